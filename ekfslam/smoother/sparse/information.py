"""A Gaussian over poses and landmarks in information form: whitened rows, their normal equations, CHOLMOD.

Unknowns are ``eps`` (T, 6), one vector a pose, and ``d`` (M, 3), one a landmark. Rows touch one pose and one landmark
(observations), two consecutive poses (motion), or the first pose (prior). Landmarks know of each other only through
poses, so those with few observations are eliminated first, all at once, by their Schur complements; what remains, the
poses and the landmarks with many observations, goes to CHOLMOD. Both are steps of one sparse elimination: nothing is
approximated, and no matrix as wide as the state is ever formed.

Sources: Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle adjustment - a modern synthesis", 2000, section 6 (Schur
complement); Takahashi, Fagan, Chen, "Formation of a sparse bus impedance matrix", 1973 (selected inverse).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ekfslam.arrays import Array, IntArray
from ekfslam.errors import IllPosedError
from ekfslam.smoother.sparse.cholmod import NotPositiveDefiniteError, SparseCholesky, concatenated_ranges
from ekfslam.smoother.sparse.selected_inverse import SelectedInverse

# Landmarks with more observations than this are left to CHOLMOD: eliminating one couples all poses that saw it, pair by
# pair, and their number grows with the square.
ELIMINATE_UP_TO = 40
_AT_ONCE = 20_000  # observations or pairs of them, so that temporary arrays stay in the cache


@dataclass(frozen=True)
class LinearSystem:
    """Whitened rows ``J x = r`` over ``eps`` (T, 6) and ``d`` (M, 3), to be solved in the least-squares sense.

    Args:
        landmarks: Number of landmarks M.
        B: (6, 6) the first pose is ``eps_0 = B zeta`` with ``zeta ~ N(0, I)``; ``B B^T`` may be singular.
        r_prior: (6,) right side of the rows ``zeta = r``.
        J_from, J_to: (T-1, 6, 6) motion rows of step k over ``eps_k`` and ``eps_{k+1}``.
        r_motion: (T-1, 6) their right sides.
        frame, landmark: (K,) pose and landmark of each observation.
        J_x, J_m: (K, 3, 6) and (K, 3, 3) rows of the observations.
        r: (K, 3) their right sides.
    """

    landmarks: int
    B: Array
    r_prior: Array
    J_from: Array
    J_to: Array
    r_motion: Array
    frame: IntArray
    landmark: IntArray
    J_x: Array
    J_m: Array
    r: Array

    @property
    def half_square(self) -> float:
        """Half the sum of squares of all right sides: the cost of leaving everything as it is."""
        return 0.5 * sum(float((r**2).sum()) for r in (self.r_prior, self.r_motion, self.r))


class Elimination:
    """What depends on nothing but which frame saw which landmark; computed once, used for every linearisation.

    Args:
        frames: Number of poses T.
        landmarks: Number of landmarks M.
        frame, landmark: (K,) of each observation; no pair may occur twice.
        ids: (M,) landmark ids, for error messages.
        eliminate_up_to: Landmarks with at most this many observations are eliminated before CHOLMOD's turn.
    """

    def __init__(
        self,
        frames: int,
        landmarks: int,
        frame: IntArray,
        landmark: IntArray,
        ids: IntArray,
        eliminate_up_to: int = ELIMINATE_UP_TO,
    ) -> None:
        self.frames, self.landmarks, self.ids = frames, landmarks, ids
        self.frame, self.landmark = frame, landmark
        seen = np.bincount(landmark, minlength=landmarks)
        if (seen == 0).any():
            raise IllPosedError("landmarks without an observation", ids[seen == 0])
        self.is_kept = seen > eliminate_up_to
        self.kept = np.flatnonzero(self.is_kept)
        # Blocks of the reduced system: the poses, then the kept landmarks.
        self.block_sizes = np.repeat([6, 3], [frames, len(self.kept)])
        self.start = np.concatenate([[0], np.cumsum(self.block_sizes)])
        self.block_of_landmark = np.full(landmarks, -1)
        self.block_of_landmark[self.kept] = frames + np.arange(len(self.kept))

        self.of_kept = np.flatnonzero(self.is_kept[landmark])
        self.of_eliminated = np.flatnonzero(~self.is_kept[landmark])
        self._pair_up()
        self._lay_out()

    def _pair_up(self) -> None:
        """Pairs of observations (later, not later) of each eliminated landmark, together if they couple the same poses.

        Groups of pairs are sorted by their sizes, so that many of one size can be summed in one matrix product.
        """
        order = self.of_eliminated[np.lexsort((self.frame[self.of_eliminated], self.landmark[self.of_eliminated]))]
        counts = np.bincount(self.landmark[order], minlength=self.landmarks)
        ends = np.cumsum(counts)
        rank = np.arange(len(order)) - np.repeat(ends - counts, counts)  # 0 for a landmark's first observation
        later = np.repeat(np.arange(len(order)), rank + 1)
        earlier = concatenated_ranges(np.arange(len(order)) - rank, rank + 1)
        later, earlier = order[later].astype(np.int32), order[earlier].astype(np.int32)
        key = self.frame[later].astype(np.int64) * self.frames + self.frame[earlier]
        by_key = np.argsort(key, kind="stable")
        keys, starts, sizes = np.unique(key[by_key], return_index=True, return_counts=True)
        by_size = np.argsort(sizes, kind="stable")
        self.group_sizes = sizes[by_size]
        by_key = by_key[concatenated_ranges(starts[by_size], self.group_sizes)]
        self.later, self.earlier = later[by_key], earlier[by_key]
        self.coupled = np.stack(np.divmod(keys[by_size], self.frames), axis=-1)  # (later frame, earlier) of each group

    def groups(self) -> Iterator[tuple[slice, IntArray, IntArray]]:
        """Portions of groups of pairs, all of one size in each portion, small enough for the cache.

        Yields:
            The slice of g groups; the observations (g, size) of their pairs, later ones and earlier ones.
        """
        starts = np.cumsum(self.group_sizes) - self.group_sizes
        sizes, first = np.unique(self.group_sizes, return_index=True)
        for size, begin, end in zip(sizes, first, np.append(first, len(starts))[1:], strict=True):
            step = max(1, _AT_ONCE // size)
            for group in range(begin, end, step):
                stop = min(group + step, end)
                pairs = slice(starts[group], starts[group] + size * (stop - group))
                yield slice(group, stop), self.later[pairs].reshape(-1, size), self.earlier[pairs].reshape(-1, size)

    def _lay_out(self) -> None:
        """Where the entries of all blocks go in the reduced matrix: its lower triangle and whole diagonal blocks."""
        own, steps = np.arange(len(self.block_sizes)), np.arange(self.frames - 1)
        kinds = (  # block rows, block columns, height, width
            (own[: self.frames], own[: self.frames], 6, 6),
            (steps + 1, steps, 6, 6),
            (self.coupled[:, 0], self.coupled[:, 1], 6, 6),
            (own[self.frames :], own[self.frames :], 3, 3),
            (self.block_of_landmark[self.landmark[self.of_kept]], self.frame[self.of_kept], 3, 6),
        )
        block_row, block_column = (np.concatenate([kind[i] for kind in kinds]) for i in (0, 1))
        # Steps and diagonal blocks may be among the coupled ones: they share their place.
        unique, place = np.unique(block_column * len(own) + block_row, return_inverse=True)
        column, row = np.divmod(unique, len(own))
        height = self.block_sizes[row]
        column_height = np.bincount(column, weights=height, minlength=len(own)).astype(np.int64)
        pointers = np.concatenate([[0], np.cumsum(np.repeat(column_height, self.block_sizes))])
        above = np.cumsum(height) - height
        above -= (np.cumsum(column_height) - column_height)[column]
        origin, stride = pointers[self.start[column]] + above, column_height[column]

        index_type = np.int32 if pointers[-1] < 2**31 else np.int64
        self._pointers, self._indices = pointers.astype(index_type), np.empty(pointers[-1], dtype=index_type)
        self._targets = []
        for (block_row, _, high, wide), at in zip(
            kinds, np.split(place, np.cumsum([len(kind[0]) for kind in kinds])[:-1]), strict=True
        ):
            target = origin[at, None, None] + np.arange(high)[:, None] + stride[at, None, None] * np.arange(wide)
            target = target.astype(index_type)
            self._indices[target] = self.start[block_row, None, None] + np.arange(high)[:, None]
            self._targets.append(target)

    def assemble(self, blocks: tuple[Array, ...]) -> sp.csc_array:
        """The reduced matrix from the blocks (n, height, width) of each kind, in the order of `_lay_out`."""
        data = np.zeros(len(self._indices))
        for target, block in zip(self._targets, blocks, strict=True):
            data[target] += block
        size = int(self.start[-1])
        return sp.csc_array((data, self._indices, self._pointers), shape=(size, size))

    def sum_by_landmark(self, values: Array) -> Array:
        """Sums (M, ...) of what belongs to observations (K, ...)."""
        return _sum(self.landmark, self.landmarks, values)

    def sum_by_frame(self, values: Array) -> Array:
        """Sums (T, ...) of what belongs to observations (K, ...)."""
        return _sum(self.frame, self.frames, values)


def _sum(index: IntArray, groups: int, values: Array) -> Array:
    """Sums (groups, ...) of the values (n, ...) of each index (n,)."""
    n = len(index)
    summation = sp.csc_array((np.ones(n), index, np.arange(n + 1)), shape=(groups, n))
    return (summation @ values.reshape(n, -1)).reshape(groups, *values.shape[1:])


def _sum_products(index: IntArray, groups: int, A: Array, B: Array) -> Array:
    """Sums (groups, a, b) of ``A_k^T B_k`` for A (n, c, a), B (n, c, b), never all products at once."""
    total = np.zeros((groups, A.shape[2], B.shape[2]))
    for begin in range(0, len(index), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        total += _sum(index[part], groups, A[part].swapaxes(1, 2) @ B[part])
    return total


class JointInformation:
    """The Gaussian that a `LinearSystem` describes, factorised.

    Args:
        elimination: The structure; may be shared by systems with the same observations.
        system: The rows.
        damping: Levenberg-Marquardt: added to the diagonal (0: the posterior itself). Not in proportion to it: that
            crawls along the flat directions of a trajectory.
        factor: CHOLMOD's factor of an earlier system with the same structure, whose analysis is used again.

    Attributes:
        eps: (T, 6) mean of the pose unknowns.
        zeta: (6,) mean of the first pose in units of its prior.
        d: (M, 3) mean of the landmark unknowns.
        cost: Half the sum of squares that the rows leave (of a system without damping).

    Raises:
        IllPosedError: The rows leave something undetermined; names landmark ids or frames.
    """

    def __init__(
        self,
        elimination: Elimination,
        system: LinearSystem,
        damping: float = 0.0,
        factor: SparseCholesky | None = None,
    ) -> None:
        self.elimination, self._B = elimination, system.B  # not the rows: they take more memory than all else kept
        e = elimination
        B, J_x, J_m, J_to = system.B, system.J_x, system.J_m, system.J_to
        J_from = system.J_from
        if len(J_from):
            J_from = np.concatenate([J_from[:1] @ B, J_from[1:]])

        H_mm = _sum_products(e.landmark, e.landmarks, J_m, J_m)
        H_xx = _sum_products(e.frame, e.frames, J_x, J_x)
        H_xx[0] = np.eye(6) + B.T @ H_xx[0] @ B
        H_xx[:-1] += J_from.swapaxes(1, 2) @ J_from
        H_xx[1:] += J_to.swapaxes(1, 2) @ J_to
        if damping:
            for H in (H_mm, H_xx):
                H += damping * np.eye(H.shape[-1])
        self._factorise(system, H_mm, H_xx, J_to.swapaxes(1, 2) @ J_from, factor)

        g_x = e.sum_by_frame((J_x.swapaxes(1, 2) @ system.r[..., None])[..., 0])
        g_x[0] = system.r_prior + B.T @ g_x[0]
        g_x[:-1] += (J_from.swapaxes(1, 2) @ system.r_motion[..., None])[..., 0]
        g_x[1:] += (J_to.swapaxes(1, 2) @ system.r_motion[..., None])[..., 0]
        g_m = e.sum_by_landmark((J_m.swapaxes(1, 2) @ system.r[..., None])[..., 0])
        zeta_and_eps, self.d = self._solve(g_x, g_m)
        self.zeta = zeta_and_eps[0].copy()
        self.eps = self._with_first_pose(zeta_and_eps)
        # Half the sum of squares at the mean x: |r - J x|^2 = |r|^2 - g^T x.
        self.cost = system.half_square - 0.5 * float((zeta_and_eps * g_x).sum() + (self.d * g_m).sum())

    def _factorise(
        self, system: LinearSystem, H_mm: Array, H_xx: Array, H_step: Array, factor: SparseCholesky | None
    ) -> None:
        """Schur complements of the eliminated landmarks, then CHOLMOD."""
        e = self.elimination
        L = _cholesky_of_landmarks(H_mm, e.ids)
        self._L_inverse = np.linalg.inv(L)
        self._log_det_landmarks = 2.0 * float(np.log(np.diagonal(L[~e.is_kept], axis1=1, axis2=2)).sum())
        # Y_k^T Y_l is what an eliminated landmark takes from the block of the poses of its observations k and l.
        self._Y = _H_mx(system)
        for begin in range(0, len(e.landmark), _AT_ONCE):
            part = slice(begin, begin + _AT_ONCE)
            self._Y[part] = self._L_inverse[e.landmark[part]] @ self._Y[part]
        self._Y[e.of_kept] = 0.0
        coupling = np.empty((len(e.coupled), 6, 6))
        for groups, later, earlier in e.groups():
            stacked = len(later), 3 * later.shape[1], 6
            coupling[groups] = self._Y[later].reshape(stacked).swapaxes(1, 2) @ self._Y[earlier].reshape(stacked)
        matrix = e.assemble((H_xx, H_step, -coupling, H_mm[e.kept], _H_mx(system, e.of_kept)))
        del coupling
        try:
            factor = SparseCholesky(matrix, e.block_sizes) if factor is None else factor.with_values(matrix)
        except NotPositiveDefiniteError as error:
            is_pose = error.block < e.frames
            culprit = error.block if is_pose else e.ids[e.kept[error.block - e.frames]]
            raise IllPosedError(f"{'frame' if is_pose else 'landmark'} without enough information", [culprit]) from None
        self.factor = factor

    def _solve(self, g_x: Array, g_m: Array) -> tuple[Array, Array]:
        """Solve the normal equations for one right side (T, 6), (M, 3)."""
        e = self.elimination
        whitened = (self._L_inverse @ g_m[..., None])[..., 0]
        reduced = g_x - e.sum_by_frame((self._Y.swapaxes(1, 2) @ whitened[e.landmark, :, None])[..., 0])
        solution = self.factor.solve(np.concatenate([reduced.ravel(), g_m[e.kept].ravel()]))
        x = solution[: 6 * e.frames].reshape(-1, 6)
        return x, self._landmarks_given(x, solution[6 * e.frames :].reshape(-1, 3), whitened)

    def _landmarks_given(self, x: Array, kept: Array, whitened: Array) -> Array:
        """Landmarks (M, 3): eliminated ones from the poses x (T, 6), the others as they are."""
        e = self.elimination
        seen = e.sum_by_landmark((self._Y @ x[e.frame, :, None])[..., 0])
        d = (self._L_inverse.swapaxes(1, 2) @ (whitened - seen)[..., None])[..., 0]
        d[e.kept] = kept
        return d

    def _with_first_pose(self, zeta_and_eps: Array) -> Array:
        eps = zeta_and_eps.copy()
        eps[0] = self._B @ zeta_and_eps[0]
        return eps

    @property
    def log_determinant(self) -> float:
        """Log of the determinant of the joint covariance, without directions of the first pose known for certain."""
        scales = np.linalg.svd(self._B, compute_uv=False)
        known = scales > 1e-12 * max(scales[0], 1.0)
        return 2.0 * float(np.log(scales[known]).sum()) - self.factor.log_determinant - self._log_det_landmarks

    @cached_property
    def _selected(self) -> SelectedInverse:
        return SelectedInverse(self.factor)

    def pose_covariances(self) -> Array:
        """Marginal covariances (T, 6, 6) of all poses, by selected inversion."""
        own = np.arange(self.elimination.frames)
        covariance = self._selected.blocks(own, own)
        covariance[0] = self._B @ covariance[0] @ self._B.T
        return covariance

    def landmark_covariances(self) -> Array:
        """Marginal covariances (M, 3, 3) of all landmarks, by selected inversion.

        Of an eliminated landmark ``L^-T (I + sum_kl Y_k Z_kl Y_l^T) L^-1`` over its observations k and l, Z being the
        selected inverse of the reduced matrix.
        """
        e = self.elimination
        half = np.zeros((e.landmarks, 3, 3))
        for groups, later, earlier in e.groups():
            Z = self._selected.blocks(*e.coupled[groups].T)
            YZ = (self._Y[later].reshape(len(later), -1, 6) @ Z).reshape(-1, 3, 6)
            later, earlier = later.ravel(), earlier.ravel()
            terms = YZ @ self._Y[earlier].swapaxes(1, 2)
            terms[later == earlier] *= 0.5
            half += _sum(e.landmark[later], e.landmarks, terms)
        covariance = self._L_inverse.swapaxes(1, 2) @ (np.eye(3) + half + half.swapaxes(1, 2)) @ self._L_inverse
        if len(e.kept):
            covariance[e.kept] = self._selected.blocks(e.block_of_landmark[e.kept], e.block_of_landmark[e.kept])
        return 0.5 * (covariance + covariance.swapaxes(1, 2))

    def covariance(self, frames: IntArray, landmarks: IntArray) -> Array:
        """Joint covariance of some poses (6 columns each) and some landmarks (3 each), in the order given, by solves.

        Args:
            frames: (a,) pose numbers.
            landmarks: (b,) landmark numbers, not ids.

        Returns:
            (6a+3b, 6a+3b).
        """
        e = self.elimination
        selection = self._selection(np.asarray(frames, dtype=np.int64), np.asarray(landmarks, dtype=np.int64))
        half = self.factor.half_solve(selection.T.toarray())
        covariance = half.T @ half
        own = 6 * len(frames) + 3 * np.arange(len(landmarks))
        given_poses = self._L_inverse[landmarks].swapaxes(1, 2) @ self._L_inverse[landmarks]
        given_poses[e.is_kept[landmarks]] = 0.0
        place = own[:, None] + np.arange(3)
        covariance[place[:, :, None], place[:, None, :]] += given_poses
        return covariance

    def pattern(self) -> tuple[IntArray, IntArray]:
        """Rows and columns of the blocks in the lower triangle of the information matrix: poses, then landmarks."""
        e = self.elimination
        own, step = np.arange(e.frames + e.landmarks), np.arange(e.frames - 1)
        return np.concatenate([own, step + 1, e.frames + e.landmark]), np.concatenate([own, step, e.frame])

    def factor_pattern(self) -> tuple[IntArray, IntArray]:
        """Rows and columns of the blocks of its Cholesky factor, in the order of elimination."""
        e = self.elimination
        eliminated = np.flatnonzero(~e.is_kept)
        rank = np.empty(e.landmarks, dtype=np.int64)
        rank[eliminated] = np.arange(len(eliminated))
        place = np.empty(len(e.block_sizes), dtype=np.int64)
        place[self.factor.block_order] = len(eliminated) + np.arange(len(place))
        L = self.factor.factor()
        block = np.repeat(np.sort(place), e.block_sizes[self.factor.block_order])
        column = np.repeat(np.arange(L.shape[1]), np.diff(L.indptr))
        reduced = np.unique(block[L.indices] * (len(eliminated) + len(place)) + block[column])
        reduced_row, reduced_column = np.divmod(reduced, len(eliminated) + len(place))
        own = np.arange(len(eliminated))
        return (
            np.concatenate([own, place[e.frame[e.of_eliminated]], reduced_row]),
            np.concatenate([own, rank[e.landmark[e.of_eliminated]], reduced_column]),
        )

    def sample(self, rng: np.random.Generator, size: int) -> tuple[Array, Array]:
        """Independent draws of the unknowns: ``eps`` (size, T, 6) and ``d`` (size, M, 3)."""
        e = self.elimination
        reduced = self.factor.sample_transform(rng.standard_normal((int(e.start[-1]), size)))
        eps, d = np.empty((size, e.frames, 6)), np.empty((size, e.landmarks, 3))
        for i in range(size):
            x = reduced[: 6 * e.frames, i].reshape(-1, 6)
            white = rng.standard_normal((e.landmarks, 3))
            d[i] = self.d + self._landmarks_given(x, reduced[6 * e.frames :, i].reshape(-1, 3), white)
            eps[i] = self.eps + self._with_first_pose(x)
        return eps, d

    def _selection(self, frames: IntArray, landmarks: IntArray) -> sp.csr_array:
        """What picks poses and landmarks out of the reduced unknowns: an eliminated landmark follows its poses."""
        e = self.elimination
        height = 6 * len(frames) + 3 * len(landmarks)
        pose_blocks = np.broadcast_to(np.eye(6), (len(frames), 6, 6)).copy()
        pose_blocks[frames == 0] = self._B

        place = np.full(e.landmarks, -1)
        place[landmarks] = 6 * len(frames) + 3 * np.arange(len(landmarks))
        chosen = np.flatnonzero((place[e.landmark] >= 0) & ~e.is_kept[e.landmark])
        follow = -self._L_inverse[e.landmark[chosen]].swapaxes(1, 2) @ self._Y[chosen]
        kept = landmarks[e.is_kept[landmarks]]

        parts = (
            (6 * np.arange(len(frames)), e.start[frames], pose_blocks),
            (place[e.landmark[chosen]], e.start[e.frame[chosen]], follow),
            (place[kept], e.start[e.block_of_landmark[kept]], np.broadcast_to(np.eye(3), (len(kept), 3, 3))),
        )
        row, column, value = [], [], []
        for first_row, first_column, block in parts:
            shape = block.shape
            row.append(np.broadcast_to(first_row[:, None, None] + np.arange(shape[1])[:, None], shape).ravel())
            column.append(np.broadcast_to(first_column[:, None, None] + np.arange(shape[2]), shape).ravel())
            value.append(block.ravel())
        return sp.csr_array(
            (np.concatenate(value), (np.concatenate(row), np.concatenate(column))), shape=(height, int(e.start[-1]))
        )


def _H_mx(system: LinearSystem, observations: IntArray | slice = slice(None)) -> Array:
    """Blocks (n, 3, 6) of the information between the landmarks and the poses of some observations."""
    blocks = system.J_m[observations].swapaxes(1, 2) @ system.J_x[observations]
    first = system.frame[observations] == 0
    blocks[first] = blocks[first] @ system.B
    return blocks


def _cholesky_of_landmarks(H_mm: Array, ids: IntArray) -> Array:
    """Cholesky factors (M, 3, 3) of the landmarks' own information.

    Raises:
        IllPosedError: Some are singular to working precision; names them.
    """
    undefined = ~np.isfinite(H_mm).all(axis=(1, 2))
    if undefined.any():
        raise IllPosedError("landmarks with infinite or undefined information", ids[undefined])
    eigenvalues = np.linalg.eigvalsh(H_mm)
    weak = ~(eigenvalues[:, 0] > 1e-13 * eigenvalues[:, 2])
    if weak.any():
        raise IllPosedError("landmarks with too little information", ids[weak])
    return np.asarray(np.linalg.cholesky(H_mm))
