"""Landmarks in the image of the last updated view, eq. (7'): derivatives, gauge, fall-backs, and what it is for."""

import dataclasses

import numpy as np
import pytest
from support.gauge import drive, exact_motion, gauge_directions
from support.helpers import run_joint
from support.jacobians import POSES, central
from support.reference import CAMERA, T_CAM_IMU, small_world

from ekfslam import Config, posterior, run
from ekfslam.config import CalibrationConfig, FilterConfig
from ekfslam.data.sequence import Noise
from ekfslam.data.simulate import builtin
from ekfslam.errors import ConfigError
from ekfslam.filters.coordinates import CameraCoordinates, change_in_view, image, image_jacobian, points_in
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.filters.observing import look, observe
from ekfslam.filters.retraction import carried_back, retracted
from ekfslam.filters.variants import VARIANTS
from ekfslam.geometry import se3
from ekfslam.models.blocks import CameraJitter, VisionDrift
from ekfslam.models.build import model_of
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.models.sensors.stereo import Rig

OPEN = FilterConfig(
    landmark_coordinates="image", gate_probability=1.0, split_after=0, retire="never", engine="reference"
)
P0 = np.diag([0.2, 0.1, 0.3, 0.05, 0.04, 0.08]) ** 2
NOISE = Noise.isotropic(0.3, 0.02, 1.0)
CAMERAS = {
    "as given": CalibrationConfig(),
    "all free": CalibrationConfig(rotation_deg=1.0, lever_arm_m=0.1, baseline=0.01, disparity_px=0.5, time_s=0.01),
    "rotation free": CalibrationConfig(rotation_deg=1.0, baseline=0.01),
}
# In the camera frame: four ahead, one behind, one beside, one without disparity.
POINTS = np.array([[1, -0.5, 6], [-2, 1, 15], [0.5, 0.2, 3], [4, -3, 24], [1, 2, -5], [9, 0, 1], [30, 10, 900.0]])
AHEAD = np.array([True] * 4 + [False] * 3)
STEP = np.array([0.02, -0.03, 0.05, 0.01, 0.02, -0.015])


class Setup:
    """A view with landmarks about it and a correction of everything."""

    def __init__(self, T, calibration, variant="standard"):
        rig = Rig(CAMERA, T_CAM_IMU, NOISE)
        self.model = model_of(rig, NOISE, T, P0, calibration)
        self.camera = CameraCoordinates(rig, 0.1)
        self.variant, self.rng, layout = VARIANTS[variant], np.random.default_rng(3), self.model.layout
        W = T_CAM_IMU @ se3.exp(np.array([-1.0, 0.2, 0.1, 0.02, -0.05, 0.1])) @ T
        self.values = {**self.model.initial_values(), "previous_view": W, "view": T_CAM_IMU @ T, "pose": T}
        self.m = se3.apply(se3.inverse(W), POINTS)
        self.x = 0.02 * self.rng.normal(size=layout.body)
        self.columns = layout.columns(["previous_view"])
        self.x[self.columns] = STEP
        self.d = 0.05 * self.rng.normal(size=self.m.shape)

    def points(self, values, m):
        return points_in(values["previous_view"], m, values["previous_view"], m)

    def after(self, x, d):
        """Blocks and landmarks after a correction, and which landmarks counted by their images."""
        values, before = self.model.retract(self.values, x), self.points(self.values, self.m)
        return values, *self.camera.retract(before, values["previous_view"], x[self.columns], d)

    def change(self, turned):
        values, m, in_image = self.after(self.x, self.d)
        before, after = self.values["previous_view"], values["previous_view"]
        views = self.points(self.values, self.m), self.points(values, m)
        return change_in_view(np.arange(len(m)), self.columns, *views, in_image, turned(before, after))


everywhere = pytest.mark.parametrize("T", POSES.values(), ids=POSES.keys())
calibrations = pytest.mark.parametrize("calibration", CAMERAS.values(), ids=CAMERAS.keys())


@calibrations
@everywhere
def test_derivatives_of_the_retraction(T, calibration):
    """M and B against differences: by landmarks, by the view, and by nothing else."""
    s = Setup(T, calibration)
    values, m, in_image = s.after(s.x, s.d)
    np.testing.assert_array_equal(in_image, AHEAD)
    body, n = s.model.layout.body, len(m)

    def moved(h):
        at, m_h, _ = s.after(s.x + h[:body], s.d + h[body:].reshape(n, 3))
        return np.concatenate([se3.log(at["previous_view"] @ se3.inverse(values["previous_view"])), (m_h - m).ravel()])

    change = s.change(s.variant.derivative)
    full = np.zeros((3 * n, body + 3 * n))
    full[:, change.columns] = change.B.reshape(3 * n, -1)
    for i in range(n):
        full[3 * i : 3 * i + 3, body + 3 * i : body + 3 * i + 3] = change.M[i]
    numeric = central(moved, body + 3 * n)
    largest = np.abs(numeric[6:]).reshape(n, -1).max(axis=1).repeat(3)[:, None]
    assert (np.abs(numeric[6:] - full) < 1e-6 * largest).all()
    turned = s.variant.derivative(s.values["previous_view"], values["previous_view"])
    np.testing.assert_allclose(numeric[:6, s.model.layout["previous_view"]], turned, rtol=1e-6, atol=1e-6)


@calibrations
@everywhere
def test_a_correction_is_d_to_first_order(T, calibration):
    s = Setup(T, calibration)
    for step in (1e-3, 1e-4):
        _, m, _ = s.after(step * s.x, step * s.d)
        assert np.abs(m - s.m - step * s.d).max(axis=1)[AHEAD].max() < 10 * step**2


@calibrations
@everywhere
def test_gauge_directions_are_carried_along(T, calibration):
    """``G N(X) = N(X+)`` for the invariant variant; first estimates keep N where they are."""
    s = Setup(T, calibration, "invariant")
    values, m, in_image = s.after(s.x, s.d)
    change = s.change(s.variant.turned)
    start, end = (gauge_directions(v["previous_view"], p) for v, p in ((s.values, s.m), (values, m)))
    carried = change.M @ start[6:].reshape(-1, 3, 6) + change.B @ start[:6]
    scale = np.abs(end[6:]).max()
    np.testing.assert_allclose(carried, end[6:].reshape(-1, 3, 6), atol=1e-11 * scale)

    T_first, m_first = se3.exp(0.1 * STEP) @ s.values["previous_view"], s.m + 0.1
    views = (points_in(v["previous_view"], p, T_first, m_first) for v, p in ((s.values, s.m), (values, m)))
    change = change_in_view(np.arange(len(m)), s.columns, *views, in_image, np.eye(6))
    N = gauge_directions(T_first, m_first)
    carried = change.M @ N[6:].reshape(-1, 3, 6) + change.B @ N[:6]
    np.testing.assert_allclose(carried, N[6:].reshape(-1, 3, 6), atol=1e-11 * scale)


@pytest.mark.parametrize("calibration", CAMERAS.values(), ids=CAMERAS.keys())
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_covariance_is_carried_by_the_dense_product(variant, calibration):
    s = Setup(POSES["random 1"], calibration, variant)
    values, _, _ = s.after(s.x, s.d)
    change, layout, n = s.change(s.variant.turned), s.model.layout, len(s.m)
    ekf = JointEKF(s.model, dataclasses.replace(OPEN, variant=variant))
    root = s.rng.normal(size=(layout.body + 3 * n,) * 2)
    P = root @ root.T
    ekf.P = P.copy()
    s.variant.transport(ekf.gaussian, s.model, s.values, values, [change])
    G = np.eye(len(P))
    for name in ("pose", "view", "previous_view"):
        if variant == "invariant":
            G[layout[name], layout[name]] = se3.adjoint(values[name] @ se3.inverse(s.values[name]))
    for i in range(n):
        own = slice(layout.body + 3 * i, layout.body + 3 * i + 3)
        G[own, own], G[own, change.columns] = change.M[i], change.B[i]
    expected = G @ P @ G.T
    std = np.sqrt(np.diag(expected))
    assert (np.abs(ekf.P - expected) < 1e-12 * np.outer(std, std)).all()
    np.testing.assert_array_equal(ekf.P, ekf.P.T)


@pytest.mark.parametrize("coordinates", ["image", "xyz"])
@pytest.mark.parametrize("variant", ["invariant", "standard"])
def test_rows_are_carried_back_by_the_chain_rule(variant, coordinates):
    """Rows at a corrected mean against the change of the gauge (invariant), or against differences.

    The latter hold without jitter and calibration, whose parts of a corrected view are of second order.
    """
    world = small_world(seed=2, frames=8)
    noise = dataclasses.replace(world.noise, track_first_px=np.full(3, 0.3), track_walk_px=np.full(3, 0.3))
    config = dataclasses.replace(OPEN, variant=variant, landmark_coordinates=coordinates)
    rig, is_all = Rig(world.camera, world.T_cam_imu, noise), variant == "invariant"
    blocks, calibration = ((CameraJitter(), VisionDrift()), CAMERAS["rotation free"]) if is_all else ((), None)
    ekf = JointEKF(rig, config, world.initial_T_world_imu, P0, calibration, blocks=blocks)
    for _ in run_filter(ekf, world, range(4)):
        pass
    ekf.predict(world.twist[4], 0.1)
    ids, pixels = world.observations.at(4)
    slot, is_known = ekf.table.lookup(ids)
    slot, measured = slot[is_known][::-2], ekf.sensor.rows(pixels)[is_known][::-2]
    rng, body = np.random.default_rng(1), ekf.gaussian.body
    # A correction as P allows it: the view is where the blocks are.
    correction = np.linalg.cholesky(ekf.P + 1e-12 * np.eye(len(ekf.P))) @ rng.normal(size=len(ekf.P))
    E = look(ekf)
    correction[:body] = E @ correction[:body]
    moved = retracted(ekf, correction)
    _, rows = observe(ekf, moved.mean, slot, measured, ekf.mean)
    back = carried_back(ekf, rows, moved)
    layout, T, positions = ekf.model.layout, ekf.T_imu_world, ekf.linear_positions_m
    N = np.zeros((layout.body, 6))
    T_first = ekf.variant.linear(T, ekf.motion.T_predicted)
    N[layout["pose"]] = -se3.adjoint(T_first)
    N[layout["view"]] = -se3.adjoint(ekf.values["view"])
    first = ekf.variant.linear(ekf.values["previous_view"], ekf.motion.W_predicted_before)
    N[layout["previous_view"]] = -se3.adjoint(first)
    N_m = gauge_directions(T, positions)[6:].reshape(-1, 3, 6)[slot]
    scale = np.abs(back.H_x).max() * np.abs(N).max()
    gained = back.H_x @ N[: layout.seen] + back.H_m @ N_m
    assert (np.abs(gained).max() < 1e-9 * scale) == (variant != "standard")
    if variant != "standard":
        return

    def left(h):
        at = retracted(ekf, correction + np.concatenate([E @ h[:body], h[body:]])).mean
        return observe(ekf, at, slot, measured)[1].residual.ravel()

    numeric = -central(left, len(correction))
    ours = np.zeros((rows.residual.size, len(correction)))
    ours[:, : layout.seen] = (back.H_x @ E[: layout.seen, : layout.seen]).reshape(len(ours), -1)
    for i, own in enumerate(slot):
        ours[3 * i : 3 * i + 3, body + 3 * own : body + 3 * own + 3] = back.H_m[i]
    np.testing.assert_allclose(ours, numeric, atol=1e-6 * np.abs(numeric).max())


def test_the_image_is_its_own_inverse():
    q = POINTS[:4]
    np.testing.assert_allclose(image(image(q)), q, rtol=1e-15)
    np.testing.assert_allclose(
        image_jacobian(image(q)) @ image_jacobian(q), np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-15
    )
    for point, J in zip(q, image_jacobian(q), strict=True):
        np.testing.assert_allclose(J, central(lambda h, p=point: image(p + h), 3), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(("factor", "by_image"), [(0.2, False), (0.3, True), (3.5, True), (4.5, False), (-1.0, False)])
def test_disparities_that_change_too_much_fall_back(factor, by_image):
    """One landmark at 10 m; the correction asks for so many times its disparity."""
    s = Setup(np.eye(4), CalibrationConfig())
    q = np.array([[1.0, 0.5, 10.0]])
    W = s.values["previous_view"]
    s.m = se3.apply(se3.inverse(W), q)
    y = image(q)
    wanted = y * [1, 1, factor]
    dq = np.linalg.solve(image_jacobian(q)[0], (wanted - y)[0])
    d = W[:3, :3].T @ dq
    values, m, in_image = s.after(np.zeros(18), d[None])
    assert in_image.tolist() == [by_image]
    found = se3.apply(values["previous_view"], m)
    np.testing.assert_allclose(found, image(wanted) if by_image else q + dq, atol=1e-9)


# --- whole filters --------------------------------------------------------------------------------------------------


def without_views(ekf):
    """P without the views, which exact velocities tell for certain, and the gauge directions of the rest."""
    views = ekf.model.layout.columns(ekf.model.layout.views)
    N = gauge_directions(ekf.linear_T_imu_world, ekf.linear_positions_m)
    return np.delete(np.delete(ekf.P, views, 0), views, 1), N


@pytest.mark.parametrize(
    ("variant", "iterations", "retire"),
    [
        ("invariant", 1, "never"),
        ("invariant", 1, "unseen"),
        ("invariant", 3, "unseen"),
        ("fej", 1, "unseen"),
        ("standard", 1, "never"),
    ],
)
def test_information_about_the_gauge(variant, iterations, retire):
    world = exact_motion(small_world(seed=4, frames=60))
    ekf = drive(world, dataclasses.replace(OPEN, variant=variant, iterations=iterations, retire=retire), P0)
    P, N = without_views(ekf)
    prior = se3.adjoint(se3.inverse(world.initial_T_world_imu))
    prior = prior.T @ np.linalg.solve(P0, prior)
    ratio = np.linalg.eigvals(np.linalg.solve(prior, N.T @ np.linalg.solve(P, N))).real
    # Exact velocities leave nothing to correct in the pose, and landmarks count relative to it: so the standard variant
    # gains nothing either.
    np.testing.assert_allclose(ratio, 1.0, atol=1e-6)


@pytest.mark.parametrize(("variant", "iterations"), [("invariant", 1), ("invariant", 3), ("fej", 1), ("standard", 1)])
def test_what_is_seen_does_not_depend_on_the_prior_of_the_gauge(variant, iterations):
    world = small_world(seed=6, frames=40)
    config = dataclasses.replace(OPEN, variant=variant, iterations=iterations)
    found = []
    for scale in (1e-4, 1.0):
        ekf = drive(world, config, scale * P0)
        found.append(se3.apply(ekf.T_imu_world, ekf.positions_m))
    assert len(found[0]) >= 10
    difference = np.abs(found[0] - found[1]).max() / np.abs(found[0]).max()
    assert difference > 1e-6 if variant == "standard" else difference < 1e-8


def test_two_views_from_one_place_give_the_mean_of_their_images():
    """Pose known and rig at rest: the posterior is exact, where xyz makes the depth wrong by a quarter of eps^2."""
    rig = Rig(CAMERA, T_CAM_IMU, Noise(np.zeros(6), np.ones(4)))
    q = np.array([[1.0, 0.5, 20.0], [-3.0, 1.0, 24.0]])
    first = np.column_stack([rig.predict(q), rig.predict(q)[:, 1]])
    second = first + np.array([2.0, 1.0, -1.5, 1.0])
    found = {}
    for coordinates in ("image", "xyz"):
        ekf = JointEKF(rig, dataclasses.replace(OPEN, landmark_coordinates=coordinates), np.eye(4), np.zeros((6, 6)))
        ekf.update(0, np.arange(2), first)
        ekf.predict(np.zeros(6), 0.1)
        ekf.update(1, np.arange(2), second)
        found[coordinates] = ekf.positions_m
    exact = se3.apply(se3.inverse(T_CAM_IMU), rig.invert(rig.rows((first + second) / 2)))
    np.testing.assert_allclose(found["image"], exact, rtol=1e-12)
    assert np.abs(found["xyz"] - exact).max() > 0.1


def test_one_camera_alone_has_images_too():
    """Landmarks wait for parallax, and what two views leave over corrects the pose that was just updated."""
    world = small_world(frames=40)
    sensor = Monocular(world.camera, world.T_cam_imu, world.noise, parallax_rad=0.2)
    ekf = run_joint(world, sensor, OPEN)[0]
    order = np.argsort(world.truth.landmark)
    true = world.truth.position_m[order][np.searchsorted(world.truth.landmark[order], ekf.ids)]
    std = np.sqrt(np.linalg.eigvalsh(ekf.gaussian.landmark_blocks())[:, -1])
    assert len(ekf.ids) > 5
    assert (np.linalg.norm(ekf.positions_m - true, axis=1) < 5 * std).all()


def test_which_view_was_updated_last():
    """That of the prediction never serves, nor one that nothing has updated."""
    world = small_world(frames=12)
    ekf = JointEKF(Rig(world.camera, world.T_cam_imu, world.noise), OPEN, world.initial_T_world_imu, P0)
    nothing = np.empty(0, dtype=np.int64), np.empty((0, 4))
    expected = []
    for k in range(12):
        if k:
            ekf.predict(world.twist[k], 0.1)
            expected.append(ekf.updated_view)
        ekf.update(k, *(nothing if k == 5 else world.observations.at(k)))
        assert ekf.updated_view == (None if k == 5 else "view")
    assert expected == ["previous_view"] * 5 + [None] + ["previous_view"] * 5


def test_a_first_sight_of_everything_anew_serves():
    world = small_world(frames=4)
    config = dataclasses.replace(OPEN, retire="unseen", retire_after=1)
    ekf = JointEKF(Rig(world.camera, world.T_cam_imu, world.noise), config, world.initial_T_world_imu, P0)
    ekf.update(0, *world.observations.at(0))
    ekf.predict(world.twist[1], 0.1)
    ids, pixels = world.observations.at(1)
    ekf.update(1, ids + 10_000, pixels)
    assert ekf.updated_view == "view"


@pytest.mark.slow
@pytest.mark.parametrize(
    "variant", [v if v == "invariant" else pytest.param(v, marks=pytest.mark.slow) for v in VARIANTS]
)
def test_a_loop_closes_with_landmarks_that_come_back(variant):
    """Revival takes rows linearised again, in every variant, and the smoother has views as functions of two frames."""
    world = builtin("loop?frames=100&radius_m=10&landmarks=60")
    never, unseen = (
        run(world, "full", Config(filter=FilterConfig(variant, retire=retire))) for retire in ("never", "unseen")
    )
    assert unseen.counts["revived"] > 0
    error = [np.linalg.norm(r.T_world_imu[-1, :3, 3] - world.truth.T_world_imu[-1, :3, 3]) for r in (never, unseen)]
    assert error[1] < 1.5 * error[0] + 0.05
    smoothed = posterior(unseen)
    assert np.linalg.norm(smoothed.T_world_imu[-1, :3, 3] - world.truth.T_world_imu[-1, :3, 3]) < 1.5 * error[0] + 0.05


def test_a_model_without_views_is_refused():
    model = model_of(Rig(CAMERA, T_CAM_IMU, NOISE), NOISE, np.eye(4), P0, coordinates="xyz")
    with pytest.raises(ConfigError, match="'image' needs views"):
        JointEKF(model, OPEN)
    assert JointEKF(model, dataclasses.replace(OPEN, landmark_coordinates="xyz")).P.shape == (6, 6)


def test_iterating_in_xyz_is_refused_with_the_reason():
    with pytest.raises(ConfigError, match="distances too short"):
        Config().with_overrides({"filter": {"iterations": 3, "landmark_coordinates": "xyz"}})
    assert Config().with_overrides({"filter": {"iterations": 3}}).filter.landmark_coordinates == "image"


def test_iterating_changes_little_but_fits_better():
    world = small_world(frames=30, sigma_v=1.0, sigma_w=0.2)
    rig = Rig(world.camera, world.T_cam_imu, world.noise)
    once, often = (run_joint(world, rig, dataclasses.replace(OPEN, iterations=n))[1] for n in (1, 4))
    again = run_joint(world, rig, dataclasses.replace(OPEN, iterations=5))[1]
    assert 1e-6 < np.abs(once - often).max() < 0.2
    assert np.abs(again - often).max() < 0.1 * np.abs(once - often).max()
