"""What several subcommands share: arguments, and what is made of them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path

from ekfslam import files
from ekfslam.config import VARIANTS, Config
from ekfslam.data.sequence import Sequence, stretch
from ekfslam.errors import WriteError
from ekfslam.evaluation.sanity import inspect_sequence
from ekfslam.evaluation.summary import compare_table, summarise
from ekfslam.filters.result import Result
from ekfslam.frontend.opening import open_sequence
from ekfslam.storage.archive import Archive

DEFAULT_DATA = "builtin:city"


class _Unresumable(argparse.Action):
    def __call__(self, *_: object, **__: object) -> None:
        print("note: --resume has no effect: runs start from the beginning; sweeps and studies resume", flush=True)


def add_resume(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--resume", action=_Unresumable, nargs=0, help=argparse.SUPPRESS)


def add_force(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--force", action="store_true", help="replace a file that is no earlier result of the same")


def add_no_figures(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--no-figures", action="store_true", help="draw none, which saves time")


def add_executor(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: one per core)")
    parser.add_argument(
        "--executor",
        default="processes",
        metavar="SPEC",
        help="processes (default), serial, tls://HOST:PORT (a Dask cluster, with the certificates of Dask's "
        "configuration distributed.comm.tls), dask://HOST:PORT (without: whoever reaches that port runs programs as "
        "you; for networks of your own only), or mpi",
    )


def add_place_options(parser: argparse.ArgumentParser) -> None:
    """What belongs to a recording, but lies elsewhere."""
    parser.add_argument("--truth", type=Path, metavar="FILE", help="true poses: KITTI odometry or TUM text")
    parser.add_argument(
        "--velocities",
        type=Path,
        metavar="FILE",
        help="velocities from elsewhere: text of time vx vy vz wx wy wz (s, m/s, rad/s), or another recording",
    )
    parser.add_argument(
        "--velocity-frame",
        choices=("imu", "level"),
        help="frame of --velocities (default: as the file says, otherwise imu)",
    )
    parser.add_argument(
        "--lateral",
        choices=("corrected", "as-stored"),
        default="corrected",
        help="sign of the lateral velocity of KITTI, stored positive to the right (default: %(default)s)",
    )


def add_data_options(parser: argparse.ArgumentParser) -> None:
    add_place_options(parser)
    parser.add_argument(
        "--frames",
        type=_stretch,
        metavar="A:B",
        help="frames A to B - 1 alone, like a slice in Python",
    )
    parser.add_argument(
        "--extrinsics",
        choices=("corrected", "as-stored"),
        default="corrected",
        help="how to read cam_T_imu of .npz recordings (default: %(default)s)",
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


def _stretch(text: str) -> slice:
    try:
        return stretch(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _setting(text: str) -> tuple[str, float]:
    key, _, value = text.partition("=")
    return key, float(value)  # argparse reports a ValueError


def add_filter_options(parser: argparse.ArgumentParser) -> None:
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
    group.add_argument(
        "--relative-frames",
        type=int,
        metavar="N",
        help="show the NEES of relative poses up to N frames apart, too (default: 0, since it slows the filter down)",
    )


def configured(options: argparse.Namespace) -> Config:
    config = Config.from_toml(options.config) if options.config else Config()
    return config.with_overrides(
        {
            "noise": {
                "sigma_v_m_s": options.sigma_v,
                "sigma_w_rad_s": options.sigma_w,
                "sigma_px": options.sigma_px,
            },
            "filter": {
                "variant": options.variant,
                "iterations": options.iterations,
                "retire": options.retire,
                "relative_frames": options.relative_frames,
            },
            "truth": dict(options.truth_noise),
        }
    )


def open_data(options: argparse.Namespace, data: str) -> Sequence:
    settings = Config.from_toml(options.config).front_end if getattr(options, "config", None) else None
    sequence = open_sequence(
        data,
        extrinsics=options.extrinsics,
        lateral=options.lateral,
        truth=options.truth,
        velocities=options.velocities,
        velocity_frame=options.velocity_frame,
        front_end=settings,
    )
    return sequence if options.frames is None else sequence[options.frames]


def print_warnings(sequence: Sequence) -> None:
    """Say what looks wrong in a recording before it is run."""
    for line in inspect_sequence(sequence).warnings:
        print(f"{sequence.name}: warning: {line}", flush=True)


def require_ours(options: argparse.Namespace, path: Path, is_ours: Callable[[Path], bool]) -> None:
    """Raise a `WriteError` where a file would be lost that is no earlier result of the same kind."""
    if not (options.force or files.is_free(path) or is_ours(path)):
        raise WriteError(f"{path}: exists, and is no earlier result of the same; --force replaces it")


def table(data: Sequence | Archive, landmarks: int | None, results: Mapping[str, Result]) -> str:
    modes = {mode: summarise(data, result) for mode, result in results.items()}
    return compare_table({"sequence": data.name, "frames": len(data.time_s), "landmarks": landmarks, "modes": modes})
