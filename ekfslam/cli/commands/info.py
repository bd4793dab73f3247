"""Show the content of a recording or an archive, and its defects."""

from __future__ import annotations

import argparse
import dataclasses

from ekfslam import hdf5
from ekfslam.cli.commands.doctor import print_build
from ekfslam.cli.options import DATA, declare, open_data, table
from ekfslam.config import Config
from ekfslam.data.interpolation import stretches
from ekfslam.data.readers.simulated import BUILTIN
from ekfslam.data.sequence import Sequence
from ekfslam.data.tracks import inspect_tracks
from ekfslam.evaluation.consistency import interpolated_frames
from ekfslam.evaluation.sanity import inspect_sequence
from ekfslam.evaluation.sources import compare_sources, in_words
from ekfslam.evaluation.truth import with_truth_noise
from ekfslam.filters.result import UNUSED
from ekfslam.provenance import in_words as made_by
from ekfslam.reports import details
from ekfslam.resolve import noise_of_velocities, resolve
from ekfslam.storage.archive import FORMAT as ARCHIVE_FORMAT
from ekfslam.storage.archive import read_archive

EXAMPLES = ("info 0027.npz", "info results/local/city/archive.h5")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    declare(parser, "data", *DATA)
    parser.add_argument(
        "--build", action="store_true", help="show engine, libraries and threads of this installation instead"
    )


def command(options: argparse.Namespace) -> None:
    if options.build:
        print_build()
    elif _is_archive(options.data):
        _print_archive(options.data)
    else:
        given = Config().with_overrides({"truth": dict(options.truth_noise)})
        sequence = with_truth_noise(open_data(options, options.data), given.truth)
        _print_recording(sequence)
        _print_findings(sequence)


def _print_archive(path: str) -> None:
    archive = read_archive(path)
    print(f"{path}: archive of {archive.name}, {len(archive.time_s)} frames, from {archive.source}")
    print(table(archive, None, archive.results))
    print(details(archive.results))
    made: dict[str, list[str]] = {}
    for mode, result in archive.results.items():
        made.setdefault(made_by(result.attributes), []).append(mode)
    for words, modes in made.items():
        print(f"{', '.join(modes)}: made by {words or 'another program'}")
    for mode, result in archive.results.items():
        for remark in result.remarks:
            print(f"{mode}: note: {remark}")


def _print_recording(sequence: Sequence) -> None:
    camera, truth = sequence.camera, sequence.truth
    tracks = inspect_tracks(sequence.observations, sequence.twist)
    print(f"name          {sequence.name} ({sequence.source})")
    print(f"frames        {len(sequence)} in {sequence.time_s[-1] - sequence.time_s[0]:.1f} s")
    print(f"tracks        {tracks.tracks}, {len(sequence.observations)} observations")
    print(
        f"camera        fu {camera.fu_px:g} fv {camera.fv_px:g} cu {camera.cu_px:g} cv {camera.cv_px:g} px, "
        f"baseline {camera.baseline_m:g} m"
    )
    for samples in sequence.inputs:
        print(f"inputs        {samples.text}")
    print(_noise_line(sequence))
    known = "none" if truth is None else f"{len(truth.frame)} poses, {len(truth.landmark)} landmarks"
    print(f"truth         {known}")
    if truth is not None:
        print(f"truth noise   {'none stated: taken as exact' if truth.noise is None else truth.noise.text}")
    gaps = ", ".join(f"{begin} to {end}" for begin, end in stretches(sequence.interpolated))
    print(f"gaps          {f'intervals {gaps} are interpolated' if gaps else 'none'}")
    drawn = [] if truth is None else stretches(interpolated_frames(truth, len(sequence)))
    for begin, end in drawn:
        print(f"truth gap     the true poses of frames {begin} to {end} lie on a line: interpolated, in no NEES")
    for key, value in sequence.attributes.items():
        if not key.startswith("right_camera_"):  # a note says it with units
            print(f"{key:13s} {value:.4g}" if isinstance(value, float) else f"{key:13s} {value}")


def _noise_line(sequence: Sequence) -> str:
    if not sequence.has_velocities and sequence.inertial is not None:
        return "velocities    not measured: inertial samples move the state"
    if not sequence.has_velocities:
        return "velocities    none: motion is a random walk started by stereo odometry"
    if sequence.noise is None:
        v, w = noise_of_velocities(sequence).texts
        return f"noise         not stated; white noise of the velocities, from the data: {v} m/s, {w} rad/s"
    return f"noise         twist {sequence.noise.twist_std} (m/s, rad/s), pixels {sequence.noise.pixel_std_px} px"


def _print_findings(sequence: Sequence) -> None:
    """Print notes, warnings, and the model that `resolve` chooses."""
    for note in sequence.notes:
        print(f"note          {note}")
    sanity = inspect_sequence(sequence)
    for line in sanity.figures:
        print(f"sanity        {line}")
    for line in sanity.warnings:
        print(f"warning       {line}")
    for line in () if sanity.warnings else in_words(compare_sources(sequence), sequence.time_s):
        print(f"sources       {line}")
    problem = resolve(sequence)
    assert problem.hygiene is not None
    if (found := problem.account.get("found_tracks")) is not None:
        print(f"tracks        noise not stated; from the data: {found}")
    for name in ("odometry", "beside"):
        if name in problem.account:
            print(f"{name:13s} {problem.account[name]}")
    if UNUSED in problem.account:
        print(f"warning       {problem.account[UNUSED]}")
    if "inertial_start" in problem.account:
        print(f"densities     {problem.account['inertial_noise']}")
        print(f"start         {problem.account['inertial_start']}")
    print(f"filter        {problem.account['engine']}")
    for line in problem.lines:
        print(f"state         {line}")
    for line in problem.decisions:
        print(f"resolved      {line}")
    for line in problem.hygiene.lines(dataclasses.asdict(problem.config.hygiene)):
        print(f"hygiene       {line}")


def _is_archive(data: str) -> bool:
    return not data.startswith(BUILTIN) and hdf5.format_of(data) == ARCHIVE_FORMAT
