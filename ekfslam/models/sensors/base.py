"""The interface of a sensor of point landmarks."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.noise import Noise

# Reason codes of `Sensor.screen`; the index into `ekfslam.filters.result.REASONS` of what is rejected.
ACCEPTED = -1
GATE, DISPARITY, _, BEHIND_CAMERA, MOVING, WAITING = range(6)


class Sensor(Protocol):
    """Anything that sees point landmarks in d rows each: ``z = h(q)``, ``q = T_cam_imu s``, with independent errors.

    `ekfslam.models.sensors.stereo.Rig` is the main one; experiments bring their own.
    """

    @property
    def T_cam_imu(self) -> Array:
        """(4, 4) extrinsics, IMU to the frame of ``q``."""

    @property
    def dimension(self) -> int:
        """Rows of an observation, d."""

    @property
    def noise(self) -> Noise:
        """Noise of velocities and measurements."""

    def screen(self, measured: Array, min_depth_m: float) -> IntArray:
        """Return reason codes (n,), judged from the measurements alone."""

    def in_view(self, q: Array, min_depth_m: float) -> BoolArray:
        """Return whether (n,) points (n, 3) can be seen at all."""

    def rows(self, measured: Array) -> Array:
        """Return the rows (n, d) of each measurement."""

    def variance(self, rows: Array) -> Array:
        """Return variances (n, d) of the rows if noise is white."""

    def predict(self, q: Array) -> Array:
        """``h(q)``: points (n, 3) m to rows (n, d)."""

    def jacobian(self, q: Array) -> Array:
        """``dh/dq`` (n, d, 3)."""

    def invert(self, rows: Array) -> Array:
        """Return the points (n, 3) m that rows (n, d) see; never called for a `DelayedSensor`."""


@runtime_checkable
class DelayedSensor(Protocol):
    """A `Sensor` that needs two views to locate a landmark, such as one camera alone.

    Its model has the block `ekfslam.models.blocks.pose.Anchor`. New tracks wait from the anchor on, until
    `triangulate` has an answer; see `ekfslam.filters.starting`.
    """

    @property
    def patience(self) -> int:
        """Frames after which the anchor moves on."""

    def triangulate(self, rows_anchor: Array, rows: Array, T_now_anchor: Array) -> tuple[Array, BoolArray]:
        """Return points (n, 3) in the sensor's frame from two views (n, d), and whether (n,) parallax suffices.

        ``T_now_anchor`` (4, 4) maps the sensor's frame at the anchor into the present one.
        """
