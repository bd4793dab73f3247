"""Sensors: what observes landmarks or velocities. One file a sensor."""

from ekfslam.models.sensors.base import Sensor
from ekfslam.models.sensors.stereo import Rig

__all__ = ["Rig", "Sensor"]
