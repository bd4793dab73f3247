"""The one way in which files are written, whatever they hold: as a whole or not at all.

The content is complete in memory before anything is touched. It goes to a file beside the target, to the disk (fsync),
and takes the place of the target by renaming. A full disk, a limit or a kill leaves the older file as it was.

A leaf: readers of data use it as well as archives do, so it imports nothing of the package but the errors.
"""

from __future__ import annotations

import fcntl
import itertools
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ekfslam.errors import WriteError

_PREFIX, _SUFFIX = ".ekfslam.", ".tmp"  # of unfinished files; the number of the process stands between
_counter = itertools.count()


def write(path: str | Path, content: str | bytes) -> None:
    """Write a file, in place of an older one.

    The permissions of an older file stay. A symbolic link stays, and what it names is written.

    Raises:
        WriteError: The target is a folder, a device or protected, its folder is missing, or the disk is full.
    """
    target = _target(path)
    data = content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content
    unfinished = target.with_name(f"{_PREFIX}{os.getpid()}.{next(_counter)}{_SUFFIX}")
    try:
        _sweep(target.parent)
        _write_to_disk(unfinished, data, target)
        unfinished.replace(target)
        _sync_folder(target.parent)
    except OSError as error:
        raise WriteError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)


def require_writable(path: str | Path) -> None:
    """Raise a `WriteError` where `write`, after making the folder, would fail for another reason than a full disk."""
    folder = _target(path).parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    if not folder.is_dir():
        raise WriteError(f"{path}: cannot be written: {folder} is no folder")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise WriteError(f"{path}: cannot be written: the folder {folder} is protected")


def make_folder(path: str | Path) -> Path:
    """Make a folder and those above it where they are missing.

    Raises:
        WriteError: It cannot be made, or is there and no folder.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WriteError(f"{path}: the folder cannot be made: {error.strerror or error}") from None
    return path


@contextmanager
def alone(path: str | Path) -> Iterator[None]:
    """Wait until nobody else who asks so works on files of the same folder, and keep it so meanwhile.

    Raises:
        WriteError: There is no such folder.
    """
    try:
        folder = os.open(_target(path).parent, os.O_RDONLY)
    except OSError as error:
        raise WriteError(f"{path}: {error.strerror or error}") from None
    try:
        with suppress(OSError):  # some file systems have no locks: then nobody waits
            fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def _target(path: str | Path) -> Path:
    """What is really written: the end of all symbolic links."""
    try:
        target = Path(path).resolve()
        mode = target.stat().st_mode if target.exists() else None
    except (OSError, RuntimeError, ValueError) as error:  # loops of links, names that are too long or hold NUL
        raise WriteError(f"{path}: cannot be written: {error}") from None
    if mode is not None and not stat.S_ISREG(mode):
        raise WriteError(f"{path}: cannot be written: it is {'a folder' if stat.S_ISDIR(mode) else 'no regular file'}")
    if mode is not None and not os.access(target, os.W_OK):
        raise WriteError(f"{path}: cannot be written: the file is protected")
    return target


def _write_to_disk(unfinished: Path, data: bytes, target: Path) -> None:
    """Write a new file with the permissions of the target, and wait until it is on the disk."""
    with unfinished.open("xb") as file:
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)  # says that its writer lives
        if target.exists():
            older = target.stat()
            with suppress(OSError):
                os.fchown(file.fileno(), older.st_uid, older.st_gid)
            os.fchmod(file.fileno(), older.st_mode & 0o777)
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    """Bring the renaming to the disk, where the file system can."""
    with suppress(OSError):
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def _sweep(folder: Path) -> None:
    """Remove what dead processes have left unfinished."""
    for scrap in folder.glob(f"{_PREFIX}*{_SUFFIX}"):
        number = scrap.name.removeprefix(_PREFIX).partition(".")[0]
        if not number.isdigit() or _is_alive(int(number)):
            continue
        with suppress(OSError), scrap.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # held: its writer lives on another machine
            scrap.unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True
