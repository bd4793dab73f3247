"""Long live run: messages with drops, repeats, swaps and jumps, by three threads; memory and time a message stay flat.

    python tests/fuzz/live.py [MESSAGES]

Velocities, images and queries of the pose come from a thread each. At the end the state must be that of a clean replay
of the messages that were accepted, which are kept for up to 100 000. `tests/test_live_robust.py` has a short run.
"""

from __future__ import annotations

import resource
import sys
import threading
import time
from itertools import islice
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from test_live_robust import assert_same, disturbed, new, sent

from ekfslam.errors import EkfslamError

DELAY_S, BLOCK, MOST_REPLAYED = 0.6, 25, 100_000


def main(count: int) -> None:
    live = new(delay_s=DELAY_S, log_frames=1000)
    stream = disturbed(count * 5 // 6, np.random.default_rng(0))
    block, accepted, done, spent = list(islice(stream, BLOCK)), [], 0, 0.0

    def proceed() -> None:
        nonlocal block, done
        done += len(block)
        block = list(islice(stream, BLOCK))
        if done % (BLOCK * max(count // 10 // BLOCK, 1)) == 0:
            report()

    def report() -> None:
        nonlocal spent
        memory, now = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024, time.process_time()
        print(f"{done}: {memory} MB, {1e6 * (now - spent) / (count // 10):.0f} us a message", flush=True)
        spent = now

    turns = threading.Barrier(3, proceed)  # threads stay within the delay of each other

    def run(kind: str) -> None:
        while block:
            for i, (name, arguments, t) in enumerate(block):
                if kind == "pose" and i % 10 == 0 and live.time_s is not None:
                    live.pose()
                elif name == kind:
                    try:
                        getattr(live, name)(*arguments, t)
                    except EkfslamError:
                        continue
                    if count <= MOST_REPLAYED:
                        accepted.append((name, arguments, t))
            turns.wait()

    threads = [threading.Thread(target=run, args=(kind,)) for kind in ("predict", "update", "pose")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    live.flush()
    print(live.counts)
    if count <= MOST_REPLAYED:
        replay = sent(new(delay_s=DELAY_S, log_frames=1000), sorted(accepted, key=lambda message: message[2]))
        assert_same(live, replay)
        print("state: that of a clean replay")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20_000)
