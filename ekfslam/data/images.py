"""Recordings of stereo images with their calibration. `ekfslam.frontend` rectifies and tracks them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array
from ekfslam.data.checks import checked_pose, frozen, require_finite, require_shape, spelled_as_in, validate_stamps
from ekfslam.data.inputs import InertialSamples, Velocities, VelocityFrame
from ekfslam.data.noise import Noise
from ekfslam.data.observations import Truth, validate_truth
from ekfslam.errors import CalibrationError
from ekfslam.geometry import se3
from ekfslam.names import printable
from ekfslam.shown import Card, Shown, count, figure

Image = NDArray[np.uint8]
DistortionModel = Literal["none", "radtan", "equidistant"]

# Allowed numbers of coefficients of a model.
_COEFFICIENTS: dict[DistortionModel, tuple[int, ...]] = {"none": (0,), "radtan": (4, 5, 8), "equidistant": (4,)}
LEAST_BASELINE_M, LARGEST_BASELINE_M = 0.005, 5.0  # others are named: their unit is probably another one
_LEAST_FOCAL_PX = 1e-3
_LARGEST_SIDE_PX = 1 << 15  # limit of OpenCV's remap


@dataclass(frozen=True)
class Distortion:
    """Distortion of a lens.

    Args:
        model: ``none``, ``radtan`` (radial and tangential, Brown 1966) or ``equidistant`` (Kannala and Brandt 2006).
        coefficients: ``(k1, k2, p1, p2[, k3[, k4, k5, k6]])`` of radtan, ``(k1, k2, k3, k4)`` of equidistant.
    """

    model: DistortionModel = "none"
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.model not in get_args(DistortionModel):
            message = f"expected {', '.join(get_args(DistortionModel))}, found {self.model!r}"
            raise CalibrationError(message, field="distortion")
        object.__setattr__(self, "coefficients", tuple(float(value) for value in self.coefficients))
        allowed = _COEFFICIENTS[self.model]
        if len(self.coefficients) not in allowed:
            message = f"{self.model} has {' or '.join(map(str, allowed))} coefficients, found {len(self.coefficients)}"
            raise CalibrationError(message, field="distortion")
        require_finite(np.array(self.coefficients), "distortion")


@dataclass(frozen=True)
class PairCalibration:
    """Calibration of two cameras, rectified or not; raise a `DataError` if it is impossible."""

    K_left: Array  # K_left, K_right: (3, 3) intrinsic matrices, px
    K_right: Array
    size: tuple[int, int]  # width and height of the images of both, px
    T_right_left: Array  # (4, 4) left to right optical frame; that of a rectified pair is `side_by_side`
    # distortion_left, distortion_right: Distortion of the lenses.
    distortion_left: Distortion = field(default_factory=Distortion)
    distortion_right: Distortion = field(default_factory=Distortion)

    def __post_init__(self) -> None:
        for name in ("K_left", "K_right"):
            object.__setattr__(self, name, _checked_intrinsics(getattr(self, name), name))
        object.__setattr__(self, "size", _checked_size(self.size))
        object.__setattr__(self, "T_right_left", checked_pose(self.T_right_left, "T_right_left"))
        if not np.linalg.norm(self.T_right_left[:3, 3]) > 0:
            raise CalibrationError("the two cameras are at the same place", field="T_right_left")

    @property
    def is_rectified(self) -> bool:
        """Whether rows agree already: no distortion, equal intrinsics without skew, and a shift along x alone."""
        T = self.T_right_left
        return (
            self.distortion_left.model == self.distortion_right.model == "none"
            and bool((self.K_left == self.K_right).all())
            and self.K_left[0, 1] == 0
            and T[0, 3] < 0
            and bool(np.abs(T - side_by_side(-T[0, 3])).max() < 1e-9)
        )


@dataclass(frozen=True)
class LensCalibration:
    """Calibration of one camera; raise a `DataError` if it is impossible."""

    K: Array  # (3, 3) intrinsic matrix, px
    size: tuple[int, int]  # width and height of the images, px
    distortion: Distortion = field(default_factory=Distortion)

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", _checked_intrinsics(self.K, "K"))
        object.__setattr__(self, "size", _checked_size(self.size))


def _checked_intrinsics(matrix: Array, name: str) -> Array:
    K = np.asarray(matrix, dtype=float)
    require_shape(K, (3, 3), name)
    require_finite(K, name, 1e7)
    if min(K[0, 0], K[1, 1]) < _LEAST_FOCAL_PX or (K[2] != (0, 0, 1)).any() or K[1, 0] != 0:
        raise CalibrationError("not an intrinsic matrix: upper triangular, positive focal lengths", field=name)
    return frozen(K)


def _checked_size(given: tuple[int, int]) -> tuple[int, ...]:
    size = tuple(int(side) for side in given)
    if len(size) != 2 or not all(0 < side < _LARGEST_SIDE_PX for side in size):
        raise CalibrationError(f"expected width and height of an image, found {given}", field="size")
    return size


def baseline_doubt(baseline_m: float) -> str:
    """Return a warning about a baseline that is hardly in metres; empty without one."""
    if baseline_m > LARGEST_BASELINE_M:
        in_mm = f"as if it were in mm ({baseline_m / 1e3:.4g} m)"
        return f"the baseline is {baseline_m:.6g} m: the calibration looks {in_mm}"
    if 0 < baseline_m < LEAST_BASELINE_M:
        return f"the baseline is {1e3 * baseline_m:.4g} mm: the calibration looks as if it were not in metres"
    return ""


def side_by_side(baseline_m: float) -> Array:
    """Return ``T_right_left`` (4, 4) of a rectified pair."""
    return se3.transform(np.eye(3), np.array([-baseline_m, 0.0, 0.0]))


@dataclass(frozen=True, repr=False)
class ImageRecording(Shown):
    """One recording of images of a pair or of one camera, with or without body velocities and inertial samples.

    Args:
        name, source, time_s, velocity_frame, truth, noise, notes, attributes: See `ekfslam.Sequence`.
        calibration: Calibration of the pair, or of the one camera.
        load: Function that returns the images of frame k, left and right or one, as (height, width) uint8, in any
            order. It raises `UnknownFormatError` or `DataError`.
        T_cam_imu: (4, 4) IMU to the optical frame of the left camera before rectification.
        twist: (T, 6) measured velocities ``[v; w]``, ``twist[k]`` drives ``(t[k-1], t[k]]``; None if there are none.
        inertial: Samples of a gyroscope and an accelerometer; None if there are none.
    """

    name: str
    source: str
    time_s: Array
    calibration: PairCalibration | LensCalibration
    load: Callable[[int], tuple[Image, ...]]
    T_cam_imu: Array
    twist: Array | None = None
    velocity_frame: VelocityFrame = "imu"
    truth: Truth | None = None
    noise: Noise | None = None
    notes: tuple[str, ...] = ()
    attributes: Mapping[str, str | int | float] = field(default_factory=dict)
    inertial: InertialSamples | None = None

    def __post_init__(self) -> None:
        for name in ("time_s",) if self.twist is None else ("time_s", "twist"):
            object.__setattr__(self, name, frozen(np.asarray(getattr(self, name), dtype=float)))
        with spelled_as_in(self.source):
            validate_stamps(self.time_s)
            if self.twist is not None:
                Velocities(self.time_s, self.twist, self.velocity_frame)
            object.__setattr__(self, "T_cam_imu", checked_pose(self.T_cam_imu, "T_cam_imu"))
            if self.truth is not None:
                validate_truth(self.truth, len(self.time_s))
        object.__setattr__(self, "name", printable(self.name))
        doubt = baseline_doubt(self.baseline_m)
        if doubt and doubt not in self.notes:
            object.__setattr__(self, "notes", (doubt, *self.notes))

    def __len__(self) -> int:
        return len(self.time_s)

    def card(self) -> Card:
        """Return the card that ``repr`` and a notebook show."""
        size = " x ".join(map(str, self.calibration.size))
        cameras = f"two, {figure(self.baseline_m)} m apart" if self.baseline_m else "one"
        facts = {
            "source": self.source,
            "frames": f"{len(self)}, {figure(float(self.time_s[-1] - self.time_s[0]))} s",
            "cameras": f"{cameras}, {size} px",
            "velocities": "none" if self.twist is None else f"in .twist, {self.velocity_frame} frame",
            "inertial": "none" if self.inertial is None else self.inertial.text,
            "truth": "none" if self.truth is None else self.truth.text,
        }
        facts |= {"notes": count(len(self.notes), "sentence") + " in .notes"} if self.notes else {}
        return Card(self.name, facts, ("ekfslam.track(recording)", "recording[100:300]", "recording.load(0)"))

    @property
    def baseline_m(self) -> float:
        """Distance of the cameras; 0 if there is one."""
        of_one = isinstance(self.calibration, LensCalibration)
        return 0.0 if of_one else float(np.linalg.norm(self.calibration.T_right_left[:3, 3]))  # type: ignore[union-attr]

    @property
    def has_scale(self) -> bool:
        """Whether a second camera, inertial samples or linear velocities tell the scale."""
        has_way = self.twist is not None and bool(self.twist[:, :3].any())
        return isinstance(self.calibration, PairCalibration) or self.inertial is not None or has_way

    @property
    def of_left_camera(self) -> ImageRecording:
        """The images of the left camera alone."""
        pair = self.calibration
        if isinstance(pair, LensCalibration):
            return self
        lens = LensCalibration(pair.K_left, pair.size, pair.distortion_left)
        notes = (*self.notes, "The left camera alone is used.")
        return replace(self, calibration=lens, load=_Left(self.load), notes=notes)

    def __getitem__(self, frames: slice) -> ImageRecording:
        """Return a stretch of successive frames, as a recording whose frames count from 0."""
        begin, end, _ = frames.indices(len(self))
        return replace(
            self,
            time_s=self.time_s[begin:end],
            load=_Later(self.load, begin),
            twist=None if self.twist is None else self.twist[begin:end],
            truth=None if self.truth is None else self.truth.stretch(begin, end),
        )


@dataclass(frozen=True)
class _Later:
    """Load images that begin at a later frame."""

    load: Callable[[int], tuple[Image, ...]]
    begin: int

    def __call__(self, frame: int) -> tuple[Image, ...]:
        return self.load(self.begin + frame)


@dataclass(frozen=True)
class _Left:
    """Load left images alone."""

    load: Callable[[int], tuple[Image, ...]]

    def __call__(self, frame: int) -> tuple[Image, ...]:
        return self.load(frame)[:1]
