"""Give a trajectory of another program its covariance, from the recording that it was estimated from."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager
from pathlib import Path
from typing import get_args

from ekfslam import files
from ekfslam.cli.options import configured, declare, declare_run, open_data, print_warnings, require_ours, table
from ekfslam.data.readers.tum import read_trajectory
from ekfslam.data.trajectory import Moving
from ekfslam.evaluation.truth import with_truth_noise
from ekfslam.given import trajectory_covariance
from ekfslam.storage.archive import archive_image, require_same_origin
from ekfslam.storage.exports import Poses, contents, is_export

EXAMPLES = (
    "covariance drive.mat --trajectory orbslam.txt --frame camera --out orbslam.h5",
    "covariance builtin:city --trajectory mine.tum --out mine.h5",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    declare(parser, "data")
    parser.add_argument(
        "--trajectory", type=Path, required=True, metavar="FILE", help="TUM text: time tx ty tz qx qy qz qw"
    )
    parser.add_argument(
        "--frame", choices=get_args(Moving), default="body", help="moving frame of its poses (default: %(default)s)"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.h5", help="archive to write")
    declare_run(parser)


def claims(options: argparse.Namespace) -> AbstractContextManager[None]:
    return files.claimed(options.out, options.out.with_suffix(".txt"))


def command(options: argparse.Namespace) -> None:
    config = configured(options)
    sequence = with_truth_noise(open_data(options, options.data), config.truth)
    trajectory = read_trajectory(options.trajectory, frame=options.frame)
    text = options.out.with_suffix(".txt")
    for path in (options.out, text):
        files.require_writable(path)
    print_warnings(sequence)
    own, covered, result = trajectory_covariance(sequence, trajectory, config, options.trajectory.name)
    if not options.force:
        require_same_origin(options.out, covered)
    written = contents(Poses(own, covered.T_cam_imu), text, "tum", options.frame)
    for path in written:
        require_ours(options, path, lambda path: is_export(path, "tum"))
    files.write_all({options.out: archive_image(covered, {result.mode: result}), **written})
    print(table(covered, None, {result.mode: result}))
    a, b, of = (result.attributes[f"given_{key}"] for key in ("scale_position", "scale_rotation", "poses"))
    print(
        f"{of} poses of {len(result.time_s)} frames; standard deviations of the best estimate times {a:.2f} (position)"
    )
    print(f"and {b:.2f} (rotation), by the difference to it")
    for remark in result.remarks:
        print(f"note: {remark}")
    print(f"written to {options.out}, {', '.join(map(str, written))}")
