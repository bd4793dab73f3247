"""The view: the camera of a frame in world, with one error in place of those of all blocks that move it.

Observations of a frame depend on where its camera is and on nothing else of the body but the intrinsics. So the view
``W = T_cam_world`` has an error of six columns, ``W_true = exp(z^) W``, with ``z = Y x`` of the body at the prediction
(`ekfslam.models.observer.Camera`). It stays when pose and jitter move on, and landmarks count by their images in it,
eq. (7'). Kin: Roumeliotis and Burdick, "Stochastic cloning", ICRA 2002.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array
from ekfslam.geometry import se3
from ekfslam.models.blocks.base import StateBlock


class _ViewBlock(StateBlock):
    size = 6
    is_seen = True
    is_view = True
    retraction = "pose"

    def initial(self) -> Array:
        return np.eye(4)

    def retract(self, value: Array, correction: Array) -> Array:
        return se3.exp(correction) @ value


@dataclass(frozen=True)
class View(_ViewBlock):
    """The view of the present frame, set at its prediction."""

    name = "view"


@dataclass(frozen=True)
class PreviousView(_ViewBlock):
    """The view of the frame before: errors of tracks are differences over two frames, eq. (10)."""

    name = "previous_view"
    clones = "view"


@dataclass(frozen=True)
class Anchor(_ViewBlock):
    """The view from which tracks wait for parallax, see `ekfslam.filters.starting`."""

    name = "anchor"
