"""Process models: how the state gets from one frame to the next. One file a process; see `base` for the contract."""

from ekfslam.models.process.base import MakeProcess, Measured, Process, Residual, Step
from ekfslam.models.process.inertial import INERTIAL_BLOCKS, Inertial
from ekfslam.models.process.velocities import VelocityInputs, VelocityWalk

__all__ = [
    "INERTIAL_BLOCKS",
    "Inertial",
    "MakeProcess",
    "Measured",
    "Process",
    "Residual",
    "Step",
    "VelocityInputs",
    "VelocityWalk",
]
