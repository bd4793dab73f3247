"""Drive folders of KITTI raw: velocities, calibration, 6-DoF truth, and rectified images of a pair or one camera.

Geiger, Lenz, Stiller, Urtasun, *Vision meets Robotics: The KITTI Dataset* (IJRR 2013), and the readme of its
development kit. A drive has ``oxts`` (see `oxts`), and ``image_00 image_01`` (gray) or ``image_02 image_03`` (colour)
with ``data/0000000000.png ...``. The three files ``calib_*.txt`` are in it or in the folder above.
"""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ekfslam.arrays import Array
from ekfslam.data.checks import require_rigid, spelled_as_in
from ekfslam.data.images import ImageRecording, LensCalibration, PairCalibration, side_by_side
from ekfslam.data.readers.fields import checksum
from ekfslam.data.readers.oxts import EXPECTED, Oxts, image_stamp_notes, read_oxts
from ekfslam.data.readers.pictures import in_order, numbered_images, pair_files
from ekfslam.data.readers.poses import Poses
from ekfslam.data.readers.registry import Lateral, Reader, Source
from ekfslam.data.readers.text import read_keys
from ekfslam.data.sequence import WITHOUT_TRACKS, Observations, Sequence, validate_camera
from ekfslam.data.tracks import inspect_tracks
from ekfslam.data.truth_noise import KITTI_TRUTH_NOISE
from ekfslam.errors import CalibrationError, ConfigError, ExtrinsicsError, LostDataError, UnknownFormatError
from ekfslam.geometry import se3
from ekfslam.geometry.camera import StereoCamera

Pair = Literal["gray", "color"]
CAMERAS: dict[Pair, tuple[str, str]] = {"gray": ("00", "01"), "color": ("02", "03")}

_RECTIFIED_M = 0.01  # the color pair of KITTI itself is off by 3 mm
_FOLDER_NAME = re.compile(r"\d{4}_\d\d_\d\d_drive_\d{4}_(sync|extract)")
_NO_TRACKS = "KITTI raw has no tracks; they must come from elsewhere."


@dataclass(frozen=True)
class KittiRaw:
    """A drive: all of a `Sequence` except tracks, see there."""

    folder: Path
    oxts: Oxts
    camera: StereoCamera
    T_cam_imu: Array
    notes: tuple[str, ...]
    attributes: dict[str, str]

    def sequence(self, observations: Observations | None = None) -> Sequence:
        """Return the drive as a `Sequence`, with tracks in the rectified images from elsewhere, or with none."""
        none = Observations(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 4)))
        sequence = Sequence(
            name=self.folder.resolve().name,
            source=str(self.folder),
            time_s=self.oxts.time_s,
            twist=self.oxts.twist,
            camera=self.camera,
            T_cam_imu=self.T_cam_imu,
            observations=none if observations is None else observations,
            truth=self.oxts.truth,
            attributes={**self.attributes, **(WITHOUT_TRACKS if observations is None else {})},
        )
        # Only the tracks of a valid sequence can be inspected.
        found = inspect_tracks(sequence.observations, sequence.twist).notes
        return dataclasses.replace(sequence, notes=(*self.notes, *((_NO_TRACKS,) if observations is None else found)))


def is_kitti_raw(folder: Path) -> bool:
    """Return whether a folder is laid out, or at least named, as a drive of KITTI raw."""
    return folder.is_dir() and ((folder / "oxts").is_dir() or bool(_FOLDER_NAME.fullmatch(folder.resolve().name)))


def open_kitti_raw(folder: str | Path, pair: Pair = "gray", lateral: Lateral = "corrected") -> KittiRaw:
    """Read a drive folder such as ``2011_09_30/2011_09_30_drive_0027_sync``, with the ``pair`` gray or color."""
    if pair not in CAMERAS:
        raise ConfigError(f"pair must be one of {', '.join(CAMERAS)}, found {pair!r}")
    folder = Path(folder)
    oxts = read_oxts(folder, lateral)
    camera, T_cam_imu, files = read_calibration(folder, pair)
    return KittiRaw(
        folder=folder,
        oxts=oxts,
        camera=camera,
        T_cam_imu=T_cam_imu,
        notes=(*oxts.notes, *image_stamp_notes(folder / f"image_{CAMERAS[pair][0]}" / "timestamps.txt", oxts.time_s)),
        attributes={
            "checksum_sha256": checksum(*oxts.files, *files),
            "reader": READER.name,
            "stereo_pair": pair,
            "lateral": lateral,
            **oxts.attributes,
        },
    )


def open_kitti_raw_images(folder: Path, lateral: Lateral = "corrected") -> ImageRecording | None:
    """Open the rectified images of a sync drive, with velocities and truth; None without images."""
    there = {pair: [c for c in cameras if (folder / f"image_{c}/data").is_dir()] for pair, cameras in CAMERAS.items()}
    pair = max(there, key=lambda pair: len(there[pair]))
    if not there[pair]:
        return None
    if folder.resolve().name.endswith("_extract"):
        raise UnknownFormatError(f"{folder}: images of an extract drive are not rectified; take the sync drive")
    found = [numbered_images(folder / f"image_{camera}/data") for camera in there[pair]]
    drive = open_kitti_raw(folder, pair, lateral).sequence()
    first, last = min(map(min, found)), max(map(max, found))
    if last >= len(drive):
        message = f"image {last:010d} has no packet, there are {len(drive)}"
        raise LostDataError(message, source=str(folder), field="oxts")
    left, *right = (in_order(images, range(first, last + 1)) for images in found)
    part = drive[first : last + 1]
    load, deep = pair_files(left, right[0] if right else None)
    K = np.vstack([part.camera.matrix[:2, :3], [0.0, 0.0, 1.0]])
    notes = tuple(note for note in part.notes if note != _NO_TRACKS)
    T_cam_imu, T_right_left = part.T_cam_imu, side_by_side(part.camera.baseline_m)
    if not right:
        notes = (*notes, f"There is one camera: image_{there[pair][0]}.")
        T_cam_imu = T_right_left @ T_cam_imu if there[pair][0] == CAMERAS[pair][1] else T_cam_imu
    if len(part) < len(drive):
        notes = (*notes, f"The folder has images {first} to {last} of {len(drive)} packets.")
    attributes = {name: value for name, value in part.attributes.items() if name not in WITHOUT_TRACKS}
    return ImageRecording(
        name=part.name,
        source=part.source,
        time_s=part.time_s,
        calibration=PairCalibration(K, K, load.size, T_right_left) if right else LensCalibration(K, load.size),
        load=load,
        T_cam_imu=T_cam_imu,
        twist=part.twist,
        velocity_frame=part.velocity_frame,
        truth=part.truth,
        notes=(*notes, *deep),
        attributes={**attributes, "reader": "kitti_raw_images"},
    )


def read_calibration(folder: Path, pair: Pair = "gray") -> tuple[StereoCamera, Array, tuple[Path, ...]]:
    """Return a rectified stereo pair, ``T_cam_imu`` (4, 4) of its left camera, and the files read.

    ``P_rect = K [I, t]`` of the left camera moves its origin by t from that of the rectified camera 00, so

        T_cam_imu = [I, t] R_rect_00 T_cam00_velo T_velo_imu,   baseline = t_x(left) - t_x(right).
    """
    left, right = (f"P_rect_{number}" for number in CAMERAS[pair])
    names = ("imu_to_velo", "velo_to_cam", "cam_to_cam")
    files = tuple(_find_calibration(folder, f"calib_{name}.txt") for name in names)
    T_velo_imu, T_cam00_velo = (_rigid(path) for path in files[:2])
    cam_to_cam = files[2]
    values = read_keys(cam_to_cam, {"R_rect_00": 9, left: 12, right: 12}, EXPECTED)
    with spelled_as_in(str(cam_to_cam), {"K": left, "baseline": f"{left}, {right}"}):
        rectify = se3.transform(values["R_rect_00"].reshape(3, 3), np.zeros(3))
        require_rigid(rectify, "R_rect_00", ExtrinsicsError)
        K, t_left = _split_projection(values[left], left)
        K_right, t_right = _split_projection(values[right], right)
        if not np.allclose(K, K_right, rtol=1e-6) or np.abs(t_left - t_right)[1:].max() > _RECTIFIED_M:
            raise CalibrationError(f"not a rectified pair with {left}", field=right)
        camera = StereoCamera(*(float(x) for x in (K[0, 0], K[1, 1], K[0, 2], K[1, 2], t_left[0] - t_right[0])))
        validate_camera(camera)
    return camera, se3.transform(np.eye(3), t_left) @ rectify @ T_cam00_velo @ T_velo_imu, files


def _find_calibration(folder: Path, name: str) -> Path:
    for place in (folder, folder.resolve().parent):
        if (place / name).is_file():
            return place / name
    raise UnknownFormatError(f"{folder}: {name} is neither here nor in the folder above; {EXPECTED}")


def _rigid(path: Path) -> Array:
    """Return the rigid transform (4, 4) of a calibration file with the keys R and T."""
    values = read_keys(path, {"R": 9, "T": 3}, EXPECTED)
    T = se3.transform(values["R"].reshape(3, 3), values["T"])
    with spelled_as_in(str(path)):
        require_rigid(T, "R", ExtrinsicsError)
    return T


def _split_projection(values: Array, name: str) -> tuple[Array, Array]:
    """Return K (3, 3) and t (3,) of a projection matrix ``K [I, t]``."""
    P = values.reshape(3, 4)
    K = P[:, :3]
    pinhole = np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
    if (pinhole != K).any() or K[0, 0] * K[1, 1] == 0:
        raise CalibrationError("not of the form [fu 0 cu . ; 0 fv cv . ; 0 0 1 .]", field=name)
    return K, (np.linalg.inv(K) @ P[:, 3]).astype(float)


def _truth(source: Source, sequence: Sequence) -> Poses:
    oxts = read_oxts(source.path)
    return Poses(oxts.truth.T_world_imu, oxts.time_s[oxts.truth.frame], oxts.files, KITTI_TRUTH_NOISE)


READER = Reader(
    "kitti_raw",
    "a drive folder of KITTI raw",
    lambda source: is_kitti_raw(source.path),
    tracks=lambda source: open_kitti_raw(source.path, lateral=source.lateral).sequence(),
    images=lambda source: open_kitti_raw_images(source.path, source.lateral),
    truth=_truth,
)
