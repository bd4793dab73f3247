"""State blocks: everything that filter and smoother estimate besides landmarks. A new block is a new file."""

from ekfslam.models.blocks.base import OPTIONAL_BLOCKS, Layout, StateBlock, Values, optional_block
from ekfslam.models.blocks.calibration import Calibration
from ekfslam.models.blocks.camera_jitter import CameraJitter
from ekfslam.models.blocks.imu_scale import ImuScale
from ekfslam.models.blocks.inertial import AccelBias, GyroBias, Velocity
from ekfslam.models.blocks.pose import Pose
from ekfslam.models.blocks.twist import Twist
from ekfslam.models.blocks.twist_bias import TwistBias
from ekfslam.models.blocks.up import Up
from ekfslam.models.blocks.view import Anchor, PreviousView, View
from ekfslam.models.blocks.vision_drift import VisionDrift

__all__ = [
    "OPTIONAL_BLOCKS",
    "AccelBias",
    "Anchor",
    "Calibration",
    "CameraJitter",
    "GyroBias",
    "ImuScale",
    "Layout",
    "Pose",
    "PreviousView",
    "StateBlock",
    "Twist",
    "TwistBias",
    "Up",
    "Values",
    "Velocity",
    "View",
    "VisionDrift",
    "optional_block",
]
