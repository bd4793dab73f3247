"""Limits on the sizes that headers of files claim, checked before any content is allocated, decompressed or read."""

from __future__ import annotations

import stat
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from ekfslam.errors import ConfigError, EkfslamError, UnknownFormatError

DEFAULT_GB = 0.5  # more than twice the largest recording known; reading takes about three times as much
_TEXT_SHARE = 16  # memory of parsed numbers over that of their text
_MOST_DOTS = 100_000_000  # sum over lines of squares, as which the time of `tomllib` grows with dotted keys
_limit: ContextVar[int] = ContextVar("limit", default=int(DEFAULT_GB * 1e9))
_noted: ContextVar[set[Path] | None] = ContextVar("noted", default=None)


@contextmanager
def reading_up_to(gb: float) -> Iterator[None]:
    """Set the limit on the size of files within the context, in gigabytes of numbers."""
    if not 0 < gb <= 1e6:
        raise ConfigError(f"the limit of reading must be a positive number of gigabytes, found {gb}")
    token = _limit.set(int(gb * 1e9))
    try:
        yield
    finally:
        _limit.reset(token)


def limit_gb() -> float:
    """Return the limit in gigabytes, for `reading_up_to` in another process."""
    return _limit.get() / 1e9


class Budget:
    """The bytes that the file ``source`` may still claim; more raises an ``error``."""

    def __init__(self, source: str, error: type[EkfslamError] = UnknownFormatError) -> None:
        self.source, self.error, self.left = source, error, _limit.get()

    def take(self, size: int, what: str) -> None:
        """Take ``size`` bytes; raise an error if fewer are left."""
        self.left -= size
        if size < 0 or self.left < 0:
            raise self.error(
                f"{self.source}: {what} claims {size / 1e9:.3g} GB, more than the {_limit.get() / 1e9:.3g} GB that may "
                "be read of a file; --read-limit raises this"
            )


@contextmanager
def noting_files() -> Iterator[set[Path]]:
    """Yield a set to which `require_file` adds every file of the context, without symbolic links."""
    found: set[Path] = set()
    token = _noted.set(found)
    try:
        yield found
    finally:
        _noted.reset(token)


def toml_values(text: str) -> dict[str, Any]:
    """Return the values of a TOML file; `TOMLDecodeError` also for keys of thousands of parts."""
    if sum(line.count(".") ** 2 for line in text.splitlines()) > _MOST_DOTS:
        raise tomllib.TOMLDecodeError("a line has too many dots")
    return tomllib.loads(text)


def require_file(path: str | Path, is_text: bool = False) -> None:
    """Raise an `UnknownFormatError` unless this is a small enough regular file; a pipe would never end."""
    try:
        status = Path(path).stat()
    except (OSError, ValueError) as error:
        raise UnknownFormatError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
    if not stat.S_ISREG(status.st_mode):
        raise UnknownFormatError(
            f"{path}: cannot be read (it is {'a directory' if stat.S_ISDIR(status.st_mode) else 'no regular file'})"
        )
    Budget(str(path)).take(status.st_size * (_TEXT_SHARE if is_text else 1), "the text" if is_text else "the file")
    if (noted := _noted.get()) is not None:
        noted.add(Path(path).resolve())
