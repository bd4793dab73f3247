"""Progress bars of loops longer than a second, on terminals only."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import TypeVar

Item = TypeVar("Item")


def progress(items: Iterable[Item], description: str, unit: str = "frame", total: int | None = None) -> Iterable[Item]:
    """Return ``items`` with a progress bar on standard error; ``total`` is their number if they have no length."""
    if not sys.stderr.isatty():
        return items
    from multiprocessing import parent_process

    from tqdm import tqdm

    # Bars of workers would overwrite each other.
    hidden = parent_process() is not None
    return tqdm(items, desc=description, unit=unit, total=total, delay=1.0, leave=False, disable=hidden)
