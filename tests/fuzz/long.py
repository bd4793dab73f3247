"""As many hostile inputs as one likes: ``python tests/fuzz/long.py --inputs 20000``.

Inputs run in processes that are replaced when they die, so that a crash of the interpreter is a finding like any other.
"""

from __future__ import annotations

import argparse
import collections
import json
import os
import pickle
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# ruff: noqa: E402 (the paths above come first)
from generators import GENERATORS, Valid, case_of
from oracle import verdict

from ekfslam.figures import style

MOST_BYTES = 2 << 30
DRAWN = 20  # one of so many inputs draws its figures really


def work(prepared: Path, begin: int, end: int) -> None:
    """Try inputs, one line of JSON each before and after."""
    valid = pickle.loads(prepared.read_bytes())  # our own, of a moment ago
    true_png = style.png
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(begin, end):
            print(json.dumps({"seed": seed}), flush=True)
            for module in [module for name, module in sys.modules.items() if name.startswith("ekfslam")]:
                if hasattr(module, "png"):
                    module.png = true_png if seed // len(GENERATORS) % DRAWN == 0 else lambda *_: b""
            case, start = case_of(valid, seed), time.monotonic()
            found = verdict(case, Path(folder) / "work")
            used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
            if used > MOST_BYTES:
                found = found or f"{used / 1e9:.2f} GB"
            seconds = time.monotonic() - start
            line = {"seed": seed, "found": found, "seconds": seconds, "bytes": used, "arguments": case.arguments}
            print(json.dumps(line), flush=True)
            if used > MOST_BYTES:
                return


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=20_000)
    parser.add_argument("--begin", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after so many")
    parser.add_argument("--worker", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        work(Path(options.worker[0]), int(options.worker[1]), int(options.worker[2]))
        return
    tried, slowest, most, findings = 0, 0.0, 0, collections.Counter[str]()
    seconds = collections.Counter[str]()
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        prepared = Path(folder) / "valid"
        prepared.write_bytes(pickle.dumps(Valid.prepared()))
        seed, end = options.begin, options.begin + options.inputs
        while seed < end and time.monotonic() - started < options.seconds:
            command = [sys.executable, __file__, "--worker", str(prepared), str(seed), str(min(seed + 500, end))]
            worker = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
            assert worker.stdout is not None
            begun = None
            for text in worker.stdout:
                try:
                    line = json.loads(text)
                except ValueError:
                    continue
                if "found" not in line:
                    begun = line["seed"]
                    continue
                begun, seed, tried = None, line["seed"] + 1, tried + 1
                seconds[GENERATORS[line["seed"] % len(GENERATORS)].__name__] += line["seconds"]
                slowest, most = max(slowest, line["seconds"]), max(most, line["bytes"])
                if line["found"]:
                    findings[line["found"].strip().splitlines()[-1][:100]] += 1
                    family = GENERATORS[line["seed"] % len(GENERATORS)].__name__
                    print(f"seed {line['seed']} ({family}) {line['arguments']}\n{line['found']}", flush=True)
            code = worker.wait()
            if begun is not None:
                findings[f"died: {code}"] += 1
                print(f"seed {begun}: the interpreter died with {code}", flush=True)
                seed, tried = begun + 1, tried + 1
    took = time.monotonic() - started
    print(f"{tried} inputs in {took:.0f} s, slowest {slowest:.1f} s, largest {most / 1e9:.2f} GB")
    print(", ".join(f"{name} {total:.0f} s" for name, total in seconds.most_common()))
    print("\n".join(f"{count:6d} {what}" for what, count in findings.most_common()) or "no finding")


if __name__ == "__main__":
    main()
