"""The modes of a command: ``--mode`` and ``--modes`` take one or several, separated by blanks or commas."""

from __future__ import annotations

import argparse
from collections.abc import Iterable

from ekfslam.config import MODES

_MODE_FLAGS = ("--mode", "--modes")


def modes_of(text: str) -> list[str]:
    """Return the modes in a text, separated by commas."""
    modes = [mode.strip() for mode in text.split(",")]
    if unknown := [mode for mode in modes if mode not in MODES]:
        raise argparse.ArgumentTypeError(f"unknown mode {unknown[0]!r}; known: {', '.join(MODES)}")
    return list(dict.fromkeys(modes))


def joined_modes(arguments: Iterable[str]) -> list[str]:
    """Return arguments with modes after ``--mode`` or ``--modes`` as one word, so that a recording may follow."""
    found: list[str] = []
    is_open = False
    for argument in arguments:
        is_mode = all(part.strip() in MODES for part in argument.split(","))
        if is_open and is_mode and found[-1] not in _MODE_FLAGS:
            found[-1] += f",{argument}"
        else:
            found.append(argument)
        is_open = argument in _MODE_FLAGS or (is_open and is_mode)
    return found


def declare_modes(parser: argparse.ArgumentParser, default: Iterable[str]) -> None:
    """Add the modes to run as ``--mode`` and ``--modes``."""
    default = list(default)
    words = f"one or several of {', '.join(MODES)} (default: {', '.join(default)})"
    parser.add_argument(*_MODE_FLAGS, dest="modes", type=modes_of, default=default, metavar="MODE", help=words)
