"""Numeric arrays of MATLAB 5 files. `scipy.io.loadmat` crashes the interpreter on some damaged files.

After 128 bytes of header come elements: a tag (type, number of bytes) and data. The data of a matrix are elements
again: flags, dimensions, name, values. Since MATLAB 7 every matrix is compressed by zlib.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from ekfslam.limits import Budget

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_NUMERIC_CLASSES = range(6, 16)  # double, single and the integers; others are cells, structures, text, ...
_COMPLEX_FLAG = 0x0800
_MOST_DEFLATED = 1032  # bytes of one compressed byte


def parse_mat(content: bytes, budget: Budget) -> dict[str, NDArray]:
    """Return every variable of a file by name; an empty array of objects stands for other than real numbers."""
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None:
        raise ValueError("the header states no byte order")
    variables = {}
    for kind, data in _elements(memoryview(content)[128:], order):
        if kind == _COMPRESSED:
            kind, data = next(_elements(_inflated(data, order, budget), order), (kind, data))
        if kind != _MATRIX:
            raise ValueError(f"unexpected element of type {kind}")
        name, value = _matrix(data, order)
        variables[name] = value
    return variables


def _inflated(data: memoryview, order: str, budget: Budget) -> memoryview:
    """Decompress an element to the size that its tag claims, if that is allowed."""
    _, size = struct.unpack_from(order + "II", zlib.decompressobj().decompress(data, 8))
    budget.take(size, "a compressed variable")
    if size > _MOST_DEFLATED * (len(data) + 1):
        raise ValueError(f"a variable claims {size} bytes, which {len(data)} compressed ones cannot hold")
    return memoryview(zlib.decompressobj().decompress(data, 8 + size))


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield type and data of each element."""
    position = 0
    while position < len(data):
        kind, size = struct.unpack_from(order + "II", data, position)
        if kind >> 16:  # up to four bytes of data share the eight bytes of the tag
            kind, size, start = kind & 0xFFFF, kind >> 16, position + 4
        else:
            start = position + 8
        if start + size > len(data):
            raise ValueError(f"an element of {size} bytes runs beyond the end")
        yield kind, data[start : start + size]
        position = start + size
        if kind != _COMPRESSED:
            position += -position % 8


def _matrix(data: memoryview, order: str) -> tuple[str, NDArray]:
    elements = list(islice(_elements(data, order), 4))
    if len(elements) < 3:
        raise ValueError("a matrix without name")
    flags, dimensions, name = (element for _, element in elements[:3])
    (flag,) = struct.unpack_from(order + "I", flags)
    text = bytes(name).decode("latin-1")
    if flag & 0xFF not in _NUMERIC_CLASSES or flag & _COMPLEX_FLAG:
        return text, np.empty(0, dtype=object)
    shape = [int(size) for size in np.frombuffer(dimensions, order + "i4")]
    kind, values = elements[3] if len(elements) > 3 else (0, b"")
    if kind not in _NUMBERS:
        raise ValueError(f"{text} has values of unknown type {kind}")
    array = np.frombuffer(values, order + _NUMBERS[kind])
    if min(shape, default=-1) < 0 or math.prod(shape) != len(array):
        raise ValueError(f"{text} has {len(array)} values for the shape {shape}")
    return text, array.reshape(shape, order="F")
