"""Make names from files and paths safe to print and to use in paths."""

from __future__ import annotations

from collections.abc import Iterable

_LONGEST = 100  # bytes of a path component, with room for endings
_UNSAFE = frozenset('/\\:*?"<>|')  # some system separates paths by them, or gives them a meaning


def printable(text: str, keep: str = "") -> str:
    """Return a text with its control characters, except those to keep, and invalid UTF-8 written out: ``\\x1b``."""
    return "".join(
        c if c.isprintable() or c in keep else c.encode("unicode_escape", "backslashreplace").decode() for c in text
    )


def components(names: Iterable[str]) -> list[str]:
    """Return a distinct path component for each name, without separators and parent folders."""
    taken: set[str] = set()
    found = []
    for name in names:
        safe = "".join("_" if c in _UNSAFE else c for c in printable(name)).strip(". ")
        safe = safe.encode()[:_LONGEST].decode(errors="ignore") or "unnamed"
        distinct, number = safe, 1
        while distinct.casefold() in taken:
            number += 1
            distinct = f"{safe}-{number}"
        taken.add(distinct.casefold())
        found.append(distinct)
    return found


def without_common_ends(names: Iterable[str], between: str = "_") -> list[str]:
    """Return different names without the words at both ends that all of them have; a single one stays."""
    words = [name.split(between) for name in names]
    for end in (0, -1):
        while len(words) > 1 and min(map(len, words)) > 1 and len({name[end] for name in words}) == 1:
            words = [name[1:] if end == 0 else name[:-1] for name in words]
    return [between.join(name) for name in words]
