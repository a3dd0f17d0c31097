"""Calibration of rigs of RGB-D cameras: poses, intrinsics and depth bias, to a millimetre or two."""

__version__ = "0.1.0"
"""Read by pyproject.toml; looking the version up among the installed packages takes longer than all of `--help`."""
