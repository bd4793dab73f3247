"""A reference filter in the middle of a drive, and a compiled one in the same state."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ekfslam.config import CalibrationConfig, FilterConfig
from ekfslam.data.noise import Noise
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.observing import camera_of, look
from ekfslam.geometry import se3
from ekfslam.geometry.camera import DEPTH_FROM_PX, StereoCamera
from ekfslam.models.blocks import Calibration, CameraJitter, StateBlock, Up, VisionDrift
from ekfslam.models.build import model_of
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.models.sensors.stereo import Rig
from support.reference import T_CAM_IMU

CAMERA = StereoCamera(fu_px=400.0, fv_px=410.0, cu_px=320.0, cv_px=240.0, baseline_m=0.5)
CALIBRATION = CalibrationConfig(lever_arm_m=0.1, rotation_deg=2.0, baseline=0.02, disparity_px=1.0, time_s=0.05)
NOISE = dataclasses.replace(Noise.isotropic(0.1, 0.01, 0.7), pixel_std_px=np.array([0.6, 0.7, 0.8, 0.9]))
TRACKS = dataclasses.replace(
    NOISE,
    track_first_px=np.array([0.5, 0.6, 0.7]),
    track_walk_px=np.array([0.2, 0.3, 0.1]),
    track_flow_px=20.0,
    track_parallax=0.3,
)
LANDMARKS, STEP = 7, 4
EXTRINSICS = se3.exp(np.array([0.3, -0.2, 0.5, 0.3, -0.2, 0.1])) @ T_CAM_IMU


class Sway(StateBlock):
    """A block that moves the camera, in differences otherwise than in single observations."""

    name, size = "sway", 6
    is_seen = per_frame = True

    def transition(self, tau_s, way_m):
        return np.full((*np.shape(tau_s), 6), 0.9), np.full((*np.shape(tau_s), 6), 0.01)

    def camera_share(self, way_m, is_difference):
        return np.where(is_difference, way_m, 0.3)


@dataclass(frozen=True)
class Case:
    """What a model has; all is there by default."""

    variant: str = "invariant"
    coordinates: str = "image"
    tracks: bool = True
    calibration: bool = True
    blocks: bool = True
    monocular: bool = False

    def estimate(self, T_imu_world, rng):
        """Return a reference estimate at a pose, with seven landmarks in view, and a covariance for it."""
        noise = TRACKS if self.tracks else NOISE
        sensor = (Monocular if self.monocular else Rig)(CAMERA, EXTRINSICS, noise)
        blocks = (CameraJitter(), Sway(), VisionDrift()) if self.blocks else ()
        calibration = CALIBRATION if self.calibration else None
        model = model_of(sensor, noise, T_imu_world, np.eye(6) * 1e-4, calibration, blocks, self.coordinates)
        settings = {"variant": self.variant, "landmark_coordinates": self.coordinates, "engine": "reference"}
        e = Estimate(model, FilterConfig(**settings))
        values = {**e.values, **{block.name: rng.normal(size=6) * 0.05 for block in blocks}}
        if self.calibration:
            values["calibration"] = rng.normal(size=9) * [0.1, 0.1, 0.1, 0.05, 0.05, 0.05, 0.02, 1.0, 0.05]
        e.values, e.step = values, STEP
        e.imu_twist = rng.normal(size=6) * [3, 3, 3, 0.3, 0.3, 0.3]
        e.motion = dataclasses.replace(e.motion, way_m=np.array(1.3))
        W = camera_of(e, e.mean)
        for name, spread in (("previous_view", 0.1), ("anchor", 0.3)):
            if name in values:
                values[name] = se3.exp(rng.normal(size=6) * spread) @ W
        look(e)
        n, body = LANDMARKS, model.layout.body
        q = rng.normal(size=(n, 3)) * [3, 2, 6] + [0, 0, 16]
        position_m, step = se3.apply(se3.inverse(W), q), np.arange(n)
        e.table.append(
            id=step + 10,
            first_step=step % 3,
            last_step=np.where(step % 3 == 1, STEP - 2, STEP - 1),
            position_m=position_m,
            initial_m=position_m,
            seen_rows=sensor.predict(q) + rng.normal(size=(n, sensor.dimension)),
        )
        e.updated_view = "previous_view" if "view" in values else e.updated_view
        root = rng.normal(size=(body + 3 * n, body + 3 * n)) * 0.02
        return e, root @ root.T + 1e-4 * np.eye(len(root))


def flat(e, values=None):
    """Return the values of all blocks as one vector."""
    values = e.values if values is None else values
    return np.concatenate([np.ravel(values[block.name]) for block in e.model.layout.blocks])


def arguments(e, values=None, waiting_gate=1e9):
    """Return the arguments of a `Filter` of the module for a reference estimate."""
    error = e.model.noise.track_error
    return [
        _blocks(e.model),
        _sensor(e.sensor),
        None if error is None else vars(error),
        {**_CONFIG, **_settings(e.config), "waiting_gate": waiting_gate},
        flat(e) if values is None else values,
        e.coordinates,
        e.model.prior_covariance,
        _shares(e),
    ]


def compiled(engine, e, P=None, values=None, position_m=None, waiting_gate=1e9):
    """Return a `Filter` of the module in the state of a reference estimate with covariance P, its view open."""
    values, body = flat(e, values), e.model.layout.body
    made = engine.Filter(*arguments(e, values, waiting_gate))
    for _ in range(e.step):
        arrive(made, e, values, np.eye(body), np.zeros((body, body)))
    table = {name: np.ascontiguousarray(getattr(e.table, name)) for name in _COLUMNS}
    made.revive(table)
    position_m = e.table.position_m if position_m is None else position_m
    made.adopt(made.values(), e.coordinates, position_m, np.eye(body + 3 * len(e.table)) if P is None else P)
    engine.set_updated(made, e.updated_view or "none")
    return made


def arrive(made, e, values, Phi, Q):
    """Predict a compiled filter to values (all blocks as one vector), by the way of an estimate."""
    T, numbers = e.T_imu_world, (0.1, float(e.motion.way_m), 1.0)
    made.arrive(values, e.coordinates, e.imu_twist, Phi, Q, T, T, np.zeros(Q.shape), numbers, None, _shares(e))


def _shares(e):
    """Return the shares (2, b) of blocks that move the camera, of single observations and of differences."""
    moving = [block for block in e.model.layout.blocks if block.coupling == "camera"]
    shares = [[block.camera_share(e.motion.way_m, np.array(follows)) for block in moving] for follows in (False, True)]
    return np.array(shares, dtype=float).reshape(2, -1)


_COLUMNS = (
    *("id", "first_frame", "last_frame", "observations", "misses", "log_row", "stay_until", "first_step", "last_step"),
    *("last_observation", "asleep", "position_m", "initial_m", "evidence", "seen_rows"),
)
_CONFIG = dict.fromkeys(("gate", "input_gate"), 1e9) | {
    "gate_probability": 1.0,
    "moving_sigma": 1.5,
    "moving_share": 0.05,
    "retire_after": 1,
    "misses_to_split": 0,
    "dormant": -1,
    "doubt": 30.0,
    "estimates_velocity": False,
}


def _settings(config):
    is_by_image = config.landmark_coordinates == "image"
    is_invariant = config.variant == "invariant"
    return {"is_invariant": is_invariant, "image_coordinates": is_by_image, "min_depth_m": config.min_depth_m}


def _blocks(model):
    made, at = [], 0
    for block in model.layout.blocks:
        kinds = {"pose": block.is_pose or block.is_view, "direction": isinstance(block, Up)}
        kinds |= {"calibration": isinstance(block, Calibration), "vector": True}
        size, columns = block.initial().size, model.layout[block.name]
        made.append(
            {
                "name": block.name,
                "kind": next(kind for kind, fits in kinds.items() if fits),
                "at": columns.start,
                "size": block.size,
                "value_at": at,
                "value_size": size,
                "moves_camera": block.coupling == "camera",
                "free": block.free.tolist() if isinstance(block, Calibration) else [],
            }
        )
        at += size
    return made


def _sensor(sensor):
    variance, is_rig = np.asarray(sensor.noise.pixel_std_px) ** 2, isinstance(sensor, Rig)
    return {
        **vars(sensor.camera),
        "is_monocular": not is_rig,
        "disparity_offset_px": 0.0,
        "least_disparity_px": DEPTH_FROM_PX,
        "sees_disparity": is_rig and sensor.noise.track_error is not None,
        "weight_left": variance[3] / (variance[1] + variance[3]),
        "T_cam_imu": sensor.T_cam_imu,
        "variance_px2": sensor.variance_px2 if is_rig else variance[:3],
        "parallax_rad": getattr(sensor, "parallax_rad", 0.0),
        "patience": getattr(sensor, "patience", 0),
    }
