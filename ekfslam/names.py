"""Names that come from inside files or from paths: what of them may be shown, and what may become a path.

A leaf: it imports nothing of the package.
"""

from __future__ import annotations

from collections.abc import Iterable

_LONGEST = 100  # bytes of a path component, with room for endings
_UNSAFE = frozenset('/\\:*?"<>|')  # somewhere they part paths, or name what is no file


def printable(text: str, keep: str = "") -> str:
    """A text whose control characters, and bytes that are no UTF-8, are written out: ``\\x1b``.

    Args:
        text: Any.
        keep: Control characters that stay.
    """
    return "".join(
        c if c.isprintable() or c in keep else c.encode("unicode_escape", "backslashreplace").decode() for c in text
    )


def components(names: Iterable[str]) -> list[str]:
    """One path component each that leads nowhere else; no two are the same, whatever the names are."""
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
