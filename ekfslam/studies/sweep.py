"""Sweeps: recordings x seeds x cases x variants x settings x modes, one row of figures of merit a run, in one table.

    sweep = Sweep.from_toml("study.toml")
    with open_executor("processes") as executor:
        table = run_sweep(sweep, "sweep.h5", executor)

A study is a TOML file. Whatever stands in a list is tried, each with each:

    recordings = ["builtin:city?frames=300", { data = "0027.npz", truth = "poses/07.txt" }]
    modes = ["dead-reckoning", "full"]
    variants = ["invariant", "standard"]
    seeds = [0, 1, 2]            # of built-in worlds; a recording is run once

    [settings.noise]             # tables and keys of a configuration, see `ekfslam.config`
    sigma_px = [1.0, 2.0, 4.0]

    [cases."no tilt".noise]      # settings that belong together, under a name
    tilt_deg = 0.0
    [cases."velocities alone"]
    mode = "dead-reckoning"

A program may add columns of its own, and change recordings after they are read: see `Sweep` and `Recording`.

A run is known by all that decides its numbers, the content of its recording and the versions of the software included.
So an interrupted sweep goes on, and a study may be extended: what is there already is not run again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import itertools
import json
import math
import tomllib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ekfslam.config import MODES, VARIANTS, Config, FrontEndConfig
from ekfslam.data.readers.simulated import BUILTIN
from ekfslam.data.sequence import Sequence, stretch
from ekfslam.errors import ArchiveError, ConfigError, EkfslamError, UnknownFormatError
from ekfslam.evaluation.summary import KEYS, summarise
from ekfslam.evaluation.truth import with_truth_noise
from ekfslam.filters.result import Result
from ekfslam.frontend.opening import open_sequence
from ekfslam.limits import DEFAULT_GB, limit_gb, reading_up_to, require_file
from ekfslam.names import printable
from ekfslam.progress import progress as with_progress
from ekfslam.runner import run, versions
from ekfslam.studies.executors import ONE_RUN_AT_A_TIME, completed
from ekfslam.studies.journal import Journal
from ekfslam.studies.sweep_table import SweepTable, read_table, write_table

MOST_RUNS = 100_000
_ERROR_BYTES = 400
_KEYS = ("recordings", "modes", "variants", "seeds", "settings", "cases")
_FILES = ("data", "truth", "velocities")  # of a recording
_RECORDING_KEYS = (*_FILES, "name", "extrinsics", "lateral", "velocity_frame", "frames")
_TAKEN = ("key", "recording", "seed", "case", "mode", "error", "run", *KEYS)  # names of columns

Column = Callable[[Sequence, Result], float | None]


@dataclass(frozen=True)
class Recording:
    """A recording of a sweep.

    Args:
        data: Path, or ``builtin:NAME``.
        name: In the table.
        truth, extrinsics, lateral, velocities, velocity_frame: As of `ekfslam.open_sequence`.
        frames: The stretch ``A:B`` of it, empty for all; ``prepare`` comes after.
        prepare: From what was read and the seed, None without seeds, to what is run. For other processes it must be a
            function of a module, or a `functools.partial` of one. What it draws, it draws from the seed.
    """

    data: str
    name: str
    truth: str | None = None
    extrinsics: str = "corrected"
    lateral: str = "corrected"
    velocities: str | None = None
    velocity_frame: str | None = None
    frames: str = ""
    prepare: Callable[[Sequence, int | None], Sequence] | None = None

    @property
    def is_simulated(self) -> bool:
        return self.data.startswith(BUILTIN)

    @property
    def is_seeded(self) -> bool:
        """Whether a seed changes it."""
        return self.is_simulated or self.prepare is not None

    def with_seed(self, seed: int) -> Recording:
        """The built-in world with a seed of its own; anything else as it is."""
        if not self.is_simulated:
            return self
        return dataclasses.replace(self, data=f"{self.data}{'&' if '?' in self.data else '?'}seed={seed}")

    @cached_property
    def content(self) -> str:
        """What decides its numbers: digests of its files, or the name of the world; and how it is prepared.

        Raises:
            UnknownFormatError: A file is missing.
        """
        prepared = [] if self.prepare is None else [_source(self.prepare)]
        other = {"velocities": self.velocities and _digest(Path(self.velocities)), "frames": self.frames}
        other |= {"velocity_frame": self.velocity_frame}
        prepared += [f"{name} {value}" for name, value in other.items() if value]
        if self.is_simulated:
            return " ".join([self.data, *prepared])
        files = [_digest(Path(p)) for p in (self.data, self.truth) if p]
        return " ".join([self.extrinsics, self.lateral, *files, *prepared])


@dataclass(frozen=True)
class Case:
    """Settings that belong together.

    Args:
        overrides: Table to key to value; they count more than those of the sweep.
        mode: The only one it is run in; empty: those of the sweep.
    """

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
    columns: Mapping[str, Column] = dataclasses.field(default_factory=dict)

    @cached_property
    def config(self) -> Config:
        return Config().with_overrides(self.overrides)

    @cached_property
    def key(self) -> str:
        """What decides its numbers, as 64 hexadecimal digits."""
        facts: list[Any] = [self.recording.content, self.mode, dataclasses.asdict(self.config), versions()]
        if self.recording.prepare is not None:
            facts.append(self.seed)
        if self.columns:
            facts.append({name: _source(column) for name, column in self.columns.items()})
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Sweep:
    """What to run.

    Args:
        recordings: On what.
        modes, variants: Of `MODES` and `VARIANTS`.
        seeds: Of built-in worlds, and of recordings that are prepared; none: their own.
        settings: Table to key to the values to try.
        cases: Sets of settings, by names that become the column ``case``.
        columns: Figures of merit besides those of `summarise`, by name: functions as of `Recording`.

    Raises:
        ConfigError: There is nothing to run, too much, or something unknown.
    """

    recordings: tuple[Recording, ...]
    modes: tuple[str, ...] = ("full",)
    variants: tuple[str, ...] = ("invariant",)
    seeds: tuple[int, ...] = ()
    settings: Mapping[str, Mapping[str, tuple[Any, ...]]] = dataclasses.field(default_factory=dict)
    cases: Mapping[str, Case] = dataclasses.field(default_factory=dict)
    columns: Mapping[str, Column] = dataclasses.field(default_factory=dict)

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
        choices = [values for table in self.settings.values() for values in table.values()]
        seeded = sum(max(len(self.seeds), 1) if recording.is_seeded else 1 for recording in self.recordings)
        ways = sum(1 if case.mode else len(self.modes) for case in self._cases.values())
        count = seeded * ways * len(self.variants) * math.prod(map(len, choices))
        if not 1 <= count <= MOST_RUNS:
            raise ConfigError(f"a sweep is of 1 to {MOST_RUNS} runs, found {count}")
        names = [recording.name for recording in self.recordings]
        if len(set(names)) < len(names):
            raise ConfigError(f"recordings of a sweep need different names, found {', '.join(names)}")
        keys = [task.key for task in self.tasks]
        if len(set(keys)) < len(keys):
            raise ConfigError("a sweep holds the same run twice: a value or recording stands in it twice")

    @property
    def _cases(self) -> Mapping[str, Case]:
        return self.cases or {"": Case()}

    @cached_property
    def tasks(self) -> tuple[Task, ...]:
        """All runs, the mode changing fastest."""
        names = [(table, key) for table, values in self.settings.items() for key in values]
        choices = [self.settings[table][key] for table, key in names]
        found = []
        for recording in self.recordings:
            for seed in self.seeds if recording.is_seeded and self.seeds else (None,):
                seeded = recording if seed is None else recording.with_seed(seed)
                for (name, case), variant, values in itertools.product(
                    self._cases.items(), self.variants, itertools.product(*choices)
                ):
                    overrides: dict[str, dict[str, Any]] = {"filter": {"variant": variant}}
                    for (table, key), value in zip(names, values, strict=True):
                        _put(overrides, table, key, value)
                    for table, own in case.overrides.items():
                        overrides.setdefault(table, {}).update(own)
                    modes = (case.mode,) if case.mode else self.modes
                    found += [Task(seeded, seed, name, mode, overrides, self.columns) for mode in modes]
        return tuple(found)

    @staticmethod
    def from_toml(path: str | Path) -> Sweep:
        """The sweep of a file; paths in it are relative to its folder.

        Raises:
            ConfigError: The file is missing, is not TOML, or holds something unknown.
        """
        try:
            require_file(path, is_text=True)
            found = tomllib.loads(Path(path).read_text(encoding="utf-8"))
            return _parsed(found, Path(path).parent)
        except UnknownFormatError as error:  # names the file
            raise ConfigError(str(error)) from None
        except (OSError, ValueError, RecursionError, ConfigError) as error:  # ValueError: no UTF-8, no TOML
            raise ConfigError(f"{path}: {error}") from None


def run_sweep(sweep: Sweep, path: str | Path, executor: Executor, progress: bool = True) -> SweepTable:
    """Run what the table at ``path`` does not hold yet.

    Every finished run is at once in a journal beside the table. The table is written at the end, and where the sweep is
    interrupted by anything but a kill. A run that a filter cannot finish is a row with an error and no figures.

    Args:
        sweep: What to run.
        path: HDF5 file of the table, made if missing.
        executor: Where to run it, see `ekfslam.studies.executors.open_executor`.
        progress: Whether to show a bar with the time left, on a terminal.

    Raises:
        ArchiveError: ``path`` holds runs that this sweep does not ask for, or cannot be written.
    """
    path = Path(path)
    tasks = {task.key: task for task in sweep.tasks}
    done = _taken_up(path, tasks)
    journal = Journal(path, "sweep", lambda key: _blank(sweep.columns))
    for key, _, record in journal.entries():
        _require_wanted(path, key, tasks)
        done[key] = record["run"]
    missing = [task for key, task in tasks.items() if key not in done]
    finished: Any = completed(missing, lambda task: executor.submit(run_task, task, limit_gb()))
    if progress:
        finished = with_progress(finished, "sweep", "run", total=len(missing))
    try:
        for task, record in finished:
            journal.append(task.key, 0, {"run": record})
            done[task.key] = record
    finally:
        table = _table(sweep, done)
        if len(table):
            write_table(path, table)
            journal.remove()
    return table


def run_task(task: Task, read_gb: float = DEFAULT_GB) -> dict[str, NDArray]:
    """Figures of merit of one run, those of `KEYS` and then its columns, NaN where there is none; why it failed, if so.

    Args:
        task: What to run.
        read_gb: See `ekfslam.limits.reading_up_to`.
    """
    record = _blank(task.columns)["run"]
    try:
        with ONE_RUN_AT_A_TIME, reading_up_to(read_gb):
            sequence = _opened(task.recording, task.seed, task.config.front_end)
            sequence = with_truth_noise(sequence, task.config.truth)
            result = run(sequence, task.mode, task.config)  # type: ignore[arg-type]
            found: dict[str, Any] = dict(summarise(sequence, result))
            found |= {name: column(sequence, result) for name, column in task.columns.items()}
        record["figures"][:] = [np.nan if value is None else value for value in found.values()]
    except EkfslamError as error:
        record["error"] = np.array(printable(str(error)).encode()[:_ERROR_BYTES], dtype=record["error"].dtype)
    return record


@lru_cache(maxsize=2)
def _opened(recording: Recording, seed: int | None, front_end: FrontEndConfig) -> Sequence:
    """A recording, kept for the next run on it in the same process."""
    names = ("truth", "extrinsics", "lateral", "velocities", "velocity_frame")
    options: dict[str, Any] = {name: getattr(recording, name) for name in names}
    sequence = open_sequence(recording.data, front_end=front_end, **options)
    if recording.frames:
        sequence = sequence[stretch(recording.frames)]
    return sequence if recording.prepare is None else recording.prepare(sequence, seed)


def _blank(columns: Mapping[str, Column]) -> dict[str, dict[str, NDArray]]:
    figures = np.full(len(KEYS) + len(columns), np.nan)
    return {"run": {"figures": figures, "error": np.zeros((), dtype=f"S{_ERROR_BYTES}")}}


def _taken_up(path: Path, tasks: Mapping[str, Task]) -> dict[str, Mapping[str, NDArray]]:
    """The runs that the table of an earlier sweep holds."""
    done: dict[str, Mapping[str, NDArray]] = {}
    if not path.exists():
        return done
    columns = read_table(path).columns
    for row, key in enumerate(columns["key"]):
        _require_wanted(path, key, tasks)
        own = tasks[key].columns
        record = _blank(own)["run"]
        record["figures"][:] = [columns[name][row] if name in columns else np.nan for name in (*KEYS, *own)]
        record["error"] = np.array(columns["error"][row].encode(), dtype=record["error"].dtype)
        done[key] = record
    return done


def _require_wanted(path: Path, key: str, tasks: Mapping[str, Task]) -> None:
    if key not in tasks:
        raise ArchiveError(
            f"{path} holds runs of another study, of other recordings or of another release; move it away or choose "
            "another folder"
        )


def _table(sweep: Sweep, done: Mapping[str, Mapping[str, NDArray]]) -> SweepTable:
    """The runs that are done, in the order of the sweep."""
    tasks = [task for task in sweep.tasks if task.key in done]
    rows = []
    for task in tasks:
        record = done[task.key]
        case = {"case": task.case} if sweep.cases else {}
        told = {"recording": task.recording.name, "seed": task.seed, **case, "mode": task.mode}
        facts = {**told, **_settings(task.config)}
        figures = dict(zip((*KEYS, *sweep.columns), record["figures"].tolist(), strict=True))
        rows.append({"key": task.key, **facts, **figures, "error": record["error"].item().decode(errors="replace")})
    swept = ["recording", *(["case"] if sweep.cases else []), "mode", "filter.variant"]
    swept += ["seed"] if sweep.seeds else []
    swept += [f"{table}.{key}" for table, values in sweep.settings.items() for key in values]
    return SweepTable.of_rows(rows, tuple(swept), len(sweep.tasks))


def _settings(config: Config) -> dict[str, Any]:
    """Every setting that a run may depend on, by ``table.key``."""
    return {
        f"{table}.{name}": value
        for table, values in dataclasses.asdict(config).items()
        if table != "tuning"  # a record, no setting
        for name, value in _flat(values)
    }


def _flat(values: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from ((f"{key}.{name}", inner) for name, inner in _flat(value))
        else:
            yield key, value


def _put(overrides: dict[str, dict[str, Any]], table: str, key: str, value: Any) -> None:
    """Set a key of a table; of a state block, ``blocks.<name>``, too."""
    first, _, block = table.partition(".")
    settings = overrides.setdefault(first, {})
    (settings.setdefault(block, {}) if block else settings)[key] = value


def _parsed(found: Mapping[str, Any], folder: Path) -> Sweep:
    for key in found:
        if key not in _KEYS:
            raise ConfigError(f"unknown key {key!r}; known: {', '.join(_KEYS)}")
    for key in _KEYS[:4]:
        if not isinstance(found.get(key, []), list):
            raise ConfigError(f"{key} must be a list, found {found[key]!r}")
    settings: dict[str, dict[str, tuple[Any, ...]]] = {}
    if not isinstance(found.get("settings", {}), dict):
        raise ConfigError("[settings] must hold tables")
    for table, values in found.get("settings", {}).items():
        if not isinstance(values, dict):
            raise ConfigError(f"[settings.{table}] must be a table, found {values!r}")
        for key, value in values.items():
            if isinstance(value, dict):  # of a state block
                settings.setdefault(f"{table}.{key}", {}).update({k: _listed(v) for k, v in value.items()})
            else:
                settings.setdefault(table, {})[key] = _listed(value)
    given: dict[str, Any] = {key: tuple(found[key]) for key in ("modes", "variants", "seeds") if key in found}
    recordings = tuple(_recording(entry, folder) for entry in found.get("recordings", []))
    return Sweep(recordings, settings=settings, cases=_named_cases(found.get("cases", {})), **given)


def _named_cases(found: Any) -> dict[str, Case]:
    """Cases of a file: tables of tables, and a mode."""
    if not isinstance(found, dict) or not all(isinstance(case, dict) for case in found.values()):
        raise ConfigError(f"[cases] must hold tables, found {found!r}")
    cases = {}
    for name, case in found.items():
        tables = {key: value for key, value in case.items() if key != "mode"}
        for table, values in tables.items():
            if not isinstance(values, dict):
                raise ConfigError(f"[cases.{name}.{table}] must be a table, found {values!r}")
        cases[printable(name)] = Case(tables, case.get("mode", ""))
    return cases


def _listed(value: Any) -> tuple[Any, ...]:
    return tuple(value) if isinstance(value, list) else (value,)


def _recording(entry: Any, folder: Path) -> Recording:
    given = {"data": entry} if isinstance(entry, str) else entry
    if not isinstance(given, dict) or not all(isinstance(value, str) for value in given.values()):
        raise ConfigError(f"a recording is a path, or a table of texts with data, found {entry!r}")
    for key in given:
        if key not in _RECORDING_KEYS:
            raise ConfigError(f"unknown key {key!r} of a recording; known: {', '.join(_RECORDING_KEYS)}")
    if "data" not in given:
        raise ConfigError(f"a recording has no data: {entry!r}")
    try:
        stretch(given.get("frames", ":"))
    except ValueError as error:
        raise ConfigError(f"frames of {given['data']}: {error}") from None
    is_simulated = given["data"].startswith(BUILTIN)
    usual = given["data"].removeprefix(BUILTIN) if is_simulated else Path(given["data"]).stem
    places = {key: str((folder / given[key]).resolve()) for key in _FILES if key in given}
    if is_simulated:
        places["data"] = given["data"]
    return Recording(**{**given, **places, "name": printable(given.get("name", usual))})


def _source(value: Any) -> str:
    """What decides the results of a function, as far as that can be told: its source, and what is bound to it."""
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


@lru_cache(maxsize=256)
def _digest(path: Path) -> str:
    """Digest of a file, or of the names and sizes in a folder."""
    if path.is_dir():
        listed = [f"{p.relative_to(path)} {p.stat().st_size}" for p in sorted(path.rglob("*")) if p.is_file()]
        return hashlib.sha256("\n".join(listed).encode()).hexdigest()
    require_file(path)
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
