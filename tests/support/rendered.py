"""A small textured world, its geometry known, seen by two cameras: images for tests, rendered ray by ray."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates, zoom

from ekfslam.data.images import Distortion, ImageRecording, PairCalibration
from ekfslam.data.sequence import Truth
from ekfslam.geometry import motion, se3
from ekfslam.geometry.lens import equidistant, radtan

SIZE = 400, 200
BASELINE_M = 0.35
PERIOD_S = 0.1
_TEXEL_M = 0.04
_NOISE = 1.5  # grey levels
# A room with a pillar: planes n . p = d that face the inside, in world (x forward, y left, z up).
_PLANES = (
    ((0.0, 0.0, 1.0), -1.2),
    ((1.0, 0.0, 0.0), 26.0),
    ((1.0, 0.0, 0.0), -8.0),
    ((0.0, 1.0, 0.0), 14.0),
    ((0.0, 1.0, 0.0), -7.0),
    ((0.0, 0.0, 1.0), 6.0),
)
_PILLAR = (11.0, 12.0), (-3.5, -2.5)  # x and y of its sides, from floor to ceiling
T_CAM_BODY = se3.transform(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.1, 0.2, -0.3]))


@dataclass(frozen=True)
class Camera:
    """Rays (height, width, 3) of the pixels of a camera, optical frame."""

    rays: np.ndarray


def camera(K: np.ndarray, lens: Distortion) -> Camera:
    """The rays of a camera: its distortion inverted by fixed-point iteration."""
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    bent = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], axis=-1)
    distort = {"radtan": radtan, "equidistant": equidistant}.get(lens.model, lambda xy, _: xy)
    xy = bent.copy()
    for _ in range(60):
        xy += bent - distort(xy, lens.coefficients)
    assert np.abs(distort(xy, lens.coefficients) - bent).max() < 1e-9
    return Camera(np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=-1))


def textures(rng: np.random.Generator) -> list[np.ndarray]:
    """Random patterns of several scales, each half as fine as the one before, so that what is far does not flicker."""
    size = 1024
    whole = sum(
        weight * zoom(rng.standard_normal((size // step,) * 2), step, order=1, mode="grid-wrap", grid_mode=True)
        for step, weight in ((2, 0.6), (8, 1.0), (32, 1.0))
    )
    levels = [128.0 + 38.0 * whole / whole.std()]
    while len(levels) < 6:
        fine = levels[-1]
        levels.append(0.25 * (fine[::2, ::2] + fine[1::2, ::2] + fine[::2, 1::2] + fine[1::2, 1::2]))
    return levels


def first_hits(origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depths (n,) along rays (n, 3) in world of what they hit first, and its face (n,): a plane, or 10 and 11."""
    depth, face = np.full(len(rays), np.inf), np.zeros(len(rays), dtype=int)
    planes = [(np.array(n), d) for n, d in _PLANES]
    with np.errstate(divide="ignore", invalid="ignore"):
        for i, (n, d) in enumerate(planes):
            t = (d - n @ origin) / (rays @ n)
            nearer = (t > 0.05) & (t < depth)
            depth[nearer], face[nearer] = t[nearer], i
        for axis in (0, 1):
            for side in _PILLAR[axis]:
                t = (side - origin[axis]) / rays[:, axis]
                across = origin[1 - axis] + t * rays[:, 1 - axis]
                nearer = (t > 0.05) & (t < depth) & (across > _PILLAR[1 - axis][0]) & (across < _PILLAR[1 - axis][1])
                depth[nearer], face[nearer] = t[nearer], 10 + axis
    return depth, face


def render(seen: Camera, T_world_cam: np.ndarray, patterns: list[np.ndarray], focal_px: float) -> np.ndarray:
    """What a camera sees (height, width), grey levels without noise."""
    rays = seen.rays.reshape(-1, 3) @ T_world_cam[:3, :3].T
    origin = T_world_cam[:3, 3]
    depth, face = first_hits(origin, rays)
    point = origin + depth[:, None] * rays
    normal_axis = np.where(face == 10, 0, np.where(face == 11, 1, 0))
    for i, (n, _) in enumerate(_PLANES):
        normal_axis[face == i] = int(np.argmax(n))
    s = np.where(normal_axis == 0, point[:, 1], point[:, 0]) + 7.3 * face
    t = np.where(normal_axis == 2, point[:, 1], point[:, 2]) + 3.1 * face
    level = np.clip(np.round(np.log2(np.maximum(depth / focal_px / _TEXEL_M, 1.0))), 0, len(patterns) - 1).astype(int)
    grey = np.empty(len(rays))
    for i, pattern in enumerate(patterns):
        at = level == i
        where = np.stack([t[at], s[at]]) / _TEXEL_M / 2**i - 0.5 + 0.5 / 2**i
        grey[at] = map_coordinates(pattern, where, order=1, mode="grid-wrap")
    return grey.reshape(SIZE[1], SIZE[0])


def drive(frames: int) -> np.ndarray:
    """Velocities (T, 6) of a ride that turns left and right over uneven ground."""
    time_s = PERIOD_S * np.arange(frames)
    twist = np.zeros((frames, 6))
    twist[:, 0] = 5.0 + 0.6 * np.sin(1.1 * time_s)
    twist[:, 1:3] = np.stack([0.05 * np.sin(2.0 * time_s), 0.08 * np.cos(1.7 * time_s)], axis=1)
    twist[:, 3] = 0.05 * np.sin(2.3 * time_s)
    twist[:, 4] = 0.06 * np.cos(1.9 * time_s)
    twist[:, 5] = 0.32 * np.cos(0.9 * time_s)
    return twist


PINHOLE = np.array([[300.0, 0.0, 199.5], [0.0, 300.0, 99.5], [0.0, 0.0, 1.0]])


def calibrated(distorted: bool) -> PairCalibration:
    """A pair as it is said to be: rectified pinholes, or two unequal lenses that squint."""
    T_right_left = se3.transform(np.eye(3), np.array([-BASELINE_M, 0.0, 0.0]))
    if not distorted:
        return PairCalibration(PINHOLE, PINHOLE, SIZE, T_right_left)
    K_right = np.array([[304.0, 0.0, 196.0], [0.0, 303.0, 102.0], [0.0, 0.0, 1.0]])
    squint = se3.transform(se3.so3_exp(np.array([0.010, -0.015, 0.008])), np.array([-BASELINE_M, 0.004, -0.006]))
    lenses = Distortion("radtan", (-0.20, 0.05, 0.0008, -0.0005)), Distortion("equidistant", (0.02, -0.01, 0.004, 0.0))
    return PairCalibration(PINHOLE, K_right, SIZE, squint, *lenses)


def recording(frames: int, distorted: bool, rotation_rad: np.ndarray, seed: int = 0) -> ImageRecording:
    """A recording of the room without velocities, with truth.

    Args:
        frames: How many.
        distorted: Whether the lenses are.
        rotation_rad: (3,) rotation of the right camera against its calibration, in its own frame.
        seed: Of texture and noise.
    """
    rng = np.random.default_rng(seed)
    patterns, calibration = textures(rng), calibrated(distorted)
    left = camera(calibration.K_left, calibration.distortion_left)
    right = camera(calibration.K_right, calibration.distortion_right)
    T_right_left = se3.transform(se3.so3_exp(rotation_rad), np.zeros(3)) @ calibration.T_right_left
    time_s = PERIOD_S * np.arange(frames)
    T_world_body = se3.inverse(motion.integrate(np.eye(4), drive(frames), np.diff(time_s)))
    images = []
    for T in T_world_body:
        T_world_left = T @ se3.inverse(T_CAM_BODY)
        pair = (
            render(seen, T_world_cam, patterns, 300.0) + _NOISE * rng.standard_normal(SIZE[::-1])
            for seen, T_world_cam in ((left, T_world_left), (right, T_world_left @ se3.inverse(T_right_left)))
        )
        images.append(tuple(np.clip(np.round(image), 0, 255).astype(np.uint8) for image in pair))
    return ImageRecording(
        name="room",
        source="tests",
        time_s=time_s,
        calibration=calibration,
        load=images.__getitem__,
        T_cam_imu=T_CAM_BODY,
        truth=Truth(np.arange(frames), T_world_body),
    )


def write_kitti(recorded: ImageRecording, frames: int, place: Path) -> Path:
    """The first frames in a folder as the odometry benchmark has them, with the calibration of ideal lenses."""
    for side, name in enumerate(("image_0", "image_1")):
        (place / name).mkdir(parents=True)
        for k in range(frames):
            Image.fromarray(recorded.load(k)[side]).save(place / name / f"{k:06d}.png")
    P = "300 0 199.5 {} 0 300 99.5 0 0 0 1 0"
    (place / "calib.txt").write_text(f"P0: {P.format(0)}\nP1: {P.format(-300 * BASELINE_M)}\n")
    (place / "times.txt").write_text("".join(f"{PERIOD_S * k:.1f}\n" for k in range(frames)))
    return place
