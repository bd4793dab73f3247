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
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from ekfslam.errors import WriteError

_PREFIX, _SUFFIX = ".ekfslam.", ".tmp"  # of unfinished files; the number of the process stands between
_counter = itertools.count()


def write(path: str | Path, content: str | bytes) -> None:
    """`write_all` of one file, into a folder that exists."""
    write_all({Path(path): content}, make_folders=False)


def write_all(contents: Mapping[Path, str | bytes], make_folders: bool = True) -> None:
    """Write files that belong together, in place of older ones: all are on the disk before the first takes its place.

    Permissions of older files stay. A symbolic link stays, and what it names is written.

    Args:
        contents: By path; text is encoded in UTF-8.
        make_folders: Make folders that are missing; they go again where the writing fails.

    Raises:
        WriteError: A target is a folder, a device or protected, its folder is missing, or the disk is full.
    """
    unfinished: dict[Path, Path] = {}
    made: list[Path] = []
    path = Path()
    try:
        for path, content in contents.items():
            target = _target(path)
            if make_folders:
                made += _make_folder(target.parent)
            _sweep(target.parent)
            beside = target.with_name(f"{_PREFIX}{os.getpid()}.{next(_counter)}{_SUFFIX}")
            unfinished[target] = beside
            data = content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content
            _write_to_disk(beside, data, target)
        for target, beside in unfinished.items():
            beside.replace(target)
        for folder in {target.parent for target in unfinished}:
            _sync_folder(folder)
    except OSError as error:
        raise WriteError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            for beside in unfinished.values():
                beside.unlink(missing_ok=True)
            for folder in reversed(made):
                folder.rmdir()  # only empty ones can be


def require_writable(path: str | Path) -> None:
    """Raise a `WriteError` where `write`, after making the folder, would fail for another reason than a full disk."""
    folder = _target(path).parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    if not folder.is_dir():
        raise WriteError(f"{path}: cannot be written: {folder} is no folder")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise WriteError(f"{path}: cannot be written: the folder {folder} is protected")


def is_free(path: str | Path) -> bool:
    """Whether nothing is lost by writing there: there is no file, or an empty one."""
    path = Path(path)
    return not path.exists() or (path.is_file() and path.stat().st_size == 0)


def _make_folder(folder: Path) -> list[Path]:
    """Make a folder and those above it where they are missing; those that were made, from the top."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()][::-1]
    for path in missing:
        path.mkdir(exist_ok=True)
    return missing


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
