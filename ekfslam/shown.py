"""Show a record at a prompt or in a notebook in a few lines, in place of thousands of numbers."""

from __future__ import annotations

from html import escape
from typing import NamedTuple


class Card(NamedTuple):
    """A short view of a record."""

    title: str  # size of the record in a few words
    facts: dict[str, str]  # key figures by name
    further: tuple[str, ...] = ()  # useful Python calls on the record


class Shown:
    """A record with a short ``repr`` and a table for notebooks, both from `card`."""

    def card(self) -> Card:
        """Return the card that ``repr`` and a notebook show."""
        raise NotImplementedError

    def __repr__(self) -> str:
        title, facts, further = self.card()
        width = max(map(len, (*facts, "go on")))
        lines = [f"  {name:<{width}}  {text}" for name, text in facts.items()]
        lines += [f"  {'go on':<{width}}  {'  '.join(further)}"] if further else []
        return "\n".join([f"{type(self).__name__}: {title}", *lines])

    def _repr_html_(self) -> str:
        title, facts, further = self.card()
        cell = '<td style="text-align: left">'
        rows = "".join(f"<tr>{cell}{escape(name)}</td>{cell}{escape(text)}</td></tr>" for name, text in facts.items())
        code = " ".join(f"<code>{escape(call)}</code>" for call in further)
        head = f"<b>{type(self).__name__}</b>: {escape(title)}"
        return f"<div>{head}<table>{rows}</table>{f'go on: {code}' if code else ''}</div>"


def count(number: int, noun: str) -> str:
    """Return a number with its noun: ``1 landmark``, ``12 034 landmarks``."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}".replace(",", " ")


def figure(value: float) -> str:
    """Return a number with three digits."""
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
