"""Factors: whitened rows over a few unknowns each, and the linear system that a list of them makes.

A factor is a batch of n alike constraints ``sum_t J_t x_t = r`` with unit noise. Unknowns have four groups: ``frames``
(T, w), the pose of each frame and the shared blocks that its observations depend on; ``aux`` (T, a), further blocks of
each frame; ``drive`` (1, g), blocks with one value for the drive; ``landmarks`` (M, 3).

To add a new kind of factor, build it from the state at which the system is linearised, and append it to the list:

    speed = Factor(r, (Term("aux", frame, J),))  # r (n, 1), frame (n,), J (n, 1, a)
    information = JointInformation(dataclasses.replace(system, factors=(*system.factors, speed)))
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.errors import PosteriorError

GROUPS = ("frames", "aux", "drive", "landmarks")
_SINGULAR = 1e-12


@dataclass(frozen=True)
class Term:
    """The part of a factor over one group of unknowns.

    Args:
        group: One of `GROUPS`.
        index: (n,) unknown that each constraint touches.
        J: (n, d, size) whitened Jacobian.
    """

    group: str
    index: IntArray
    J: Array


@dataclass(frozen=True)
class Factor:
    """n whitened constraints of d rows each: ``sum_t J_t x_t = r``.

    Args:
        r: (n, d) residual that the unknowns explain.
        terms: One for each unknown that a constraint touches. Terms without columns are dropped.
        observation: (n,) number of the observation that each constraint comes from, for the robust kernel.
    """

    r: Array
    terms: tuple[Term, ...]
    observation: IntArray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "terms", tuple(term for term in self.terms if term.J.shape[-1]))

    def scaled(self, scale: Array) -> Factor:
        """Return the factor with each constraint multiplied by a number (n,)."""
        terms = tuple(Term(term.group, term.index, scale[:, None, None] * term.J) for term in self.terms)
        return Factor(scale[:, None] * self.r, terms, self.observation)

    def only(self, which: BoolArray) -> Factor:
        """Return some of the constraints (n,)."""
        terms = tuple(Term(term.group, term.index[which], term.J[which]) for term in self.terms)
        return Factor(self.r[which], terms, None if self.observation is None else self.observation[which])


@dataclass(frozen=True)
class FirstFrame:
    """Prior of the first frame: ``(eps_0, aux_0) = B zeta`` with ``zeta ~ N(-zeta_hat, I)``.

    Unknowns of the first frame count in units of their prior, so that its covariance ``B B^T`` may be singular.

    Args:
        B: (w+a, w+a) root of the covariance; its block [:w, w:] is 0.
        zeta: (w+a,) where the system is linearised.
        width: Size w of ``eps_0``.
    """

    B: Array
    zeta: Array
    width: int

    @property
    def frames(self) -> Array:
        """(w, w) ``eps_0`` by its own part of zeta."""
        return self.B[: self.width, : self.width]

    @property
    def aux(self) -> Array:
        """(a, a) ``aux_0`` by its own part of zeta."""
        return self.B[self.width :, self.width :]

    @property
    def coupling(self) -> Array:
        """(a, w) ``aux_0`` by the part of zeta of ``eps_0``."""
        return self.B[self.width :, : self.width]

    @cached_property
    def log_determinant(self) -> float:
        """Log of the determinant of ``B B^T``, without directions that are known for certain."""
        scales = np.linalg.svd(self.B, compute_uv=False)
        return 2.0 * float(np.log(scales[scales > _SINGULAR * max(scales[0], 1.0)]).sum())

    def factor(self) -> Factor:
        """Return the prior itself, over zeta."""
        rows, first = np.eye(len(self.B))[None], np.zeros(1, dtype=np.int64)
        parts = Term("frames", first, rows[..., : self.width]), Term("aux", first, rows[..., self.width :])
        return Factor(-self.zeta[None], parts)

    def in_units(self, factor: Factor) -> list[Factor]:
        """Return a factor over ``eps_0`` and ``aux_0`` as factors over zeta."""
        terms, coupled = [], np.zeros(len(factor.r), dtype=bool)
        further: list[Term] = []
        for term in factor.terms:
            first, J = term.index == 0, term.J
            if term.group in ("frames", "aux") and first.any():
                J = J.copy()
                J[first] = J[first] @ (self.frames if term.group == "frames" else self.aux)
                if term.group == "aux" and self.coupling.any():
                    coupled |= first
                    by_frame = np.where(first[:, None, None], term.J, 0.0) @ self.coupling
                    further.append(Term("frames", np.zeros_like(term.index), by_frame))
            terms.append(Term(term.group, term.index, J))
        changed = dataclasses.replace(factor, terms=tuple(terms))
        if not further:
            return [changed]
        also = dataclasses.replace(factor, terms=(*terms, *further)).only(coupled)
        return [also] if coupled.all() else [changed.only(~coupled), also]


@dataclass(frozen=True)
class LinearSystem:
    """All factors of a problem, linearised, to be solved in the least-squares sense.

    Args:
        factors: All but the prior of the first frame.
        first: That prior.
        counts: Number of unknowns of each of the `GROUPS`.
        sizes: Columns of one unknown of each group.
        ids: (M,) landmark ids, for error messages.
    """

    factors: tuple[Factor, ...]
    first: FirstFrame
    counts: Mapping[str, int]
    sizes: Mapping[str, int]
    ids: IntArray = field(repr=False)

    @staticmethod
    def of(factors: tuple[Factor, ...], first: FirstFrame, frames: int, drive: int, ids: IntArray) -> LinearSystem:
        """Return the system of T frames, g columns of the drive, and landmarks with the ids (M,)."""
        sizes = {"frames": first.width, "aux": len(first.B) - first.width, "drive": drive, "landmarks": 3}
        counts = {"frames": frames, "aux": frames, "drive": 1, "landmarks": len(ids)}
        counts = {group: count if sizes[group] else 0 for group, count in counts.items()}
        return LinearSystem(factors, first, counts, sizes, ids)

    @property
    def half_square(self) -> float:
        """Half the sum of squares of all residuals: the cost where the system is linearised."""
        own = sum(float(np.square(factor.r).sum()) for factor in self.factors)
        return 0.5 * (own + float(np.square(self.first.zeta).sum()))

    def over_zeta(self) -> list[Factor]:
        """Return all factors, with the first frame in units of its prior."""
        return [self.first.factor(), *(part for factor in self.factors for part in self.first.in_units(factor))]

    def norms(self, observations: int) -> Array:
        """Return the norms (K,) of the residuals of the factors that come from observations."""
        s = np.zeros(observations)
        for factor in self.factors:
            if factor.observation is not None:
                s[factor.observation] = np.linalg.norm(factor.r, axis=1)
        return s

    def weighted(self, weight: Array) -> LinearSystem:
        """Return the system with the squares of each observation multiplied by a weight (K,)."""
        root = np.sqrt(weight)
        factors = (f if f.observation is None else f.scaled(root[f.observation]) for f in self.factors)
        return dataclasses.replace(self, factors=tuple(factors))

    @property
    def start(self) -> dict[str, int]:
        """First column of each group, if all unknowns stand in the order of `GROUPS`."""
        ends = np.cumsum([self.counts[group] * self.sizes[group] for group in GROUPS]).tolist()
        return dict(zip(GROUPS, [0, *ends[:-1]], strict=True))

    def rows(self, factors: Sequence[Factor] | None = None) -> tuple[sp.csr_array, Array]:
        """Return J (n, N) over all unknowns, and r (n,), of some factors: ``J^T J`` is their information.

        By default they are all, with the first frame as zeta.
        """
        start, row, column, value, count, right = self.start, [], [], [], 0, []
        for factor in self.over_zeta() if factors is None else factors:
            first = count + np.arange(factor.r.size).reshape(factor.r.shape)
            for term in factor.terms:
                size = term.J.shape[-1]
                at = start[term.group] + size * term.index[:, None, None] + np.arange(size)
                row.append(np.broadcast_to(first[:, :, None], term.J.shape).ravel())
                column.append(np.broadcast_to(at, term.J.shape).ravel())
                value.append(term.J.ravel())
            count += factor.r.size
            right.append(factor.r.ravel())
        width = sum(self.counts[group] * self.sizes[group] for group in GROUPS)
        entries = np.concatenate(row), np.concatenate(column)
        return sp.csr_array((np.concatenate(value), entries), shape=(count, width)), np.concatenate(right)

    def information_matrix(self) -> tuple[sp.csc_array, IntArray]:
        """Return the information matrix (n, n) of ``eps, aux, drive, d``, and which of these (n,) are its columns.

        Components of the first frame that are known for certain (a zero row of B) have no column.

        Raises:
            PosteriorError: The first frame is known for certain in a direction that is no axis.
        """
        J, B = self.rows()[0], self.first.B
        known = np.abs(B).max(axis=1) > 0
        scales = np.linalg.svd(B[known], compute_uv=False)
        if known.any() and scales[-1] <= _SINGULAR * scales[0]:
            raise PosteriorError(
                "the first pose is known for certain in a direction that is no axis: no information matrix"
            )
        w, at_aux = self.first.width, self.start["aux"]
        columns = np.concatenate([np.arange(w), at_aux + np.arange(len(B) - w)])
        # (eps_0, aux_0) = B zeta, and of zeta nothing else is observed.
        of_zeta = np.linalg.pinv(B[known]) if known.any() else np.empty((len(B), 0))
        kept = np.ones(J.shape[1], dtype=bool)
        kept[columns] = False
        order = np.concatenate([columns[known], np.flatnonzero(kept)])
        J = sp.hstack([J[:, columns] @ sp.csr_array(of_zeta), J[:, np.flatnonzero(kept)]], format="csc")
        ascending = np.argsort(order)
        J = J[:, ascending]
        return sp.csc_array(J.T @ J), order[ascending]
