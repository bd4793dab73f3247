"""Track features through stereo images and write them as a recording."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager
from pathlib import Path

from ekfslam import files
from ekfslam.cli.options import PLACES, config_file, declare, require_ours
from ekfslam.data.imu import with_inertial_files
from ekfslam.data.opening import attach_truth, open_images
from ekfslam.data.readers.hdf5 import is_recording_of, sequence_image
from ekfslam.data.velocities import attach_velocities
from ekfslam.errors import UnknownFormatError
from ekfslam.figures.style import png
from ekfslam.figures.tracks import plot_tracks
from ekfslam.frontend.track import track

EXAMPLES = ("track sequences/06 --out 06.h5", "track sequences/06 --truth poses/06.txt --features 250 --out 06.h5")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "data", metavar="SOURCE", help="folder with images of a pair or of one camera, and their calibration"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.h5", help="recording to write")
    declare(parser, "--force", *PLACES, "--camera")
    declare(parser, "--config", help="settings in a table [front_end]")
    parser.add_argument("--features", type=int, metavar="N", help="features wanted in a frame")


def claims(options: argparse.Namespace) -> AbstractContextManager[None]:
    return files.claimed(options.out, options.out.with_suffix(".png"))


def command(options: argparse.Namespace) -> None:
    config = config_file(options).with_overrides({"front_end": {"features": options.features}})
    files.require_writable(options.out)
    recording = open_images(
        options.data, lateral=options.lateral, topics=options.topics, calibration=options.calibration
    )
    if recording is None:
        raise UnknownFormatError(f"{options.data}: there are no images that a source knows")
    recording = recording.of_left_camera if options.camera == "left" else recording
    if options.velocities is not None:
        frame, lateral = options.velocity_frame, options.lateral
        recording = attach_velocities(recording, options.velocities, velocity_frame=frame, lateral=lateral)
    recording = with_inertial_files(recording, options.imu, options.imu_noise)
    sequence, report = track(recording, config.front_end)
    if options.truth is not None:
        sequence = attach_truth(sequence, options.truth)
    require_ours(options, options.out, lambda path: is_recording_of(path, sequence))
    picture = options.out.with_suffix(".png")
    drawn = png(plot_tracks(recording, sequence, report))
    files.write_all({options.out: sequence_image(sequence), picture: drawn})
    for line in report.lines:
        print(line)
    print(f"{len(sequence)} frames written to {options.out}, drawn in {picture}")
