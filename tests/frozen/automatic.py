"""Freezes results of the automatic model, for later versions to be compared with.

``python tests/frozen/automatic.py`` writes ``automatic.npz``: the first frames of every recording that is present, and
the built-in worlds, filtered and smoothed with the default configuration. The factor on track errors is given, since
finding it is no part of the filter. The module `make` says what is kept of a result. The program that froze them was
corrected in one place: its smoother mixed two maps when it chose where landmarks start.
"""

from __future__ import annotations

import sys
from pathlib import Path

from frozen.make import DATA, HERE, Frozen, of_result, write

from ekfslam import Config, Sequence, open_sequence, run, smooth

FRAMES = 60
CONFIG = Config().with_overrides({"noise": {"track_scale": 1.0}})
FILE = HERE / "automatic.npz"
WORLDS = ("builtin:city", "builtin:loop", "builtin:city?seed=3", "builtin:loop?seed=1")
RECORDINGS = (
    "ece276a/0020.npz",
    "ece276a/0022_dense_noisy.npz",
    "ece276a/0027.npz",
    "ece276a/0027_dense_noisy.npz",
    "ece276a/0042.npz",
    "utias/2011_09_26_drive_0001_sync_KLT.mat",
    "utias/2011_09_26_drive_0009_sync_KLT.mat",
    "utias/2011_09_26_drive_0027_sync_KLT.mat",
    "utias/2011_09_26_drive_0036_sync_KLT.mat",
    "utias/2011_09_30_drive_0020_sync_KLT.mat",
    "utias/2011_09_30_drive_0027_sync_KLT.mat",
    "utias/2011_10_03_drive_0042_sync_KLT.mat",
)


def of_source(name: str, source: str | Path) -> Frozen:
    """Return what is kept of the filtered and the smoothed run; nothing of a recording can be read from it."""
    sequence: Sequence = open_sequence(source)[:FRAMES]
    result = run(sequence, "full", CONFIG)
    runs = {"full": result, "smoothed": smooth(result)}
    return {
        f"{name}: {mode}: {key}": value
        for mode, found in runs.items()
        for key, value in of_result(found, numbers=False).items()
    }


def main() -> int:
    """Write the file."""
    frozen: Frozen = {}
    for name in WORLDS:
        frozen |= of_source(name, name)
    for name in RECORDINGS:
        if (path := DATA / name).exists():
            frozen |= of_source(name, path)
    write(FILE, frozen)
    return 0


if __name__ == "__main__":
    sys.exit(main())
