"""Monte Carlo studies of consistency: many simulated drives, several filter variants on each, one archive.

The first pose is drawn from the prior of the filters, no outlier is simulated and nothing is gated, so the mean NEES of
a consistent filter equals its degrees of freedom. Results are bit-equal for any executor and after interruptions.

    /                             attributes format, format_version, error_convention, study (JSON), seed, versions
    /levels/<level>               attribute world (JSON)
        time (T,)                 nominal stamps
        done (runs,)              whether a run is finished
        <variant>/<field>         (runs, T, ...) as in `VARIANT_LAYOUT`; NaN or 0 for a run that is not finished
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any
from zlib import crc32

import h5py
import numpy as np
from numpy.typing import NDArray

from ekfslam import files, hdf5
from ekfslam.arrays import Array, BoolArray
from ekfslam.config import VARIANTS, Config, FilterConfig
from ekfslam.data.sequence import Sequence
from ekfslam.data.simulate import Loop, simulate
from ekfslam.data.worlds import require_kind
from ekfslam.errors import ArchiveError, ConfigError, FilterError
from ekfslam.evaluation.consistency import nanmean, nees, pose_error, world_axes_errors, world_axes_std
from ekfslam.filters.joint import JointEKF
from ekfslam.filters.loop import one_thread, run_filter
from ekfslam.filters.result import ERROR_CONVENTION
from ekfslam.models.sensors.stereo import Rig
from ekfslam.provenance import provenance, versions
from ekfslam.shown import Card, Shown, count
from ekfslam.smoother.fixed_lag import FixedLag
from ekfslam.stored import COUNTS, FLAGS, NOT_NEGATIVE_OR_NONE, NUMBERS_OR_NONE, Check, Item, Layout, Shape, zeros
from ekfslam.studies.executors import ONE_RUN_AT_A_TIME
from ekfslam.studies.journal import Journal, Key, Record, flat, run_missing

FORMAT = "ekfslam-study"
FORMAT_VERSION = 2  # 2 added coordinates of all dimensions

# Settings of each variant of a study. The textbook filter has landmarks as positions in world.
TEXTBOOK = "textbook"
_VARIANTS: dict[str, dict[str, Any]] = {
    **{variant: {"variant": variant} for variant in VARIANTS},
    TEXTBOOK: {"variant": "standard", "landmark_coordinates": "xyz"},
    **{f"{variant}-iterated": {"variant": variant, "iterations": 3} for variant in VARIANTS if variant != "fej"},
}
STUDY_VARIANTS: tuple[str, ...] = tuple(_VARIANTS)
LABELS: Mapping[str, str] = {name: name for name in STUDY_VARIANTS} | {TEXTBOOK: "textbook (standard, xyz)"}
COMPARED = (*VARIANTS, TEXTBOOK)  # by default

_SMALL_PRIOR: dict[str, Any] = {"initial_position_std_m": 0.01, "initial_rotation_std_rad": 0.001}
_LARGE_PRIOR: dict[str, Any] = {"initial_position_std_m": 0.5, "initial_rotation_std_rad": float(np.deg2rad(15.0))}
_RING = Loop(frames=314, stamp_jitter_s=0.0, radius_m=20.0, speed_m_s=8.0, landmarks=100, min_disparity_px=6.0)

# Two rounds of a ring, from a good rig to a very poor one; at ``large-heading`` the first pose is hardly known.
LEVELS: Mapping[str, Loop] = MappingProxyType(
    {
        name: dataclasses.replace(
            _RING, name=name, sigma_px=px, sigma_v_m_s=v, sigma_w_rad_s=w, max_range_m=range_m, **prior
        )
        for name, px, v, w, range_m, prior in (
            ("low", 0.5, 0.1, 0.01, 25.0, _SMALL_PRIOR),
            ("mid", 1.0, 0.5, 0.05, 40.0, _SMALL_PRIOR),
            ("high", 2.0, 1.5, 0.2, 25.0, _SMALL_PRIOR),
            ("large-heading", 1.0, 0.5, 0.05, 25.0, _LARGE_PRIOR),
        )
    }
)

JOINT_INSTANTS = 4  # equally spaced, the last one at the last frame
MOST_VALUES = 10_000_000  # frames of all runs and variants: an archive of 1.4 GB

# Data sets below a level, and below a variant of it.
LEVEL_LAYOUT = (
    Item("time", "time", ("T",), "s", "nominal stamps"),
    Item("done", "done", ("runs",), "1", "runs that are in", FLAGS),
)


def _field(name: str, shape: Shape, units: str, meaning: str, check: Check = NOT_NEGATIVE_OR_NONE) -> Item:
    """Return the data set of a value per run; the shape is that of one run."""
    return Item(name, name, ("runs", *shape), units, meaning, check)


# T is the number of frames, J the number of instants at which the joint NEES is taken.
VARIANT_LAYOUT = (
    _field("pose_nees", ("T",), "1", "xi, 6 degrees of freedom"),
    _field("orientation_nees", ("T",), "1", "theta of xi, 3 degrees of freedom"),
    _field("position_nees", ("T",), "1", "rho of xi, 3 degrees of freedom"),
    _field("landmark_nees", ("T",), "1", "mean over the landmarks in the state, 3 degrees of freedom each"),
    _field("joint_nees_per_dof", ("J",), "1", "xi and all landmarks, divided by 6 + 3n"),
    _field("nis", ("T",), "1", "innovations of the frame"),
    _field("nis_dof", ("T",), "1", "degrees of freedom of nis", COUNTS),
    _field("position_error", ("T", "xyz"), "m", "estimate minus truth, world axes", NUMBERS_OR_NONE),
    _field("rotation_error", ("T", "xyz"), "rad", "log(R_estimate R_truth^T), world axes", NUMBERS_OR_NONE),
    _field("three_sigma", ("T", "error"), "m (0-2), rad (3-5)", "bounds of position and rotation error, world axes"),
    _field("diverged", (), "1", "stopped with an error, not finite, or left the ring altogether", FLAGS),
)
_RUN_LAYOUT = tuple(item._replace(shape=item.shape[1:]) for item in VARIANT_LAYOUT)


@dataclass(frozen=True, repr=False)
class Study(Shown):
    """A Monte Carlo study: simulated worlds and the filter variants to compare on them.

        study = Study({"mid": LEVELS["mid"]}, ("invariant", "standard"), runs=50)
        with open_executor("processes") as executor:
            archive = run_study(study, "study.h5", executor)
        print(study_table(summarise_study(archive)))  # of ekfslam.studies.summary

    Raise a `ConfigError` if there is nothing to do, or a variant is unknown.
    """

    # Name to world; the seed of a world is not used.
    levels: Mapping[str, Loop] = dataclasses.field(default_factory=lambda: dict(LEVELS))
    # Names in `STUDY_VARIANTS`: the variants of the filter, ``-iterated`` with three iterations per update, and
    # ``textbook``, the standard variant with landmarks in ``xyz``.
    variants: tuple[str, ...] = VARIANTS
    runs: int = 50  # number of realisations of each level
    seed: int = 0  # seed of all realisations

    def __post_init__(self) -> None:
        object.__setattr__(self, "levels", dict(self.levels))  # a mapping proxy could not be sent to a worker
        object.__setattr__(self, "variants", tuple(self.variants))
        for key in ("runs", "seed"):
            require_kind("study", key, getattr(self, key), int)
        for variant in self.variants:
            if variant not in STUDY_VARIANTS:
                raise ConfigError(f"unknown variant {variant!r} of a study; known: {', '.join(STUDY_VARIANTS)}")
        if len(set(self.variants)) < len(self.variants):
            raise ConfigError(f"a variant of the study is named twice: {', '.join(self.variants)}")
        for name, level in self.levels.items():
            if not level.initial_position_std_m * level.initial_rotation_std_rad > 0:
                raise ConfigError(f"level {name}: a study needs a prior of the first pose, or NEES is not defined")
        if not self.levels or not self.variants or self.runs < 1 or self.seed < 0:
            raise ConfigError("a study needs a level, a variant, at least one run, and a seed that is not negative")
        values = self.runs * len(self.variants) * sum(world.frames for world in self.levels.values())
        if values > MOST_VALUES:
            raise ConfigError(
                f"a study of {self.runs} runs is too large: {values:.3g} frames, at most {MOST_VALUES:.3g}"
            )

    def card(self) -> Card:
        filters = self.runs * len(self.levels) * len(self.variants)
        facts = {"levels": ", ".join(self.levels), "variants": ", ".join(self.variants), "seed": str(self.seed)}
        title = f"{count(self.runs, 'run')} of each level, {count(filters, 'filter')} in all"
        return Card(title, facts, ('ekfslam.check_consistency(study, "out")',))

    @property
    def parameters(self) -> dict[str, Any]:
        """Everything that decides the numbers, ready for JSON."""
        return dataclasses.asdict(self)


def realisation(study: Study, level: str, run: int) -> Loop:
    """Return the world of one run, whose seed is of the study's seed, the level's name and the run."""
    source = np.random.SeedSequence(entropy=study.seed, spawn_key=(crc32(level.encode()), run))
    return dataclasses.replace(study.levels[level], seed=int(source.generate_state(1, np.uint64)[0] >> 1))


def filter_config(level: Loop, variant: str) -> FilterConfig:
    """Return the settings of a variant: the prior that the truth is drawn from, and no rejected observation."""
    settings = FilterConfig(
        **_VARIANTS[variant],
        retire="never",
        gate_probability=1.0,
        split_after=0,
        initial_position_std_m=level.initial_position_std_m,
        initial_rotation_std_rad=level.initial_rotation_std_rad,
    )
    return Config(filter=settings).filter  # checked


def run_one(study: Study, level: str, run: int) -> dict[str, dict[str, NDArray]]:
    """Simulate one run; return variant to field to value (`VARIANT_LAYOUT`): NaN at frame 0 and after a stop."""
    world = realisation(study, level, run)
    with ONE_RUN_AT_A_TIME, one_thread(), np.errstate(all="ignore"):
        sequence = simulate(world)
        return {variant: evaluate(sequence, world, filter_config(world, variant)) for variant in study.variants}


def _blank(study: Study, level: str, layout: Layout = _RUN_LAYOUT) -> dict[str, dict[str, NDArray]]:
    """Return every field of every variant without values: NaN, 0 or False."""
    sizes = {"runs": study.runs, "T": study.levels[level].frames, "J": JOINT_INSTANTS}
    return {variant: _no_values(layout, sizes) for variant in study.variants}


def _no_values(layout: Layout, sizes: Mapping[str, int]) -> dict[str, NDArray]:
    found = zeros(layout, **sizes)
    return {name: np.full_like(x, np.nan) if x.dtype.kind == "f" else x for name, x in found.items()}


def _joint_frames(frames: int) -> list[int]:
    return [(frames - 1) * (i + 1) // JOINT_INSTANTS for i in range(JOINT_INSTANTS)]


def evaluate(sequence: Sequence, world: Loop, config: FilterConfig) -> dict[str, NDArray]:
    """Run one filter on one realisation and return its record, with the fields and shapes of `VARIANT_LAYOUT`."""
    truth, noise = sequence.truth, sequence.noise
    assert truth is not None
    assert noise is not None
    frames = len(sequence)
    T_true = np.full((frames, 4, 4), np.nan)
    T_true[truth.frame] = truth.T_world_imu
    T_est, P_pose = np.full((frames, 4, 4), np.nan), np.full((frames, 6, 6), np.nan)
    record = _no_values(_RUN_LAYOUT, {"T": frames, "J": JOINT_INSTANTS})
    joint_frames = _joint_frames(frames)

    rig, start = Rig(sequence.camera, sequence.T_cam_imu, noise), sequence.initial_T_world_imu
    ekf = JointEKF(rig, config, start, window=FixedLag)
    known, stopped = np.zeros(frames, dtype=bool), False
    try:
        for k, report, _ in run_filter(ekf, sequence):
            if not (np.isfinite(ekf.T_imu_world).all() and ekf.gaussian.is_finite):
                stopped = True
                break
            record["nis"][k], record["nis_dof"][k] = report.nis, report.dof
            T_est[k], P_pose[k] = ekf.T_world_imu, ekf.gaussian.body_covariance[:6, :6]
            known[k] = k >= truth.frame[0]
            if not known[k] or len(ekf.ids) == 0:
                continue
            m_true = truth.position_m[np.searchsorted(truth.landmark, ekf.ids)]
            error = ekf.variant.landmark_error(ekf.positions_m, m_true, T_est[k], T_true[k])
            record["landmark_nees"][k] = nanmean(nees(error, ekf.gaussian.landmark_blocks()), axis=0)
            if k in joint_frames:
                other = slice(6, ekf.gaussian.body)  # all blocks but the pose
                P = np.delete(np.delete(ekf.P, other, 0), other, 1)
                joint = np.concatenate([pose_error(T_est[k], T_true[k]), error.ravel()])
                record["joint_nees_per_dof"][joint_frames.index(k)] = nees(joint, P) / len(P)
    except (FilterError, np.linalg.LinAlgError):
        stopped = True
    _put_errors(record, known, T_est[known], T_true[known], P_pose[known])
    left = np.linalg.norm(record["position_error"][-1]) > 2.0 * world.radius_m
    record["diverged"][()] = stopped or bool(left)
    return record


def _put_errors(record: dict[str, NDArray], known: BoolArray, T_est: Array, T_true: Array, P: Array) -> None:
    """Write errors, NEES and bounds of the poses of the known frames into a record."""
    xi = pose_error(T_est, T_true)
    record["pose_nees"][known] = nees(xi, P)
    record["position_nees"][known] = nees(xi[:, :3], P[:, :3, :3])
    record["orientation_nees"][known] = nees(xi[:, 3:], P[:, 3:, 3:])
    errors = world_axes_errors(T_est, T_true)
    record["position_error"][known], record["rotation_error"][known] = errors[:, :3], errors[:, 3:]
    record["three_sigma"][known] = 3.0 * world_axes_std(T_est, P)


@dataclass(frozen=True, repr=False)
class StudyArchive(Shown):
    """A study and its finished runs."""

    study: Study  # the study
    done: Mapping[str, BoolArray]  # level to mask (runs,) of finished runs
    # Level to variant to field to values (runs, ...), see `VARIANT_LAYOUT`.
    data: Mapping[str, Mapping[str, Mapping[str, NDArray]]]
    software: Mapping[str, str] = dataclasses.field(default_factory=versions)  # versions that wrote the archive

    @staticmethod
    def empty(study: Study) -> StudyArchive:
        """Return an archive with room for all runs."""
        done = {level: np.zeros(study.runs, dtype=bool) for level in study.levels}
        return StudyArchive(study, done, {level: _blank(study, level, VARIANT_LAYOUT) for level in study.levels})

    def card(self) -> Card:
        runs = self.study.runs
        facts = {level: f"{int(done.sum())} of {count(runs, 'run')}" for level, done in self.done.items()}
        facts["variants"] = ", ".join(self.study.variants)
        title = "complete" if self.complete else "not complete"
        calls = ("study_table(summarise_study(archive))", 'archive.data[level][variant]["pose_nees"]')
        return Card(title, facts, calls)

    @property
    def runs(self) -> int:
        """Number of finished runs of all levels."""
        return sum(int(mask.sum()) for mask in self.done.values())

    @property
    def complete(self) -> bool:
        """Whether all runs are finished."""
        return self.runs == self.study.runs * len(self.study.levels)

    def time_s(self, level: str) -> Array:
        """Return the nominal stamps (T,) of a level."""
        world = self.study.levels[level]
        return world.frame_period_s * np.arange(world.frames, dtype=float)

    def finished(self, level: str) -> dict[str, dict[str, NDArray]]:
        """Return the values of the finished runs of a level, by variant and field."""
        done = self.done[level]
        return {v: {field: value[done] for field, value in values.items()} for v, values in self.data[level].items()}

    def put(self, key: Key, record: Record) -> None:
        """Write the record of a run into the archive."""
        level, run = key
        for variant, values in record.items():
            for field, value in values.items():
                self.data[level][variant][field][run] = value
        self.done[level][run] = True


def run_study(study: Study, path: str | Path, executor: Executor, progress: bool = True) -> StudyArchive:
    """Run everything that the archive at ``path`` does not hold, see `run_missing`; a larger number of runs extends it.

    Raise an `ArchiveError` if it is of another study; the message names the difference.
    """
    path = Path(path)
    archive = StudyArchive.empty(study)
    decides = {**study.parameters, "runs": None, **versions()}
    journal = Journal(path, decides, partial(_blank, study))

    def missing() -> dict[Key, tuple[Study, str, int]]:
        keys = itertools.product(range(study.runs), study.levels)
        return {(level, run): (study, level, run) for run, level in keys if not archive.done[level][run]}

    def keep(key: Key, record: Record) -> None:
        level, run = key
        for variant, fields in record.items():
            _require_run(f"{path}: {variant} of run {run} at {level}", fields)
        if run < study.runs:  # the journal may be one of a longer study
            archive.put(key, record)

    def save() -> None:
        if journal.path.stat().st_size:  # some runs have finished
            write_study(path, archive)

    earlier, label = partial(_earlier, path, study), "consistency" if progress else ""
    run_missing(journal, earlier, missing, lambda *task: executor.submit(run_one, *task), keep, save, label)
    return archive


def _require_run(place: str, record: Mapping[str, NDArray]) -> None:
    """Raise an `ArchiveError` if the record of a run holds what an archive would not."""
    for item in VARIANT_LAYOUT:
        if not np.all(item.check.holds(record[item.name], {})):
            raise ArchiveError(f"{place}: {item.name} must {item.check.words}")
    if not (record["diverged"] or np.isfinite(record["position_error"][-1]).all()):
        raise ArchiveError(f"{place}: it did not diverge, but has no last position")


def _earlier(path: Path, study: Study) -> Iterator[tuple[Key, Record]]:
    """Yield the finished runs of an archive; raise an `ArchiveError` if it is of another study."""
    old = read_study(path)
    wanted, found = dict(flat(study.parameters)), dict(flat(old.study.parameters))
    found["runs"] = max(found["runs"], wanted["runs"])
    # Numbers of another version of the software may differ in the last bits, which matters only if they would mix.
    if not (old.complete and old.study.runs == study.runs):
        wanted, found = {**wanted, **versions()}, {**found, **old.software}
    differing = [name for name in {**found, **wanted} if found.get(name) != wanted.get(name)]
    if differing:
        said = [f"{name} is {found.get(name)}, asked for {wanted.get(name)}" for name in differing[:3]]
        more = f" and {len(differing) - 3} more" if len(differing) > 3 else ""
        raise ArchiveError(
            f"{path} holds another study: {'; '.join(said)}{more}; move it away or choose another folder"
        )
    for level, done in old.done.items():
        for run in np.flatnonzero(done).tolist():
            yield (level, run), {v: {f: x[run] for f, x in of.items()} for v, of in old.data[level].items()}


def write_study(path: str | Path, archive: StudyArchive) -> None:
    """Write the archive of a study."""
    study = archive.study

    def fill(h5file: h5py.File) -> None:
        # The seed is text: it may be larger than any integer of HDF5.
        facts = {"error_convention": ERROR_CONVENTION, "study": json.dumps(study.parameters), "seed": str(study.seed)}
        hdf5.write_attributes(h5file, {**facts, **provenance()})
        for level, world in study.levels.items():
            group = h5file.create_group(f"levels/{level}")
            hdf5.write_attributes(group, {"world": json.dumps(dataclasses.asdict(world))})
            along = {"time": archive.time_s(level), "instant": np.array(_joint_frames(world.frames))}
            hdf5.write_fields(group, LEVEL_LAYOUT, {"time": along["time"], "done": archive.done[level]})
            for variant, values in archive.data[level].items():
                hdf5.write_fields(group.create_group(variant), VARIANT_LAYOUT, values, coordinates=along)
                group[f"{variant}/joint_nees_per_dof"].attrs["frames"] = _joint_frames(world.frames)

    files.write_all({Path(path): hdf5.image(FORMAT, FORMAT_VERSION, fill)})


def read_study(path: str | Path) -> StudyArchive:
    """Read the archive of a study, finished or not."""
    with hdf5.opened(path, FORMAT, FORMAT_VERSION) as h5file:
        parameters = hdf5.json_table(h5file, "study")
        try:
            levels = {name: Loop(**world) for name, world in dict(parameters["levels"]).items()}
            study = Study(**{**parameters, "levels": levels})
        except ConfigError as error:
            raise ArchiveError(f"{path}: {error}") from None
        facts = hdf5.attributes(h5file)
        software = {name: str(value) for name, value in facts.items() if name.startswith("version_")}
        archive = StudyArchive(study, done := {}, data := {}, software)
        for level, world in study.levels.items():
            group = hdf5.subgroup(h5file, f"levels/{level}")
            sizes = {"runs": study.runs, "T": world.frames, "J": JOINT_INSTANTS}
            found = hdf5.read_fields(group, LEVEL_LAYOUT, sizes)
            done[level] = found["done"]
            along = {"time": found["time"], "instant": np.array(_joint_frames(world.frames))}
            data[level] = {
                variant: hdf5.read_fields(hdf5.subgroup(group, variant), VARIANT_LAYOUT, sizes, along)
                for variant in study.variants
            }
        return archive
