"""Compare tracks of the front end with given ones: errors in the image, and errors of the poses.

The images are the first 51 frames of KITTI odometry 06; the given tracks are KLT tracks of the same drive and frames. A
track is fitted to given poses: a landmark m, and a constant error c of its disparity,

    z(k) = pi(T_cam_world(k) m) + c e_d + r(k),    e_d = (0, 0, -1),    c ~ N(0, 1 px),

by least squares over its rows (u, v, uR) with standard deviations of 0.3 px. Figures of the errors of tracks:

- constant: standard deviation of c over tracks that determine it to 0.4 px, in disparity,
- walk: standard deviation of r(k) - r(k-1), for u, v, and disparity (white noise s gives sqrt(2) s),
- lag 1: correlation of successive differences (-0.5 for white noise, 0 for a walk),
- shared: standard deviation of the mean difference of a frame beyond that of independent tracks.

All are robust (medians of absolute values). Poses are those of vision alone (front end, full, without velocities), and
the true ones, whose first second is interpolated.

    python experiments/front_end.py
"""

from __future__ import annotations

from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from common import argument_parser, has_recordings, trajectory_errors, truth_of, with_aligned, write
from matplotlib.figure import Figure

import ekfslam
from ekfslam import attach_truth, open_images
from ekfslam.arrays import Array
from ekfslam.data.sequence import Sequence
from ekfslam.data.velocities import attach_velocities
from ekfslam.evaluation.summary import summarise
from ekfslam.evaluation.tables import markdown_table, number
from ekfslam.figures.maps import plot_map
from ekfslam.figures.style import line_of, styled
from ekfslam.frontend.track import TrackReport, track
from ekfslam.geometry import se3
from ekfslam.geometry.camera import project, rectified_jacobian, rectified_rows, triangulate

FOLDER, TRUTH = "kitti_odometry/sequences/06", "kitti_odometry_poses/06.txt"
GIVEN = "utias/2011_09_30_drive_0020_sync_KLT.mat"
FRAMES = 51
ROW_STD_PX, CONSTANT_STD_PX, KNOWN_PX, OUTLIER_PX = 0.3, 1.0, 0.4, 3.0
ITERATIONS, LEAST, LAGS = 8, 4, 8
ROWS = ("u", "v", "disparity")
CONFIG = ekfslam.Config().with_overrides({"filter": {"relative_frames": 100}})


def main() -> None:
    parser = argument_parser(__doc__, "front_end", data=True)
    options = parser.parse_args()
    if not has_recordings(options.data, f"{FOLDER}/calib.txt", TRUTH, GIVEN):
        return
    tracked, report, ms = track_images(options.data, velocities=False)
    driven, _, _ = track_images(options.data, velocities=True)
    given = attach_truth(ekfslam.open_sequence(options.data / GIVEN)[:FRAMES], options.data / TRUTH)
    runs = {
        "front end, vision alone": (tracked, ekfslam.run(tracked, "full", CONFIG)),
        "front end, with velocities": (driven, ekfslam.run(driven, "full", CONFIG)),
        "given KLT, with velocities": (given, ekfslam.run(given, "full", CONFIG)),
    }
    poses = {
        "vision's": _camera_poses(tracked, runs["front end, vision alone"][1].T_world_imu),
        "true": _camera_poses(tracked, truth_of(tracked).T_world_imu),
    }
    found = {
        (name, where): errors_of(sequence, T_world_cam)
        for name, sequence in (("given KLT", given), ("front end", tracked))
        for where, T_world_cam in poses.items()
    }
    rows = {name: figures_of(*run) for name, run in runs.items()}
    values = {
        "ms_per_frame": ms,
        "poses": rows,
        "errors": [{"tracks": name, "poses": where, **errors} for (name, where), errors in found.items()],
        "rotation_px": report.rotation_px[-1].tolist(),
    }
    figures = {"errors_of_tracks": plot_errors({name: found[name, "vision's"] for name in ("given KLT", "front end")})}
    sequence, result = runs["front end, vision alone"]
    figures["map"] = plot_map({"full": result}, sequence.truth)
    write(options.out, "front_end", values, _text(rows, found, report, ms), figures)
    print(_text(rows, found, report, ms))


def track_images(data: Path, velocities: bool) -> tuple[Sequence, TrackReport, float]:
    """Return the tracks of the images, and the processor time per frame in ms, with decoding."""
    recording = open_images(data / FOLDER)
    assert recording is not None
    if velocities:
        recording = attach_velocities(recording, data / GIVEN)
    begin = process_time()
    sequence, report = track(recording)
    return attach_truth(sequence, data / TRUTH), report, 1e3 * (process_time() - begin) / len(sequence)


def _camera_poses(sequence: Sequence, T_world_imu: Array) -> Array:
    return T_world_imu @ se3.inverse(sequence.T_cam_imu)


def errors_of(sequence: Sequence, T_world_cam: Array) -> dict[str, Any]:
    """Return the figures of the errors of a recording's tracks at poses (T, 4, 4) of its camera."""
    T_cam_world, observations = se3.inverse(T_world_cam), sequence.observations
    constants, residuals = [], []
    order = np.lexsort((observations.frame, observations.landmark))
    cuts = np.flatnonzero(np.diff(observations.landmark[order])) + 1
    for part in np.split(order, cuts):
        frames = observations.frame[part]
        rows = rectified_rows(observations.pixels_px[part], np.ones(4))[0]
        if len(part) < LEAST or (rows[:, 0] - rows[:, 2] < 1.0).any() or (np.diff(frames) != 1).any():
            continue
        c, c_std, r = _fitted(sequence, T_cam_world[frames], rows)
        if np.abs(r).max() < OUTLIER_PX:
            residuals.append((frames, r))
            if c_std < KNOWN_PX:
                constants.append(c)
    steps = [(frames[1:], np.diff(r, axis=0)) for frames, r in residuals]
    frame, step = (np.concatenate(parts) for parts in zip(*steps, strict=True))
    pairs = np.concatenate([np.stack([d[:-1], d[1:]], axis=1) for _, d in steps])
    walk = _robust_std(step)
    lag_1 = [_robust_correlation(pairs[:, 0, i], pairs[:, 1, i]) for i in range(3)]
    spread = [_robust_std(np.concatenate([r[lag:] - r[:-lag] for _, r in residuals])) for lag in range(1, LAGS + 1)]
    return {
        "tracks_fitted": len(residuals),
        "constant_px": float(_robust_std(np.array(constants) - np.median(constants))),
        "constants": np.round(constants, 3).tolist(),
        "walk_px": walk.tolist(),
        "lag_1": lag_1,
        "shared_px": _shared(frame, step).tolist(),
        "spread_px": np.array(spread).tolist(),
    }


def _fitted(sequence: Sequence, T_cam_world: Array, rows: Array) -> tuple[float, float, Array]:
    """Return the constant disparity error of a track, its standard deviation, and residuals (n, 3) in u, v, d."""
    camera = sequence.camera
    m = np.mean(se3.apply(se3.inverse(T_cam_world), triangulate(camera, rows)), axis=0)
    c = 0.0
    for _ in range(ITERATIONS):
        q = se3.apply(T_cam_world, m)
        q[:, 2] = np.maximum(q[:, 2], 0.5)
        r = rows - project(camera, q)[:, :3] + (0.0, 0.0, c)
        J = np.zeros((*r.shape, 4))
        J[:, :, :3], J[:, 2, 3] = rectified_jacobian(camera, q) @ T_cam_world[:, :3, :3], -1.0
        weight = (1.0 + (r / (3.0 * ROW_STD_PX)) ** 2) ** -1 / ROW_STD_PX**2
        flat, w = J.reshape(-1, 4), weight.reshape(-1)
        information = (flat * w[:, None]).T @ flat
        information[3, 3] += CONSTANT_STD_PX**-2
        gradient = (flat * w[:, None]).T @ r.reshape(-1)
        gradient[3] -= c * CONSTANT_STD_PX**-2
        step = np.linalg.solve(information + 1e-9 * np.eye(4), gradient)
        m, c = m + step[:3], c + float(step[3])
    std = float(np.sqrt(np.linalg.inv(information + 1e-9 * np.eye(4))[3, 3]))
    return c, std, np.stack([r[:, 0], r[:, 1], r[:, 0] - r[:, 2]], axis=1)


def _robust_std(values: Array) -> Array:
    """Return standard deviations along the first axis, from medians of absolute values."""
    return np.asarray(1.4826 * np.median(np.abs(values), axis=0))


def _robust_correlation(x: Array, y: Array) -> float:
    """Return the correlation of two zero-mean variables, from robust deviations of their sum and difference."""
    x, y = x / _robust_std(x), y / _robust_std(y)
    plus, minus = _robust_std(x + y) ** 2, _robust_std(x - y) ** 2
    return float((plus - minus) / (plus + minus))


def _shared(frame: Array, step: Array) -> Array:
    """Return the standard deviation (3,) of the mean step of a frame, less that of the mean of independent steps."""
    squares = []
    for k in np.unique(frame):
        some = step[frame == k]
        if len(some) >= 10:
            middle = np.median(some, axis=0)
            # The variance of a median is pi/2 times that of a mean.
            squares.append(middle**2 - 0.5 * np.pi * _robust_std(some - middle) ** 2 / len(some))
    return np.sqrt(np.maximum(np.mean(squares, axis=0), 0.0))


def figures_of(sequence: Sequence, result: ekfslam.Result) -> dict[str, Any]:
    summary = summarise(sequence, result)
    kept = ("nis_per_dof", "pose_nees_with_truth_noise_mean", "pose_nees_relative_10_mean")
    return {**trajectory_errors(sequence, result.T_world_imu), **{name: summary[name] for name in kept}}


def _text(rows: dict[str, Any], found: dict[Any, Any], report: TrackReport, ms: float) -> str:
    poses = markdown_table(
        ["tracks", "ATE (aligned) [m]", "NIS / dof", "NEES (6), truth noise", "over 10 frames (6)"],
        [
            [
                name,
                with_aligned(row, ".3f"),
                number(row["nis_per_dof"], ".2f"),
                number(row["pose_nees_with_truth_noise_mean"], ".1f"),
                number(row["pose_nees_relative_10_mean"], ".1f"),
            ]
            for name, row in rows.items()
        ],
    )
    errors = markdown_table(
        ["tracks", "poses", "fitted", "constant", "walk u, v, d", "lag 1 u, v, d", "shared u, v, d"],
        [
            [
                name,
                where,
                str(row["tracks_fitted"]),
                number(row["constant_px"], ".2f"),
                *(", ".join(f"{value:.2f}" for value in row[key]) for key in ("walk_px", "lag_1", "shared_px")),
            ]
            for (name, where), row in found.items()
        ],
        left=2,
    )
    lines = "".join(f"- {line}\n" for line in report.lines)
    return (
        f"# Tracks of the front end\n\nFirst {FRAMES} frames (60 m) of KITTI odometry 06, {ms:.0f} ms of processor "
        f"time a frame, PNG decoding included.\n\n{lines}\n{poses}\n\nThe true poses of the first second are "
        "interpolated, and the first one is wrong by 0.4 deg: see the aligned errors. Only runs with velocities know "
        f"of this second.\n\nErrors of tracks, px; `experiments/front_end.py` says what they are:\n\n{errors}\n"
    )


@styled
def plot_errors(found: dict[str, Any]) -> Figure:
    """Draw the spread of track errors against their age, and the constant disparity errors."""
    figure = Figure(figsize=(10.0, 3.0))
    panels = figure.subplots(1, 4)
    styles = {"given KLT": line_of("mapping-only"), "front end": line_of("full")}
    lags = np.arange(1, LAGS + 1)
    top = 1.1 * max(float(np.max(errors["spread_px"])) for errors in found.values())
    for i, (ax, row) in enumerate(zip(panels[:3], ROWS, strict=True)):
        for name, errors in found.items():
            ax.plot(lags, np.array(errors["spread_px"])[:, i], marker="o", **styles[name], label=name)
        ax.set(xlabel="frames apart", title=f"change of the error: {row}", ylim=(0.0, top))
    panels[0].set_ylabel("standard deviation [px]")
    panels[0].legend()
    bins = np.linspace(-2.0, 2.0, 33).tolist()
    for name, errors in found.items():
        style = {key: styles[name][key] for key in ("color", "linestyle")}
        panels[3].hist(errors["constants"], bins, density=True, histtype="step", linewidth=1.4, **style, label=name)
    panels[3].set(xlabel="[px]", ylabel="density [1/px]", title="constant disparity error")
    return figure


if __name__ == "__main__":
    main()
