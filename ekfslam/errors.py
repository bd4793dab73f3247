"""Named errors. Every message names its place: file, field, and index, frame or landmark id.

The command line turns an `EkfslamError` into one line and exit code 2; any other exception is a bug.
"""

from __future__ import annotations

import math
from collections.abc import Iterable


def _listed(ids: tuple[int, ...]) -> str:
    """Return ids as `` [3, 5, ...]``, and nothing for none."""
    shown = ", ".join(map(str, ids[:8])) + (", ..." if len(ids) > 8 else "")
    return f" [{shown}]" if ids else ""


class EkfslamError(Exception):
    """Base of every error that a user's data, configuration or request can cause."""


class ConfigError(EkfslamError):
    """A configuration file or override names an unknown key or a value out of range."""


class MissingPackageError(EkfslamError):
    """An optional package is not installed; an extra of this project installs it."""

    def __init__(self, package: str, extra: str, what: str) -> None:
        super().__init__(f"{what} needs the package {package}, which is not installed: pip install 'ekfslam[{extra}]'")


class UnknownFormatError(EkfslamError):
    """A file is missing, unreadable, truncated, or of a format that no reader knows."""


class ArchiveError(EkfslamError):
    """A result archive is damaged, lacks a run or a field, or has a version that this release cannot read."""


class WriteError(ArchiveError):
    """A file cannot be written; an older one of its name is unchanged."""


class WorkerError(EkfslamError):
    """A process that worked for a study or a comparison has died; everything that was finished is kept."""


class DataError(EkfslamError):
    """A data set is malformed.

    Args:
        message: Problem in words.
        source: File or built-in world of the data.
        field: Name of the wrong field, as the file or `Sequence` spells it.
        index: Index of the first wrong entry of the field, if there is one.
    """

    def __init__(
        self, message: str, *, source: str = "", field: str = "", index: int | tuple[int, ...] | None = None
    ) -> None:
        self.message, self.source, self.field, self.index = message, source, field, index
        where = field
        if index is not None:
            where += f"[{', '.join(map(str, index)) if isinstance(index, tuple) else index}]"
        super().__init__(": ".join(part for part in (source, where, message) if part))


class ShapeError(DataError):
    """A field is missing, or its shape does not fit the others."""


class NonFiniteError(DataError):
    """A field holds NaN or infinity."""


class StampError(DataError):
    """Time stamps do not increase strictly."""


class CalibrationError(DataError):
    """The intrinsic matrix is singular or the stereo baseline is not positive."""


class ExtrinsicsError(DataError):
    """A transform's rotation part is not a rotation."""


class EmptyTracksError(DataError):
    """There are no observations, or a track has none."""


class DuplicateObservationError(DataError):
    """A landmark is observed twice in one frame."""


class TruthError(DataError):
    """Ground truth does not fit the sequence: another length, unknown frames, or poses that are not rigid."""


class FilterError(EkfslamError):
    """A filter cannot continue."""


class ScaleError(FilterError):
    """A recording of one camera has neither velocities nor inertial samples: nothing tells the scale."""


class NoVelocitiesError(FilterError):
    """Dead reckoning was requested for a recording without measured velocities."""


class NoInertialError(FilterError):
    """Velocity or biases were requested of a result without inertial samples."""


class InnovationError(FilterError):
    """The innovation covariance S of a frame is not positive definite.

    ``ids`` are the landmarks whose blocks of S are not; all observed ones if only the whole of S is not.
    """

    def __init__(self, frame: int, ids: Iterable[int]) -> None:
        self.frame, self.ids = frame, tuple(int(i) for i in ids)
        super().__init__(
            f"frame {frame}: innovation covariance is not positive definite for landmark ids{_listed(self.ids)}; "
            "check that the pixel noise is positive and the initial covariance positive semi-definite"
        )


class NonFiniteResultError(FilterError):
    """An estimate or a covariance has become NaN or infinite, first at an ``index`` such as the frame: no result."""

    def __init__(self, mode: str, what: str, index: int) -> None:
        self.mode, self.what, self.index = mode, what, index
        super().__init__(
            f"{mode}: {what}[{index}] is not finite; velocities, pixels or noise are out of the range of floats"
        )


class RetiredSettingWarning(UserWarning):
    """A configuration names a setting that no longer exists; it is ignored."""


class LateError(EkfslamError):
    """A message or a query (velocity, image, pose) has a stamp that the filter has passed: it is at ``least_s``."""

    def __init__(self, what: str, stamp_s: float, least_s: float | None) -> None:
        self.what, self.stamp_s, self.least_s = what, stamp_s, least_s
        known = "no image has been processed yet" if least_s is None else f"the filter is at {least_s:.6f} s"
        at = f"{what} at {stamp_s:.6f} s comes too late" if math.isfinite(stamp_s) else f"no {what}"
        super().__init__(f"{at}: {known}")


class ClockError(StampError):
    """A stamp is so far from all others that a clock must have jumped."""


class BacklogError(EkfslamError):
    """More messages wait in a live filter than it may keep."""


class MissingVelocityError(EkfslamError):
    """No velocity has arrived that reaches to a stamp."""

    def __init__(self, stamp_s: float) -> None:
        super().__init__(f"no velocity has arrived yet that reaches to {stamp_s:.6f} s")


class HonestyError(EkfslamError):
    """A result has no innovations to judge its covariance by."""


class PosteriorError(EkfslamError):
    """A posterior cannot be computed, or not for these frames or landmarks."""


class IllPosedError(PosteriorError):
    """The rows of a posterior leave something undetermined, of the landmarks or frames ``ids``."""

    def __init__(self, what: str, ids: Iterable[int]) -> None:
        self.ids = tuple(int(i) for i in ids)
        super().__init__(f"the posterior is ill-posed: {what}{_listed(self.ids)}")


class LineError(DataError):
    """A line of a text file has a wrong number of values, or a value that is no number or no stamp."""


class LostDataError(DataError):
    """A recording has lost more packets or stamps than can be repaired."""
