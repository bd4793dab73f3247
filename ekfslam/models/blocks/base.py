"""The interface of a state block, and the layout of blocks in a covariance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.data.sequence import Sequence

# Estimates by name of their block; arrays may have leading dimensions (frames).
Values = Mapping[str, Array]

# A block is added to the measured velocities, turns them, moves the camera, changes the sensor, or none of these.
Coupling = Literal["none", "velocity", "level", "camera", "sensor"]
# The error of a block: a vector is added, a pose or a direction is premultiplied by exp, of a calibration only the free
# parameters move; a class that overrides `StateBlock.retract` has its own, unless it says otherwise.
Retraction = Literal["vector", "pose", "direction", "calibration", "own"]
_COUPLED_BY: dict[str, Coupling] = {"velocity_offset": "velocity", "turn_velocities": "level", "camera_share": "camera"}


class StateBlock:
    """A part of the state: by default a constant vector with an additive error, on which nothing else depends.

    Subclasses are frozen dataclasses that override the differences.

    Attributes:
        coupling: Role in the model; set by the method that a subclass overrides.
        retraction: Kind of its error.
        laws: Names of the laws by which the engine computes a method without Python, by method. A class that overrides
            the method has none for it, unless it says otherwise.
        name: Key of its value, and of its columns in the `Layout`.
        size: Number of columns of its error.
        per_frame: Whether it has a value for each frame, or one for the whole drive.
        is_seen: Whether observations of landmarks depend on it.
        is_curved: Whether its value is a vector but no sum of corrections, so that the log keeps it.
        is_pose: Whether it is the pose ``T_imu_world``.
        is_view: Whether it is a view ``T_cam_world``, whose error is a function of the errors of other blocks.
        clones: Name of the block whose previous value it is; "" if it is no clone.
        labels, units: Names and units of the estimates that `reported` returns.
    """

    coupling: ClassVar[Coupling] = "none"
    retraction: ClassVar[Retraction] = "vector"
    laws: ClassVar[Mapping[str, str]] = {}
    per_frame: ClassVar[bool] = False
    is_seen: ClassVar[bool] = False
    is_curved: ClassVar[bool] = False
    is_pose: ClassVar[bool] = False
    is_view: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        for method, coupling in _COUPLED_BY.items():
            if method in vars(cls):
                cls.coupling = coupling
        if "retract" in vars(cls) and "retraction" not in vars(cls):
            cls.retraction = "own"
        inherited: Mapping[str, str] = next(vars(base)["laws"] for base in cls.__mro__[1:] if "laws" in vars(base))
        kept = {method: law for method, law in inherited.items() if method not in vars(cls)}
        cls.laws = {**kept, **vars(cls).get("laws", {})}

    @classmethod
    def law(cls, method: str) -> str:
        """Return the law of a method: ``none`` if it is that of `StateBlock`, ``own`` if it is Python alone."""
        is_base = getattr(cls, method) is getattr(StateBlock, method, None)
        return "none" if is_base else cls.laws.get(method, "own")

    def as_data(self) -> dict[str, Any] | None:
        """Return what a prediction in C++ has to know of the block; None: it depends on Python."""
        laws = {method: self.law(method) for method in ("transition", "turn_velocities", "camera_share")}
        if "own" in laws.values() or (self.clones and not self.is_view):
            return None
        offset = self.velocity_offset()
        return {**laws, "offset": np.zeros((6, 0)) if offset is None else np.asarray(offset, dtype=float)}

    @property
    def name(self) -> str:
        raise NotImplementedError

    @property
    def clones(self) -> str:
        return ""

    @property
    def size(self) -> int:
        raise NotImplementedError

    @property
    def labels(self) -> tuple[str, ...]:
        return ()

    @property
    def units(self) -> tuple[str, ...]:
        return ()

    def initial(self) -> Array:
        """Return its value before the first frame."""
        return np.zeros(self.size)

    def begun_by(self, sequence: Sequence) -> StateBlock:
        """Return the block with the first value that a recording states, if it states one."""
        return self

    def prior_covariance(self) -> Array:
        """Return the covariance (size, size) of that value."""
        return np.zeros((self.size, self.size))

    def retract(self, value: Array, correction: Array) -> Array:
        """Return the value after a correction (..., size) of its error."""
        return value + correction

    def transition(self, tau_s: Array | float, way_m: Array | float) -> tuple[Array, Array] | None:
        """Return ``phi`` and the standard deviation of w (..., size) of the walk ``x+ = phi x + w``; None: constant.

        Intervals have durations ``tau_s`` (...) and ways driven ``way_m`` (...).
        """
        return None

    def velocity_offset(self) -> Array | None:
        """Return the derivative (6, size) of the measured velocities by a block that is added to them."""
        return None

    def turn_velocities(
        self, twist: Array, by: Array, values: Values, R_linear: Array, layout: Layout
    ) -> tuple[Array, Array]:
        """Return velocities (..., 6) and their derivative (..., 6, body), after this block has turned them.

        Values are estimates of all blocks, the pose the one before the interval; its error is linearised at the
        rotation R_linear (..., 3, 3).
        """
        return twist, by

    def camera_share(self, way_m: Array, is_difference: BoolArray) -> Array | None:
        """Return the share of the value (6,) that moves the camera: ``exp((share value)^) T_imu_world``.

        An observation (...) may be a difference from the frame before, eq. (10), ``way_m`` (...) ago.
        """
        return None

    @classmethod
    def automatic(cls, white_std: Array | None, is_clean: bool, has_checked_tracks: bool) -> dict[str, float] | None:
        """Return its settings in the automatic model of a recording; None: it is not part of that model.

        Args:
            white_std: (2,) white noise of linear (m/s) and angular velocities (rad/s); None: no velocities.
            is_clean: Whether these show no more noise than a good unit has.
            has_checked_tracks: Whether tracks are compared with their first sight, so that they do not drift.
        """
        return None

    def reported(self, values: Values, covariance: Array, layout: Layout) -> tuple[Array, Array]:
        """Return estimates and standard deviations (p,) by `labels`, given all blocks and their covariance."""
        at = layout[self.name]
        return values[self.name], np.sqrt(covariance.diagonal()[at])

    @property
    def reported_prior_std(self) -> Array:
        """(p,) standard deviations of what `labels` name, before the first frame."""
        return np.sqrt(np.diag(self.prior_covariance()))


class Layout(dict[str, slice]):
    """Columns of the blocks in a covariance: blocks that observations depend on come first; the pose must be the first.

    Attributes:
        body: Number of columns of all blocks.
        seen: Number of leading columns that observations of landmarks depend on.
        views: Names of the views.
        clones: Name of the clone of each block that has one in the frame before.
        curved: Blocks whose values are no sums of corrections.
    """

    def __init__(self, blocks: Iterable[StateBlock]) -> None:
        self.blocks = tuple(sorted(blocks, key=lambda block: not block.is_seen))
        end = np.cumsum([block.size for block in self.blocks]).tolist()
        super().__init__(
            (block.name, slice(stop - block.size, stop)) for block, stop in zip(self.blocks, end, strict=True)
        )
        self.body = end[-1]
        self.views = tuple(block.name for block in self.blocks if block.is_view)
        self.clones = {block.clones: block.name for block in self.blocks if block.clones}
        self.curved = tuple(block for block in self.blocks if block.is_curved)
        self.seen = sum(block.size for block in self.blocks if block.is_seen)

    def coupled(self, coupling: Coupling) -> tuple[StateBlock, ...]:
        """Return the blocks with a coupling, in the order of their columns."""
        return tuple(block for block in self.blocks if block.coupling == coupling)

    def block(self, name: str) -> StateBlock:
        """Return a block by name; raise a `KeyError` if it is not in the state."""
        return {block.name: block for block in self.blocks}[name]

    def columns(self, names: Iterable[str]) -> IntArray:
        """Return the columns of some blocks, in the order given."""
        parts = [np.arange(self[name].start, self[name].stop) for name in names]
        return np.concatenate([np.empty(0, dtype=np.int64), *parts])


OPTIONAL_BLOCKS: dict[str, type[StateBlock]] = {}
_Block = TypeVar("_Block", bound=type[StateBlock])


def optional_block(block: _Block) -> _Block:
    """Make a block available by name: the table ``[blocks.<name>]`` of a configuration puts it into the state."""
    OPTIONAL_BLOCKS[str(block.name)] = block
    return block
