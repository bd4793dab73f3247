"""A recording in your own format, which `open_sequence` and everything else then take like any other.

It shows a reader (a file with a `Reader`, see ``formats/lines.py``) and its registration: readers are all files in the
folders of the package `ekfslam.data.readers`, to which you can add a folder. The command line finds the reader if its
file is in ``ekfslam/data/readers`` itself.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np

import ekfslam
from ekfslam.data import readers
from ekfslam.data.simulate import Loop, simulate

readers.__path__.append(str(Path(__file__).parent / "formats"))


def as_lines(sequence: ekfslam.Sequence) -> str:
    """Read a recording from text, see ``formats/lines.py``."""
    camera, noise = sequence.camera, sequence.noise
    assert noise is not None
    rows: list[tuple[str, Iterable[float]]] = [
        ("camera", [camera.fu_px, camera.fv_px, camera.cu_px, camera.cv_px, camera.baseline_m]),
        ("T_cam_imu", sequence.T_cam_imu.ravel()),
        ("noise", [noise.twist_std[0], noise.twist_std[3], noise.pixel_std_px[0]]),
    ]
    for k, (time_s, twist) in enumerate(zip(sequence.time_s, sequence.twist, strict=True)):
        rows.append(("frame", [time_s, *twist]))
        rows.extend(("seen", [i, *pixels]) for i, pixels in zip(*sequence.observations.at(k), strict=True))
    return "\n".join(["LINES 1", *(f"{word} {' '.join(f'{x:.6f}' for x in values)}" for word, values in rows)])


def main() -> None:
    recorded = simulate(Loop(frames=100))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.txt"
        path.write_text(as_lines(recorded) + "\n", encoding="utf-8")
        sequence = ekfslam.open_sequence(path)
        print(f"read by: {sequence.attributes['reader']}")
        print(f"frames: {len(sequence)}, observations: {len(sequence.observations)} of {len(recorded.observations)}")
        path.write_text(as_lines(recorded).replace("seen", "scene", 1), encoding="utf-8")
        try:
            ekfslam.open_sequence(path)
        except ekfslam.EkfslamError as error:
            print(f"a damaged file: {str(error).replace(str(path), path.name)}")

    result, truth = ekfslam.run(sequence), recorded.truth
    assert truth is not None
    error_m = np.linalg.norm(result.T_world_imu[:, :3, 3] - truth.T_world_imu[:, :3, 3], axis=1)
    print(f"landmarks: {len(result.landmarks)}")
    print(f"largest error of a position: {error_m.max():.3f} m")


if __name__ == "__main__":
    main()
