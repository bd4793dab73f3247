"""Clones of blocks that observations depend on and that change from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass

from ekfslam.arrays import Array
from ekfslam.models.blocks.base import StateBlock


@dataclass(frozen=True)
class Previous(StateBlock):
    """Value of another block, a vector, in the frame before: eq. (10) needs both."""

    block: StateBlock

    is_seen = True
    retraction = "vector"

    @property
    def name(self) -> str:
        return f"previous_{self.block.name}"

    @property
    def clones(self) -> str:
        return self.block.name

    @property
    def size(self) -> int:
        return self.block.size

    def retract(self, value: Array, correction: Array) -> Array:
        return self.block.retract(value, correction)
