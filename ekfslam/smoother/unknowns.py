"""Unknowns of the smoother: which block of the model belongs to which group, and a state of all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ekfslam.arrays import Array, IntArray
from ekfslam.errors import PosteriorError
from ekfslam.geometry import se3
from ekfslam.models.blocks import StateBlock
from ekfslam.models.model import Model
from ekfslam.smoother.sparse.factors import FirstFrame


@dataclass(frozen=True)
class State:
    """A trajectory, a map, and the other blocks."""

    T_imu_world: Array  # (T, 4, 4) poses
    positions_m: Array  # (M, 3) landmarks in world
    # (w+a,) first frame in units of its prior: T_0 = exp((B zeta)^) T_prior, and its blocks by addition to their prior
    # means.
    zeta: Array
    shared: Array  # (T, w-6) values of the blocks of a frame that observations depend on, without its pose
    aux: Array  # (T, a) values of the further blocks of a frame
    drive: Array  # (g,) coordinates of the blocks of the drive: sums of corrections
    drive_values: Mapping[str, Array]  # values of the blocks of the drive, by name


class Unknowns:
    """Blocks of a model in the groups of `ekfslam.smoother.sparse.factors`.

    Covariance and ``mean`` (body,) are those before the first frame; that of the pose alone may be given.

    Attributes:
        shared, aux, of_drive: Blocks of ``frames`` (without the pose), of ``aux`` and of ``drive``.
        frame_columns, aux_columns, drive_columns: Their columns in the model's layout, the pose's included.
        width: Number of columns of a frame.
        shared_mean, aux_mean, drive_covariance: (w-6,), (a,) prior means in the first frame; (g, g) of the drive.
        B: (w+a, w+a) root of the first frame's covariance, see `FirstFrame`.
    """

    def __init__(self, model: Model, initial_covariance: Array, mean: Array) -> None:
        layout = model.layout
        self.shared: Sequence[StateBlock] = model.observer.shared
        self.aux = [block for block in layout.blocks if block.per_frame and not block.is_seen]
        self.of_drive = [block for block in layout.blocks if not (block.per_frame or block.is_view)]
        self.frame_columns = layout.columns(["pose", *(block.name for block in self.shared)])
        self.aux_columns = layout.columns(block.name for block in self.aux)
        self.drive_columns = layout.columns(block.name for block in self.of_drive)
        self.width = len(self.frame_columns)
        self.shared_mean, self.aux_mean = mean[self.frame_columns[6:]], mean[self.aux_columns]
        first = np.concatenate([self.frame_columns, self.aux_columns])
        covariance = model.prior_covariance.copy()
        known = len(initial_covariance)
        covariance[:known, :known] = initial_covariance
        self.B = root(covariance[np.ix_(first, first)], self.width)
        self.drive_covariance = covariance[np.ix_(self.drive_columns, self.drive_columns)]
        if covariance[np.ix_(first, self.drive_columns)].any():
            raise PosteriorError("the prior couples blocks of the drive with blocks of the first frame")

    def places(self, columns: IntArray) -> IntArray:
        """Return the places, in the columns of a frame and its further blocks, of some columns of the layout."""
        own = np.concatenate([self.frame_columns, self.aux_columns])
        order = np.argsort(own)
        return np.asarray(order[np.searchsorted(own[order], columns)])

    def first_frame(self, zeta: Array) -> FirstFrame:
        """Return the prior of the first frame, linearised at zeta (w+a,)."""
        B = self.B.copy()
        B[:6] = se3.left_jacobian(self.B[:6] @ zeta) @ B[:6]
        return FirstFrame(B, zeta, self.width)

    def drive_values(self, correction: Array, before: Mapping[str, Array] | None = None) -> dict[str, Array]:
        """Return the values of the drive's blocks after a correction (g,), by default of their initial values."""
        parts = split(self.of_drive, correction)
        start = before or {block.name: block.initial() for block in self.of_drive}
        return {block.name: block.retract(start[block.name], parts[block.name]) for block in self.of_drive}

    def values(self, state: State) -> dict[str, Array]:
        """Return the values of all blocks but the pose: of each frame (T, ...), or of the drive."""
        return {**state.drive_values, **split(self.shared, state.shared), **split(self.aux, state.aux)}

    def all_values(self, state: State) -> dict[str, Array]:
        """Return the values (T, ...) of all blocks in each frame."""
        frames = len(state.T_imu_world)
        of_drive = {name: np.broadcast_to(x, (frames, *x.shape)) for name, x in state.drive_values.items()}
        return {**self.values(state), **of_drive, "pose": state.T_imu_world}

    def last_values(self, state: State) -> dict[str, Array]:
        """Return the values of a filter's blocks but views at the last frame."""
        of_frames = split(self.shared, state.shared) | split(self.aux, state.aux)
        values = dict(state.drive_values) | {name: value[-1] for name, value in of_frames.items()}
        return {**values, "pose": state.T_imu_world[-1]}

    def last_coordinates(self, state: State) -> tuple[IntArray, Array]:
        """Return the columns (c,) of all blocks but pose and views, and their coordinates at the last frame."""
        columns = np.concatenate([self.aux_columns, self.drive_columns, self.frame_columns[6:]])
        return columns, np.concatenate([state.aux[-1], state.drive, state.shared[-1]])


def split(blocks: Sequence[StateBlock], array: Array) -> dict[str, Array]:
    """Return the parts (..., size) of an array (..., n) that belong to each of some blocks, by name."""
    ends = np.cumsum([block.size for block in blocks])[:-1]
    return dict(zip((block.name for block in blocks), np.split(array, ends, axis=-1), strict=True)) if blocks else {}


def root(covariance: Array, width: int) -> Array:
    """Return B with ``B B^T = covariance`` (n, n), which may be singular; its block [:width, width:] is 0."""
    std = np.sqrt(np.diag(covariance))
    scale = np.where(std > 0, std, 1.0)
    correlation = covariance / np.outer(scale, scale)
    high, low = slice(0, width), slice(width, None)
    B = np.zeros_like(correlation)
    B[high, high] = _symmetric_root(correlation[high, high])
    B[low, high] = correlation[low, high] @ np.linalg.pinv(B[high, high], rcond=1e-7)
    B[low, low] = _symmetric_root(correlation[low, low] - B[low, high] @ B[low, high].T)
    return scale[:, None] * B


def _symmetric_root(A: Array) -> Array:
    eigenvalues, vectors = np.linalg.eigh(A)
    return np.asarray((vectors * np.sqrt(np.maximum(eigenvalues, 0.0))) @ vectors.T)
