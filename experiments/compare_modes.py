"""Dead reckoning, independent landmark mapping and full SLAM on the embedded worlds.

The report localises with the prediction alone,

    T+ = exp(-tau u^) T,                                                                     (1)

and maps every landmark by a separate Kalman filter that takes those poses as exact. Pose errors therefore go straight
into the map, and images never correct the pose. Full SLAM keeps pose and landmarks in one state, whose covariance holds
their correlations,

    S = H P H^T + V,   (xi, d) = P H^T S^-1 r,   P -= P H^T S^-1 H P,                        (6)

so that an observed landmark pulls the pose, and the pose pulls every landmark in view.

`city` is a drive of 100 s through streets, with 3 % gross outliers and noisy velocities, so dead reckoning drifts; no
landmark comes back. `loop` drives three times round a circle, so landmarks come back, and the filter keeps them all.

    python experiments/compare_modes.py [--out DIR] [--workers N]
"""

from __future__ import annotations

from common import argument_parser, swept

from ekfslam import open_sequence
from ekfslam.reports import compare_all
from ekfslam.studies.executors import open_executor
from ekfslam.studies.sweep import Recording, Sweep

WORLDS = ("city", "loop")


def main() -> None:
    parsed = argument_parser(__doc__, "demo", workers=True).parse_args()
    sequences = {parsed.out / world: open_sequence(f"builtin:{world}") for world in WORLDS}
    with open_executor("processes", parsed.workers) as executor:
        for said in compare_all(sequences, executor):
            print(said)

    # The variants differ in the linearisation alone. The standard one gains information about the direction that the
    # rig points to in the world, which no measurement holds: its pose NEES (6 expected) tells.
    worlds = tuple(Recording(f"builtin:{world}", world) for world in WORLDS)
    table = swept("compare_modes", Sweep(worlds, variants=("invariant", "standard")), parsed.workers)
    print(table.markdown(["pose_nees_mean"]))


if __name__ == "__main__":  # the worker processes import this file
    main()
