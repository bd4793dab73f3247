"""Sweeps: recordings x seeds x cases x variants x settings x modes, one row of figures of merit a run.

    sweep = Sweep.from_toml("study.toml")
    with open_executor("processes") as executor:
        table = run_sweep(sweep, "sweep.h5", executor)

The format of the file is described in ``docs/sweep.md``. The key of a run is a digest of everything that decides its
numbers, so an interrupted sweep resumes, and an extended one runs only new combinations.
"""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import itertools
import json
import math
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ekfslam
from ekfslam.config import MODES, VARIANTS, Config, FrontEndConfig, of_toml
from ekfslam.data.imu import with_inertial_files
from ekfslam.data.opening import open_recording
from ekfslam.data.readers.simulated import BUILTIN
from ekfslam.data.sequence import Sequence, stretch
from ekfslam.data.velocities import attach_velocities
from ekfslam.errors import ArchiveError, ConfigError, EkfslamError
from ekfslam.evaluation.summary import KEYS, summarise
from ekfslam.evaluation.truth import with_truth_noise
from ekfslam.filters.loop import one_thread
from ekfslam.filters.result import Result
from ekfslam.frontend.opening import open_sequence
from ekfslam.limits import DEFAULT_GB, limit_gb, noting_files, reading_up_to, require_file
from ekfslam.names import printable
from ekfslam.others import NO_OTHERS, Others, files_of
from ekfslam.provenance import versions
from ekfslam.runner import run
from ekfslam.studies.executors import ONE_RUN_AT_A_TIME
from ekfslam.studies.journal import Journal, Key, Record, flat, run_missing
from ekfslam.studies.sweep_table import (
    PREDICTION,
    SweepTable,
    is_known_to_prediction,
    read_table,
    require_figures,
    write_table,
)

MOST_RUNS = 100_000
_ERROR_BYTES = 400
_KEYS = {"recordings": list, "modes": list, "variants": list, "seeds": list, "settings": dict, "cases": dict}
_KEYS |= {"with": dict, "with_frame": str, "with_world": str}
_KINDS = {list: "list", dict: "table", str: "text"}
_FILES = ("truth", "velocities", "calibration", "imu", "imu_noise")  # of a recording, beside its data
_OPENED_AS = ("extrinsics", "lateral", "topics", "calibration")  # arguments of `open_recording`
_READ_AS = ("extrinsics", "lateral", "velocity_frame", "topics", *_FILES)  # arguments of `open_sequence`
_RECORDING_KEYS = ("data", "name", "frames", *_READ_AS)
_TAKEN = ("key", "recording", "seed", "case", "mode", "error", "run", *KEYS)  # names of columns

Column = Callable[[Sequence, Result], float | None]


@dataclass(frozen=True)
class Recording:
    """A recording of a sweep."""

    data: str  # path, or ``builtin:NAME``
    name: str  # name in the table
    # truth, extrinsics, lateral, velocities, velocity_frame, topics, calibration, imu, imu_noise: arguments of
    # `ekfslam.open_sequence`; ``topics`` in a file is one text with blanks between names.
    truth: str | None = None
    extrinsics: str = "corrected"
    lateral: str = "corrected"
    velocities: str | None = None
    velocity_frame: str | None = None
    topics: tuple[str, ...] = ()
    calibration: str | None = None
    imu: str | None = None
    imu_noise: str | None = None
    frames: str = ""  # stretch ``A:B`` of the recording, empty for all of it; applied before ``prepare``
    # Function from the sequence and the seed (None without seeds) to the sequence that is run. It must be a function of
    # a module, or a `functools.partial` of one, and draw random numbers from the seed alone.
    prepare: Callable[[Sequence, int | None], Sequence] | None = None

    @property
    def is_simulated(self) -> bool:
        return self.data.startswith(BUILTIN)

    @property
    def is_seeded(self) -> bool:
        """Whether a seed changes the recording."""
        return self.is_simulated or self.prepare is not None

    def with_seed(self, seed: int | None) -> Recording:
        """Return the built-in world with a seed; return other recordings unchanged."""
        if seed is None or not self.is_simulated:
            return self
        return dataclasses.replace(self, data=f"{self.data}{'&' if '?' in self.data else '?'}seed={seed}")

    @cached_property
    def content(self) -> str:
        """Everything that decides its numbers: digests of its files or the name of the world, and its preparation."""
        facts = {name: getattr(self, name) for name in ("data", "frames", *_READ_AS)}
        given = [name for name in _FILES if facts[name]] + ([] if self.is_simulated else ["data"])
        places = [Path(facts[name]) for name in given]
        for name, place in zip(given, places, strict=True):
            facts[name] = _digest(place)
        inside = {place.resolve() for place in places}
        beside = [path for path in self._read if not inside & {path, *path.parents}]
        facts["beside"] = sorted(f"{path.name} {_digest_of_file(path)}" for path in beside)
        return json.dumps([facts, _source(self.prepare)])

    @property
    def _read(self) -> set[Path]:
        """Files that opening reads, such as calibrations beside the recording; for a damaged one, those until then."""
        with noting_files() as found, suppress(EkfslamError, OSError):
            options: dict[str, Any] = {name: getattr(self, name) for name in _OPENED_AS}
            recording: Any = open_recording(self.data, **options)
            if self.velocities:
                attach_velocities(recording, self.velocities)
            with_inertial_files(recording, self.imu, self.imu_noise)
        return found


@dataclass(frozen=True)
class Case:
    """Settings that belong together: table to key to value. Settings and mode replace those of the sweep."""

    overrides: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    mode: str = ""


@dataclass(frozen=True)
class Task:
    """One run of a sweep: a recording, a mode, and a configuration that differs from the default in ``overrides``."""

    recording: Recording
    seed: int | None
    case: str
    mode: str
    overrides: Mapping[str, Mapping[str, Any]]
    columns: Mapping[str, Column]
    others: Others = NO_OTHERS  # the trajectory that takes the place of a run, under the name of the mode

    @cached_property
    def config(self) -> Config:
        return Config().with_overrides(self.overrides)

    @cached_property
    def key(self) -> str:
        """Digest of everything that decides its numbers, as 64 hexadecimal digits."""
        return self._key(dataclasses.asdict(self.config))

    @cached_property
    def run_key(self) -> str:
        """Digest of the settings that its mode knows. Tasks with the same one have the same numbers, and run once."""
        settings = dict(flat(dataclasses.asdict(self.config)))
        if self.mode == PREDICTION and not self.columns:
            settings = {name: value for name, value in settings.items() if is_known_to_prediction(name)}
        return self._key(settings)

    def _key(self, settings: Mapping[str, Any]) -> str:
        columns = {name: _source(column) for name, column in self.columns.items()}
        facts: list[Any] = [self.recording.content, self.mode, settings, versions(), _program(), columns]
        if self.recording.prepare is not None:
            facts.append(self.seed)
        for path in self.others.files.values():
            facts += [*map(_digest, files_of(path)), self.others.frame, self.others.world]
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Sweep:
    """A product of recordings, modes, variants, seeds and settings to run."""

    recordings: tuple[Recording, ...]  # the recordings
    modes: tuple[str, ...] = ("full",)  # modes, variants: names in `MODES` and `VARIANTS`
    variants: tuple[str, ...] = ("invariant",)
    seeds: tuple[int, ...] = ()  # seeds of built-in worlds and of prepared recordings; none for their own
    # Values to try, by table and key or by dotted name such as noise.sigma_px.
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    # Sets of settings by name; the names become the column case.
    cases: Mapping[str, Case] = dataclasses.field(default_factory=dict)
    # Further figures of merit by name, with the restrictions of `Recording.prepare`.
    columns: Mapping[str, Column] = dataclasses.field(default_factory=dict)
    others: Others = NO_OTHERS

    def __post_init__(self) -> None:
        modes = (*self.modes, *(case.mode for case in self.cases.values() if case.mode))
        for what, values, known in (("mode", modes, MODES), ("variant", self.variants, VARIANTS)):
            for value in values:
                if value not in known:
                    raise ConfigError(f"unknown {what} {value!r} of a sweep; known: {', '.join(known)}")
        if not all(type(seed) is int and seed >= 0 for seed in self.seeds):
            raise ConfigError(f"seeds of a sweep must be whole numbers, not negative, found {list(self.seeds)}")
        for name in self.columns:
            if name in _TAKEN or not name or set(name) & set("./"):
                raise ConfigError(f"a column of a sweep cannot have the name {name!r}")
        seeded = len(self._seeded)
        self.others.require_distinct(len(self.recordings), len({seed for _, seed in self._seeded} - {None}))
        ways = sum(1 if case.mode else len(self.modes) for case in self._cases.values())
        count = seeded * ways * len(self.variants) * math.prod(len(values) for _, values in flat(self.settings))
        if not 1 <= count <= MOST_RUNS:
            raise ConfigError(f"a sweep is of 1 to {MOST_RUNS} runs, found {count}")
        names = [recording.name for recording in self.recordings]
        if len(set(names)) < len(names):
            raise ConfigError(f"recordings of a sweep need different names, found {', '.join(names)}")
        if len({task.key for task in self.tasks}) < count + seeded * len(self.others.files):
            raise ConfigError("a sweep holds the same run twice: a value or recording stands in it twice")

    @property
    def _cases(self) -> Mapping[str, Case]:
        return self.cases or {"": Case()}

    @property
    def _seeded(self) -> list[tuple[Recording, int | None]]:
        """Each recording with each of its seeds."""
        return [(own, seed) for own in self.recordings for seed in (own.is_seeded and self.seeds) or (None,)]

    @cached_property
    def tasks(self) -> tuple[Task, ...]:
        """All runs; the mode changes fastest."""
        choices, found = dict(flat(self.settings)), []
        for recording, seed in self._seeded:
            own, named = recording.with_seed(seed), self.others.named(recording.name, seed)
            grid = itertools.product(self._cases.items(), self.variants, itertools.product(*choices.values()))
            for (name, case), variant, values in grid:
                overrides: dict[str, dict[str, Any]] = {"filter": {"variant": variant}}
                for setting, value in zip(choices, values, strict=True):
                    _put(overrides, setting, value)
                for table, settings in case.overrides.items():
                    overrides.setdefault(table, {}).update(settings)
                modes = (case.mode,) if case.mode else self.modes
                found += [Task(own, seed, name, mode, overrides, self.columns) for mode in modes]
            for name, path in named.files.items():
                only = dataclasses.replace(named, files={name: path})
                found.append(Task(own, seed, "", name, {}, self.columns, only))
        return tuple(found)

    @staticmethod
    def from_toml(path: str | Path) -> Sweep:
        """Read a sweep from a file; paths in it are relative to its folder."""
        return of_toml(path, lambda found: _parsed(found, Path(path).parent))


def run_sweep(sweep: Sweep, path: str | Path, executor: Executor, progress: bool = True) -> SweepTable:
    """Run every task that the table at ``path`` does not hold, and write the table; see `run_missing`.

    A run that a filter cannot finish is a row with an error and no figures.

    Raises:
        ArchiveError: ``path`` holds runs that are not part of this sweep, or cannot be written.
        WriteError: Another sweep writes there.
    """
    path = Path(path)
    tasks = {(task.key, 0): task for task in sweep.tasks}
    journal = Journal(path, "sweep", lambda _: _record(sweep.columns, {}))
    done: dict[str, Mapping[str, NDArray]] = {}  # by `Task.run_key`

    def earlier() -> Iterator[tuple[Key, Record]]:
        for row in read_table(path).rows():
            yield (row["key"], 0), _record(sweep.columns, row, row["error"])

    def missing() -> dict[Key, tuple[Task, float]]:
        limit, runs = limit_gb(), dict[str, Task]()
        for task in sweep.tasks:
            runs.setdefault(task.run_key, task)
        return {(task.key, 0): (task, limit) for run, task in runs.items() if run not in done}

    def keep(key: Key, record: Record) -> None:
        if key not in tasks:
            raise ArchiveError(
                f"{path} holds runs of another study, of other recordings or of another build; move it away or "
                "choose another folder"
            )
        _require_row(f"{path}: run {key[0]}", record["run"], is_own=not tasks[key].others.files)
        done[tasks[key].run_key] = record["run"]

    def save() -> None:
        if done:
            write_table(path, _table(sweep, done))

    label = "sweep" if progress else ""
    run_missing(journal, earlier, missing, lambda *task: executor.submit(run_task, *task), keep, save, label)
    return _table(sweep, done)


@one_thread()
def run_task(task: Task, read_gb: float = DEFAULT_GB) -> Record:
    """Run one task, with a limit on the size of files, and return its figures of merit or its error."""
    try:
        with ONE_RUN_AT_A_TIME, reading_up_to(read_gb):
            sequence = _opened(task.recording, task.recording.content, task.seed, task.config.front_end)
            sequence = with_truth_noise(sequence, task.config.truth)
            theirs = task.others.results(sequence)
            result = theirs.get(task.mode) or run(sequence, task.mode, task.config)  # type: ignore[arg-type]
            figures: dict[str, Any] = dict(summarise(sequence, result))
            if not task.others.files:
                figures |= {name: column(sequence, result) for name, column in task.columns.items()}
        return _record(task.columns, figures)
    except EkfslamError as error:
        return _record(task.columns, {}, printable(str(error)))


def _require_row(place: str, run: Mapping[str, NDArray], is_own: bool) -> None:
    """Raise an `ArchiveError` if the figures or the error of a run are none that `run_task` returns."""
    error, figures = run["error"].item().decode(errors="replace"), run["figures"]
    for key, value in zip(KEYS, figures, strict=False):  # columns of a program follow
        require_figures(f"{place}: {key}", key, value)
    if error != printable(error):
        raise ArchiveError(f"{place}: its error cannot be printed")
    if error and not np.isnan(figures).all():
        raise ArchiveError(f"{place}: has figures of merit, and the error {error!r}")
    if is_own and not error and np.isnan(figures).all():
        raise ArchiveError(f"{place}: has neither figures of merit nor an error")


def _record(columns: Mapping[str, Column], figures: Mapping[str, Any], error: str = "") -> Record:
    """Return the record of a run: figures, NaN if missing, and the error."""
    values = [figures.get(name) for name in (*KEYS, *columns)]
    numbers = np.array([np.nan if value is None else float(value) for value in values])
    return {"run": {"figures": numbers, "error": np.array(error.encode()[:_ERROR_BYTES], dtype=f"S{_ERROR_BYTES}")}}


@lru_cache(maxsize=2)
def _opened(recording: Recording, content: str, seed: int | None, front_end: FrontEndConfig) -> Sequence:
    """Open a recording and keep it for the next run in the same process, unless its files change."""
    options: dict[str, Any] = {name: getattr(recording, name) for name in _READ_AS}
    sequence = open_sequence(recording.data, front_end=front_end, **options)
    if recording.frames:
        sequence = sequence[stretch(recording.frames)]
    return sequence if recording.prepare is None else recording.prepare(sequence, seed)


def _table(sweep: Sweep, done: Mapping[str, Mapping[str, NDArray]]) -> SweepTable:
    """Return the finished runs in the order of the sweep."""
    rows = []
    for task in sweep.tasks:
        record = done.get(task.run_key)
        if record is None:
            continue
        settings = dataclasses.asdict(task.config)
        settings.pop("tuning")  # a record of the past
        if task.others.files:
            settings = dict.fromkeys(dict(flat(settings)))
        case = {"case": task.case} if sweep.cases else {}
        facts = {"recording": task.recording.name, "seed": task.seed, **case, "mode": task.mode, **dict(flat(settings))}
        figures = dict(zip((*KEYS, *sweep.columns), record["figures"].tolist(), strict=True))
        rows.append({"key": task.key, **facts, **figures, "error": record["error"].item().decode(errors="replace")})
    swept = ["recording", *(["case"] if sweep.cases else []), "mode", "filter.variant"]
    swept += [*(["seed"] if sweep.seeds else []), *dict(flat(sweep.settings))]
    return SweepTable.of_rows(rows, tuple(swept), len(sweep.tasks))


def _put(overrides: dict[str, Any], name: str, value: Any) -> None:
    """Set a value under a dotted name such as ``noise.sigma_px`` or ``blocks.twist_bias.sigma_v_m_s``."""
    *tables, key = name.split(".")
    for table in tables:
        overrides = overrides.setdefault(table, {})
    overrides[key] = value


# --- The file --------------------------------------------------------------------------------------------------------


def _parsed(found: Mapping[str, Any], folder: Path) -> Sweep:
    for key in found:
        if key not in _KEYS:
            raise ConfigError(f"unknown key {key!r}; known: {', '.join(_KEYS)}")
    for key, kind in _KEYS.items():
        if not isinstance(found.get(key, kind()), kind):
            raise ConfigError(f"{key} must be a {_KINDS[kind]}, found {found[key]!r}")
    settings = dict(flat(found.get("settings", {})))
    for name, value in settings.items():
        if "." not in name:
            raise ConfigError(f"[settings.{name}] must be a table, found {value!r}")
        settings[name] = tuple(value) if isinstance(value, list) else (value,)
    given: dict[str, Any] = {key: tuple(found[key]) for key in ("modes", "variants", "seeds") if key in found}
    recordings = tuple(_recording(entry, folder) for entry in found.get("recordings", []))
    cases = {printable(name): _case(name, case) for name, case in found.get("cases", {}).items()}
    for name, path in found.get("with", {}).items():
        if not isinstance(path, str):
            raise ConfigError(f"with.{name} must be a path, found {path!r}")
    theirs = {name: str(folder / path) for name, path in found.get("with", {}).items()}
    others = Others(theirs, found.get("with_frame"), found.get("with_world", "first"))
    return Sweep(recordings, settings=settings, cases=cases, others=others, **given)


def _case(name: str, found: Any) -> Case:
    if not isinstance(found, dict):
        raise ConfigError(f"[cases.{name}] must be a table, found {found!r}")
    tables = {key: value for key, value in found.items() if key != "mode"}
    try:
        Config().with_overrides(tables)
    except ConfigError as error:
        raise ConfigError(f"[cases.{name}]: {error}") from None
    return Case(tables, found.get("mode", ""))


def _recording(entry: Any, folder: Path) -> Recording:
    given = {"data": entry} if isinstance(entry, str) else entry
    if not isinstance(given, dict) or not all(isinstance(value, str) for value in given.values()):
        raise ConfigError(f"a recording is a path, or a table of texts with data, found {entry!r}")
    for key in given:
        if key not in _RECORDING_KEYS:
            raise ConfigError(f"unknown key {key!r} of a recording; known: {', '.join(_RECORDING_KEYS)}")
    if "data" not in given:
        raise ConfigError(f"a recording has no data: {entry!r}")
    data = given["data"]
    try:
        stretch(given.get("frames", ":"))
    except ValueError as error:
        raise ConfigError(f"frames of {data}: {error}") from None
    is_file = not data.startswith(BUILTIN)
    name = given.get("name", Path(data).stem if is_file else data.removeprefix(BUILTIN))
    files = [key for key in ("data", *_FILES) if key in given and (is_file or key != "data")]
    places = {key: str((folder / given[key]).resolve()) for key in files}
    return Recording(**{**given, **places, "name": printable(name), "topics": tuple(given.get("topics", "").split())})


# --- Digests ---------------------------------------------------------------------------------------------------------


def _source(value: Any) -> str:
    """Return the source of a function and the values bound to it."""
    if value is None or isinstance(value, str | int | float | Path):
        return repr(value)
    if isinstance(value, partial):
        return json.dumps([_source(part) for part in (value.func, *value.args, *sum(value.keywords.items(), ()))])
    try:
        return f"{value.__qualname__} {inspect.getsource(value)}"
    except (OSError, TypeError, AttributeError):
        raise ConfigError(
            f"a sweep takes functions of a module, with numbers, texts or functions bound to them, found {value!r}"
        ) from None


def _digest(path: Path) -> str:
    """Return the digest of a file, or of all files in a folder."""
    if path.is_dir():
        inside = [f"{p.relative_to(path)} {_digest_of_file(p)}" for p in sorted(path.rglob("*")) if p.is_file()]
        return hashlib.sha256("\n".join(inside).encode()).hexdigest()
    require_file(path)
    return _digest_of_file(path)


def _digest_of_file(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@cache
def _program() -> str:
    """Return the digest of the sources and the compiled module of this program."""
    folder = Path(ekfslam.__file__).parent
    own = sorted(p for ending in ("*.py", "*.so", "*.pyd") for p in folder.rglob(ending))
    return hashlib.sha256("".join(_digest_of_file(p) for p in own).encode()).hexdigest()
