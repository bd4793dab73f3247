"""Write ``archive.md``: the format of result archives, from the layouts that write and read them.

python docs/make_archive.py
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path

from ekfslam import files, stored
from ekfslam.data.readers import hdf5 as sequences
from ekfslam.evaluation.tables import document, markdown_table
from ekfslam.filters.result import ERROR_CONVENTION, Result
from ekfslam.storage import archive
from ekfslam.storage.exports import EXPORTS
from ekfslam.studies import study

PAGE = Path(__file__).with_name("archive.md")

OPENING = """
A result archive is one HDF5 file. It holds a recording without its observations, the truth if there is any, and what
every mode made of it. A file appears under its name only when it is complete, and reading gives back every number bit
for bit. Every data set states its `units` and its `frame` of reference as attributes.

    import ekfslam, xarray

    archive = ekfslam.read_archive("city.h5")               # everything, checked
    archive.results["full"].position_covariance_world       # (T, 3, 3), along the axes of world
    archive.results["full"].to_dataframe("landmarks")       # pandas

    group = "runs/full/trajectory"                          # without this package
    trajectory = xarray.open_dataset("city.h5", group=group, engine="h5netcdf")
    trajectory.covariance.sel(xi="rho_x", xi_2="rho_x")     # variance along x of the IMU, by stamp

pandas and xarray come with `pip install 'ekfslam[paper]'`. h5py needs nothing else.
"""

DIMENSIONS = """
Every dimension is a dimension scale of HDF5 in the group of the data sets that have it, and holds the coordinate along
it. So each group can be opened alone. A dimension without labels, stamps or ids counts from 0. A square matrix has its
second axis as `<name>_2`.
""".strip()

STORAGE = """
Arrays of more than 10 000 numbers are compressed: gzip at level 1 after byte shuffling, in pieces of at most 1 MiB. It
was measured with the mode full of `builtin:city`, 1000 frames and 61 233 observations, on a loaded machine:

| | size [MB] | write [s] | read [s] |
|---|---:|---:|---:|
| not compressed | 13.17 | 0.23 | 0.31 |
| level 1 | 7.90 | 0.54 | 0.43 |
| level 1, shuffled | 7.34 | 0.47 | 0.41 |
| level 4, shuffled | 7.25 | 0.55 | 0.41 |
| level 9, shuffled | 7.21 | 2.15 | 0.45 |

Pieces of 64 KiB and 256 KiB gave the same within 1 %.
"""

READING = """
A reader must not trust a file: this package inspects all of it before it uses anything. It refuses links, data in other
files, types that no archive has, sizes beyond a limit, values out of their range, coordinates other than those of the
table above, and fields that contradict each other. Each is one error that names file and item. Archives of all
earlier format versions are read.
"""


def page() -> str:
    """Return the text of the page."""
    parts = ["# The archive format", OPENING, f"This is format version {archive.FORMAT_VERSION} of `{archive.FORMAT}`."]
    parts += [f"Errors: {ERROR_CONVENTION}.", "## Groups and attributes", _tree(archive.__doc__)]
    parts += ["## Dimensions", _dimensions()]
    parts += ["## Data sets of the recording and its truth", _table(sequences.LAYOUT, False)]
    parts += ["A recording by itself (`ekfslam-sequence`) also has:", _table(sequences.OBSERVATIONS_LAYOUT, False)]
    for name, record, layout in stored.layouts_of(Result):
        parts += [f"## Fields below `runs/<mode>{name and '/'}{name}`", f"They are fields of `{record.__name__}`."]
        stated = stored.attributes_of(record)
        parts += [f"Attributes: {', '.join(f'`{field}`' for field in stated)}."] if stated else []
        parts += [_table(layout, meanings=_meanings(record))]
        for item in layout:
            if item.codes:
                parts += [f"Codes of `{item.name}`: {', '.join(f'{i} {text}' for i, text in enumerate(item.codes))}."]
    parts += ["## Archives of studies", _tree(study.__doc__), _table((*study.LEVEL_LAYOUT, *study.VARIANT_LAYOUT))]
    parts += ["## Storage", STORAGE, "## Reading", READING]
    rows = [[f"`{name}`", export.words, f"`.{export.ending}`"] for name, export in EXPORTS.items()]
    parts += ["## Exports", "`ekfslam export city.h5 --format FORMAT` writes:"]
    parts += [markdown_table(["format", "holds", "ending"], rows, left=3)]
    return document("<!-- Written by docs/make_archive.py from the code: change it there. -->", *parts)


def _tree(doc: str | None) -> str:
    """Return the indented tree in the docstring of a module."""
    lines = inspect.cleandoc(doc or "").splitlines()
    begin = next(i for i, line in enumerate(lines) if line.startswith("    /"))
    length = next((i for i, line in enumerate(lines[begin:]) if line and not line.startswith("    ")), None)
    return "\n".join(lines[begin:][:length])


def _meanings(record: type) -> dict[str, str]:
    """Return what a class of records says of each field, in its docstring or in a comment above or beside it."""
    args = inspect.cleandoc(record.__doc__ or "").partition("Args:")[2].partition("\n\n")[0]
    found: dict[str, str] = {}
    for names, words in re.findall(r"(?m)^ {4}([\w, ]+): ((?:.|\n {8})*)", args):
        found |= dict.fromkeys(names.split(", "), " ".join(words.replace("``", "`").split()).rstrip("."))
    fields = r"(?m)((?:^    # .*\n)*)^    (\w+): [^#\n]*(?:\n(?:        .*|    \)))*(?:# (.*))?$"
    for above, name, beside in re.findall(fields, inspect.getsource(record)):
        words = " ".join([*(line.strip(" #") for line in above.splitlines()), beside]).strip().rstrip(".")
        names, _, rest = words.partition(": ")
        is_of_several = rest and name in names.split(", ")
        if words:
            found |= dict.fromkeys(names.split(", "), rest) if is_of_several else {name: words}
    return found


def _table(layout: stored.Layout, checked: bool = True, meanings: dict[str, str] | None = None) -> str:
    headings = ["data set", "dimensions", "units", "frame"]
    headings += ["values must"] * checked + ["field"] * (meanings is not None)
    rows = []
    for item in layout:
        words = item.check.words.replace(f"from 0 to {stored.MOST}", "from 0 on").replace(f"to {stored.MOST}", "on")
        row = [f"`{item.name}`", ", ".join(item.dims) or "-", item.units, item.frame] + [words] * checked
        row += [f"`{item.field}`: {meanings.get(item.field, '')}"] if meanings is not None else []
        rows.append(row)
    return markdown_table(headings, rows, left=6)


def _dimensions() -> str:
    layouts = [sequences.LAYOUT, sequences.OBSERVATIONS_LAYOUT]
    layouts += [layout for _, _, layout in stored.layouts_of(Result)] + [study.LEVEL_LAYOUT, study.VARIANT_LAYOUT]
    items = [item for layout in layouts for item in layout]
    names = dict.fromkeys(name for item in items for name in item.dims if not name.endswith(stored.SECOND))
    labels = {axis.name: ", ".join(axis.labels) for axis in stored.AXES.values()}
    rows = [[f"`{name}`", stored.meaning_of(name), labels.get(name, "")] for name in names]
    return f"{DIMENSIONS}\n\n{markdown_table(['dimension', 'along it', 'labels'], rows, left=3)}"


if __name__ == "__main__":
    files.write(PAGE, page())
