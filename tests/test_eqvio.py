"""The csv of EqVIO: tracks of one camera, inertial samples and calibration in one file."""

import numpy as np
import pytest

import ekfslam
from ekfslam.errors import CalibrationError, LineError, StampError, UnknownFormatError

HEADER = "row_type,t_abs,frame_idx,landmark_id,gx,gy,gz,ax,ay,az,u_norm,v_norm,key,value"
META = {"camera_fx": 400.0, "camera_fy": 410.0, "camera_cx": 320.0, "camera_cy": 240.0}
META |= {
    "T_ci_tx": 0.1,
    "T_ci_ty": 0.2,
    "T_ci_tz": 0.3,
    "T_ci_qw": 0.5,
    "T_ci_qx": -0.5,
    "T_ci_qy": 0.5,
    "T_ci_qz": -0.5,
}
FEATURE = "vision_feature,1000.05,1,7,,,,,,,0.25,-0.5,,"


def lines():
    meta = [f"meta,,,,,,,,,,,,{key},{value}" for key, value in META.items()]
    imu = [f"imu,{1000.0 + 0.005 * k:.3f},,,0,0,0.1,0,0,9.81,,,," for k in range(40)]
    first = ["vision_feature,1000.00,0,7,,,,,,,0.2,-0.5,,", "vision_feature,1000.00,0,9,,,,,,,0.1,0.1,,"]
    return [HEADER, *meta, *imu, *first, FEATURE]


def opened(tmp_path, rows):
    (tmp_path / "tracks.csv").write_text("\n".join(rows) + "\n")
    return ekfslam.open_sequence(tmp_path / "tracks.csv")


def test_tracks_samples_and_calibration_are_read(tmp_path):
    sequence = opened(tmp_path, lines())
    ids, pixels = sequence.observations.at(1)
    assert sequence.camera.is_monocular and ids.tolist() == [7]
    np.testing.assert_allclose(pixels, [[320.0 + 400.0 * 0.25, 240.0 - 410.0 * 0.5]])
    np.testing.assert_allclose(sequence.time_s, [1000.0, 1000.05])
    assert len(sequence.inertial.time_s) == 40 and sequence.inertial.noise is None
    # The optical axis is ahead, x of the body; the camera is at (0.1, 0.2, 0.3).
    np.testing.assert_allclose(np.linalg.inv(sequence.T_cam_imu)[:3, 2:], [[1, 0.1], [0, 0.2], [0, 0.3]], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (lambda rows: [row for row in rows if "camera_fy" not in row], CalibrationError, "camera_fy"),
        (lambda rows: [row.replace("T_ci_qw,0.5", "T_ci_qw,0.9") for row in rows], CalibrationError, "quaternion"),
        (lambda rows: [*rows, FEATURE.replace("1000.05", "1000.06")], StampError, "same frame"),
        (lambda rows: [*rows, FEATURE.replace("1000.05,1", "999.9,2")], StampError, "increase"),
        (lambda rows: [*rows, FEATURE.replace("0.25", "x")], LineError, r"line\[56\]"),
        (lambda rows: [*rows, "imu,1000"], LineError, "2 columns"),
        (lambda rows: [row.replace("landmark_id", "id") for row in rows], LineError, "landmark_id"),
    ],
)
def test_a_damaged_file_is_named_with_its_place(tmp_path, change, error, words):
    with pytest.raises(error, match=words):
        opened(tmp_path, change(lines()))


def test_another_csv_is_not_taken_for_one(tmp_path):
    with pytest.raises(UnknownFormatError):
        opened(tmp_path, ["time,x", "0,1"])
