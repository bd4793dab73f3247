"""Kills at random moments: ``python tests/fuzz/kills.py --kills 50``.

Each command is started, killed and started again until it has been killed so often; in a third of the starts a second
one runs in the same folder. Whenever one ends by itself, what it has written must be, bit for bit, what an undisturbed
run writes, and nothing else may lie beside it. A second one may be refused, if it says so.
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
    "sweep": ["sweep", "s.toml", "--executor", "processes", "--workers", "2", "--out", "."],
    "workers": ["consistency", "--runs", "4", "--variants", "invariant", "--workers", "2", "--out", "."],
}
SWEEP = 'recordings = ["builtin:city?frames=40"]\nmodes = ["full", "smoothed"]\nseeds = [0, 1, 2]\n'
REFUSED = ("another run is writing there", "another command is writing or reading it")
TIMES = ("timing", "ms_per_frame", "total_s")  # data sets that differ from run to run


def archives(folder: Path) -> dict[str, bytes]:
    """Every data set below a folder but the times."""
    found = {}
    for path in folder.rglob("*.h5"):
        with h5py.File(path) as h5file:
            names: list[str] = []
            h5file.visititems(lambda name, item, names=names: names.append(name) if hasattr(item, "dtype") else None)
            for name in names:
                if not any(time in name for time in TIMES):
                    found[f"{path.relative_to(folder)}:{name}"] = h5file[name][()].tobytes()
    return found


def differing(found: dict[str, bytes], expected: dict[str, bytes]) -> list[str]:
    """Return the names of data sets that are missing, too many or other."""
    return sorted(name for name in found.keys() | expected.keys() if found.get(name) != expected.get(name))


def start(arguments: list[str], folder: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "ekfslam", *arguments]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def disturbed(arguments: list[str], folder: Path, longest: float, rng: np.random.Generator) -> tuple[int, int]:
    """Start one run or two, kill them at a random moment, and return the numbers of kills and of ends."""
    end, running, codes = time.monotonic() + rng.uniform(0.5, longest), [start(arguments, folder)], []
    if rng.random() < 1 / 3:
        time.sleep(rng.uniform(0.0, 0.5 * longest) * rng.integers(2))
        running.append(start(arguments, folder))
    for process in [running[i] for i in rng.permutation(len(running))]:
        try:
            process.wait(timeout=max(end - time.monotonic(), 0.01))
        except subprocess.TimeoutExpired:
            process.kill()
        words = process.communicate()[1]
        codes.append(process.returncode)
        is_refused = process.returncode == 2 and any(text in words for text in REFUSED) and len(running) == 2
        assert process.returncode in (0, -signal.SIGKILL) or is_refused, (arguments, process.returncode, words)
    return codes.count(-signal.SIGKILL), codes.count(0)


def fresh(path: Path, name: str) -> Path:
    """Return a new folder with the files that a command reads."""
    path.mkdir()
    (path / "s.toml").write_text(SWEEP)
    if name == "posterior":
        assert start(["run", WORLD, "--out", "full.h5"], path).wait() == 0
    return path


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
            whole, begin = fresh(Path(place) / "whole", name), time.monotonic()
            assert start(arguments, whole).wait() == 0
            longest, expected = time.monotonic() - begin, archives(whole)
            beside = sorted(str(path.relative_to(whole)) for path in whole.rglob("*"))
            kills = ends = rounds = 0
            folder = fresh(Path(place) / "0", name)
            while kills < options.kills:
                killed, ended = disturbed(arguments, folder, longest, rng)
                kills, ends = kills + killed, ends + ended
                if not ended:
                    continue
                assert not (wrong := differing(archives(folder), expected)), (name, wrong)
                if not killed:
                    assert sorted(str(path.relative_to(folder)) for path in folder.rglob("*")) == beside, name
                rounds += 1
                folder = fresh(Path(place) / str(rounds), name)
            assert start(arguments, folder).wait() == 0
            assert not (wrong := differing(archives(folder), expected)), (name, wrong)
            print(f"{name}: {kills} kills, {ends + 1} ends, all with the same bits and nothing else", flush=True)


if __name__ == "__main__":
    main()
