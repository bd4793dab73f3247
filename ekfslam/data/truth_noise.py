"""Noise of a ground truth itself, which NEES adds to the covariance of the estimate."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple


@dataclass(frozen=True)
class TruthNoise:
    """Standard deviations of a ground truth, all independent of each other.

    Errors of the first pose and of the world move the whole estimate, which starts at the first true pose. Drift and
    turned body grow with time and motion. The other errors belong to single poses.
    """

    # first_roll_rad, first_pitch_rad, first_yaw_rad: Attitude of the first pose, about the axes of the IMU.
    first_roll_rad: float = 0.0
    first_pitch_rad: float = 0.0
    first_yaw_rad: float = 0.0
    first_position_m: float = 0.0  # position of the first pose, each axis
    stamp_s: float = 0.0  # jitter of the stamps: an error along the motion, in proportion to the velocities
    position_m: float = 0.0  # position of each pose, each axis
    attitude_rad: float = 0.0  # attitude of each pose, each axis
    world_tilt_rad: float = 0.0  # error of the vertical of the world, about each level axis of it
    turn_rad: float = 0.0  # constant error of the axes of the true body, about each axis: of extrinsics, say
    drift_m_sqrt_s: float = 0.0  # random walk of the position, each axis: standard deviation after one second
    scale: float = 0.0  # error of all distances, as a share of them: of a projection of the Earth, say

    @property
    def text(self) -> str:
        """Return all values in one line, angles in degrees."""
        angles = (self.first_roll_rad, self.first_pitch_rad, self.first_yaw_rad, self.attitude_rad)
        roll, pitch, yaw, attitude = (f"{math.degrees(angle):.3g}" for angle in angles)
        text = f"first pose {roll}, {pitch}, {yaw} deg (roll, pitch, yaw), {self.first_position_m:.3g} m"
        text += f"; each pose {self.position_m:.3g} m, {attitude} deg, stamps {1e3 * self.stamp_s:.3g} ms"
        tilt, turn = (f"{math.degrees(value):.3g} deg" for value in (self.world_tilt_rad, self.turn_rad))
        drift = f"{self.drift_m_sqrt_s:.3g} m/sqrt(s)"
        slow = [(self.world_tilt_rad, f"world tilt {tilt}"), (self.turn_rad, f"body turned {turn}")]
        slow += [(self.drift_m_sqrt_s, f"drift {drift}"), (self.scale, f"scale {self.scale:.3g}")]
        return "; ".join([text, *(words for value, words in slow if value)])


class Doubt(NamedTuple):
    """A stretch in which the truth contradicts velocities and vision, which agree."""

    begin: int  # begin, end: first and last frame
    end: int
    axis: int  # axis 0 to 5 of the pose error in the IMU frame
    size: float  # offset of the later poses, m or rad


_DOUBTS, _DRIFT = "truth_doubts", "truth_drift_m_sqrt_s"


def doubt_attributes(doubts: Iterable[Doubt], drift_m_sqrt_s: float) -> dict[str, str | float]:
    """Return what a recording itself says against its truth as attributes of a result; empty without any."""
    text = "; ".join(f"{one.begin}-{one.end} {one.axis} {one.size:.4g}" for one in doubts)
    return ({_DOUBTS: text} if text else {}) | ({_DRIFT: drift_m_sqrt_s} if drift_m_sqrt_s else {})


def doubts_of(attributes: Mapping[str, str | int | float]) -> tuple[tuple[Doubt, ...], float]:
    """Return the doubts and the drift among attributes; text that is none holds no doubts."""
    rows = re.findall(r"(\d+)-(\d+) ([0-5]) ([\d.e+-]+)", str(attributes.get(_DOUBTS, "")))
    doubts = tuple(Doubt(int(begin), int(end), int(axis), float(size)) for begin, end, axis, size in rows)
    return doubts, float(attributes.get(_DRIFT, 0.0))


KITTI_TRUTH_NOISE = TruthNoise(
    first_roll_rad=math.radians(0.2),
    first_pitch_rad=math.radians(0.2),
    first_yaw_rad=math.radians(0.5),
    stamp_s=0.003,
    position_m=0.02,
    attitude_rad=math.radians(0.1),
    scale=0.0015,
)
"""The GPS/INS unit of KITTI (OXTS RT3003), whose output is the truth of KITTI raw, KITTI odometry and the UTIAS drives.

Position and attitude are what Geiger, Lenz, Stiller, Urtasun, "Vision meets Robotics: The KITTI Dataset", IJRR 2013,
state of it: 0.02 m and 0.1 deg. They agree with the drives themselves, where the truth's rotation differs from the
unit's own gyros by 0.02 deg a root frame over 50 frames, and its stamps jitter by about 3 ms. Roll, pitch and heading
of the first pose are those between the truth and the direction in which the vehicle really drives off.

Positions are the Mercator projection of a sphere of 6378137 m. The radii of the ellipsoid at 49 degrees are 6390.3 km
(east) and 6371.8 km (north), so eastward distances are 0.19 % too short, northward ones 0.10 % too long: 0.15 % root
mean square. Velocities show it: on drive 0027 the ratio of true to measured length changes with the heading by an
amplitude of 0.18 +- 0.05 %, where 0.145 % is expected.
"""
