"""Filter and smoother believe the same: rows frozen where the filter linearised them have its state as solution."""

import dataclasses

import numpy as np
import pytest
from support.everything import BLOCKS, CALIBRATION, EVERYTHING, PRIOR, with_everything
from support.frozen import assert_equal_to_frozen_rows
from support.helpers import tracked, truth_error
from support.running import WHOLE

from ekfslam import open_sequence
from ekfslam.config import Config, PosteriorConfig
from ekfslam.data.noise import TrackError
from ekfslam.data.sequence import Truth
from ekfslam.data.simulate import builtin
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.resolve import resolve
from ekfslam.runner import run
from ekfslam.smoother.posterior import in_layout, posterior, posterior_of_log, smooth
from ekfslam.smoother.revival import MapRevival

FILTERED = PosteriorConfig(linearisation="filtered")
SHARED = ["camera_jitter", "vision_drift"]
ALL_BLOCKS = ["pose", "view", "previous_view", "calibration", *SHARED, "twist", "up", "twist_bias"]
TRACK_ERROR = TrackError(np.array([0.3, 0.4, 0.8]), np.array([0.2, 0.25, 0.3]), 40.0, 0.05)
UNSHARED = [name for name in ALL_BLOCKS if name not in SHARED]


def drive(sequence, settings, blocks=ALL_BLOCKS):
    """The filter after a recording whose model has the blocks."""
    problem = resolve(sequence, Config().with_overrides(settings))
    assert [block.name for block in problem.model.layout.blocks] == blocks
    ekf = JointEKF(problem.model, problem.config.filter)
    ekf.revival = MapRevival(ekf.model, ekf.config) if problem.config.filter.retire == "unseen" else None
    for _ in run_filter(ekf, problem.sequence):
        pass
    return ekf


@pytest.mark.parametrize("variant", ["standard", "fej"])
def test_every_block_and_errors_of_tracks_in_the_city(variant):
    settings = {"filter": {"variant": variant, "retire": "never", **PRIOR}}
    ekf = drive(
        with_everything(builtin("city?frames=26")),
        {**settings, "calibration": CALIBRATION, "blocks": BLOCKS},
    )
    assert (ekf.log().previous >= 0).sum() > 400
    assert_equal_to_frozen_rows(ekf)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("blocks", "names"),
    [({"twist_bias": {}}, UNSHARED), pytest.param(BLOCKS, ALL_BLOCKS, marks=pytest.mark.slow)],
    ids=["unshared", "every"],
)
@pytest.mark.parametrize("variant", ["standard", "fej"] if WHOLE else ["fej"])
def test_every_block_and_errors_of_tracks_on_a_loop_with_revival(variant, blocks, names):
    settings = {"filter": {"variant": variant, "retire": "unseen", "retire_after": 3, **PRIOR}}
    world = with_everything(builtin("loop?frames=100&radius_m=10&landmarks=60"))
    ekf = drive(world, {**settings, "calibration": CALIBRATION, "blocks": blocks}, names)
    assert len(ekf.retired.revived) > 0
    assert_equal_to_frozen_rows(ekf)


@pytest.mark.data
@pytest.mark.parametrize("variant", ["standard", "fej"])
def test_every_block_and_errors_of_tracks_on_a_recording(data_path, variant):
    """The first frames: after 100 P is so close to singular (4e8) that rounding alone may exceed the tolerance."""
    frames = 60 if WHOLE else 25
    sequence = open_sequence(data_path("utias/2011_09_26_drive_0001_sync_KLT.mat"))
    seen = sequence.observations.frame < frames
    observations = dataclasses.replace(
        sequence.observations,
        **{name: getattr(sequence.observations, name)[seen] for name in ("frame", "landmark", "pixels_px")},
    )
    truth = Truth(sequence.truth.frame[:1], sequence.truth.T_world_imu[:1])
    short = dataclasses.replace(
        sequence,
        time_s=sequence.time_s[:frames],
        twist=sequence.twist[:frames],
        observations=observations,
        truth=truth,
    )
    found = resolve(short).model.noise
    walks = {key: EVERYTHING[key] for key in ("twist_walk_std", "motion_std")}
    noise = dataclasses.replace(found, **walks, twist_std=np.full(6, 0.05))
    settings = {
        "filter": {"variant": variant, "landmark_coordinates": "xyz"},
        "calibration": CALIBRATION,
        "blocks": BLOCKS,
    }
    assert_equal_to_frozen_rows(drive(dataclasses.replace(short, noise=noise), settings))


@pytest.mark.parametrize("part", ["twist", "up", "track", "calibration", "twist_bias", "camera_jitter", "vision_drift"])
@pytest.mark.parametrize("variant", ["standard", "fej"])
def test_every_block_by_itself(variant, part):
    keys = {
        "twist": ("twist_walk_std", "motion_std"),
        "up": ("tilt_rad",),
        "track": ("track_first_px", "track_walk_px"),
        "vision_drift": ("track_first_px", "track_walk_px"),
    }
    world = builtin("city?frames=20")
    chosen = {key: EVERYTHING[key] for key in keys.get(part, ())}
    world = dataclasses.replace(world, noise=dataclasses.replace(world.noise, **chosen))
    settings = {"filter": {"variant": variant, **PRIOR}}
    settings |= {"calibration": CALIBRATION} if part == "calibration" else {}
    settings |= {"blocks": {part: BLOCKS[part]}} if part in BLOCKS else {}
    views = ["view", "previous_view"] if part in ("track", "vision_drift") else []
    assert_equal_to_frozen_rows(drive(world, settings, ["pose", *views, *([] if part == "track" else [part])]))


@pytest.mark.slow
def test_a_loop_closes_under_automatic_noise():
    """A loop whose file states no noise: landmarks come back, and it ends as well as if they had never left."""
    world = "loop" if WHOLE else "loop?frames=120&radius_m=10&landmarks=60"
    world = builtin(world)
    movers = world.truth.landmark[::10].tolist()
    world = dataclasses.replace(tracked(world, TRACK_ERROR, movers=movers), noise=None)
    error, accepted, moving = {}, [], []
    for retire in ("never", "unseen"):
        result = run(world, "full", Config().with_overrides({"filter": {"retire": retire}}))
        error[retire] = truth_error(world, result)[-1]
        accepted.append(result.counts["accepted"])
        moving.append(result.counts["moving"])
        assert (result.counts["revived"] > 0) == (retire == "unseen")
        assert result.counts["reappeared"] == 0
    assert error["unseen"] < 1.2 * error["never"]
    # What speaks against a landmark is kept while it is away.
    assert moving[0] == moving[1] > 0
    assert accepted[0] == pytest.approx(accepted[1], rel=0.005)


@pytest.mark.slow
def test_as_filtered_of_a_run_with_every_block_is_the_filter():
    world = with_everything(builtin("city?frames=25"))
    settings = {
        "filter": {"variant": "standard", "landmark_coordinates": "xyz"},
        "calibration": CALIBRATION,
        "blocks": BLOCKS,
    }
    settings["posterior"] = {"linearisation": "filtered"}
    result = run(world, "full", Config().with_overrides(settings))
    found = posterior(result)
    np.testing.assert_allclose(found.T_world_imu[-1], result.T_world_imu[-1], atol=1e-8)
    np.testing.assert_allclose(found.pose_covariance[-1], result.covariance[-1], atol=1e-9)
    bias = found.block_covariance("twist_bias")
    at = [result.parameters.name.index(f"bias of {axis}") for axis in ("v_x", "w_z")]
    np.testing.assert_allclose(found.values["twist_bias"][-1, [0, 5]], result.parameters.value[-1, at], atol=1e-8)
    np.testing.assert_allclose(np.sqrt(np.diag(bias[-1])[[0, 5]]), result.parameters.std[-1, at], rtol=1e-6)
    assert found.block_covariance("up").shape == (3, 3)
    assert smooth(result).mode == "as filtered"


def test_a_log_of_an_older_release_gets_the_columns_of_views():
    """It has clones of pose and jitter in place of views, behind the pose and behind all seen blocks."""
    settings = {"filter": {"variant": "standard", **PRIOR}, "calibration": CALIBRATION, "blocks": BLOCKS}
    ekf = drive(with_everything(builtin("city?frames=6")), settings)
    log, layout = ekf.log(), ekf.model.layout
    parts = [["pose"], None, ["calibration", "camera_jitter", "vision_drift"], None, ["twist", "up", "twist_bias"]]
    columns = np.concatenate([np.full(6, -1) if names is None else layout.columns(names) for names in parts])

    def old(array):
        return np.where(columns < 0, 7.0, array[:, columns])

    former = dataclasses.replace(
        log,
        has_views=False,
        initial_covariance=old(old(log.initial_covariance).T),
        **{name: old(getattr(log, name)) for name in ("departed", "linear", "updated")},
    )
    found, own = in_layout(former, ekf.model), np.sort(columns[columns >= 0])
    for name in ("departed", "linear", "updated"):
        np.testing.assert_array_equal(getattr(found, name)[:, own], getattr(log, name)[:, own])
    np.testing.assert_array_equal(found.initial_covariance[np.ix_(own, own)], log.initial_covariance[np.ix_(own, own)])
    new, again = (posterior_of_log(some, ekf.model, ekf.landmarks().position_m, FILTERED) for some in (log, found))
    # Corrections of jitter and calibration between two frames are in the pose of the frame before: of second order.
    np.testing.assert_allclose(again.T_world_imu, new.T_world_imu, atol=2e-3)
