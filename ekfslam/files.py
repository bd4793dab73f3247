"""Atomic writing: a file is written as a whole or not at all.

The complete content goes to a file next to the target, to the disk (fsync), and replaces the target by renaming. A full
disk, a limit or a kill leaves the older file unchanged. Windows has no such locks: callers neither wait for each other
nor are told of each other there, and unfinished files of killed processes stay.
"""

from __future__ import annotations

import hashlib
import itertools
import os
import stat
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from ekfslam.errors import WriteError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_PREFIX, _SUFFIX = ".ekfslam.", ".tmp"  # names of unfinished files, with the number of the process between
_LOCK = ".lock"  # ending of the locks of claims
_counter = itertools.count()
_claims: set[tuple[Path, int]] = set()  # files claimed by this process, and the threads


def write(path: str | Path, content: str | bytes) -> None:
    """Write one file into a folder that exists, see `write_all`."""
    write_all({Path(path): content}, make_folders=False)


def write_all(contents: Mapping[Path, str | bytes], make_folders: bool = True) -> None:
    """Write files that belong together: all are on the disk before the first one replaces an older file.

    Older files keep their permissions. A symbolic link stays, and its target is written. Missing folders are made if
    asked for, and removed again if writing fails. Raise a `WriteError` if a target cannot be written.
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
            scratch = target.with_name(f"{_PREFIX}{os.getpid()}.{next(_counter)}{_SUFFIX}")
            unfinished[target] = scratch
            data = content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content
            _write_to_disk(scratch, data, target)
        for target, scratch in unfinished.items():
            scratch.replace(target)
        for folder in {target.parent for target in unfinished}:
            _sync_folder(folder)
    except OSError as error:
        raise WriteError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            for scratch in unfinished.values():
                scratch.unlink(missing_ok=True)
            for folder in reversed(made):
                folder.rmdir()  # only empty ones can be


def require_writable(path: str | Path) -> None:
    """Raise a `WriteError` if `write_all` would fail even on an empty disk."""
    folder = _target(path).parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    if not folder.is_dir():
        raise WriteError(f"{path}: cannot be written: {folder} is no folder")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise WriteError(f"{path}: cannot be written: the folder {folder} is protected")


def is_free(path: str | Path) -> bool:
    """Return whether there is no file at a path, or an empty one."""
    path = Path(path)
    return not path.exists() or (path.is_file() and path.stat().st_size == 0)


def _make_folder(folder: Path) -> list[Path]:
    """Make a folder and its missing parents; return those that were made, the outermost first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()][::-1]
    for path in missing:
        path.mkdir(exist_ok=True)
    return missing


@contextmanager
def alone(path: str | Path) -> Iterator[None]:
    """Lock the folder of a path, so that callers change files in it in turn; `WriteError` if there is none."""
    parent = _target(path).parent
    if fcntl is None and parent.is_dir():
        yield
        return
    try:
        folder = os.open(parent, os.O_RDONLY)
    except OSError as error:
        raise WriteError(f"{path}: cannot be written: {error.strerror or error}") from None
    try:
        with suppress(OSError):  # some file systems have no locks: then no caller waits
            fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


@contextmanager
def held(path: str | Path) -> Iterator[None]:
    """Lock a file itself for one writer, from reading to the end of writing. An empty file is removed at the end.

    Raises:
        WriteError: Another process or thread holds it, or it cannot be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = _locked(path)
    except BlockingIOError:
        raise WriteError(f"{path}: another run is writing there; wait for its end, or choose another folder") from None
    except OSError as error:
        raise WriteError(f"{path}: cannot be written: {error.strerror or error}") from None
    try:
        yield
    finally:
        with suppress(OSError):
            if path.stat().st_size == 0 and os.path.samestat(path.stat(), os.fstat(file)):  # not that of a successor
                path.unlink()
        os.close(file)


@contextmanager
def claimed(*writes: str | Path | None, reads: Iterable[str | Path] = ()) -> Iterator[None]:
    """Claim files until the end of a command: those it writes for it alone, those it reads against writers.

    A claim is a lock of a hidden file beside the target. It ends with its process, however that ends. Claims of one
    thread nest. A file that is missing, or whose folder is protected, is read without a claim.

    Raises:
        WriteError: Another process or thread uses a file, or its folder cannot be written.
    """
    wanted: dict[Path, tuple[str | Path, bool]] = {_target(path): (path, False) for path in writes if path is not None}
    for path in reads:
        with suppress(OSError, ValueError, RuntimeError):  # loops of links: the reader names them
            if (target := Path(path).resolve()).is_file():
                wanted.setdefault(target, (path, True))
    with ExitStack() as stack:
        for target, (path, is_read) in sorted(wanted.items()):
            if fcntl is not None and (target, threading.get_ident()) not in _claims:
                _claim(stack, target, path, is_read)
        yield


def _claim(stack: ExitStack, target: Path, path: str | Path, is_read: bool) -> None:
    """Claim one file until the end of a stack."""
    lock = target.with_name(f"{_PREFIX}{_short(target.name)}{_LOCK}")
    try:
        for folder in _make_folder(target.parent):
            stack.callback(_remove_folder, folder)
        file = _locked(lock, is_read)
    except BlockingIOError:
        raise WriteError(
            f"{path}: another command is writing or reading it; wait for its end, or choose another output"
        ) from None
    except OSError as error:
        if is_read:
            return
        raise WriteError(f"{path}: cannot be written: {error.strerror or error}") from None
    _claims.add((target, threading.get_ident()))
    stack.callback(_release, lock, target, file)


def _release(lock: Path, target: Path, file: int) -> None:
    """End a claim, and remove its lock file unless others hold it."""
    _claims.discard((target, threading.get_ident()))
    with suppress(OSError):
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        lock.unlink()
    os.close(file)


def _remove_folder(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()  # only empty ones can be


def _short(name: str) -> str:
    """Return a name, or a digest of one that leaves no room for an ending."""
    name_bytes = os.fsencode(name)
    return name if len(name_bytes) < 200 else hashlib.sha256(name_bytes).hexdigest()


def _locked(path: Path, is_shared: bool = False) -> int:
    """Open and lock a file; `BlockingIOError` if somebody else has."""
    how = 0 if fcntl is None else (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB
    while True:
        try:
            file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except PermissionError:
            if not path.exists():
                raise
            file = os.open(path, os.O_RDONLY)  # left by another user; may be locked all the same
        try:
            if fcntl is not None:
                fcntl.flock(file, how)
            if fcntl is None or os.path.samestat(os.fstat(file), path.stat()):
                return file
        except FileNotFoundError:
            pass  # its owner has removed it in between: a new one is free
        except OSError as error:
            if isinstance(error, BlockingIOError):
                os.close(file)
                raise
            return file  # a file system without locks: no caller is told
        os.close(file)


def _target(path: str | Path) -> Path:
    """Return the file at the end of all symbolic links."""
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
        if fcntl is not None:
            with suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX)  # tells `_sweep` that the writer is alive
        if fcntl is not None and target.exists():
            older = target.stat()
            with suppress(OSError):
                os.fchown(file.fileno(), older.st_uid, older.st_gid)
            os.fchmod(file.fileno(), older.st_mode & 0o777)
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    """Flush a renaming to the disk, if the file system can."""
    with suppress(OSError):
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def _sweep(folder: Path) -> None:
    """Remove unfinished files and locks of dead processes."""
    if fcntl is None:  # os.kill(process, 0) would interrupt the process there
        return
    for scrap in folder.glob(f"{_PREFIX}*"):
        number = scrap.name.removeprefix(_PREFIX).partition(".")[0]
        is_dead = scrap.suffix == _SUFFIX and number.isdigit() and not _is_alive(int(number))
        if not is_dead and scrap.suffix != _LOCK:
            continue
        with suppress(OSError), scrap.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # held: its writer lives, perhaps on another machine
            if os.path.samestat(os.fstat(file.fileno()), scrap.stat()):
                scrap.unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True
