"""From images to a map: the front end on a rendered world whose geometry is known, and its parts by themselves."""

import dataclasses
import sys

import numpy as np
import pytest
from PIL import Image

import ekfslam
from ekfslam import open_images
from ekfslam.config import Config, FrontEndConfig
from ekfslam.data.images import Distortion, PairCalibration
from ekfslam.errors import CalibrationError, EmptyTracksError, MissingPackageError, NoVelocitiesError
from ekfslam.evaluation.summary import summarise
from ekfslam.figures.tracks import plot_tracks
from ekfslam.frontend.rectify import rectification
from ekfslam.frontend.rotation import RightRotation, correction
from ekfslam.frontend.track import track
from ekfslam.geometry import lens, se3
from ekfslam.geometry.camera import StereoCamera, project
from ekfslam.geometry.stereo_motion import agrees, align, linearise, sampled_motion
from ekfslam.resolve import resolve
from ekfslam.runner import run

cv2 = pytest.importorskip("cv2")

from support.rendered import BASELINE_M, SIZE, calibrated, drive, first_hits, recording, write_kitti  # noqa: E402

CAMERA = StereoCamera(300.0, 300.0, 199.5, 99.5, BASELINE_M)
ROTATION_RAD = np.deg2rad([0.10, -0.08, 0.06])


@pytest.fixture(scope="module")
def room():
    """Forty frames through distorted, unequal lenses, the right one rotated against its calibration."""
    return recording(40, distorted=True, rotation_rad=ROTATION_RAD)


@pytest.fixture(scope="module")
def tracked(room):
    return track(room)


def first(room, frames):
    truth = dataclasses.replace(
        room.truth, frame=room.truth.frame[:frames], T_world_imu=room.truth.T_world_imu[:frames]
    )
    return dataclasses.replace(room, time_s=room.time_s[:frames], truth=truth)


# --- the whole way ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_rotation_of_the_right_camera_is_found(tracked):
    sequence, report = tracked
    # Pixels of a camera that turns by psi move by minus the correction; pitch is about x, yaw about y, roll about z.
    expected = sequence.camera.fu_px * ROTATION_RAD * (1.0, -1.0, -1.0)
    assert np.abs(expected).min() > 0.3
    assert np.abs(report.rotation_px[-1] - expected).max() < 0.1
    assert (report.rotation_std_px[-1] < 0.5 * report.rotation_std_px[0]).all()


@pytest.mark.slow
def test_from_images_to_poses_without_velocities(tracked):
    sequence, _ = tracked
    assert not sequence.has_velocities
    result = run(sequence, "full", Config().with_overrides({"filter": {"relative_frames": 10}}))
    found = summarise(sequence, result)
    assert found["ate_m"] < 0.12 and found["ate_aligned_m"] < 0.06  # of 20 m
    assert 1.0 < found["pose_nees_mean"] < 12.0
    assert 0.5 < found["pose_nees_relative_10_mean"] < 8.0
    assert found["rejected"] < 0.03 * found["accepted"]  # features on the edges of the pillar slide
    mapping = summarise(sequence, run(sequence, "mapping-only"))
    assert mapping["ate_m"] < 0.15
    with pytest.raises(NoVelocitiesError, match="room: no measured velocities"):
        run(sequence, "dead-reckoning")


def errors_of_tracks(sequence):
    """Errors (n, 3) in u, v and disparity of each track with four observations, and ways over depths (n - 1,).

    The true point is the first one on the ray of the first observation.
    """
    observations, camera, found = sequence.observations, sequence.camera, []
    T_cam_world = sequence.T_cam_imu @ se3.inverse(sequence.truth.T_world_imu)
    T_world_cam = se3.inverse(T_cam_world)
    for landmark in observations.ids:
        which = observations.landmark == landmark
        frames, pixels = observations.frame[which], observations.pixels_px[which]
        if len(frames) < 4 or np.ptp(frames) >= len(frames):
            continue
        u, v = pixels[0, :2]
        ray = T_world_cam[frames[0], :3, :3] @ [(u - camera.cu_px) / camera.fu_px, (v - camera.cv_px) / camera.fv_px, 1]
        origin = T_world_cam[frames[0], :3, 3]
        q = se3.apply(T_cam_world[frames], origin + first_hits(origin, ray[None])[0] * ray)
        off = pixels - project(camera, q)
        way = np.linalg.norm(np.diff(T_world_cam[frames, :3, 3], axis=0), axis=1)
        found.append((np.column_stack([off[:, 0], off[:, 1], off[:, 0] - off[:, 2]]), way / q[1:, 2]))
    return found


@pytest.mark.slow
def test_errors_of_tracks_are_as_large_as_stated_near_and_far(tracked):
    """Spread by medians of the change over three frames, in stated standard deviations.

    Medians, because few tracks follow an edge of the pillar. Those of near tracks are an eighth of what is
    stated, which allows for surfaces that are not flat.
    """
    sequence, _ = tracked
    error = resolve(sequence).model.track_error
    far, near, spread_px = [], [], ([], [])
    for e, parallax in errors_of_tracks(sequence):
        variance = error.step_variance(np.zeros((len(parallax), 3)), parallax)
        for k in range(len(parallax) - 2):
            is_near = parallax[k : k + 3].mean() > 0.06
            change = e[k + 3] - e[k]
            (near if is_near else far).append(change / np.sqrt(variance[k : k + 3].sum(axis=0)))
            spread_px[int(is_near)].append(change)
    for stated in (far, near):
        assert len(stated) > 100
        spread = 1.4826 * np.median(np.abs(stated), axis=0)
        assert (spread > 0.1).all() and (spread < 1.3).all(), spread
    assert np.median(np.abs(spread_px[1])) > 2.0 * np.median(np.abs(spread_px[0]))


@pytest.mark.slow
def test_without_self_calibration_poses_are_worse(room, tracked):
    fixed, _ = track(room, FrontEndConfig(rotation_deg=1e-6))
    calibrated_m, fixed_m = (summarise(data, run(data, "mapping-only"))["ate_m"] for data in (tracked[0], fixed))
    assert fixed_m > 2.0 * calibrated_m


@pytest.mark.slow
def test_tracks_do_not_depend_on_the_run_nor_much_on_the_prediction(room):
    some = first(room, 6)
    (one, report), (two, _) = track(some), track(some)
    for name in ("frame", "landmark", "pixels_px"):
        np.testing.assert_array_equal(getattr(one.observations, name), getattr(two.observations, name))
    assert report.observations == len(one.observations)
    alive = report.tracks + report.single - sum(report.losses.values())
    assert len(one.observations.at(5)[0]) <= alive <= FrontEndConfig().features
    moving = dataclasses.replace(some, twist=drive(6))
    wrong = dataclasses.replace(some, twist=-5.0 * drive(6))
    right = track(moving)[0]
    np.testing.assert_array_equal(right.twist, drive(6))
    assert len(track(wrong)[0].observations) > 0.8 * len(right.observations)


@pytest.mark.slow
def test_report_and_picture_say_what_became_of_the_tracks(room, tracked):
    sequence, report = tracked
    assert report.tracks == len(sequence.observations.ids) and report.lengths.min() >= 2
    assert f"{report.tracks} tracks" in report.lines[0] and "out of the left image" in report.lines[1]
    assert set(report.lines) <= set(sequence.notes)
    figure = plot_tracks(room, sequence, report)
    assert len(figure.axes) == 3 + 1 + 3
    assert len(figure.axes[0].collections[1].get_offsets()) == len(sequence.observations.at(8)[0])


# --- what cannot be tracked -------------------------------------------------------------------------------------------


def test_images_without_features_are_named(room):
    black = np.zeros((SIZE[1], SIZE[0]), dtype=np.uint8)
    with pytest.raises(EmptyTracksError, match="no feature is seen in both images"):
        track(dataclasses.replace(first(room, 3), load=lambda k: (black, black)))


def test_without_opencv_the_extra_is_named(room, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'ekfslam\[images\]'"):
        track(first(room, 2))


def test_swapped_cameras_are_named():
    calibration = calibrated(distorted=True)
    swapped = dataclasses.replace(calibration, T_right_left=se3.inverse(calibration.T_right_left))
    with pytest.raises(CalibrationError, match="swapped"):
        rectification(swapped)


# --- parts ------------------------------------------------------------------------------------------------------------


def test_lenses_are_those_of_opencv():
    rng = np.random.default_rng(0)
    xy = rng.uniform(-0.8, 0.8, (50, 2))
    points = np.concatenate([xy, np.ones((50, 1))], axis=1)
    zero = np.zeros(3)
    for count in (4, 5, 8):
        k = rng.uniform(-0.05, 0.05, count)
        expected = cv2.projectPoints(points, zero, zero, np.eye(3), k)[0].reshape(-1, 2)
        np.testing.assert_allclose(lens.radtan(xy, k), expected, atol=1e-12)
    k = rng.uniform(-0.05, 0.05, 4)
    expected = cv2.fisheye.projectPoints(points[:, None], zero, zero, np.eye(3), k)[0].reshape(-1, 2)
    np.testing.assert_allclose(lens.equidistant(xy, k), expected, atol=1e-12)
    assert (lens.equidistant(np.zeros((1, 2)), k) == 0).all()


def test_rectified_cameras_see_points_in_the_same_row():
    calibration = calibrated(distorted=True)
    rectified = rectification(calibration)
    lengths = np.diagonal([calibration.K_left[:2, :2], calibration.K_right[:2, :2]], axis1=1, axis2=2)
    assert rectified.camera.fu_px == rectified.camera.fv_px == pytest.approx(lengths.mean())
    assert np.ptp(lengths) > 0 and np.ptp(lengths[:, 0]) != np.ptp(lengths[:, 1])
    rng = np.random.default_rng(1)
    q = rng.uniform((-2.0, -1.0, 4.0), (2.0, 1.0, 9.0), (40, 3))  # in the left camera
    z = project(rectified.camera, se3.apply(rectified.T_rectified_left, q))
    sides = (
        (q, calibration.K_left, calibration.distortion_left, z[:, :2]),
        (se3.apply(calibration.T_right_left, q), calibration.K_right, calibration.distortion_right, z[:, 2:]),
    )
    for (points, K, distortion, pixels), read in zip(sides, rectified.maps, strict=True):
        model = {"radtan": lens.radtan, "equidistant": lens.equidistant}[distortion.model]
        xy = model(points[:, :2] / points[:, 2:], distortion.coefficients)
        seen = xy @ K[:2, :2].T + K[:2, 2]
        inside = ((pixels > 1) & (pixels < np.array(SIZE) - 2)).all(axis=1)
        assert inside.sum() > 20
        u, v = pixels[inside].T.astype(np.float32)
        found = np.stack([cv2.remap(read[..., i], u, v, cv2.INTER_LINEAR).ravel() for i in (0, 1)], axis=1)
        np.testing.assert_allclose(found, seen[inside], atol=0.03)
    assert rectification(calibrated(distorted=False)).maps is None


def pairs(rng, count, T, std=0.0):
    """Rows of points before and after a motion."""
    q = rng.uniform((-8.0, -2.0, 5.0), (8.0, 2.0, 30.0), (count, 3))
    rows = [project(CAMERA, p)[:, :3] for p in (q, se3.apply(T, q))]
    return [row + std * rng.standard_normal(row.shape) for row in rows]


def test_motion_is_exact_and_robust():
    rng, T = np.random.default_rng(2), se3.exp(np.array([0.05, -0.1, -1.1, 0.01, -0.04, 0.02]))
    before, now = pairs(rng, 40, T)
    np.testing.assert_allclose(align(CAMERA, before, now, np.eye(4)).T_now_before, T, atol=1e-6)
    wrong = rng.random(40) < 0.4
    now[wrong] += rng.uniform(10.0, 40.0, (wrong.sum(), 3))
    start = sampled_motion(CAMERA, before, now, rng, 200, 2.0)
    found = align(CAMERA, before, now, start)
    np.testing.assert_allclose(found.T_now_before, T, atol=1e-3)
    np.testing.assert_array_equal(agrees(found, 2.0), ~wrong)
    assert (sampled_motion(CAMERA, before[:2], now[:2], rng, 10, 2.0) == np.eye(4)).all()


@pytest.mark.parametrize("angle", [1e-3, 0.4, 3.0])
def test_derivatives_and_weights_of_an_alignment_are_right(angle):
    rng, h = np.random.default_rng(5), 1e-6
    turn = se3.transform(se3.so3_exp(np.array([0.1, angle, -0.05])), np.array([2.0, -1.0, 45.0]))
    before, now = pairs(rng, 12, turn, std=1.0)
    before[:, 2] = np.minimum(before[:, 2], before[:, 0] - 3.0)

    def found(T=turn, true_px=before):
        return linearise(CAMERA, true_px, now, T, true_px, 0.2, 2.0)

    for j, step in enumerate(h * np.eye(6)):
        ahead, back = (found(se3.exp(sign * step) @ turn).residual_px for sign in (1.0, -1.0))
        np.testing.assert_allclose(found().H[..., j], (back - ahead) / (2 * h), rtol=1e-5, atol=1e-3)
    for j, step in enumerate(h * np.eye(3)):
        ahead, back = (found(true_px=before + sign * step).residual_px for sign in (1.0, -1.0))
        np.testing.assert_allclose(found().B[..., j], (back - ahead) / (2 * h), rtol=1e-4, atol=1e-4)
    B, W = found().B, found().W
    k = np.array([0.0, 0.0, 1.0]) - B[..., 2]
    S = 0.2**2 * (np.eye(3) + B @ np.swapaxes(B, 1, 2)) + 0.3**2 * k[..., None] * k[:, None]
    weight = (W @ S)[:, :1, :1]
    np.testing.assert_allclose(W @ S, weight * np.eye(3), atol=1e-8)
    information = sum(H.T @ w @ H for H, w in zip(found().H, W, strict=True))
    np.testing.assert_allclose(found().information, information, rtol=1e-10)


@pytest.mark.parametrize("std", [0.0, 0.2])
def test_yaw_is_found_from_motion_alone(std):
    rng, T = np.random.default_rng(3), se3.exp(np.array([0.05, -0.1, -1.5, 0.01, -0.04, 0.02]))
    rotation = RightRotation(CAMERA, np.deg2rad(0.5), 0.2)
    yaw = np.array([0.0, 0.6, 0.0])

    def corrected(rows, vector):
        right = rows[:, [2, 1]]
        return np.stack([rows[:, 0], rows[:, 1], rows[:, 2] + correction(CAMERA, vector, right)[:, 0]], axis=1)

    for _ in range(60):
        rows = [corrected(row, -yaw) for row in pairs(rng, 80, T, std)]
        before, now = (corrected(row, np.array([0.0, rotation.yaw, 0.0])) for row in rows)
        rotation.observe_motion(align(CAMERA, before, now, T), before, now)
    assert rotation.yaw == pytest.approx(0.6, abs=0.03)
    assert rotation.std[1] < 0.2


def test_a_former_setting_is_accepted_with_a_note():
    with pytest.warns(UserWarning, match=r"front_end\.window is ignored: it is a constant"):
        assert ekfslam.Config().with_overrides({"front_end": {"window": 14}}) == ekfslam.Config()


def test_settings_break_no_rule_and_are_kept(room):
    with pytest.raises(ekfslam.EkfslamError, match=r"front_end\.levels must be"):
        ekfslam.Config().with_overrides({"front_end": {"levels": 9}})
    sequence, _ = track(first(room, 2), FrontEndConfig(features=40))
    assert sequence.attributes["front_end_features"] == 40
    assert len(sequence.observations) <= 80


def test_a_lens_needs_its_coefficients():
    with pytest.raises(CalibrationError, match="equidistant has 4 coefficients, found 2"):
        Distortion("equidistant", (0.1, 0.2))
    with pytest.raises(CalibrationError, match="at the same place"):
        PairCalibration(np.eye(3), np.eye(3), (4, 4), np.eye(4))


# --- folders of KITTI odometry ----------------------------------------------------------------------------------------


@pytest.fixture
def folder(room, tmp_path):
    """Three frames as the benchmark stores them; the pixels need not be rectified to be read."""
    return write_kitti(room, 3, tmp_path / "sequence")


def test_a_folder_of_kitti_odometry_is_read(folder, room):
    found = open_images(folder)
    assert found.calibration.is_rectified and found.calibration.size == SIZE and len(found) == 3
    assert found.calibration.T_right_left[0, 3] == pytest.approx(-BASELINE_M)
    for got, want in zip(found.load(2), room.load(2), strict=True):
        np.testing.assert_array_equal(got, want)
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n0.3\n")
    assert any("first 3 of 4" in note for note in open_images(folder).notes)
    for name in ("image_0", "image_1"):
        (folder / name).rename(folder / f"image_{int(name[-1]) + 2}")
    P = "300 0 199.5 {} 0 300 99.5 0.2 0 0 1 0.003"
    (folder / "calib.txt").write_text(f"P2: {P.format(20)}\nP3: {P.format(20 - 300 * BASELINE_M)}\n")
    colour = open_images(folder)
    assert colour.attributes["images"] == "image_2 image_3"
    of_gray = "True poses of the benchmark are of the left gray camera"
    assert [any(note.startswith(of_gray) for note in images.notes) for images in (found, colour)] == [False, True]
    assert colour.calibration.T_right_left[0, 3] == pytest.approx(-BASELINE_M)


@pytest.mark.slow
def test_every_command_takes_a_folder(folder, tmp_path, capsys):
    from ekfslam.cli import main

    assert ekfslam.open_sequence(folder).attributes["images"] == "image_0 image_1"
    out = tmp_path / "tracks.h5"
    assert main(["track", str(folder), "--features", "40", "--out", str(out)]) == 0
    assert "tracks with" in capsys.readouterr().out
    assert out.with_suffix(".png").exists()
    again = ekfslam.open_sequence(out)
    assert not again.has_velocities and again.has_checked_tracks and again.attributes["front_end_features"] == 40
    assert main(["info", str(folder)]) == 0
    assert "motion is a random walk started by stereo odometry" in capsys.readouterr().out
    assert main(["run", str(out), "--mode", "dead-reckoning", "--out", str(tmp_path / "run.h5")]) == 2
    assert "no measured velocities" in capsys.readouterr().err


def _truncate(path):
    path.write_bytes(path.read_bytes()[:200])


BROKEN = {
    "no stamps": (lambda f: (f / "times.txt").unlink(), "times.txt"),
    "few stamps": (lambda f: (f / "times.txt").write_text("0.0\n0.1\n"), "3 images, but 2 stamps"),
    "stamps back": (lambda f: (f / "times.txt").write_text("0.0\n0.2\n0.1\n"), "is before"),
    "word": (lambda f: (f / "times.txt").write_text("0.0\nhalf\n0.1\n"), "half"),
    "gap": (lambda f: (f / "image_0" / "000001.png").unlink(), "image 000001 is missing"),
    "one side": (lambda f: (f / "image_1" / "000002.png").unlink(), "image 000002 is missing"),
    "no images": (lambda f: [path.unlink() for path in (f / "image_0").iterdir()], "there are no images"),
    "one camera": (
        lambda f: (f / "calib.txt").write_text("P0: 300 0 9 0 0 300 9 0 0 0 1 0\n"),
        "P1: this key is missing",
    ),
    "few numbers": (lambda f: (f / "calib.txt").write_text("P0: 300 0\n"), "2 values, expected 12"),
    "swapped": (
        lambda f: (f / "calib.txt").write_text("P0: 300 0 9 0 0 300 9 0 0 0 1 0\nP1: 300 0 9 90 0 300 9 0 0 0 1 0\n"),
        "not to the right",
    ),
    "unequal": (
        lambda f: (f / "calib.txt").write_text("P0: 300 0 9 0 0 300 9 0 0 0 1 0\nP1: 310 0 9 -90 0 300 9 0 0 0 1 0\n"),
        "not rectified",
    ),
    "size": (lambda f: Image.new("L", (30, 20)).save(f / "image_1" / "000001.png"), "30 x 20 pixels"),
    "damaged": (lambda f: _truncate(f / "image_0" / "000001.png"), "not a readable image"),
    "no image": (lambda f: (f / "image_0" / "000000.png").write_text("hello"), "not a readable image"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_folder_is_named(folder, name):
    spoil, message = BROKEN[name]
    spoil(folder)
    with pytest.raises(ekfslam.EkfslamError, match=message) as error:
        ekfslam.open_sequence(folder)
    assert str(folder) in str(error.value)
