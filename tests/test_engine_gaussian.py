"""The covariance of the engine against a literal one: one matrix P, each verb a few lines."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import pytest
from scipy.linalg import block_diag

from ekfslam.arrays import Array, BoolArray, IntArray

engine = pytest.importorskip("ekfslam.engine._engine", reason="the engine is not built")

# Layout of the body: pose, a block that walks, view, intrinsics, previous view, anchor, a block that is measured.
POSE, WALK, VIEW, INTRINSICS, PREVIOUS, ANCHOR, TWIST = 0, 6, 9, 15, 17, 23, 29
BODY = 35
FRONT = [15, 16]


class Literal:
    """One matrix over body, drifted view (6), considered columns and landmarks."""

    def __init__(self, P_body: Array) -> None:
        self.P = block_diag(P_body, np.zeros((6, 6)))
        self.considered, self.drifts = 0, False
        self.Y = self.Yd = np.zeros((6, BODY))

    @property
    def first(self) -> int:
        return BODY + 6 + self.considered

    @property
    def n(self) -> int:
        return (len(self.P) - self.first) // 3

    def own(self, slot: IntArray) -> IntArray:
        return (self.first + 3 * np.asarray(slot, dtype=np.int64)[:, None] + np.arange(3)).ravel()

    def lead(self) -> IntArray:
        drifted = np.arange(BODY, BODY + 6) if self.drifts else np.arange(0)
        parts = [FRONT, ANCHOR + np.arange(6), drifted, VIEW + np.arange(6), PREVIOUS + np.arange(6)]
        return np.concatenate(parts).astype(np.int64)

    def outside(self) -> Array:
        """P in the order of the engine: without the drifted view."""
        kept = np.delete(np.arange(len(self.P)), np.arange(BODY, BODY + 6))
        return self.P[np.ix_(kept, kept)]

    def by(self, A: Array, noise: Array | None = None) -> None:
        P = A @ self.P @ A.T
        if noise is not None:
            P[:BODY, :BODY] += noise
        self.P = 0.5 * (P + P.T)

    def eye(self) -> Array:
        return np.eye(len(self.P))

    def copies(self, source: int, to: int) -> None:
        A = self.eye()
        A[to : to + 6] = A[source : source + 6]
        self.by(A)

    def propagate(self, Phi: Array, Q: Array) -> None:
        A = self.eye()
        A[:BODY, :BODY] = Phi
        self.by(A, Q)

    def open_view(self, Y: Array, Yd: Array | None) -> None:
        A = self.eye()
        A[VIEW : VIEW + 6] = A[BODY : BODY + 6] = 0.0
        A[VIEW : VIEW + 6, :BODY] = Y
        if Yd is not None:
            A[BODY : BODY + 6, :BODY] = Yd
        self.Y, self.drifts = Y, Yd is not None
        self.Yd = np.zeros((6, BODY)) if Yd is None else Yd
        self.by(A)

    def add_noise(self, Q: Array) -> None:
        A = np.zeros((len(self.P), BODY))
        A[:BODY] = np.eye(BODY)
        A[VIEW : VIEW + 6], A[BODY : BODY + 6] = self.Y, self.Yd
        self.P += A @ Q @ A.T

    def H(self, rows: tuple) -> Array:
        slot, H_x, H_m = rows[:3]
        k, d = H_x.shape[:2]
        H = np.zeros((k, d, len(self.P)))
        H[..., self.lead()] = H_x
        for i in range(k):
            H[i][:, self.own(slot[i : i + 1])] = H_m[i]
        return H.reshape(k * d, -1)

    def solve(self, H: Array, residual: Array, variance: Array) -> tuple[Array, float, float]:
        S = H @ self.P @ H.T + np.diag(variance)
        self.S, self.left = S, residual
        gain = np.linalg.solve(S, H @ self.P).T
        c = slice(BODY + 6, self.first)
        gain[c] = 0.0
        self.gain, self.last = gain, H
        x = np.delete(gain @ residual, np.arange(BODY, BODY + 6))
        return x, float(residual @ np.linalg.solve(S, residual)), float(np.linalg.slogdet(S)[1])

    def apply(self, variance: Array) -> None:
        A = self.eye() - self.gain @ self.last
        P = A @ self.P @ A.T + self.gain @ np.diag(variance) @ self.gain.T
        self.P = 0.5 * (P + P.T)

    def augment(self, G: Array, covariance: Array) -> None:
        A = np.zeros((3 * len(G), len(self.P)))
        A[:, self.lead()] = G.reshape(3 * len(G), -1)
        AP = A @ self.P
        self.P = np.block([[self.P, AP.T], [AP, AP @ A.T + block_diag(*covariance)]])

    def transform_landmarks(self, slot: IntArray, M: Array | None, B: Array, at: int) -> None:
        A = self.eye()
        for i, s in enumerate(slot):
            own = self.own(np.array([s]))
            if M is not None:
                A[np.ix_(own, own)] = M[i]
            A[own, at : at + 6] = B[i]
        self.by(A)

    def transform_body(self, at: int, M: Array) -> None:
        A = self.eye()
        A[at : at + len(M), at : at + len(M)] = M
        self.by(A)

    def marginalise(self, stay: BoolArray) -> None:
        kept = np.concatenate([np.arange(self.first), self.own(np.flatnonzero(stay))])
        self.P = self.P[np.ix_(kept, kept)]

    def consider(self, columns: int) -> None:
        at = self.first
        self.P = np.insert(np.insert(self.P, [at] * columns, 0.0, axis=0), [at] * columns, 0.0, axis=1)
        self.considered += columns

    def clone(self, source: int, size: int, to: int) -> None:
        A = self.eye()
        A[to + 6 : to + 6 + size] = A[source : source + size]
        self.by(A)

    def replace(self, P: Array) -> None:
        """Take a P in the order of the engine; the drifted view is made anew."""
        at = np.arange(len(P) + 6)
        kept = np.delete(at, np.arange(BODY, BODY + 6))
        self.P = np.zeros((len(at), len(at)))
        self.P[np.ix_(kept, kept)] = P
        A = self.eye()
        A[BODY : BODY + 6] = 0.0
        A[BODY : BODY + 6, :BODY] = self.Yd
        self.by(A)


class Pair:
    """Engine and literal covariance, and random arguments for both."""

    def __init__(self, seed: int, P_body: Array | None = None) -> None:
        self.rng = np.random.default_rng(seed)
        if P_body is None:
            root = self.rng.standard_normal((BODY, BODY)) * 0.3
            P_body = root @ root.T
            P_body[:] = np.where(np.isin(np.arange(BODY), self.views())[:, None], 0.0, P_body)
            P_body[:, self.views()] = 0.0
        self.a = engine.Gaussian(P_body, VIEW, PREVIOUS, ANCHOR, FRONT)
        self.b = Literal(P_body)
        self.walks = False
        self.asleep = np.zeros(0, dtype=bool)
        self.drift = True

    @staticmethod
    def views() -> IntArray:
        return np.concatenate([at + np.arange(6) for at in (VIEW, PREVIOUS, ANCHOR)])

    def normal(self, *shape: int) -> Array:
        return self.rng.standard_normal(shape)

    def check(self, tolerance: float = 1e-10) -> None:
        n = self.b.n
        assert self.a.landmarks == n
        slots = self.rng.permutation(n)
        P = self.a.covariance_of(slots.tolist())
        order = np.concatenate([np.arange(self.b.first - 6), self.b.own(slots) - 6])
        expected = self.b.outside()[np.ix_(order, order)]
        scale = np.sqrt(np.maximum(np.diag(expected), 1e-6))
        worst = np.abs((P - expected) / np.outer(scale, scale)).max()
        assert worst < tolerance, worst
        b = self.b.first - 6
        np.testing.assert_allclose(self.a.body_covariance, P[:b, :b], atol=1e-12 * P.max())
        own = [P[b + 3 * i : b + 3 * i + 3, b + 3 * i : b + 3 * i + 3] for i in range(n)]
        np.testing.assert_allclose(
            self.a.landmark_blocks(slots.tolist()), np.reshape(own, (n, 3, 3)), atol=1e-12 * P.max()
        )

    def both(self, verb: str, *args: object, **kwargs: object) -> None:
        getattr(self.a, verb)(
            *[x.tolist() if isinstance(x, np.ndarray) and x.dtype in (bool, int) else x for x in args]
        )
        getattr(self.b, verb)(*args)

    def noise(self) -> Array:
        noisy = [*range(POSE, POSE + 6), *range(WALK, WALK + 3), *(FRONT if self.walks else [])]
        root = np.zeros((BODY, BODY))
        root[np.ix_(noisy, noisy)] = 0.05 * self.normal(len(noisy), len(noisy))
        return root @ root.T

    def sees(self) -> Array:
        Y = np.zeros((6, BODY))
        others = np.delete(np.arange(BODY), self.views())
        Y[:, others] = 0.3 * self.normal(6, len(others))
        Y[:, POSE : POSE + 6] += np.eye(6)
        return Y

    def close(self) -> None:
        self.a.close_view()
        self.b.copies(VIEW, PREVIOUS)

    def step(self) -> None:
        Phi = np.eye(BODY)
        Phi[POSE : POSE + 6, TWIST : TWIST + 6] = 0.1 * self.normal(6, 6)
        Phi[POSE : POSE + 6, POSE : POSE + 6] += 0.05 * self.normal(6, 6)
        Phi[WALK : WALK + 3, WALK : WALK + 3] *= 0.9
        if self.walks:
            Phi[FRONT[0], FRONT[0]] = 0.95
            Phi[FRONT[1], TWIST] = 0.1
        self.both("propagate", Phi, self.noise())

    def open(self) -> None:
        Y, Yd = self.sees(), self.sees() if self.drift else None
        self.a.open_view(Y, Yd)
        self.b.open_view(Y, Yd)

    def predict(self) -> None:
        self.close()
        self.step()
        self.open()

    def rows(self, slot: IntArray, d: int = 3) -> tuple:
        k, width = len(slot), len(self.b.lead())
        assert self.a.lead[4] == width
        H_x = 0.5 * self.normal(k, d, width)
        return slot, H_x, self.normal(k, d, 3), self.normal(k, d), self.rng.uniform(0.1, 1.0, (k, d))

    def project(self, rows: tuple):
        return self.a.project(rows[0].tolist(), *rows[1:])

    def seen(self) -> IntArray:
        """A shuffled subset of the landmarks that are awake, without the first one."""
        awake = np.flatnonzero(~self.asleep)[1:]
        return self.rng.permutation(awake)[: max(3, len(awake) // 2)]

    def update(self, d: int = 3, out: bool = True, tolerance: float = 1e-9) -> None:
        slot = self.seen()
        if not len(slot):
            return
        rows = self.rows(slot, d)
        k = len(slot)
        at = self.project(rows)
        H, residual, variance = self.b.H(rows), rows[3].ravel(), rows[4].ravel()
        x, nis, log_det = self.b.solve(H, residual, variance)
        S = self.b.S
        np.testing.assert_allclose(at.S, S, rtol=tolerance, atol=tolerance * np.abs(S).max())
        own = [S[i * d : i * d + d, i * d : i * d + d] - np.diag(rows[4][i]) for i in range(k)]
        np.testing.assert_allclose(at.variances, own, rtol=tolerance, atol=tolerance * np.abs(S).max())
        solution = self.a.solve(at)
        self.agree(solution, x, nis, log_det, tolerance)
        which = self.rng.permutation(k)[: max(1, k // 2)]
        std = np.sqrt(rows[4][which])
        K = np.linalg.inv(S)
        others = [K[i * d : i * d + d, i * d : i * d + d] * np.outer(s, s) for i, s in zip(which, std, strict=True)]
        np.testing.assert_allclose(self.a.given_others(solution, which.tolist()), others, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(solution.residual.ravel(), variance * (K @ residual), rtol=1e-7, atol=1e-8)
        left = np.ones(k, dtype=bool)
        if out and k > 1:
            left[self.rng.permutation(k)[:1]] = False
            solution = self.a.without(solution, (~left).tolist())
        some = np.repeat(left, d)
        x, nis, log_det = self.b.solve(H[some], residual[some], variance[some])
        self.agree(solution, x, nis, log_det, tolerance)
        J = self.normal(int(some.sum()), 2)
        np.testing.assert_allclose(
            self.a.information(solution, J), J.T @ np.linalg.solve(self.b.S, J), rtol=1e-8, atol=1e-8
        )
        self.a.apply(solution)
        self.b.apply(variance[some])

    def agree(self, solution, x: Array, nis: float, log_det: float, tolerance: float) -> None:
        np.testing.assert_allclose(self.a.correction(solution), x, rtol=tolerance, atol=tolerance * np.abs(x).max())
        assert solution.nis == pytest.approx(nis, rel=tolerance, abs=tolerance)
        assert solution.log_det == pytest.approx(log_det, rel=tolerance, abs=tolerance)

    def measure(self) -> None:
        """Rows of the body alone."""
        H = np.zeros((5, BODY))
        H[:, TWIST : TWIST + 6] = self.normal(5, 6)
        H[:, WALK : WALK + 3] = 0.3 * self.normal(5, 3)
        H[:, FRONT] = 0.3 * self.normal(5, 2)
        H[:, PREVIOUS : PREVIOUS + 6] = 0.1 * self.normal(5, 6)
        residual, variance = self.normal(5), self.rng.uniform(0.1, 1.0, 5)
        solution = self.a.solve_body(H, residual, variance)
        wide = np.pad(H, ((0, 0), (0, len(self.b.P) - BODY)))
        self.agree(solution, *self.b.solve(wide, residual, variance), 1e-9)
        self.a.apply(solution)
        self.b.apply(variance)

    def start(self, n: int) -> None:
        G = np.zeros((n, 3, len(self.b.lead())))
        front, _, view, _, _ = self.a.lead
        G[..., view : view + 6] = self.normal(n, 3, 6)
        G[..., :2] = self.normal(n, 3, 2)
        if self.rng.random() < 0.3:
            G[..., 2:front] = self.normal(n, 3, 6)
        C = self.normal(n, 3, 3)
        C = 0.1 * C @ C.swapaxes(1, 2) + 0.05 * np.eye(3)
        self.both("augment", G, C)
        self.asleep = np.concatenate([self.asleep, np.zeros(n, dtype=bool)])

    def turn(self) -> None:
        """Re-express body, views and landmarks as a correction does."""
        for at in (POSE, VIEW, PREVIOUS, ANCHOR):
            self.both("transform_body", at, np.eye(6) + 0.05 * self.normal(6, 6))
        slot = self.rng.permutation(self.b.n)
        awake = slot[~self.asleep[slot]]
        M, B = np.eye(3) + 0.05 * self.normal(len(awake), 3, 3), 0.05 * self.normal(len(awake), 3, 6)
        self.both("transform_landmarks", awake, M, B, VIEW)
        asleep = slot[self.asleep[slot]]
        self.both("transform_landmarks", asleep, None, 0.05 * self.normal(len(asleep), 3, 6), VIEW)

    def rest(self, asleep: BoolArray) -> None:
        self.asleep = asleep
        self.a.rest(asleep.tolist())

    def leave(self, stay: BoolArray) -> None:
        self.both("marginalise", stay)
        self.asleep = self.asleep[stay]

    def frame(self, n: int = 4, measured: bool = False) -> None:
        self.close()
        if measured:
            self.measure()
        self.step()
        self.open()
        self.update()
        self.turn()
        self.start(n)
        n = self.b.n
        self.leave(self.rng.random(n) > max(4.0 / max(n, 8), 1.0 - 24.0 / n))


@pytest.fixture
def pair() -> Pair:
    pair = Pair(0)
    pair.open()
    pair.start(6)
    return pair


def test_frames_agree_with_one_matrix(pair: Pair) -> None:
    for _ in range(8):
        pair.frame()
        pair.check()


def test_measured_body_agrees_with_one_matrix(pair: Pair) -> None:
    for _ in range(6):
        pair.frame(measured=True)
        pair.check()


def test_frames_without_drift_agree_with_one_matrix(pair: Pair) -> None:
    pair.drift = False
    for _ in range(6):
        pair.frame()
        pair.check()


def test_intrinsics_that_walk_leave_their_old_columns_to_landmarks(pair: Pair) -> None:
    pair.walks = True
    for _ in range(6):
        pair.frame()
        pair.check()


def test_rows_of_two_numbers_agree_with_one_matrix(pair: Pair) -> None:
    for _ in range(3):
        pair.predict()
        pair.update(d=2)
        pair.start(3)
        pair.check()


def test_promoted_landmarks_agree_with_one_matrix(pair: Pair) -> None:
    for _ in range(6):
        pair.predict()
        pair.update()
        pair.turn()
        pair.start(1)
    assert pair.a.width < 35 + 12 * 6  # the oldest were promoted, and their views dropped
    pair.check()


def test_anchor_that_is_held_again_agrees_with_one_matrix(pair: Pair) -> None:
    for frame in range(8):
        pair.frame()
        if frame in (1, 2, 5):
            pair.a.hold_anchor()
            pair.b.copies(VIEW, ANCHOR)
            pair.check()
            pair.start(2)
        pair.check()


def sleeps(pair: Pair, tolerance: float = 1e-9) -> None:
    """Let some landmarks sleep and some wake, shuffled."""
    pair.rest(pair.rng.random(pair.b.n) < 0.4)
    pair.check(tolerance)


@pytest.mark.parametrize("change", ["plain", "measured", "walks", "no drift", "anchor"])
def test_dormant_landmarks_agree_with_one_matrix(pair: Pair, change: str) -> None:
    pair.walks, pair.drift = change == "walks", change != "no drift"
    for frame in range(8):
        pair.frame(measured=change == "measured")
        pair.check(1e-9)
        sleeps(pair)
        if change == "anchor" and frame % 3 == 1:
            pair.a.hold_anchor()
            pair.b.copies(VIEW, ANCHOR)


def test_considered_columns_are_not_corrected(pair: Pair) -> None:
    assert pair.a.consider(6) == BODY
    pair.b.consider(6)
    for frame in range(6):
        pair.both("clone", POSE if frame % 2 else VIEW, 6, BODY)
        pair.frame(measured=True)
        pair.check(1e-9)
        sleeps(pair)
        pair.check(1e-9)
    assert pair.a.consider(3) == BODY + 6
    pair.b.consider(3)
    pair.both("clone", WALK, 3, BODY + 6)
    pair.check(1e-9)


@pytest.mark.parametrize("walks", [False, True])
@pytest.mark.parametrize("sleeping", [False, True])
def test_noise_that_is_added_later_reaches_the_views(pair: Pair, sleeping: bool, walks: bool) -> None:
    pair.walks = walks
    for _ in range(3):
        pair.frame()
        if sleeping:
            sleeps(pair)
        pair.predict()
        pair.both("add_noise", pair.noise())
        pair.check(1e-9)
        pair.update()
        pair.check(1e-9)


def test_replaced_covariance_counts(pair: Pair) -> None:
    for _ in range(2):
        pair.frame()
    sleeps(pair)
    pair.predict()
    A = np.eye(len(pair.b.outside()))
    A += 0.02 * pair.normal(*A.shape)
    A[VIEW : VIEW + 6] = 0.0
    A[VIEW : VIEW + 6, :BODY] = pair.b.Y
    P = A @ pair.b.outside() @ A.T
    P = 0.5 * (P + P.T)
    pair.both("replace", P)
    pair.asleep[:] = False
    pair.check()
    for _ in range(3):
        pair.update(tolerance=1e-8)
        pair.check(1e-8)
        pair.frame()


def test_copies_are_independent(pair: Pair) -> None:
    for _ in range(3):
        pair.frame()
    sleeps(pair)
    before = pair.b.outside().copy()
    other = copy.copy(pair.a)
    pair.frame()
    P = other.covariance_of(list(range((len(before) - BODY) // 3)))
    np.testing.assert_allclose(P, before, atol=1e-9 * before.max())
    pair.check(1e-9)


@pytest.mark.parametrize("certain", ["everything", "pose", "all but the pose"])
def test_first_frames_from_certain_priors_agree_with_one_matrix(certain: str) -> None:
    P = np.zeros((BODY, BODY))
    some = {"everything": [], "pose": [*range(WALK, WALK + 3), *FRONT], "all but the pose": range(6)}[certain]
    P[some, some] = 0.5
    pair = Pair(1, P)
    pair.open()
    pair.start(5)
    pair.check()
    pair.update()
    pair.turn()
    pair.check()
    for _ in range(4):
        pair.frame()
        pair.check()
        sleeps(pair)


def test_wrong_rows_are_named(pair: Pair) -> None:
    pair.predict()
    rows = pair.rows(np.array([3, 1]))
    rows[4][1] = -1e6
    with pytest.raises(ValueError, match="variances must be positive"):
        pair.project(rows)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_two_hundred_frames_of_all_verbs_agree_with_one_matrix(seed: int) -> None:
    pair = Pair(seed)
    pair.open()
    pair.start(6)
    verbs: list[Callable[[], object]] = [lambda: sleeps(pair, 1e-8), pair.turn, lambda: pair.start(2)]
    for frame in range(200):
        pair.walks = bool(pair.rng.random() < 0.1)
        pair.drift = bool(pair.rng.random() < 0.7)
        pair.frame(measured=bool(pair.rng.random() < 0.3))
        for _ in range(2):
            verbs[pair.rng.integers(len(verbs))]()
        if pair.rng.random() < 0.1:
            pair.a.hold_anchor()
            pair.b.copies(VIEW, ANCHOR)
        if frame % 10 == 0:
            pair.check(1e-8)
