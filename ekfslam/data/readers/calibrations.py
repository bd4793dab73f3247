"""Calibrations of a pair in the files of other programs, for images that bring none.

- Kalibr and OpenVINS: a chain with ``cam0 cam1``, or the configuration that names it (``relative_config_imucam``).
- EuRoC: ``cam0/sensor.yaml`` and ``cam1/sensor.yaml`` (either file, or the folder above).
- ROS: ``left.yaml`` and ``right.yaml`` of camera_calibration, as in CameraInfo (either file, or their folder).
- OpenCV: ``K1 D1 K2 D2 R T`` (or ``M1 ...``) of stereo_calib.
- ORB-SLAM: ``LEFT.K D R P`` and ``RIGHT``; ``Camera1 Camera2 Stereo.T_c1_c2``; ``Camera.fx ... Camera.bf``.
- ``calibration.toml``, see `image_folders`.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.checks import require_finite, require_rigid, require_shape, spelled_as_in
from ekfslam.data.images import Distortion, DistortionModel, LensCalibration, PairCalibration, side_by_side
from ekfslam.data.readers.imu_yaml import between_cameras, chain_of, find_chain, late_s, pose_of, topics_of
from ekfslam.data.readers.pictures import other_side, side_of
from ekfslam.data.readers.text import read_lines
from ekfslam.data.readers.yaml import Calibration, read_yaml
from ekfslam.errors import CalibrationError, DataError, ExtrinsicsError, UnknownFormatError
from ekfslam.geometry import se3
from ekfslam.limits import toml_values

Size = tuple[int, int]
_MODELS: dict[str, DistortionModel] = {
    "none": "none",
    "radial-tangential": "radtan",
    "radtan": "radtan",
    "plumb_bob": "radtan",
    "rational_polynomial": "radtan",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "KannalaBrandt8": "equidistant",
}
_KEYS = {"left", "right", "times", "rate_hz", "T_right_left", "baseline_m", "T_cam_imu"}
_KEYS |= {"velocities", "bit_depth", "calibration"}
_TABLES = {"left_camera", "right_camera"}
_CAMERA_KEYS = {"intrinsics", "distortion_model", "distortion"}
EXPECTED = (
    "expected a chain of Kalibr or OpenVINS, left.yaml and right.yaml of ROS, a stereo calibration of OpenCV, "
    "settings of ORB-SLAM, or calibration.toml"
)


@dataclass(frozen=True)
class CameraFile:
    """Calibration of one camera."""

    K: Array  # (3, 3) intrinsic matrix
    lens: Distortion
    size: Size | None = None  # width and height of images, if the file states them


@dataclass(frozen=True)
class PairFile:
    """Calibration of a pair as files have it."""

    left: CameraFile
    right: CameraFile | None  # None: of one camera
    T_right_left: Array  # (4, 4) left to right optical frame
    files: tuple[Path, ...]  # files that were read
    T_cam_imu: Array | None = None  # (4, 4) IMU to left optical frame; None if it is not stated
    notes: tuple[str, ...] = ()  # facts about the reading
    topics: tuple[str, ...] = ()  # topics of left and right images that the files name
    late_s: float = 0.0  # stamp of an inertial sample less that of an image of the same instant

    @property
    def of_right(self) -> PairFile:
        """The right camera alone; the only one of a file of one camera."""
        if self.right is None:
            return self
        T = None if self.T_cam_imu is None else self.T_right_left @ self.T_cam_imu
        return replace(self, left=self.right, right=None, T_cam_imu=T, topics=self.topics[1:])

    def pair(self, size: Size | None = None) -> PairCalibration | LensCalibration:
        """Return the calibration for images of a size, by default the stated one; raise `CalibrationError` if none."""
        source = str(self.files[0])
        for camera in (self.left, self.right or self.left):
            size = size or camera.size
            if camera.size is not None and camera.size != size:
                found = f"the images have {size} pixels" if size else ""
                raise CalibrationError(f"{camera.size} pixels, but {found}", source=source, field="size")
        if size is None:
            raise CalibrationError("the size of the images is not stated", source=source, field="size")
        with spelled_as_in(source):
            if self.right is None:
                return LensCalibration(self.left.K, size, self.left.lens)
            return PairCalibration(self.left.K, self.right.K, size, self.T_right_left, self.left.lens, self.right.lens)


def camera_of(fu: float, fv: float, cu: float, cv: float, lens: Distortion, size: Size | None = None) -> CameraFile:
    """Return a camera of focal lengths and principal point, px."""
    return CameraFile(np.array([[fu, 0.0, cu], [0.0, fv, cv], [0.0, 0.0, 1.0]]), lens, size)


def lens_of(name: str, coefficients: Array, key: str) -> Distortion:
    """Return a distortion by its name in any of the formats; no coefficient but 0 is no distortion."""
    if not np.any(coefficients):
        return Distortion()
    if name not in _MODELS:
        raise CalibrationError(f"expected {', '.join(_MODELS)}, found {name!r}", field=key)
    values = coefficients.tolist()
    if _MODELS[name] == "radtan" and len(values) > 8 and not any(values[8:]):
        values = values[:8]  # thin prisms and tilts that are 0
    return Distortion(_MODELS[name], tuple(values)) if _MODELS[name] != "none" else Distortion()


def read_pair(path: str | Path, images: tuple[str, ...] = ("left", "right")) -> PairFile:
    """Read the calibration of a pair from a file, or from the files of a folder; a `DataError` names a wrong key.

    ``images`` are the names of its topics or folders of images, for which chains of Kalibr are searched. A single name
    stands for one camera, the right one if the name says so.
    """
    path, is_one = Path(path), len(images) == 1
    if path.is_dir():
        path = _in_folder(path)
    with spelled_as_in(str(path)):
        if path.suffix == ".toml":
            return _toml(path)
        read = read_yaml(path)
        for key, reader in _FORMATS.items():
            if any(name == key or name.startswith(f"{key}.") for name in read.values):
                found: PairFile = reader(read, images) if reader is _chain else reader(read)
                break
        else:
            raise UnknownFormatError(f"{path}: no calibration of a pair that is known; {EXPECTED}")
    if is_one:
        is_right = found.topics != images and side_of(images[0]) == 1
        return found.of_right if is_right else replace(found, right=None, topics=found.topics[:1])
    if found.right is None:
        sides = "left.yaml and right.yaml, or cam0 and cam1"
        raise UnknownFormatError(f"{path}: it has one camera, and no file beside it is that of the other side: {sides}")
    return found


def read_toml(file: Path) -> dict[str, Any]:
    """Return the values of a ``calibration.toml``; unknown keys are refused."""
    text = "\n".join(read_lines(file, "expected calibration.toml"))
    try:
        values = toml_values(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise UnknownFormatError(f"{file}: not a TOML file ({error})") from None
    tables = [("", values, _KEYS | _TABLES)]
    tables += [(f"{name}.", values[name], _CAMERA_KEYS) for name in _TABLES if isinstance(values.get(name), dict)]
    for prefix, table, known in tables:
        for key in table.keys() - known:
            message = f"unknown key; known: {', '.join(sorted(known))}"
            raise CalibrationError(message, source=str(file), field=prefix + key)
    return values


def _toml(file: Path) -> PairFile:
    """Read tables and transforms of ``calibration.toml``, see `image_folders`."""
    values = read_toml(file)
    left = _toml_camera(values, "left_camera")
    right = _toml_camera(values, "right_camera") if "right_camera" in values else left
    T_cam_imu = _numbers(values["T_cam_imu"], (4, 4), "T_cam_imu") if "T_cam_imu" in values else None
    if "left" in values and not values.keys() & {"right", "right_camera", "T_right_left", "baseline_m"}:
        return PairFile(left, None, np.eye(4), (file,), T_cam_imu)
    if ("T_right_left" in values) == ("baseline_m" in values):
        raise CalibrationError("expected either T_right_left or baseline_m", field="T_right_left")
    if "baseline_m" in values:
        baseline = values["baseline_m"]
        if not (isinstance(baseline, int | float) and 0 < baseline < 1e6):
            raise CalibrationError(f"expected a positive length, found {baseline!r}", field="baseline_m")
        T_right_left = side_by_side(baseline)
    else:
        T_right_left = _numbers(values["T_right_left"], (4, 4), "T_right_left")
    return PairFile(left, right, T_right_left, (file,), T_cam_imu)


def _toml_camera(values: dict[str, Any], name: str) -> CameraFile:
    table = values.get(name)
    if not isinstance(table, dict):
        raise CalibrationError("this table is missing", field=name)
    fu, fv, cu, cv = _numbers(table.get("intrinsics"), (4,), f"{name}.intrinsics")
    model = table.get("distortion_model", "none")
    coefficients = _numbers(table.get("distortion", []), (None,), f"{name}.distortion")
    with spelled_as_in("", {"distortion": f"{name}.distortion"}):
        lens = Distortion(model, tuple(coefficients.tolist()))
    return camera_of(fu, fv, cu, cv, lens)


def _numbers(value: Any, shape: tuple[int | None, ...], name: str) -> Array:
    """Return an array of finite numbers of a shape; None stands for any length."""
    try:
        entries = np.asarray(value, dtype=object)
        if not {type(entry) for entry in entries.flat} <= {int, float}:  # no truth values, texts or ragged lists
            raise TypeError
        found = entries.astype(float)
        require_shape(found, shape, name)
        require_finite(found, name)
    except (TypeError, ValueError, OverflowError, DataError):
        wanted = " x ".join("n" if n is None else str(n) for n in shape)
        raise CalibrationError(f"expected {wanted} numbers", field=name) from None
    return found


def _in_folder(folder: Path) -> Path:
    chain = find_chain(folder)
    if chain is None:
        places = (folder / above / "cam0/sensor.yaml" for above in ("", "mav0"))
        chain = next((file for file in places if file.is_file()), None)
    lefts = [file for file in sorted((*folder.glob("*.yaml"), *folder.glob("*.yml"))) if side_of(file.stem) == 0]
    if chain is None and not lefts:
        raise UnknownFormatError(f"{folder}: no calibration of a pair; {EXPECTED}")
    return chain or lefts[0]


def _chain(read: Calibration, images: tuple[str, ...]) -> PairFile:
    """Read the cameras of a chain of Kalibr that have the topics ``images``, otherwise ``cam0`` and ``cam1``."""
    known = topics_of(read)
    named = [name for image in images for name, topic in known.items() if topic == image]
    chosen = named if len(named) == len(images) else list(known)[:2]
    cameras = [_kalibr_camera(read, f"{name}.", "distortion_coeffs") for name in chosen]
    (T_left, notes), (T_right, further) = (chain_of(read, name) for name in (chosen[0], chosen[-1]))
    T_between = between_cameras(read, chosen[0], chosen[-1])
    if T_left is not None and T_right is not None:
        T_between = T_right @ se3.inverse(T_left)
    if T_between is None:
        raise CalibrationError("neither T_cn_cnm1 nor T_cam_imu of both cameras is stated", field=chosen[-1])
    topics = tuple(filter(None, (known[name] for name in chosen)))
    return PairFile(
        cameras[0],
        cameras[1] if len(chosen) == 2 else None,
        T_between,
        (read.path,),
        T_left,
        tuple(dict.fromkeys((*notes, *further))),
        topics if len(topics) == len(chosen) else (),
        late_s(read, chosen[0]),
    )


def _kalibr_camera(read: Calibration, prefix: str, coefficients: str) -> CameraFile:
    with spelled_as_in(str(read.path), {"distortion": f"{prefix}{coefficients}"}):
        if (kind := read.word(f"{prefix}camera_model")) != "pinhole":
            raise CalibrationError(f"expected pinhole, found {kind!r}", field=f"{prefix}camera_model")
        fu, fv, cu, cv = read.numbers(f"{prefix}intrinsics", 4).tolist()
        size = _size(read, f"{prefix}resolution")
        name, key = read.word(f"{prefix}distortion_model"), f"{prefix}distortion_model"
        if name not in _MODELS:
            raise CalibrationError(f"expected {', '.join(_MODELS)}, found {name!r}", field=key)
        values = () if _MODELS[name] == "none" else tuple(read.numbers(f"{prefix}{coefficients}").tolist())
        return camera_of(fu, fv, cu, cv, Distortion(_MODELS[name], values), size)


def _size(read: Calibration, *keys: str) -> Size:
    """Return width and height from one key of two numbers, or two keys of one."""
    width, height = read.numbers(keys[0], 2) if len(keys) == 1 else (read.numbers(key, 1)[0] for key in keys)
    if not (float(width).is_integer() and float(height).is_integer()):
        message = f"expected whole numbers of pixels, found {width:g} and {height:g}"
        raise CalibrationError(message, field=keys[0])
    return int(width), int(height)


def _euroc(read: Calibration) -> PairFile:
    """Read ``sensor.yaml`` of a camera of EuRoC and that of the other side: ``cam0/sensor.yaml cam1/sensor.yaml``."""
    path = read.path
    folder = other_side(path.parent.resolve())
    other = other_side(path) or (folder / path.name if folder is not None else None)
    if other is None or not other.is_file():
        return read_euroc_pair(path)
    is_right = side_of(path.stem) == 1 or side_of(path.resolve().parent.name) == 1
    return read_euroc_pair(other, path) if is_right else read_euroc_pair(path, other)


def read_euroc_pair(*paths: Path) -> PairFile:
    """Read ``sensor.yaml`` of the left and of the right camera of EuRoC, or of one camera, with ``T_BS``."""
    reads = [read_yaml(path) for path in paths]
    if len(reads) == 1:
        camera = _kalibr_camera(reads[0], "", "distortion_coefficients")
        return PairFile(camera, None, np.eye(4), paths, se3.inverse(pose_of(reads[0], "T_BS")))
    left, right = (_kalibr_camera(read, "", "distortion_coefficients") for read in reads)
    T_left, T_right = (se3.inverse(pose_of(read, "T_BS")) for read in reads)
    if left.size != right.size:
        message = f"{right.size} differs from {left.size} of the left camera"
        raise CalibrationError(message, source=str(paths[1]), field="resolution")
    return PairFile(left, right, T_right @ se3.inverse(T_left), paths, T_left)


def _openvins(read: Calibration) -> PairFile:
    """Follow the configuration of an estimator to its chain."""
    found = read_pair(read.path.parent / read.word("relative_config_imucam"))
    return replace(found, files=(*found.files, read.path))


def _ros(read: Calibration) -> PairFile:
    """Read the file of one side and that of the other, whose names differ in the side alone."""
    side, other = side_of(read.path.stem), other_side(read.path)
    folder = other_side(read.path.parent.resolve()) if side is None else None
    if folder is not None and (folder / read.path.name).is_file():
        side, other = side_of(read.path.parent.resolve().name), folder / read.path.name
    if side is None or other is None:
        return PairFile(_ros_camera(read), None, np.eye(4), (read.path,))
    reads = (read, read_yaml(other)) if side == 0 else (read_yaml(other), read)
    cameras, turned, shifts = [_ros_camera(each) for each in reads], [], []
    for each in reads:
        with spelled_as_in(str(each.path)):
            turned.append(_rotation(each, "rectification_matrix"))
            shifts.append(shift_of(each.matrix("projection_matrix", 3, 4), "projection_matrix"))
    if not (shifts[0] == 0 < shifts[1]):
        found = f"expected a baseline on the right and none on the left, found {shifts[1]:g} and {shifts[0]:g} m"
        raise CalibrationError(found, source=str(reads[1].path), field="projection_matrix")
    T = rectified_apart(turned[0], turned[1], shifts[1])
    return PairFile(cameras[0], cameras[1], T, (reads[0].path, reads[1].path))


def _ros_camera(read: Calibration) -> CameraFile:
    with spelled_as_in(str(read.path)):
        model = read.word("distortion_model") if "distortion_model" in read else "plumb_bob"
        lens = lens_of(model, read.numbers("distortion_coefficients"), "distortion_model")
        return CameraFile(read.matrix("camera_matrix", 3, 3), lens, _size(read, "image_width", "image_height"))


def shift_of(P: Array, key: str) -> float:
    """Return the baseline (m) that a projection matrix (3, 4) states."""
    if not P[0, 0] > 0:
        raise CalibrationError("P has no positive focal length", field=key)
    return float(-P[0, 3] / P[0, 0]) if P[0, 3] else 0.0


def rectified_apart(R_left: Array, R_right: Array, baseline_m: float) -> Array:
    """Return ``T_right_left`` (4, 4) of cameras whose rectified images are side by side after rotations (3, 3)."""
    turn_left, turn_right = (se3.transform(R, np.zeros(3)) for R in (R_left, R_right))
    return se3.inverse(turn_right) @ side_by_side(baseline_m) @ turn_left


def _rotation(read: Calibration, key: str) -> Array:
    T = se3.transform(read.matrix(key, 3, 3), np.zeros(3))
    require_rigid(T, key, ExtrinsicsError)
    return se3.nearest_rigid(T)[:3, :3]


def _opencv(read: Calibration) -> PairFile:
    """Read ``K1 D1 K2 D2`` (or ``M1 ...``) with ``R T``, or those in ``extrinsics.yml`` beside."""
    letter = "K" if any(key.startswith("K1") for key in read.values) else "M"
    beside = read.path.with_name(read.path.name.replace("intrinsics", "extrinsics"))
    further = read_yaml(beside) if "R.data" not in read and "R" not in read and beside != read.path else read
    cameras = [
        CameraFile(read.matrix(f"{letter}{i}", 3, 3), lens_of("plumb_bob", read.numbers(f"D{i}"), f"D{i}"))
        for i in (1, 2)
    ]
    with spelled_as_in(str(further.path)):
        T = se3.transform(_rotation(further, "R"), further.numbers("T", 3))
    return PairFile(cameras[0], cameras[1], T, tuple(dict.fromkeys((read.path, further.path))))


def _orb_rectifying(read: Calibration) -> PairFile:
    """Read the settings of ORB-SLAM2 with images as the lens sees them: ``LEFT.K D R P``."""
    cameras, turned = [], []
    for side in ("LEFT", "RIGHT"):
        size = _size(read, f"{side}.width", f"{side}.height") if f"{side}.width" in read else _orb_size(read)
        lens = lens_of("plumb_bob", read.numbers(f"{side}.D"), f"{side}.D")
        cameras.append(CameraFile(read.matrix(f"{side}.K", 3, 3), lens, size))
        turned.append(_rotation(read, f"{side}.R"))
    T = rectified_apart(turned[0], turned[1], shift_of(read.matrix("RIGHT.P", 3, 4), "RIGHT.P"))
    return PairFile(cameras[0], cameras[1], T, (read.path,), _orb_body(read))


def _orb_size(read: Calibration) -> Size | None:
    return _size(read, "Camera.width", "Camera.height") if "Camera.width" in read else None


def _orb_camera(read: Calibration, prefix: str) -> CameraFile:
    fu, fv, cu, cv = (float(read.numbers(f"{prefix}.{name}", 1)[0]) for name in ("fx", "fy", "cx", "cy"))
    kind = read.word("Camera.type") if "Camera.type" in read else "PinHole"
    names = ("k1", "k2", "k3", "k4") if kind == "KannalaBrandt8" else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    stated = [name for name in names if f"{prefix}.{name}" in read]
    values = np.zeros(next((n for n in (4, 5, 8) if all(name in names[:n] for name in stated)), 8))
    for name in stated if kind != "Rectified" else ():
        values[names.index(name)] = read.numbers(f"{prefix}.{name}", 1)[0]
    lens = lens_of("KannalaBrandt8" if kind == "KannalaBrandt8" else "plumb_bob", values, f"{prefix}.k1")
    return camera_of(fu, fv, cu, cv, lens, _orb_size(read))


def _orb_two(read: Calibration) -> PairFile:
    """Read the settings of ORB-SLAM3: two cameras and ``Stereo.T_c1_c2``, or ``Rectified`` and a baseline."""
    left = _orb_camera(read, "Camera1")
    if not any(key.startswith(("Stereo.", "Camera.bf")) for key in read.values):
        return PairFile(left, None, np.eye(4), (read.path,), _orb_body(read))
    if not any(key.startswith("Stereo.T_c1_c2") for key in read.values):
        baseline = float(read.numbers("Stereo.b", 1)[0]) if "Stereo.b" in read else _orb_bf(read, left)
        return PairFile(left, left, side_by_side(baseline), (read.path,), _orb_body(read))
    right = _orb_camera(read, "Camera2") if "Camera2.fx" in read else left
    T_left_right = pose_of(read, "Stereo.T_c1_c2")
    return PairFile(left, right, se3.inverse(T_left_right), (read.path,), _orb_body(read))


def _orb_bf(read: Calibration, left: CameraFile) -> float:
    return float(read.numbers("Camera.bf", 1)[0]) / float(left.K[0, 0])


def _orb_one(read: Calibration) -> PairFile:
    """Read the settings of ORB-SLAM2 for rectified images, with ``Camera.bf``, or for two fisheyes with ``Tlr``."""
    left = _orb_camera(read, "Camera")
    if any(key.startswith("Tlr") for key in read.values):
        T_left_right = np.vstack([read.matrix("Tlr", 3, 4), [0.0, 0.0, 0.0, 1.0]])
        require_rigid(T_left_right, "Tlr", ExtrinsicsError)
        T = se3.inverse(se3.nearest_rigid(T_left_right))
        return PairFile(left, _orb_camera(read, "Camera2"), T, (read.path,), _orb_body(read))
    right = left if "Camera.bf" in read else None
    T = np.eye(4) if right is None else side_by_side(_orb_bf(read, left))
    return PairFile(left, right, T, (read.path,), _orb_body(read))


def _orb_body(read: Calibration) -> Array | None:
    """Return ``T_cam_imu`` of ``IMU.T_b_c1`` or ``Tbc``, poses of the left camera in the body."""
    key = next((name for name in ("IMU.T_b_c1", "Tbc") if any(k.startswith(name) for k in read.values)), None)
    return None if key is None else se3.inverse(pose_of(read, key))


# Formats by a key that tells them, the first that fits.
_FORMATS: dict[str, Any] = {
    "relative_config_imucam": _openvins,
    "cam0": _chain,
    "T_BS": _euroc,
    "camera_matrix": _ros,
    "LEFT.K": _orb_rectifying,
    "Camera1.fx": _orb_two,
    "Camera.fx": _orb_one,
    "K1": _opencv,
    "M1": _opencv,
}
