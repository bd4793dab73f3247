"""The observation side of a frame in the engine: one call, and what log and books take in of it."""

from __future__ import annotations

from typing import Any

from ekfslam.arrays import Array, IntArray
from ekfslam.engine.face import Engine
from ekfslam.filters.estimate import Estimate
from ekfslam.filters.frame import Outcome
from ekfslam.filters.innovations import FrameInnovations
from ekfslam.filters.landmarks import landmarks_of
from ekfslam.filters.lifecycle import Retired
from ekfslam.filters.logbook import Accepted, LogBook
from ekfslam.models.blocks import Values


def rest(e: Estimate, engine: Engine, retired: Retired, frame: int, ids: IntArray) -> None:
    """Let landmarks out of view sleep or retire; arguments as of `ekfslam.filters.frame.rest`."""
    e.forget_table()
    if (gone := engine.rest(frame, ids)) is not None:
        _keep(retired, gone)


def update(
    e: Estimate,
    engine: Engine,
    log: LogBook,
    retired: Retired,
    frame: int,
    ids: IntArray,
    measured: Array,
    is_rested: bool,
) -> Outcome:
    """Let landmarks out of view leave, correct with known ones (6), start new ones (5).

    Other arguments are those of `ekfslam.filters.frame.update`.

    Args:
        is_rested: Whether `rest` was called for this frame.
    """

    def twist_after(after: Values) -> Array:
        return e.model.process.imu_twist({"pose": e.motion.T_departed}, after, e.motion.interval)

    needs_twist = e.model.observer.has_time_offset and e.motion.tau_s
    e.forget_table()
    found = engine.update(frame, ids, measured, is_rested, twist_after if needs_twist else None)
    for gone in found["retired"]:
        _keep(retired, gone)
    retired.moving.update(found["moving"].tolist())
    if (doubt := found["doubt"]) != e.motion.interval.doubt:
        e.motion = e.motion.doubted(doubt)
    views = ("pose", *e.model.layout.views)
    # The log has the rows at their linearisation, then those of new landmarks.
    taken, begun = found["taken"], found["begun"]
    accepted = Accepted(*(taken[name] for name in ("landmark", "previous", "rows", "variance", "position_m")))
    log.corrected(e, accepted, engine.named(taken["values"], views), taken["imu_twist"], taken["coordinates"])
    log.amend(T_updated=engine.named(found["updated_values"], views)["pose"], updated=found["updated_coordinates"])
    seen = [(e.step, begun["rows"], begun["variance"])]
    if begun["step_before"] >= 0:
        seen.insert(0, (begun["step_before"], begun["rows_before"], begun["variance"]))
    if len(begun["ids"]):
        log.started(begun["ids"], begun["position_m"], *seen)
        retired.start_again(begun["ids"])
    e.values, e.coordinates, e.imu_twist = engine.named(found["values"]), found["coordinates"], found["imu_twist"]
    return Outcome(
        found["reason"],
        found["nis"],
        found["log_det"],
        found["dof"],
        found["split"],
        FrameInnovations(**found["innovations"]),
    )


def _keep(retired: Retired, gone: dict[str, Any]) -> None:
    """Keep the last estimates of landmarks that left the state."""
    retired.take(landmarks_of(gone["table"], gone["covariance"]), gone["table"], gone["may_return"])
