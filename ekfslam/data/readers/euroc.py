"""EuRoC MAV and TUM-VI: stereo images and true poses in a folder with ``mav0``, or in the folder ``mav0`` itself.

Images are in ``mav0/cam0 cam1`` with ``data.csv`` and ``sensor.yaml``, true poses in
``mav0/state_groundtruth_estimate0/data.csv``. Burri et al., *The EuRoC micro aerial vehicle datasets* (IJRR 2016).
Schubert et al., *The TUM VI Benchmark* (IROS 2018): a folder may have the calibration of Kalibr, ``dso/camchain.yaml``,
in place of ``sensor.yaml``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.checks import require_rigid, spelled_as_in
from ekfslam.data.images import Distortion, DistortionModel, ImageRecording, PairCalibration
from ekfslam.data.readers.fields import checksum
from ekfslam.data.readers.pictures import PairFiles, pair_stamps
from ekfslam.data.readers.poses import Poses, stamped_poses, truth_of_frames
from ekfslam.data.readers.registry import Reader, Source
from ekfslam.data.readers.text import Table, first_row, line_of, parse_table, read_lines, rows_of
from ekfslam.data.readers.yaml import Calibration, read_yaml
from ekfslam.errors import (
    CalibrationError,
    ExtrinsicsError,
    LineError,
    LostDataError,
    StampError,
    TruthError,
    UnknownFormatError,
)
from ekfslam.geometry import se3

CAMERAS = ("cam0", "cam1")
COLUMNS = ("timestamp", "p_RS_R_x", "p_RS_R_y", "p_RS_R_z", "q_RS_w", "q_RS_x", "q_RS_y", "q_RS_z")
_AS_TUM = [0, 1, 2, 3, 5, 6, 7, 4]  # the quaternion with w last
_FOLDERS = ("state_groundtruth_estimate0", "mocap0")  # mocap0: TUM-VI
_PLACES = ("data.csv", *(f"{above}{folder}/data.csv" for above in ("", "mav0/") for folder in _FOLDERS))
_KALIBR = ("dso/camchain.yaml", "camchain.yaml")
_MODELS: dict[str, DistortionModel] = {
    "radial-tangential": "radtan",
    "radtan": "radtan",
    "equidistant": "equidistant",
    "none": "none",
}


def open_euroc(folder: Path) -> ImageRecording:
    """Open the images of a recording, its calibration, and its truth if there is any; the body is the IMU."""
    mav = _mav(folder) or folder
    (left_ns, left), (right_ns, right) = (_images(mav / name) for name in CAMERAS)
    in_left, in_right, notes = pair_stamps(left_ns, right_ns, str(mav))
    calibration, T_cam_imu, read = _calibration(mav)
    time_s = left_ns[in_left] / 1e9
    truth, found = None, find_euroc_truth(mav)
    if found is not None:
        truth = truth_of_frames(time_s, read_euroc(found))
        notes = (*notes, f"Truth of {len(truth.frame)} of {len(time_s)} frames from {found.relative_to(mav)}.")
    place = folder.resolve()
    return ImageRecording(
        name=place.name if place.name != "mav0" else place.parent.name,
        source=str(folder),
        time_s=time_s,
        calibration=calibration,
        load=PairFiles([left[i] for i in in_left], [right[i] for i in in_right], calibration.size),
        T_cam_imu=T_cam_imu,
        truth=truth if truth is not None and len(truth.frame) else None,
        notes=("There are no velocities: the IMU gives angular rates and accelerations only.", *notes),
        attributes={
            "reader": IMAGES.name,
            "checksum_sha256": checksum(*(mav / name / "data.csv" for name in CAMERAS), *read),
        },
    )


def _mav(folder: Path) -> Path | None:
    """Return the folder of the cameras."""
    return next((place for place in (folder / "mav0", folder) if (place / CAMERAS[0] / "data.csv").is_file()), None)


def _images(camera: Path) -> tuple[IntArray, list[Path]]:
    """Return increasing stamps (ns) and files of a camera."""
    path = camera / "data.csv"
    stamps: list[int] = []
    files: list[Path] = []
    there = {entry.name for entry in (camera / "data").iterdir()} if (camera / "data").is_dir() else set()
    for number, content in rows_of(read_lines(path, "expected stamps and names of images")):
        words = [word.strip() for word in content.split(",")]
        if len(words) < 2 or not words[0].isdigit() or int(words[0]) >= 1 << 63:
            if not stamps and not any(word.isdigit() for word in words):
                continue  # a header without the mark of a comment
            raise LineError(f"{content!r} is no stamp in ns and a name", **line_of(path, number))
        if words[1] not in there:
            raise LostDataError(f"the image {words[1]} is missing in {camera / 'data'}", **line_of(path, number))
        stamp = int(words[0])
        if stamps and stamp <= stamps[-1]:
            raise StampError("the stamp does not increase", **line_of(path, number))
        stamps.append(stamp)
        files.append(camera / "data" / words[1])
    if not stamps:
        raise LineError("there are no images", source=str(path), field="line")
    return np.array(stamps, dtype=np.int64), files


def _calibration(mav: Path) -> tuple[PairCalibration, Array, tuple[Path, ...]]:
    """Return the calibration of the pair, ``T_cam_imu`` of its left camera, and the files read."""
    kalibr = next((place / name for place in (mav, mav.parent) for name in _KALIBR if (place / name).is_file()), None)
    paths = [mav / name / "sensor.yaml" for name in CAMERAS]
    if not paths[0].is_file() and kalibr is not None:
        read = read_yaml(kalibr)
        cameras = [_camera(read, f"{name}.", "distortion_coeffs") for name in CAMERAS]
        poses = [_kalibr_pose(read, name) for name in CAMERAS]
        paths = [kalibr]
    else:
        reads = [read_yaml(path) for path in paths]
        cameras = [_camera(read, "", "distortion_coefficients") for read in reads]
        poses = [se3.inverse(_pose(read, "T_BS.data" if "T_BS.data" in read else "T_BS")) for read in reads]
    (K_left, size, lens_left), (K_right, size_right, lens_right) = cameras
    with spelled_as_in(str(paths[-1])):
        if size_right != size:
            raise CalibrationError(f"{size_right} differs from {size} of the left camera", field="resolution")
        T_right_left = poses[1] @ se3.inverse(poses[0])
        return PairCalibration(K_left, K_right, size, T_right_left, lens_left, lens_right), poses[0], tuple(paths)


def _camera(read: Calibration, prefix: str, coefficients: str) -> tuple[Array, tuple[int, int], Distortion]:
    """Return intrinsic matrix, size and lens of a camera."""
    with spelled_as_in(str(read.path), {"distortion": f"{prefix}{coefficients}"}):
        if (kind := read.word(f"{prefix}camera_model")) != "pinhole":
            raise CalibrationError(f"expected pinhole, found {kind!r}", field=f"{prefix}camera_model")
        fu, fv, cu, cv = read.numbers(f"{prefix}intrinsics", 4)
        width, height = read.numbers(f"{prefix}resolution", 2)
        if not (float(width).is_integer() and float(height).is_integer()):
            message = f"expected whole numbers of pixels, found {width:g} and {height:g}"
            raise CalibrationError(message, field=f"{prefix}resolution")
        if (name := read.word(f"{prefix}distortion_model")) not in _MODELS:
            raise CalibrationError(f"expected {', '.join(_MODELS)}, found {name!r}", field=f"{prefix}distortion_model")
        values = () if _MODELS[name] == "none" else tuple(read.numbers(f"{prefix}{coefficients}").tolist())
        lens = Distortion(_MODELS[name], values)
    return np.array([[fu, 0.0, cu], [0.0, fv, cv], [0.0, 0.0, 1.0]]), (int(width), int(height)), lens


def _pose(read: Calibration, key: str) -> Array:
    pose = read.numbers(key, 16).reshape(4, 4)
    with spelled_as_in(str(read.path)):
        require_rigid(pose, key, ExtrinsicsError)
    return se3.nearest_rigid(pose)


def _kalibr_pose(read: Calibration, name: str) -> Array:
    """Return ``T_cam_imu`` of a camera; Kalibr may state that of the second relative to the first."""
    key = f"{name}.T_cam_imu"
    if key not in read and f"{name}.T_cn_cnm1" in read:
        return _pose(read, f"{name}.T_cn_cnm1") @ _kalibr_pose(read, CAMERAS[0])
    return _pose(read, key)


def find_euroc_truth(folder: Path) -> Path | None:
    """Return the csv of true poses of a recording, its ``mav0``, or the folder of the csv itself; None if none."""
    return next((folder / place for place in _PLACES if (folder / place).is_file()), None)


def read_euroc(path: Path) -> Poses:
    """Read the poses ``T_R_S`` of the body (the IMU) in the reference frame, from a csv or the csv of a folder.

    They are stamped in ns, with quaternions w first. The header must name these eight columns; others are not read.
    """
    path = find_euroc_truth(path) or path
    lines = read_lines(path, f"expected {TRUTH.expected}")
    number, line = next(iter(rows_of(lines, comment=None)), (1, ""))
    header = [word.split("[")[0].strip() for word in line.removeprefix("#").split(",")]
    if not line.startswith("#") or tuple(header[: len(COLUMNS)]) != COLUMNS:
        expected = f"expected #{', '.join(COLUMNS)}, ..."
        raise TruthError(f"the header is missing or differs; {expected}", **line_of(path, number))
    table = parse_table(
        lines,
        path,
        columns=len(header),
        used=len(COLUMNS),
        separator=",",
        # Nanoseconds since 1970 have more digits than a float; as integers they lose none.
        converters={0: lambda word: int(word) / 1e9},
        error=TruthError,
    )
    if not len(table.values):
        raise UnknownFormatError(f"{path}: holds no poses; expected lines of {', '.join(COLUMNS)}, ...")
    return stamped_poses(Table(path, table.values[:, _AS_TUM], table.line))


def _has_truth(source: Source) -> bool:
    # No other format of poses has commas.
    return find_euroc_truth(source.path) is not None or "," in first_row(source.path)


IMAGES = Reader(
    "euroc_images",
    "a folder of EuRoC or TUM-VI (mav0/cam0 cam1)",
    lambda source: _mav(source.path) is not None,
    images=lambda source: open_euroc(source.path),
)
TRUTH = Reader(
    "EuRoC",
    "a EuRoC ground-truth csv or its folder",
    _has_truth,
    truth=lambda source, _: read_euroc(source.path),
)
