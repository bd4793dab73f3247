"""Errors that all landmarks of a frame share: jitter of the camera, drift of vision, rotation of the right camera.

`literal_rows` is the model written down once more, landmark by landmark; it shares nothing with the package but `se3`.
"""

import dataclasses

import numpy as np
import pytest
from support.jacobians import POSES, Seen, central, see, visible_points
from support.literal import (
    BY_DISPARITY,
    EVERYTHING,
    OPEN,
    P0,
    TILTED,
    TRACKS,
    Literal,
    filter_of,
    gauge_information,
    in_level_frame,
    side_by_side,
)
from support.reference import CAMERA, T_CAM_IMU, small_world
from support.running import WHOLE, seeds

from ekfslam.config import FilterConfig
from ekfslam.data.sequence import Noise, Observations
from ekfslam.data.simulate import builtin
from ekfslam.errors import ConfigError
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.filters.observing import moment, observe
from ekfslam.geometry import se3
from ekfslam.models.blocks import CameraJitter, TwistBias, VisionDrift
from ekfslam.models.blocks.calibration import prior_std
from ekfslam.models.build import model_of
from ekfslam.models.observer import Moment
from ekfslam.models.sensors.stereo import Rig
from ekfslam.smoother.problem import BatchProblem

NOISE = Noise(
    np.repeat([0.3, 0.05], 3),
    np.array([0.7, 0.9, 1.1, 1.3]),
    twist_walk_std=np.repeat([0.2, 0.02], 3),
    motion_std=np.repeat([0.05, 0.01], 3),
    tilt_rad=0.05,
)
KINDS = {"tracks": dataclasses.replace(NOISE, **TRACKS), "white": NOISE}
BIAS = TwistBias(sigma_v_m_s=0.1, sigma_w_rad_s=0.01, time_v_s=3.0, time_w_s=7.0)
SHARED = [CameraJitter(), VisionDrift(length_m=20.0)]
BLOCKS = [*SHARED, BIAS]
ERRORS = {
    "calibration": np.array([0.05, -0.08, 0.06, 0.02, -0.03, 0.025, 0.03, 0.7, 0.03]),
    "camera_jitter": np.array([0.04, -0.03, 0.05, 0.02, -0.01, 0.015]),
    "vision_drift": np.array([0.02, 0.03, -0.01, 0.004, 0.003, -0.005]),
}
TWIST = np.array([7.0, 0.4, -0.3, 0.1, -0.2, 0.5])
LEAST_WAY_M = 0.1
poses = pytest.mark.parametrize("T", POSES.values(), ids=POSES.keys())
kinds = pytest.mark.parametrize("noise", KINDS.values(), ids=KINDS.keys())


def pixel(q):
    return np.array([CAMERA.fu_px * q[0] / q[2] + CAMERA.cu_px, CAMERA.fv_px * q[1] / q[2] + CAMERA.cv_px])


def literal_camera(values, way_m, follows, twist):
    """The camera in world (4, 4)."""
    c, offset = values["calibration"], values["camera_jitter"]
    if follows:
        offset = offset + max(way_m, LEAST_WAY_M) * values["vision_drift"]
    return se3.exp(c[:6]) @ T_CAM_IMU @ se3.exp(-c[8] * twist) @ se3.exp(offset) @ values["pose"]


def literal_rows(values, m, way_m, follows, twist, before=False, disparity=True):
    """Rows (n, 3) of landmarks (n, 3), those that follow another observation with the drift; or in the view before."""
    c, rows = values["calibration"], []
    right_of_both = NOISE.pixel_std_px[1] ** 2 / (NOISE.pixel_std_px[1] ** 2 + NOISE.pixel_std_px[3] ** 2)
    for point, follows_one in zip(m, follows, strict=True):
        W = values["previous_view"] if before else literal_camera(values, way_m, follows_one, twist)
        q = se3.apply(W, point)
        baseline = np.array([CAMERA.baseline_m * np.exp(c[6]), 0.0, 0.0])
        left, right = pixel(q), pixel(q - baseline)
        v = (1 - right_of_both) * left[1] + right_of_both * right[1]
        rows.append([left[0], v, left[0] - right[0] + c[7] if disparity else right[0] - c[7]])
    return np.array(rows)


def everything(T, noise, blocks=BLOCKS):
    """The model with every block, and values of it of which none is zero."""
    model = model_of(Rig(CAMERA, T_CAM_IMU, noise), noise, T, P0, EVERYTHING, blocks)
    W_before = T_CAM_IMU @ se3.exp(np.array([0.6, 0.1, -0.05, 0.01, 0.02, -0.05])) @ T
    values = {**model.initial_values(), "previous_view": W_before, "pose": T, **ERRORS}
    return model, {name: value for name, value in values.items() if name in model.layout}


def moment_of(model, values, way_m):
    shared = {block.name: values[block.name] for block in model.observer.shared}
    return Moment(values["pose"], values["pose"], values["calibration"], TWIST, shared, np.array(way_m))


@pytest.mark.parametrize("way_m", [1.7, 0.03])
@pytest.mark.parametrize("twist", [np.zeros(6), TWIST], ids=["at rest", "driving"])
@poses
def test_the_camera_in_world_by_every_block(T, twist, way_m):
    """Of single observations and of differences: with jitter, drift, extrinsic calibration and time offset."""
    model, values = everything(T, KINDS["tracks"])
    body = model.layout.body
    moment = dataclasses.replace(moment_of(model, values, way_m), twist=twist)
    cameras = model.observer.cameras(moment)
    for kind in (0, 1):
        W = cameras.T_cam_imu[kind] @ T
        np.testing.assert_allclose(W, literal_camera(values, way_m, kind, twist), atol=1e-12 * np.abs(W).max())

        def error(x, kind=kind, W=W):
            return se3.log(literal_camera(model.retract(values, x), way_m, kind, twist) @ se3.inverse(W))

        Y = np.pad(cameras.by[kind], ((0, 0), (0, body - model.layout.seen)))
        numeric = central(error, body)
        np.testing.assert_allclose(Y, numeric, rtol=1e-6, atol=1e-7 * np.abs(numeric).max())
        names = ["pose", "camera_jitter", "calibration", *(["vision_drift"] if kind else [])]
        assert [name for name in model.layout if np.abs(Y[:, model.layout[name]]).max() > 0] == [
            name for name in model.layout if name in names
        ]


def wide(seen, body, slots, landmarks):
    """H (3k, body+3n) by all blocks and landmarks."""
    k, _, width = seen.H_x.shape
    H = np.zeros((k, 3, body + 3 * landmarks))
    H[..., :width] = seen.H_x
    for i, slot in enumerate(slots):
        H[i, :, body + 3 * slot : body + 3 * slot + 3] = seen.H_m[i]
    return H.reshape(3 * k, -1)


def assert_equal_rows(ours, numeric):
    np.testing.assert_allclose(ours, numeric, rtol=1e-5, atol=1e-6 * np.abs(numeric).max())


@pytest.mark.parametrize(
    ("follows", "way_m"),
    [(follows, way_m) for follows in ("some", "all", "none") for way_m in (1.7, 0.03)]
    if WHOLE
    else [("some", 1.7), ("all", 0.03), ("none", 1.7)],
)
@kinds
@poses
def test_rows_by_every_block_and_landmark(T, noise, follows, way_m):
    model, values = everything(T, noise)
    m, slots = visible_points(T, 6), np.array([4, 1, 5, 2])
    is_difference = {"some": np.array([True, False, True, False]), "all": np.ones(4, bool), "none": np.zeros(4, bool)}
    body, follow, disparity = model.layout.body, is_difference[follows], noise.track_error is not None

    def rows(x):
        points = (m + x[body:].reshape(-1, 3))[slots]
        moved = {**ERRORS, **model.retract(values, x[:body])}
        return literal_rows(moved, points, way_m, follow, TWIST, disparity=disparity).ravel()

    seen = see(model.observer, moment_of(model, values, way_m), m[slots], m[slots], follow)
    nothing = np.zeros(body + 3 * len(m))
    np.testing.assert_allclose(seen.z.ravel(), rows(nothing), rtol=1e-11)
    H = wide(seen, body, slots, len(m))
    assert_equal_rows(H, central(rows, len(nothing)))
    drift = H[:, model.layout["vision_drift"]].reshape(4, 3, 6)
    assert (np.abs(drift).max(axis=(1, 2)) > 0).tolist() == follow.tolist()


@poses
def test_rows_in_the_view_before_by_every_block_and_landmark(T):
    model, values = everything(T, KINDS["tracks"])
    m, slots, body = visible_points(T, 5), np.array([3, 0, 4]), model.layout.body
    none = np.zeros(3, dtype=bool)

    def rows(x):
        points = (m + x[body:].reshape(-1, 3))[slots]
        return literal_rows(model.retract(values, x[:body]), points, 1.7, none, TWIST, before=True).ravel()

    by = np.zeros((6, model.layout.seen))
    by[:, model.layout["previous_view"]] = np.eye(6)
    sight = model.observer.project(values["calibration"], values["previous_view"], m[slots])
    np.testing.assert_allclose(sight.z.ravel(), rows(np.zeros(body + 15)), rtol=1e-11)
    seen = Seen(sight.q, sight.z, model.observer.by_body(sight, by), sight.H_m)
    H = wide(seen, body, slots, len(m))
    assert_equal_rows(H, central(rows, body + 15))
    for name in ("pose", "camera_jitter", "vision_drift", "view"):
        assert not H[:, model.layout[name]].any()


@poses
def test_observations_of_the_filter_by_every_block_and_landmark(T):
    """Some landmarks are seen again in the next frame, some after a gap, some not at all; the first one is not."""
    model, values = everything(T, KINDS["tracks"])
    ekf = JointEKF(model, OPEN)
    ids, m = np.array([40, 3, 17, 99, 8, 21]), visible_points(T, 6)
    zero = {name: np.zeros_like(value) for name, value in ERRORS.items()}

    def pixels(which):
        rows = literal_rows({**zero, "pose": ekf.T_imu_world}, m[which], 0.0, np.zeros(len(which)), TWIST)
        return np.column_stack([rows[:, :2], rows[:, 0] - rows[:, 2], rows[:, 1]])

    ekf.begin(TWIST)
    ekf.update(0, ids, pixels(np.arange(6)))
    ekf.predict(TWIST, 0.02)
    ekf.update(1, ids[[5, 0, 2, 4]], pixels([5, 0, 2, 4]) + 0.3)
    ekf.predict(1.1 * TWIST, 0.03)
    # Wherever all blocks may be.
    ekf.values = {**ekf.values, **{name: ERRORS[name] for name in ERRORS}}
    ekf.values["pose"] = se3.exp(np.array([0.02, -0.03, 0.01, 0.01, 0.02, -0.01])) @ ekf.values["pose"]
    slots, body, values = np.array([4, 1, 5, 3, 2]), model.layout.body, ekf.values
    follows = ekf.table.last_step[slots] == ekf.step - 1
    assert follows.tolist() == [True, False, True, False, True]
    before, way_m = ekf.table.seen_rows[slots], 0.03 * 1.1 * np.linalg.norm(TWIST[:3])
    measured = before + np.array([3.0, -1.0, 0.5])

    def residual(x):
        moved, points = model.retract(values, x[:body]), (ekf.positions_m + x[body:].reshape(-1, 3))[slots]
        now = measured - literal_rows(moved, points, way_m, follows, ekf.imu_twist)
        last = before - literal_rows(moved, points, way_m, follows, None, before=True)
        return (now - follows[:, None] * last).ravel()

    _, rows = observe(ekf, ekf.mean, slots, measured)
    size = body + 18
    np.testing.assert_allclose(rows.residual.ravel(), residual(np.zeros(size)), atol=1e-8)
    assert_equal_rows(wide(rows, body, rows.slot, 6), -central(residual, size))


def new_landmarks(model, moment, z, variance):
    observer, camera = model.observer, model.observer.camera(moment)
    W, q = camera.T_cam_imu @ moment.T_imu_world, observer.inverted(moment.calibration, z)[0]
    return observer.initialise(moment.calibration, W, W, camera.by, q, variance)


@kinds
@poses
def test_new_landmarks_by_every_block(T, noise):
    """What was seen stays as it is, whatever the blocks are; the rest is the noise of the sight."""
    model, values = everything(T, noise)
    m, body, none = visible_points(T, 4), model.layout.body, np.zeros(4, dtype=bool)
    disparity, variance = noise.track_error is not None, np.array([[0.5, 0.3, 0.7]]) * np.arange(1, 5)[:, None]
    moment = moment_of(model, values, 1.7)
    z = literal_rows({**ERRORS, **values}, m, 1.7, none, TWIST, disparity=disparity) + np.array([0.5, -0.2, 0.3])
    positions, G, covariance = new_landmarks(model, moment, z, variance)
    seen = literal_rows({**ERRORS, **values}, positions, 1.7, none, TWIST, disparity=disparity)
    np.testing.assert_allclose(seen, z, atol=1e-9)

    def started(x):
        return new_landmarks(model, moment_of(model, model.retract(values, x), 1.7), z, variance)[0].ravel()

    full = np.zeros((12, body))
    full[:, : model.layout.seen] = G.reshape(12, -1)
    assert_equal_rows(full, central(started, body))
    for i in range(4):
        by_row = central(lambda d, i=i: new_landmarks(model, moment, z + d, variance)[0][i], 3)
        expected = by_row @ np.diag(variance[i]) @ by_row.T
        np.testing.assert_allclose(covariance[i], expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    assert model.observer.inverted(moment.calibration, z)[1].all()


# --- the model ------------------------------------------------------------------------------------------------------


def test_which_models_have_views():
    def views(noise, coordinates):
        rig = Rig(CAMERA, T_CAM_IMU, noise)
        return model_of(rig, noise, np.eye(4), P0, blocks=SHARED, coordinates=coordinates).layout.views

    assert views(KINDS["tracks"], "xyz") == views(NOISE, "image") == ("view", "previous_view")
    assert views(NOISE, "xyz") == ()
    with pytest.raises(ConfigError, match=r"there twice: .*camera_jitter"):
        model_of(Rig(CAMERA, T_CAM_IMU, NOISE), NOISE, np.eye(4), P0, blocks=[*SHARED, CameraJitter()])


def test_views_of_a_prediction():
    """The view before is the view; the view is the camera of the blocks, which wander on."""
    model, _ = everything(np.eye(4), KINDS["tracks"])
    config = dataclasses.replace(OPEN, engine="reference")  # whose values may be set
    ekf, rng, layout = JointEKF(model, config), np.random.default_rng(0), model.layout
    root = rng.normal(size=(layout.body, layout.body))
    P = root @ root.T
    ekf.P = P.copy()
    values = {name: ERRORS[name] for name in ("camera_jitter", "vision_drift", "calibration")}
    ekf.values = {**ekf.values, **values, "view": se3.exp(0.1 * TWIST) @ T_CAM_IMU}
    before = ekf.values
    ekf.predict(TWIST, 0.2)
    way_m = 0.2 * np.linalg.norm(TWIST[:3])
    assert ekf.motion.way_m == pytest.approx(way_m)
    kept = {"camera_jitter": 0.2 / 0.6, "vision_drift": way_m / 20.0}
    view, last = layout["view"], layout["previous_view"]
    np.testing.assert_array_equal(ekf.values["previous_view"], before["view"])
    np.testing.assert_allclose(ekf.P[last, last], P[view, view])
    for block in SHARED:
        at, phi = layout[block.name], np.exp(-kept[block.name])
        own, std = P[at, at], block.stationary_std
        np.testing.assert_allclose(ekf.values[block.name], phi * before[block.name])
        np.testing.assert_allclose(ekf.P[at, at], phi**2 * own + np.diag(std**2 * (1 - phi**2)))
        np.testing.assert_allclose(ekf.P[at, last], phi * P[at, view])
    np.testing.assert_allclose(ekf.values["view"], literal_camera(ekf.values, way_m, False, ekf.imu_twist), atol=1e-12)
    Y = np.zeros((6, layout.body))
    Y[:, : layout.seen] = model.observer.camera(moment(ekf, ekf.mean)).by
    np.testing.assert_allclose(ekf.P[view], Y @ ekf.P, atol=1e-9 * np.abs(ekf.P).max())


@pytest.mark.parametrize("blocks", [[], SHARED], ids=["up and calibration", "shared errors, too"])
@pytest.mark.parametrize("tracks", [TRACKS, {}], ids=["tracks", "white"])
@pytest.mark.parametrize("coordinates", ["xyz", "image"])
@pytest.mark.parametrize("variant", ["invariant", "fej", "standard"])
def test_information_about_the_gauge_with_everything(variant, coordinates, tracks, blocks):
    """Velocities taken as exact: not the least is gained or lost, but by the standard variant."""
    world = small_world(seed=4, frames=60 if WHOLE else 30)
    world = in_level_frame(world, TILTED, twist_std=np.zeros(6), tilt_rad=0.05, **tracks)
    config = dataclasses.replace(OPEN, variant=variant, landmark_coordinates=coordinates)
    ekf = filter_of(world, config, EVERYTHING, up=TILTED[:, 2], blocks=blocks)
    prior = gauge_information(ekf)
    for _ in run_filter(ekf, world):
        pass
    ratio = np.linalg.eigvals(np.linalg.solve(prior, gauge_information(ekf))).real
    if variant == "standard":
        assert ratio.max() > 3
    else:
        np.testing.assert_allclose(ratio, 1.0, atol=1e-6)


class LiteralShared(Literal):
    """The textbook EKF with shared errors; their columns come after those of all other blocks."""

    OWN = ("jitter", "drift")

    def __init__(self, sequence, variant, images):
        super().__init__(sequence, variant, np.arange(9), prior_std(EVERYTHING), TILTED[:, 2], BIAS, images)
        for name in self.OWN:
            self.at[name] = slice(self.body, self.body + 6)
            self.body += 6
        self.P = np.pad(self.P, (0, self.body - len(self.P)))
        for block, name in zip(SHARED, self.OWN, strict=True):
            self.P[self.at[name], self.at[name]] = np.diag(block.stationary_std**2)
        vars(self).update({name: np.zeros(6) for name in self.OWN})

    def moved_by(self, e):
        own = {name: getattr(self, name) + e[..., self.at[name]] for name in self.OWN}
        return {**super().moved_by(e), **own}

    def wander(self, tau):
        super().wander(tau)
        lengths = tau / 0.6, max(self.way_m, LEAST_WAY_M) / 20.0
        for block, name, length in zip(SHARED, self.OWN, lengths, strict=True):
            F, kept = np.eye(len(self.P)), np.exp(-length)
            F[self.at[name], self.at[name]] *= kept
            self.P = F @ self.P @ F.T
            self.P[self.at[name], self.at[name]] += np.diag((1 - kept**2) * block.stationary_std**2)
            setattr(self, name, kept * getattr(self, name))

    def look(self, x, m, before=False, follows=False):
        W = x["before"] if before else self.camera(x, follows)
        q = se3.apply(W[..., None, :, :], m)
        baseline = CAMERA.baseline_m * np.exp(x["c"][..., 6])
        right = q - baseline[..., None, None] * np.eye(3)[0]
        left, right = (np.moveaxis(pixel(np.moveaxis(p, -1, 0)), 0, -1) for p in (q, right))
        disparity = left[..., 0] - right[..., 0] + x["c"][..., None, 7]
        rows = np.stack([left[..., 0], (left[..., 1] + right[..., 1]) / 2, disparity], axis=-1)
        return rows if self.tracks is not None else rows @ BY_DISPARITY.T

    def camera(self, x, follows=False):
        offset = x["jitter"]
        if follows:
            offset = offset + max(self.way_m, LEAST_WAY_M) * x["drift"]
        return super().camera({**x, "T": se3.exp(offset) @ x["T"]})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variant", "coordinates", "errors"),
    [
        (variant, coordinates, errors)
        for variant in ("standard", "invariant")
        for coordinates in ("xyz", "image")
        for errors in ("tracks", "white")
        # In the reduced form: all pairs.
        if WHOLE or [variant == "standard", coordinates == "image", errors == "tracks"].count(True) % 2
    ],
)
def test_filter_with_shared_errors_equals_the_literal_one(variant, coordinates, errors):
    """As in `test_level`: of what is there some are left out, the first among them, and others come in any order."""
    tracks = {"tracks": TRACKS, "white": {}}[errors]
    walk = {"twist_walk_std": NOISE.twist_walk_std, "motion_std": NOISE.motion_std, "tilt_rad": 0.05, **tracks}
    world = in_level_frame(small_world(frames=10, landmarks=20 if WHOLE else 12), TILTED, **walk)
    # Landmarks that are not seen for some frames stay awake.
    config = dataclasses.replace(OPEN, variant=variant, landmark_coordinates=coordinates, retire_after=100)
    ekf = filter_of(world, config, EVERYTHING, up=TILTED[:, 2], blocks=BLOCKS)
    literal = LiteralShared(world, variant, coordinates == "image")
    side_by_side(ekf, literal, world, 1e-9 if coordinates == "xyz" else 2e-8, shuffle=True)
    assert (np.abs(ekf.values["camera_jitter"]) > 1e-6).all()


def test_residuals_of_the_batch_problem():
    """Of observations and of the blocks themselves, at any state; their derivatives are looked at elsewhere."""
    world = dataclasses.replace(small_world(frames=9, landmarks=20), noise=KINDS["tracks"])
    ekf = filter_of(world, OPEN, EVERYTHING, blocks=BLOCKS)
    for _ in run_filter(ekf, world):
        pass
    problem, rng = BatchProblem(ekf.log(), ekf.model), np.random.default_rng(4)
    log, state = problem.log, problem.filtered_state(ekf.landmarks().position_m)
    drive_values = {**state.drive_values, "calibration": ERRORS["calibration"]}
    shared = state.shared + 0.01 * rng.normal(size=state.shared.shape)
    state = dataclasses.replace(state, shared=shared, drive_values=drive_values)
    names = ["camera_jitter", "vision_drift"]
    T, tau, way_m = state.T_imu_world, log.tau_s, log.way_m
    twist = [log.seen_twist[0], *(-se3.log(T[k] @ se3.inverse(T[k - 1])) / tau[k] for k in range(1, 9))]

    def left(i, follows):
        k, m = log.frame[i], state.positions_m[log.landmark[i]]
        values = {"pose": T[k], **drive_values, **dict(zip(names, np.split(shared[k], [6]), strict=True))}
        return log.rows[i] - literal_rows(values, m[None], way_m[k], [follows], twist[k])[0]

    found, expected = np.zeros_like(log.rows), []
    for factor in (factor for factor in problem.observations.factors(state) if factor.observation is not None):
        found[factor.observation] = factor.r
    np.testing.assert_allclose(problem.observations.at(state).norms(), np.linalg.norm(found, axis=1), rtol=1e-9)
    found *= np.sqrt(log.variance)
    for i, previous in enumerate(log.previous):
        expected.append(left(i, previous >= 0) - (left(previous, False) if previous >= 0 else 0.0))
    assert (log.previous >= 0).sum() > 20
    np.testing.assert_allclose(found, expected, atol=1e-7)
    lengths = {"camera_jitter": tau / 0.6, "vision_drift": way_m / 20.0}
    parts = []
    for block, x in zip(SHARED, np.split(shared, [6], axis=1), strict=True):
        kept = np.exp(-lengths[block.name][1:, None])
        parts.append((x[1:] - kept * x[:-1]) / (block.stationary_std * np.sqrt(1 - kept**2)))
    walks = problem.process.factors(state)[1]
    np.testing.assert_allclose(-walks.r, np.hstack(parts), rtol=1e-9)


# --- recovery: worlds in which one error is put in ------------------------------------------------------------------

# Sparse tracks, so that a run takes a second; errors of tracks are white but for what is put in.
FRAMES = 60 if WHOLE else 36
DRIVE = f"city?frames={FRAMES}&outlier_fraction=0&max_tracks=25&sigma_v_m_s={{}}&sigma_w_rad_s={{}}&seed={{}}"
CLOSED = FilterConfig(gate_probability=1.0, split_after=0, retire="unseen", retire_after=1, moving_sigma=1e9)
WALKS = {"track_first_px": np.full(3, 0.3), "track_walk_px": np.full(3, 0.3)}


def plain_rows(world, T, m):
    """Pixels (n, 4) of landmarks (n, 3)."""
    camera, q = world.camera, se3.apply(world.T_cam_imu @ T, m)
    right = q - np.array([camera.baseline_m, 0, 0])
    f, c = np.array([camera.fu_px, camera.fv_px]), np.array([camera.cu_px, camera.cv_px])
    return np.concatenate([f * q[:, :2] / q[:, 2:] + c, f * right[:, :2] / right[:, 2:] + c], axis=1)


class Spoilt:
    """A simulated drive recorded once more, with velocities and tracks that err as told.

    Args:
        seed: Of everything.
        std: Of the velocities, m/s and rad/s.
        jitter, drift, bias: Blocks whose process is drawn from and put in; None: no such error.
        walks: Whether errors of tracks walk.
    """

    def __init__(self, seed, std=(0.1, 0.005), jitter=None, drift=None, bias=None, walks=False):
        world, rng = builtin(DRIVE.format(*std, seed)), np.random.default_rng(seed)
        T, truth, tau = se3.inverse(world.truth.T_world_imu), world.truth, np.diff(world.time_s)
        u = -se3.log(T[1:] @ se3.inverse(T[:-1])) / tau[:, None]
        way_m = np.append(0.0, np.linalg.norm(u[:, :3], axis=1) * tau)
        tau = np.append(0.0, tau)
        self.jitter, self.drift, self.bias = (self.path(rng, b, tau, way_m) for b in (jitter, drift, bias))
        observations, pixels, errors = world.observations, [], {}
        for k in range(len(world)):
            ids, _ = observations.at(k)
            m = truth.position_m[np.searchsorted(truth.landmark, ids)]
            seen_from = se3.exp(self.jitter[k]) @ T[k]
            clean = plain_rows(world, seen_from, m)
            flow = plain_rows(world, se3.exp(max(way_m[k], LEAST_WAY_M) * self.drift[k]) @ seen_from, m) - clean
            noise = self.track_noise(rng, len(ids)) if walks else world.noise.pixel_std_px * rng.normal(size=flow.shape)
            # An error that walks is that of the frame before and a new part; it starts with nothing of the drift.
            old = [errors.get(i) if walks else None for i in ids.tolist()]
            error = np.array([n if e is None else e + f + n for e, f, n in zip(old, flow, noise, strict=True)])
            errors = dict(zip(ids.tolist(), error, strict=True))
            pixels.append(clean + error.reshape(-1, 4))
        order = np.argsort(observations.frame, kind="stable")
        observations = Observations(
            observations.frame[order],
            np.concatenate([observations.at(k)[0] for k in range(len(world))]),
            np.vstack(pixels),
        )
        twist = np.vstack([u[:1], u]) + self.bias + world.noise.twist_std * rng.normal(size=(len(world), 6))
        noise = dataclasses.replace(world.noise, **WALKS) if walks else world.noise
        self.sequence = dataclasses.replace(world, twist=twist, observations=observations, noise=noise)
        self.T = T

    @staticmethod
    def track_noise(rng, n):
        u, v, disparity = (WALKS["track_walk_px"] * rng.normal(size=(n, 3))).T
        return np.column_stack([u, v, u - disparity, v])

    @staticmethod
    def path(rng, block, tau, way_m):
        """A draw (T, 6) of a block's process."""
        if block is None:
            return np.zeros((len(tau), 6))
        x = [block.stationary_std * rng.normal(size=6)]
        for k in range(1, len(tau)):
            phi, std = block.transition(tau[k], way_m[k])
            x.append(phi * x[-1] + std * rng.normal(size=6))
        return np.array(x)

    def filtered(self, *blocks):
        """Pose NEES (T-1,), and of every block its estimates (T, n) and standard deviations (T, n)."""
        world = self.sequence
        rig = Rig(world.camera, world.T_cam_imu, world.noise)
        ekf, nees, found = (
            JointEKF(rig, CLOSED, world.initial_T_world_imu, blocks=blocks),
            [],
            {b.name: [] for b in blocks},
        )
        for k, _ in enumerate(run_filter(ekf, world)):
            if k:
                xi = se3.log(self.T[k] @ se3.inverse(ekf.T_imu_world))
                nees.append(xi @ np.linalg.solve(ekf.P[:6, :6], xi))
            for name, values in found.items():
                std = np.sqrt(np.diag(ekf.P)[ekf.model.layout[name]])
                values.append([ekf.values[name], std])
        return np.array(nees), {name: np.array(values).swapaxes(0, 1) for name, values in found.items()}


QUIET = (0.02, 0.001)
LARGE_BIAS = TwistBias(sigma_v_m_s=0.3, sigma_w_rad_s=0.02, time_v_s=30.0, time_w_s=30.0)
CASES = {
    # The block, what is put in, and what of it is found to a quarter.
    "jitter": (CameraJitter(), {"jitter": CameraJitter()}, []),
    "jitter, good velocities": (CameraJitter(), {"jitter": CameraJitter(), "std": QUIET}, []),
    "drift": (VisionDrift(), {"drift": VisionDrift(), "walks": True}, []),
    "bias": (LARGE_BIAS, {"bias": LARGE_BIAS, "std": QUIET}, [1, 2, 3, 4, 5]),
}


@pytest.mark.slow
@pytest.mark.parametrize(("block", "put_in", "well"), CASES.values(), ids=CASES.keys())
def test_what_was_put_in_is_found_and_poses_are_honest_for_it(block, put_in, well):
    """Several drives; estimates count once half of a drive is over."""
    nees, without, errors, stds, truths = [], [], [], [], []
    for seed in seeds(12, 8):
        world = Spoilt(seed, **put_in)
        of_poses, found = world.filtered(block)
        nees.append(of_poses.mean())
        (estimate, std), which = (
            found[block.name][:, FRAMES // 2 :],
            next(name for name in put_in if name not in ("std", "walks")),
        )
        true = getattr(world, which)[FRAMES // 2 :]
        errors.append(estimate - true)
        stds.append(std)
        truths.append(np.broadcast_to(true, estimate.shape))
        if seed < 2:
            without.append(world.filtered()[0].mean())
    assert 4 < np.mean(nees) < 8.5
    assert np.mean(without) > 30
    assert 0.6 < np.mean(np.square(np.array(errors) / stds)) < 1.5
    size, error = (np.sqrt(np.mean(np.square(values), axis=(0, 1))) for values in (truths, errors))
    assert (error[well] < 0.25 * size[well]).all()
    # All are known better than before.
    assert (np.mean(stds, axis=(0, 1)) < 0.99 * block.stationary_std).all()
