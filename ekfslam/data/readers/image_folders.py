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

Without ``right``, ``T_right_left`` and ``baseline_m`` it is one camera, whose images are in ``left``. In place of the
tables and the transforms, ``calibration = "camchain.yaml"`` names a file of another program, see
`calibrations`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.checks import spelled_as_in
from ekfslam.data.images import ImageRecording
from ekfslam.data.readers.calibrations import read_pair, read_toml
from ekfslam.data.readers.fields import BODY_IS_CAMERA, checksum
from ekfslam.data.readers.pictures import find_pair, images_in, images_of_sides, pair_files
from ekfslam.data.readers.registry import CALIBRATION, Reader, Source
from ekfslam.data.readers.text import first_row, parse_table, read_lines
from ekfslam.data.velocities import attach_velocities
from ekfslam.errors import CalibrationError, LostDataError
from ekfslam.geometry.camera import T_CAM_BODY

FILE = "calibration.toml"
_BARE: dict[str, Any] = {"times": "times.txt"}  # of a folder without its own file


def open_folder(path: Path, calibration: str | None = None) -> ImageRecording:
    """Open the images that ``calibration`` or the folder's own describes; the body may be the left camera."""
    file = _file_of(path)
    folder, values = file.parent, (_BARE if calibration and not file.is_file() else read_toml(file))
    if calibration is None and "calibration" in values:
        calibration = str(folder / _text(values, "calibration", file))
    described = read_pair(calibration or file)
    left, right = _files(values, folder, file, described.right is None)
    load, notes = pair_files(left, right, bits=_bits(values, file))
    notes += () if "velocities" in values else ("There are no velocities.",)
    notes += () if described.T_cam_imu is not None else (f"There is no T_cam_imu. {BODY_IS_CAMERA}",)
    attributes = {"checksum_sha256": checksum(file)} if file.is_file() else {}
    if calibration is not None:
        notes += (f"The calibration is that of {described.files[0].name}.", *described.notes)
        attributes[CALIBRATION] = checksum(*described.files)
    with spelled_as_in(str(file)):
        recording = ImageRecording(
            name=folder.resolve().name,
            source=str(path),
            time_s=_stamps(values, folder, file, len(left)),
            calibration=described.pair(load.size),
            load=load,
            T_cam_imu=T_CAM_BODY if described.T_cam_imu is None else described.T_cam_imu,
            notes=notes,
            attributes={"reader": READER.name, **attributes},
        )
    if "velocities" not in values:
        return recording
    return attach_velocities(recording, folder / _text(values, "velocities", file))


def _file_of(path: Path) -> Path:
    return path / FILE if path.is_dir() else path


def _folders(values: dict[str, Any], folder: Path, file: Path) -> tuple[str, str]:
    """Return the names of the folders of images; by default those with usual names."""
    if "left" in values or "right" in values:
        return _text(values, "left", file), _text(values, "right", file)
    if (found := find_pair(folder)) is None:
        message = "expected the names of the folders of images; there are none with usual names, such as left and right"
        raise CalibrationError(message, source=str(file), field="left")
    return found


def _files(values: dict[str, Any], folder: Path, file: Path, is_one: bool) -> tuple[list[Path], list[Path] | None]:
    """Return the files of left and right images, or of one camera."""
    if is_one:
        return list(images_in(folder / _text(values, "left", file))), None
    left, right = images_of_sides(*(folder / name for name in _folders(values, folder, file)))
    if alone := [image.stem for key, image in [*left.items(), *right.items()] if (key in left) != (key in right)]:
        raise LostDataError(f"{len(alone)} images have no partner, the first is {alone[0]}", source=str(folder))
    return list(left.values()), [right[key] for key in left]


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


def _recognises(source: Source) -> bool:
    file = _file_of(source.path)
    if source.path.is_dir():
        return file.is_file() or (source.calibration is not None and _is_bare(source.path))
    return file.suffix == ".toml" and bool(first_row(file)) and b"\x00" not in source.head


def _is_bare(folder: Path) -> bool:
    """Return whether a folder has a pair of folders of images and stamps, but is no sequence of KITTI."""
    return find_pair(folder) is not None and (folder / "times.txt").is_file() and not (folder / "calib.txt").is_file()


READER = Reader(
    "image_folders",
    f"a folder with {FILE} of a pair of image folders",
    _recognises,
    images=lambda source: open_folder(source.path, source.calibration),
)
