"""A Gaussian over all unknowns in information form: the solution of a list of factors, and its covariances.

Landmarks with few observations are eliminated by their Schur complements, and the rest is left to CHOLMOD (see
`ekfslam.smoother.sparse.structure`). Both are steps of one sparse elimination: nothing is approximated, and no matrix
as wide as the state is ever formed.
Source: Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle adjustment - a modern synthesis", 2000, section 6.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ekfslam.arrays import Array, IntArray
from ekfslam.errors import IllPosedError
from ekfslam.smoother.sparse.cholmod import NotPositiveDefiniteError, SparseCholesky
from ekfslam.smoother.sparse.coordinates import REDUCED, SOLVED, Coordinates
from ekfslam.smoother.sparse.factors import LinearSystem
from ekfslam.smoother.sparse.normal_equations import NormalEquations, normal_equations, sum_by
from ekfslam.smoother.sparse.selected_inverse import SelectedInverse
from ekfslam.smoother.sparse.structure import AT_ONCE, Structure

_UNDETERMINED = {
    "seen": "frame without enough information",
    "hidden": "frame without enough information",
    "drive": "too little information about blocks of the whole drive",
    "landmarks": "landmark without enough information",
}


class JointInformation:
    """The Gaussian that a `LinearSystem` describes, factorised; an `IllPosedError` names what is undetermined.

    Args:
        system: All factors.
        damping: Levenberg-Marquardt: added to the diagonal. Not in proportion to it: that crawls along the flat
            directions of a trajectory.
        like: A solution of another system with the same structure, whose analysis is used again.

    Attributes:
        zeta: (w+a,) mean of the first frame in units of its prior.
        eps, aux, drive, d: Means of the unknowns: (T, w), (T, a), (g,), and (M, 3) of the landmarks.
        gain, cost: Decrease of half the sum of squares from the linearisation point to the mean, and that at the mean.
    """

    structure: Structure
    factor: SparseCholesky
    _Y: dict[str, Array]
    _L_inverse: Array

    def __init__(
        self,
        system: LinearSystem,
        damping: float = 0.0,
        like: JointInformation | None = None,
        structure: Structure | None = None,
    ) -> None:
        self.structure = s = structure or (like.structure if like else Structure(system))
        # Not the factors: they take more memory than all else kept.
        self._first, self._coordinates = system.first, Coordinates.of(system)
        equations = normal_equations(s, self._coordinates.factors(system), self._coordinates)
        self._factorise(equations, damping, like)
        g = equations.gradient
        whitened = (self._L_inverse @ g["landmarks"][..., None])[..., 0]
        right = np.zeros(int(s.start[-1]))
        reduced = s.reduced(right)
        for group in REDUCED:
            landmark, index = s.pairs[group].T
            taken = (self._Y[group].swapaxes(1, 2) @ whitened[landmark, :, None])[..., 0]
            reduced[group][...] = g[group] - sum_by(index, s.counts[group], taken)
        reduced["landmarks"][...] = g["landmarks"][s.kept]
        x = s.reduced(self.factor.solve(right))
        self.d = self._landmarks_given(x, whitened)
        # With (H + damping I) x = g: |r|^2 - |r - J x|^2 = 2 g^T x - x^T H x = g^T x + damping x^T x.
        solved = {**x, "landmarks": self.d}
        self.gain = 0.5 * sum(float((solved[group] * (g[group] + damping * solved[group])).sum()) for group in SOLVED)
        self.cost = system.half_square - self.gain
        u = self._of_frames(x)
        self.zeta = self._coordinates.Q_first @ u[0]
        self.eps, self.aux = self._coordinates.unknowns(u)
        self.drive = x["drive"].ravel()

    def _factorise(self, equations: NormalEquations, damping: float, like: JointInformation | None) -> None:
        """Take the Schur complements of the landmarks, then call CHOLMOD."""
        s, self._Y = self.structure, equations.pairs
        own = [
            np.broadcast_to(damping * np.eye(s.sizes[group]), (s.counts[group],) + 2 * (s.sizes[group],))
            for group in REDUCED
        ]
        of_landmarks = equations.landmarks + damping * np.eye(3)
        L = _cholesky_of_landmarks(of_landmarks, s.ids)
        self._L_inverse = np.asarray(np.linalg.inv(L), dtype=float)
        self._log_det_landmarks = 2.0 * float(np.log(np.diagonal(L[~s.is_kept], axis1=1, axis2=2)).sum())
        # Y_k^T Y_l is what an eliminated landmark takes from the block of the unknowns of its pairs k and l.
        of_kept = []
        for group, kept in s.kept_pairs.items():
            Y, landmark = self._Y[group], s.pairs[group][:, 0]
            of_kept.append(Y[kept])
            for begin in range(0, len(Y), AT_ONCE):
                part = slice(begin, begin + AT_ONCE)
                Y[part] = self._L_inverse[landmark[part]] @ Y[part]
            Y[kept] = 0.0
        matrix = s.pattern.assemble((*own, of_landmarks[s.kept], *equations.products, *self._complements(), *of_kept))
        try:
            self.factor = SparseCholesky(s.pattern, matrix, like.factor if like else None)
        except NotPositiveDefiniteError as error:
            group = [group for group in SOLVED if s.first[group] <= error.block][-1]
            number = error.block - s.first[group]
            of_landmarks = s.ids[s.kept[number : number + 1]].tolist()
            culprits = {"landmarks": of_landmarks, "drive": []}.get(group, [number])
            raise IllPosedError(_UNDETERMINED[group], culprits) from None

    def _complements(self) -> Iterator[Array]:
        """Yield what elimination adds to the couples of unknowns of each coupling."""
        for coupling in self.structure.couplings:
            Y_row, Y_column = self._Y[coupling.row], self._Y[coupling.column]
            found = np.empty((len(coupling.couples), Y_row.shape[2], Y_column.shape[2]))
            for couples, later, earlier in coupling.portions():
                n, rows = len(later), 3 * later.shape[1]
                left, right = Y_row[later].reshape(n, rows, -1), Y_column[earlier].reshape(n, rows, -1)
                found[couples] = left.swapaxes(1, 2) @ right
            yield np.negative(found, out=found)

    def _landmarks_given(self, x: dict[str, Array], whitened: Array) -> Array:
        """Return landmarks (M, 3): eliminated ones from the reduced unknowns, the others as they are."""
        s = self.structure
        rest = whitened.copy()
        for group in REDUCED:
            landmark, index = s.pairs[group].T
            rest -= sum_by(landmark, len(rest), (self._Y[group] @ x[group][index, :, None])[..., 0])
        d = (self._L_inverse.swapaxes(1, 2) @ rest[..., None])[..., 0]
        d[s.kept] = x["landmarks"]
        return d

    def _of_frames(self, x: dict[str, Array]) -> Array:
        """Return the coordinates (T, w+a) of all frames."""
        return np.concatenate([x["seen"], x["hidden"].reshape(len(x["seen"]), -1)], axis=1)

    @property
    def log_determinant(self) -> float:
        """Log of the determinant of the joint covariance, without directions of the first frame known for certain."""
        return self._first.log_determinant - self.factor.log_determinant - self._log_det_landmarks

    @cached_property
    def _selected(self) -> SelectedInverse:
        return SelectedInverse(self.factor)

    def frame_covariances(self) -> Array:
        """Return the marginal covariances (T, w, w) of all frames."""
        return self.state_covariances[:, : self._first.width, : self._first.width]

    def aux_covariances(self) -> Array:
        """Return the marginal covariances (T, a, a) of the further blocks of the frames."""
        return self.state_covariances[:, self._first.width :, self._first.width :]

    @cached_property
    def state_covariances(self) -> Array:
        """(T, w+a, w+a) marginal covariances of frames and their further blocks, by selected inversion."""
        return self._coordinates.N @ self._frame_covariances @ self._coordinates.N.swapaxes(1, 2)

    @cached_property
    def _frame_covariances(self) -> Array:
        """(T, w+a, w+a) of the coordinates of all frames."""
        own = np.arange(self.structure.counts["seen"])
        seen = self._selected.blocks(own, own)
        if not self.structure.counts["hidden"]:
            return seen
        hidden = self.structure.blocks("hidden", own)
        across = self._selected.blocks(hidden, own)
        below = np.concatenate([across, self._selected.blocks(hidden, hidden)], axis=2)
        return np.concatenate([np.concatenate([seen, across.swapaxes(1, 2)], axis=2), below], axis=1)

    def drive_covariance(self) -> Array:
        """Return the marginal covariance (g, g) of the drive."""
        own = self.structure.blocks("drive", np.zeros(1, dtype=np.int64))
        return self._selected.blocks(own, own)[0] if self.structure.counts["drive"] else np.empty((0, 0))

    def landmark_covariances(self) -> Array:
        """Return marginals (M, 3, 3) of landmarks, eliminated: ``L^-T (I + sum_kl Y_k Z_kl Y_l^T) L^-1``."""
        s = self.structure
        half = np.zeros_like(self._L_inverse)
        for coupling in s.couplings:
            Y_row, Y_column = self._Y[coupling.row], self._Y[coupling.column]
            landmark = s.pairs[coupling.row][:, 0]
            for couples, later, earlier in coupling.portions():
                Z = self._selected.blocks(*coupling.couples[couples].T)
                YZ = (Y_row[later].reshape(len(later), -1, Y_row.shape[2]) @ Z).reshape(-1, 3, Y_column.shape[2])
                later, earlier = later.ravel(), earlier.ravel()
                terms = YZ @ Y_column[earlier].swapaxes(1, 2)
                if coupling.row == coupling.column:
                    terms[later == earlier] *= 0.5
                half += sum_by(landmark[later], len(half), terms)
        covariance = self._L_inverse.swapaxes(1, 2) @ (np.eye(3) + half + half.swapaxes(1, 2)) @ self._L_inverse
        if len(s.kept):
            own = s.blocks("landmarks", s.kept)
            covariance[s.kept] = self._selected.blocks(own, own)
        return 0.5 * (covariance + covariance.swapaxes(1, 2))

    def covariance(self, **wanted: IntArray | Sequence[int]) -> Array:
        """Return the joint covariance of unknowns, given in the order of columns: ``frames=[3, 4], landmarks=[0]``."""
        index = {group: np.asarray(chosen, dtype=np.int64) for group, chosen in wanted.items()}
        half = self.factor.half_solve(self._selection(index).T.toarray())
        covariance = half.T @ half
        if (chosen := index.get("landmarks")) is not None:  # the last group
            given_rest = self._L_inverse[chosen].swapaxes(1, 2) @ self._L_inverse[chosen]
            given_rest[self.structure.is_kept[chosen]] = 0.0
            place = len(covariance) - 3 * len(chosen) + 3 * np.arange(len(chosen))[:, None] + np.arange(3)
            covariance[place[:, :, None], place[:, None, :]] += given_rest
        return covariance

    def _selection(self, wanted: dict[str, IntArray]) -> sp.csr_array:
        """Return the matrix that picks unknowns out of the reduced ones: an eliminated landmark follows its pairs."""
        s, start = self.structure, 0
        sizes = {"frames": self._first.width, "aux": len(self._first.B) - self._first.width, **s.sizes}
        parts: list[tuple[IntArray, IntArray, Array]] = []  # rows, reduced blocks, and (n, ., .) between them
        for group, index in wanted.items():
            size = sizes[group]
            row = start + size * np.arange(len(index))
            start += size * len(index)
            if not size:
                continue
            if group in ("frames", "aux"):
                by_u = self._coordinates.rows_of(group)[index]
                parts.append((row, s.blocks("seen", index), by_u[..., : s.sizes["seen"]]))
                if s.sizes["hidden"]:
                    parts.append((row, s.blocks("hidden", index), by_u[..., s.sizes["seen"] :]))
                continue
            kept = np.flatnonzero(s.blocks(group, index) >= 0)
            blocks = np.broadcast_to(np.eye(size), (len(kept), size, size))
            parts.append((row[kept], s.blocks(group, index[kept]), blocks))
            if group == "landmarks":
                place = np.full(len(s.ids), -1)
                place[index] = row
                for other, pairs in s.pairs.items():
                    at = np.flatnonzero((place[pairs[:, 0]] >= 0) & ~s.is_kept[pairs[:, 0]])
                    landmark, unknown = pairs[at].T
                    follow = -self._L_inverse[landmark].swapaxes(1, 2) @ self._Y[other][at]
                    parts.append((place[landmark], s.blocks(other, unknown), follow))
        rows = [np.broadcast_to(row[:, None, None] + np.arange(b.shape[1])[:, None], b.shape) for row, _, b in parts]
        columns = [np.broadcast_to(s.start[at][:, None, None] + np.arange(b.shape[2]), b.shape) for _, at, b in parts]
        entries = rows, columns, [block for *_, block in parts]
        row, column, value = (np.concatenate([one.ravel() for one in many]) for many in entries)
        return sp.csr_array((value, (row, column)), shape=(start, int(s.start[-1])))

    def sample(self, rng: np.random.Generator, size: int) -> tuple[Array, Array]:
        """Return independent draws of the unknowns: ``eps`` (size, T, w) and ``d`` (size, M, 3)."""
        s = self.structure
        reduced = self.factor.sample_transform(rng.standard_normal((int(s.start[-1]), size)))
        eps, d = np.empty((size, *self.eps.shape)), np.empty((size, *self.d.shape))
        for i in range(size):
            x = s.reduced(reduced[:, i])
            d[i] = self.d + self._landmarks_given(x, rng.standard_normal(self.d.shape))
            eps[i] = self.eps + self._coordinates.unknowns(self._of_frames(x))[0]
        return eps, d


def _cholesky_of_landmarks(H_mm: Array, ids: IntArray) -> Array:
    """Return the Cholesky factors (M, 3, 3) of the landmarks' own information; name those that are singular."""
    undefined = ~np.isfinite(H_mm).all(axis=(1, 2))
    if undefined.any():
        raise IllPosedError("landmarks with infinite or undefined information", ids[undefined])
    eigenvalues = np.linalg.eigvalsh(H_mm)
    weak = ~(eigenvalues[:, 0] > 1e-13 * eigenvalues[:, 2])
    if weak.any():
        raise IllPosedError("landmarks with too little information", ids[weak])
    return np.asarray(np.linalg.cholesky(H_mm))
