"""Factors: whitened rows over a few unknowns each, and the linear system that a list of them makes.

A factor is a batch of n alike constraints ``sum_t J_t x_t = r`` with unit noise. Unknowns have four groups: ``frames``
(T, w), the pose of each frame and the shared blocks that its observations depend on; ``aux`` (T, a), further blocks of
each frame; ``drive`` (1, g), blocks with one value for the drive; ``landmarks`` (M, 3). A term may also touch
``views``, the errors (6,) of the cameras of a frame: `LinearSystem.views` says how they follow from ``frames``.

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
    """The part of a factor over one group of unknowns."""

    group: str  # one of `GROUPS`, or views
    index: IntArray  # (n,) unknown that each constraint touches
    J: Array  # (n, d, size) whitened Jacobian


@dataclass(frozen=True)
class Factor:
    """n whitened constraints of d rows each: ``sum_t J_t x_t = r``."""

    r: Array  # (n, d) residual that the unknowns explain
    terms: tuple[Term, ...]  # one for each unknown that a constraint touches. Terms without columns are dropped.
    # (n,) number of the observation that each constraint comes from, for the robust kernel.
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


def concatenated(factors: Sequence[Factor]) -> Factor:
    """Return one factor with the constraints of several, which come from observations and touch the same groups."""
    terms = [
        Term(some[0].group, np.concatenate([term.index for term in some]), np.concatenate([term.J for term in some]))
        for some in zip(*(factor.terms for factor in factors), strict=True)
    ]
    numbers = [factor.observation for factor in factors if factor.observation is not None]
    return Factor(np.concatenate([factor.r for factor in factors]), tuple(terms), np.concatenate(numbers))


@dataclass(frozen=True)
class FirstFrame:
    """Prior of the first frame, ``(eps_0, aux_0) = B zeta`` with ``zeta ~ N(-zeta_hat, I)``; B may be singular."""

    B: Array  # (w+a, w+a) root of the covariance
    zeta: Array  # (w+a,) where the system is linearised
    width: int  # size w of eps_0

    @cached_property
    def log_determinant(self) -> float:
        """Log of the determinant of ``B B^T``, without directions that are known for certain."""
        scales = np.linalg.svd(self.B, compute_uv=False)
        return 2.0 * float(np.log(scales[scales > _SINGULAR * max(scales[0], 1.0)]).sum())


@dataclass(frozen=True)
class LinearSystem:
    """All factors of a problem, linearised, to be solved in the least-squares sense."""

    factors: tuple[Factor, ...]  # all but the prior of the first frame
    first: FirstFrame  # that prior
    counts: Mapping[str, int]  # number of unknowns of each of the `GROUPS`
    sizes: Mapping[str, int]  # columns of one unknown of each group
    ids: IntArray = field(repr=False)  # (M,) landmark ids, for error messages
    # (T, 6 h, w) derivative of the h views of each frame by its unknowns frames; view h k + i is the i-th one of frame
    # k. None: no term touches views.
    views: Array | None = None
    seen: IntArray | None = None  # (s,) columns of frames by which views is regular, or all; None: all

    @staticmethod
    def of(
        factors: tuple[Factor, ...],
        first: FirstFrame,
        frames: int,
        drive: int,
        ids: IntArray,
        views: Array | None = None,
        seen: IntArray | None = None,
    ) -> LinearSystem:
        """Return the system of T frames, g columns of the drive, and landmarks with the ids (M,)."""
        sizes = {"frames": first.width, "aux": len(first.B) - first.width, "drive": drive, "landmarks": 3}
        counts = {"frames": frames, "aux": frames, "drive": 1, "landmarks": len(ids)}
        counts = {group: count if sizes[group] else 0 for group, count in counts.items()}
        return LinearSystem(factors, first, counts, sizes, ids, views, seen)

    @property
    def half_square(self) -> float:
        """Half the sum of squares of all residuals: the cost where the system is linearised."""
        own = sum(float(np.square(factor.r).sum()) for factor in self.factors)
        return 0.5 * (own + float(np.square(self.first.zeta).sum()))

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

    @property
    def first_columns(self) -> IntArray:
        """Columns (w+a,) of the first frame, if all unknowns stand in the order of `GROUPS`."""
        w = self.first.width
        return np.concatenate([np.arange(w), self.start["aux"] + np.arange(len(self.first.B) - w)])

    def rows(self) -> tuple[sp.csr_array, Array]:
        """Return J (n, N) over all unknowns, and r (n,): the first frame is zeta, and its prior comes first."""
        J, r = self.rows_without_prior()
        n, at = len(self.first.B), self.first_columns
        units = sp.eye_array(J.shape[1], format="lil")
        units[np.ix_(at, at)] = self.first.B
        prior = sp.csr_array((np.ones(n), (np.arange(n), at)), shape=(n, J.shape[1]))
        return sp.csr_array(sp.vstack([prior, J @ units.tocsr()])), np.concatenate([-self.first.zeta, r])

    def rows_without_prior(self) -> tuple[sp.csr_array, Array]:
        """Return J (n, N) over all unknowns, and r (n,), of the factors: ``J^T J`` is their information."""
        start, row, column, value, count, right = self.start, [], [], [], 0, []
        for factor in self.factors:
            first = count + np.arange(factor.r.size).reshape(factor.r.shape)
            for term in factor.terms:
                group, index, J = term.group, term.index, term.J
                if group == "views":
                    assert self.views is not None
                    by_frame = self.views.reshape(-1, 6, self.views.shape[-1])
                    group, index, J = "frames", index // (self.views.shape[1] // 6), J @ by_frame[index]
                at = start[group] + J.shape[-1] * index[:, None, None] + np.arange(J.shape[-1])
                row.append(np.broadcast_to(first[:, :, None], J.shape).ravel())
                column.append(np.broadcast_to(at, J.shape).ravel())
                value.append(J.ravel())
            count += factor.r.size
            right.append(factor.r.ravel())
        width = sum(self.counts[group] * self.sizes[group] for group in GROUPS)
        entries = np.concatenate(row), np.concatenate(column)
        return sp.csr_array((np.concatenate(value), entries), shape=(count, width)), np.concatenate(right)

    def information_matrix(self) -> tuple[sp.csc_array, IntArray]:
        """Return the information matrix (n, n) of ``eps, aux, drive, d``, and which of these (n,) are its columns.

        Components of the first frame that are known for certain (a zero row of B) have no column. Raise
        `PosteriorError` if such a direction is no axis.
        """
        J, B = self.rows_without_prior()[0], self.first.B
        known = np.abs(B).max(axis=1) > 0
        scales = np.linalg.svd(B[known], compute_uv=False)
        if known.any() and scales[-1] <= _SINGULAR * scales[0]:
            raise PosteriorError(
                "the first pose is known for certain in a direction that is no axis: no information matrix"
            )
        kept = np.ones(J.shape[1], dtype=bool)
        kept[self.first_columns[~known]] = False
        information = sp.csc_array(J.T @ J)
        if known.any():
            of_zeta, at = np.linalg.pinv(B[known]), self.first_columns[known]
            entries = np.repeat(at, len(at)), np.tile(at, len(at))
            information += sp.csc_array(((of_zeta.T @ of_zeta).ravel(), entries), shape=information.shape)
        own = np.flatnonzero(kept)
        return sp.csc_array(information[own][:, own]), own
