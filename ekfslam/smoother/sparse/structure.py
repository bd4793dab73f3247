"""Structure of a linear system: which blocks of its normal equations are not zero, and what adds to each.

It follows from the indices of the factors' terms alone, and serves for every linearisation. Landmarks with few
observations are eliminated first, all at once, by their Schur complements. The rest is the *reduced* system: one block
for each frame, aux, the drive and each kept landmark.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array, IntArray
from ekfslam.errors import IllPosedError
from ekfslam.smoother.sparse.cholmod import BlockPattern, concatenated_ranges
from ekfslam.smoother.sparse.factors import GROUPS, Factor, LinearSystem

# Landmarks observed from more frames than this are kept for CHOLMOD: eliminating one couples all frames that observed
# it, pair by pair, and their number grows with the square.
ELIMINATE_UP_TO = 40
AT_ONCE = 20_000  # constraints or pairs of them, so that temporary arrays stay in the cache
REDUCED = GROUPS[:3]


@dataclass(frozen=True)
class Product:
    """Blocks ``J_row^T J_column`` of two terms of a factor, and the places to which they are added.

    Args:
        factor, row, column: Numbers of the factor and of the terms.
        rows: Constraints (m,) of the factor that take part.
        index: (m,) place of each among the `places`.
        places: (p, 2) blocks of the reduced matrix; None for pairs with landmarks and for a term with itself.
        pairs: Group of the pairs with landmarks; "": none.
    """

    factor: int
    row: int
    column: int
    rows: IntArray | slice
    index: IntArray
    places: IntArray | None = None
    pairs: str = ""

    @cached_property
    def is_sum(self) -> bool:
        """Whether several constraints go to one place."""
        return len(np.unique(self.index)) < len(self.index)


@dataclass(frozen=True)
class Coupling:
    """Couples of unknowns that eliminated landmarks connect, and the pairs (landmark, unknown) that do it.

    Couples are sorted by their numbers of pairs, so that many can be summed in one matrix product.

    Args:
        row, column: Groups of the unknowns.
        later, earlier: Pairs of either group, those of one couple together.
        sizes: (c,) number of pairs of each couple.
        couples: (c, 2) row and column blocks of the reduced matrix.
    """

    row: str
    column: str
    later: NDArray[np.int32]
    earlier: NDArray[np.int32]
    sizes: IntArray
    couples: IntArray

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
    """Blocks of the normal equations of a system.

    Args:
        system: Any linearisation.
        eliminate_up_to: Landmarks observed from at most so many frames are eliminated.

    Attributes:
        pairs: For each reduced group, landmark and unknown (p, 2) of the pairs that factors couple.
        is_kept, kept: Whether (M,) a landmark is kept for CHOLMOD, and the numbers of kept ones.
        first: First reduced block of each group.
        block_sizes, start: Columns of each reduced block; the first of them, and the number of all.
        products, couplings: Terms of the normal equations, and of the elimination.
        kept_pairs: For each reduced group, numbers of the pairs with kept landmarks.
        pattern: Pattern of the reduced matrix. Its sets: groups, products, couplings, kept pairs.

    Raises:
        IllPosedError: Landmarks without an observation; names them.
    """

    def __init__(self, system: LinearSystem, eliminate_up_to: int = ELIMINATE_UP_TO) -> None:
        self.counts, self.sizes, self.ids = system.counts, system.sizes, system.ids
        factors = system.over_zeta()
        self._find_pairs(factors)
        seen = np.bincount(self.pairs["frames"][:, 0], minlength=self.counts["landmarks"])
        if (seen == 0).any():
            raise IllPosedError("landmarks without an observation", self.ids[seen == 0])
        self.is_kept = seen > eliminate_up_to
        for factor in factors:
            of_landmarks = [term for term in factor.terms if term.group == "landmarks"]
            for term in of_landmarks[1:] and of_landmarks:
                self.is_kept[term.index] = True
        self.kept = np.flatnonzero(self.is_kept)

        counts = [*(self.counts[group] for group in REDUCED), len(self.kept)]
        self.first = dict(zip(GROUPS, (np.cumsum(counts) - counts).tolist(), strict=True))
        self.block_sizes = np.repeat([self.sizes[group] for group in GROUPS], counts)
        self.start = np.concatenate([[0], np.cumsum(self.block_sizes)])
        self._block_of_landmark = np.full(len(seen), -1)
        self._block_of_landmark[self.kept] = self.first["landmarks"] + np.arange(len(self.kept))
        self.products = [product for i, factor in enumerate(factors) for product in self._products(i, factor)]
        couples = ((row, column) for i, row in enumerate(REDUCED) for column in REDUCED[: i + 1])
        self.couplings = [self._coupling(*one) for one in couples if all(len(self.pairs[group]) for group in one)]
        self.kept_pairs = {group: np.flatnonzero(self.is_kept[pairs[:, 0]]) for group, pairs in self.pairs.items()}
        self._lay_out(factors, counts)

    def blocks(self, group: str, index: IntArray) -> IntArray:
        """Return the reduced blocks of some unknowns of a group; -1 for landmarks that are eliminated."""
        return self._block_of_landmark[index] if group == "landmarks" else self.first[group] + index

    def reduced(self, x: Array) -> dict[str, Array]:
        """Return views (count, size, ...) of an array (n, ...) over the reduced unknowns, by group."""
        parts = np.split(x, [self.start[self.first[group]] for group in GROUPS[1:]])
        size = self.sizes
        return {
            group: part.reshape(len(part) // size[group] if size[group] else 0, size[group], *x.shape[1:])
            for group, part in zip(GROUPS, parts, strict=True)
        }

    def _find_pairs(self, factors: Sequence[Factor]) -> None:
        found: dict[str, list[IntArray]] = {group: [np.empty(0, dtype=np.int64)] for group in REDUCED}
        for factor in factors:
            for landmark in (term for term in factor.terms if term.group == "landmarks"):
                for term in (term for term in factor.terms if term.group != "landmarks"):
                    found[term.group].append(landmark.index * self.counts[term.group] + term.index)
        self._keys, self._numbers, self.pairs = {}, {}, {}
        for group, keys in found.items():
            self._keys[group], first = np.unique(np.concatenate(keys), return_index=True)
            order = np.argsort(first)
            self._numbers[group] = np.empty_like(order)
            self._numbers[group][order] = np.arange(len(order))
            self.pairs[group] = np.stack(np.divmod(self._keys[group][order], max(self.counts[group], 1)), axis=-1)

    def _products(self, number: int, factor: Factor) -> Iterator[Product]:
        """Yield the products of every two terms of a factor, each term with itself included."""
        for i, one in enumerate(factor.terms):
            yield Product(number, i, i, slice(None), one.index)
            for j, other in enumerate(factor.terms[:i]):
                is_later = GROUPS.index(one.group) >= GROUPS.index(other.group)
                row, column = (i, j) if is_later else (j, i)
                high, low = factor.terms[row], factor.terms[column]
                if high.group == low.group:
                    # The later unknown has the row. One that a constraint touches twice adds both ways.
                    for a, b in ((row, column), (column, row)):
                        which = np.flatnonzero(factor.terms[a].index >= factor.terms[b].index)
                        if len(which):
                            yield self._reduced_product(number, factor, a, b, which)
                elif high.group == "landmarks":
                    place = np.searchsorted(self._keys[low.group], high.index * self.counts[low.group] + low.index)
                    index = self._numbers[low.group][place]
                    yield Product(number, row, column, slice(None), index, pairs=low.group)
                else:
                    yield self._reduced_product(number, factor, row, column, slice(None))

    def _reduced_product(self, number: int, factor: Factor, row: int, column: int, rows: IntArray | slice) -> Product:
        n = len(self.block_sizes)
        high, low = (self.blocks(factor.terms[i].group, factor.terms[i].index[rows]) for i in (row, column))
        keys, index = np.unique(high * n + low, return_inverse=True)
        return Product(number, row, column, rows, index, np.stack(np.divmod(keys, n), axis=-1))

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

    def _lay_out(self, factors: Sequence[Factor], counts: Sequence[int]) -> None:
        places = []
        for group, count in zip(GROUPS, counts, strict=True):
            own = self.first[group] + np.arange(count)
            places.append((np.stack([own, own], axis=-1), (self.sizes[group],) * 2))
        for product in self.products:
            if product.places is not None:
                high, low = (factors[product.factor].terms[i].group for i in (product.row, product.column))
                places.append((product.places, (self.sizes[high], self.sizes[low])))
        for coupling in self.couplings:
            places.append((coupling.couples, (self.sizes[coupling.row], self.sizes[coupling.column])))
        for group, kept in self.kept_pairs.items():
            landmark, index = self.pairs[group][kept].T
            blocks = np.stack([self.blocks("landmarks", landmark), self.blocks(group, index)], axis=-1)
            places.append((blocks, (3, self.sizes[group])))
        self.pattern = BlockPattern(self.block_sizes, places)
