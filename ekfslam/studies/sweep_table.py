"""The table of a sweep: one row a run, every setting and figure of merit a column, in HDF5 and Parquet.

/           attributes format, format_version, swept (names of columns), requested runs, versions
/table      one data set per column: numbers (NaN if missing) or text; run, their common dimension
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ekfslam import files, hdf5
from ekfslam.errors import ArchiveError, ConfigError
from ekfslam.evaluation.metrics import METRICS
from ekfslam.evaluation.paired import paired_grid
from ekfslam.evaluation.summary import KEY_FIGURES, KEYS
from ekfslam.evaluation.tables import MISSING, Column, Grid, document, markdown_text
from ekfslam.names import printable
from ekfslam.provenance import in_words, provenance
from ekfslam.shown import count
from ekfslam.stored import TEXTS, Check, Item

FORMAT, FORMAT_VERSION = "ekfslam-sweep", 1
_RUNS, _ROW = "runs", "run"  # the length that all columns share, and its dimension
_ANY_NUMBER = Check("f", "be numbers", lambda value, _: np.ones(value.shape, dtype=bool))  # a limit may be infinite
SHOWN = (*KEY_FIGURES, "total_s")


_DRAWS = ("recording", "seed")  # columns over which estimators and settings are compared
PREDICTION = "dead-reckoning"
# Settings that dead reckoning knows of the joint filter; of the other tables it knows all but these.
_OF_PREDICTION = ("initial_position_std_m", "initial_rotation_std_rad", "relative_frames")
_NOT_OF_PREDICTION = ("hygiene", "posterior", "tuning")
_TIMES = ("ms_per_frame_median", "ms_per_frame_max", "total_s")
# Units by the endings of settings, longer ones first.
_UNITS = {"rad_s": "rad/s", "m_s2": "m/s^2", "m_s": "m/s", "px": "px", "deg": "deg", "rad": "rad", "hz": "Hz"}
_UNITS |= {"ms": "ms", "m": "m", "s": "s"}


def is_known_to_prediction(setting: str) -> bool:
    """Return whether dead reckoning may depend on a setting, by its dotted name."""
    table, _, key = setting.partition(".")
    return key in _OF_PREDICTION if table == "filter" else table not in _NOT_OF_PREDICTION


@dataclass(frozen=True)
class SweepTable:
    """The results of a sweep. Methods raise a `ConfigError` for an unknown column."""

    # Name to values (n,): numbers as floats, NaN if missing; all else as text, empty if missing.
    columns: Mapping[str, NDArray]
    swept: tuple[str, ...]  # names of the columns that distinguish the runs
    asked: int  # number of runs of the complete sweep
    headings: Mapping[str, str] = field(default_factory=dict)  # of columns that are neither metrics nor settings
    notes: tuple[str, ...] = ()  # below the table of a paper

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    @staticmethod
    def of_rows(
        rows: Sequence[Mapping[str, Any]], swept: tuple[str, ...], asked: int, headings: Mapping[str, str] | None = None
    ) -> SweepTable:
        """Make a table of rows. A column of numbers and truth values holds floats, any other holds text."""
        columns: dict[str, NDArray] = {}
        for name in dict.fromkeys(name for row in rows for name in row):
            values = [row.get(name) for row in rows]
            if all(value is None or isinstance(value, int | float) for value in values):
                columns[name] = np.array([np.nan if value is None else float(value) for value in values])
            else:
                columns[name] = np.array(["" if value is None else str(value) for value in values], dtype=object)
        return SweepTable(columns, swept, asked, headings or {})

    def column(self, name: str) -> NDArray:
        """Return a column by name."""
        if name not in self.columns:
            raise ConfigError(f"the sweep has no column {name!r}; it has {', '.join(self.columns)}")
        return self.columns[name]

    def groups(self, *names: str) -> dict[tuple[Any, ...], SweepTable]:
        """Split the table by the values in some columns, in the order of their first rows."""
        rows: dict[tuple[Any, ...], list[int]] = {}
        for row, values in enumerate(zip(*(self.column(name).tolist() for name in names), strict=True)):
            key = tuple(None if value != value else value for value in values)  # NaN would differ from itself
            rows.setdefault(key, []).append(row)
        return {values: self._only(chosen) for values, chosen in rows.items()}

    def where(self, name: str, *values: str) -> SweepTable:
        """Return the rows with one of the values in a column, formatted as in `markdown`; each must occur in it."""
        found = [spoken(value) for value in self.column(name).tolist()]
        for value in values:
            if value not in found:
                raise ConfigError(f"the column {name} has no {value!r}; it has {', '.join(dict.fromkeys(found))}")
        return self._only([row for row, value in enumerate(found) if value in values])

    def _only(self, rows: Sequence[int]) -> SweepTable:
        columns = {name: values[np.asarray(rows, dtype=int)] for name, values in self.columns.items()}
        return replace(self, columns=columns, asked=len(rows))

    def rows(self, *names: str) -> list[dict[str, Any]]:
        """Return some columns (default: all) row by row as plain values, ready for JSON; None for NaN."""
        columns = {name: self.column(name).tolist() for name in names or self.columns}
        return [
            {name: None if values[i] != values[i] else values[i] for name, values in columns.items()}
            for i in range(len(self))
        ]

    @property
    def told(self) -> list[str]:
        """Names of the swept columns in which the runs differ, or the first one."""
        values = {name: {*map(spoken, self.column(name).tolist())} - {MISSING} for name in self.swept}
        return [name for name, found in values.items() if len(found) > 1] or [self.swept[0]]

    @property
    def choices(self) -> list[str]:
        """Names of the columns that tell estimators and settings apart, not recordings and seeds."""
        return [name for name in self.told if name not in _DRAWS]

    def _shown(self, figures: Sequence[str]) -> list[str]:
        """Return the columns of which there is a value."""
        columns = {name: self.column(name) for name in figures}
        return [name for name, x in columns.items() if x.dtype.kind != "f" or np.isfinite(x).any()]

    def grid(self, figures: Sequence[str] = SHOWN) -> Grid:
        """Return some figures of all runs, the best of a recording and seed in bold."""
        texts = [Column(self.words(name), [spoken(x) for x in self.column(name).tolist()]) for name in self.told]
        numbers = [self._column(name, self.column(name).tolist()) for name in self._shown(figures)]
        groups = list(zip(*(self.column(name).tolist() for name in _DRAWS if name in self.columns), strict=True))
        return Grid([*texts, *numbers], [tuple(map(spoken, group)) for group in groups], [self._head(self.told)])

    def means(self, figures: Sequence[str] = SHOWN, over: Sequence[str] = ("seed",)) -> Grid:
        """Return mean and standard error of figures over seeds or recordings (first: median, worst), and counts."""
        names, kept = [name for name in self.told if name not in over], self.without_repeats()
        parts = kept.groups(*names) if names else {(): kept}
        texts = [Column(self.words(name), [spoken(key[i]) for key in parts]) for i, name in enumerate(names)]
        numbers, gaps = [Column("runs", [len(part) for part in parts.values()])], list[str]()
        shown = [name for name in self._shown(figures) if self.column(name).dtype.kind == "f"]
        for place, name in enumerate(shown):
            values = [x[np.isfinite(x)] for x in (part.column(name) for part in parts.values())]
            mean, median, worst = (
                [float(pick(x)) if len(x) else None for x in values] for pick in (np.mean, np.median, np.max)
            )
            errors = [float(x.std(ddof=1) / np.sqrt(len(x))) if len(x) > 1 else None for x in values]
            numbers.append(one := self._column(name, mean, errors))
            further = {} if place else {"median": median, "worst": worst}
            numbers += [Column(heading, x, decimals=one.places) for heading, x in further.items()]
            lacking = sum(len(part) - len(x) for part, x in zip(parts.values(), values, strict=True) if len(x))
            gaps += [f"{self.words(name)} is missing in {count(lacking, 'run')}"] if lacking else []
        groups = [key[names.index("recording")] if "recording" in names else "" for key in parts]
        words = f"± is the standard error over {' and '.join(f'{name}s' for name in over if name in self.told)}"
        return Grid([*texts, *numbers], groups, ["; ".join([words, *gaps, self._head(self.told)])])

    def tests(self, figures: Sequence[str] = SHOWN) -> tuple[Grid | None, tuple[str, ...]]:
        """Return paired tests of estimators and settings over recordings and seeds, see `paired_grid`."""
        found: dict[str, dict[tuple[str, ...], dict[Any, float]]] = {}
        names = [name for name in self._shown(figures) if self.column(name).dtype.kind == "f" and name not in _TIMES]
        for choice, part in self.without_repeats().groups(*self.choices).items() if self.choices else ():
            keys = list(zip(*(part.column(name).tolist() for name in _DRAWS if name in self.columns), strict=True))
            keys = [tuple(map(spoken, key)) for key in keys]
            for name in names:
                values = dict(zip(keys, part.column(name).tolist(), strict=True))
                found.setdefault(self.words(name), {})[tuple(map(spoken, choice))] = values
        return paired_grid(found)

    def paper(self, ending: str, figures: Sequence[str] = SHOWN) -> str:
        """Return the table of a paper as a file with an ending of `WRITERS`, and paired tests of the choices.

        Rows are means over seeds if there are several, else single runs; below are means over all recordings.
        """
        grid = self.means(figures) if self._is_repeated("seed") else self.grid(figures)
        if self._is_repeated("recording"):
            grid = grid.above(self.means(figures, _DRAWS), "mean")
        tests, said = self.tests(figures)
        further = said if tests is None else [markdown_text(tests)]
        return replace(grid, notes=[in_words(provenance()), *grid.notes, *self.notes, *further]).text(ending)

    def _is_repeated(self, name: str) -> bool:
        return name in self.told and len(set(self.column(name).tolist())) > 1

    def words(self, name: str) -> str:
        """Return the heading of a column, with its unit."""
        return self.headings.get(name) or words_of(name)

    def _column(self, name: str, values: Sequence[str | float | None], errors: Sequence[float | None] = ()) -> Column:
        heading = self.words(name)  # errors have a unit there, NEES and NIS their expected value
        return Column(heading, values, errors, is_compared="[" in heading and name not in _TIMES)

    def without_repeats(self, kept: str = "") -> SweepTable:
        """Return the table with equal runs of dead reckoning once, without settings that it ignores but ``kept``."""
        columns, modes = {name: x.copy() for name, x in self.columns.items()}, self.columns.get("mode", np.zeros(0))
        rows = np.flatnonzero(modes == PREDICTION)
        for name in self.told if len(rows) else ():
            if name != kept and not is_known_to_prediction(name):
                columns[name][rows] = np.nan if columns[name].dtype.kind == "f" else ""
        facts = [
            x
            for name, x in columns.items()
            if name == kept or (name != "key" and name not in _TIMES and is_known_to_prediction(name))
        ]
        first = {str([x[row] for x in facts]): row for row in reversed(rows.tolist())}
        repeated = {*rows.tolist()} - {*first.values()}
        return replace(self, columns=columns)._only([row for row in range(len(self)) if row not in repeated])

    def _head(self, told: Sequence[str]) -> str:
        """Return the number of runs, and the errors of those without a result."""
        errors = self.columns.get("error", np.zeros(len(self), dtype="U1")).tolist()
        failed = [(row, text) for row, text in enumerate(errors) if text]
        rows = {row: ", ".join(spoken(self.column(name)[row]) for name in told) for row, _ in failed}
        lines = "\n".join(f"- {rows[row]}: {text}" for row, text in failed)
        return f"{len(self)} of {self.asked} runs" + (f", {len(failed)} without a result:\n\n{lines}" if failed else "")

    def markdown(self, figures: Sequence[str] = SHOWN) -> str:
        """Return some figures of merit of all runs as Markdown, with their means over seeds and paired tests."""
        tests, said = self.tests(figures)
        means = [self.means(figures)] if self._is_repeated("seed") else []
        grids = [self.grid(figures), *means, *([] if tests is None else [tests])]
        return document(*map(markdown_text, grids), *(said if means and tests is None else ()))


def words_of(column: str) -> str:
    """Return a column in words with its unit: the heading of a metric, or a setting whose name ends with its unit."""
    if column in METRICS:
        return METRICS[column].heading
    unit = next((ending for ending in _UNITS if column.endswith(f"_{ending}")), None)
    name = column if unit is None else f"{column.removesuffix(f'_{unit}')} [{_UNITS[unit]}]"
    return name.replace("_", " ").replace(".", " ")


def table_image(table: SweepTable) -> bytes:
    """Return a table as an HDF5 file."""

    def fill(h5file: h5py.File) -> None:
        hdf5.write_attributes(h5file, {"swept": json.dumps(table.swept), "runs": table.asked, **provenance()})
        columns = {name: x if x.dtype.kind == "f" else hdf5.fixed_texts(x) for name, x in table.columns.items()}
        hdf5.write_fields(h5file.create_group("table", track_order=True), _layout(columns), columns)

    return hdf5.image(FORMAT, FORMAT_VERSION, fill)


def write_table(path: str | Path, table: SweepTable) -> list[Path]:
    """Write a table as HDF5, and as Parquet if ``pyarrow`` is installed; return the paths."""
    path = Path(path)
    contents: dict[Path, str | bytes] = {path: table_image(table)}
    with suppress(ImportError):
        import pyarrow
        from pyarrow import parquet

        columns = {name: values.tolist() for name, values in table.columns.items()}
        parquet.write_table(pyarrow.table(columns), packed := BytesIO())
        contents[path.with_suffix(".parquet")] = packed.getvalue()
    files.write_all(contents)
    return list(contents)


def read_table(path: str | Path) -> SweepTable:
    """Read the table of a sweep."""
    with hdf5.opened(path, FORMAT, FORMAT_VERSION) as h5file:
        group = hdf5.subgroup(h5file, "table")
        for name in group:
            if not isinstance(group[name], h5py.Dataset):
                raise ArchiveError(f"{path}: table/{name} is no column")
        columns = hdf5.read_fields(group, _layout({name: group[name] for name in group if name != _ROW}))
        for name, values in columns.items():
            if values.dtype.kind != "f":
                columns[name] = np.array([printable(text) for text in hdf5.texts(values)], dtype=object)
        swept, asked = json.loads(str(hdf5.attribute(h5file, "swept"))), hdf5.attribute(h5file, "runs")
        if not (isinstance(swept, list) and all(isinstance(name, str) for name in swept)):
            raise ArchiveError(f"{path}: attribute swept is no list of columns")
        if not (type(asked) is int and asked >= 0):
            raise ArchiveError(f"{path}: attribute runs is no count")
        missing = [name for name in ("key", "error", *swept, *KEYS) if name not in columns]
        if missing:
            raise ArchiveError(f"{path}: table/{missing[0]} is missing")
        for name in ("key", "error", *KEYS):
            if (columns[name].dtype.kind == "f") != (name in KEYS):
                raise ArchiveError(f"{path}: table/{name} must be {'numbers' if name in KEYS else 'text'}")
            if name in KEYS:
                require_figures(f"{path}: table/{name}", name, columns[name])
        if len(set(columns["key"])) < len(columns["key"]):
            raise ArchiveError(f"{path}: table/key holds a run twice")
        return SweepTable(columns, tuple(swept), asked)


def require_figures(place: str, key: str, values: NDArray) -> None:
    """Raise an `ArchiveError` if values of a metric are infinite, or one of this package is negative or no count."""
    metric, values = METRICS[key], values[~np.isnan(values)]
    own = getattr(metric.compute, "func", metric.compute).__module__.startswith("ekfslam.")  # a partial has `func`
    least = 0.0 if own else -np.inf
    if not ((values >= least) & (values < np.inf)).all():
        raise ArchiveError(f"{place} must be finite{' and not negative' if own else ''}")
    if metric.fmt == "d" and (values % 1).any():
        raise ArchiveError(f"{place} must be whole numbers")


def _layout(columns: Mapping[str, Any]) -> list[Item]:
    return [
        Item(name, name, (_RUNS,), "see the name", "none", _ANY_NUMBER if values.dtype.kind == "f" else TEXTS)
        for name, values in columns.items()
    ]


def spoken(value: Any) -> str:
    """Return a setting as text; a dash if it has none."""
    if isinstance(value, float):
        return MISSING if np.isnan(value) else f"{value:g}"
    return MISSING if value in (None, "") else str(value)
