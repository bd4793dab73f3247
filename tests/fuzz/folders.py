"""Valid recordings that are folders, bags, or images, small enough to be broken thousands of times."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image
from rosbags import rosbag1, rosbag2
from support.bags import KINDS, stereo
from support.bags import write as write_bag
from support.images import write_course, write_euroc, write_plain, write_raw_images
from support.kitti_raw import write_drive
from support.npy import npy_fields, write_npy
from support.rendered import BASELINE_M, recording

from ekfslam.data.simulate import builtin

Files = dict[str, bytes]  # by relative path, with a slash


def files_below(folder: Path) -> Files:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def folders() -> dict[str, tuple[Files, str]]:
    """By name: files, and the relative path that a user would give."""
    found = {}
    writers = {
        "drive": write_drive,
        "raw": lambda place: write_raw_images(write_drive(place)),
        "euroc": write_euroc,
        "plain": write_plain,
        "course": write_course,
        "npy": lambda place: write_npy(place / "dataset00.npy", npy_fields(builtin("loop?frames=7"))),
        "room": _room,
        **{kind: lambda place, kind=kind: write_bag(place, stereo(), kind) for kind in KINDS},
        **{f"ros1 {name}": lambda place, name=name: _compressed(place, True, name) for name in ("BZ2", "LZ4")},
        **{f"ros2 {name}": lambda place, name=name: _compressed(place, False, name) for name in ("FILE", "MESSAGE")},
    }
    for name, write in writers.items():
        with tempfile.TemporaryDirectory() as place:
            path = write(Path(place))
            found[name] = files_below(Path(place)), path.relative_to(place).as_posix()
    return found


def _room(place: Path) -> Path:
    """Frames of KITTI odometry that can really be tracked."""
    room = recording(4, False, np.zeros(3))
    for side, name in enumerate(("image_0", "image_1")):
        (place / name).mkdir()
        for k in range(4):
            (place / name / f"{k:06d}.png").write_bytes(png(room.load(k)[side]))
    P = "300 0 199.5 {} 0 300 99.5 0 0 0 1 0"
    (place / "calib.txt").write_text(f"P0: {P.format(0)}\nP1: {P.format(-300 * BASELINE_M)}\n")
    (place / "times.txt").write_text("0.0\n0.1\n0.2\n0.3\n")
    return place


def _compressed(place: Path, is_ros1: bool, name: str) -> Path:
    """A bag that its writer compresses: in chunks, as a whole, or each message."""

    class Compressed(rosbag1.Writer if is_ros1 else rosbag2.Writer):
        def __init__(self, path: Path, **more: object) -> None:
            super().__init__(path, **more)
            if is_ros1:
                self.set_compression(self.CompressionFormat[name])
            else:
                self.set_compression(rosbag2.CompressionMode[name], rosbag2.CompressionFormat.ZSTD)

    module, writer = (rosbag1, rosbag1.Writer) if is_ros1 else (rosbag2, rosbag2.Writer)
    module.Writer = Compressed
    try:
        return write_bag(place, stereo(), "ros1" if is_ros1 else "ros2")
    finally:
        module.Writer = writer


def png(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "png")
    return stream.getvalue()


def is_text(name: str) -> bool:
    return PurePosixPath(name).suffix in (".txt", ".csv", ".yaml", ".toml")
