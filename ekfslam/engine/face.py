"""The face of the compiled filter: a model as plain data, values of blocks by name, and the covariance's verbs.

`Engine` owns mean, landmark table and covariance. It has the verbs of `ekfslam.filters.gaussian.Gaussian` that
predictions, references and reports need.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, cast

import numpy as np
from scipy.special import gammaincinv

from ekfslam.arrays import Array, IntArray
from ekfslam.config import FilterConfig
from ekfslam.data.interval import Interval
from ekfslam.engine.report import Gone, Report, report, retired
from ekfslam.geometry.camera import DEPTH_FROM_PX
from ekfslam.models.blocks import StateBlock, Twist, Values
from ekfslam.models.build import has_image_coordinates
from ekfslam.models.model import Model
from ekfslam.models.process import Inertial, VelocityInputs, VelocityWalk
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.models.sensors.stereo import Rig

# Thresholds of the consensus and of the gate on inputs: those of the reference filter.
DOUBT, INPUT_PROBABILITY = 30.0, 1.0 - 1e-4


_KINDS = (np.zeros((), dtype=bool), np.ones((), dtype=bool))


class Engine:
    """Mean and covariance of a joint filter in C++, the compiled ``filter``, which may make predictions, too."""

    def __init__(self, model: Model, config: FilterConfig) -> None:
        from ekfslam.engine._engine import Filter

        self._model = model
        self.body = model.layout.body
        self._places = _places(model.layout.blocks, model.initial_values())
        self._numbers = max(at.stop for at, _ in self._places.values())
        self._camera = [block for block in model.layout.blocks if block.coupling == "camera"]
        error = model.noise.track_error
        self.filter = Filter(
            _blocks(model, self._places),
            _sensor(model.sensor),
            None if error is None else vars(error),
            _config(model, config),
            self._flat(model.initial_values()),
            model.initial_coordinates,
            np.asarray(model.prior_covariance, dtype=float),
            self._shares(0.0),
        )
        laws = [law for block in model.layout.blocks if (law := block.as_data()) is not None]
        process = process_of(model)
        self.predicts = False
        if process is not None and len(laws) == len(model.layout.blocks):
            self.filter.set_process(laws, process)
            self.predicts = True

    def __deepcopy__(self, memo: dict[int, Any]) -> Engine:
        copy = object.__new__(Engine)
        copy.__dict__.update(self.__dict__, filter=self.filter.copy())
        return copy

    def _flat(self, values: Values) -> Array:
        return np.concatenate([np.ravel(values[name]) for name in self._places])

    def _shares(self, way_m: Array | float) -> Array:
        """Return the shares (2, b) of blocks that move the camera, of single observations and of differences."""
        way = np.asarray(way_m, dtype=float)
        shares = [[block.camera_share(way, is_difference) for block in self._camera] for is_difference in _KINDS]
        return np.array(shares, dtype=float).reshape(2, -1)

    def named(self, flat: Array, names: Iterable[str] | None = None) -> dict[str, Array]:
        """Return the values of blocks by name, of all or of some."""
        found = {}
        for name in self._places if names is None else names:
            at, shape = self._places[name]
            found[name] = flat[at] if len(shape) == 1 else flat[at].reshape(shape)
        return found

    @property
    def values(self) -> dict[str, Array]:
        """Estimate of every state block by name."""
        return self.named(self.filter.values())

    # --- predictions --------------------------------------------------------------------------------------------------

    def predict(self, interval: Interval) -> dict[str, Any] | None:
        """Predict by eq. (1) and (2), or (12); None: the model needs the prediction in Python.

        Returns:
            Flat ``values``, ``coordinates`` and ``departed`` coordinates, ``imu_twist``, ``way_m``, the pose
            ``T_departed`` that the process moved, and the extrinsics ``T_cam_imu`` of the frame before; ``nis`` and
            ``log_det`` of inputs that measure velocities in the state, and the factor ``doubt`` of their standard
            deviations.
        """
        if not self.predicts:
            return None
        found: dict[str, Any] = self.filter.predict(
            interval.tau_s, interval.dt_s, interval.inputs, interval.is_gap, interval.doubt
        )
        return found

    def propagate(self, Phi: Array, Q: Array) -> None:
        """Propagate the blocks, eq. (2)."""
        self.filter.propagate(Phi, Q)

    def measure(
        self, values: Values, coordinates: Array, H: Array, residual: Array, variance: Array
    ) -> tuple[dict[str, Array], Array, float, float]:
        """Condition on rows H (k, body) of the blocks, eq. (6) and (7'); return the mean, NIS and ``log det S``."""
        flat, coordinates, nis, log_det = self.filter.measure(
            self._flat(values), coordinates, H, residual, np.asarray(variance, dtype=float)
        )
        return self.named(flat), coordinates, nis, log_det

    def arrive(
        self, values: Values, coordinates: Array, imu_twist: Array, Phi: Array, Q: Array, motion: Any
    ) -> tuple[dict[str, Array], Array]:
        """End a prediction: propagate by eq. (2), take the mean of the blocks, and open the view of this frame.

        ``Phi`` and ``Q`` (body, body) are those of the blocks; views do not count. Return values and coordinates with
        those of the view.
        """
        flat, coordinates = self.filter.arrive(
            self._flat(values),
            coordinates,
            imu_twist,
            Phi,
            Q,
            motion.T_departed,
            motion.T_predicted,
            motion.Q,
            (motion.tau_s, float(motion.way_m), motion.interval.doubt),
            motion.last,
            self._shares(motion.way_m),
        )
        return self.named(flat), coordinates

    # --- frames -------------------------------------------------------------------------------------------------------

    def rest(self, frame: int, ids: IntArray) -> Gone | None:
        """Let landmarks out of view sleep or retire; return those that retired, None: there are none."""
        return retired(self.filter.rest(frame, ids))

    def update(
        self, frame: int, ids: IntArray, measured: Array, is_rested: bool, twist_after: Callable[[Values], Array] | None
    ) -> Report:
        """Update by a frame's observations, unless `rest` was called, and return what the log and the report need.

        ``twist_after`` returns the velocity (6,) of the IMU at this frame by corrected values, for a time offset.
        """
        function = None if twist_after is None else lambda flat: twist_after(self.named(flat))
        found = self.filter.update(frame, ids, measured, is_rested, function)
        return report(found, self._numbers, self._model.layout.body, self._model.sensor.dimension)

    def look_again(self, imu_twist: Array) -> tuple[dict[str, Array], Array]:
        """Open the view of the first frame for a velocity (6,) of the IMU; return values and coordinates."""
        flat, coordinates = self.filter.look_again(imu_twist)
        return self.named(flat), coordinates

    def table(self) -> dict[str, Array | IntArray]:
        """Return the columns of the landmark table."""
        found: dict[str, Array | IntArray] = self.filter.table()
        return found

    def revive(self, more: dict[str, Any]) -> None:
        """Append landmarks to the table, given its columns; `adopt` must follow."""
        self.filter.revive(more)

    def adopt(self, values: Values, coordinates: Array, position_m: Array, P: Array) -> tuple[dict[str, Array], Array]:
        """Replace mean and covariance of blocks and landmarks; return values and coordinates with those of the view."""
        flat, coordinates = self.filter.adopt(self._flat(values), coordinates, position_m, P)
        return self.named(flat), coordinates

    def replace(self, P: Array) -> None:
        """Replace the covariance (body+3n, body+3n)."""
        self.filter.replace(P)

    # --- the covariance -----------------------------------------------------------------------------------------------

    @property
    def considered(self) -> int:
        """Number of considered columns, between body and landmarks."""
        return int(self.filter.considered())

    @property
    def landmarks(self) -> int:
        """Number n of landmarks."""
        return int(self.filter.landmarks())

    @property
    def P(self) -> Array:
        """(body+3n, body+3n), a copy."""
        P = self.filter.covariance()
        return np.asarray(0.5 * (P + P.T))

    @property
    def body_covariance(self) -> Array:
        """(body, body), a copy; with the considered columns."""
        return np.asarray(self.filter.body_covariance())

    @property
    def is_finite(self) -> bool:
        """Whether no number on the diagonal blocks is NaN or infinite."""
        return bool(np.isfinite(self.body_covariance).all() and np.isfinite(self.landmark_blocks()).all())

    def landmark_blocks(self, slot: IntArray | None = None) -> Array:
        """Return the landmarks' own covariances (k, 3, 3), of all or at slots (k,)."""
        return np.asarray(self.filter.landmark_blocks(slot))

    def covariance_of(self, slot: IntArray) -> Array:
        """Return the covariance (body+3k, body+3k) of the body and of the landmarks at the slots (k,)."""
        return np.asarray(self.filter.covariance(slot))

    def consider(self, columns: int) -> int:
        """Add considered columns, and return the first of them."""
        first = int(self.filter.consider(columns))
        self.body += columns
        return first

    def clone(self, source: slice, to: slice) -> None:
        """Copy body columns into considered ones."""
        self.filter.clone(source.start, source.stop - source.start, to.start)


def flops() -> float:
    """Return the floating point operations of BLAS and LAPACK calls of the engine in this thread so far."""
    from ekfslam.engine._engine import flops as counted

    return float(counted())


def _places(blocks: tuple[StateBlock, ...], values: Values) -> dict[str, tuple[slice, tuple[int, ...]]]:
    """Return the place and the shape of each block's value in the flat vector."""
    end, places = 0, {}
    for block in blocks:
        begin, end = end, end + values[block.name].size
        places[block.name] = slice(begin, end), values[block.name].shape
    return places


def _blocks(model: Model, places: dict[str, tuple[slice, tuple[int, ...]]]) -> list[dict[str, Any]]:
    return [
        {
            "name": block.name,
            "kind": block.retraction,
            "at": model.layout[block.name].start,
            "size": block.size,
            "value_at": places[block.name][0].start,
            "value_size": places[block.name][0].stop - places[block.name][0].start,
            "moves_camera": block.coupling == "camera",
            "free": np.asarray(getattr(block, "free", ())).tolist(),
        }
        for block in model.layout.blocks
    ]


def process_of(model: Model) -> dict[str, Any] | None:
    """Return the process as data; None: it is a class of Python alone."""
    process = model.process
    if type(process) is Inertial and not process.has_scale:
        densities = {name: float(value) for name, value in vars(process.noise).items()}
        return {"kind": "inertial", **densities, "gravity_m_s2": process.gravity_m_s2}
    if type(process) not in (VelocityInputs, VelocityWalk):
        return None
    stds = {name: np.asarray(getattr(model.noise.process, name), dtype=float) for name in ("pose_std", "gap_std")}
    if not process.estimates_velocity:
        return {"kind": "velocities", "walks": False, **stds}
    twist_std, twist = np.asarray(model.noise.process.twist_std, dtype=float), cast(Twist, model.layout.block("twist"))
    return {"kind": "velocities", "walks": True, **stds, "twist_std": twist_std, "is_measured": twist.is_measured}


def _sensor(sensor: Any) -> dict[str, Any]:
    is_rig = isinstance(sensor, Rig)
    pixels = np.asarray(sensor.noise.pixel_std_px, dtype=float) ** 2
    return {
        **vars(sensor.camera),
        "is_monocular": not is_rig,
        "disparity_offset_px": sensor.disparity_offset_px if is_rig else 0.0,
        "least_disparity_px": DEPTH_FROM_PX,
        "sees_disparity": is_rig and sensor.noise.track_error is not None,
        "weight_left": pixels[3] / (pixels[1] + pixels[3]),
        "T_cam_imu": np.asarray(sensor.T_cam_imu, dtype=float),
        "variance_px2": sensor.variance_px2 if is_rig else np.array([*pixels[:2], 1.0]),
        "parallax_rad": getattr(sensor, "parallax_rad", 0.0),
        "patience": getattr(sensor, "patience", 0),
    }


def _config(model: Model, config: FilterConfig) -> dict[str, Any]:
    sensor, probability = model.sensor, config.gate_probability
    return {
        "is_invariant": config.variant == "invariant",
        "image_coordinates": has_image_coordinates(sensor, config.landmark_coordinates),
        "gate": _threshold(probability, sensor.dimension),
        "gate_probability": probability,
        # Two views of two rows each leave one row once they have located a landmark.
        "waiting_gate": _threshold(probability, 1) if isinstance(sensor, Monocular) else 0.0,
        "min_depth_m": config.min_depth_m,
        "moving_sigma": config.moving_sigma,
        "moving_share": config.moving_share,
        "estimates_velocity": model.process.estimates_velocity,
        "retire_after": config.retire_after or 1,
        "misses_to_split": config.misses_to_split(model.track_error is not None),
        "dormant": -1 if config.retire == "never" else config.dormant or 0,
        "input_gate": _threshold(INPUT_PROBABILITY, 6),
        "doubt": DOUBT,
    }


def _threshold(probability: float, dimension: int) -> float:
    """Return the chi-square threshold of a gate, see `ekfslam.filters.gates`."""
    return 2.0 * float(gammaincinv(dimension / 2.0, probability))
