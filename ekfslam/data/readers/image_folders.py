"""A plain pair of image folders with its own calibration: a folder with ``calibration.toml``, or that file.

::

    left = "left"                       # folders of images next to this file; equal names belong together, in natural
    right = "right"                     # order. Both may be one folder with left_0001 and right_0001. Optional if
                                        # the folders have usual names: left right, image_l image_r, cam0 cam1, ...
    times = "times.txt"                 # a stamp a line, s; or rate_hz = 10.0
    T_right_left = [[1, 0, 0, -0.54], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
                                        # left optical frame to right optical frame; or baseline_m = 0.54
    T_cam_imu = [...]                   # optional: IMU to left optical frame
    bit_depth = 12                      # optional: used bits of 16-bit images; default: by the largest value
    velocities = "velocities.csv"       # optional, see `ekfslam.data.velocities`

    [left_camera]
    intrinsics = [707.0, 707.0, 602.0, 183.0]       # fu, fv, cu, cv in px
    distortion_model = "radtan"                     # optional: none, radtan, equidistant
    distortion = [-0.28, 0.07, 0.0, 0.0]

    [right_camera]                      # optional: as the left one
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.checks import require_finite, require_shape, spelled_as_in
from ekfslam.data.images import Distortion, ImageRecording, PairCalibration, side_by_side
from ekfslam.data.readers.fields import BODY_IS_CAMERA, checksum
from ekfslam.data.readers.pictures import find_pair, images_of_sides, pair_files
from ekfslam.data.readers.registry import Reader, Source
from ekfslam.data.readers.text import first_row, parse_table, read_lines
from ekfslam.data.velocities import attach_velocities
from ekfslam.errors import CalibrationError, DataError, LostDataError, UnknownFormatError
from ekfslam.geometry.camera import T_CAM_BODY

FILE = "calibration.toml"
_KEYS = {"left", "right", "times", "rate_hz", "T_right_left", "baseline_m", "T_cam_imu", "velocities", "bit_depth"}
_TABLES = {"left_camera", "right_camera"}
_CAMERA_KEYS = {"intrinsics", "distortion_model", "distortion"}


def open_folder(path: Path) -> ImageRecording:
    """Open the images that a calibration describes, see this module.

    Without ``T_cam_imu`` the body is the left camera.
    """
    file = _file_of(path)
    folder, values = file.parent, _parsed(file)
    left, right = images_of_sides(*(folder / name for name in _folders(values, folder, file)))
    alone = [
        image.stem for side, other in ((left, right), (right, left)) for key, image in side.items() if key not in other
    ]
    if alone:
        raise LostDataError(f"{len(alone)} images have no partner, the first is {alone[0]}", source=str(folder))
    load, notes = pair_files(list(left.values()), [right[key] for key in left], bits=_bits(values, file))
    notes += () if "velocities" in values else ("There are no velocities.",)
    notes += () if "T_cam_imu" in values else (f"There is no T_cam_imu. {BODY_IS_CAMERA}",)
    with spelled_as_in(str(file)):
        recording = ImageRecording(
            name=folder.resolve().name,
            source=str(path),
            time_s=_stamps(values, folder, file, len(left)),
            calibration=_pair(values, load.size),
            load=load,
            T_cam_imu=_numbers(values["T_cam_imu"], (4, 4), "T_cam_imu") if "T_cam_imu" in values else T_CAM_BODY,
            notes=notes,
            attributes={"reader": READER.name, "checksum_sha256": checksum(file)},
        )
    if "velocities" not in values:
        return recording
    return attach_velocities(recording, folder / _text(values, "velocities", file))


def _file_of(path: Path) -> Path:
    return path / FILE if path.is_dir() else path


def _parsed(file: Path) -> dict[str, Any]:
    text = "\n".join(read_lines(file, f"expected {FILE}"))
    try:
        values = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise UnknownFormatError(f"{file}: not a TOML file ({error})") from None
    tables = [("", values, _KEYS | _TABLES)]
    tables += [(f"{name}.", values[name], _CAMERA_KEYS) for name in _TABLES if isinstance(values.get(name), dict)]
    for prefix, table, known in tables:
        for key in table.keys() - known:
            message = f"unknown key; known: {', '.join(sorted(known))}"
            raise CalibrationError(message, source=str(file), field=prefix + key)
    return values


def _folders(values: dict[str, Any], folder: Path, file: Path) -> tuple[str, str]:
    """Return the names of the folders of images; by default those with usual names."""
    if "left" in values or "right" in values:
        return _text(values, "left", file), _text(values, "right", file)
    if (found := find_pair(folder)) is None:
        message = "expected the names of the folders of images; there are none with usual names, such as left and right"
        raise CalibrationError(message, source=str(file), field="left")
    return found


def _bits(values: dict[str, Any], file: Path) -> int | None:
    bits = values.get("bit_depth")
    if bits is not None and not (isinstance(bits, int) and 8 <= bits <= 16):
        raise CalibrationError(f"expected 8 to 16, found {bits!r}", source=str(file), field="bit_depth")
    return bits


def _text(values: dict[str, Any], key: str, file: Path) -> str:
    if not isinstance(values.get(key), str):
        raise CalibrationError("expected the name of a file or folder", source=str(file), field=key)
    return values[key]


def _stamps(values: dict[str, Any], folder: Path, file: Path, count: int) -> Array:
    """Return the stamps (count,) of the images."""
    if ("times" in values) == ("rate_hz" in values):
        raise CalibrationError("expected either times or rate_hz", field="times")
    if "rate_hz" in values:
        rate = values["rate_hz"]
        if not (isinstance(rate, int | float) and 1e-6 < rate < 1e6):
            raise CalibrationError(f"expected a positive rate, found {rate!r}", field="rate_hz")
        return np.arange(count) / rate
    path = folder / _text(values, "times", file)
    times = parse_table(read_lines(path, "expected a stamp a line"), path, columns=1).values[:, 0]
    if len(times) != count:
        raise LostDataError(f"{len(times)} stamps for {count} images", source=str(path))
    return times


def _pair(values: dict[str, Any], size: tuple[int, int]) -> PairCalibration:
    K_left, lens_left = _camera(values, "left_camera")
    K_right, lens_right = _camera(values, "right_camera") if "right_camera" in values else (K_left, lens_left)
    if ("T_right_left" in values) == ("baseline_m" in values):
        raise CalibrationError("expected either T_right_left or baseline_m", field="T_right_left")
    if "baseline_m" in values:
        baseline = values["baseline_m"]
        if not (isinstance(baseline, int | float) and 0 < baseline < 1e6):
            raise CalibrationError(f"expected a positive length, found {baseline!r}", field="baseline_m")
        T_right_left = side_by_side(baseline)
    else:
        T_right_left = _numbers(values["T_right_left"], (4, 4), "T_right_left")
    return PairCalibration(K_left, K_right, size, T_right_left, lens_left, lens_right)


def _camera(values: dict[str, Any], name: str) -> tuple[Array, Distortion]:
    table = values.get(name)
    if not isinstance(table, dict):
        raise CalibrationError("this table is missing", field=name)
    fu, fv, cu, cv = _numbers(table.get("intrinsics"), (4,), f"{name}.intrinsics")
    model = table.get("distortion_model", "none")
    coefficients = _numbers(table.get("distortion", []), (None,), f"{name}.distortion")
    with spelled_as_in("", {"distortion": f"{name}.distortion"}):
        lens = Distortion(model, tuple(coefficients.tolist()))
    return np.array([[fu, 0.0, cu], [0.0, fv, cv], [0.0, 0.0, 1.0]]), lens


def _numbers(value: Any, shape: tuple[int | None, ...], name: str) -> Array:
    """Return an array of finite numbers of a shape; None stands for any length."""
    try:
        found = np.asarray(value, dtype=float)
        require_shape(found, shape, name)
        require_finite(found, name)
    except (TypeError, ValueError, OverflowError, DataError):
        wanted = " x ".join("n" if n is None else str(n) for n in shape)
        raise CalibrationError(f"expected {wanted} numbers", field=name) from None
    return found


def _recognises(source: Source) -> bool:
    file = _file_of(source.path)
    if source.path.is_dir():
        return file.is_file()
    return file.suffix == ".toml" and bool(first_row(file)) and b"\x00" not in source.head


READER = Reader(
    "image_folders",
    f"a folder with {FILE} of a pair of image folders",
    _recognises,
    images=lambda source: open_folder(source.path),
)
