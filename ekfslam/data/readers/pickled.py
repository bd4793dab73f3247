"""Pickled dictionaries of NumPy arrays in .npy files, read without running code of the file.

`pickle` calls any function that a file names; here only arrays, their types, scalars and plain containers are allowed.
Every operation is checked before the first one runs, so that none claims more memory than the file has bytes.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
from collections.abc import Callable
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from ekfslam.errors import UnknownFormatError
from ekfslam.limits import Budget, require_file
from ekfslam.names import printable

MAGIC = b"\x93NUMPY"
_MOST_OPERATIONS = 2_000_000  # a recording has some hundred, and ten for every image
_KINDS = "biuf"

# Operations of pickled arrays and containers: numbers, texts, bytes, lists, dictionaries, memo, calls, frames.
_OPERATIONS = """
NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG1 FLOAT BINFLOAT
STRING BINSTRING SHORT_BINSTRING UNICODE BINUNICODE SHORT_BINUNICODE BINUNICODE8
BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8 EMPTY_LIST APPEND APPENDS LIST EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3
EMPTY_DICT DICT SETITEM SETITEMS GET BINGET LONG_BINGET PUT BINPUT LONG_BINPUT MEMOIZE
GLOBAL STACK_GLOBAL REDUCE BUILD PROTO FRAME STOP MARK POP POP_MARK
"""
_ALLOWED = frozenset(_OPERATIONS.split())


def read_pickled(path: Path, expected: str) -> dict[str, Any]:
    """Return the dictionary in an .npy file: arrays of numbers, lists of them, or None by name."""
    require_file(path)
    try:
        content = path.read_bytes()
        Budget(str(path)).take(len(content), "the pickled dictionary")
        stream = io.BytesIO(content)
        shape, dtype = npy_header(stream)
        if dtype != np.dtype(object) or shape != ():
            raise pickle.UnpicklingError(f"an array of {dtype} with the shape {shape} instead of a dictionary")
        begin = stream.tell()
        _inspect(stream)
        stream.seek(begin)
        loaded = _Restricted(stream, Budget(str(path))).load()
        Budget(str(path)).take(_size(loaded, {}), "the dictionary with all its lists")
        found = _unboxed(loaded)
    except RecursionError:
        raise UnknownFormatError(f"{path}: lists in lists, too deep; {expected}") from None
    except (ValueError, EOFError, OverflowError) as error:
        raise UnknownFormatError(f"{path}: damaged .npy file ({_clean(error)}); {expected}") from None
    except (TypeError, AttributeError, KeyError, IndexError):  # their words are about Python's objects, not the file
        message = f"{path}: damaged .npy file (its operations do not fit together); {expected}"
        raise UnknownFormatError(message) from None
    except pickle.UnpicklingError as error:
        raise UnknownFormatError(f"{path}: {_clean(error)}; {expected}") from None
    if not isinstance(found, dict) or not all(isinstance(name, str) for name in found):
        raise UnknownFormatError(f"{path}: an .npy file that holds no dictionary; {expected}")
    return found


def _clean(error: Exception) -> str:
    return printable(str(error))[:200]


def npy_header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return shape and type in the header of an .npy file, and advance the stream beyond it."""
    version = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        shape, _, dtype = readers[version](stream)
    except (KeyError, SyntaxError, TokenError) as error:  # of older headers NumPy parses the words themselves
        raise ValueError(f"no header of an .npy file ({error})") from None
    return shape, dtype


def _inspect(stream: io.BytesIO) -> None:
    """Refuse operations that arrays and containers do not need, too many operations, and too large a memo."""
    for count, (operation, argument, _) in enumerate(pickletools.genops(stream), start=1):
        if operation.name not in _ALLOWED:
            raise pickle.UnpicklingError(f"the operation {operation.name} is not that of arrays and containers")
        if count > _MOST_OPERATIONS:
            raise pickle.UnpicklingError(f"more than {_MOST_OPERATIONS} operations")
        # A memo grows to the largest place that is used.
        if operation.name.endswith("PUT") and not 0 <= int(argument or 0) <= count:
            raise pickle.UnpicklingError(f"a memo of {argument} entries after {count} operations")


class _Known:
    """Function that a file may call; it has no attributes that a file could change."""

    __slots__ = ("_make",)

    def __init__(self, make: Callable[..., Any]) -> None:
        self._make = make

    def __call__(self, *arguments: Any) -> Any:
        return self._make(*arguments)

    def __setstate__(self, state: Any) -> NoReturn:
        raise pickle.UnpicklingError("the file changes a function")


class _Type:
    """Type of numbers, or of objects."""

    __slots__ = ("code", "order")

    def __init__(self, code: str) -> None:
        self.code, self.order = str(code), "<"

    def __setstate__(self, state: Any) -> None:
        self.order = str(state[1])

    @property
    def dtype(self) -> np.dtype:
        dtype = np.dtype(self.code).newbyteorder(">" if self.order == ">" else "<")
        if dtype.kind not in _KINDS:
            raise pickle.UnpicklingError(f"an array of {dtype} instead of numbers")
        return dtype


class _Array:
    """Array that takes its values when the file sets its state."""

    __slots__ = ("value",)

    def __init__(self) -> None:
        self.value: Any = None

    def __setstate__(self, state: Any) -> None:
        _, shape, kind, is_fortran, values = state
        if kind.code.startswith("O"):
            # A dictionary, as `numpy.save` wraps it, or a ragged list of images.
            if math.prod(shape) != len(values):
                raise ValueError(f"{len(values)} objects for the shape {shape}")
            self.value = values[0] if shape == () else values
        else:
            self.value = _numbers(values, kind, shape, "F" if is_fortran else "C")


def _numbers(values: Any, kind: _Type, shape: Any, order: Any) -> NDArray:
    raw = values.encode("latin-1") if isinstance(values, str) else values
    return np.frombuffer(raw, kind.dtype).reshape(tuple(int(n) for n in shape), order="F" if order == "F" else "C")


def _boxed(array: NDArray) -> _Array:
    box = _Array()
    box.value = array
    return box


def _known(ndarray: _Known, budget: Budget) -> dict[tuple[str, str], _Known]:
    """Return the functions that pickled arrays call, by module and name, for one file."""

    def reconstruct(kind: Any, shape: Any, code: Any) -> _Array:
        if kind is not ndarray:
            raise pickle.UnpicklingError("an array of another class than numpy.ndarray")
        return _Array()

    def from_buffer(values: Any, kind: _Type, shape: Any, order: Any) -> _Array:
        return _boxed(_numbers(values, kind, shape, order))

    def scalar(kind: _Type, values: Any) -> Any:
        return _numbers(values, kind, (), "C").item()

    def encode(text: str, encoding: str) -> bytes:
        budget.take(len(text), "the text in it")  # each call makes a copy
        return text.encode("latin-1")  # bytes that were pickled for Python 2

    found = {("numpy", "ndarray"): ndarray, ("numpy", "dtype"): _Known(lambda code, *_: _Type(code))}
    found["_codecs", "encode"] = _Known(encode)
    for module in ("numpy.core", "numpy._core"):
        found[f"{module}.multiarray", "_reconstruct"] = _Known(reconstruct)
        found[f"{module}.multiarray", "scalar"] = _Known(scalar)
        found[f"{module}.numeric", "_frombuffer"] = _Known(from_buffer)
    return found


def _no_array(*_: Any) -> NoReturn:
    raise pickle.UnpicklingError("the file calls numpy.ndarray")


class _Restricted(pickle.Unpickler):
    """Unpickler that knows only the names of `_known`."""

    def __init__(self, stream: io.BytesIO, budget: Budget) -> None:
        super().__init__(stream, encoding="latin-1")
        self._names = _known(_Known(_no_array), budget)

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self._names:
            raise pickle.UnpicklingError(f"the file asks for {module}.{name}, which is neither array nor container")
        return self._names[module, name]

    def persistent_load(self, pid: Any) -> NoReturn:
        raise pickle.UnpicklingError("the file refers to objects outside of it")


def _size(value: Any, known: dict[int, int]) -> int:
    """Return the bytes of a value if each list is written out wherever it occurs; ``known`` holds those of lists."""
    value = value.value if isinstance(value, _Array) else value
    if isinstance(value, np.ndarray):
        return int(value.nbytes)
    if not isinstance(value, dict | list | tuple):
        return len(value) if isinstance(value, str | bytes) else 8
    if id(value) not in known:
        known[id(value)] = -1
        entries = value.values() if isinstance(value, dict) else value
        known[id(value)] = 8 + sum(_size(entry, known) for entry in entries)
    if known[id(value)] < 0:
        raise pickle.UnpicklingError("a list that contains itself")
    return known[id(value)]


def _unboxed(value: Any, depth: int = 2) -> Any:
    """Return a value with its arrays: a dictionary, of lists."""
    value = value.value if isinstance(value, _Array) else value
    if depth and isinstance(value, dict):
        return {name: _unboxed(entry, depth - 1) for name, entry in value.items()}
    if depth and isinstance(value, list | tuple):
        return [_unboxed(entry, depth - 1) for entry in value]
    return value
