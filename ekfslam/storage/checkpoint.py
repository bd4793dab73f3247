"""Checkpoints: the whole state of an estimator in a file, from which it goes on bit for bit.

    /       attributes format, format_version, key, digest
        structure   the objects as JSON, see below
        memory      the contents of all arrays

An estimator is objects of this package that hold arrays, numbers, texts and containers of these. Each is a node of a
list; what an object holds are numbers of nodes, so that what is shared stays shared. An array is a view of a piece of
memory: arrays that are views of one another are so again, in the same order of memory, on which the last bit depends.

A file is data and never program: reading makes objects of known classes of this package without calling anything of
them. It is refused unless its ``key`` says that it belongs to the same recording, settings and software.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ekfslam import files, hdf5
from ekfslam.config import Config
from ekfslam.data.sequence import Sequence
from ekfslam.errors import EkfslamError, ResumeError, WriteError

FORMAT = "ekfslam-checkpoint"
FORMAT_VERSION = 1
EVERY_S = 30.0
SHARE = 0.05  # of the time may go into checkpoints

_LAYOUT = hdf5.layout(
    ("structure", "structure", ("n",), "JSON, UTF-8", "none", hdf5.whole(0, 255)),
    ("memory", "memory", ("m",), "contents of arrays", "none", hdf5.whole(0, 255)),
)
_PLAIN = (str, int, float, bool, type(None))
_CONTAINERS: dict[str, Callable[[list[Any]], Any]] = {"list": list, "tuple": tuple, "set": set}
# Where the classes of an estimator are; there are none of other modules.
_ROOMS = (
    "ekfslam.filters.",
    "ekfslam.models.",
    "ekfslam.smoother.",
    "ekfslam.geometry.",
    "ekfslam.data.",
    "ekfslam.config.",
)
_KINDS = "fiub"  # of arrays


class _Packer:
    """Takes objects apart into nodes.

    Args:
        of_fields: Of dataclasses their fields alone, without what they have worked out meanwhile.
    """

    def __init__(self, of_fields: bool = False) -> None:
        self.of_fields = of_fields
        self.nodes: list[Any] = []
        self.memory: list[bytes] = []
        self._size = 0
        self._of: dict[int, int] = {}
        self._kept: list[Any] = []  # so that no number of an object is given to another meanwhile

    def node(self, value: Any) -> int:
        """The number of the node of a value."""
        if id(value) in self._of:
            return self._of[id(value)]
        number = len(self.nodes)
        self.nodes.append(None)
        self._of[id(value)] = number
        self._kept.append(value)
        self.nodes[number] = self._taken_apart(value)
        return number

    def _taken_apart(self, value: Any) -> Any:
        if isinstance(value, np.generic):
            return ["scalar", value.dtype.str, value.tobytes().hex()]
        if type(value) in _PLAIN:
            return ["float", value.hex()] if isinstance(value, float) else ["plain", value]
        if isinstance(value, np.ndarray):
            return self._array(value)
        if isinstance(value, slice):
            return ["slice", value.start, value.stop, value.step]
        for name, kind in (("list", list), ("tuple", tuple), ("set", set)):
            if type(value) is kind:
                return [name, [self.node(item) for item in value]]
        items = [[self.node(k), self.node(v)] for k, v in value.items()] if isinstance(value, dict) else []
        if type(value) is dict:
            return ["dict", items]
        place = f"{type(value).__module__}:{type(value).__qualname__}"
        _class_of(place)
        held = vars(value)
        if self.of_fields and dataclasses.is_dataclass(value):
            held = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return ["object", place, items, {name: self.node(item) for name, item in held.items()}]

    def _array(self, array: NDArray) -> Any:
        owner = array
        while isinstance(owner.base, np.ndarray):
            owner = owner.base
        if array.dtype.kind not in _KINDS:
            raise TypeError(f"an array of {array.dtype} has no place in a checkpoint")
        shape, strides, dtype = list(array.shape), list(array.strides), array.dtype.str
        if owner is not array:
            offset = array.__array_interface__["data"][0] - owner.__array_interface__["data"][0]
            return ["view", self.node(owner), offset, dtype, shape, strides, array.flags.writeable]
        as_it_lies = array if array.flags.c_contiguous else array.transpose(np.argsort(strides, kind="stable")[::-1])
        content = as_it_lies.tobytes()
        begin, self._size = self._size, self._size + len(content)
        self.memory.append(content)
        return ["array", begin, len(content), dtype, shape, strides, array.flags.writeable]


class _Builder:
    """Puts objects together from nodes; anything but what `_Packer` makes is an error that `hdf5.opened` names."""

    def __init__(self, nodes: list[Any], memory: NDArray) -> None:
        self.nodes, self.memory = nodes, memory
        self._made: dict[int, Any] = {}
        self._open: set[int] = set()

    def value(self, number: int) -> Any:
        """What the node of a number stands for."""
        if number in self._made:
            return self._made[number]
        if number in self._open or not 0 <= number < len(self.nodes):
            raise ValueError(f"node {number} is part of itself, or none")
        kind, *rest = self.nodes[number]
        if kind == "object":  # may hold what holds it
            return self._object(number, *rest)
        self._open.add(number)
        self._made[number] = (
            getattr(self, f"_{kind}")(*rest) if kind not in _CONTAINERS else self._container(kind, *rest)
        )
        self._open.discard(number)
        return self._made[number]

    def _plain(self, value: Any) -> Any:
        if type(value) not in _PLAIN:
            raise TypeError("no plain value")
        return value

    def _float(self, text: str) -> float:
        return float.fromhex(text)

    def _scalar(self, dtype: str, content: str) -> Any:
        return np.frombuffer(bytes.fromhex(content), _dtype(dtype))[0]

    def _slice(self, start: int | None, stop: int | None, step: int | None) -> slice:
        return slice(start, stop, step)

    def _container(self, kind: str, items: list[int]) -> Any:
        return _CONTAINERS[kind]([self.value(item) for item in items])

    def _dict(self, items: list[list[int]]) -> dict[Any, Any]:
        return {self.value(key): self.value(item) for key, item in items}

    def _array(
        self, begin: int, size: int, dtype: str, shape: list[int], strides: list[int], writeable: bool
    ) -> NDArray:
        if not 0 <= begin <= begin + size <= len(self.memory):
            raise ValueError("an array lies outside of the memory")
        return _view(self.memory[begin : begin + size].copy(), 0, dtype, shape, strides, writeable)

    def _view(
        self, owner: int, offset: int, dtype: str, shape: list[int], strides: list[int], writeable: bool
    ) -> NDArray:
        array = self.value(owner)
        return _view(array.base, offset, dtype, shape, strides, writeable)

    def _object(self, number: int, place: str, items: list[list[int]], held: dict[str, int]) -> Any:
        kind = _class_of(place)
        made = kind.__new__(kind)  # type: ignore[call-overload]
        self._made[number] = made
        for key, item in items:
            made[self.value(key)] = self.value(item)
        vars(made).update({str(name): self.value(item) for name, item in held.items()})
        return made


def _dtype(text: str) -> np.dtype:
    dtype = np.dtype(text)
    if dtype.kind not in _KINDS:
        raise TypeError(f"an array of {dtype} has no place in a checkpoint")
    return dtype


def _view(memory: NDArray, offset: int, dtype: str, shape: list[int], strides: list[int], writeable: bool) -> NDArray:
    """A view of bytes; NumPy refuses one that reaches beyond them."""
    if not (isinstance(memory, np.ndarray) and memory.dtype == np.uint8):
        raise TypeError("a view of what is no memory")
    array: NDArray = np.ndarray(tuple(shape), _dtype(dtype), memory, offset, tuple(strides))
    array.flags.writeable = bool(writeable)
    return array


def _class_of(place: str) -> type:
    """A class of an estimator by the name of its module and its own; never anything else."""
    module, _, name = place.partition(":")
    found = getattr(importlib.import_module(module), name, None) if f"{module}.".startswith(_ROOMS) else None
    if not isinstance(found, type) or found.__module__ != module:
        raise TypeError(f"{place} is no class of an estimator")
    return found


def image(key: str, state: Mapping[str, Any]) -> bytes:
    """The bytes of a checkpoint of a state: a dictionary of what an estimator and its run hold."""
    packer = _Packer()
    root = packer.node(dict(state))
    structure = np.frombuffer(json.dumps([root, packer.nodes]).encode(), np.uint8)
    memory = np.frombuffer(b"".join(packer.memory), np.uint8)

    def fill(h5file: Any) -> None:
        hdf5.write_attributes(h5file, {"key": key, "digest": _digest(structure, memory)})
        for item, value in zip(_LAYOUT, (structure, memory), strict=True):
            hdf5.write_attributes(
                h5file.create_dataset(item.name, data=value), {"units": item.units, "frame": item.frame}
            )

    return hdf5.image(FORMAT, FORMAT_VERSION, fill)


def read(path: str | Path, key: str) -> dict[str, Any]:
    """The state in a checkpoint.

    Raises:
        ResumeError: It is missing or damaged, or of another recording, other settings or other software.
    """
    with hdf5.opened(path, FORMAT, FORMAT_VERSION, error=ResumeError) as h5file:
        if hdf5.attribute(h5file, "key") != key:
            raise ResumeError(
                f"{path}: is of another recording, other settings or another release; without --resume all begins anew"
            )
        structure, memory = (h5file[item.name][()] for item in _LAYOUT)
        if hdf5.attribute(h5file, "digest") != _digest(structure, memory):
            raise ResumeError(f"{path}: damaged checkpoint")
        root, nodes = json.loads(structure.tobytes())
        try:
            state = _Builder(nodes, memory).value(root)
        except (AttributeError, RecursionError) as error:
            raise ResumeError(f"{path}: damaged checkpoint ({error})") from None
    if not isinstance(state, dict):
        raise ResumeError(f"{path}: damaged checkpoint")
    return state


def _digest(*parts: NDArray) -> str:
    return hashlib.sha256(b"".join(hashlib.sha256(part.tobytes()).digest() for part in parts)).hexdigest()


def key_of(sequence: Sequence, config: Config, mode: str, software: Mapping[str, str]) -> str:
    """What a run depends on, as 64 hexadecimal digits: recording, settings, mode, versions and the program itself."""
    digest = hashlib.sha256()
    packer = _Packer(of_fields=True)
    recording = {field.name: getattr(sequence, field.name) for field in dataclasses.fields(sequence)}
    facts = dict(sequence.attributes)
    packer.node({**recording, "attributes": facts, "config": dataclasses.asdict(config), "mode": mode})
    digest.update(json.dumps([packer.nodes, dict(software)]).encode())
    for part in packer.memory:
        digest.update(part)
    package = Path(__file__).parents[1]
    for source in sorted(package.rglob("*.py")):
        digest.update(source.read_bytes())
    return digest.hexdigest()


@dataclass
class Checkpoints:
    """Where a run keeps its state, and how often.

    Args:
        path: File of the checkpoint.
        resume: Whether to go on from it if it is there.
        every_s: Seconds between two; more where writing one takes long.
    """

    path: Path
    resume: bool = False
    every_s: float = dataclasses.field(default_factory=lambda: EVERY_S)

    def __post_init__(self) -> None:
        self.path = Path(self.path)  # a string does, too
        self._next = monotonic() + self.every_s

    def found(self, key: str) -> dict[str, Any] | None:
        """The state to go on from, if there is one.

        Raises:
            ResumeError: There is one, but damaged, or of something else.
        """
        return read(self.path, key) if self.resume and self.path.exists() else None

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        """Remove them where the work is done or has failed; an interruption leaves them to go on with."""
        if error is None or (isinstance(error, EkfslamError) and not isinstance(error, ResumeError)):
            self.remove()

    def beside(self, ending: str) -> Checkpoints:
        """Those of a part of the work, in a file of their own."""
        return Checkpoints(self.path.with_name(self.path.name + ending), self.resume, self.every_s)

    def keep(self, key: str, state: Mapping[str, Any], always: bool = False) -> None:
        """Write the state if it is time, or ``always``; where that fails, the work goes on."""
        begin = monotonic()
        if begin < self._next and not always:
            return
        with suppress(WriteError):  # a disk that is full now need not be so at the end
            files.write_all({self.path: image(key, state)})
        end = monotonic()
        self._next = end + max(self.every_s, (end - begin) / SHARE)

    def remove(self) -> None:
        """The work is done: nothing is to be gone on with."""
        for path in (self.path, self.path.with_name(self.path.name + ".full")):
            path.unlink(missing_ok=True)
