"""The three estimators: dead reckoning, the report's independent landmark EKFs, and the joint EKF."""

from ekfslam.filters.dead_reckoning import dead_reckon
from ekfslam.filters.joint import JointEKF, run_joint
from ekfslam.filters.mapping import map_landmarks

__all__ = ["JointEKF", "dead_reckon", "map_landmarks", "run_joint"]
