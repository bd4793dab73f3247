"""The messages of a live filter: which ones it accepts, and the books about the others."""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Literal, NamedTuple

import numpy as np

from ekfslam.errors import BacklogError, ClockError, EkfslamError, LateError, StampError

JUMPED = 10  # messages of a kind in a row, close to each other, after which a clock has jumped
LISTED = 1000  # dropped messages
Kind = Literal["velocity", "sample", "image"]
Reason = Literal["late", "repeated", "jump", "backlog", "before the first sample", "failed", "reset"]
PLURAL: dict[Kind, str] = {"velocity": "velocities", "sample": "samples", "image": "images"}


class Dropped(NamedTuple):
    """A message that the filter did not use."""

    kind: Kind
    time_s: float
    reason: Reason


@dataclasses.dataclass
class LiveCounts:
    """Counts of all messages: none is dropped without being counted."""

    velocities: int = 0  # velocities, samples, images: messages in time
    images: int = 0
    taken_in: int = 0  # images that the filter has processed
    # late_velocities, late_samples, late_images: Rejected messages, older than the last processed image.
    late_velocities: int = 0
    late_images: int = 0
    out_of_order: int = 0  # messages in time that came after a later one of their kind
    held: int = 0  # images processed with extrapolated inputs, since none had arrived in time
    gaps: int = 0  # images after inputs more than gap_s apart
    samples: int = 0
    late_samples: int = 0
    repeated: int = 0  # rejected messages with the stamp of another one of their kind
    jumps: int = 0  # rejected messages whose stamps were more than jump_s off
    refused: int = 0  # rejected messages, because too many waited
    # Images older than all samples, inputs older than all images, and messages dropped by `LiveEKF.reset`.
    unused: int = 0
    failed: int = 0  # images that the filter could not process; the prediction to their stamp remains
    resets: int = 0  # calls of `LiveEKF.reset`, and new beginnings after a clock had jumped before the first image
    log_drops: int = 0  # times that the log was dropped


class Admission:
    """Judge of messages by their stamps: ``raise`` an error at one that cannot be used, or ``count`` it.

    ``jump_s`` is the time by which a stamp may be after the newest one. `counts` and `dropped` are those of `LiveEKF`,
    `newest` holds the newest stamp of each kind.
    """

    def __init__(self, late: Literal["raise", "count"], jump_s: float) -> None:
        self.late, self.jump_s = late, jump_s
        self.counts = LiveCounts()
        self.dropped: deque[Dropped] = deque(maxlen=LISTED)
        self.start()

    def start(self) -> None:
        """Forget all stamps; counts go on."""
        self.newest: dict[Kind, float] = dict.fromkeys(PLURAL, -np.inf)
        self._strange: dict[Kind, tuple[int, float]] = {}  # rejected stamps in a row, and the last, by kind

    @property
    def newest_s(self) -> float:
        """The newest stamp of all messages; minus infinity before the first."""
        return max(self.newest.values())

    def has_jumped(self, kind: Kind, t: float, time_s: float | None) -> bool:
        """Return whether a message stamped t is one of many in a row whose stamps agree, far from all others."""
        newest = self.newest_s
        # An older stamp is just out of order unless the filter is past it, or has not begun.
        is_behind = t < newest - self.jump_s and (time_s is None or t <= time_s)
        if not (is_behind or self._is_ahead(t)):
            self._strange.pop(kind, None)
            return False
        count, last = self._strange.get(kind, (0, t))
        self._strange[kind] = count + 1 if abs(t - last) <= self.jump_s else 1, t
        return self._strange[kind][0] >= JUMPED

    def _is_ahead(self, t: float) -> bool:
        return np.isfinite(self.newest_s) and t > self.newest_s + self.jump_s

    def accepts(self, kind: Kind, t: float, time_s: float | None, is_repeated: bool, is_full: bool) -> bool:
        """Return whether a message of a kind, stamped t, can be used; count it, and list it or raise if not.

        Args:
            time_s: Stamp up to which the filter has used messages of its kind; None before the first image.
            is_repeated: Whether another message has its kind and stamp.
            is_full: Whether no more messages of its kind may wait.
        """
        newest = self.newest_s
        reason: Reason = "late"
        error: EkfslamError | None = None
        if self._is_ahead(t) or (time_s is None and t < newest - self.jump_s):
            reason, side = "jump", "after" if t > newest else "before"
            text = f"{kind} at {t:.6f} s is {abs(t - newest):.3g} s {side} the newest message"
            error = ClockError(text, field="t")
        elif is_repeated:
            reason, error = "repeated", StampError(f"there are two {PLURAL[kind]} at {t:.6f} s", field="t")
        elif time_s is not None and t <= time_s:
            error = LateError(kind, t, time_s)
        elif is_full:
            text = f"{kind} at {t:.6f} s: too many {PLURAL[kind]} wait; reset() drops them"
            reason, error = "backlog", BacklogError(text)
        if error is not None:
            self.refuse(kind, t, reason, error)
            return False
        setattr(self.counts, PLURAL[kind], getattr(self.counts, PLURAL[kind]) + 1)
        self.counts.out_of_order += t < self.newest[kind]
        self.newest[kind] = max(self.newest[kind], t)
        return True

    def refuse(self, kind: Kind, t: float, reason: Reason, error: EkfslamError) -> None:
        """Count and list a message that is not used, and raise unless such messages are only counted."""
        names = {"late": f"late_{PLURAL[kind]}", "repeated": "repeated", "jump": "jumps", "backlog": "refused"}
        setattr(self.counts, names[reason], getattr(self.counts, names[reason]) + 1)
        self.dropped.append(Dropped(kind, t, reason))
        if self.late == "raise":
            raise error
