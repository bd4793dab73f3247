"""The command line: every subcommand is a thin call of the function of the same name in Python."""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from collections.abc import Callable, Mapping
from collections.abc import Sequence as SequenceType
from contextlib import suppress
from pathlib import Path
from typing import get_args

from ekfslam import __version__, files, hdf5
from ekfslam.config import MODES, VARIANTS, Config, Kernel, Linearisation, NoiseModel
from ekfslam.data.interpolation import stretches
from ekfslam.data.readers import BUILTIN, open_sequence
from ekfslam.data.readers.hdf5 import is_recording_of, sequence_image
from ekfslam.data.readers.text import first_line
from ekfslam.data.sequence import Sequence
from ekfslam.data.simulate import builtin
from ekfslam.data.tracks import inspect_tracks
from ekfslam.errors import ArchiveError, ConfigError, EkfslamError, WriteError
from ekfslam.evaluation.summary import compare_table, summarise
from ekfslam.evaluation.truth import with_truth_noise
from ekfslam.figures.posterior import draw_posterior_figures
from ekfslam.figures.run import save_figures
from ekfslam.figures.style import older_figures, pngs
from ekfslam.filters.result import Result
from ekfslam.limits import DEFAULT_GB, reading_up_to
from ekfslam.models.build import build
from ekfslam.models.noise import velocity_noise
from ekfslam.names import components, printable
from ekfslam.reports import check, check_consistency, compare, remove_figures
from ekfslam.runner import run
from ekfslam.smoother.posterior import posterior, smooth
from ekfslam.storage.archive import FORMAT as ARCHIVE_FORMAT
from ekfslam.storage.archive import (
    Archive,
    add_result,
    archive_image,
    open_result,
    read_archive,
    require_same_origin,
    trajectory_text,
    truth_text,
)
from ekfslam.storage.checkpoint import Checkpoints
from ekfslam.studies.study import LEVELS, STUDY_VARIANTS, Study, levels_of
from ekfslam.studies.tuning import toml_heading, tune

DEFAULT_DATA = "builtin:city"
TRUTH = "truth"  # what `export` takes beside the modes


def main(arguments: SequenceType[str] | None = None) -> int:
    """Entry point of ``ekfslam``; returns the exit code: 0, or 2 after one line for a user's error."""
    options = _parser().parse_args(arguments)
    command: Callable[[argparse.Namespace], None] = options.command
    _prepare_output()
    try:
        with reading_up_to(options.read_limit):
            command(options)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of our output (head, less) has gone; that is not an error.
        _forget_output()
    except (EkfslamError, OSError, MemoryError) as error:
        _forget_output()
        message = printable(" ".join(str(error).split())) or "there is not enough memory"
        print(f"ekfslam: error: {message}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("ekfslam: interrupted", file=sys.stderr)
        return 130
    return 0


def _prepare_output() -> None:
    """Let printing work where there is no output, and where its encoding lacks a character of a name."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the caller
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115 (open until the exit)
        reconfigure = getattr(getattr(sys, name), "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="backslashreplace")


def _forget_output() -> None:
    """Keep the exit from flushing into an output that is full or gone."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ekfslam",
        description="Visual-inertial EKF-SLAM: dead reckoning, independent landmark mapping, and full joint SLAM.",
        epilog="DATA is a recording (ECE 276A .npz, UTIAS .mat, ekfslam .h5) or a simulated world: "
        "builtin:city, builtin:loop, builtin:city?seed=3.",
    )
    parser.add_argument("--version", action="version", version=f"ekfslam {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(
        name: str, command: Callable[[argparse.Namespace], None], summary: str, *examples: str
    ) -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name,
            help=summary,
            description=summary[0].upper() + summary[1:] + ".",
            epilog="examples:\n" + "\n".join(f"  ekfslam {example}" for example in examples),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        sub.set_defaults(command=command)
        sub.add_argument(
            "--read-limit",
            type=float,
            default=DEFAULT_GB,
            metavar="GB",
            help="how many gigabytes of numbers a file may hold; more is refused unread (default: %(default)s)",
        )
        return sub

    sub = add(
        "compare",
        _compare,
        "run several modes on the same data and compare them",
        "compare",
        "compare 0027.npz --truth poses/07.txt --out results/local",
        "compare a.mat b.mat --modes dead-reckoning full --sigma-v 0.5 --sigma-w 0.05",
    )
    sub.add_argument("data", nargs="*", default=[DEFAULT_DATA], metavar="DATA", help=f"default: {DEFAULT_DATA}")
    sub.add_argument("--modes", nargs="+", choices=MODES, default=list(MODES), metavar="MODE", help=", ".join(MODES))
    sub.add_argument("--out", type=Path, default=Path("results/local"), metavar="DIR", help="default: %(default)s")
    _add_force(sub)
    _add_resume(sub)
    _add_data_options(sub)
    _add_filter_options(sub)

    sub = add(
        "run",
        _run,
        "run one mode and write its result archive",
        "run --mode full --variant invariant --out city.h5",
        "run drive.mat --mode mapping-only --config noise.toml --out drive.h5",
    )
    sub.add_argument("data", nargs="?", default=DEFAULT_DATA, metavar="DATA", help=f"default: {DEFAULT_DATA}")
    sub.add_argument("--mode", choices=MODES, default="full", help="default: %(default)s")
    sub.add_argument("--out", type=Path, required=True, metavar="FILE.h5", help="archive to write")
    _add_force(sub)
    _add_resume(sub)
    _add_data_options(sub)
    _add_filter_options(sub)

    sub = add(
        "consistency",
        _consistency,
        "simulate many drives and see whether the covariances hold what they promise",
        "consistency --runs 20",
        "consistency --level all --variants invariant standard fej --out results/local/all",
        "consistency --runs 1000 --executor tls://scheduler:8786",
    )
    sub.add_argument("--runs", type=int, default=50, metavar="N", help="of each level (default: %(default)s)")
    sub.add_argument(
        "--level",
        nargs="+",
        choices=(*LEVELS, "all"),
        default=["mid"],
        metavar="NAME",
        help=f"{', '.join(LEVELS)}, or all (default: mid)",
    )
    sub.add_argument(
        "--variants",
        nargs="+",
        choices=STUDY_VARIANTS,
        default=list(VARIANTS),
        metavar="VARIANT",
        help=f"{', '.join(STUDY_VARIANTS)} (default: {' '.join(VARIANTS)})",
    )
    sub.add_argument("--seed", type=int, default=0, metavar="N", help="default: %(default)s")
    sub.add_argument("--workers", type=int, metavar="N", help="processes (default: one per core)")
    sub.add_argument(
        "--executor",
        default="processes",
        metavar="SPEC",
        help="processes (default), serial, tls://HOST:PORT (a Dask cluster, with the certificates of Dask's "
        "configuration distributed.comm.tls), dask://HOST:PORT (without: whoever reaches that port runs programs as "
        "you; for networks of your own only), or mpi",
    )
    sub.add_argument(
        "--out",
        type=Path,
        default=Path("results/local/consistency"),
        metavar="DIR",
        help="default: %(default)s; an interrupted study there goes on",
    )

    sub = add(
        "simulate",
        _simulate,
        "write a simulated world as a recording",
        "simulate city --out city.h5",
        "simulate 'loop?seed=7' --out loop.h5",
    )
    sub.add_argument("world", nargs="?", default=DEFAULT_DATA, metavar="WORLD", help=f"default: {DEFAULT_DATA}")
    sub.add_argument("--out", type=Path, required=True, metavar="FILE.h5", help="recording to write")
    _add_force(sub)

    sub = add(
        "info",
        _info,
        "say what is in a recording or an archive, and what is wrong with it",
        "info 0027.npz",
        "info results/local/city/archive.h5",
    )
    sub.add_argument("data", nargs="?", default=DEFAULT_DATA, metavar="FILE", help=f"default: {DEFAULT_DATA}")
    _add_data_options(sub)

    sub = add(
        "tune",
        _tune,
        "find the noise of a recording from its innovations, without truth",
        "tune drive.mat",
        "tune drive.mat --out noise.toml && ekfslam run drive.mat --config noise.toml --out drive.h5",
    )
    sub.add_argument("data", nargs="?", default=DEFAULT_DATA, metavar="DATA", help=f"default: {DEFAULT_DATA}")
    sub.add_argument(
        "--out", type=Path, metavar="FILE.toml", help="write what was found, for --config of run and compare"
    )
    _add_force(sub)
    sub.add_argument("--config", type=Path, metavar="FILE.toml", help="settings of the filter; sigmas are ignored")
    sub.add_argument(
        "--model",
        choices=[model for model in get_args(NoiseModel) if model != "tuned"],
        help="auto: sigmas of the automatic model; white: of white noise alone (default: as configured)",
    )
    sub.add_argument("--drift", action="store_true", help="look for the drift of the tracks, too")
    _add_data_options(sub)

    sub = add("plot", _plot, "draw the figures of an archive", "plot city.h5", "plot city.h5 --out figures")
    sub.add_argument("archive", type=Path, metavar="ARCHIVE")
    sub.add_argument("--out", type=Path, metavar="DIR", help="default: the folder of the archive")

    sub = add(
        "posterior",
        _posterior,
        "smooth a full run: write the posterior over all poses and landmarks into its archive",
        "posterior city.h5",
        "posterior city.h5 --linearisation filtered",
        "posterior city.h5 --kernel cauchy",
    )
    sub.add_argument("archive", type=Path, metavar="ARCHIVE", help="as written by run or compare, mode full")
    sub.add_argument(
        "--linearisation",
        choices=get_args(Linearisation),
        help="map: at the maximum a posteriori; filtered: where the filter linearised (default: as configured, map)",
    )
    sub.add_argument("--kernel", choices=get_args(Kernel), help="robust kernel of map (default: as configured, huber)")
    sub.add_argument("--out", type=Path, metavar="DIR", help="for the figures; default: the folder of the archive")

    sub = add(
        "check",
        _check,
        "say whether the covariance of a run is honest, without truth, from its innovations",
        "check city.h5",
        "check drive.h5 --out figures",
    )
    sub.add_argument("archive", type=Path, metavar="ARCHIVE", help="as written by run or compare, mode full")
    sub.add_argument("--mode", default="full", help="run in the archive (default: %(default)s)")
    sub.add_argument("--out", type=Path, metavar="DIR", help="for check.md, .json, .png; default: that of the archive")

    sub = add(
        "export",
        _export,
        "write a trajectory of an archive, estimated or true, as text",
        "export city.h5 --format tum",
        "export city.h5 --format tum --mode truth",
        "export city.h5 --format kitti --mode dead-reckoning --out poses.txt",
    )
    sub.add_argument("archive", type=Path, metavar="ARCHIVE")
    sub.add_argument("--format", choices=("tum", "kitti"), required=True, help="poses of the IMU in world")
    sub.add_argument(
        "--mode", help=f"any in the archive (default: full, or else its first), or {TRUTH} for the true poses"
    )
    sub.add_argument("--out", type=Path, metavar="FILE", help="default: ARCHIVE with .MODE.FORMAT.txt")
    _add_force(sub)
    return parser


def _add_resume(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on where an interrupted run of the same stopped, to the same bits; its checkpoint lies beside --out",
    )


def _add_force(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--force", action="store_true", help="replace a file that is no earlier result of the same")


def _add_data_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--truth", type=Path, metavar="FILE", help="true poses: KITTI odometry or TUM text")
    parser.add_argument(
        "--extrinsics",
        choices=("corrected", "as-stored"),
        default="corrected",
        help="how to read cam_T_imu of .npz recordings (default: %(default)s)",
    )
    parser.add_argument(
        "--lateral",
        choices=("corrected", "as-stored"),
        default="corrected",
        help="sign of the lateral velocity of KITTI, stored positive to the right (default: %(default)s)",
    )
    parser.add_argument(
        "--truth-noise",
        nargs="+",
        type=_setting,
        default=[],
        metavar="KEY=VALUE",
        help="standard deviations of the truth in place of those that its format states: roll_deg, pitch_deg, yaw_deg, "
        "first_position_m, stamp_s, position_m, attitude_deg",
    )


def _setting(text: str) -> tuple[str, float]:
    key, _, value = text.partition("=")
    return key, float(value)  # argparse reports a ValueError


def _add_filter_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("settings", "flags override the file, the file overrides the defaults")
    group.add_argument(
        "--config",
        type=Path,
        metavar="FILE.toml",
        help="tables [noise], [hygiene], [filter], [calibration], [posterior], [truth]; what `tune` writes is one",
    )
    group.add_argument("--variant", choices=VARIANTS, help="linearisation of the joint filter")
    group.add_argument("--iterations", type=int, metavar="N", help="Gauss-Newton iterations of an update")
    group.add_argument("--retire", choices=("auto", "unseen", "never"), help="when landmarks leave the state")
    group.add_argument("--sigma-v", type=float, metavar="M_S", help="linear velocity noise per sample, m/s")
    group.add_argument("--sigma-w", type=float, metavar="RAD_S", help="angular velocity noise per sample, rad/s")
    group.add_argument("--sigma-px", type=float, metavar="PX", help="pixel noise")


def _config(options: argparse.Namespace) -> Config:
    config = Config.from_toml(options.config) if options.config else Config()
    return config.with_overrides(
        {
            "noise": {
                "sigma_v_m_s": options.sigma_v,
                "sigma_w_rad_s": options.sigma_w,
                "sigma_px": options.sigma_px,
            },
            "filter": {"variant": options.variant, "iterations": options.iterations, "retire": options.retire},
            "truth": dict(options.truth_noise),
        }
    )


def _open(options: argparse.Namespace, data: str) -> Sequence:
    return open_sequence(data, extrinsics=options.extrinsics, lateral=options.lateral, truth=options.truth)


def _compare(options: argparse.Namespace) -> None:
    config = _config(options)
    if options.truth and len(options.data) > 1:
        raise ConfigError("--truth belongs to one recording, but several are given; compare them one by one")
    # Everything is read before anything is run: a mistyped last name should not cost the first hour.
    sequences = [_open(options, data) for data in options.data]
    # Recordings of the same name do not overwrite each other.
    folders = [options.out / name for name in components(sequence.name for sequence in sequences)]
    for sequence, folder in zip(sequences, folders, strict=True):
        files.require_writable(folder / "archive.h5")
        if not options.force:
            require_same_origin(folder / "archive.h5", sequence)
    for sequence, folder in zip(sequences, folders, strict=True):
        for note in sequence.notes:
            print(f"{sequence.name}: {note}")
        with Checkpoints(folder / "unfinished.checkpoint", options.resume) as checkpoints:
            comparison = compare(sequence, options.modes, config, checkpoints)
            paths = comparison.save(folder, options.force)
        print(f"\n{comparison.table}\nwritten to {folder}: {', '.join(path.name for path in paths)}")


def _run(options: argparse.Namespace) -> None:
    config = _config(options)
    sequence = with_truth_noise(_open(options, options.data), config.truth)
    files.require_writable(options.out)
    if not options.force:
        require_same_origin(options.out, sequence)
    with Checkpoints(options.out.with_name(f"{options.out.name}.checkpoint"), options.resume) as checkpoints:
        result = run(sequence, options.mode, config, checkpoints=checkpoints)
        older = [] if _is_shared(options.out) else older_figures(options.out.parent)
        files.write_all({options.out: archive_image(sequence, {result.mode: result})})
    remove_figures(older, ())
    print(_table(sequence, len(sequence.observations.ids), {result.mode: result}))
    print(", ".join(f"{name} {count}" for name, count in result.counts.items()))
    if result.parameters is not None:
        print("\n".join(result.parameters.lines))
    for remark in result.remarks:
        print(f"note: {remark}")
    print(f"written to {options.out}")


def _is_shared(archive: Path) -> bool:
    """Whether the figures beside an archive need not be its own."""
    return not archive.exists() or any(path != archive for path in archive.parent.glob("*.h5"))


def _consistency(options: argparse.Namespace) -> None:
    study = Study(levels_of(options.level), tuple(options.variants), options.runs, options.seed)
    report = check_consistency(study, options.out, options.executor, options.workers)
    print(f"{report.table}\nwritten to {options.out}: {', '.join(path.name for path in report.paths)}")


def _simulate(options: argparse.Namespace) -> None:
    files.require_writable(options.out)
    sequence = builtin(options.world.removeprefix(BUILTIN))
    _require_ours(options, options.out, lambda path: is_recording_of(path, sequence))
    files.write_all({options.out: sequence_image(sequence)})
    print(f"{len(sequence)} frames, {len(sequence.observations)} observations written to {options.out}")


def _info(options: argparse.Namespace) -> None:
    if _is_archive(options.data):
        archive = read_archive(options.data)
        print(f"{options.data}: archive of {archive.name}, {len(archive.time_s)} frames, from {archive.source}")
        print(_table(archive, None, archive.results))
        for mode, result in archive.results.items():
            print(f"{mode}: " + ", ".join(f"{name} {count}" for name, count in result.counts.items()))
            if result.parameters is not None:
                for line in result.parameters.lines:
                    print(f"{mode}: {line}")
            for remark in result.remarks:
                print(f"{mode}: note: {remark}")
            if result.hygiene is not None:
                for line in result.hygiene.lines(result.config["hygiene"]):
                    print(f"{mode}: hygiene: {line}")
        return
    given = Config().with_overrides({"truth": dict(options.truth_noise)})
    sequence = with_truth_noise(_open(options, options.data), given.truth)
    camera, truth, noise = sequence.camera, sequence.truth, sequence.noise
    tracks = inspect_tracks(sequence.observations, sequence.twist)
    print(f"name          {sequence.name} ({sequence.source})")
    print(f"frames        {len(sequence)} in {sequence.time_s[-1] - sequence.time_s[0]:.1f} s")
    print(f"tracks        {tracks.tracks}, {len(sequence.observations)} observations")
    print(
        f"camera        fu {camera.fu_px:g} fv {camera.fv_px:g} cu {camera.cu_px:g} cv {camera.cv_px:g} px, "
        f"baseline {camera.baseline_m:g} m"
    )
    if noise is None:
        v, w = velocity_noise(sequence.twist).texts
        print(f"noise         not stated; white noise of the velocities, from the data: {v} m/s, {w} rad/s")
    else:
        print(f"noise         twist {noise.twist_std} (m/s, rad/s), pixels {noise.pixel_std_px} px")
    known = "none" if truth is None else f"{len(truth.frame)} poses, {len(truth.landmark)} landmarks"
    print(f"truth         {known}")
    if truth is not None:
        print(f"truth noise   {'none stated: taken as exact' if truth.noise is None else truth.noise.text}")
    gaps = ", ".join(f"{begin} to {end}" for begin, end in stretches(sequence.interpolated))
    print(f"gaps          {f'intervals {gaps} are interpolated' if gaps else 'none'}")
    for key, value in sequence.attributes.items():
        print(f"{key:13s} {value}")
    for note in sequence.notes:
        print(f"note          {note}")
    problem = build(sequence)
    assert problem.hygiene is not None
    for line in problem.lines:
        print(f"state         {line}")
    for line in problem.hygiene.lines(dataclasses.asdict(problem.config.hygiene)):
        print(f"hygiene       {line}")


def _tune(options: argparse.Namespace) -> None:
    config = Config.from_toml(options.config) if options.config else Config()
    config = config.with_overrides({"noise": {"model": options.model}})
    sequence = _open(options, options.data)
    if options.out:
        files.require_writable(options.out)
        _require_ours(options, options.out, lambda path: first_line(path) == toml_heading(sequence.name))
    tuned = tune(sequence, config, drift=options.drift)
    print(tuned.table)
    if options.out:
        files.write_all({options.out: tuned.toml})
        print(f"written to {options.out}")


def _plot(options: argparse.Namespace) -> None:
    archive = read_archive(options.archive)
    if not archive.results:
        raise ArchiveError(f"{options.archive}: holds no run")
    directory = options.out or options.archive.parent
    files.require_writable(directory / "map.png")
    for path in save_figures(directory, archive.results, archive.truth, archive.interpolated):
        print(path)


def _posterior(options: argparse.Namespace) -> None:
    full = open_result(options.archive, "full")
    overrides = {"posterior": {"linearisation": options.linearisation, "kernel": options.kernel}}
    config = Config().with_overrides(full.config).with_overrides(overrides).posterior
    directory = options.out or options.archive.parent
    for path in (options.archive, directory / "sparsity.png"):
        files.require_writable(path)
    found = posterior(full, config)
    smoothed = smooth(full, config, found)
    truth = read_archive(options.archive).truth
    figures = pngs(directory, draw_posterior_figures(full, smoothed, found.information, truth))
    add_result(options.archive, smoothed, of=full, beside=figures)
    archive = read_archive(options.archive)
    print(_table(archive, None, archive.results))
    print(", ".join(f"{name} {count}" for name, count in smoothed.counts.items()))
    for path in figures:
        print(path)
    print(f"{smoothed.mode} written to {options.archive}")


def _check(options: argparse.Namespace) -> None:
    found = check(options.archive, options.mode, options.out)
    print(found.honesty.table)
    print("written: " + ", ".join(map(str, found.paths)))


def _export(options: argparse.Namespace) -> None:
    archive = read_archive(options.archive)
    modes = list(archive.results)
    mode = options.mode or ("full" if "full" in modes or not modes else modes[0])
    path = options.out or options.archive.with_suffix(f".{components([mode])[0]}.{options.format}.txt")
    files.require_writable(path)
    _require_ours(options, path, lambda path: len(first_line(path).split()) == (8 if options.format == "tum" else 12))
    if mode == TRUTH:
        poses, text = truth_text(archive, str(options.archive), options.format)
    else:
        result = open_result(options.archive, mode)
        poses, text = len(result.time_s), trajectory_text(result, options.format)
    files.write_all({path: text})
    print(f"{poses} poses written to {path}")


def _require_ours(options: argparse.Namespace, path: Path, is_ours: Callable[[Path], bool]) -> None:
    """Raise a `WriteError` where a file would be lost that is no earlier result of the same kind."""
    if not (options.force or files.is_free(path) or is_ours(path)):
        raise WriteError(f"{path}: exists, and is no earlier result of the same; --force replaces it")


def _is_archive(data: str) -> bool:
    return not data.startswith(BUILTIN) and hdf5.format_of(data) == ARCHIVE_FORMAT


def _table(data: Sequence | Archive, landmarks: int | None, results: Mapping[str, Result]) -> str:
    modes = {mode: summarise(data, result) for mode, result in results.items()}
    return compare_table({"sequence": data.name, "frames": len(data.time_s), "landmarks": landmarks, "modes": modes})


if __name__ == "__main__":
    sys.exit(main())
