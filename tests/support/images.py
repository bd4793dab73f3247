"""Small recordings of images in every format of folders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image as Pillow

from ekfslam import open_images
from ekfslam.data.images import ImageRecording
from ekfslam.data.simulate import builtin
from ekfslam.geometry import se3
from support.npy import npy_fields, write_npy

SIZE = (12, 8)
FRAMES = 6
STAMPS_NS = 1_403_636_579_763_555_584 + 50_000_000 * np.arange(FRAMES)


def opened(path: Path) -> ImageRecording:
    found = open_images(path)
    assert found is not None
    return found


def picture(frame: int, side: int) -> np.ndarray:
    """Pixels that say which image they are of."""
    return np.full(SIZE[::-1], 10 * frame + side, dtype=np.uint8)


def write_picture(path: Path, frame: int, side: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Pillow.fromarray(picture(frame, side)).save(path)


def write_raw_images(drive: Path) -> Path:
    for frame in range(FRAMES):
        for side in (0, 1):
            write_picture(drive / f"image_0{side}/data/{frame:010d}.png", frame, side)
    return drive


def sensor_yaml(T_BS: np.ndarray, fu: float) -> str:
    data = ",\n         ".join(", ".join(repr(float(x)) for x in row) for row in T_BS)
    return f"""#Default sensor yaml file
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [{data}]

# Camera specific definitions.
rate_hz: 20
resolution: [{SIZE[0]}, {SIZE[1]}]
camera_model: pinhole
intrinsics: [{fu}, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""


LEFT_IN_BODY = se3.exp(np.array([0.02, -0.06, 0.01, 0.1, -0.2, 1.5]))
LEFT_RIGHT = se3.exp(np.array([0.11, 0.001, -0.002, 0.01, -0.02, 0.005]))


def write_euroc(place: Path) -> Path:
    folder = place / "MH_01_easy"
    for side, pose in enumerate((LEFT_IN_BODY, LEFT_IN_BODY @ LEFT_RIGHT)):
        camera = folder / f"mav0/cam{side}"
        for frame, stamp in enumerate(STAMPS_NS):
            write_picture(camera / f"data/{stamp}.png", frame, side)
        lines = ["#timestamp [ns],filename", *(f"{stamp},{stamp}.png" for stamp in STAMPS_NS)]
        (camera / "data.csv").write_text("\r\n".join(lines) + "\r\n")
        (camera / "sensor.yaml").write_text(sensor_yaml(pose, 458.654 + side))
    return folder


TOML = """left = "left"
right = "right"
times = "times.txt"
T_right_left = [[1, 0, 0, -0.54], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
[left_camera]
intrinsics = [707.0, 706.0, 602.0, 183.0]
distortion_model = "radtan"
distortion = [-0.28, 0.07, 0.0, 0.0]
[right_camera]
intrinsics = [708.0, 706.0, 602.0, 183.0]
"""


def write_plain(place: Path) -> Path:
    folder = place / "garden"
    for frame in range(FRAMES):
        for side, name in enumerate(("left", "right")):
            write_picture(folder / name / f"{frame:04d}.png", frame, side)
    np.savetxt(folder / "times.txt", 0.1 * np.arange(FRAMES))
    (folder / "calibration.toml").write_text(TOML)
    return folder


def write_course(place: Path) -> Path:
    fields = npy_fields(builtin(f"loop?frames={FRAMES}"))
    del fields["features"]
    sides = [[picture(frame, side) for frame in range(FRAMES)] for side in (0, 1)]
    write_npy(place / "dataset02_imgs.npy", dict(zip(("cam_imgs_L", "cam_imgs_R"), sides, strict=True)))
    return write_npy(place / "dataset02.npy", fields)
