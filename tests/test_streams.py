"""Inputs of a live filter: joined velocities are those of the interval, and gaps are found wherever they are."""

from __future__ import annotations

import numpy as np
import pytest

from ekfslam.errors import MissingVelocityError
from ekfslam.filters.streams import Samples, Velocities
from ekfslam.geometry import se3

SPACING_S, LONG_S = 0.1, 0.3


def stream_of(kind, long_at=None, count=10, seed=0):
    """Return inputs at 0, 0.1, 0.2 s, ..., one step of which is long, added in another order."""
    rng, steps = np.random.default_rng(seed), np.full(count - 1, SPACING_S)
    if long_at is not None:
        steps[long_at] = LONG_S
    stamps = np.concatenate([[0.0], np.cumsum(steps)]).tolist()
    rows, stream = rng.standard_normal((count, 6)), kind(gap_s=0.2)
    for i in range(count) if kind is Samples else rng.permutation(count).tolist():
        stream.add(rows[i], stamps[i])
    return stream, stamps, rows


def moved(interval):
    T = np.eye(4)
    for dt, twist in zip(interval.dt_s, interval.inputs, strict=True):
        T = T @ se3.exp(dt * twist)
    return T


@pytest.mark.parametrize("long_at", [None, 0, 2, 5, 8])
@pytest.mark.parametrize("begin", [0.0, 0.05, 0.1, 0.35])
def test_joined_velocities_lead_to_the_pose_of_all_and_keep_their_gap(long_at, begin):
    stream, stamps, _ = stream_of(Velocities, long_at)
    ends = [begin + 0.01, begin + 0.12, *(stamp + 0.04 for stamp in stamps if stamp > begin), stamps[-1]]
    for end in [*ends, ends[0], ends[3]]:
        (one, is_held), (every, is_held_too) = stream.joined(begin, end), stream.during(begin, end)
        np.testing.assert_allclose(moved(one), moved(every), atol=1e-12)
        assert one.tau_s == every.tau_s == end - begin
        assert (one.is_gap, is_held) == (every.is_gap, is_held_too), end
        long = [] if long_at is None else stamps[long_at : long_at + 2]
        assert every.is_gap == bool(long and begin < long[1] and end > long[0]), end
        assert is_held == (end > stamps[-1])


def test_a_late_velocity_changes_what_was_joined_before():
    stream, _, rows = stream_of(Velocities)
    before = moved(stream.joined(0.05, 0.85)[0])
    stream.add(10.0 * rows[0], 0.45)
    after = moved(stream.joined(0.05, 0.85)[0])
    assert np.abs(after - before).max() > 0.01
    np.testing.assert_allclose(after, moved(stream.during(0.05, 0.85)[0]), atol=1e-12)


def test_velocities_that_are_forgotten_leave_the_newest_as_a_mark():
    for kind in (Velocities, Samples):
        stream, stamps, _ = stream_of(kind)
        whole = stream.during(0.35, 0.72)[0]
        stream.forget(0.35)
        assert stream.stamps == stamps[3:]
        stream.forget(0.3)
        assert stream.stamps == stamps[3:]
        part = stream.during(0.35, 0.72)[0]
        np.testing.assert_array_equal(part.inputs, whole.inputs)
        np.testing.assert_array_equal(part.dt_s, whole.dt_s)
        stream.forget(-1.0)
        assert stream.stamps == stamps[3:] and stream.has(0.4) and not stream.has(0.2)


def test_the_velocity_at_a_stamp_is_that_which_leads_to_it():
    stream, stamps, rows = stream_of(Velocities)
    for t, i, is_held in ((-1.0, 0, False), (0.1, 1, False), (0.11, 2, False), (stamps[-1], 9, False), (5.0, 9, True)):
        found, held = stream.at(t)
        np.testing.assert_array_equal(found, rows[i])
        assert held == is_held, t
    assert stream.driving(0.11) == stamps[2] and stream.driving(5.0) is None
    assert stream.serves(0.11, 0.2) and not stream.serves(0.11, 0.19) and stream.serves(5.0, 0.0)
    with pytest.raises(MissingVelocityError):
        Velocities(1.0).during(0.0, 1.0)
    assert not Velocities(1.0).serves(0.0, 1.0)


@pytest.mark.parametrize(("gap_s", "step", "is_gap"), [(0.2, 0.25, True), (9.0, 0.25, False), (9.0, 0.35, True)])
def test_samples_have_a_gap_if_a_step_is_longer_than_three_or_than_the_limit(gap_s, step, is_gap):
    stream, stamps = Samples(gap_s), [*np.arange(8) * 0.1, 0.7 + step]
    for t in stamps:
        stream.add(np.full(6, t), t)
    interval, is_held = stream.during(0.65, 0.7 + 0.5 * step)
    assert interval.is_gap == is_gap and not is_held
    np.testing.assert_allclose(interval.dt_s, [0.05, 0.5 * step])
    np.testing.assert_allclose(interval.inputs[:, 0], [0.675, 0.7 + 0.25 * step])  # linear between stamps
    assert not stream.during(0.35, 0.65)[0].is_gap
    assert stream.during(0.65, 2.0)[1] and stream.at(2.0)[1] and not stream.at(0.35)[1]
    np.testing.assert_allclose(stream.at(0.35)[0], np.full(6, 0.35))


def test_a_first_image_may_be_one_step_before_the_first_sample():
    stream, stamps, _ = stream_of(Samples)
    assert stream.begin_after(stamps[0] - 0.11) and not stream.begin_after(stamps[0] - 0.09)
    assert not Samples(1.0).begin_after(0.0) and not Velocities(1.0).begin_after(0.0)
    assert not stream.serves(stamps[-1] + 0.01, 99.0)  # samples wait for the next one
