"""Frames from states with turned extrinsics, blocks and calibration: the engine's are those of the reference filter."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.compiled import Case, assert_same_state, frames
from support.jacobians import POSES
from support.literal import OPEN, filter_of
from support.reference import small_world

from ekfslam.engine import choice
from ekfslam.filters.loop import run_filter
from ekfslam.geometry import se3
from ekfslam.geometry import stereo_motion as stereo
from ekfslam.geometry.camera import StereoCamera, project

pytestmark = pytest.mark.skipif(bool(choice.MISSING), reason=f"engine: {choice.MISSING}")

CASES = {
    "all": Case(),
    "standard": Case(variant="standard"),
    "dormant": Case(dormant=3),
    "no calibration": Case(calibration=False),
    "no blocks": Case(blocks=False),
    "white pixels": Case(tracks=False),
    "plain": Case(tracks=False, calibration=False, blocks=False),
    "plain, xyz": Case(tracks=False, calibration=False, blocks=False, coordinates="xyz"),
    "plain, xyz, standard": Case("standard", "xyz", tracks=False, calibration=False, blocks=False),
    "one camera": Case(tracks=False, calibration=False, blocks=False, monocular=True),
    "one camera, tracks, standard": Case("standard", calibration=False, blocks=False, monocular=True),
}
PLACES = {name: POSES[name] for name in ("near identity", "random 0", "near pi 3")}


@pytest.mark.parametrize("T", PLACES.values(), ids=PLACES.keys())
@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_frames_are_those_of_the_reference(case, T):
    both = case.filters(T)
    most = 0
    for reports in frames(both, 7, np.random.default_rng(5)):
        if reports is not None:
            np.testing.assert_array_equal(reports[0].reason, reports[1].reason)
            assert reports[0].nis == pytest.approx(reports[1].nis, rel=1e-8)
            most = max(most, reports[0].dof)
        assert_same_state(*both, 1e-8, floor=1e-15)
    assert most >= 6


@pytest.mark.parametrize("seed", range(5))
def test_an_alignment_of_two_frames_is_that_of_numpy(seed):
    rng = np.random.default_rng(seed)
    camera, n = StereoCamera(500.0, 510.0, 320.0, 240.0, 0.3), 40
    points = rng.uniform((-4, -2, 2), (4, 2, 20), (n, 3))
    T = se3.exp(np.r_[rng.normal(0, 0.3, 3), rng.normal(0, 0.05, 3)])
    before, now = (project(camera, q)[:, :3] + rng.normal(0, 0.2, (n, 3)) for q in (points, se3.apply(T, points)))
    now[:5] += rng.normal(0, 20, (5, 3))
    start = np.eye(4)
    start[2, 3] = -2.2  # the nearest points are behind the camera there
    for first in (np.eye(4), start):
        found, expected = (
            align(camera, before, now, first, 0.2, 2.0) for align in (stereo.align, stereo.align_in_numpy)
        )
        for name, value in vars(expected).items():
            np.testing.assert_allclose(getattr(found, name), value, rtol=1e-8, atol=1e-9, err_msg=name)


def test_innovations_are_whitened_unless_their_correlation_is_nearly_singular():
    """Precise pixels and turn rates that say little: smallest eigenvalues are on both sides of the bound, and near."""
    world = small_world(sigma_px=0.02, sigma_v=1e-3, sigma_w=0.3, frames=12)
    found = []
    for engine in ("engine", "reference"):
        ekf = filter_of(world, dataclasses.replace(OPEN, engine=engine))
        reports = [report.innovations for _, report, _ in run_filter(ekf, world)]
        found.append(np.concatenate([one.alone for one in reports if one is not None]))
    assert 50 < np.isnan(found[0]).any(axis=1).sum() < len(found[0]) - 50
    np.testing.assert_allclose(*found, atol=1e-5)  # NaN where the other is
