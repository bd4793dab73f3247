"""Results of functions of a record that never changes, kept with it."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import cached_property
from typing import Any, TypeVar

Found = TypeVar("Found")


class Once:
    """A record that keeps what functions find in it."""

    def once(self, find: Callable[..., Found], *arguments: object) -> Found:
        """Return ``find(self, *arguments)``, which the first call computes: modes of a run share what they find."""
        key = find, pickle.dumps(arguments)
        if key not in self._found:
            self._found[key] = find(self, *arguments)
        return self._found[key]

    @cached_property
    def _found(self) -> dict[object, Any]:
        return {}
