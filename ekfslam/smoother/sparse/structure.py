"""Structure of a linear system: which blocks of its normal equations are not zero, and what adds to each.

It follows from the indices of the factors' terms alone, and serves for every linearisation. Landmarks with few
observations are eliminated first, all at once, by their Schur complements. The rest is the *reduced* system: blocks
for what each frame has *seen* and *hidden* (`ekfslam.smoother.sparse.coordinates`), the drive and each kept landmark.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array, IntArray
from ekfslam.errors import IllPosedError
from ekfslam.smoother.sparse.cholmod import BlockPattern, concatenated_ranges
from ekfslam.smoother.sparse.coordinates import REDUCED, SOLVED, Coordinates
from ekfslam.smoother.sparse.factors import Factor, LinearSystem

# Landmarks whose elimination would couple more columns of frames are kept for CHOLMOD: the work grows with the square.
MOST_COUPLED = 300
AT_ONCE = 20_000  # constraints or pairs of them, so that temporary arrays stay in the cache


@dataclass(frozen=True)
class Side:
    """Columns of the constraints of a factor that touch the same unknowns, other than landmarks."""

    group: str  # one of `REDUCED`; views count as what their frames have seen
    index: IntArray  # (s,) unknown of each stretch of constraints
    term: int  # number of the term
    view: IntArray | None  # (s,) number of the view among those of its frame; None: the term is over coordinates

    @cached_property
    def once(self) -> bool:
        """Whether no two stretches touch the same unknown."""
        return len(np.unique(self.index)) == len(self.index)


@dataclass(frozen=True)
class Batch:
    """The constraints of a factor, in *stretches* that touch the same unknowns other than landmarks."""

    order: IntArray | None  # (n,) constraints, those of a stretch together; None: they are so already
    start: IntArray  # (s,) first one of each stretch
    sides: tuple[Side, ...]  # terms that are not over landmarks
    landmarks: tuple[int, ...]  # numbers of the terms over landmarks
    # For each such term and each side, the pair (n,) of each constraint in order; over views the number of the view
    # among those of all pairs.
    pairs: dict[tuple[int, int], IntArray] = field(default_factory=dict)


@dataclass(frozen=True)
class Product:
    """Blocks ``J_row^T J_column`` of two terms of a factor, and the blocks of the reduced matrix they are added to."""

    batch: int  # number of the factor
    row: int  # row, column: numbers of sides, or of the terms over landmarks
    column: int
    which: IntArray  # stretches (m,), or constraints of two landmarks, that take part
    index: IntArray | None  # (m,) place of each among the `places`; None: they are in order
    places: IntArray  # (p, 2) blocks of the reduced matrix
    of_landmarks: bool = False  # whether both are landmarks


@dataclass(frozen=True)
class Coupling:
    """Couples of unknowns that eliminated landmarks connect, sorted by number of pairs (landmark, unknown)."""

    row: str  # row, column: groups of the unknowns
    column: str
    later: NDArray[np.int32]  # later, earlier: pairs of either group, those of one couple together
    earlier: NDArray[np.int32]
    sizes: IntArray  # (c,) number of pairs of each couple
    couples: IntArray  # (c, 2) row and column blocks of the reduced matrix

    def portions(self) -> Iterator[tuple[slice, NDArray[np.int32], NDArray[np.int32]]]:
        """Yield couples with one number of pairs, few enough for the cache: their slice, later, earlier (g, size)."""
        starts = np.cumsum(self.sizes) - self.sizes
        sizes, first = np.unique(self.sizes, return_index=True)
        for size, begin, end in zip(sizes, first, np.append(first, len(starts))[1:], strict=True):
            step = max(1, AT_ONCE // size)
            for couple in range(begin, end, step):
                stop = min(couple + step, end)
                pairs = slice(starts[couple], starts[couple] + size * (stop - couple))
                yield slice(couple, stop), self.later[pairs].reshape(-1, size), self.earlier[pairs].reshape(-1, size)


class Structure:
    """Blocks of the normal equations of a system; an `IllPosedError` names landmarks without an observation.

    Landmarks observed from at most ``eliminate_up_to`` frames are eliminated; None: see `MOST_COUPLED`.

    Attributes:
        pairs: For each reduced group, landmark and unknown (p, 2) of the pairs that factors couple, by unknown.
        is_kept, kept: Whether (M,) a landmark is kept for CHOLMOD, and the numbers of kept ones.
        first, block_sizes, start: First reduced block of each group; columns of each block; the first of them, and all.
        batches: Constraints of the factors; `normal_equations` adds their products.
        products, couplings: Terms of the normal equations, and of the elimination.
        kept_pairs: For each reduced group, numbers of the pairs with kept landmarks.
        pattern: Pattern of the reduced matrix. Its sets: groups, products, couplings, kept pairs.
    """

    def __init__(self, system: LinearSystem, eliminate_up_to: int | None = None) -> None:
        coordinates = Coordinates.of(system)
        factors, seen = coordinates.factors(system), coordinates.seen
        frames, landmarks = system.counts["frames"], system.counts["landmarks"]
        self.sizes = {
            "seen": seen,
            "hidden": len(system.first.B) - seen,
            "drive": system.sizes["drive"],
            "landmarks": 3,
        }
        self.counts = {"seen": frames, "hidden": frames, "drive": 1, "landmarks": landmarks}
        self.counts = {group: count if self.sizes[group] else 0 for group, count in self.counts.items()}
        self.ids = system.ids
        self.batches = [_batch(factor, coordinates) for factor in factors]
        self.views = coordinates.C.shape[1] // 6
        self._find_pairs(factors)
        observed = np.bincount(self.pairs["seen"][:, 0], minlength=landmarks)
        if (observed == 0).any():
            raise IllPosedError("landmarks without an observation", self.ids[observed == 0])
        self.is_kept = observed > (MOST_COUPLED // seen if eliminate_up_to is None else eliminate_up_to)
        for factor, batch in zip(factors, self.batches, strict=True):
            for term in batch.landmarks[1:] and batch.landmarks:
                self.is_kept[factor.terms[term].index] = True
        self.kept = np.flatnonzero(self.is_kept)

        counts = [*(self.counts[group] for group in REDUCED), len(self.kept)]
        self.first = dict(zip(SOLVED, (np.cumsum(counts) - counts).tolist(), strict=True))
        self.block_sizes = np.repeat([self.sizes[group] for group in SOLVED], counts)
        self.start = np.concatenate([[0], np.cumsum(self.block_sizes)])
        self._block_of_landmark = np.full(landmarks, -1)
        self._block_of_landmark[self.kept] = self.first["landmarks"] + np.arange(len(self.kept))
        self.products = [product for i, factor in enumerate(factors) for product in self._products(i, factor)]
        couples = ((row, column) for i, row in enumerate(REDUCED) for column in REDUCED[: i + 1])
        self.couplings = [self._coupling(*one) for one in couples if all(len(self.pairs[group]) for group in one)]
        self.kept_pairs = {group: np.flatnonzero(self.is_kept[pairs[:, 0]]) for group, pairs in self.pairs.items()}
        self._lay_out(counts)

    def blocks(self, group: str, index: IntArray) -> IntArray:
        """Return the reduced blocks of some unknowns of a group; -1 for landmarks that are eliminated."""
        return self._block_of_landmark[index] if group == "landmarks" else self.first[group] + index

    def reduced(self, x: Array) -> dict[str, Array]:
        """Return views (count, size, ...) of an array (n, ...) over the reduced unknowns, by group."""
        parts = np.split(x, [self.start[self.first[group]] for group in SOLVED[1:]])
        size = self.sizes
        return {
            group: part.reshape(len(part) // size[group] if size[group] else 0, size[group], *x.shape[1:])
            for group, part in zip(SOLVED, parts, strict=True)
        }

    def _find_pairs(self, factors: Sequence[Factor]) -> None:
        """Find all pairs of a landmark and another unknown, and those of the constraints of each batch."""
        found: dict[str, list[IntArray]] = {group: [np.empty(0, dtype=np.int64)] for group in REDUCED}
        touched = []
        for factor, batch in zip(factors, self.batches, strict=True):
            lengths = np.diff(batch.start, append=len(factor.r))
            for term in batch.landmarks:
                landmark = factor.terms[term].index
                landmark = landmark if batch.order is None else landmark[batch.order]
                for i, side in enumerate(batch.sides):
                    keys = landmark * self.counts[side.group] + np.repeat(side.index, lengths)
                    found[side.group].append(keys)
                    view = None if side.view is None else np.repeat(side.view, lengths)
                    touched.append((batch, (term, i), side.group, keys, view))
        self._numbers, self.pairs, by_key = {}, {}, {}
        for group, parts in found.items():
            by_key[group] = np.unique(np.concatenate(parts))
            order = np.argsort(by_key[group] % max(self.counts[group], 1), kind="stable")  # by unknown
            self._numbers[group] = np.empty_like(order)
            self._numbers[group][order] = np.arange(len(order))
            self.pairs[group] = np.stack(np.divmod(by_key[group][order], max(self.counts[group], 1)), axis=-1)
        for batch, one, group, keys, view in touched:
            numbers = self._numbers[group][np.searchsorted(by_key[group], keys)]
            batch.pairs[one] = numbers if view is None else numbers * self.views + view

    def _products(self, number: int, factor: Factor) -> Iterator[Product]:
        """Yield the products of every two sides of a batch, and of every two landmarks that a constraint touches."""
        batch = self.batches[number]
        blocks = [self.blocks(side.group, side.index) for side in batch.sides]
        for i in range(len(blocks)):
            for j in range(i + 1):
                yield from self._both_ways(number, i, j, blocks[i], blocks[j])
        for i in batch.landmarks:
            for j in (j for j in batch.landmarks if j < i):
                of_i, of_j = (self.blocks("landmarks", factor.terms[term].index) for term in (i, j))
                yield from self._both_ways(number, i, j, of_i, of_j, of_landmarks=True)

    def _both_ways(
        self, number: int, i: int, j: int, of_i: IntArray, of_j: IntArray, of_landmarks: bool = False
    ) -> Iterator[Product]:
        """Yield the products of two terms: the later block has the row; one that both touch adds both ways."""
        n = len(self.block_sizes)
        for row, column, high, low in ((i, j, of_i, of_j), (j, i, of_j, of_i))[: 1 if i == j else 2]:
            which = np.flatnonzero(high >= low)
            if len(which):
                keys, index = np.unique(high[which] * n + low[which], return_inverse=True)
                index = None if np.array_equal(index, np.arange(len(keys))) else index
                places = np.stack(np.divmod(keys, n), axis=-1)
                yield Product(number, row, column, which, index, places, of_landmarks)

    def _coupling(self, row: str, column: str) -> Coupling:
        """Return the couples of unknowns of two groups that eliminated landmarks connect."""
        by_row, by_column = self._numbers[row], self._numbers[column]  # by landmark, then by unknown
        of_row, of_column = self.pairs[row][by_row, 0], self.pairs[column][by_column, 0]
        eliminated = np.flatnonzero(~self.is_kept[of_row])
        starts = np.searchsorted(of_column, of_row[eliminated])
        # Within one group, each with those that do not come later.
        ends = eliminated + 1 if row == column else np.searchsorted(of_column, of_row[eliminated], side="right")
        later = by_row.astype(np.int32)[np.repeat(eliminated, ends - starts)]
        earlier = by_column.astype(np.int32)[concatenated_ranges(starts, ends - starts)]
        key = self.pairs[row][later, 1] * self.counts[column] + self.pairs[column][earlier, 1]
        by_key = np.argsort(key, kind="stable")
        keys, starts, sizes = np.unique(key[by_key], return_index=True, return_counts=True)
        by_size = np.argsort(sizes, kind="stable")
        by_key = by_key[concatenated_ranges(starts[by_size], sizes[by_size])]
        couples = np.stack(np.divmod(keys[by_size], self.counts[column]), axis=-1)
        couples += [self.first[row], self.first[column]]
        return Coupling(row, column, later[by_key], earlier[by_key], sizes[by_size], couples)

    def _lay_out(self, counts: Sequence[int]) -> None:
        places = []
        for group, count in zip(SOLVED, counts, strict=True):
            own = self.first[group] + np.arange(count)
            places.append((np.stack([own, own], axis=-1), (self.sizes[group],) * 2))
        for product in self.products:
            sides = self.batches[product.batch].sides
            row, column = (
                "landmarks" if product.of_landmarks else sides[i].group for i in (product.row, product.column)
            )
            places.append((product.places, (self.sizes[row], self.sizes[column])))
        for coupling in self.couplings:
            places.append((coupling.couples, (self.sizes[coupling.row], self.sizes[coupling.column])))
        for group, kept in self.kept_pairs.items():
            landmark, index = self.pairs[group][kept].T
            blocks = np.stack([self.blocks("landmarks", landmark), self.blocks(group, index)], axis=-1)
            places.append((blocks, (3, self.sizes[group])))
        self.pattern = BlockPattern(self.block_sizes, places)


def _batch(factor: Factor, coordinates: Coordinates) -> Batch:
    """Return the stretches of a factor over coordinates, views and landmarks."""
    n, sides, keys = len(factor.r), [], [np.zeros(len(factor.r), dtype=np.int64)]
    for i, term in enumerate(factor.terms):
        if term.group == "landmarks":
            continue
        group, index, view = term.group, term.index, None
        if group == "views":
            group, (index, view) = "seen", coordinates.index_of_views(index)
        sides.append(Side(group, index, i, view))
        keys.append(term.index)
    order = np.lexsort(keys[::-1])
    ordered = np.stack(keys, axis=-1)[order]
    start = np.flatnonzero(np.any(ordered != np.roll(ordered, 1, axis=0), axis=1) | (np.arange(n) == 0))
    first = order[start]
    own = (Side(s.group, s.index[first], s.term, None if s.view is None else s.view[first]) for s in sides)
    landmarks = tuple(i for i, term in enumerate(factor.terms) if term.group == "landmarks")
    return Batch(None if np.array_equal(order, np.arange(n)) else order, start, tuple(own), landmarks)
