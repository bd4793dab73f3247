"""A symmetric sparse matrix made of blocks, assembled many times with one pattern."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import scipy.sparse as sp

from ekfslam.arrays import Array, IntArray


class BlockPattern:
    """Pattern of the lower triangle of a symmetric matrix, with whole diagonal blocks.

    Args:
        sizes: (b,) columns of each block.
        places: Sets of blocks: (n, 2) row and column of each, and the shape of all blocks of the set. A place may occur
            in several sets, but once in each.

    Attributes:
        row, column: Blocks of the pattern, in the order of the columns.
    """

    def __init__(self, sizes: IntArray, places: Sequence[tuple[IntArray, tuple[int, int]]]) -> None:
        n, start = len(sizes), np.cumsum(sizes) - sizes
        everything = np.concatenate([blocks for blocks, _ in places])
        unique, place = np.unique(everything[:, 1] * n + everything[:, 0], return_inverse=True)
        self.column, self.row = np.divmod(unique, n)
        height = sizes[self.row]
        column_height = np.bincount(self.column, weights=height, minlength=n).astype(np.int64)
        pointers = np.concatenate([[0], np.cumsum(np.repeat(column_height, sizes))])
        above = np.cumsum(height) - height
        above -= (np.cumsum(column_height) - column_height)[self.column]
        origin, stride = pointers[start[self.column]] + above, column_height[self.column]

        index_type = np.int32 if pointers[-1] < 2**31 else np.int64
        self._pointers, self._indices = pointers.astype(index_type), np.empty(pointers[-1], dtype=index_type)
        self._targets = []
        ends = np.cumsum([len(blocks) for blocks, _ in places])[:-1]
        for (blocks, (high, wide)), at in zip(places, np.split(place, ends), strict=True):
            target = origin[at, None, None] + np.arange(high)[:, None] + stride[at, None, None] * np.arange(wide)
            target = target.astype(index_type)
            self._indices[target] = start[blocks[:, 0], None, None] + np.arange(high)[:, None]
            self._targets.append(target)

    def assemble(self, values: Iterable[Array]) -> sp.csc_array:
        """Return the matrix from the blocks (n, high, wide) of each set, in the order of `places`; places add up."""
        data = np.zeros(len(self._indices))
        for target, blocks in zip(self._targets, values, strict=True):
            data[target] += blocks
        size = len(self._pointers) - 1
        return sp.csc_array((data, self._indices, self._pointers), shape=(size, size))
