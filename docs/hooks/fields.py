"""Give the comments of fields to the API pages, as entries ``Args`` of the docstring of their class."""

from __future__ import annotations

import re

import griffe


class FieldComments(griffe.Extension):
    """Append the comment behind or above each field to the docstring of a class that has no ``Args``."""

    def on_class_members(self, *, cls: griffe.Class, **_: object) -> None:
        if cls.docstring is None or "Args:" in cls.docstring.value or not cls.lines:
            return
        entries = []
        for name, member in cls.members.items():
            if member.is_attribute and member.lineno:
                comment = _comment(cls.lines, member.lineno - cls.lineno, name)
                entries += [f"    {comment}"] if comment else []
        if entries:
            cls.docstring.value += "\n\nArgs:\n" + "\n".join(entries)


def _comment(lines: list[str], row: int, name: str) -> str:
    """Return ``names: comment`` of the field in a row of a class; empty without a comment."""
    behind = re.search(r"  # (?!type:)(.*)$", lines[row])
    above = []
    while behind is None and row > 0 and (found := re.fullmatch(r"\s*# (.*)", lines[row - 1])):
        above.insert(0, found.group(1))
        row -= 1
    text = behind.group(1) if behind else " ".join(above)
    return text if not text or text.startswith((f"{name}, ", f"{name}: ")) else f"{name}: {text}"
