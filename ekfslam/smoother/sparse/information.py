"""A Gaussian over poses, other blocks and landmarks in information form: whitened rows, normal equations, CHOLMOD.

Unknowns are ``eps`` (T, w), one vector a frame: its pose, and what else of it observations depend on; ``aux`` (T, a),
what else has a value for each frame; ``drive`` (g,), what has one value for the drive; and ``d`` (M, 3), one a
landmark. Observations touch a frame, perhaps the one before, the drive and a landmark; motion touches consecutive
frames, the aux of the later one and the drive. Landmarks know of each other only through frames and drive, so those
with few observations are eliminated first, all at once, by their
Schur complements. What remains goes to CHOLMOD. Both are steps of one sparse elimination: nothing is approximated, and
no matrix as wide as the state is ever formed.

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
    """Whitened rows ``J x = r`` over all unknowns, to be solved in the least-squares sense.

    The first frame is ``eps_0 = B zeta`` with ``zeta ~ N(0, I)``; its columns in all Jacobians are those of zeta.

    Args:
        landmarks: Number of landmarks M.
        B: (w, w) see above; ``B B^T`` may be singular.
        r_prior: (w,) right side of the rows ``zeta = r``.
        J_from, J_to: (T-1, w, w) motion rows of step k over ``eps_k`` and ``eps_{k+1}``.
        r_motion: (T-1, w) their right sides.
        frame, landmark: (K,) pose and landmark of each observation.
        J_x, J_m: (K, d, w) and (K, d, 3) rows of the observations.
        r: (K, d) their right sides.
        previous: (K,) observation whose pose the rows touch, too; -1: none.
        J_p: (K, d, w) rows over that frame; None: there is no such observation.
        J_g: (K, d, g) rows over the drive.
        J_motion_aux, J_motion_drive: (T-1, w, a) over ``aux_{k+1}`` and (T-1, w, g).
        aux_prior: (a,) weights of the rows ``weight aux_0 = r``, (a,) ``r_aux_prior``.
        phi, aux_weight: (T-1, a) of the rows ``weight (aux_{k+1} - phi aux_k) = r_aux``, element by element.
        r_aux: (T-1, a) their right sides.
        at: (n,) frames of scalar rows over aux; J_at (n, a); r_at (n,).
        landmark_weight: Weight of the rows ``weight d = r_landmark`` of every landmark; 0: there are none.
        r_landmark: (M, 3) their right sides.
        drive_prior: (g,) weights of the rows ``weight drive = r_drive``, (g,).
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
    previous: IntArray
    J_p: Array | None
    J_g: Array
    J_motion_aux: Array
    J_motion_drive: Array
    aux_prior: Array
    r_aux_prior: Array
    phi: Array
    aux_weight: Array
    r_aux: Array
    at: IntArray
    J_at: Array
    r_at: Array
    drive_prior: Array
    r_drive: Array
    landmark_weight: float = 0.0
    r_landmark: Array | float = 0.0

    @property
    def half_square(self) -> float:
        """Half the sum of squares of all right sides: the cost of leaving everything as it is."""
        right = (self.r_prior, self.r_motion, self.r, self.r_aux_prior, self.r_aux, self.r_at, self.r_drive)
        return 0.5 * (sum(float((r**2).sum()) for r in right) + float(np.square(self.r_landmark).sum()))


class Elimination:
    """What depends on nothing but which frame saw which landmark; computed once, used for every linearisation.

    Args:
        frames: Number of poses T.
        landmarks: Number of landmarks M.
        frame, landmark: (K,) of each observation; no pair may occur twice.
        ids: (M,) landmark ids, for error messages.
        aux, drive: Sizes a and g of the blocks of a frame besides its pose, and of those of the drive.
        eliminate_up_to: Landmarks with at most this many observations are eliminated before CHOLMOD's turn.
        width: Number w of unknowns of a frame: six of its pose, and what else observations depend on.
    """

    def __init__(
        self,
        frames: int,
        landmarks: int,
        frame: IntArray,
        landmark: IntArray,
        ids: IntArray,
        aux: int = 0,
        drive: int = 0,
        eliminate_up_to: int = ELIMINATE_UP_TO,
        width: int = 6,
    ) -> None:
        self.width = width
        self.frames, self.landmarks, self.ids = frames, landmarks, ids
        self.frame, self.landmark = frame, landmark
        self.aux, self.drive = aux, drive
        seen = np.bincount(landmark, minlength=landmarks)
        if (seen == 0).any():
            raise IllPosedError("landmarks without an observation", ids[seen == 0])
        self.is_kept = seen > eliminate_up_to
        self.kept = np.flatnonzero(self.is_kept)
        # Blocks of the reduced system: poses, aux of the frames, the drive, kept landmarks.
        counts = [frames, frames if aux else 0, 1 if drive else 0, len(self.kept)]
        self.block_sizes = np.repeat([width, aux, drive, 3], counts)
        self.start = np.concatenate([[0], np.cumsum(self.block_sizes)])
        self.first_block = np.concatenate([[0], np.cumsum(counts)[:-1]])  # of each of the four kinds
        self.block_of_landmark = np.full(landmarks, -1)
        self.block_of_landmark[self.kept] = self.first_block[3] + np.arange(len(self.kept))

        self.of_kept = np.flatnonzero(self.is_kept[landmark])
        self.of_eliminated = np.flatnonzero(~self.is_kept[landmark])
        self._pair_up()
        self._lay_out()

    def parts(self, x: Array) -> tuple[Array, Array, Array, Array]:
        """Frames (T, w, ...), aux (T, a, ...), drive (g, ...), kept landmarks (n, 3, ...) of the reduced unknowns."""
        ends = self.start[self.first_block[1:]]
        poses, aux, drive, kept = np.split(x, ends)
        rest = x.shape[1:]
        return (
            poses.reshape(self.frames, self.width, *rest),
            aux.reshape(self.frames, self.aux, *rest),
            drive,
            kept.reshape(-1, 3, *rest),
        )

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
        pose, steps = np.arange(self.frames), np.arange(self.frames - 1)
        own = np.arange(len(self.block_sizes))
        aux = self.first_block[1] + (pose if self.aux else pose[:0])
        drive = self.first_block[2] + np.arange(1 if self.drive else 0)
        landmark = own[self.first_block[3] :]
        of_drive = np.broadcast_to(drive, (len(pose),)) if self.drive else pose[:0]
        seen = self.block_of_landmark[self.landmark[self.of_kept]]
        w = self.width
        kinds = (  # block rows, block columns, height, width
            (pose, pose, w, w),
            (steps + 1, steps, w, w),
            (self.coupled[:, 0], self.coupled[:, 1], w, w),
            (landmark, landmark, 3, 3),
            (seen, self.frame[self.of_kept], 3, w),
            (aux, aux, self.aux, self.aux),
            (aux[1:], aux[:-1], self.aux, self.aux),
            (aux, pose[: len(aux)], self.aux, w),
            (aux[1:], steps[: len(aux[1:])], self.aux, w),
            (drive, drive, self.drive, self.drive),
            (of_drive, pose[: len(of_drive)], self.drive, w),
            (of_drive[: len(aux)], aux[: len(of_drive)], self.drive, self.aux),
            (landmark[: len(of_drive) * len(landmark)], np.repeat(drive, len(landmark)), 3, self.drive),
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
    if not values.size:
        return np.zeros((groups, *values.shape[1:]))
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
        eps: (T, w) mean of the unknowns of the frames, those of their poses first.
        zeta: (w,) mean of the first frame in units of its prior.
        aux: (T, a) mean of what else each frame has.
        drive: (g,) mean of what the drive has.
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
        self._factorise(system, damping, factor)
        g_m, right = e.sum_by_landmark(_transposed(system.J_m, system.r)), _right_side(e, system)
        g_m = g_m + system.landmark_weight * system.r_landmark
        whitened = (self._L_inverse @ g_m[..., None])[..., 0]
        reduced = right.copy()
        reduced_poses, _, reduced_drive, reduced_kept = e.parts(reduced)
        reduced_poses -= e.sum_by_frame((self._Y.swapaxes(1, 2) @ whitened[e.landmark, :, None])[..., 0])
        reduced_drive -= (self._Y_drive.swapaxes(1, 2) @ whitened[..., None])[..., 0].sum(axis=0)
        reduced_kept[...] = g_m[e.kept]
        solution = self.factor.solve(reduced)
        x, self.aux, self.drive, kept = e.parts(solution)
        self.d = self._landmarks_given(x, self.drive, kept, whitened)
        self.zeta = x[0].copy()
        self.eps = self._with_first_pose(x)
        # Half the sum of squares at the mean x: |r - J x|^2 = |r|^2 - g^T x.
        without_kept = solution[: len(right) - kept.size] @ right[: len(right) - kept.size]
        self.cost = system.half_square - 0.5 * float(without_kept + (self.d * g_m).sum())

    def _factorise(self, system: LinearSystem, damping: float, factor: SparseCholesky | None) -> None:
        """Schur complements of the eliminated landmarks, then CHOLMOD."""
        e = self.elimination
        H_mm = _sum_products(e.landmark, e.landmarks, system.J_m, system.J_m)
        H_mm += system.landmark_weight**2 * np.eye(3)
        blocks = _blocks(e, system)
        if damping:
            for H in (H_mm, blocks["pose"], blocks["aux"], blocks["drive"]):
                H += damping * np.eye(H.shape[-1])
        L = _cholesky_of_landmarks(H_mm, e.ids)
        self._L_inverse = np.linalg.inv(L)
        self._log_det_landmarks = 2.0 * float(np.log(np.diagonal(L[~e.is_kept], axis1=1, axis2=2)).sum())
        # Y_k^T Y_l is what an eliminated landmark takes from the block of the poses of its observations k and l.
        self._Y = _H_mx(system)
        H_mx_kept = self._Y[e.of_kept]
        for begin in range(0, len(e.landmark), _AT_ONCE):
            part = slice(begin, begin + _AT_ONCE)
            self._Y[part] = self._L_inverse[e.landmark[part]] @ self._Y[part]
        self._Y[e.of_kept] = 0.0
        coupling = np.empty((len(e.coupled), e.width, e.width))
        for groups, later, earlier in e.groups():
            stacked = len(later), 3 * later.shape[1], e.width
            coupling[groups] = self._Y[later].reshape(stacked).swapaxes(1, 2) @ self._Y[earlier].reshape(stacked)
        # The drive goes through every landmark.
        H_md = _sum_products(e.landmark, e.landmarks, system.J_m, system.J_g)
        self._Y_drive = self._L_inverse @ H_md
        self._Y_drive[e.kept] = 0.0
        if e.drive:
            blocks["drive"] -= (self._Y_drive.swapaxes(1, 2) @ self._Y_drive).sum(axis=0)
            blocks["drive pose"] -= _sum_products(e.frame, e.frames, self._Y_drive[e.landmark], self._Y)
        matrix = e.assemble(
            (
                blocks["pose"],
                blocks["pose step"],
                -coupling,
                H_mm[e.kept],
                H_mx_kept,
                blocks["aux"],
                blocks["aux step"],
                blocks["aux pose"],
                blocks["aux pose before"],
                blocks["drive"],
                blocks["drive pose"],
                blocks["drive aux"],
                H_md[e.kept if e.drive else e.kept[:0]],
            )
        )
        del coupling
        try:
            self.factor = SparseCholesky(matrix, e.block_sizes) if factor is None else factor.with_values(matrix)
        except NotPositiveDefiniteError as error:
            kind = int(np.searchsorted(e.first_block, error.block, side="right")) - 1
            number = error.block - int(e.first_block[kind])
            what = ("frame without enough information", "frame whose velocities have not enough information")
            if kind == 2:
                raise IllPosedError("too little information about blocks of the whole drive", []) from None
            culprit = e.ids[e.kept[number]] if kind == 3 else number
            raise IllPosedError("landmark without enough information" if kind == 3 else what[kind], [culprit]) from None

    def _landmarks_given(self, x: Array, drive: Array, kept: Array, whitened: Array) -> Array:
        """Landmarks (M, 3): eliminated ones from the poses x (T, 6) and the drive (g,), the others as they are."""
        e = self.elimination
        seen = e.sum_by_landmark((self._Y @ x[e.frame, :, None])[..., 0]) + self._Y_drive @ drive
        d = (self._L_inverse.swapaxes(1, 2) @ (whitened - seen)[..., None])[..., 0]
        d[e.kept] = kept
        return d

    def _with_first_pose(self, zeta_and_eps: Array) -> Array:
        eps = zeta_and_eps.copy()
        eps[0] = self._B @ zeta_and_eps[0]
        return eps

    @property
    def square(self) -> float:
        """Sum of squares of the mean: what damping penalises."""
        parts = (self.zeta, self.eps[1:], self.aux, self.drive, self.d)
        return float(sum((part**2).sum() for part in parts))

    @property
    def log_determinant(self) -> float:
        """Log of the determinant of the joint covariance, without directions of the first pose known for certain."""
        scales = np.linalg.svd(self._B, compute_uv=False)
        known = scales > 1e-12 * max(scales[0], 1.0)
        return 2.0 * float(np.log(scales[known]).sum()) - self.factor.log_determinant - self._log_det_landmarks

    @cached_property
    def _selected(self) -> SelectedInverse:
        return SelectedInverse(self.factor)

    def frame_covariances(self) -> Array:
        """Marginal covariances (T, w, w) of all frames, by selected inversion."""
        own = np.arange(self.elimination.frames)
        covariance = self._selected.blocks(own, own)
        covariance[0] = self._B @ covariance[0] @ self._B.T
        return covariance

    def pose_covariances(self) -> Array:
        """Marginal covariances (T, 6, 6) of all poses, by selected inversion."""
        return self.frame_covariances()[:, :6, :6]

    def aux_covariances(self) -> Array:
        """Marginal covariances (T, a, a) of what else each frame has, by selected inversion."""
        e = self.elimination
        own = e.first_block[1] + np.arange(e.frames)
        return self._selected.blocks(own, own) if e.aux else np.empty((e.frames, 0, 0))

    def drive_covariance(self) -> Array:
        """Marginal covariance (g, g) of what the drive has."""
        e = self.elimination
        own = e.first_block[2:3]
        return self._selected.blocks(own, own)[0] if e.drive else np.empty((0, 0))

    def landmark_covariances(self) -> Array:
        """Marginal covariances (M, 3, 3) of all landmarks, by selected inversion.

        Of an eliminated landmark ``L^-T (I + sum_kl Y_k Z_kl Y_l^T) L^-1`` over its observations k and l and the drive,
        Z being the selected inverse of the reduced matrix.
        """
        e = self.elimination
        half = np.zeros((e.landmarks, 3, 3))
        for groups, later, earlier in e.groups():
            Z = self._selected.blocks(*e.coupled[groups].T)
            YZ = (self._Y[later].reshape(len(later), -1, e.width) @ Z).reshape(-1, 3, e.width)
            later, earlier = later.ravel(), earlier.ravel()
            terms = YZ @ self._Y[earlier].swapaxes(1, 2)
            terms[later == earlier] *= 0.5
            half += _sum(e.landmark[later], e.landmarks, terms)
        if e.drive:
            drive = np.full(e.frames, e.first_block[2])
            Z = self._selected.blocks(np.arange(e.frames), drive)
            by_pose = e.sum_by_landmark(self._Y @ Z[e.frame])
            half += (by_pose + 0.5 * self._Y_drive @ self.drive_covariance()) @ self._Y_drive.swapaxes(1, 2)
        covariance = self._L_inverse.swapaxes(1, 2) @ (np.eye(3) + half + half.swapaxes(1, 2)) @ self._L_inverse
        if len(e.kept):
            covariance[e.kept] = self._selected.blocks(e.block_of_landmark[e.kept], e.block_of_landmark[e.kept])
        return 0.5 * (covariance + covariance.swapaxes(1, 2))

    def covariance(
        self, frames: IntArray, landmarks: IntArray, aux: IntArray | None = None, drive: bool = False
    ) -> Array:
        """Joint covariance, by solves: of some poses, of the aux of some frames, of the drive, of some landmarks.

        Args:
            frames: (p,) frame numbers, w columns each.
            landmarks: (b,) landmark numbers, not ids, three columns each; they come last.
            aux: (q,) frames whose aux follows the poses, a columns each; None: of no frame.
            drive: Whether the drive follows, with g columns.
        """
        e = self.elimination
        frames, landmarks = np.asarray(frames, dtype=np.int64), np.asarray(landmarks, dtype=np.int64)
        aux = np.empty(0, dtype=np.int64) if aux is None else np.asarray(aux, dtype=np.int64)
        selection = self._selection(frames, aux, drive, landmarks)
        half = self.factor.half_solve(selection.T.toarray())
        covariance = half.T @ half
        own = len(covariance) - 3 * len(landmarks) + 3 * np.arange(len(landmarks))
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
        """Independent draws of the unknowns: ``eps`` (size, T, w) and ``d`` (size, M, 3)."""
        e = self.elimination
        reduced = self.factor.sample_transform(rng.standard_normal((int(e.start[-1]), size)))
        eps, d = np.empty((size, e.frames, e.width)), np.empty((size, e.landmarks, 3))
        for i in range(size):
            x, _, drive, kept = e.parts(reduced[:, i])
            white = rng.standard_normal((e.landmarks, 3))
            d[i] = self.d + self._landmarks_given(x, drive, kept, white)
            eps[i] = self.eps + self._with_first_pose(x)
        return eps, d

    def _selection(self, frames: IntArray, aux: IntArray, drive: bool, landmarks: IntArray) -> sp.csr_array:
        """What picks unknowns out of the reduced ones: an eliminated landmark follows its poses and the drive."""
        e = self.elimination
        w = e.width
        pose_blocks = np.broadcast_to(np.eye(w), (len(frames), w, w)).copy()
        pose_blocks[frames == 0] = self._B
        before_aux = w * len(frames)
        before_drive = before_aux + e.aux * len(aux)
        before = before_drive + (e.drive if drive else 0)
        at_drive = e.start[e.first_block[2]]

        place = np.full(e.landmarks, -1)
        place[landmarks] = before + 3 * np.arange(len(landmarks))
        chosen = np.flatnonzero((place[e.landmark] >= 0) & ~e.is_kept[e.landmark])
        follow = -self._L_inverse[e.landmark[chosen]].swapaxes(1, 2) @ self._Y[chosen]
        follow_drive = -self._L_inverse[landmarks].swapaxes(1, 2) @ self._Y_drive[landmarks]
        kept = landmarks[e.is_kept[landmarks]]
        drives = np.arange(1 if drive and e.drive else 0)

        parts = (
            (w * np.arange(len(frames)), e.start[frames], pose_blocks),
            (
                before_aux + e.aux * np.arange(len(aux)),
                e.start[e.first_block[1] + aux] if e.aux else aux,
                np.broadcast_to(np.eye(e.aux), (len(aux), e.aux, e.aux)),
            ),
            (
                before_drive + drives,
                at_drive + drives,
                np.broadcast_to(np.eye(e.drive), (len(drives), *(e.drive,) * 2)),
            ),
            (place[e.landmark[chosen]], e.start[e.frame[chosen]], follow),
            (place[landmarks], np.full(len(landmarks), at_drive), follow_drive),
            (place[kept], e.start[e.block_of_landmark[kept]], np.broadcast_to(np.eye(3), (len(kept), 3, 3))),
        )
        row, column, value = [], [], []
        for first_row, first_column, block in parts:
            shape = block.shape
            row.append(np.broadcast_to(first_row[:, None, None] + np.arange(shape[1])[:, None], shape).ravel())
            column.append(np.broadcast_to(first_column[:, None, None] + np.arange(shape[2]), shape).ravel())
            value.append(block.ravel())
        shape = before + 3 * len(landmarks), int(e.start[-1])
        return sp.csr_array((np.concatenate(value), (np.concatenate(row), np.concatenate(column))), shape=shape)


def _transposed(J: Array, r: Array) -> Array:
    """``J^T r`` of many rows: (n, d, c), (n, d) to (n, c)."""
    return (J.swapaxes(1, 2) @ r[..., None])[..., 0]


def _blocks(e: Elimination, system: LinearSystem) -> dict[str, Array]:
    """Blocks of the information of poses, aux and drive among themselves, before landmarks are eliminated."""
    J_from, J_to, J_a, J_d = system.J_from, system.J_to, system.J_motion_aux, system.J_motion_drive
    pose = _sum_products(e.frame, e.frames, system.J_x, system.J_x)
    pose[0] += np.eye(e.width)
    pose[:-1] += J_from.swapaxes(1, 2) @ J_from
    pose[1:] += J_to.swapaxes(1, 2) @ J_to
    step = J_to.swapaxes(1, 2) @ J_from
    follows = np.flatnonzero(system.previous >= 0)
    if system.J_p is not None and len(follows):
        frame, J_p = e.frame[system.previous[follows]], system.J_p[follows]
        pose += _sum_products(frame, e.frames, J_p, J_p)
        step += _sum_products(frame, e.frames - 1, system.J_x[follows], J_p)
    blocks = {"pose": pose, "pose step": step}

    n_aux = e.frames if e.aux else 0
    aux = np.zeros((n_aux, e.aux, e.aux))
    if e.aux:
        diagonal = np.arange(e.aux)
        aux[0, diagonal, diagonal] += system.aux_prior**2
        aux[:-1, diagonal, diagonal] += (system.aux_weight * system.phi) ** 2
        aux[1:, diagonal, diagonal] += system.aux_weight**2
        aux[1:] += J_a.swapaxes(1, 2) @ J_a
        aux += _sum_products(system.at, e.frames, system.J_at[:, None], system.J_at[:, None])
    blocks["aux"] = aux
    blocks["aux step"] = -((system.aux_weight**2 * system.phi)[: max(n_aux - 1, 0), :, None] * np.eye(e.aux))
    aux_pose = np.zeros((n_aux, e.aux, e.width))
    if e.aux:
        aux_pose[1:] = J_a.swapaxes(1, 2) @ J_to
    blocks["aux pose"] = aux_pose
    blocks["aux pose before"] = (J_a.swapaxes(1, 2) @ J_from)[: max(n_aux - 1, 0)]

    n_drive = 1 if e.drive else 0
    drive, drive_pose = np.zeros((n_drive, e.drive, e.drive)), np.zeros((n_drive * e.frames, e.drive, e.width))
    drive_aux = np.zeros((n_drive * n_aux, e.drive, e.aux))
    if e.drive:
        flat = system.J_g.reshape(-1, e.drive)
        drive[0] = np.diag(system.drive_prior**2) + flat.T @ flat + (J_d.swapaxes(1, 2) @ J_d).sum(axis=0)
        drive_pose += _sum_products(e.frame, e.frames, system.J_g, system.J_x)
        if system.J_p is not None and len(follows):
            drive_pose += _sum_products(frame, e.frames, system.J_g[follows], J_p)
        drive_pose[:-1] += J_d.swapaxes(1, 2) @ J_from
        drive_pose[1:] += J_d.swapaxes(1, 2) @ J_to
        if e.aux:
            drive_aux[1:] = J_d.swapaxes(1, 2) @ J_a
    blocks["drive"], blocks["drive pose"], blocks["drive aux"] = drive, drive_pose, drive_aux
    return blocks


def _right_side(e: Elimination, system: LinearSystem) -> Array:
    """``J^T r`` of poses, aux and drive, in the order of the reduced unknowns; 0 for kept landmarks."""
    right = np.zeros(int(e.start[-1]))
    poses, aux, drive, _ = e.parts(right)
    poses += e.sum_by_frame(_transposed(system.J_x, system.r))
    poses[0] += system.r_prior
    poses[:-1] += _transposed(system.J_from, system.r_motion)
    poses[1:] += _transposed(system.J_to, system.r_motion)
    follows = np.flatnonzero(system.previous >= 0)
    if system.J_p is not None and len(follows):
        poses += _sum(e.frame[system.previous[follows]], e.frames, _transposed(system.J_p[follows], system.r[follows]))
    if e.aux:
        weighted = system.aux_weight * system.r_aux
        aux[0] += system.aux_prior * system.r_aux_prior
        aux[1:] += weighted + _transposed(system.J_motion_aux, system.r_motion)
        aux[:-1] -= system.phi * weighted
        aux += _sum(system.at, e.frames, system.J_at * system.r_at[:, None])
    if e.drive:
        drive += system.drive_prior * system.r_drive
        drive += system.J_g.reshape(-1, e.drive).T @ system.r.ravel()
        drive += _transposed(system.J_motion_drive, system.r_motion).sum(axis=0)
    return right


def _H_mx(system: LinearSystem) -> Array:
    """Blocks (K, 3, w) of the information between landmarks and the poses that observed them, one an observation."""
    blocks = system.J_m.swapaxes(1, 2) @ system.J_x
    follows = np.flatnonzero(system.previous >= 0)
    if system.J_p is not None and len(follows):
        # No observation has two successors, so that nothing is added twice to one block.
        blocks[system.previous[follows]] += system.J_m[follows].swapaxes(1, 2) @ system.J_p[follows]
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
