"""Ground truth of EuRoC: found from any folder, matched by stamp, refused with file and line where it is broken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.recordings import FRAMES, HEADER, ece276a_fields, stamps, write_npz

from ekfslam import open_sequence
from ekfslam.data.sequence import Sequence
from ekfslam.errors import DataError, NonFiniteError, StampError, TruthError, UnknownFormatError
from ekfslam.geometry import se3

IN_RECORDING = "mav0/state_groundtruth_estimate0/data.csv"


def poses() -> np.ndarray:
    xi = np.array([2.0, -1, 0.5, 0.9, -0.4, 0.2]) + 0.1 * np.arange(FRAMES)[:, None] * np.array([1.0, 0, 2, 1, -2, 0.5])
    return se3.exp(xi)


def csv_lines(offset_ns: int = 1_000_000) -> list[str]:
    """Header, and poses 1 ms after each frame; others, 30 ms before and 40 ms after, must not be taken."""
    stamp_ns = np.round(stamps() * 1e9).astype(np.int64) + offset_ns
    rows = []
    for ns, T in zip(stamp_ns, poses(), strict=True):
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        far = [99.0, 99, 99, 1, 0, 0, 0]
        for shift, pose in ((-31_000_000, far), (0, [*T[:3, 3], w, x, y, z]), (39_000_000, far)):
            rows.append(",".join([str(ns + shift), *(f"{value:.9f}" for value in pose), *["0.000001"] * 9]))
    return [HEADER, *rows]


@pytest.fixture
def npz(tmp_path) -> Path:
    return write_npz(tmp_path / "0099.npz", ece276a_fields())


@pytest.fixture
def recording(tmp_path) -> Path:
    (tmp_path / "V1_01_easy" / IN_RECORDING).parent.mkdir(parents=True)
    (tmp_path / "V1_01_easy" / IN_RECORDING).write_text("\n".join(csv_lines()) + "\n")
    return tmp_path / "V1_01_easy"


def assert_true(sequence: Sequence) -> None:
    np.testing.assert_array_equal(sequence.truth.frame, np.arange(FRAMES))
    np.testing.assert_allclose(sequence.truth.T_world_imu, poses(), atol=1e-8)


@pytest.mark.parametrize("place", [".", "mav0", "mav0/state_groundtruth_estimate0", IN_RECORDING])
def test_truth_is_found_from_any_folder_and_matched_by_stamp(npz, recording, place):
    sequence = open_sequence(npz, truth=recording / place)
    assert_true(sequence)
    name = (recording / place).name
    assert sequence.notes[-1] == f"Truth of 7 of 7 frames from {name}; 14 of its 21 poses are not used."
    assert len(sequence.attributes["truth_checksum_sha256"]) == 64


def test_name_of_the_file_and_line_ends_do_not_matter(npz, tmp_path):
    path = tmp_path / "truth.txt"
    path.write_bytes("\r\n".join([*csv_lines(), ""]).encode())
    assert_true(open_sequence(npz, truth=path))


def test_eight_columns_are_enough(npz, tmp_path):
    path = tmp_path / "data.csv"
    lines = [",".join(line.split(",")[:8]) for line in csv_lines()]
    path.write_text("\n".join([lines[0].replace("timestamp", "timestamp [ns]"), *lines[1:]]))
    assert_true(open_sequence(npz, truth=path))


def test_other_clocks_are_refused_with_both_spans(npz, tmp_path):
    path = tmp_path / "data.csv"
    path.write_text("\n".join(csv_lines(offset_ns=10_000_000_000)))
    with pytest.raises(
        TruthError, match=r"0 of the 7 frames.*its stamps are 1317384516\.\d+ to .*sequence's 1317384506"
    ):
        open_sequence(npz, truth=path)


def words(line: str, k: int, text: str) -> str:
    parts = line.split(",")
    parts[k] = text
    return ",".join(parts)


LINES = csv_lines()
BROKEN = [
    (0, "", TruthError, 2),  # no header
    (0, HEADER.replace("p_RS_R_x", "pressure"), TruthError, 1),
    (0, "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]", TruthError, 1),
    (4, LINES[4] + ",1.0", TruthError, 5),
    (4, LINES[4].rsplit(",", 1)[0], TruthError, 5),
    (4, words(LINES[4], 1, "x"), TruthError, 5),
    (4, words(LINES[4], 1, ""), TruthError, 5),
    (4, words(LINES[4], 0, "1317384506.4"), TruthError, 5),
    (4, words(LINES[4], 0, "9" * 400), TruthError, 5),
    (4, words(LINES[4], 2, "nan"), NonFiniteError, 5),
    (4, words(LINES[4], 4, "3.0"), TruthError, 5),
    (4, words(words(LINES[4], 0, LINES[3].split(",")[0]), 1, "98"), StampError, 5),
]


@pytest.mark.parametrize(("line", "text", "error", "number"), BROKEN)
def test_broken_csv_names_file_and_line(npz, recording, line, text, error, number):
    path = recording / IN_RECORDING
    path.write_text("\n".join([*LINES[:line], text, *LINES[line + 1 :]]))
    with pytest.raises(DataError) as caught:
        open_sequence(npz, truth=recording)
    assert type(caught.value) is error, caught.value
    assert (caught.value.source, caught.value.field, caught.value.index) == (str(path), "line", number)


def test_csv_without_poses_and_folder_without_csv_are_refused(npz, recording):
    path = recording / IN_RECORDING
    path.write_text(HEADER + "\n")
    with pytest.raises(UnknownFormatError, match=r"data\.csv: holds no poses"):
        open_sequence(npz, truth=recording)
    path.unlink()
    with pytest.raises(UnknownFormatError, match=r"V1_01_easy: .*a EuRoC ground-truth csv or its folder"):
        open_sequence(npz, truth=recording)
