"""CPU and wall-clock time of the parts of a command."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter, process_time

_BEGIN = perf_counter()  # the wall-clock time of Python's own start is not known


class Timings:
    """A clock that charges one part at a time: an inner part interrupts the outer one.

    All CPU time since the start of the process is charged to the first one.
    """

    def __init__(self, part: str = "imports") -> None:
        self.spent: dict[str, tuple[float, float]] = {}  # part to CPU and wall-clock time, s
        self._part, self._since = part, (0.0, _BEGIN)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Charge a part inside."""
        outer = self._part
        self._charge(name)
        try:
            yield
        finally:
            self._charge(outer)

    @property
    def table(self) -> str:
        """The time of each part, one line each, and their sum."""
        self._charge(self._part)
        rows = {**self.spent, "total": tuple(map(sum, zip(*self.spent.values(), strict=True)))}
        lines = (f"{name:16s} {cpu_s:8.2f} {wall_s:8.2f}" for name, (cpu_s, wall_s) in rows.items())
        return "\n".join([f"{'':16s} {'CPU [s]':>8s} {'wall [s]':>8s}", *lines])

    def _charge(self, following: str) -> None:
        now, before = (process_time(), perf_counter()), self.spent.get(self._part, (0.0, 0.0))
        cpu_s, wall_s = (b + n - s for b, n, s in zip(before, now, self._since, strict=True))
        self.spent[self._part] = cpu_s, wall_s
        self._part, self._since = following, now
