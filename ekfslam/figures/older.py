"""Figures of earlier runs, found and removed without Matplotlib, whose import takes longer than a short run."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

MADE_BY = "ekfslam"  # in every figure


def older_figures(directory: Path) -> list[Path]:
    """Return the figures in a folder that `ekfslam.figures.style.png` has made."""
    found: list[Path] = []
    pictures = sorted(directory.glob("*.png"))
    if not pictures:
        return found
    from PIL import Image

    for path in pictures:
        with suppress(OSError, ValueError, SyntaxError), Image.open(path) as picture:
            if picture.info.get("Software") == MADE_BY:
                found.append(path)
    return found


def remove_figures(older: Iterable[Path], new: Iterable[Path]) -> None:
    """Remove older figures that no new ones replace, and with ``check.png`` its verdict."""
    for path in set(older) - set(new):
        for suffix in (".png", ".md", ".json") if path.name == "check.png" else (".png",):
            path.with_suffix(suffix).unlink(missing_ok=True)
