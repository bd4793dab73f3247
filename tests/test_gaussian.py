"""Every verb of the covariance against its naive form; the table of landmarks stays aligned."""

import numpy as np
import pytest

from ekfslam.config import FilterConfig
from ekfslam.errors import InnovationError
from ekfslam.filters.gates import agrees_with_others, moves_along
from ekfslam.filters.gaussian import Gaussian, Rows
from ekfslam.filters.landmarks import LandmarkTable

BODY, SEEN, POSE, CLONE, WALK = 14, 12, slice(0, 6), slice(6, 12), slice(12, 14)


class Naive:
    """P as one matrix, and every verb by its textbook formula."""

    def __init__(self, body):
        self.P, self.b, self.considered = body.copy(), len(body), 0

    @property
    def n(self):
        return (len(self.P) - self.b) // 3

    def linear(self, F, Q=0.0):
        self.P = F @ self.P @ F.T + Q

    def propagate(self, Phi, Q):
        F, wide = np.eye(len(self.P)), np.zeros_like(self.P)
        F[:BODY, :BODY], wide[:BODY, :BODY] = Phi, Q
        self.linear(F, wide)

    def H(self, rows):
        k, d = rows.residual.shape
        H = np.zeros((k, d, len(self.P)))
        H[..., :SEEN] = rows.H_x
        for i, slot in enumerate(rows.slot):
            H[i, :, self.b + 3 * slot : self.b + 3 * slot + 3] = rows.H_m[i]
        return H.reshape(k * d, -1)

    def condition(self, H, r, V):
        S = H @ self.P @ H.T + np.diag(V)
        gain = self.P @ H.T @ np.linalg.inv(S)
        at = slice(self.b - self.considered, self.b)
        own = self.P[at, at].copy()
        self.P = self.P - gain @ S @ gain.T
        self.P[at, at] = own
        correction = gain @ r
        correction[at] = 0.0
        return correction, r @ np.linalg.solve(S, r), np.linalg.slogdet(S)[1], S

    def augment(self, G, C):
        wide = np.zeros((3 * len(G), len(self.P)))
        wide[:, :SEEN] = G.reshape(-1, SEEN)
        self.linear(np.vstack([np.eye(len(self.P)), wide]))
        for i, block in enumerate(C):
            at = slice(len(self.P) - 3 * (len(C) - i), len(self.P) - 3 * (len(C) - i) + 3)
            self.P[at, at] += block

    def transform_landmarks(self, slot, M, B, columns):
        F = np.eye(len(self.P))
        for i, landmark in enumerate(slot):
            at = slice(self.b + 3 * landmark, self.b + 3 * landmark + 3)
            F[at, at] = np.eye(3) if M is None else M[i]
            F[at, columns] = B[i]
        self.linear(F)

    def transform_body(self, at, A):
        F = np.eye(len(self.P))
        F[at, at] = A
        self.linear(F)

    def marginalise(self, stay):
        kept = np.flatnonzero(np.concatenate([np.ones(self.b, dtype=bool), np.repeat(stay, 3)]))
        self.P = self.P[np.ix_(kept, kept)]

    def consider(self, columns):
        self.P = np.insert(np.insert(self.P, [self.b] * columns, 0.0, axis=0), [self.b] * columns, 0.0, axis=1)
        self.b, self.considered = self.b + columns, self.considered + columns

    def clone(self, source, to):
        F = np.eye(len(self.P))
        F[to], F[to, source] = 0.0, np.eye(6)
        self.linear(F)


def rows_of(rng, slots, d=3):
    k = len(slots)
    H_x = rng.normal(size=(k, d, SEEN))
    H_x[rng.random(k) < 0.5, :, CLONE] = 0.0
    return Rows(np.array(slots), H_x, rng.normal(size=(k, d, 3)), rng.normal(size=(k, d)), rng.uniform(0.5, 2, (k, d)))


def same(gaussian, naive, scale=1e-9):
    """P, and every part of it that can be asked for."""
    std = np.sqrt(np.diag(naive.P))
    scale = scale * np.outer(std, std) + 1e-13
    assert (np.abs(gaussian.P - naive.P) <= scale).all()
    np.testing.assert_array_equal(gaussian.P, gaussian.P.T)
    assert (np.abs(gaussian.body_covariance - naive.P[: naive.b, : naive.b]) <= scale[: naive.b, : naive.b]).all()
    assert gaussian.landmarks == naive.n
    assert gaussian.is_finite
    if naive.n > 2:
        slot = np.array([2, 0])
        own = naive.b + (3 * slot[:, None] + np.arange(3)).ravel()
        columns = np.concatenate([np.arange(naive.b), own])
        part = naive.P[np.ix_(columns, columns)]
        assert (np.abs(gaussian.covariance_of(slot) - part) <= scale[np.ix_(columns, columns)]).all()
        np.testing.assert_allclose(
            gaussian.landmark_blocks(slot)[0], part[naive.b : naive.b + 3, naive.b : naive.b + 3]
        )
        np.testing.assert_allclose(gaussian.landmark_blocks()[2], gaussian.landmark_blocks(slot)[0])


def _by_landmark(gaussian, solution):
    return solution.done.correction[gaussian.body :].reshape(-1, 3)


def condition(rng, gaussian, naive, slots, out):
    """Condition both on rows, of which some are taken out again; everything a solution says is compared."""
    rows, d = rows_of(rng, slots), 3
    H, r, V = naive.H(rows), rows.residual.ravel(), rows.variance.ravel()
    ids = 100 + np.arange(len(slots))
    projection = gaussian.project(rows, 0, ids)
    S = H @ naive.P @ H.T + np.diag(V)
    for i, block in enumerate(projection.variances):
        own = slice(i * d, i * d + d)
        np.testing.assert_allclose(block + np.diag(V[own]), S[own, own], rtol=1e-9)
    before = gaussian.P.copy()
    solution = gaussian.solve(projection, 0, ids)
    inverse, std = np.linalg.inv(S), np.sqrt(rows.variance)
    left = rows.corrected(solution.done.correction[: gaussian.seen], _by_landmark(gaussian, solution))
    blocks = solution.given_others()
    for i, C in enumerate(blocks):
        own = slice(i * d, i * d + d)
        np.testing.assert_allclose(C, inverse[own, own] * np.outer(std[i], std[i]), atol=1e-9)
    squares, _ = agrees_with_others(left, blocks)
    for i in range(len(slots)):
        others = np.delete(np.arange(len(S)), np.s_[i * d : i * d + d])
        gain = np.linalg.solve(S[np.ix_(others, others)], S[others, i * d : i * d + d]).T
        rest = rows.residual[i] - gain @ r[others]
        block = S[i * d : i * d + d, i * d : i * d + d] - gain @ S[others, i * d : i * d + d]
        np.testing.assert_allclose(squares[i], rest @ np.linalg.solve(block, rest), rtol=1e-6, atol=1e-9)
    out = np.isin(np.arange(len(slots)), out)
    if out.any():
        solution = gaussian.solve(projection.only(np.flatnonzero(~out)), 0, ids[~out])
    kept = np.flatnonzero(np.repeat(~out, d))
    J = rng.normal(size=(int((~out).sum()), d, 6))
    flat = J.reshape(-1, 6)
    S_kept = S[np.ix_(kept, kept)]
    np.testing.assert_allclose(solution.information(J), flat.T @ np.linalg.inv(S_kept) @ flat, rtol=1e-7, atol=1e-9)
    correction, nis, log_det, _ = naive.condition(H[kept], r[kept], V[kept])
    np.testing.assert_allclose(solution.done.correction, correction, atol=1e-9)
    np.testing.assert_allclose([solution.done.nis, solution.done.log_det], [nis, log_det], atol=1e-9)
    np.testing.assert_array_equal(gaussian.P, before)
    gaussian.apply(solution)
    np.testing.assert_allclose(solution.done.correction, correction, atol=1e-9)


def step(rng):
    """Phi and Q of a frame: the clone takes the pose's place, the pose moves, the rest wanders."""
    Phi, Q = np.eye(BODY), np.zeros((BODY, BODY))
    Phi[CLONE, CLONE], Phi[CLONE, POSE] = 0.0, np.eye(6)
    Phi[POSE, POSE] += 0.1 * rng.normal(size=(6, 6))
    Phi[POSE, WALK] = 0.1 * rng.normal(size=(6, 2))
    Q[POSE, POSE], Q[WALK, WALK] = 0.01 * np.eye(6), 0.02 * np.eye(2)
    return Phi, Q


@pytest.mark.parametrize("certain", [False, True], ids=["uncertain", "certain"])
@pytest.mark.parametrize("considered", [0, 12])
def test_all_verbs_over_many_frames(considered, certain):
    """Landmarks come, are seen in part and shuffled, and leave; coordinates change; all is compared in every frame."""
    rng = np.random.default_rng(considered + certain)
    body = np.diag(rng.uniform(0.01, 0.1, BODY)) * (not certain)
    gaussian, naive = Gaussian(body, SEEN), Naive(body)
    if considered:
        assert gaussian.consider(considered) == BODY
        naive.consider(considered)
    for frame in range(25):
        Phi, Q = step(rng)
        gaussian.propagate(Phi, Q), naive.propagate(Phi, Q)
        same(gaussian, naive)
        H, r, V = rng.normal(size=(2, BODY)), rng.normal(size=2), np.array([0.3, 0.7])
        solution = gaussian.solve_body(H, r, V, frame)
        gaussian.apply(solution)
        wide = np.hstack([H, np.zeros((2, len(naive.P) - BODY))])
        correction, nis, log_det, _ = naive.condition(wide, r, V)
        np.testing.assert_allclose(solution.done.correction, correction, atol=1e-9)
        np.testing.assert_allclose([solution.done.nis, solution.done.log_det], [nis, log_det], atol=1e-9)
        if naive.n:
            slots = rng.permutation(naive.n)[: max(3, naive.n - 2)]
            condition(rng, gaussian, naive, slots, out=[[], [1], [0, 2]][frame % 3] if len(slots) > 2 else [])
            same(gaussian, naive)
            which = np.flatnonzero(rng.random(naive.n) < 0.6) if frame % 2 else np.arange(naive.n)
            M = None if frame % 4 < 2 else np.eye(3) + 0.1 * rng.normal(size=(len(which), 3, 3))
            B, columns = 0.1 * rng.normal(size=(len(which), 3, 6)), np.arange(6, 12)
            gaussian.transform_landmarks(which, M, B, columns), naive.transform_landmarks(which, M, B, columns)
            A = np.eye(6) + 0.1 * rng.normal(size=(6, 6))
            gaussian.transform_body(CLONE, A), naive.transform_body(CLONE, A)
            same(gaussian, naive)
        new = [4, 0, 2][frame % 3]
        G, C = rng.normal(size=(new, 3, SEEN)), np.stack([(1 + i) * 0.1 * np.eye(3) for i in range(new)] or [np.eye(3)])
        G[..., CLONE] = 0.0
        if new:
            gaussian.augment(G, C[:new]), naive.augment(G, C[:new])
        if naive.n > 7:
            stay = rng.random(naive.n) < 0.7
            stay[:3] = True
            stay[0] = frame < 15  # one landmark outlives all others
            gaussian.marginalise(stay), naive.marginalise(stay)
        if considered and frame % 5 == 0:
            gaussian.clone(POSE, slice(BODY, BODY + 6)), naive.clone(POSE, slice(BODY, BODY + 6))
        same(gaussian, naive)
    assert naive.n > 3


def test_nothing_but_landmarks_is_uncertain():
    rng = np.random.default_rng(10)
    nothing, C = np.zeros((BODY, BODY)), np.stack([(1 + i) * 0.1 * (np.eye(3) + 0.4) for i in range(5)])
    gaussian, naive = Gaussian(nothing, SEEN), Naive(nothing)
    G = rng.normal(size=(5, 3, SEEN))
    gaussian.augment(G, C), naive.augment(G, C)
    gaussian.propagate(np.eye(BODY), nothing)
    for slots in ([3, 1, 4], [1, 2]):
        condition(rng, gaussian, naive, slots, out=[1])
        same(gaussian, naive)


def test_another_covariance_takes_its_place():
    rng = np.random.default_rng(7)
    root = rng.normal(size=(BODY + 15,) * 2)
    gaussian, naive = Gaussian(np.eye(BODY), SEEN), Naive(np.eye(BODY))
    gaussian.consider(6)
    naive.P = root @ root.T
    gaussian.start_over(naive.P)
    naive.consider(6)
    same(gaussian, naive)
    condition(rng, gaussian, naive, [3, 1, 4], out=[1])
    Phi, Q = step(rng)
    gaussian.propagate(Phi, Q), naive.propagate(Phi, Q)
    same(gaussian, naive)
    gaussian.replace(0.5 * (naive.P + naive.P.T))
    gaussian.marginalise(np.array([True, False, True, True, False]))
    naive.marginalise(np.array([True, False, True, True, False]))
    same(gaussian, naive)


def test_all_rows_taken_out_leave_what_was():
    rng = np.random.default_rng(8)
    root = rng.normal(size=(BODY + 9,) * 2)
    gaussian = Gaussian(np.eye(BODY), SEEN)
    gaussian.replace(root @ root.T)
    projection = gaussian.project(rows_of(rng, [1, 2]), 0, np.arange(2))
    solution = gaussian.solve(projection.only(np.empty(0, dtype=np.int64)), 0, np.empty(0, dtype=np.int64))
    done = solution.done
    assert done.nis == 0 and done.log_det == 0 and not done.correction.any()
    gaussian.apply(solution)
    np.testing.assert_allclose(gaussian.P, root @ root.T, atol=1e-11)


def test_an_innovation_covariance_that_is_not_positive_definite_is_named():
    rng = np.random.default_rng(9)
    gaussian = Gaussian(np.eye(BODY), SEEN)
    gaussian.replace(np.eye(BODY + 9))
    rows = rows_of(rng, [1, 2])
    rows.variance[1] = -100.0
    with pytest.raises(InnovationError, match=r"frame 4.*71"):
        gaussian.solve(gaussian.project(rows, 4, np.array([70, 71])), 4, np.array([70, 71]))
    rows.variance[1], rows.H_x[1, 0, 0] = 1.0, np.nan
    with pytest.raises(InnovationError, match=r"frame 4.*71"):
        gaussian.solve(gaussian.project(rows, 4, np.array([70, 71])), 4, np.array([70, 71]))


def test_a_landmark_moves_from_its_third_observation_on_if_its_evidence_is_large():
    table = LandmarkTable(dimension=3, extra=0)
    table.append(id=[1, 2, 3, 4], position_m=np.zeros((4, 3)), observations=[2, 3, 9, 3])
    along, information = np.array([50.0, -50.0, 50.0, 1.0]), np.full(4, 25.0)
    config = FilterConfig(moving_sigma=3.0, moving_share=0.05)
    verdict = moves_along(table, np.arange(4), (along, information), np.full(4, 100.0), 25.0, config)
    assert verdict.tolist() == [False, True, True, False]
    # Gross outliers count as at the gate: half of what they show.
    np.testing.assert_allclose(table.evidence, np.column_stack([0.5 * along, information]))


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
    found = table.snapshot(np.array([1]), 3 * np.eye(3)[None])
    assert found.id.tolist() == [9] and found.covariance[0, 0, 0] == 3 and found.observations.tolist() == [1]
