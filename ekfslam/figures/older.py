"""Pictures and pages of archives: marks that name the archives shown, without Matplotlib, whose import takes long.

A mark is a piece of the file that programs skip: a chunk of PNG, a comment of SVG, PDF and HTML, a free box of MP4,
the rest of a GIF. It holds paths relative to the folder of the file, so that a folder of results may be moved.
"""

from __future__ import annotations

import os
import re
import stat
import struct
import zlib
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from urllib.parse import quote, unquote_to_bytes

from ekfslam.errors import WriteError

MADE_BY = "ekfslam"  # in every figure
FIGURES = "*.png"  # the name by which commands claim all figures of a folder
WAY = "--out chooses another place"
WAYS = f"{WAY}, --force replaces it"
_PICTURES = (".png", ".svg", ".pdf")
_KEPT = ("report.html", "drive.gif", "drive.mp4")  # files under other names are records of the user
_END = 1 << 18  # bytes at the end of a file that hold its mark
_MARK, _NAMES = b"ekfslam_shows:", re.compile(rb"([A-Za-z0-9_.~%/:,]*);")


def marked(contents: Mapping[Path, str | bytes], archives: Iterable[Path]) -> dict[Path, str | bytes]:
    """Return contents of files by path; pictures and pages among them name the archives that they show."""
    archives, found = tuple(archives), dict(contents)
    if not archives:
        return found
    for path, content in contents.items():
        data = content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content
        names = ",".join(quote(os.fsencode(_seen_from(path, archive))).replace("-", "%2D") for archive in archives)
        found[path] = _with_mark(data, path.suffix, f"ekfslam_shows:{names};".encode())
    return found


def _real(path: Path) -> Path:
    """Return a path without links; `Path.resolve` raises errors for loops of links. What no path can be stays."""
    try:
        return Path(os.path.realpath(path))
    except ValueError:
        return path


def _seen_from(path: Path, archive: Path) -> str:
    """Return the path of an archive relative to the folder of a file."""
    target, folder = _real(archive), _real(path.parent)
    try:
        return os.path.relpath(target, folder)
    except ValueError:  # on another drive of Windows
        return str(target)


def _with_mark(data: bytes, suffix: str, mark: bytes) -> bytes:
    if suffix == ".png":
        chunk = b"tEXtSource\0" + mark
        return (
            data[:-12] + struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[-12:]
        )
    if suffix == ".mp4":
        return data + struct.pack(">I", len(mark) + 8) + b"free" + mark
    if suffix == ".pdf":
        return data + b"%" + mark + b"\n"
    if suffix == ".gif":
        return data + mark  # after its last block
    return data + b"<!-- " + mark + b" -->\n" if suffix in (".svg", ".html") else data


def archives_in(path: Path) -> set[Path]:
    """Return the archives that a picture or page names, none if it is missing or has no mark."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # a pipe would never end
            return set()
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - _END))
            data = file.read()
    except OSError:
        return set()
    _, is_marked, rest = data.rpartition(_MARK)
    mark = _NAMES.match(rest) if is_marked else None
    names = [os.fsdecode(unquote_to_bytes(name)) for name in mark[1].split(b",")] if mark else []
    return {path.parent / name for name in names if "\0" not in name}


def require_own(paths: Iterable[Path], archives: Iterable[Path], ways: str = WAYS) -> None:
    """Raise a `WriteError` if a picture or page shows an archive that is still there and not among some."""
    own = {_real(archive) for archive in archives}
    for path in paths:
        # Not `Path.is_file`, which raises errors for names that are too long.
        there = [archive for archive in archives_in(path) if os.path.isfile(archive)]  # noqa: PTH113
        others = [archive for archive in there if _real(archive) not in own]
        if others:
            raise WriteError(f"{path}: shows {min(others)}, another archive; {ways}")


def pictures_of(archives: Iterable[Path], folder: Path) -> list[Path]:
    """Return the pictures in a folder that show these archives and no other."""
    own = {_real(archive) for archive in archives}
    places = [path for suffix in _PICTURES for path in folder.glob(f"*{suffix}")]
    return [path for path in sorted(places) if own and {_real(other) for other in archives_in(path)} == own]


def older_figures(archive: Path) -> list[Path]:
    """Return the pictures and the page in the folder of an archive that show it alone.

    Figures of older releases have no marks. They are among them if the folder has no other archive.
    """
    folder, own = archive.parent, {_real(archive)}
    found = pictures_of(own, folder)
    kept = [folder / name for name in _KEPT]
    found += [path for path in kept if {_real(other) for other in archives_in(path)} == own]
    if archive.exists() and all(path == archive for path in folder.glob("*.h5")):
        files = (path for path in folder.glob("*.png") if path.is_file())
        found += [path for path in files if not archives_in(path) and _is_figure(path)]
    return found


def _is_figure(path: Path) -> bool:
    """Return whether `ekfslam.figures.style.png` has made a picture."""
    from PIL import Image

    with suppress(OSError, ValueError, SyntaxError), Image.open(path) as picture:
        return picture.info.get("Software") == MADE_BY
    return False


def remove_figures(older: Iterable[Path], new: Iterable[Path]) -> None:
    """Remove older figures that no new ones replace, and with ``check.png`` its verdict."""
    for path in set(older) - set(new):
        path.unlink(missing_ok=True)
        if path.name == "check.png":
            for suffix in (".md", ".json"):
                path.with_suffix(suffix).unlink(missing_ok=True)
