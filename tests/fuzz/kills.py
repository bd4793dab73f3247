"""Kills at random moments: ``python tests/fuzz/kills.py --kills 50``.

Each command is started, killed and started again until it has been killed so often; whenever it ends by itself, what
it has written must be, bit for bit, what an undisturbed run writes, and nothing else may lie beside it.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np

WORLD = "builtin:city?frames=150"
COMMANDS = {
    "run": ["run", WORLD, "--out", "a.h5"],
    "compare": ["compare", WORLD, "--out", "."],
    "study": ["consistency", "--runs", "4", "--variants", "invariant", "--executor", "serial", "--out", "."],
    "posterior": ["posterior", "full.h5"],
}


def archives(folder: Path) -> dict[str, bytes]:
    """Every data set below a folder but the times."""
    found = {}
    for path in folder.rglob("*.h5"):
        with h5py.File(path) as h5file:
            names: list[str] = []
            h5file.visititems(lambda name, item, names=names: names.append(name) if hasattr(item, "dtype") else None)
            for name in names:
                if "timing" not in name:
                    found[f"{path.relative_to(folder)}:{name}"] = h5file[name][()].tobytes()
    return found


def start(arguments: list[str], folder: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-m", "ekfslam", *arguments], cwd=folder, stdout=subprocess.DEVNULL)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", nargs="+", default=list(COMMANDS), choices=list(COMMANDS))
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    for name in options.commands:
        arguments = COMMANDS[name]
        with tempfile.TemporaryDirectory() as place:

            def fresh(folder: str, place: str = place, name: str = name) -> Path:
                path = Path(place) / folder
                path.mkdir()
                if name == "posterior":
                    assert start(["run", WORLD, "--out", "full.h5"], path).wait() == 0
                return path

            whole = fresh("whole")
            begin = time.monotonic()
            assert start(arguments, whole).wait() == 0
            longest, expected = time.monotonic() - begin, archives(whole)
            beside = sorted(str(path.relative_to(whole)) for path in whole.rglob("*"))
            kills = ended = rounds = 0
            folder = fresh("0")
            while kills < options.kills:
                process = start(arguments, folder)
                try:
                    code = process.wait(timeout=rng.uniform(0.5, longest))
                except subprocess.TimeoutExpired:
                    process.kill()
                    code = process.wait()
                if code == -signal.SIGKILL:
                    kills += 1
                    continue
                assert code == 0, (name, code)
                ended += 1
                assert archives(folder) == expected, name
                assert sorted(str(path.relative_to(folder)) for path in folder.rglob("*")) == beside, name
                rounds += 1
                folder = fresh(str(rounds))
            assert start(arguments, folder).wait() == 0
            assert archives(folder) == expected, name
            print(f"{name}: {kills} kills, {ended + 1} ends, all with the same bits and nothing else", flush=True)


if __name__ == "__main__":
    main()
