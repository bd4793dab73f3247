"""Reproduce Figures 1-5 of the report from its own recordings, next to full SLAM on the same data.

The report's system has two halves. Its trajectories (Figures 1 and 4) come from the prediction alone,

    T+ = exp(-tau u^) T,                                                                     (1)

its maps (Figures 2, 3 and 5) from one small EKF per landmark at those poses,

    K = P H^T (H P H^T + V)^-1,   m+ = m + K (z - M pi(q)),   P+ = (I - K H) P,

started at the first stereo observation. That is the mode `mapping-only`. Full SLAM, the further work that the report
proposes, runs on the same observations.

The recordings hold about three landmarks per frame, and velocities from the unit that also gives the truth. So dead
reckoning is hard to beat, and vision adds little; but the map changes, and poses and landmarks have a joint covariance.
`cam_T_imu` of these files holds the camera's position instead of the translation of a rigid transform. It is corrected
here, and the table shows the errors without the correction. The lateral velocity of these files is positive to the
right, against the description of its format. It is used as stored, as in the report.

    python experiments/reproduce_report.py [--data DIR] [--out DIR]
"""

from __future__ import annotations

import sys
from dataclasses import replace

from common import REPORT, argument_parser, has_recordings, open_recording, with_aligned

import ekfslam
from ekfslam import files
from ekfslam.evaluation.tables import document, markdown_table
from ekfslam.figures.maps import plot_landmark_arrows, plot_map
from ekfslam.figures.style import save_all
from ekfslam.filters.result import Landmarks
from ekfslam.stored import empty

# Recording, and the report's figures of its trajectory and of its landmarks.
FIGURES = (
    ("0027", "figure_1_trajectory_0027", "figure_2_landmarks_0027"),
    ("0042", "figure_1_trajectory_0042", "figure_3_landmarks_0042"),
    ("0020", "figure_4_trajectory_0020", "figure_5_landmarks_0020"),
)

# The report knows neither a gate nor tracks that jump; disparities below 2 px (of 1 px noise) are left out.
AS_REPORTED = ekfslam.Config().with_overrides(
    {
        "noise": {"model": "white"},
        "hygiene": {"restart_at_repeats": False, "min_disparity_sigma": 2.0**0.5, "disparity_jump_sigma": 0.0},
        "filter": {"gate_probability": 1.0, "split_after": 0},
    }
)


def main() -> int:
    parsed = argument_parser(__doc__, "report", data=True).parse_args()
    if not has_recordings(parsed.data, *REPORT):
        return 0
    rows = []
    for name, trajectory_figure, landmark_figure in FIGURES:
        file = f"ece276a/{name}.npz"
        comparison = ekfslam.compare(open_recording(parsed.data, file, lateral="as-stored"))
        comparison.save(parsed.out / name)
        print(comparison.table)

        results, truth = comparison.results, comparison.sequence.truth
        as_reported = ekfslam.run(comparison.sequence, "mapping-only", AS_REPORTED)
        paths = {mode: replace(results[mode], landmarks=empty(Landmarks)) for mode in ("dead-reckoning", "full")}
        figures = {
            trajectory_figure: plot_map(paths, truth),
            landmark_figure: plot_landmark_arrows(as_reported, truth),
            f"{landmark_figure}_full": plot_landmark_arrows(results["full"], truth),
        }
        save_all(parsed.out, figures, packed=True)

        as_stored = open_recording(parsed.data, file, extrinsics="as-stored", lateral="as-stored")
        stored = ekfslam.compare(as_stored, ["dead-reckoning"]).summary["modes"]["dead-reckoning"]
        modes = comparison.summary["modes"]
        rows.append([name, *map(with_aligned, (modes["dead-reckoning"], stored, modes["full"]))])

    text = document(
        "ATE in metres (in brackets: aligned), against KITTI odometry; lateral velocity as stored, as in the report:",
        markdown_table(["recording", "dead reckoning", "extrinsics as stored", "full SLAM"], rows),
    )
    files.write(parsed.out / "summary.md", text)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
