"""The unknowns of the rig: one a file, listed here.

What is listed as estimated is solved for; what is held is tested, and named where it is not zero. To turn a suspicion into an
unknown is to move its line.
"""

from __future__ import annotations

from rgbd_calib.rig.blocks.block import Block, BlockPrior, Component, Fault, Kind, PointBlock, Scope, Told
from rgbd_calib.rig.blocks.board_back import BackSheet
from rgbd_calib.rig.blocks.board_bow import BoardBow
from rgbd_calib.rig.blocks.board_corners import CornerOffsets
from rgbd_calib.rig.blocks.board_print import BoardPrint
from rgbd_calib.rig.blocks.board_scale import BoardScale
from rgbd_calib.rig.blocks.board_shape import BoardShapeBlock
from rgbd_calib.rig.blocks.board_warp import BoardWarp
from rgbd_calib.rig.blocks.camera_poses import CameraPoses
from rgbd_calib.rig.blocks.depth_bias import DepthBiasBlock
from rgbd_calib.rig.blocks.depth_drift import DepthDrift
from rgbd_calib.rig.blocks.depth_error import DepthErrorBlock
from rgbd_calib.rig.blocks.depth_field import DepthField
from rgbd_calib.rig.blocks.depth_of_board import DepthOfBoard
from rgbd_calib.rig.blocks.depth_range import DepthRange
from rgbd_calib.rig.blocks.depth_ripple import DepthRipple
from rgbd_calib.rig.blocks.depth_tilt import DepthTilt
from rgbd_calib.rig.blocks.intrinsics import IntrinsicsBlock
from rgbd_calib.rig.blocks.pixel_field import PixelField
from rgbd_calib.rig.blocks.registration import Registration
from rgbd_calib.rig.blocks.tape import Tape
from rgbd_calib.rig.blocks.units import Boards, WallPlanes
from rgbd_calib.rig.blocks.wall_tilt import WallTilt

ESTIMATED: tuple[type[Block], ...] = (
    CameraPoses,
    IntrinsicsBlock,
    DepthBiasBlock,
    DepthOfBoard,
    DepthDrift,
    DepthRipple,
    DepthField,
    DepthTilt,
    Registration,
    Tape,
    WallTilt,
    BoardBow,
    BoardPrint,
    BackSheet,
    CornerOffsets,
)
"""What the bundle solves for."""

HELD: tuple[type[Block], ...] = (
    BoardScale,
    BoardWarp,
    DepthRange,
    PixelField,
)
"""What it holds at zero, and the self-checks look for."""

__all__ = [
    "ESTIMATED",
    "HELD",
    "Block",
    "BlockPrior",
    "BoardShapeBlock",
    "Boards",
    "Component",
    "DepthBiasBlock",
    "DepthErrorBlock",
    "Fault",
    "Kind",
    "PointBlock",
    "Registration",
    "Scope",
    "Told",
    "WallPlanes",
]
