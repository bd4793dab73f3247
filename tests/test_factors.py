"""Solutions of lists of factors against dense least squares, and factors of kinds that the package does not know."""

import dataclasses

import numpy as np
import pytest
from support.running import WHOLE

from ekfslam.smoother.sparse.dense import DenseInformation
from ekfslam.smoother.sparse.factors import GROUPS, Factor, FirstFrame, LinearSystem, Term
from ekfslam.smoother.sparse.information import JointInformation
from ekfslam.smoother.sparse.structure import Structure
from ekfslam.smoother.unknowns import root


def random_factor(rng, n, d, *touched):
    """A factor over unknowns (group, index (n,), size)."""
    terms = tuple(Term(group, np.asarray(index), rng.normal(size=(n, d, size))) for group, index, size in touched)
    return Factor(rng.normal(size=(n, d)), terms)


def random_system(rng, frames, landmarks, share, aux=0, drive=0, chained=False, w=6, coupled=False):
    """A random system whose landmarks are seen from a random, shuffled choice of frames, loops and all.

    Chained observations touch the frame before, too, if their landmark was seen there. Coupled: the process and the
    prior of the first frame connect frames and aux of both sides.
    """
    seen = rng.uniform(size=(frames, landmarks)) < share
    seen[rng.integers(frames, size=landmarks), np.arange(landmarks)] = True
    frame, landmark = rng.permutation(np.argwhere(seen)).T
    follows = np.array([chained and k > 0 and bool(seen[k - 1, j]) for k, j in zip(frame, landmark, strict=True)])
    step, none, every = np.arange(frames - 1), np.zeros(frames - 1, dtype=int), np.arange(frames)
    now = ("frames", step + 1, w), ("aux", step + 1, aux), ("drive", none, drive)
    factors = [random_factor(rng, frames - 1, w, ("frames", step, w), *now, *([("aux", step, aux)] if coupled else []))]
    for k, j, before in ((frame[~follows], landmark[~follows], False), (frame[follows], landmark[follows], True)):
        own = [("frames", k, w), ("landmarks", j, 3), ("drive", 0 * k, drive)]
        factors.append(random_factor(rng, len(k), 3, *own, *([("frames", k - 1, w)] if before else [])))
    factors.append(random_factor(rng, frames - 1, aux, ("aux", step, aux), ("aux", step + 1, aux)))
    factors.append(random_factor(rng, frames, 2, ("aux", rng.permutation(every), aux)))
    factors.append(random_factor(rng, 1, drive, ("drive", [0], drive)))
    known = Term("frames", every, np.broadcast_to(np.eye(w), (frames, w, w)))  # so that dense algebra has digits left
    factors.append(Factor(rng.normal(size=(frames, w)), (known,)))
    B = np.eye(w + aux) + 0.3 * rng.normal(size=(w + aux, w + aux))
    B[:w, w:] = 0.0
    if not coupled:
        B[w:, :w] = 0.0
    first = FirstFrame(B, rng.normal(size=w + aux), w)
    factors = tuple(factor for factor in factors if factor.r.size and factor.terms)
    return LinearSystem.of(factors, first, frames, drive, rng.permutation(1000)[:landmarks])


def columns_of(system):
    """First column of every unknown of each group."""
    start, found = 0, {}
    for group in GROUPS:
        found[group] = start + system.sizes[group] * np.arange(system.counts[group])
        start += system.counts[group] * system.sizes[group]
    return found, start


def dense(system):
    """Mean (N,), covariance (N, N) and cost of a system, by dense algebra."""
    at, width = columns_of(system)
    rows, right = [], []
    for factor in system.factors:
        for i, r in enumerate(factor.r):
            row = np.zeros((len(r), width))
            for term in factor.terms:
                first = at[term.group][term.index[i]]
                row[:, first : first + term.J.shape[2]] += term.J[i]
            rows.append(row)
            right.append(r)
    # The first frame in units of its prior.
    of_first = np.concatenate([np.arange(system.sizes["frames"]), at["aux"][:1] + np.arange(system.sizes["aux"])])
    first = np.eye(width)
    first[np.ix_(of_first, of_first)] = system.first.B
    J = np.vstack([np.vstack(rows) @ first, np.eye(width)[of_first]])
    r = np.concatenate([*right, -system.first.zeta])
    x = np.linalg.lstsq(J, r, rcond=None)[0]
    return first @ x, first @ np.linalg.inv(J.T @ J) @ first.T, 0.5 * ((J @ x - r) ** 2).sum()


def assert_equals_dense(system, found, rng):
    mean, covariance, cost = dense(system)
    at, _ = columns_of(system)
    largest, size = np.abs(covariance).max(), system.sizes
    own = {group: at[group][:, None] + np.arange(size[group]) for group in GROUPS}
    solved = {"frames": found.eps, "aux": found.aux, "drive": found.drive, "landmarks": found.d}
    marginals = {
        "frames": found.frame_covariances(),
        "aux": found.aux_covariances(),
        "drive": found.drive_covariance()[None],
        "landmarks": found.landmark_covariances(),
    }
    for group in GROUPS:
        np.testing.assert_allclose(solved[group].ravel(), mean[own[group]].ravel(), rtol=1e-8, atol=1e-9)
        for columns, block in zip(own[group], marginals[group], strict=size[group] > 0):
            np.testing.assert_allclose(block, covariance[np.ix_(columns, columns)], atol=1e-9 * largest)
    np.testing.assert_allclose(found.cost, cost, rtol=1e-9, atol=1e-12 * system.half_square)
    np.testing.assert_allclose(found.log_determinant, np.linalg.slogdet(covariance)[1], rtol=1e-9)
    # A shuffled subset, the first frame not in front.
    frames = rng.permutation(system.counts["frames"])[: max(1, system.counts["frames"] // 2)]
    some = rng.permutation(system.counts["landmarks"])[: max(1, system.counts["landmarks"] // 2)]
    everything = {"frames": frames, "aux": frames, "drive": [0], "landmarks": some}
    for wanted in ({"frames": frames, "landmarks": some}, everything):
        columns = np.concatenate([own[group][index].ravel() for group, index in wanted.items() if size[group]])
        expected = covariance[np.ix_(columns, columns)]
        np.testing.assert_allclose(found.covariance(**wanted), expected, atol=1e-9 * largest)


SIZES = [(1, 3, 1.0), (12, 1, 0.3), (15, 25, 0.25), (30, 40, 0.05)]  # frames, landmarks, share that is seen
STATES = {
    "poses": {},
    "drive, chained": {"drive": 2, "chained": True},
    "aux": {"aux": 5},
    "everything": {"aux": 4, "drive": 3, "chained": True},
    "chained, shared": {"chained": True, "w": 8},
    "everything, shared": {"aux": 4, "drive": 3, "chained": True, "w": 11},
    "coupled": {"aux": 9, "coupled": True},
    "everything, coupled": {"aux": 4, "drive": 3, "chained": True, "w": 8, "coupled": True},
}


@pytest.mark.parametrize(
    ("size", "up_to", "state"),
    [
        (size, up_to, state)
        for i, size in enumerate(SIZES)
        for j, state in enumerate(STATES)
        for k, up_to in enumerate((0, 4, 100))
        if WHOLE or k == (i + j) % 3  # all pairs
    ],
)
def test_information_equals_dense_least_squares(size, up_to, state):
    rng = np.random.default_rng(size[0])
    system = random_system(rng, *size, **STATES[state])
    found = JointInformation(system, structure=Structure(system, up_to))
    assert_equals_dense(system, found, rng)


def system_of_views(rng, views, w, seen):
    """A random system whose landmarks are seen through views of the frames, and the same one without views."""
    system = random_system(rng, 9, 14, 0.5, aux=4, drive=3, chained=True, w=w, coupled=True)
    by_frame = rng.normal(size=(9, 6 * views, w))
    through, plain = [], []
    for factor in system.factors:
        if all(term.group != "landmarks" for term in factor.terms):
            through.append(factor)
            plain.append(factor)
            continue
        terms, expanded = [], []
        for number, term in enumerate(factor.terms):
            if term.group == "frames":
                view = rng.integers(views, size=len(term.index)) if number else np.full(len(term.index), views - 1)
                J = rng.normal(size=(*term.J.shape[:2], 6))
                terms.append(Term("views", views * term.index + view, J))
                J_frame = J @ by_frame.reshape(9, views, 6, w)[term.index, view]
                expanded.append(Term("frames", term.index, J_frame))
            else:
                terms.append(term)
                expanded.append(term)
        through.append(dataclasses.replace(factor, terms=tuple(terms)))
        plain.append(dataclasses.replace(factor, terms=tuple(expanded)))
    seen = np.array(seen) if seen else np.arange(w)
    return dataclasses.replace(system, factors=tuple(through), views=by_frame, seen=seen), dataclasses.replace(
        system, factors=tuple(plain)
    )


@pytest.mark.parametrize("singular", [False, True])
@pytest.mark.parametrize(
    ("views", "w", "seen"),
    [(1, 6, None), (1, 11, range(6)), (2, 18, [*range(6), *range(12, 18)]), (2, 15, None)],
    ids=["pose", "jitter hidden", "drift seen, jitter hidden", "nothing hidden"],
)
def test_landmarks_seen_through_views_are_those_of_the_frames(views, w, seen, singular):
    rng = np.random.default_rng(w)
    system, plain = system_of_views(rng, views, w, seen)
    if singular:  # a first pose that is known for certain in part
        B = system.first.B.copy()
        B[[0, 3, w - 1]] = 0.0
        first = dataclasses.replace(system.first, B=B)
        system, plain = (dataclasses.replace(one, first=first) for one in (system, plain))
    found = JointInformation(system)
    assert found.structure.sizes["hidden"] == (w - len(seen) if seen else 0) + 4
    if not singular:
        assert_equals_dense(plain, found, rng)
    expected = JointInformation(plain)
    for name in ("zeta", "eps", "aux", "drive", "d", "gain", "cost", "log_determinant"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(found.landmark_covariances(), expected.landmark_covariances(), rtol=1e-6, atol=1e-9)
    for one, other in zip(system.rows(), plain.rows(), strict=True):
        dense_of = [part.toarray() if hasattr(part, "toarray") else part for part in (one, other)]
        np.testing.assert_allclose(*dense_of, atol=1e-12)


def test_a_stranger_adds_kinds_of_factors_from_outside():
    """A loop closure, the offset between two landmarks, and a landmark that a bias of a frame displaces."""
    rng = np.random.default_rng(2)
    system = random_system(rng, 15, 25, 0.25, aux=4, drive=2, chained=True, coupled=True)
    loops = random_factor(rng, 3, 6, ("frames", [0, 9, 3], 6), ("frames", [14, 1, 3], 6))
    offsets = random_factor(rng, 4, 3, ("landmarks", [3, 7, 7, 20], 3), ("landmarks", [8, 2, 24, 1], 3))
    displaced = random_factor(rng, 2, 3, ("landmarks", [5, 6], 3), ("aux", [4, 0], 4))
    larger = dataclasses.replace(system, factors=(*system.factors, loops, offsets, displaced))
    found = JointInformation(larger)
    assert set(found.structure.kept) == {1, 2, 3, 7, 8, 20, 24}
    assert_equals_dense(larger, found, rng)
    assert found.cost > JointInformation(system).cost


def test_a_system_of_the_same_structure_uses_the_analysis_again():
    systems = [random_system(np.random.default_rng(5), 12, 20, 0.3, aux=3, coupled=True) for _ in range(2)]
    factors = tuple(factor.scaled(np.full(len(factor.r), 2.0)) for factor in systems[1].factors)
    other = dataclasses.replace(systems[1], factors=factors)
    found = JointInformation(other, like=JointInformation(systems[0]))
    assert_equals_dense(other, found, np.random.default_rng(0))


def test_damping_adds_to_the_diagonal_in_units_of_the_prior():
    rng = np.random.default_rng(6)
    system = random_system(rng, 10, 12, 0.4, aux=3, drive=2, coupled=True)
    J, r = system.rows()
    x = np.linalg.solve((J.T @ J).toarray() + 0.7 * np.eye(J.shape[1]), J.T @ r)
    found = JointInformation(system, damping=0.7)
    np.testing.assert_allclose(found.d.ravel(), x[-36:], rtol=1e-8, atol=1e-10)
    left = 0.5 * ((J @ x - r) ** 2).sum()
    np.testing.assert_allclose(found.cost, left, rtol=1e-9)
    np.testing.assert_allclose(found.gain, 0.5 * (r**2).sum() - left, rtol=1e-9)


def test_the_dense_solution_equals_the_sparse_one():
    """With a prior over the first frame, the drive and a shuffled choice of landmarks, in units of its root."""
    rng = np.random.default_rng(8)
    system, known, sizes = random_system(rng, 6, 9, 0.5, aux=3, drive=2, coupled=True), np.array([5, 1, 7]), (9, 2, 9)
    others = [random_factor(rng, 1, size, ("drive", [0], 2)) for size in sizes[1:2]]
    others.append(Factor(rng.normal(size=(3, 3)), (Term("landmarks", known, np.broadcast_to(np.eye(3), (3, 3, 3))),)))
    drive = others[0].terms[0].J[0]
    B = np.zeros((20, 20))
    B[:9, :9], B[9:11, 9:11], B[11:, 11:] = system.first.B, np.linalg.inv(drive), np.eye(9)
    zeta = np.concatenate([system.first.zeta, -others[0].r[0], -others[1].r.ravel()])
    wide = dataclasses.replace(system, first=FirstFrame(B, zeta, system.first.width))
    sparse = JointInformation(dataclasses.replace(system, factors=(*system.factors, *others)))
    found = DenseInformation(wide, known)
    for name in ("eps", "aux", "drive", "d", "gain"):
        np.testing.assert_allclose(getattr(found, name), getattr(sparse, name), rtol=1e-8, atol=1e-9)
    wanted = {"frames": [0, 4], "aux": [4], "drive": [0], "landmarks": [3, 7, 0, 1]}
    np.testing.assert_allclose(found.covariance(**wanted), sparse.covariance(**wanted), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("certain", [[], [2], [0, 1, 7]])
def test_information_matrix_is_the_inverse_of_the_covariance(certain):
    rng = np.random.default_rng(7)
    system = random_system(rng, 8, 10, 0.5, aux=3, drive=2, chained=True, coupled=True)
    B = system.first.B.copy()
    B[certain] = 0.0
    system = dataclasses.replace(system, first=dataclasses.replace(system.first, B=B))
    matrix, kept = system.information_matrix()
    _, covariance, _ = dense(system)
    at_certain = [*(i for i in certain if i < 6), *(48 + i - 6 for i in certain if i >= 6)]
    assert kept.tolist() == [i for i in range(len(covariance)) if i not in at_certain]
    np.testing.assert_allclose(matrix @ covariance[np.ix_(kept, kept)], np.eye(len(kept)), atol=1e-7)


@pytest.mark.parametrize("rank", [15, 9, 3])
def test_root_of_a_coupled_covariance_leaves_the_frame_to_itself(rank):
    rng = np.random.default_rng(rank)
    A = rng.normal(size=(15, rank)) * np.repeat([100.0, 1e-2, 1e-4], 5)[:, None]
    B = root(A @ A.T, 6)
    scale = np.sqrt(np.diag(A @ A.T))
    np.testing.assert_allclose(B @ B.T, A @ A.T, atol=1e-7 * np.outer(scale, scale).max())
    assert (np.abs(B @ B.T - A @ A.T) <= 1e-7 * np.outer(scale, scale)).all()
    assert not B[:6, 6:].any()


@pytest.mark.slow
def test_samples_have_the_covariance_they_are_drawn_from():
    system = random_system(np.random.default_rng(3), 4, 5, 0.6, aux=2, coupled=True)
    found = JointInformation(system, structure=Structure(system, 3))
    assert 0 < len(found.structure.kept) < 5
    # Standard errors are 0.014 of a mean and at most 0.02 of a covariance; the bounds are four and five of them.
    eps, d = found.sample(np.random.default_rng(4), 5_000)
    draws = np.concatenate([eps.reshape(len(eps), -1), d.reshape(len(d), -1)], axis=1)
    expected = found.covariance(frames=np.arange(4), landmarks=np.arange(5))
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        (draws.mean(axis=0) - np.concatenate([found.eps.ravel(), found.d.ravel()])) / scale, 0, atol=0.056
    )
    np.testing.assert_allclose(np.cov(draws.T) / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.1)
