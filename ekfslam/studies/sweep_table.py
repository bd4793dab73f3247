"""The table of a sweep: one row a run, every setting and figure of merit a column, in HDF5 and Parquet.

/           attributes format, format_version, swept (names of columns), requested runs, versions
/table      one data set per column: numbers (NaN if missing) or text; run, their common dimension
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ekfslam import files, hdf5
from ekfslam.errors import ArchiveError, ConfigError
from ekfslam.evaluation.summary import KEYS
from ekfslam.evaluation.tables import document, markdown_table, significant
from ekfslam.names import printable
from ekfslam.runner import versions
from ekfslam.stored import TEXTS, Check, Item

FORMAT, FORMAT_VERSION = "ekfslam-sweep", 1
_RUNS, _ROW = "runs", "run"  # the length that all columns share, and its dimension
_ANY_NUMBER = Check("f", "be numbers", lambda value, _: np.ones(value.shape, dtype=bool))  # a limit may be infinite
SHOWN = (
    "ate_m",
    "ate_aligned_m",
    "t_rel_percent",
    "pose_nees_with_truth_noise_mean",
    "nis_per_dof",
    "landmark_rmse_m",
    "total_s",
)


@dataclass(frozen=True)
class SweepTable:
    """The results of a sweep. Methods raise a `ConfigError` for an unknown column."""

    # Name to values (n,): numbers as floats, NaN if missing; all else as text, empty if missing.
    columns: Mapping[str, NDArray]
    swept: tuple[str, ...]  # names of the columns that distinguish the runs
    asked: int  # number of runs of the complete sweep

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    @staticmethod
    def of_rows(rows: Sequence[Mapping[str, Any]], swept: tuple[str, ...], asked: int) -> SweepTable:
        """Make a table of rows. A column of numbers and truth values holds floats, any other holds text."""
        columns: dict[str, NDArray] = {}
        for name in dict.fromkeys(name for row in rows for name in row):
            values = [row.get(name) for row in rows]
            if all(value is None or isinstance(value, int | float) for value in values):
                columns[name] = np.array([np.nan if value is None else float(value) for value in values])
            else:
                columns[name] = np.array(["" if value is None else str(value) for value in values], dtype=object)
        return SweepTable(columns, swept, asked)

    def column(self, name: str) -> NDArray:
        """Return a column by name."""
        if name not in self.columns:
            raise ConfigError(f"the sweep has no column {name!r}; it has {', '.join(self.columns)}")
        return self.columns[name]

    def groups(self, *names: str) -> dict[tuple[Any, ...], SweepTable]:
        """Split the table by the values in some columns, in the order of their first rows."""
        rows: dict[tuple[Any, ...], list[int]] = {}
        for row, values in enumerate(zip(*(self.column(name).tolist() for name in names), strict=True)):
            rows.setdefault(values, []).append(row)
        return {values: self._only(chosen) for values, chosen in rows.items()}

    def where(self, name: str, *values: str) -> SweepTable:
        """Return the rows with one of the values in a column, formatted as in `markdown`; each must occur in it."""
        spoken = [_spoken(value) for value in self.column(name).tolist()]
        for value in values:
            if value not in spoken:
                raise ConfigError(f"the column {name} has no {value!r}; it has {', '.join(dict.fromkeys(spoken))}")
        return self._only([row for row, value in enumerate(spoken) if value in values])

    def _only(self, rows: Sequence[int]) -> SweepTable:
        columns = {name: values[np.asarray(rows, dtype=int)] for name, values in self.columns.items()}
        return SweepTable(columns, self.swept, len(rows))

    def rows(self, *names: str) -> list[dict[str, Any]]:
        """Return some columns (default: all) row by row as plain values, ready for JSON; None for NaN."""
        columns = {name: self.column(name).tolist() for name in names or self.columns}
        return [
            {name: None if values[i] != values[i] else values[i] for name, values in columns.items()}
            for i in range(len(self))
        ]

    def markdown(self, figures: Sequence[str] = SHOWN) -> str:
        """Return a Markdown table of the swept columns and of some figures of merit, with the errors."""
        told = [name for name in self.swept if len(set(self.column(name).tolist())) > 1] or list(self.swept[:1])
        shown = [
            name for name in figures if self.column(name).dtype.kind != "f" or np.isfinite(self.column(name)).any()
        ]
        rows = [
            [*(_spoken(self.column(name)[i]) for name in told), *(_figure(self.column(name)[i]) for name in shown)]
            for i in range(len(self))
        ]
        failed = [(row, text) for row, text in enumerate(self.columns.get("error", [])) if text]
        lines = "\n".join(f"- {', '.join(rows[row][: len(told)])}: {text}" for row, text in failed)
        head = f"{len(self)} of {self.asked} runs" + (f", {len(failed)} without a result:\n\n{lines}" if failed else "")
        return document(markdown_table([*told, *shown], rows, left=len(told), padded=True), head)


def table_image(table: SweepTable) -> bytes:
    """Return a table as an HDF5 file."""

    def fill(h5file: h5py.File) -> None:
        hdf5.write_attributes(h5file, {"swept": json.dumps(table.swept), "runs": table.asked, **versions()})
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
        columns = hdf5.read_fields(group, _layout({name: group[name] for name in group if name != _ROW}))
        for name, values in columns.items():
            if values.dtype.kind != "f":
                columns[name] = np.array([printable(text) for text in hdf5.texts(values)], dtype=object)
        swept = json.loads(str(hdf5.attribute(h5file, "swept")))
        missing = [name for name in ("key", "error", *swept, *KEYS) if name not in columns]
        if missing:
            raise ArchiveError(f"{path}: table/{missing[0]} is missing")
        return SweepTable(columns, tuple(swept), int(hdf5.attribute(h5file, "runs")))


def _layout(columns: Mapping[str, Any]) -> list[Item]:
    return [
        Item(name, name, (_RUNS,), "see the name", "none", _ANY_NUMBER if values.dtype.kind == "f" else TEXTS)
        for name, values in columns.items()
    ]


def _spoken(value: Any) -> str:
    if isinstance(value, float):
        return "-" if np.isnan(value) else f"{value:g}"
    return str(value)


def _figure(value: Any) -> str:
    if isinstance(value, float):
        return significant(value if np.isfinite(value) else None)
    return str(value)
