"""The estimators: the joint filter, mapping-only, dead reckoning, and what they share."""

from ekfslam.filters.joint import JointEKF

__all__ = ["JointEKF"]
