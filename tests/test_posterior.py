"""The joint posterior against the dense filter, against dense algebra, and against what it must not know."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from support.everything import with_everything
from support.gauge import gauge_directions
from support.helpers import run_joint
from support.reference import small_world
from support.running import WHOLE

from ekfslam import open_sequence
from ekfslam.config import CalibrationConfig, Config, FilterConfig, NoiseConfig, PosteriorConfig
from ekfslam.data.sequence import Noise, Observations, cut
from ekfslam.data.simulate import builtin
from ekfslam.errors import IllPosedError, PosteriorError
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.geometry import se3
from ekfslam.models.blocks import CameraJitter, TwistBias, VisionDrift
from ekfslam.models.sensors.stereo import Rig
from ekfslam.resolve import noise_of
from ekfslam.runner import run
from ekfslam.smoother.optimise import robust
from ekfslam.smoother.posterior import posterior, posterior_of_log, smooth
from ekfslam.smoother.problem import BatchProblem
from ekfslam.smoother.revival import MapRevival
from ekfslam.smoother.sparse.information import JointInformation
from ekfslam.smoother.sparse.structure import Structure
from ekfslam.storage.archive import open_result, write_archive

P0 = np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]) ** 2
SINGULAR_P0 = np.diag([0.1, 0.2, 0.0, 0.0, 0.0, 0.03]) ** 2
OPEN = FilterConfig(landmark_coordinates="xyz", gate_probability=1.0, split_after=0, retire="never")
FILTERED = PosteriorConfig(linearisation="filtered")


def rig_of(sequence):
    white = Config(noise=NoiseConfig(model="white"))
    return Rig(sequence.camera, sequence.T_cam_imu, noise_of(sequence, white))


def drive(sequence, config, P0=None):
    """The filter after a sequence, and its poses after each frame."""
    revives = config.revive >= 0
    ekf, poses, _ = run_joint(sequence, rig_of(sequence), config, covariance=P0, revives=revives)
    return ekf, poses


def posterior_of(ekf, config=FILTERED):
    return posterior_of_log(ekf.log(), ekf.model, ekf.landmarks().position_m, config)


def assert_equal_to_dense_filter(found, ekf):
    """Every landmark, the last pose and all of the covariance, to the tolerances of exact arithmetic done twice."""
    active = ekf.table.log_row
    np.testing.assert_allclose(found.position_m[active], ekf.positions_m, atol=1e-6)
    np.testing.assert_allclose(found.T_world_imu[-1], ekf.T_world_imu, atol=1e-9)
    scale = np.sqrt(np.diag(ekf.P))
    covariance = found.joint_covariance([-1], active)
    assert (np.abs(covariance - ekf.P) <= 1e-8 * np.outer(scale, scale)).all()
    n = len(active)
    own = ekf.P[6:, 6:].reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
    # By selected inversion, too.
    largest = np.abs(own).max(axis=(1, 2), keepdims=True)
    assert (np.abs(found.landmark_covariance[active] - own) <= 1e-8 * largest).all()
    largest = np.abs(ekf.P[:6, :6]).max()
    assert (np.abs(found.pose_covariance[-1] - ekf.P[:6, :6]) <= 1e-8 * largest).all()


@pytest.mark.parametrize(("variant", "iterations"), [("standard", 1), ("fej", 1), ("standard", 3)])
@pytest.mark.parametrize("prior", [None, SINGULAR_P0, P0], ids=["certain", "half certain", "uncertain"])
def test_as_filtered_equals_the_dense_filter(variant, iterations, prior):
    world = small_world()
    ekf, _ = drive(world, dataclasses.replace(OPEN, variant=variant, iterations=iterations), prior)
    assert_equal_to_dense_filter(posterior_of(ekf), ekf)


@pytest.mark.parametrize("variant", ["standard", "fej"])
def test_as_filtered_equals_the_dense_filter_with_gates_and_splits(variant):
    world = builtin("loop?frames=100&outlier_fraction=0.1")
    config = FilterConfig(variant=variant, landmark_coordinates="xyz", retire="never", split_after=2)
    ekf, _, reports = run_joint(world, rig_of(world), config)
    assert sum(len(report.split) for report in reports) > 0
    assert sum((report.reason != -1).sum() for report in reports) > 100
    assert_equal_to_dense_filter(posterior_of(ekf), ekf)


@pytest.mark.data
@pytest.mark.parametrize("name", ["0027", "0020", "0042"])
def test_as_filtered_equals_the_dense_filter_on_the_recordings(data_path, name):
    sequence = open_sequence(data_path(f"ece276a/{name}.npz"))
    if not WHOLE:
        sequence = cut(sequence, 0, 200, sequence.initial_T_world_imu)
    config = Config().with_overrides(
        {"filter": {"variant": "standard", "landmark_coordinates": "xyz", "retire": "never"}}
    )
    ekf, _, _ = run_joint(sequence, rig_of(sequence), config.filter)
    assert_equal_to_dense_filter(posterior_of(ekf), ekf)


def test_where_landmarks_are_eliminated_makes_no_difference():
    world = small_world()
    ekf, _ = drive(world, OPEN, P0)
    problem = BatchProblem(ekf.log(), ekf.model)
    system = problem.relinearised(problem.filtered_state(ekf.positions_m))
    found = [JointInformation(system, structure=Structure(system, up_to)) for up_to in (0, 12, 1000)]
    kept = [len(one.structure.kept) for one in found]
    assert kept[0] == problem.log.landmarks > kept[1] > kept[2] == 0
    for one in found[1:]:
        np.testing.assert_allclose(one.eps, found[0].eps, atol=1e-10)
        np.testing.assert_allclose(one.d, found[0].d, atol=1e-9)
        np.testing.assert_allclose(one.frame_covariances(), found[0].frame_covariances(), atol=1e-10)
        np.testing.assert_allclose(one.landmark_covariances(), found[0].landmark_covariances(), atol=1e-9)
        np.testing.assert_allclose(one.log_determinant, found[0].log_determinant, rtol=1e-12)


CALIBRATION = CalibrationConfig(0.3, 0.05, 0.01, 0.3, 0.0)


def numeric_rows(problem, state):
    """Central differences of all residuals of a problem through `BatchProblem.moved`, in the columns of its rows."""
    T, M, w, aux, drive = len(state.T_imu_world), len(state.positions_m), *widths(problem), len(state.drive)
    ends = np.cumsum([w * T, aux * T, drive, 3 * M])

    def residuals(x):
        eps, of_frames, of_drive, d = np.split(x, ends[:-1])
        eps, of_frames = eps.reshape(T, w), of_frames.reshape(T, aux)
        zeta = np.concatenate([eps[0], of_frames[0]])
        step = SimpleNamespace(eps=eps, zeta=zeta, aux=of_frames, drive=of_drive, d=d.reshape(M, 3))
        return -problem.relinearised(problem.moved(state, step)).rows()[1]

    step = 1e-6
    columns = [(residuals(e) - residuals(-e)) / (2 * step) for e in step * np.eye(ends[-1])]
    return np.column_stack(columns)


def widths(problem):
    """Columns of a frame, and of its aux."""
    return problem.unknowns.width, len(problem.unknowns.aux_columns)


SHARED = [CameraJitter(time_s=0.3), VisionDrift(length_m=3.0)]


KINDS = {"white": (False, []), "every block": (True, []), "shared": (False, SHARED), "all": (True, SHARED)}
TURNS = {"near identity": 0.01, "random": 1.0, "near pi": 3.1}
# In the reduced form everything at once is turned in every way, and each kind of state in one.
LONG = [pytest.param(case, marks=pytest.mark.slow) for case in ("all-near identity", "all-random", "all-near pi")]
SOME = [*LONG, "white-near pi", "every block-near identity", "shared-random"]


@pytest.mark.parametrize("case", [f"{kind}-{turn}" for kind in KINDS for turn in TURNS] if WHOLE else SOME)
def test_relinearised_rows_are_derivatives_of_the_residuals(case):
    kind, turn = case.split("-")
    (everything, shared), turn = KINDS[kind], TURNS[turn]
    world = small_world(frames=8, landmarks=20) if WHOLE else small_world(frames=4, landmarks=6)
    if everything:
        world = with_everything(world)
        options = {"calibration": CALIBRATION, "blocks": [TwistBias(0.1, 0.01, 3.0, 5.0), *shared]}
        ekf, _, _ = run_joint(world, rig_of(world), OPEN, covariance=P0, **options)
    else:
        ekf, _, _ = run_joint(world, rig_of(world), OPEN, covariance=P0, blocks=shared)
    problem = BatchProblem(ekf.log(), ekf.model)
    rng = np.random.default_rng(8)
    state = problem.filtered_state(ekf.landmarks().position_m)
    # Turn the whole world: the same points are seen, at poses anywhere; then leave the consistent state.
    axis = rng.normal(size=3)
    T_world = se3.exp(np.concatenate([rng.normal(size=3), turn * axis / np.linalg.norm(axis)]))
    state = dataclasses.replace(
        state,
        T_imu_world=se3.exp(0.03 * rng.normal(size=(len(world), 6))) @ state.T_imu_world @ se3.inverse(T_world),
        positions_m=se3.apply(T_world, state.positions_m) + 0.1 * rng.normal(size=state.positions_m.shape),
        zeta=0.3 * rng.normal(size=sum(widths(problem))),
        shared=state.shared + 0.003 * rng.normal(size=state.shared.shape),
    )
    of_first = problem.unknowns.B @ state.zeta
    state.shared[0], state.aux[0] = of_first[6 : widths(problem)[0]], of_first[widths(problem)[0] :]
    first = se3.inverse(se3.exp(of_first[:6]) @ problem.log.T_predicted[0]) @ state.T_imu_world[0]
    state = dataclasses.replace(
        state,
        T_imu_world=state.T_imu_world @ se3.inverse(first),
        positions_m=se3.apply(first, state.positions_m),
    )
    J = problem.relinearised(state).rows()[0].toarray()
    expected = numeric_rows(problem, state)
    tolerance = 2e-6 * np.abs(expected).max(axis=1, keepdims=True)
    assert (np.abs(J - expected) <= tolerance + 1e-6).all()
    assert (np.abs(J).max(axis=0) > 0).all()


@pytest.mark.parametrize("kernel", ["huber", "cauchy", "none"])
def test_kernel_weight_is_the_slope_of_the_cost(kernel):
    s = np.linspace(0.05, 9.0, 60)
    h = 1e-6
    config = PosteriorConfig(kernel=kernel)
    slope = (robust(config, s + h)[0] - robust(config, s - h)[0]) / (2 * h)
    np.testing.assert_allclose(robust(config, s)[1] * s, slope, rtol=1e-6)


@pytest.mark.parametrize("kernel", ["huber", "none"])
def test_map_is_a_minimum_and_better_than_where_it_started(kernel):
    world = small_world()
    ekf, _ = drive(world, OPEN, P0)
    found = posterior_of(ekf, PosteriorConfig(kernel=kernel, tolerance=1e-13))
    assert list(found.costs) == sorted(found.costs, reverse=True)
    assert found.cost < 0.9 * found.costs[0]
    # At the minimum the last system has nothing left to correct.
    assert np.abs(found.information.eps).max() < 1e-6
    assert np.abs(found.information.d).max() < 1e-4
    start = ekf.model, ekf.landmarks().position_m + 0.05
    again = posterior_of_log(ekf.log(), *start, PosteriorConfig(kernel=kernel, tolerance=1e-13))
    np.testing.assert_allclose(again.cost, found.cost, rtol=1e-9)
    np.testing.assert_allclose(again.position_m, found.position_m, atol=1e-3)


def test_map_learns_nothing_about_where_the_world_is():
    """Information along the gauge, of the last pose and all landmarks, is that of the prior, a little less."""
    world = small_world(seed=4, frames=40)
    world = dataclasses.replace(world, noise=Noise(np.full(6, 1e-3), world.noise.pixel_std_px))
    prior = np.diag([0.2, 0.1, 0.3, 0.05, 0.04, 0.08]) ** 2
    ekf, _ = drive(world, OPEN, prior)
    found = posterior_of(ekf, PosteriorConfig(kernel="none", tolerance=1e-13))
    N = gauge_directions(se3.inverse(found.T_world_imu[-1]), found.position_m)
    now = N.T @ np.linalg.solve(found.dense_covariance(), N)
    T_start = se3.inverse(found.T_world_imu[0])
    expected = se3.adjoint(T_start).T @ np.linalg.solve(prior, se3.adjoint(T_start))
    ratio = np.linalg.eigvals(np.linalg.solve(expected, now)).real
    assert ratio.max() < 1 + 1e-6
    assert ratio.min() > 0.99


@pytest.mark.slow
def test_robust_kernel_holds_against_outliers():
    world = small_world(frames=50, landmarks=60, sigma_v=0.05, sigma_w=0.005)
    rng = np.random.default_rng(0)
    observations = world.observations
    bad = rng.uniform(size=len(observations)) < 0.05
    pixels = observations.pixels_px + bad[:, None] * rng.choice([-12.0, 12.0], (len(observations), 1)) * [1, 0, 1, 0]
    spoilt = dataclasses.replace(world, observations=Observations(observations.frame, observations.landmark, pixels))
    ekf, _ = drive(spoilt, OPEN)
    error = {}
    for kernel in ("none", "huber", "cauchy"):
        found = posterior_of(ekf, PosteriorConfig(kernel=kernel))
        error[kernel] = np.linalg.norm(found.T_world_imu[:, :3, 3] - world.truth.T_world_imu[:, :3, 3], axis=1).mean()
    assert error["cauchy"] < error["huber"] < error["none"]
    assert error["cauchy"] < 0.5 * error["none"]


@pytest.mark.slow
def test_map_is_consistent():
    """Mean NEES of the last pose and of landmarks over 30 drives, linearised at the maximum: 6 and 3 are expected."""
    pose, landmark = [], []
    for seed in range(30):
        world = builtin(f"loop?{'frames=100' if WHOLE else 'frames=25&landmarks=60'}&seed={seed}")
        ekf, _, _ = run_joint(world, rig_of(world), FilterConfig(retire="never"))
        found = posterior_of(ekf, PosteriorConfig(kernel="none"))
        xi = se3.log(se3.inverse(world.truth.T_world_imu) @ found.T_world_imu)
        error = xi[-1]
        pose.append(error @ np.linalg.solve(found.pose_covariance[-1], error))
        at = np.searchsorted(world.truth.landmark, found.id)
        d = world.truth.position_m[at] - found.position_m
        landmark.append(np.einsum("ni,nij,nj->n", d, np.linalg.inv(found.landmark_covariance), d).mean())
    assert 4.5 < np.mean(pose) < 8.0
    assert 2.4 < np.mean(landmark) < 3.8


LOOP = "loop" if WHOLE else "loop?frames=180&radius_m=10&landmarks=50"  # more than two rounds


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["standard", "fej"])
def test_revival_equals_never_retiring(variant):
    world = builtin(LOOP)
    never, expected = drive(world, FilterConfig(variant, "xyz", retire="never"))
    revived, poses = drive(world, FilterConfig(variant, "xyz", retire="unseen"))
    assert len(revived.retired.revived) > (5 if WHOLE else 1)  # those that brought their neighbours along
    assert revived.counts["retired"] > 50
    assert len(revived.landmarks()) == len(never.landmarks())
    np.testing.assert_allclose(poses, expected, atol=1e-6)
    afresh, other = drive(world, FilterConfig(variant, "xyz", retire="unseen", revive=-1))
    assert len(afresh.retired.reappeared) > 20
    assert np.abs(other - expected).max() > 0.01
    # The log goes on through it all.
    assert_equal_to_dense_filter(posterior_of(revived), never)


@pytest.mark.slow
def test_revival_of_the_invariant_variant_is_as_good_as_never_retiring():
    world = builtin(LOOP)
    config = FilterConfig(variant="invariant")
    error = {}
    for retire, revive in (("never", 0), ("unseen", 100), ("unseen", -1)):
        _, poses = drive(world, dataclasses.replace(config, retire=retire, revive=revive))
        position = se3.inverse(poses)[:, :3, 3] - world.truth.T_world_imu[:, :3, 3]
        error[retire, revive] = np.sqrt((position**2).sum(axis=1).mean())
    assert error["unseen", 100] < 1.05 * error["never", 0] < 0.5 * error["unseen", -1]


@pytest.mark.parametrize("variant", ["invariant", "fej", "standard"])
def test_no_information_about_the_gauge_is_gained_across_a_revival(variant):
    """Landmarks are out of view for a while; motion is nearly exact, so that hardly any information is lost either."""
    world = small_world(seed=4, frames=60)
    observations = world.observations
    keep = np.ones(len(observations), dtype=bool)
    for landmark in np.argsort(-np.bincount(np.unique(observations.landmark, return_inverse=True)[1]))[:6]:
        track = np.flatnonzero(observations.landmark == observations.ids[landmark])
        keep[track[4:9]] = False
    prior = np.diag([0.2, 0.1, 0.3, 0.05, 0.04, 0.08]) ** 2
    world = dataclasses.replace(
        world,
        observations=Observations(observations.frame[keep], observations.landmark[keep], observations.pixels_px[keep]),
        noise=Noise(np.full(6, 1e-3), world.noise.pixel_std_px),
    )
    config = dataclasses.replace(OPEN, variant=variant, retire="unseen", revive=5)
    ekf = JointEKF(rig_of(world), config, world.initial_T_world_imu, prior)
    ekf.revival = MapRevival(ekf.model, config)
    T_start = ekf.T_imu_world
    expected = se3.adjoint(T_start).T @ np.linalg.solve(prior, se3.adjoint(T_start))
    largest, smallest = 0.0, 1.0
    for _ in run_filter(ekf, world):
        T, m = ekf.motion.T_predicted if variant == "fej" else ekf.T_imu_world, ekf.linear_positions_m
        N = gauge_directions(T, m)
        ratio = np.linalg.eigvals(np.linalg.solve(expected, N.T @ np.linalg.solve(ekf.P, N))).real
        largest, smallest = max(largest, ratio.max()), min(smallest, ratio.min())
    assert len(ekf.retired.revived) >= 3
    if variant == "standard":
        assert largest > 100
    else:
        assert largest < 1 + 1e-6
        assert smallest > 0.99


@pytest.mark.slow
def test_archive_alone_rebuilds_the_posterior(tmp_path):
    world = builtin("loop?frames=60")
    result = run(world, "full")
    write_archive(tmp_path / "a.h5", world, {"full": result})
    for config in (PosteriorConfig(), FILTERED):
        here, there = posterior(result, config), posterior(open_result(tmp_path / "a.h5", "full"), config)
        np.testing.assert_array_equal(here.T_world_imu, there.T_world_imu)
        np.testing.assert_array_equal(here.position_m, there.position_m)
        np.testing.assert_array_equal(here.landmark_covariance, there.landmark_covariance)


def test_a_smoothed_result_counts_observations_weighted_below_one_half():
    result = run(builtin("city?frames=5&max_tracks=9"), "full")
    found = dataclasses.replace(posterior(result), weight=np.array([0.2, 0.49, 0.7, 1.0]))
    assert smooth(result, found=found).counts["observations weighted below one half"] == 2


@pytest.mark.slow
def test_smoothed_result_is_the_posterior():
    world = builtin("loop?frames=60")
    result = run(world, "full")
    found, smoothed = posterior(result), smooth(result)
    assert smoothed.mode == "smoothed"
    np.testing.assert_array_equal(smoothed.landmarks.id, found.id)
    np.testing.assert_array_equal(smoothed.landmarks.position_m, found.position_m)
    np.testing.assert_allclose(smoothed.covariance, found.pose_covariance)
    np.testing.assert_allclose(
        found.dense_covariance([3, -1])[:6, :6],
        smoothed.covariance[3],
        atol=1e-10 * np.abs(smoothed.covariance[3]).max(),
    )
    assert smooth(result, FILTERED).mode == "as filtered"
    poses, landmarks = found.sample(np.random.default_rng(0), 3)
    assert poses.shape == (3, 60, 4, 4)
    assert landmarks.shape == (3, len(found.id), 3)
    # The first pose is certain.
    np.testing.assert_allclose(poses[:, 0], np.broadcast_to(np.eye(4), (3, 4, 4)), atol=1e-9)


def test_what_is_undetermined_is_named():
    world = builtin("loop?frames=20")
    result = run(world, "full")
    still = dataclasses.replace(result, noise=Noise(np.repeat([0.5, 0.0], 3), result.noise.pixel_std_px))
    with pytest.raises(IllPosedError, match=r"velocities without noise.*frames \[1, 2, 3"):
        posterior(still)
    log = result.log
    blind = np.full_like(log.variance, 1.0)
    blind[log.landmark == 4] = np.inf
    with pytest.raises(IllPosedError, match=rf"too little information \[{log.id[4]}\]"):
        posterior(dataclasses.replace(result, log=dataclasses.replace(log, variance=blind)), FILTERED)
    unseen = dataclasses.replace(
        log, id=np.append(log.id, 777), first_position_m=np.vstack([log.first_position_m, np.ones(3)])
    )
    with pytest.raises(IllPosedError, match=r"without an observation \[777\]"):
        posterior(dataclasses.replace(result, log=unseen), FILTERED)
    with pytest.raises(PosteriorError, match="no log"):
        posterior(run(world, "mapping-only"))
    found = posterior(result)
    with pytest.raises(PosteriorError, match="there is no frame 20; there are 20"):
        found.joint_covariance([20])
    with pytest.raises(PosteriorError, match="there is no landmark"):
        found.joint_covariance([], [10**6])


def test_a_result_with_a_retired_state_block_is_not_smoothed():
    result = run(builtin("city?frames=3"), "full")
    old = dataclasses.replace(result, config={**result.config, "blocks": {"stereo_rotation": {}}})
    with pytest.raises(PosteriorError, match="the state block stereo_rotation"):
        posterior(old)
