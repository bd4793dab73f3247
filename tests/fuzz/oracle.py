"""What must hold for every input: exit code 0 or 2, one line for an error, no NaN in what is printed, little time."""

from __future__ import annotations

import contextlib
import io
import os
import re
import shutil
import signal
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path

from generators import Case

from ekfslam.cli import main

SECONDS = 20  # of the processor; the machine may have others to serve
WAITING_SECONDS = 120


class Hang(BaseException):
    """An input took too long."""


@contextlib.contextmanager
def _limited() -> Iterator[None]:
    def ring(*_: object) -> None:
        raise Hang

    before = [signal.signal(number, ring) for number in (signal.SIGPROF, signal.SIGALRM)]
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.alarm(WAITING_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
        for number, handler in zip((signal.SIGPROF, signal.SIGALRM), before, strict=True):
            signal.signal(number, handler)


def verdict(case: Case, folder: Path) -> str:
    """What is wrong with how the command took the input; empty if nothing is.

    Args:
        case: The input.
        folder: Emptied, and worked in.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, content in case.files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    out, err = io.StringIO(), io.StringIO()
    here = Path.cwd()
    os.chdir(folder)
    try:
        with _limited(), warnings.catch_warnings(), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            warnings.simplefilter("ignore")
            if case.program is not None:
                return case.program()
            code = main(case.arguments)
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 1
    except Hang:
        return f"takes more than {SECONDS} s"
    except Exception:
        return traceback.format_exc()
    finally:
        os.chdir(here)
    printed, error = out.getvalue(), err.getvalue()
    if code not in (0, 2):
        return f"exit code {code}: {error}"
    if code == 2 and error.count("\n") != 1 and not error.startswith("usage:"):
        return f"no single line: {error!r}"
    if code == 2 and "damaged" in error and re.search(r"module|object has no|positional|unsupported operand", error):
        return f"an error of the program itself is blamed on the file: {error}"
    if case.arguments[0] == "sweep":  # a recording's name is the user's word
        printed = re.sub(r"\S*=\S*", "", printed)
    printed = re.sub(r"'[^'\n]*'", "", printed)  # so are quoted words
    if code == 0 and re.search(r"(?<![\w.])[-+]?nan\b", printed, re.IGNORECASE) and "--help" not in case.arguments:
        return f"NaN printed:\n{printed}"
    scraps = [path.name for path in folder.rglob(".ekfslam.*")]
    return f"left over: {scraps}" if scraps else ""
