"""Names on the command line, separated by blanks or commas: modes, variants, columns."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import Any

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


class Names(argparse.Action):
    """Take names separated by blanks or commas, all of them ``known`` ones if any are."""

    def __init__(self, option_strings: list[str], dest: str, known: Iterable[str] = (), **changes: Any) -> None:
        super().__init__(option_strings, dest, nargs="+", **changes)
        self.known = tuple(known)

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, *_: Any) -> None:
        """Store the names of an argument."""
        names = [name for value in values for name in value.replace(",", " ").split()]
        for name in names if self.known else ():
            if name not in self.known:
                known = ", ".join(map(repr, self.known))
                raise argparse.ArgumentError(self, f"invalid choice: {name!r} (choose from {known})")
        setattr(namespace, self.dest, names)


def declare_modes(parser: argparse.ArgumentParser, default: Iterable[str]) -> None:
    """Add the modes to run as ``--mode`` and ``--modes``."""
    default = list(default)
    words = f"one or several of {', '.join(MODES)} (default: {', '.join(default)})"
    parser.add_argument(*_MODE_FLAGS, dest="modes", type=modes_of, default=default, metavar="MODE", help=words)
