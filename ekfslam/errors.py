"""Named errors. Every message says where: the file, the field, and the index, frame or landmark id.

`EkfslamError` is what the command line turns into one line and exit code 2; anything else is a bug.
"""

from __future__ import annotations

from collections.abc import Iterable


def _listed(ids: tuple[int, ...]) -> str:
    """`` [3, 5, ...]``, or nothing for none."""
    shown = ", ".join(map(str, ids[:8])) + (", ..." if len(ids) > 8 else "")
    return f" [{shown}]" if ids else ""


class EkfslamError(Exception):
    """Base of every error that a user's data, configuration or request can cause."""


class ConfigError(EkfslamError):
    """A configuration file or override names an unknown key or a value out of range."""


class MissingPackageError(EkfslamError):
    """An optional package is not installed.

    Args:
        package: Its name.
        extra: The extra of this project that installs it.
        what: What needs it.
    """

    def __init__(self, package: str, extra: str, what: str) -> None:
        super().__init__(f"{what} needs the package {package}, which is not installed: pip install 'ekfslam[{extra}]'")


class UnknownFormatError(EkfslamError):
    """A file is missing, unreadable, truncated, or of a format that no reader knows."""


class ArchiveError(EkfslamError):
    """A result archive lacks what was asked of it, or has a format version this release cannot read."""


class WriteError(ArchiveError):
    """A file cannot be written; an older one of its name is as it was."""


class DataError(EkfslamError):
    """A data set is malformed.

    Args:
        message: What is wrong.
        source: File (or built-in world) the data came from.
        field: Name of the offending field, as the file or `Sequence` spells it.
        index: Position of the first offending entry within the field, if there is one.
    """

    def __init__(
        self,
        message: str,
        *,
        source: str = "",
        field: str = "",
        index: int | tuple[int, ...] | None = None,
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
    """A filter cannot go on."""


class NoVelocitiesError(FilterError):
    """Dead reckoning was requested for a recording without measured velocities."""


class InnovationError(FilterError):
    """The innovation covariance S is not positive definite.

    Args:
        frame: Frame at which the update failed.
        ids: Landmark ids whose blocks of S are not positive definite (all observed ones if only the whole is not).
    """

    def __init__(self, frame: int, ids: Iterable[int]) -> None:
        self.frame, self.ids = frame, tuple(int(i) for i in ids)
        super().__init__(
            f"frame {frame}: innovation covariance is not positive definite for landmark ids{_listed(self.ids)}; "
            "check that the pixel noise is positive and the initial covariance positive semi-definite"
        )


class NonFiniteResultError(FilterError):
    """An estimate or a covariance has become NaN or infinite: there is no result.

    Args:
        mode: Of the run.
        what: Name of the quantity.
        index: Of its first entry that is no number, such as the frame.
    """

    def __init__(self, mode: str, what: str, index: int) -> None:
        self.mode, self.what, self.index = mode, what, index
        super().__init__(
            f"{mode}: {what}[{index}] is not finite; velocities, pixels or noise are beyond what numbers can hold"
        )


class RetiredSettingWarning(UserWarning):
    """A configuration names a setting that no longer exists; it is ignored."""


class LateError(EkfslamError):
    """A message, or a question, is about a time that is over.

    Args:
        what: ``velocity``, ``image`` or ``pose``.
        stamp_s: Its stamp.
        least_s: It must be later than this; None: nothing has been taken in yet.
    """

    def __init__(self, what: str, stamp_s: float, least_s: float | None) -> None:
        self.what, self.stamp_s, self.least_s = what, stamp_s, least_s
        known = "no image has been taken in yet" if least_s is None else f"the filter is at {least_s:.6f} s"
        super().__init__(f"{what} at {stamp_s:.6f} s comes too late: {known}")


class MissingVelocityError(EkfslamError):
    """No velocity has come that could lead to a stamp."""

    def __init__(self, stamp_s: float) -> None:
        super().__init__(f"no velocity has come yet that could lead to {stamp_s:.6f} s")


class HonestyError(EkfslamError):
    """A result has no innovations to judge its covariance by."""


class PosteriorError(EkfslamError):
    """A posterior is asked for what it cannot give."""


class IllPosedError(PosteriorError):
    """The rows of a posterior leave something undetermined.

    Args:
        what: What is undetermined.
        ids: Ids of the landmarks, or numbers of the frames, that are.
    """

    def __init__(self, what: str, ids: Iterable[int]) -> None:
        self.ids = tuple(int(i) for i in ids)
        super().__init__(f"the posterior is ill-posed: {what}{_listed(self.ids)}")


class LineError(DataError):
    """A line of a text file holds more or fewer values than its format, or what is no number or no stamp."""


class LostDataError(DataError):
    """Packets or stamps of a recording are lost in a number or at a place that cannot be repaired."""
