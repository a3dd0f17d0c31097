"""Calibration of rigs of RGB-D cameras: poses, intrinsics and depth bias, to a millimetre or two."""

from importlib.metadata import version

__version__ = version("rgbd-calib")
