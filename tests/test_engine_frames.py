"""Frames that are hard to decide: verdicts and numbers of the compiled filter are those of the reference."""

import dataclasses

import numpy as np
import pytest
from support.compiled import assert_same_report, assert_same_state
from support.everything import BLOCKS, CALIBRATION, with_everything

from ekfslam.config import Config
from ekfslam.data.simulate import builtin
from ekfslam.engine import choice
from ekfslam.filters.consensus import DOUBT
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.models.sensors.base import GATE, MOVING
from ekfslam.resolve import resolve

pytestmark = pytest.mark.skipif(bool(choice.MISSING), reason=f"engine: {choice.MISSING}")

WILD = 9  # frame with a wrong velocity
WALKING = {"track_first_px": np.array([0.5, 0.6, 1.0]), "track_walk_px": np.full(3, 0.3), "track_flow_px": 20.0}


def with_walking_tracks(world):
    return dataclasses.replace(world, noise=dataclasses.replace(world.noise, **WALKING))


def with_tracks(world, change):
    """Return a world whose observations (frame, landmark, pixels) a function changes."""
    seen = world.observations
    arrays = change(seen.frame.copy(), seen.landmark.copy(), seen.pixels_px.copy())
    named = dict(zip(("frame", "landmark", "pixels_px"), arrays, strict=True))
    return dataclasses.replace(world, observations=dataclasses.replace(seen, **named))


def lossy(world, lost=0.2):
    """Return a world whose frames see a shuffled part of their landmarks; two frames see none."""
    rng = np.random.default_rng(1)

    def change(frame, landmark, pixels):
        kept = (rng.random(len(frame)) > lost) & ~np.isin(frame, (6, 7))
        order = np.flatnonzero(kept)[np.lexsort((rng.random(kept.sum()), frame[kept]))]
        return frame[order], landmark[order], pixels[order]

    return with_tracks(world, change)


def with_traffic(world):
    """Return a world in which every fourth track drifts to the right."""

    def change(frame, landmark, pixels):
        moves = landmark % 4 == 0
        pixels[np.ix_(moves, [0, 2])] += 1.5 * frame[moves, None]
        return frame, landmark, pixels

    return with_tracks(world, change)


def with_jumps(world):
    """Return a world in which some tracks continue on another point."""

    def change(frame, landmark, pixels):
        pixels[(landmark % 5 == 1) & (frame >= WILD)] += [25.0, 12.0, 25.0, 12.0]
        return frame, landmark, pixels

    return with_tracks(world, change)


def with_wild_velocity(world, sigmas=15.0):
    twist = world.twist.copy()
    twist[WILD] += sigmas * world.noise.twist_std * [1.0, -1.0, 1.0, -1.0, 1.0, 1.0]
    return dataclasses.replace(world, twist=twist)


def assert_same_frame(filters, reports):
    """Compare reports, states and tables of the engine and the reference filter."""
    assert_same_report(*reports)
    # Whitening multiplies rounding by the condition of S, which is up to 1e6 where the prediction is wide.
    np.testing.assert_allclose(*(report.innovations.alone for report in reports), rtol=1e-6, atol=1e-6)
    assert_same_state(*filters)
    for name in ("misses", "log_row", "last_step", "last_observation", "observations"):
        np.testing.assert_array_equal(*(getattr(ekf.table, name) for ekf in filters), err_msg=name)


def reports_of_both(world, settings=None):
    """Return the reports of the engine, after a comparison of each frame with the reference filter."""
    problem = resolve(world, Config().with_overrides({"filter": {"revive": -1}, **(settings or {})}))
    filters = [
        JointEKF(problem.model, dataclasses.replace(problem.config.filter, engine=engine))
        for engine in ("engine", "reference")
    ]
    reports = []
    for frames in zip(*(run_filter(ekf, problem.sequence) for ekf in filters), strict=True):
        assert_same_frame(filters, [frame.report for frame in frames])
        reports.append(frames[0].report)
    return reports


def count(reports, reason):
    return sum(int((report.reason == reason).sum()) for report in reports)


@pytest.mark.parametrize("variant", ["invariant", "standard"])
def test_frames_that_see_a_shuffled_part_of_the_landmarks(variant):
    world = lossy(with_walking_tracks(builtin("loop?frames=16&landmarks=60&max_tracks=12")))
    reports = reports_of_both(world, {"filter": {"revive": -1, "variant": variant}})
    assert reports[6].dof == reports[7].dof == 0


def test_tracks_that_move_along():
    reports = reports_of_both(with_traffic(with_walking_tracks(builtin("city?frames=14&max_tracks=20"))))
    assert count(reports, MOVING) > 5


def test_tracks_that_jump_are_split():
    reports = reports_of_both(with_jumps(builtin("city?frames=16&max_tracks=20&outlier_fraction=0.02")))
    assert count(reports, GATE) > 5 and sum(len(report.split) for report in reports)


@pytest.mark.parametrize("settings", [{}, {"calibration": CALIBRATION}])
@pytest.mark.parametrize("tracks", [3, 20])
def test_a_wild_velocity(tracks, settings):
    world = with_wild_velocity(builtin(f"city?frames=12&max_tracks={tracks}"))
    reports = reports_of_both(lossy(world, 0.0), settings)
    assert [report.frame for report in reports if report.doubt == DOUBT] == [WILD]


def test_predictions_that_are_wide():
    world = builtin("city?frames=10&max_tracks=12&outlier_fraction=0.02&sigma_w_rad_s=0.6&sigma_v_m_s=2")
    reports_of_both(world)


def test_velocities_that_walk_with_every_block():
    world = with_traffic(lossy(with_everything(builtin("city?frames=14&max_tracks=20"))))
    reports = reports_of_both(with_wild_velocity(world), {"blocks": BLOCKS, "calibration": CALIBRATION})
    assert count(reports, MOVING)


def test_sixty_landmarks_with_outliers():
    reports = reports_of_both(lossy(builtin("city?frames=10&max_tracks=60&outlier_fraction=0.06")))
    assert count(reports, GATE) > 10
