"""Progress bars: shown on a terminal for what lasts longer than a second, silent elsewhere."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Iterable
from typing import TypeVar

from tqdm import tqdm

Item = TypeVar("Item")


def progress(items: Iterable[Item], description: str, unit: str = "frame", total: int | None = None) -> Iterable[Item]:
    """``items``, with a progress bar on standard error; ``total`` says how many where they cannot tell."""
    hidden = (
        not sys.stderr.isatty() or multiprocessing.parent_process() is not None
    )  # workers would overwrite each other
    return tqdm(items, desc=description, unit=unit, total=total, delay=1.0, leave=False, disable=hidden)
