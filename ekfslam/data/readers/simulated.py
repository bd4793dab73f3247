"""The built-in worlds by name, ``builtin:city`` or ``builtin:loop?seed=3``, see `ekfslam.data.simulate`."""

from __future__ import annotations

from ekfslam.data import simulate
from ekfslam.data.readers.registry import Reader, Source
from ekfslam.data.sequence import Sequence

BUILTIN = "builtin:"


def _open(source: Source) -> Sequence:
    return simulate.builtin(source.place.removeprefix(BUILTIN))


READER = Reader("simulated", f"a simulated world {BUILTIN}NAME", lambda source: source.place.startswith(BUILTIN), _open)
