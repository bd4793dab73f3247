"""Command line: every subcommand is a thin call of the function of the same name in Python.

Each file of `ekfslam.cli.commands` is a subcommand. The first line of its docstring is its summary, ``EXAMPLES`` are
calls of it, ``add_arguments(parser)`` declares its arguments, ``command(options)`` runs it. ``claims(options)`` is a
context that claims the files which it reads and writes. Only the called one is imported, so help and mistyped names
answer at once.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import importlib
import os
import pkgutil
import re
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from collections.abc import Sequence as SequenceType
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, NoReturn

from ekfslam import __version__
from ekfslam.cli import commands
from ekfslam.errors import EkfslamError, RetiredSettingWarning
from ekfslam.limits import DEFAULT_GB, reading_up_to
from ekfslam.names import printable


def main(arguments: SequenceType[str] | None = None) -> int:
    """Run ``ekfslam`` and return the exit code: 0, 130 after Ctrl-C, or 2 after one line for a user's error."""
    try:
        with _one_interrupt(is_last=arguments is None):
            return _run(sys.argv[1:] if arguments is None else list(arguments))
    except KeyboardInterrupt:
        print("ekfslam: interrupted", file=sys.stderr)
        return 130


@contextmanager
def _one_interrupt(is_last: bool) -> Iterator[None]:
    """Let the first Ctrl-C end a command, and no further one disturb that, nor the end of a process (``is_last``)."""
    is_ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    is_ours &= threading.current_thread() is threading.main_thread()

    def end(*_: object) -> NoReturn:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        raise KeyboardInterrupt

    if is_ours:
        signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        if is_ours and not is_last:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def _run(given: list[str]) -> int:
    if {"--mode", "--modes"} & {*given}:
        from ekfslam.cli.modes import joined_modes

        given = joined_modes(given)
    options, unknown = _parser(given[:1]).parse_known_args(given)
    if unknown:
        options.refuse(f"unrecognized arguments: {' '.join(unknown)}")
    _prepare_output()
    try:
        with reading_up_to(options.read_limit), _notes_on_one_line(), options.claims(options):
            options.command(options)
        sys.stdout.flush()
    except BrokenPipeError:
        _forget_output()  # the reader of our output (head, less) has gone, which is no error
    except (EkfslamError, OSError, MemoryError) as error:
        _forget_output()
        message = printable(" ".join(str(error).split())) or "there is not enough memory"
        print(f"ekfslam: error: {message}", file=sys.stderr)
        return 2
    return 0


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, with the nearest name that is known and the call that shows all."""

    def error(self, message: str) -> NoReturn:
        wrong = re.search(r"(?:invalid choice: |unknown mode |unrecognized arguments: )'?([\w-]+)", message)
        known = re.findall(r"[\w-]+", message.partition("choose from" if "choose from" in message else "known:")[2])
        near = (
            difflib.get_close_matches(wrong[1], known or re.findall(r"--[\w-]+", self.format_usage()), 1)
            if wrong
            else []
        )
        meant = f"; did you mean {near[0]}?" if near else ""
        self.exit(2, f"{self.prog}: error: {message}{meant} ({self.prog} --help shows all)\n")


def _parser(called: SequenceType[str]) -> argparse.ArgumentParser:
    """Return the parser of all subcommands; only the called one knows its arguments."""
    parser = _Parser(
        prog="ekfslam",
        description="Visual-inertial EKF-SLAM: dead reckoning, independent landmark mapping, and full joint SLAM.",
        epilog="DATA is a recording (ECE 276A .npz, UTIAS .mat, ekfslam .h5) or a simulated world: "
        "builtin:city, builtin:loop, builtin:city?seed=3.",
    )
    parser.add_argument("--version", action="version", version=f"ekfslam {__version__}")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    for module in pkgutil.iter_modules(commands.__path__):
        doc = ast.get_docstring(ast.parse((Path(commands.__path__[0]) / f"{module.name}.py").read_bytes())) or ""
        summary = doc.partition("\n")[0]
        sub = subparsers.add_parser(
            module.name,
            help=summary[0].lower() + summary[1:].rstrip("."),
            description=summary,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if module.name in called:
            _declare(sub, module.name)
    return parser


def _declare(parser: argparse.ArgumentParser, name: str) -> None:
    module = importlib.import_module(f"{commands.__name__}.{name}")
    claims = getattr(module, "claims", nullcontext)
    parser.set_defaults(command=module.command, claims=claims, refuse=parser.error)
    parser.epilog = "examples:\n" + "\n".join(f"  ekfslam {example}" for example in module.EXAMPLES)
    parser.add_argument(
        "--read-limit",
        type=float,
        default=DEFAULT_GB,
        metavar="GB",
        help="most gigabytes of numbers in a file; more is refused unread (default: %(default)s)",
    )
    module.add_arguments(parser)


@contextmanager
def _notes_on_one_line() -> Iterator[None]:
    """Print a `RetiredSettingWarning` without the line of code that raised it."""

    def show(message: Warning | str, category: type[Warning], *place: Any, **options: Any) -> None:
        if issubclass(category, RetiredSettingWarning):
            print(f"ekfslam: note: {message}", file=sys.stderr)
        else:
            default(message, category, *place, **options)

    with warnings.catch_warnings():
        default, warnings.showwarning = warnings.showwarning, show
        yield


def _prepare_output() -> None:
    """Let printing work without an output, and if its encoding lacks a character of a name."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the caller
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 (open until the exit)
        reconfigure = getattr(getattr(sys, name), "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="backslashreplace")


def _forget_output() -> None:
    """Keep the exit from flushing into an output that is full or gone."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
