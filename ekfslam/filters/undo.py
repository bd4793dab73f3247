"""Calls of a joint filter: one at a time, and one that fails leaves the filter as it was."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from functools import cache
from threading import Lock
from typing import Any

from threadpoolctl import LibController, ThreadpoolController

from ekfslam.errors import FilterError
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.lifecycle import Retired
from ekfslam.filters.logbook import LogBook


@cache
def _blas() -> list[LibController]:
    """Return the BLAS libraries in use; a look-up takes half a frame."""
    return list(ThreadpoolController().select(user_api="blas").lib_controllers)


class OneAtATime:
    """A lock that does not wait, and one thread of BLAS inside; a copy is a new one.

    For matrices this small a second thread costs several times what it saves, and far more on a busy machine.
    """

    def __init__(self) -> None:
        self._lock, self._lowered = Lock(), list[tuple[LibController, int]]()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            raise FilterError("the filter is in use by another thread")
        self._lowered = [(one, threads) for one in _blas() if (threads := one.get_num_threads()) != 1]
        for one, _ in self._lowered:
            one.set_num_threads(1)

    def __exit__(self, *_: object) -> None:
        for one, threads in self._lowered:
            one.set_num_threads(threads)
        self._lock.release()

    def __reduce__(self) -> tuple[type[OneAtATime], tuple[()]]:
        return OneAtATime, ()


@contextmanager
def all_or_nothing(
    e: Estimate, log: LogBook, retired: Retired, parts: Iterable[object | None], changes_engine: bool
) -> Iterator[None]:
    """Restore state, covariance, log, counts and further parts of a filter if an error is raised inside.

    ``changes_engine`` says that several calls of the engine follow; one alone changes all or nothing.
    """
    before, engine = dict(vars(e)), e.engine
    copies = {"values": dict(e.values), "coordinates": e.coordinates.copy()}
    if engine is None:
        copies |= {name: deepcopy(before[name]) for name in ("_table", "gaussian")}
    elif changes_engine:
        copies["engine"] = copies["gaussian"] = deepcopy(engine)
    states = [(vars(part), _kept(part)) for part in parts if part is not None]
    marks = log.mark(), retired.mark()
    try:
        yield
    except BaseException:
        vars(e).update(before | copies)
        if engine is not None:
            e.forget_table()
        for part, state in states:
            part.update(state)
        log.restore(marks[0])
        retired.restore(marks[1])
        raise


def _kept(part: object) -> dict[str, Any]:
    return {name: value.copy() if isinstance(value, list) else value for name, value in vars(part).items()}
