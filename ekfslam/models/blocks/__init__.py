"""State blocks: what the filter and the smoother estimate besides landmarks. One file a block.

A block says what it is, how a correction changes it, how it moves, and where it enters velocities or observations.
The filter and the smoother know blocks only by this interface: a new one is a new file and nothing else.
"""

from ekfslam.models.blocks.accel_bias import AccelBias
from ekfslam.models.blocks.base import OPTIONAL_BLOCKS, Layout, StateBlock, Values, optional_block
from ekfslam.models.blocks.calibration import Calibration
from ekfslam.models.blocks.camera_jitter import CameraJitter
from ekfslam.models.blocks.gyro_bias import GyroBias
from ekfslam.models.blocks.pose import Anchor, Pose, PreviousPose
from ekfslam.models.blocks.previous import Previous
from ekfslam.models.blocks.twist import Twist
from ekfslam.models.blocks.twist_bias import TwistBias
from ekfslam.models.blocks.up import Up
from ekfslam.models.blocks.velocity import Velocity
from ekfslam.models.blocks.vision_drift import VisionDrift

__all__ = [
    "OPTIONAL_BLOCKS",
    "AccelBias",
    "Anchor",
    "Calibration",
    "CameraJitter",
    "GyroBias",
    "Layout",
    "Pose",
    "Previous",
    "PreviousPose",
    "StateBlock",
    "Twist",
    "TwistBias",
    "Up",
    "Values",
    "Velocity",
    "VisionDrift",
    "optional_block",
]
