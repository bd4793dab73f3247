"""Write ``archive.md``: the format of result archives, from the layouts that write and read them.

python docs/make_archive.py
"""

from __future__ import annotations

import inspect
from pathlib import Path

from ekfslam import dimensions, files, hdf5
from ekfslam.data.readers import hdf5 as sequences
from ekfslam.evaluation.tables import document, markdown_table
from ekfslam.filters.result import ERROR_CONVENTION, REASONS
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

pandas and xarray come with `pip install 'ekfslam[tables]'`. h5py needs nothing else.
"""

DIMENSIONS = """
Every dimension is a dimension scale of HDF5, beside the data sets that have it, and holds the coordinate along it. So
each group can be opened by itself. What has no labels, stamps or ids counts from 0. A square matrix has its second
axis as `<name>_2`.
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
A reader must not trust a file: this package looks at all of it before it uses anything. It refuses links, data in other
files, types that no archive has, sizes beyond a limit, values out of their range, coordinates that are not what the
table above says, and fields that contradict each other. Each is one error that names file and item. Archives of all
earlier format versions are read.
"""


def page() -> str:
    """The text of the page."""
    parts = ["# The archive format", OPENING, f"This is format version {archive.FORMAT_VERSION} of `{archive.FORMAT}`."]
    parts += [f"Errors: {ERROR_CONVENTION}.", "## Groups and attributes", _tree(archive.__doc__)]
    parts += ["## Dimensions", _dimensions()]
    parts += ["## Data sets of the recording and its truth", _table(sequences.LAYOUT, False)]
    parts += [
        "A recording by itself (`ekfslam-sequence`) has these besides:",
        _table(sequences.OBSERVATIONS_LAYOUT, False),
    ]
    for group, layout in archive.LAYOUTS.items():
        place = "/".join(part for part in ("runs/<mode>", group) if part)
        parts += [f"## Data sets below `{place}`", _table(layout)]
    parts += [f"Codes of `rejections/reason`: {', '.join(f'{i} {text}' for i, text in enumerate(REASONS))}."]
    parts += ["## Archives of studies", _tree(study.__doc__), _table((*study.LEVEL_LAYOUT, *study.VARIANT_LAYOUT))]
    parts += ["## Storage", STORAGE, "## Reading", READING]
    rows = [[f"`{name}`", export.words, f"`.{export.ending}`"] for name, export in EXPORTS.items()]
    parts += ["## Exports", "`ekfslam export city.h5 --format FORMAT` writes:"]
    parts += [markdown_table(["format", "holds", "ending"], rows, left=3)]
    return document("<!-- Written by docs/make_archive.py from the code: change it there. -->", *parts)


def _tree(doc: str | None) -> str:
    """The indented tree in the docstring of a module."""
    lines = inspect.cleandoc(doc or "").splitlines()
    begin = next(i for i, line in enumerate(lines) if line.startswith("    /"))
    length = next((i for i, line in enumerate(lines[begin:]) if line and not line.startswith("    ")), None)
    return "\n".join(lines[begin:][:length])


def _table(layout: hdf5.Layout, checked: bool = True) -> str:
    rows = []
    for item in layout:
        words = item.check.words.replace(f"from 0 to {1 << 62}", "from 0 on")
        checks = [words.replace(f"to {1 << 62}", "on")] if checked else []
        rows.append([f"`{item.name}`", ", ".join(item.dims) or "-", item.units, item.frame, *checks])
    headings = ["data set", "dimensions", "units", "frame", *(["values must"] if checked else [])]
    return markdown_table(headings, rows, left=5)


def _dimensions() -> str:
    layouts = (sequences.LAYOUT, sequences.OBSERVATIONS_LAYOUT, *archive.LAYOUTS.values(), study.LEVEL_LAYOUT)
    items = [item for layout in (*layouts, study.VARIANT_LAYOUT) for item in layout]
    names = dict.fromkeys(name for item in items for name in item.dims if not name.endswith(dimensions.SECOND))
    labels = {axis.name: ", ".join(axis.labels) for axis in dimensions.AXES.values()}
    rows = [[f"`{name}`", dimensions.meaning_of(name), labels.get(name, "")] for name in names]
    return f"{DIMENSIONS}\n\n{markdown_table(['dimension', 'along it', 'labels'], rows, left=3)}"


if __name__ == "__main__":
    files.write(PAGE, page())
