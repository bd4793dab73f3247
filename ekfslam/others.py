"""Trajectories of other programs as results beside those of this package.

    others = Others({"orb": "orb.txt"}, frame="camera")
    ekfslam.compare(sequence, others=others)

A file is TUM, with covariances beside it if there are any (see `ekfslam.read_trajectory`), a EuRoC csv, or KITTI. Its
poses belong to the frames with the nearest stamps within half the median time step, or to the frames in their order if
it has no stamps. A frame without a pose is interpolated for figures, and left out of every figure of merit.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from ekfslam.arrays import Array, BoolArray, IntArray
from ekfslam.config import MODES, Config
from ekfslam.data.interpolation import stretches, stretches_text
from ekfslam.data.noise import Noise
from ekfslam.data.observations import Truth
from ekfslam.data.readers.poses import FIRST_IMAGE, Poses, nearest, truth_of_frames
from ekfslam.data.readers.registry import Source, expected, read_as
from ekfslam.data.readers.tum import covariance_file, covariances_beside
from ekfslam.data.sequence import Sequence
from ekfslam.data.trajectory import Moving, Trajectory, left_error_covariance
from ekfslam.errors import ConfigError, TruthError, UnknownFormatError
from ekfslam.evaluation.consistency import chi2_bounds, nees, pose_error
from ekfslam.evaluation.other_body import other_body
from ekfslam.evaluation.sanity import sanity_attributes
from ekfslam.evaluation.trajectory import align_yaw
from ekfslam.filters.result import OTHER, OTHER_LEVEL, OTHER_MISSING, Innovation, Landmarks, Rejections, Result
from ekfslam.geometry import se3
from ekfslam.names import printable
from ekfslam.storage.archive import Archive
from ekfslam.stored import empty

World = Literal["first", "given"]
NAME, SEED = "{name}", "{seed}"  # in a path, replaced by the recording's name and by the seed
LEAST_POSES = 3
_SHOWN = 3  # stretches in messages
_SAME_WORLD = 0.998  # two-sided probability, so that 99.9 % of the first poses in the same world agree
_LEFT = 0.6  # of the differences of motions, which the pose of another body leaves at most
_ROUNDING = 1e-3  # m and rad, of first poses without an uncertainty


@dataclass(frozen=True)
class Others:
    """Trajectories to compare with.

    Raises:
        ConfigError: A name is that of a mode, empty, or has a slash or a dot.
    """

    # Path or trajectory by name. ``{name}`` in a path is the name of the recording, ``{seed}`` the seed.
    files: Mapping[str, Trajectory | str | Path] = dataclasses.field(default_factory=dict)
    frame: Moving | None = None  # moving frame of poses in files; None: left camera for KITTI, else body
    # "first" moves each trajectory so that its first pose is that of the recording (the true one, or that of our runs);
    # if accelerations show the vertical, only in yaw and position. A first pose that is there already, within its
    # covariance, stays. "given" moves none.
    world: World = "first"

    def __post_init__(self) -> None:
        for what, value, known in (("frame", self.frame or "body", Moving), ("world", self.world, World)):
            if value not in get_args(known):
                raise ConfigError(
                    f"{what} of trajectories must be one of {', '.join(get_args(known))}, found {value!r}"
                )
        for name in self.files:
            if not name or name != printable(name) or set(name) & set("/.") or name in (*MODES, "truth"):
                raise ConfigError(f"a trajectory cannot have the name {name!r}: modes and paths have such names")

    @staticmethod
    def of(given: Others | Mapping[str, Trajectory | str | Path] | None) -> Others:
        return given if isinstance(given, Others) else Others(given or {})

    @staticmethod
    def parse(texts: list[str], frame: Moving | None = None, world: World = "first") -> Others:
        """Return the trajectories of texts ``path`` or ``name=path``; the name is by default that of the file."""
        files: dict[str, Trajectory | str | Path] = {}
        for text in texts:
            name, equals, path = text.partition("=")
            if not equals:
                name, path = Path(text).name.partition(".")[0].replace(NAME, "").replace(SEED, "").strip("-_ "), text
            if not name:
                raise ConfigError(f"{text!r} does not name the trajectory; write NAME={text}")
            if name in files:
                raise ConfigError(f"two trajectories have the name {name!r}; write NAME=PATH")
            files[name] = path
        return Others(files, frame, world)

    def named(self, name: str, seed: int | None = None) -> Others:
        """Return the trajectories of one recording, with its name and the seed in their paths."""
        filled = {
            key: str(path).replace(NAME, name).replace(SEED, str(seed)) if isinstance(path, str | Path) else path
            for key, path in self.files.items()
        }
        return dataclasses.replace(self, files=filled)

    def require_distinct(self, recordings: int, seeds: int = 1) -> None:
        """Raise a `ConfigError` if a trajectory would be compared with several recordings or seeds."""
        for name, path in self.files.items():
            for count, of, key in ((recordings, "recordings", NAME), (seeds, "seeds", SEED)):
                if count > 1 and key not in str(path):
                    raise ConfigError(f"{name}: one trajectory for {count} {of}; write {key} for them in {path}")

    def results(self, recording: Sequence | Archive, like: Result | None = None) -> dict[str, Result]:
        """Return each trajectory as a result; ``like`` is one of our runs.

        Raises:
            UnknownFormatError: A file is missing, or of no known format.
            TruthError: Fewer than three poses belong to frames.
            DataError: A file is malformed; the subclass says how.
        """
        return {name: _result(recording, name, given, self, like) for name, given in self.files.items()}


NO_OTHERS = Others()


def files_of(given: Trajectory | str | Path) -> list[Path]:
    """Return the files of a trajectory that exist: its poses and covariances."""
    if isinstance(given, Trajectory):
        return []
    path = Path(given)
    return [p for p in (path, covariance_file(path)) if p is not None and p.exists()]


def placed_poses(recording: Sequence | Archive, poses: Poses, name: str) -> Truth:
    """Return poses of the body at their frames; raise a `TruthError` if fewer than three belong to frames."""
    placed = truth_of_frames(recording.time_s, poses, int(recording.attributes.get(FIRST_IMAGE, 0)))
    if len(placed.frame) < LEAST_POSES:
        stamps = recording.time_s if poses.time_s is None else poses.time_s
        theirs, ours = (f"{t[0]:.3f} to {t[-1]:.3f} s" if len(t) else "none" for t in (stamps, recording.time_s))
        raise TruthError(
            f"{name}: {len(placed.frame)} of {len(poses.T_world_imu)} poses belong to frames: its stamps are {theirs}, "
            f"those of {recording.name} {ours}"
        )
    return placed


def _result(
    recording: Sequence | Archive, name: str, given: Trajectory | str | Path, how: Others, like: Result | None
) -> Result:
    poses, covariance = _read(recording, given, how.frame)
    placed, frames = placed_poses(recording, poses, name), len(recording.time_s)
    has = np.zeros(frames, dtype=bool)
    has[placed.frame] = True
    row = (
        np.arange(len(placed.frame)) if poses.time_s is None else nearest(poses.time_s, recording.time_s[placed.frame])
    )
    start, is_level = _start(recording, int(placed.frame[0]), like), _is_level(recording, like)
    first = None if covariance is None else covariance[row[0]]
    if how.world == "given" or _agrees(placed.T_world_imu[0], start, first):
        start = None
    T, moved = _moved(placed.T_world_imu, start, is_level)
    if moved and first is not None and first.any():
        moved += "; its first covariance is not 0: for NEES take --with-world given"
    P = np.zeros((frames, 6, 6))
    if covariance is not None:
        P = covariance[row][np.clip(np.searchsorted(placed.frame, np.arange(frames), side="right") - 1, 0, None)]
    noise = recording.noise or (Noise.isotropic(1.0, 1.0, 1.0) if like is None else like.noise)
    said = _matching(recording, poses, placed.frame, row, has), moved, _other_body(recording, placed, like)
    lines = tuple(line for line in said if line)
    source = name if isinstance(given, Trajectory) else Path(given).name
    facts: dict[str, str | int | float] = {OTHER: printable(source), OTHER_LEVEL: int(is_level)}
    return Result(
        mode=name,
        sequence_name=recording.name,
        time_s=recording.time_s,
        T_world_imu=_filled(recording.time_s, placed.frame, T),
        covariance=P,
        landmarks=empty(Landmarks),
        innovation=empty(Innovation, T=frames),
        rejections=empty(Rejections),
        ms_per_frame=np.zeros(frames),
        counts={},
        config=dataclasses.asdict(Config()) if like is None else like.config,
        noise=noise,
        camera=recording.camera,
        T_cam_imu=recording.T_cam_imu,
        attributes={
            **recording.attributes,
            **facts,
            **({} if has.all() else {OTHER_MISSING: stretches_text(~has)}),
            **sanity_attributes(lines),
        },
    )


def _read(
    recording: Sequence | Archive, given: Trajectory | str | Path, frame: Moving | None
) -> tuple[Poses, Array | None]:
    """Return poses of the body, and covariances of their errors ``xi`` if there are any."""
    T_cam_imu = recording.T_cam_imu
    if isinstance(given, Trajectory):
        T = given.T_world if given.moving == "body" else given.T_world @ T_cam_imu
        return Poses(T, given.time_s, ()), left_error_covariance(given, T_cam_imu)
    poses: Poses | None = read_as(Source.at(given), "truth", recording)
    if poses is None:
        found = "no poses of a known format" if Path(given).is_file() else "no such file"
        raise UnknownFormatError(f"{given}: {found}; {expected('truth')}")
    if poses.time_s is not None:
        trajectory = Trajectory(
            poses.time_s, poses.T_world_imu, covariances_beside(Path(given), poses.time_s), frame or "body"
        )
        return _read(recording, trajectory, None)
    if (beside := covariance_file(Path(given))) is not None:
        raise ConfigError(f"{beside}: covariances need the stamps of their poses, which KITTI has not; write TUM")
    if frame == "body" and poses.frame is None:  # the reader took them for those of the left camera
        poses = dataclasses.replace(poses, T_world_imu=T_cam_imu @ poses.T_world_imu @ se3.inverse(T_cam_imu))
    return poses, None


def _start(recording: Sequence | Archive, frame: int, like: Result | None) -> Array | None:
    """Return the pose of a frame that a trajectory is moved to: the true one, ours, or the first of the recording."""
    truth = recording.truth
    if truth is not None and (known := np.flatnonzero(truth.frame == frame)).size:
        return truth.T_world_imu[known[0]]
    if like is not None:
        return like.T_world_imu[frame]
    return recording.initial_T_world_imu if isinstance(recording, Sequence) and frame == 0 else None


def _agrees(T: Array, start: Array | None, covariance: Array | None) -> bool:
    """Return whether a first pose is at ``start`` within its covariance, so that both have the same world."""
    if start is None or covariance is None:
        return False
    with_rounding = covariance + _ROUNDING**2 * np.eye(6)
    return bool(nees(pose_error(T, start), with_rounding) <= chi2_bounds(6, _SAME_WORLD)[1])


def _is_level(recording: Sequence | Archive, like: Result | None) -> bool:
    """Return whether accelerations of the recording show the vertical."""
    if like is not None:
        return like.knows_vertical
    return isinstance(recording, Sequence) and recording.inertial is not None


def _moved(T: Array, start: Array | None, is_level: bool) -> tuple[Array, str]:
    """Return poses whose first one is at ``start``, in yaw and position or altogether, and words on the motion."""
    if start is None:
        return T, ""
    by = start @ se3.inverse(T[0])
    if is_level:  # along the heading of x, which is level in a car or in the hand
        ahead = np.stack([pose[:3, 3] + scale * pose[:3, 0] for pose in (T[0], start) for scale in (0.0, 1.0)])
        by = align_yaw(ahead[:2], ahead[2:])
        by[:3, 3] = start[:3, 3] - by[:3, :3] @ T[0, :3, 3]
    shift_m = float(np.linalg.norm(by[:3, :3] @ T[0, :3, 3] + by[:3, 3] - T[0, :3, 3]))
    turn_deg = float(np.degrees(np.linalg.norm(se3.so3_log(by[:3, :3]))))
    if shift_m < 1e-6 and turn_deg < 1e-6:
        return T, ""
    kept = ", its tilt kept" if is_level else ""
    return by @ T, f"moved by {shift_m:.3g} m and turned by {turn_deg:.3g} deg to the recording's first pose{kept}"


def _other_body(recording: Sequence | Archive, placed: Truth, like: Result | None) -> str:
    """Return words on the place of the body of a trajectory, if it differs from that of the truth, or of our run."""
    known = recording.truth or (None if like is None else Truth(np.arange(len(like.time_s)), like.T_world_imu))
    if known is None:
        return ""
    frame, ours, theirs = np.intersect1d(known.frame, placed.frame, return_indices=True)
    found = other_body(recording.time_s[frame], known.T_world_imu[ours], placed.T_world_imu[theirs])
    if found is None or found.left > _LEFT:
        return ""
    return f"it looks like poses of another body, {found.size}: its pose in ours is {found.flag} (x y z qx qy qz qw)"


def _filled(time_s: Array, frame: IntArray, T: Array) -> Array:
    """Return poses of all frames: between two of ``frame``, those of a constant twist; beyond them, the nearest."""
    after = np.clip(np.searchsorted(frame, np.arange(len(time_s))), 1, len(frame) - 1)
    before = after - 1
    share = (time_s - time_s[frame[before]]) / (time_s[frame[after]] - time_s[frame[before]])
    step = se3.log(se3.inverse(T[before]) @ T[after])
    filled = T[before] @ se3.exp(np.clip(share, 0.0, 1.0)[:, None] * step)
    filled[frame] = T
    return filled


def _matching(recording: Sequence | Archive, poses: Poses, frame: IntArray, row: IntArray, has: BoolArray) -> str:
    """Return how many poses belong to frames, and which poses and frames have no partner."""
    total = len(poses.T_world_imu)
    by = "in their order"
    if poses.time_s is not None:
        by = f"by the nearest stamp within {500.0 * float(np.median(np.diff(recording.time_s))):.3g} ms"
    said = [f"{len(frame)} of {total} poses belong to frames, {by}"]
    if poses.time_s is not None and len(frame) < total:
        left = np.ones(total, dtype=bool)
        left[row] = False
        where = [f"{poses.time_s[a]:.3f}" + (f" to {poses.time_s[b]:.3f}" if b > a else "") for a, b in stretches(left)]
        said.append(f"no frame for those at {_some(where)} s")
    if not has.all():
        numbers = [f"{a}" if a == b else f"{a} to {b}" for a, b in stretches(~has)]
        said.append(f"no pose for {int((~has).sum())} of {len(has)} frames: {_some(numbers)}")
    return "; ".join(said)


def _some(texts: list[str]) -> str:
    more = len(texts) - _SHOWN
    return ", ".join(texts[:_SHOWN]) + (f" and {more} more" if more > 0 else "")
