"""Arguments that several subcommands share, and the objects made of them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast, get_args

from ekfslam import files
from ekfslam.config import ENGINES, VARIANTS, Config
from ekfslam.data.opening import attach_truth, with_truth_frame
from ekfslam.data.sequence import Sequence, stretch
from ekfslam.data.trajectory import Moving
from ekfslam.errors import ConfigError, WriteError
from ekfslam.evaluation.sanity import inspect_sequence
from ekfslam.evaluation.summary import compare_table, summarise_all
from ekfslam.evaluation.tables import WRITERS, is_table
from ekfslam.filters.result import Result
from ekfslam.frontend.opening import open_sequence
from ekfslam.others import NAME, Others, World
from ekfslam.storage.archive import Archive

DEFAULT_DATA = "builtin:city"
_READINGS = ("corrected", "as-stored")

# Flags without effect, accepted with a note.
RETIRED = {"--resume": "runs start from the beginning; sweeps and studies resume"}


class _Retired(argparse.Action):
    def __call__(self, *_: object, **__: object) -> None:
        flag = self.option_strings[0]
        print(f"note: {flag} has no effect: {RETIRED[flag]}", flush=True)


def _stretch(text: str) -> slice:
    try:
        return stretch(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _setting(text: str) -> tuple[str, float]:
    key, _, value = text.partition("=")
    return key, float(value)  # argparse reports a ValueError


def table_file(text: str) -> Path:
    """Return the path of a table, whose ending must be that of a format."""
    if Path(text).suffix not in WRITERS:
        raise argparse.ArgumentTypeError(f"{text!r} does not end in one of {', '.join(WRITERS)}")
    if not files.is_free(Path(text)) and not is_table(Path(text)):
        raise argparse.ArgumentTypeError(f"{text} exists, and is no table of this program; choose another name")
    return Path(text)


def width(text: str) -> float:
    """Return the width of the figures of a paper in inches."""
    from ekfslam.figures.paper import width_of  # imports Matplotlib

    try:
        return width_of(text)
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _file(words: str, metavar: str = "FILE") -> dict[str, Any]:
    return {"type": Path, "metavar": metavar, "help": words}


def _switch(words: str) -> dict[str, Any]:
    return {"action": "store_true", "help": words}


def _choice(names: tuple[str, ...], default: str, words: str) -> dict[str, Any]:
    return {"choices": names, "default": default, "help": f"{words} (default: %(default)s)"}


# Shared arguments: name, and how argparse declares it.
_SHARED: dict[str, dict[str, Any]] = {
    "data": {"nargs": "?", "default": DEFAULT_DATA, "metavar": "DATA", "help": f"default: {DEFAULT_DATA}"},
    "--width": {
        "type": width,
        "metavar": "WIDTH",
        "help": "draw figures of a paper, column (3.5 inches), page (7.16), or inches wide; captions in captions.md",
    },
    "archive": _file("as written by run or compare", "ARCHIVE"),
    "--out": _file("default: the folder of the archive", "DIR"),
    "--timings": _switch("print the CPU and wall-clock time of each part"),
    "--force": _switch("overwrite the output even if it holds something else"),
    "--verbose": _switch("print all figures of merit, counts and estimated parameters"),
    "--no-figures": _switch("draw no figures, which saves time"),
    "--workers": {"type": int, "metavar": "N", "help": "processes (default: one per core)"},
    "--executor": {
        "default": "processes",
        "metavar": "SPEC",
        "help": "processes (default), serial, tls://HOST:PORT (a Dask cluster, with the certificates of Dask's "
        "configuration distributed.comm.tls), dask://HOST:PORT (without certificates: anyone who reaches that port "
        "runs programs as you; for private networks only), or mpi",
    },
    "--truth": _file(f"true poses: KITTI odometry, TUM, EuRoC, ...; {NAME} in it is the recording's name"),
    "--velocities": _file(
        "velocities from elsewhere: text of time vx vy vz wx wy wz (s, m/s, rad/s), or another recording"
    ),
    "--velocity-frame": {
        "choices": ("imu", "level"),
        "help": "frame of --velocities (default: as the file says, otherwise imu)",
    },
    "--imu": _file(
        "inertial samples from elsewhere: csv of timestamp w_x w_y w_z a_x a_y a_z (ns, rad/s, m/s^2), imu0 of EuRoC, "
        "or a bag; none leaves out those of the recording"
    ),
    "--imu-noise": _file(
        "sensor.yaml or imu.yaml with the noise densities of inertial samples (default: the one beside them)"
    ),
    "--topics": {
        "nargs": "+",
        "default": [],
        "metavar": "TOPIC",
        "help": "topics of a bag: LEFT RIGHT (or one camera) [ODOMETRY] [IMU] (default: by CameraInfo and names)",
    },
    "--calibration": _file(
        "calibration of the pair: chain of Kalibr or OpenVINS, left.yaml of ROS, OpenCV, ORB-SLAM, calibration.toml "
        "(bags without CameraInfo need one)"
    ),
    "--lateral": _choice(_READINGS, "corrected", "sign of the lateral velocity of KITTI, stored positive to the right"),
    "--camera": _choice(
        ("both", "left"), "both", "left: the left camera alone, with the scale of inertial samples or velocities"
    ),
    "--frames": {"type": _stretch, "metavar": "A:B", "help": "frames A to B - 1 only, like a slice in Python"},
    "--extrinsics": _choice(_READINGS, "corrected", "how to read cam_T_imu of .npz recordings"),
    "--truth-frame": {
        "nargs": "+",
        "default": ["body"],
        "metavar": "FRAME",
        "help": "moving frame of the truth: body, camera, or its pose in the body, x y z [qx qy qz qw] (default: body)",
    },
    "--truth-noise": {
        "nargs": "+",
        "type": _setting,
        "default": [],
        "metavar": "KEY=VALUE",
        "help": "standard deviations of the truth, in place of the defaults of its format: roll_deg, pitch_deg, "
        "yaw_deg, first_position_m, stamp_s, position_m, attitude_deg",
    },
    "--with": {
        "dest": "others",
        "action": "append",
        "default": [],
        "metavar": "[NAME=]FILE",
        "help": "trajectory of another program to compare with: TUM (covariances in FILE.cov.txt), EuRoC csv or KITTI; "
        "may be given several times; {name} in it is the recording's name",
    },
    "--with-frame": {
        "choices": get_args(Moving),
        "help": "moving frame of the poses of --with: body or left camera (default: camera for KITTI, otherwise body)",
    },
    "--with-world": _choice(
        get_args(World),
        "first",
        "first: move them so that their first pose is the recording's; given: leave their world",
    ),
    "--config": _file(
        "tables [noise], [hygiene], [filter], [calibration], [posterior], [truth]; `tune` writes such a file",
        "FILE.toml",
    ),
    **{flag: {"action": _Retired, "nargs": 0, "help": argparse.SUPPRESS} for flag in RETIRED},
}
TABLE_WORDS = f"write the table of a paper, by the ending of FILE: {', '.join(WRITERS)}"
OTHERS = ("--with", "--with-frame", "--with-world")
EXECUTOR = ("--workers", "--executor")
_INPUTS = ("--velocities", "--velocity-frame", "--imu", "--imu-noise")
PLACES = ("--truth", *_INPUTS, "--topics", "--calibration", "--lateral")  # parts of a recording in other files
_READ_AS = (*PLACES, "--camera", "--extrinsics")  # arguments of `open_sequence`
DATA = (*PLACES, "--truth-frame", "--camera", "--frames", "--extrinsics", "--truth-noise")

# Flags that override a setting, the table and key of it, and how argparse declares the flag.
_SETTINGS: tuple[tuple[str, str, dict[str, Any], str], ...] = (
    ("--engine", "filter.engine", {"choices": ENGINES}, "implementation of the joint filter: C++ or NumPy (reference)"),
    ("--variant", "filter.variant", {"choices": VARIANTS}, "linearisation of the joint filter"),
    ("--iterations", "filter.iterations", {"type": int, "metavar": "N"}, "Gauss-Newton iterations of an update"),
    ("--retire", "filter.retire", {"choices": ("auto", "unseen", "never")}, "when landmarks leave the state"),
    ("--sigma-v", "noise.sigma_v_m_s", {"type": float, "metavar": "M_S"}, "linear velocity noise per sample, m/s"),
    (
        "--sigma-w",
        "noise.sigma_w_rad_s",
        {"type": float, "metavar": "RAD_S"},
        "angular velocity noise per sample, rad/s",
    ),
    ("--sigma-px", "noise.sigma_px", {"type": float, "metavar": "PX"}, "pixel noise"),
    (
        "--relative-frames",
        "filter.relative_frames",
        {"type": int, "metavar": "N"},
        "show the NEES of relative poses up to N frames apart, too (default: 0, since it slows the filter down)",
    ),
)


def declare(parser: argparse._ActionsContainer, *names: str, **changes: Any) -> None:
    """Add shared arguments to a parser, with some changes to how argparse declares them."""
    for name in names:
        parser.add_argument(name, **{**_SHARED[name], **changes})


def declare_run(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of runs: recording, settings, and retired flags."""
    declare(parser, "--force", *RETIRED, *DATA)
    group = parser.add_argument_group("settings", "flags override the file, the file overrides the defaults")
    declare(group, "--config")
    for flag, setting, declared, words in _SETTINGS:
        group.add_argument(flag, dest=setting, help=words, **declared)


def configured(options: argparse.Namespace) -> Config:
    """Return the settings of a run."""
    overrides: dict[str, dict[str, Any]] = {"truth": dict(options.truth_noise)}
    for _, setting, _, _ in _SETTINGS:
        table, _, key = setting.partition(".")
        overrides.setdefault(table, {})[key] = getattr(options, setting)
    return config_file(options).with_overrides(overrides)


def config_file(options: argparse.Namespace) -> Config:
    """Return the settings of the file ``--config``; defaults without one."""
    path = getattr(options, "config", None)
    return Config.from_toml(path) if path else Config()


def open_data(options: argparse.Namespace, data: str) -> Sequence:
    """Open a recording as the options of `DATA` say."""
    given = {name: getattr(options, name) for name in (flag[2:].replace("-", "_") for flag in _READ_AS)}
    named = str(given.pop("truth")) if NAME in str(given["truth"]) else ""
    sequence = open_sequence(data, front_end=config_file(options).front_end, **given)
    sequence = attach_truth(sequence, named.replace(NAME, sequence.name)) if named else sequence
    sequence = with_truth_frame(sequence, _frame(options.truth_frame))
    return sequence if options.frames is None else sequence[options.frames]


def _frame(words: list[str]) -> Moving | list[float]:
    for name in get_args(Moving):
        if words == [name]:
            return cast(Moving, name)
    try:
        return [float(word) for word in words]
    except ValueError:
        return []


def others_of(options: argparse.Namespace, recordings: int = 1) -> Others:
    """Return the trajectories of the options of `OTHERS`."""
    others = Others.parse(options.others, options.with_frame, options.with_world)
    others.require_distinct(recordings)
    return others


def print_warnings(sequence: Sequence) -> None:
    """Print the warnings about a recording."""
    for line in sequence.once(inspect_sequence).warnings:
        print(f"{sequence.name}: warning: {line}", flush=True)


def require_ours(options: argparse.Namespace, path: Path, is_ours: Callable[[Path], bool]) -> None:
    """Raise a `WriteError` if writing would lose a file that is not an earlier result of the same kind."""
    if not (options.force or files.is_free(path) or is_ours(path)):
        raise WriteError(f"{path}: exists, and is not an earlier result of this command; --force overwrites it")


def table(data: Sequence | Archive, landmarks: int | None, results: Mapping[str, Result]) -> str:
    """Return the table of figures of merit, one column per mode."""
    return compare_table(summarise_all(data, landmarks, results))
