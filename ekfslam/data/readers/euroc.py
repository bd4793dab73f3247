"""EuRoC MAV and TUM-VI: stereo images, inertial samples and true poses in a folder with ``mav0``, or in that folder.

Images are in ``mav0/cam0 cam1`` with ``data.csv`` and ``sensor.yaml``, samples in ``mav0/imu0`` likewise, true poses
with velocities and biases in ``mav0/state_groundtruth_estimate0/data.csv``. Burri et al., *The EuRoC micro aerial
vehicle datasets* (IJRR 2016).
Schubert et al., *The TUM VI Benchmark* (IROS 2018): a folder may have the calibration of Kalibr, ``dso/camchain.yaml``,
in place of ``sensor.yaml``, and densities in ``imu_config.yaml`` or ``imu.yaml``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.data.images import ImageRecording
from ekfslam.data.imu import with_rows
from ekfslam.data.inertial import InertialRows
from ekfslam.data.observations import TrueMotion
from ekfslam.data.readers.calibrations import PairFile, read_euroc_pair, read_pair
from ekfslam.data.readers.columns import POSE, header_of, read_named, without_repeats
from ekfslam.data.readers.fields import BODY_IS_CAMERA, checksum
from ekfslam.data.readers.imu_text import read_imu
from ekfslam.data.readers.imu_yaml import beside, calibrated, find_chain, read_imu_yaml
from ekfslam.data.readers.pictures import SUFFIXES, pair_files, pair_stamps
from ekfslam.data.readers.poses import Poses, stamped_poses, truth_of_frames
from ekfslam.data.readers.registry import CALIBRATION, Reader, Source
from ekfslam.data.readers.text import Table, first_row, line_of, read_lines, rows_of
from ekfslam.errors import LineError, LostDataError, TruthError, UnknownFormatError
from ekfslam.geometry.camera import T_CAM_BODY

CAMERAS = ("cam0", "cam1")
COLUMNS = ("timestamp", "p_RS_R_x", "p_RS_R_y", "p_RS_R_z", "q_RS_w", "q_RS_x", "q_RS_y", "q_RS_z")
MOTION = (
    *(f"v_RS_R_{axis}" for axis in "xyz"),
    *(f"b_w_RS_S_{axis}" for axis in "xyz"),
    *(f"b_a_RS_S_{axis}" for axis in "xyz"),
)
_FOLDERS = ("state_groundtruth_estimate0", "mocap0")  # mocap0: TUM-VI
_PLACES = ("data.csv", *(f"{above}{folder}/data.csv" for above in ("", "mav0/") for folder in _FOLDERS))


def open_euroc(folder: Path, calibration: str | None = None) -> ImageRecording:
    """Open images, calibration, samples and truth of a recording; frames without samples are left out."""
    mav = _mav(folder) or folder
    cameras = [name for name in CAMERAS if (mav / name).is_dir()]
    rig, imu = _calibration(mav, calibration, len(cameras) == 1), _inertial(mav)
    time_ns, files, found_notes = _frames(mav, cameras)
    load, deep = pair_files(*files, rig.left.size)
    time_s, notes = time_ns / 1e9, (*found_notes, *deep, *rig.notes)
    truth, found = None, find_euroc_truth(mav)
    if found is not None:
        truth = truth_of_frames(time_s, read_euroc(found))
        notes = (*notes, f"Truth of {len(truth.frame)} of {len(time_s)} frames from {found.relative_to(mav)}.")
    place = folder.resolve()
    recording = ImageRecording(
        name=place.name if place.name != "mav0" else place.parent.name,
        source=str(folder),
        time_s=time_s,
        calibration=rig.pair(load.size),
        load=load,
        T_cam_imu=T_CAM_BODY if rig.T_cam_imu is None else rig.T_cam_imu,
        truth=truth if truth is not None and len(truth.frame) else None,
        notes=("There are no velocities and no inertial samples.", *notes),
        attributes={
            "reader": IMAGES.name,
            "checksum_sha256": checksum(*(mav / name / "data.csv" for name in cameras), *rig.files),
            **({CALIBRATION: checksum(*rig.files)} if calibration else {}),
        },
    )
    if imu is None:
        return recording
    if rig.T_cam_imu is None:
        note = f"Inertial samples are not used: {rig.files[0].name} states no T_cam_imu."
        return replace(recording, notes=(*recording.notes, note))
    rows, T_body_imu = imu
    T_cam_imu = None if T_body_imu is None else rig.T_cam_imu @ T_body_imu
    return with_rows(recording, replace(rows, late_s=rig.late_s, T_cam_imu=T_cam_imu))


def _frames(mav: Path, cameras: list[str]) -> tuple[IntArray, tuple[list[Path], list[Path] | None], tuple[str, ...]]:
    """Return stamps (T,) of frames, files of left and right images, or of one camera, and notes."""
    if len(cameras) == 1:
        images = _images(mav / cameras[0])
        return images.time_ns, (images.files, None), (*images.notes, "There is one camera.")
    left, right = (_images(mav / name) for name in cameras)
    # An image whose partner is known to be missing is no sign of another clock.
    left, right = left.without(right.missing_ns), right.without(left.missing_ns)
    in_left, in_right, alone = pair_stamps(left.time_ns, right.time_ns, str(mav))
    files = [left.files[i] for i in in_left], [right.files[i] for i in in_right]
    return left.time_ns[in_left], files, (*left.notes, *right.notes, *alone)


def _inertial(mav: Path) -> tuple[InertialRows, Array | None] | None:
    """Return the samples of a recording with their densities, and ``T_BS`` of the unit; None: there are none."""
    path = mav / "imu0/data.csv"
    if not path.is_file():
        return None
    file, rows = beside(path.parent, mav, mav.parent, mav / "dso", mav.parent / "dso"), read_imu(path)
    if file is None:
        return rows, None
    read = read_imu_yaml(file)
    return rows if file.parent == path.parent else calibrated(rows, read), read.T_body_imu


def _mav(folder: Path) -> Path | None:
    """Return the folder of the cameras."""
    return next((place for place in (folder / "mav0", folder) if (place / CAMERAS[0] / "data.csv").is_file()), None)


class _Images(NamedTuple):
    """Increasing stamps (T,) and files of a camera, stamps of missing files, and a note on these."""

    time_ns: IntArray
    files: list[Path]
    missing_ns: IntArray
    notes: tuple[str, ...]

    def without(self, time_ns: IntArray) -> _Images:
        """Return the images whose stamps are not among some."""
        kept = np.flatnonzero(~np.isin(self.time_ns, time_ns))
        return self._replace(time_ns=self.time_ns[kept], files=[self.files[i] for i in kept])


def _images(camera: Path) -> _Images:
    """Return the images of a camera; missing files and repeated lines are left out with a note."""
    path, found, missing, lines = camera / "data.csv", dict[int, Path](), list[int](), list[int]()
    there = {entry.name for entry in (camera / "data").iterdir()} if (camera / "data").is_dir() else set()
    for number, content in rows_of(read_lines(path, "expected stamps and names of images")):
        words = [word.strip() for word in content.split(",")]
        if len(words) < 2 or not words[0].isdecimal() or int(words[0]) >= 1 << 63:
            if not lines and not any(word.isdecimal() for word in words):
                continue  # a header without the mark of a comment
            raise LineError(f"{content!r} is no stamp in ns and a name", **line_of(path, number))
        lines.append(int(words[0]))
        if words[1] in there:
            found.setdefault(lines[-1], camera / "data" / words[1])
        elif Path(words[1]).name != words[1]:
            raise LostDataError(f"the image {words[1]} is missing in {camera / 'data'}", **line_of(path, number))
        else:
            missing.append(lines[-1])
    if not lines:
        raise LineError("there are no images", source=str(path), field="line")
    if not found:
        raise LostDataError(f"none of its {len(lines)} images is in {camera / 'data'}", source=str(path), field="line")
    extra = {name for name in there if Path(name).suffix.lower() in SUFFIXES} - {file.name for file in found.values()}
    counts = {
        f"images of data.csv are missing, the first at {min(missing, default=0)} ns": len(missing),
        "lines of data.csv repeat a stamp and are left out": len(lines) - len(missing) - len(found),
        "images have no line in data.csv and are left out": len(extra),
        "lines of data.csv are before their predecessors; all are sorted": int((np.diff(lines) < 0).sum()),
    }
    notes = tuple(f"{camera.name}: {count} {words}." for words, count in counts.items() if count)
    stamps = sorted(found)
    as_ns = (np.array(each, dtype=np.int64) for each in (stamps, missing))
    return _Images(next(as_ns), [found[stamp] for stamp in stamps], next(as_ns), notes)


def _calibration(mav: Path, given: str | None, is_one: bool) -> PairFile:
    """Return the calibration of camera(s) and body: of a given file, ``sensor.yaml``, or a chain of Kalibr."""
    own = mav / CAMERAS[0] / "sensor.yaml"
    places = (place / sub for place in (mav, mav.parent) for sub in ("dso", "."))
    chain = given or (None if own.is_file() else find_chain(*places))
    if chain is None:
        return read_euroc_pair(own, *([] if is_one else [mav / CAMERAS[1] / "sensor.yaml"]))
    found = read_pair(chain, CAMERAS[: 2 - is_one])
    notes = (f"The calibration is that of {found.files[0].name}.", *found.notes) if given else found.notes
    if found.T_cam_imu is None:
        notes += (f"{found.files[0].name} states no T_cam_imu. {BODY_IS_CAMERA}",)
    return replace(found, notes=notes)


def find_euroc_truth(folder: Path) -> Path | None:
    """Return the csv of true poses of a recording, its ``mav0``, or the folder of the csv itself; None if none."""
    return next((folder / place for place in _PLACES if (folder / place).is_file()), None)


def read_euroc(path: Path) -> Poses:
    """Read the poses ``T_R_S`` of the IMU in the reference frame, from a csv that names them, or that of a folder."""
    path = find_euroc_truth(path) or path
    lines = read_lines(path, f"expected {TRUTH.expected}")
    number, _ = next(iter(rows_of(lines, comment=None)), (1, ""))
    header = header_of(lines)
    if header is None or not header.place.keys() >= set(POSE):
        expected = f"expected #{', '.join(COLUMNS)}, ..."
        raise TruthError(f"the header is missing or differs; {expected}", **line_of(path, number))
    names = [word.split("[")[0].strip() for word in lines[header.line - 1].split(",")]
    begin = names.index(MOTION[0]) if MOTION[0] in names else -1
    has_motion = begin >= 0 and tuple(names[begin : begin + len(MOTION)]) == MOTION
    further = {name: begin + i for i, name in enumerate(MOTION)} if has_motion else {}
    header = replace(header, place={**header.place, **further})
    table = read_named(path, lines, header, (*POSE, *further), TruthError)
    if not len(table.values):
        raise UnknownFormatError(f"{path}: holds no poses; expected lines of {', '.join(COLUMNS)}, ...")
    table, notes = without_repeats(table)
    poses = replace(stamped_poses(Table(path, table.values[:, : len(POSE)], table.line)), notes=notes)
    return replace(poses, motion=TrueMotion(*np.split(table.values[:, 8:], 3, axis=1))) if further else poses


def _has_truth(source: Source) -> bool:
    # No other format of poses has commas.
    return find_euroc_truth(source.path) is not None or "," in first_row(source.path)


IMAGES = Reader(
    "euroc_images",
    "a folder of EuRoC or TUM-VI (mav0/cam0 cam1)",
    lambda source: _mav(source.path) is not None,
    images=lambda source: open_euroc(source.path, source.calibration),
)
TRUTH = Reader(
    "EuRoC", "a EuRoC ground-truth csv or its folder", _has_truth, truth=lambda source, _: read_euroc(source.path)
)
