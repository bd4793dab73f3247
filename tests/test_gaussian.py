"""Every verb of the covariance against its naive dense form; the table of landmarks stays aligned."""

import numpy as np
import pytest

from ekfslam.filters.gaussian import Gaussian, Rows
from ekfslam.filters.landmarks import LandmarkTable

BODY, SEEN, LANDMARKS = 9, 6, 5


def gaussian_of(rng):
    root = rng.normal(size=(BODY + 3 * LANDMARKS,) * 2)
    gaussian = Gaussian(np.eye(BODY), SEEN)
    gaussian.replace(root @ root.T)
    return gaussian, gaussian.P.copy()


def rows_of(rng, slots, d):
    k = len(slots)
    rows = Rows(
        np.array(slots),
        rng.normal(size=(k, d, SEEN)),
        rng.normal(size=(k, d, 3)),
        rng.normal(size=(k, d)),
        rng.uniform(0.5, 2, (k, d)),
    )
    H = np.zeros((k * d, BODY + 3 * LANDMARKS))
    for i, slot in enumerate(slots):
        H[i * d : i * d + d, :SEEN] = rows.H_x[i]
        H[i * d : i * d + d, BODY + 3 * slot : BODY + 3 * slot + 3] = rows.H_m[i]
    return rows, H


@pytest.mark.parametrize("d", [2, 3])
def test_conditioning_on_a_shuffled_subset_and_taking_it_out_again(d):
    rng = np.random.default_rng(d)
    gaussian, P = gaussian_of(rng)
    rows, H = rows_of(rng, [3, 1, 4], d)
    V, r = np.diag(rows.variance.ravel()), rows.residual.ravel()
    S = H @ P @ H.T + V
    HP, HPH = gaussian.project(rows)
    np.testing.assert_allclose(HP, H @ P, atol=1e-10)
    np.testing.assert_allclose(HPH, H @ P @ H.T, atol=1e-9)
    for i, block in enumerate(gaussian.variances(rows)):
        own = slice(i * d, i * d + d)
        np.testing.assert_allclose(block, (H @ P @ H.T)[own, own], atol=1e-9)
    ids = np.array([7, 8, 9])
    np.testing.assert_allclose(gaussian.correction(rows, 0, ids), P @ H.T @ np.linalg.solve(S, r), atol=1e-9)
    np.testing.assert_array_equal(gaussian.P, P)

    done = gaussian.condition(rows, 0, ids)
    np.testing.assert_allclose(gaussian.P, P - P @ H.T @ np.linalg.solve(S, H @ P), atol=1e-9)
    np.testing.assert_array_equal(gaussian.P, gaussian.P.T)
    np.testing.assert_allclose(done.correction, P @ H.T @ np.linalg.solve(S, r), atol=1e-9)
    np.testing.assert_allclose([done.nis, done.log_det], [r @ np.linalg.solve(S, r), np.linalg.slogdet(S)[1]])
    left = rows.corrected(done.correction[:SEEN], done.correction[BODY:].reshape(-1, 3))
    out = gaussian.condition(left, 0, ids, sign=-1.0)
    np.testing.assert_allclose(gaussian.P, P, atol=1e-7)
    nothing = done - out
    np.testing.assert_allclose(nothing.correction, 0, atol=1e-8)
    np.testing.assert_allclose([nothing.nis, nothing.log_det], 0, atol=1e-8)


def test_the_other_verbs():
    rng = np.random.default_rng(5)
    gaussian, P = gaussian_of(rng)
    Phi, Q = rng.normal(size=(BODY, BODY)), np.diag(rng.uniform(1, 2, BODY))
    F = np.eye(len(P))
    F[:BODY, :BODY] = Phi
    gaussian.propagate(Phi, Q)
    P = F @ P @ F.T
    P[:BODY, :BODY] += Q
    np.testing.assert_allclose(gaussian.P, P, atol=1e-9)

    phi, std = np.array([0.5, 0.9, 0.2]), np.array([1.0, 2.0, 3.0])
    gaussian.wander(slice(6, 9), phi, std)
    F, own = np.eye(len(P)), np.arange(6, 9)
    F[own, own] = phi
    P = F @ P @ F.T
    P[own, own] += std**2
    np.testing.assert_allclose(gaussian.P, P, atol=1e-9)

    H, r, variance = rng.normal(size=(2, BODY)), rng.normal(size=2), np.array([0.3, 0.7])
    wide = np.hstack([H, np.zeros((2, 3 * LANDMARKS))])
    S = wide @ P @ wide.T + np.diag(variance)
    done = gaussian.condition_body(H, r, variance, 0)
    np.testing.assert_allclose(done.correction, P @ wide.T @ np.linalg.solve(S, r), atol=1e-9)
    P = P - P @ wide.T @ np.linalg.solve(S, wide @ P)
    np.testing.assert_allclose(gaussian.P, P, atol=1e-9)

    G, C = rng.normal(size=(2, 3, SEEN)), np.stack([np.eye(3), 2 * np.eye(3)])
    gaussian.augment(G, C)
    grow = np.vstack([np.eye(len(P)), np.hstack([G.reshape(6, SEEN), np.zeros((6, len(P) - SEEN))])])
    P = grow @ P @ grow.T
    P[-6:, -6:] += np.kron(np.diag([1, 2]), np.eye(3))
    np.testing.assert_allclose(gaussian.P, P, atol=1e-9)

    stay = np.array([True, False, True, True, False, True, True])
    gaussian.marginalise(stay)
    kept = np.flatnonzero(np.concatenate([np.ones(BODY, dtype=bool), np.repeat(stay, 3)]))
    np.testing.assert_allclose(gaussian.P, P[np.ix_(kept, kept)], atol=1e-9)


def test_the_table_keeps_its_columns_aligned():
    table = LandmarkTable(dimension=2, extra=1)
    table.append(id=[5, 2], position_m=np.array([[1.0, 2, 3], [4, 5, 6]]), observations=[1, 7], extra=[[0.5], [0.6]])
    table.append(id=[9], position_m=np.full((1, 3), 9.0), first_frame=4)
    assert table.id.tolist() == [5, 2, 9] and table.observations.tolist() == [1, 7, 0]
    slot, known = table.lookup(np.array([9, 3, 2]))
    assert known.tolist() == [True, False, True] and slot[known].tolist() == [2, 1]
    table.observed(np.array([2, 0]), 11, np.array([[1.0, 2], [3, 4]]), np.array([21, 22]))
    table.accepted(np.array([2]), 8)
    table.keep(np.array([True, False, True]))
    assert len(table) == 2
    assert table.last_observation.tolist() == [22, 21] and table.last_step.tolist() == [11, 11]
    assert table.seen_rows.tolist() == [[3, 4], [1, 2]] and table.extra.tolist() == [[0.5], [0.0]]
    assert table.last_frame.tolist() == [0, 8] and table.first_frame.tolist() == [0, 4]
    found = table.snapshot(np.array([1]), np.stack([np.eye(3), 3 * np.eye(3)]))
    assert found.id.tolist() == [9] and found.covariance[0, 0, 0] == 3 and found.observations.tolist() == [1]
