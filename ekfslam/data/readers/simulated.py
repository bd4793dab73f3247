"""The built-in worlds by name, ``builtin:city`` or ``builtin:loop?seed=3``, see `ekfslam.data.simulate`."""

from __future__ import annotations

from ekfslam.data import simulate
from ekfslam.data.readers.registry import Reader

BUILTIN = "builtin:"

READER = Reader(
    "simulated",
    f"a simulated world {BUILTIN}NAME",
    lambda source: source.place.startswith(BUILTIN),
    lambda source: simulate.builtin(source.place.removeprefix(BUILTIN)),
)
