"""Starry Night: test the consistency of the filter on real measurements, and the stated noise of the file.

Everything is known of the indoor recording of UTIAS (`dataset3.mat`): the pose at every frame from a motion capture
system, the positions of all 20 landmarks, and the variances of velocities and pixels. So the covariance is compared
with the true error of pose and map,

    eps = e^T P^-1 e,   expected: 6 for a pose, 3 for a landmark,

and the noise with its model, by the residuals at the truth,

    r(k) = z(k) - M pi(T_cam_imu T_imu_world(k) m),   w(k) = u(k) + log(T_imu_world(k) T_imu_world(k-1)^-1) / tau.

The recording is cut into windows of 100 frames. Each starts from the true pose, displaced by a draw from the prior that
the filter is given, with an empty map; windows are the samples. Gates are off, since they would hide errors of the
model. Two models of the noise are compared, both chosen without the truth: all of the stated pixel noise white, and the
structure that `structure.choose` finds by innovations, a camera jitter of the stated size with little white noise.

Three instruments show the source of the jitter. Camera (against the known landmarks), truth and integrated velocities
each measure the rotation over some frames. Their errors are independent, so the variances of the differences give the
variance of each: ``s_a^2 = (v_ab + v_ac - v_bc) / 2``.

    python experiments/starry_night.py [--data DIR] [--out DIR]
"""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from common import STARRY_NIGHT, argument_parser, has_recordings, truth_of, write
from matplotlib.figure import Figure
from structure import Choice, choose, stated_candidates, with_value

import ekfslam
from ekfslam.arrays import Array, IntArray
from ekfslam.config import Config, FilterConfig, Variant
from ekfslam.data.sequence import WITHOUT_TRACKS, Noise, Observations, Sequence
from ekfslam.data.truth_noise import TruthNoise
from ekfslam.evaluation.consistency import (
    chi2_bounds,
    first_pose_error_covariance,
    nees,
    pose_error,
    pose_noise_covariance,
)
from ekfslam.evaluation.tables import MISSING, document, markdown_table
from ekfslam.evaluation.trajectory import match_landmarks
from ekfslam.figures.style import BOUNDS, EXPECTED, PURPLE, SERIES, SKY_BLUE, ZERO, log_axis, marker_of, styled
from ekfslam.filters import JointEKF, variants
from ekfslam.filters.dead_reckoning import dead_reckon
from ekfslam.filters.loop import one_thread, run_filter
from ekfslam.geometry import camera, se3
from ekfslam.models.blocks import StateBlock
from ekfslam.models.build import optional_blocks
from ekfslam.models.sensors.stereo import Rig
from ekfslam.resolve import noise_of

VARIANTS: tuple[Variant, ...] = ("invariant", "fej", "standard")
WINDOW_FRAMES = 100
PRIOR_POSITION_M, PRIOR_ROTATION_RAD = 0.01, 0.01
LAGS, SHOWN_LAGS = 40, (1, 2, 5, 10, 20)  # frames
PROBABILITY = 0.95
HAT_FRAMES = 20
LEAST_LANDMARKS, WHITE_PX, PRIOR_OF_CAMERA = 5, 1.4, 0.3  # of a pose from known landmarks; the prior in m and rad
EXACT = TruthNoise()
CHOOSING_FRAMES = 300
ROWS = ("uL", "vL", "uR", "vR")
AXES = ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z")


# --- The noise -------------------------------------------------------------------------------------------------------


def pixel_residuals(sequence: Sequence) -> Array:
    """Return measured minus true pixels (K, 4) of every observation; all landmarks are known."""
    truth, seen = truth_of(sequence), sequence.observations
    position = dict(zip(truth.landmark.tolist(), truth.position_m, strict=True))
    points = np.array([position[i] for i in seen.landmark.tolist()])
    q = se3.apply(sequence.T_cam_imu @ se3.inverse(truth.T_world_imu[seen.frame]), points)
    return seen.pixels_px - camera.project(sequence.camera, q)


def velocity_residuals(sequence: Sequence) -> Array:
    """Return measured minus true velocities (T-1, 6), m/s and rad/s, of the intervals that end at frames 1, 2, ..."""
    T = se3.inverse(truth_of(sequence).T_world_imu)
    tau = np.diff(sequence.time_s)[:, None]
    return sequence.twist[1:] + se3.log(T[1:] @ se3.inverse(T[:-1])) / tau


def autocorrelation(values: Array, lags: int, group: IntArray, index: IntArray) -> Array:
    """Return the correlation (lags+1, n) of values (K, n) with themselves ``lag`` frames later, within groups.

    Args:
        values: Residuals; their mean over all is taken off.
        lags: Largest lag.
        group: (K,) what belongs together, e.g. the landmark.
        index: (K,) frame of each value; pairs are of values whose frames differ by exactly the lag.
    """
    centred = values - values.mean(axis=0)
    span = index.max() + lags + 1
    key = group * span + index
    order = np.argsort(key)
    key, centred = key[order], centred[order]
    out = np.empty((lags + 1, values.shape[1]))
    for lag in range(lags + 1):
        later = np.minimum(np.searchsorted(key, key + lag), len(key) - 1)
        pair = key[later] == key + lag
        out[lag] = np.mean(centred[pair] * centred[later[pair]], axis=0)
    return out / out[0]


def robust_std(values: Array) -> Array:
    """Return the standard deviation (n,) of values (K, n) from the median absolute deviation."""
    return np.median(np.abs(values - np.median(values, axis=0)), axis=0) / 0.6745


# --- Whose error it is -----------------------------------------------------------------------------------------------


def camera_poses(sequence: Sequence) -> Array:
    """Find ``T_imu_world`` (T, 4, 4) from the pixels of each frame and the known landmarks; NaN if these are too few.

    Gauss-Newton on ``T_imu_world = exp(n^) T_true`` with a prior on n that is wider than anything it finds.
    """
    truth, seen = truth_of(sequence), sequence.observations
    position = dict(zip(truth.landmark.tolist(), truth.position_m, strict=True))
    T_imu_world, R = np.full((len(sequence), 4, 4), np.nan), sequence.T_cam_imu[:3, :3]
    for k, T_true in enumerate(se3.inverse(truth.T_world_imu)):
        ids, pixels = seen.at(k)
        if len(ids) < LEAST_LANDMARKS:
            continue
        points, T = np.array([position[i] for i in ids.tolist()]), T_true
        for _ in range(10):
            in_imu = se3.apply(T, points)
            q = se3.apply(sequence.T_cam_imu, in_imu)
            J_q = camera.projection_jacobian(sequence.camera, q) @ R
            J = np.concatenate([J_q, -J_q @ se3.skew(in_imu)], axis=-1).reshape(-1, 6) / WHITE_PX
            r = (pixels - camera.project(sequence.camera, q)).ravel() / WHITE_PX
            away = se3.log(T @ se3.inverse(T_true)) / PRIOR_OF_CAMERA
            information = J.T @ J + np.eye(6) / PRIOR_OF_CAMERA**2
            step = np.asarray(np.linalg.solve(information, J.T @ r - away / PRIOR_OF_CAMERA), dtype=float)
            T = se3.exp(step) @ T
        T_imu_world[k] = T
    return T_imu_world


def own_errors(sequence: Sequence) -> dict[str, Array]:
    """Return errors (6,), m and rad, of truth and camera (of one pose) and of the velocities (over `HAT_FRAMES`).

    From the variances of their differences over so many frames; one that comes out negative is 0.
    """
    known = se3.inverse(truth_of(sequence).T_world_imu)
    driven, _ = dead_reckon(sequence, sequence.noise or Noise.isotropic(0.0, 0.0, 1.0), np.zeros((6, 6)))
    moved = [T[HAT_FRAMES:] @ se3.inverse(T[:-HAT_FRAMES]) for T in (known, camera_poses(sequence), driven)]
    seen = np.isfinite(moved[1]).all(axis=(1, 2))
    truth, seen_by_camera, by_velocities = (T[seen] for T in moved)

    def variance(a: Array, b: Array) -> Array:
        return np.mean(se3.log(a @ se3.inverse(b)) ** 2, axis=0)

    v_tc, v_tv, v_cv = (
        variance(truth, seen_by_camera),
        variance(truth, by_velocities),
        variance(seen_by_camera, by_velocities),
    )
    own = {
        "truth": (v_tc + v_tv - v_cv) / 4.0,
        "camera": (v_tc + v_cv - v_tv) / 4.0,
        "velocities": (v_tv + v_cv - v_tc) / 2.0,
    }
    return {name: np.sqrt(np.maximum(value, 0.0)) for name, value in own.items()}


def noise_of_truth(own: Array) -> TruthNoise:
    """Return the errors (6,) of one true pose as the noise of the evaluation's truth."""
    position, attitude = np.sqrt(np.mean(own.reshape(2, 3) ** 2, axis=1)).tolist()
    roll, pitch, yaw = own[3:].tolist()
    return TruthNoise(roll, pitch, yaw, position, position_m=position, attitude_rad=attitude)


# --- Windows ---------------------------------------------------------------------------------------------------------


NOTHING_SEEN: dict[str, Any] = {
    "observations": Observations(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty((0, 4))),
    "attributes": WITHOUT_TRACKS,
}


@dataclass(frozen=True)
class Window:
    """Run one variant on one window: pose NEES (n,) after each frame, and the state at the end.

    Args:
        pose_nees, with_truth_noise: Of each frame, the truth being exact or not.
        landmark_nees: (m,).
        final_error: (6,) of the pose.
        nis, dof: NIS of the window's innovations and their degrees of freedom.
    """

    pose_nees: Array
    with_truth_noise: Array
    landmark_nees: Array
    final_error: Array
    nis: float
    dof: int


def run_window(
    sequence: Sequence,
    variant: Variant | None,
    start: int,
    stop: int,
    noise: Noise,
    rng: np.random.Generator,
    blocks: tuple[StateBlock, ...] = (),
    truth_noise: TruthNoise = EXACT,
) -> Window:
    """Filter the frames ``start`` to ``stop - 1``; the variant None is dead reckoning."""
    truth = truth_of(sequence)
    config = FilterConfig(
        variant or "invariant",
        retire="never",
        gate_probability=1.0,
        split_after=0,
        initial_position_std_m=PRIOR_POSITION_M,
        initial_rotation_std_rad=PRIOR_ROTATION_RAD,
    )
    xi = np.sqrt(np.diag(config.initial_covariance)) * rng.standard_normal(6)
    # T_imu_world = exp(xi^) T_hat, hence T_hat^-1 = T_world_imu exp(xi^).
    rig = Rig(sequence.camera, sequence.T_cam_imu, noise)
    ekf = JointEKF(rig, config, truth.T_world_imu[start] @ se3.exp(xi), blocks=blocks)
    T_world_imu, covariance = np.empty((stop - start, 4, 4)), np.empty((stop - start, 6, 6))
    nis, dof = 0.0, 0
    frames = dataclasses.replace(sequence, **NOTHING_SEEN) if variant is None else sequence
    for i, frame in enumerate(run_filter(ekf, frames, range(start, stop))):
        T_world_imu[i], covariance[i] = ekf.T_world_imu, ekf.P[:6, :6]
        nis, dof = nis + frame.report.nis, dof + frame.report.dof

    T_true, time_s = truth.T_world_imu[start:stop], sequence.time_s[start:stop]
    error = pose_error(T_world_imu, T_true)
    of_truth = first_pose_error_covariance(truth_noise, T_world_imu) + pose_noise_covariance(
        truth_noise, T_true, time_s
    )
    landmarks = ekf.landmarks()
    rows, known = match_landmarks(landmarks, truth)
    m_hat, m_true = landmarks.position_m[rows], truth.position_m[known]
    d = variants.VARIANTS[variant or "standard"].landmark_error(
        m_hat, m_true, T_world_imu[-1], truth.T_world_imu[stop - 1]
    )
    along, honest = nees(error, covariance), nees(error, covariance + of_truth)
    return Window(along, honest, nees(d, landmarks.covariance[rows]), error[-1], nis, dof)


# --- Tables and figures ----------------------------------------------------------------------------------------------

CHOSEN = ", chosen"  # behind the name of a variant: with the structure that was chosen
STATED, ALONE = "stated size", "any size"
OTHERS = (f"{STATED}, any time", ALONE)  # choices that are shown for the default variant only
SHOWN = ("dead-reckoning", "invariant", *(f"{name}{CHOSEN}" for name in VARIANTS), f"invariant, {ALONE}")
STYLES = {
    **{name: marker_of(name) for name in ("dead-reckoning", *VARIANTS)},
    **{f"{name}{CHOSEN}": {**marker_of(name), "markerfacecolor": "white"} for name in VARIANTS},
    f"invariant, {OTHERS[0]}": {**marker_of("invariant"), "color": PURPLE, "marker": "P"},
    f"invariant, {OTHERS[1]}": {**marker_of("invariant"), "color": SKY_BLUE, "marker": "v"},
}


def noise_table(sequence: Sequence) -> dict[str, dict[str, dict[str, float]]]:
    """Return stated and real noise: ``{"pixels" or "velocities": {row or axis: {figure: value}}}``."""
    stated = sequence.noise
    assert stated is not None
    seen = sequence.observations
    r, w = pixel_residuals(sequence), velocity_residuals(sequence)
    rho_r = autocorrelation(r, LAGS, seen.landmark, seen.frame)
    rho_w = autocorrelation(w, LAGS, np.zeros(len(w), dtype=np.int64), np.arange(1, len(sequence)))
    tables = {}
    for kind, names, values, rho, claim in (
        ("pixels", ROWS, r, rho_r, stated.pixel_std_px),
        ("velocities", AXES, w, rho_w, stated.twist_std),
    ):
        columns = {
            "stated_std": claim,
            "std": values.std(axis=0),
            "robust_std": robust_std(values),
            "mean": values.mean(axis=0),
            "largest": np.abs(values).max(axis=0),
            **{f"autocorrelation_{lag}": rho[lag] for lag in SHOWN_LAGS},
            "inflation": inflation(rho),
        }
        tables[kind] = {name: {c: float(v[i]) for c, v in columns.items()} for i, name in enumerate(names)}
    return tables


def inflation(rho: Array) -> Array:
    """Return the factor (n,) on a standard deviation that accounts for the correlation of samples in their mean.

    ``sqrt(1 + 2 sum rho)`` over the lags (lags+1, n) before the correlation first vanishes; white noise has 1.
    """
    before = np.cumprod(rho[1:] > 0, axis=0)
    return np.sqrt(1.0 + 2.0 * np.sum(rho[1:] * before, axis=0))


def consistency_table(windows: dict[str, list[Window]]) -> dict[str, dict[str, float]]:
    """Return means and medians over windows, the samples, for every filter."""
    table = {}
    for name, runs in windows.items():
        along = np.array([np.nanmean(run.pose_nees) for run in runs])
        end = np.array([run.pose_nees[-1] for run in runs])
        error = np.array([run.final_error for run in runs])
        table[name] = {
            "pose_nees_mean": along.mean(),
            "pose_nees_median_window": np.median(along),
            "pose_nees_end_mean": end.mean(),
            "pose_nees_end_median": np.median(end),
            "pose_nees_with_truth_noise_mean": np.mean([run.with_truth_noise.mean() for run in runs]),
            "pose_nees_with_truth_noise_end_mean": np.mean([run.with_truth_noise[-1] for run in runs]),
            "pose_nees_with_truth_noise_end_median": np.median([run.with_truth_noise[-1] for run in runs]),
            "position_rms_end_m": np.sqrt(np.mean(np.sum(error[:, :3] ** 2, axis=1))),
            "rotation_rms_end_rad": np.sqrt(np.mean(np.sum(error[:, 3:] ** 2, axis=1))),
        }
        if len(runs[0].landmark_nees):
            table[name]["nis_per_dof"] = sum(run.nis for run in runs) / sum(run.dof for run in runs)
            per_window = np.array([run.landmark_nees.mean() for run in runs])
            table[name]["landmark_nees_mean"] = per_window.mean()
            table[name]["landmark_nees_median_window"] = np.median(per_window)
    return {name: {key: float(value) for key, value in row.items()} for name, row in table.items()}


@styled
def plot_autocorrelation(sequence: Sequence) -> Figure:
    """Draw the autocorrelation of the pixel residuals of each landmark and of the velocity residuals."""
    seen = sequence.observations
    r, w = pixel_residuals(sequence), velocity_residuals(sequence)
    rho_r = autocorrelation(r, LAGS, seen.landmark, seen.frame)
    rho_w = autocorrelation(w, LAGS, np.zeros(len(w), dtype=np.int64), np.arange(1, len(sequence)))
    figure = Figure(figsize=(9.0, 3.8))
    axes = figure.subplots(1, 2, sharey=True)
    for ax, title, names, rho, count in (
        (axes[0], "pixels, per landmark", ROWS, rho_r, len(r)),
        (axes[1], "velocities", list(AXES), rho_w, len(w)),
    ):
        bound = 1.96 / np.sqrt(count)
        ax.axhspan(-bound, bound, **BOUNDS, label="95 % of white noise")
        for values, name, style in zip(rho.T, names, SERIES, strict=False):
            ax.plot(values, **style, label=name)
        ax.axhline(0.0, **ZERO)
        ax.set_xlabel(f"lag [frames, {np.median(np.diff(sequence.time_s)):.3f} s each in the median]")
        ax.set_title(title)
        ax.legend(ncols=2)
    axes[0].set_ylabel("autocorrelation [-]")
    figure.suptitle("Starry Night: autocorrelation of what is left at the true poses and landmarks")
    return figure


@styled
def plot_windows(windows: dict[str, list[Window]]) -> Figure:
    """Draw the NEES of pose and landmarks at the end of every window, with chi-square bounds."""
    figure = Figure(figsize=(9.0, 6.2))
    pose_ax, landmark_ax = figure.subplots(2, 1, sharex=True)
    bounds_label = f"{100 * PROBABILITY:g} % chi-square bounds"
    for ax, dof, label in ((pose_ax, 6, bounds_label), (landmark_ax, 3, None)):
        ax.axhspan(*chi2_bounds(dof, PROBABILITY), **BOUNDS, label=label)
        ax.axhline(dof, **EXPECTED)
    for i, name in enumerate(SHOWN):
        runs = windows[name]
        # Side by side, or filters that agree would hide one another.
        number = np.arange(1, len(runs) + 1) + 0.13 * (i - (len(SHOWN) - 1) / 2)
        pose_ax.plot(number, [run.pose_nees[-1] for run in runs], **STYLES[name], label=name)
        if len(runs[0].landmark_nees):
            landmark_ax.plot(number, [run.landmark_nees.mean() for run in runs], **STYLES[name])
    for ax, label in ((pose_ax, "pose NEES [-]"), (landmark_ax, "mean landmark NEES [-]")):
        log_axis(ax, (1.0,))
        ax.set_ylabel(label)
    pose_ax.set_title("pose, 6 degrees of freedom")
    landmark_ax.set_title("landmarks, 3 degrees of freedom")
    landmark_ax.set_xlabel(f"window of {WINDOW_FRAMES} frames [-]")
    landmark_ax.set_xticks(range(1, len(next(iter(windows.values()))) + 1))
    figure.legend(loc="outside lower center", ncols=3)
    figure.suptitle("Starry Night: NEES at the end of every window")
    return figure


def markdown(
    noise: dict[str, dict[str, dict[str, float]]],
    table: dict[str, dict[str, float]],
    count: int,
    choices: dict[str, Choice],
    own: dict[str, Array],
) -> str:
    """Return the report of the experiment."""
    low, high = chi2_bounds(6, PROBABILITY, count)
    landmark_low, landmark_high = chi2_bounds(3, PROBABILITY, count)
    return document(
        f"# Starry Night\n\n{count} windows of {WINDOW_FRAMES} frames. *Chosen*: with the errors of pixels that "
        "innovations choose among those of the stated size; *any time*, *any size*: among others, see below. All "
        "others: white, as the file states them.",
        markdown_table(
            [
                *("filter", "pose NEES, all frames", "last frame (median)", "last frame, truth noise (median)"),
                *("NIS/dof", "landmark NEES (median)", "m", "rad"),
            ],
            ([name, *consistency_cells(row)] for name, row in table.items()),
        ),
        f"Expected 6 and 3; {100 * PROBABILITY:g} % of means of {count} windows lie in {low:.2f}-{high:.2f} for the "
        f"last frame's pose and, were a window's landmarks one sample, in {landmark_low:.2f}-{landmark_high:.2f}. "
        "m and rad: root mean square errors of the pose at the last frame, in stored coordinates. *Truth noise*: the "
        f"truth is not exact but errs as measured below, by {noise_of_truth(own['truth']).text}.",
        *structure_section(choices),
        *error_section(own),
        *(
            block
            for kind, unit, digits in (("pixels", "px", 2), ("velocities", "m/s, rad/s", 4))
            for block in (
                f"## {kind.capitalize()} [{unit}]: residuals at the truth",
                markdown_table(
                    [
                        *("", "stated std", "std", "robust std", "mean", "largest"),
                        *("lag 1", "2", "5", "10", "20", "inflation"),
                    ],
                    ([name, *noise_cells(row, digits)] for name, row in noise[kind].items()),
                ),
            )
        ),
    )


def structure_section(choices: dict[str, Choice]) -> list[str]:
    """Return the section on the chosen structure and its alternatives."""
    return [
        "## The structure, chosen by innovations without truth",
        *("\n".join([f"{name}:\n", *(f"- {line}" for line in choice.lines)]) for name, choice in choices.items()),
        "What the file states of a pixel is its whole error, and the candidates of *stated size* keep it. `white` "
        "takes all of it as white; `camera jitter` as rotations of the camera that move the image as far, and white "
        "noise beside them, of the size that the NIS asks for. Its time is the block's; where the time is looked for, "
        "too, likelihood makes it as slow as a stretch is long: innovations do not show this jitter. The candidates of "
        "*any size* need not keep the whole, and with them white noise alone is chosen.",
    ]


def error_section(own: dict[str, Array]) -> list[str]:
    """Return the section on the errors of the three instruments."""
    return [
        "## Whose error it is",
        markdown_table(
            ["", *("x, mm", "y, mm", "z, mm", "roll, deg", "pitch, deg", "yaw, deg")],
            (
                [
                    f"velocities, over {HAT_FRAMES} frames" if name == "velocities" else f"{name}, one pose",
                    *own_cells(v),
                ]
                for name, v in own.items()
            ),
        ),
        f"From the variances of the differences between truth, camera and velocities over {HAT_FRAMES} frames, where "
        f"the camera sees at least {LEAST_LANDMARKS} landmarks. In roll and pitch the camera agrees better with the "
        "velocities than the truth does. So what looks like a jitter of the camera is the truth's attitude, and "
        "innovations cannot see it. It is in the stated noise because that was measured against this truth, and "
        "the covariance must contain it if NEES is to be right against the truth as it stands.",
    ]


def consistency_cells(row: dict[str, float]) -> list[str]:
    """Return the cells of one filter of `consistency_table`."""

    def with_median(mean: str, median: str) -> str:
        return f"{row[mean]:.2f} ({row[median]:.2f})" if mean in row else MISSING

    return [
        f"{row['pose_nees_mean']:.2f}",
        with_median("pose_nees_end_mean", "pose_nees_end_median"),
        with_median("pose_nees_with_truth_noise_end_mean", "pose_nees_with_truth_noise_end_median"),
        f"{row['nis_per_dof']:.2f}" if "nis_per_dof" in row else MISSING,
        with_median("landmark_nees_mean", "landmark_nees_median_window"),
        f"{row['position_rms_end_m']:.3f}",
        f"{row['rotation_rms_end_rad']:.4f}",
    ]


def own_cells(own: Array) -> list[str]:
    """Return the errors (6,) of one instrument in mm and degrees."""
    return [*(f"{1e3 * value:.1f}" for value in own[:3]), *(f"{np.rad2deg(value):.2f}" for value in own[3:])]


def noise_cells(row: dict[str, float], digits: int) -> list[str]:
    """Return the cells of one row or axis of `noise_table`."""
    sizes = [f"{row[key]:.{digits}f}" for key in ("stated_std", "std", "robust_std", "mean", "largest")]
    return [*sizes, *(f"{row[f'autocorrelation_{lag}']:.2f}" for lag in SHOWN_LAGS), f"{row['inflation']:.2f}"]


def choices_of(sequence: Sequence) -> dict[str, Choice]:
    """Choose by innovations among structures of the stated size, and of any size; the truth is removed before."""
    white, shared = stated_candidates(sequence)
    rotation, time = (f"blocks.camera_jitter.{size}" for size in ("rotation_deg", "time_s"))
    of_any_time = dataclasses.replace(shared, by_likelihood=(*shared.by_likelihood, time))
    small = with_value(shared.overrides, rotation, 0.3)
    of_any_size = (
        dataclasses.replace(white, overrides={"noise": shared.overrides["noise"]}, by_nis=shared.by_nis),
        dataclasses.replace(of_any_time, overrides=small, by_likelihood=(rotation, *of_any_time.by_likelihood)),
    )
    asked = {STATED: (white, shared), f"{STATED}, any time": (white, of_any_time), ALONE: of_any_size}
    config = Config(filter=FilterConfig(gate_probability=1.0, split_after=0))
    untold = dataclasses.replace(sequence, truth=None)
    return {name: choose(untold, config, candidates, frames=CHOOSING_FRAMES) for name, candidates in asked.items()}


def errors_of(sequence: Sequence, choice: Choice) -> tuple[Noise, tuple[StateBlock, ...]]:
    """Return noise and state blocks of a choice."""
    config = Config().with_overrides(choice.overrides)
    return noise_of(sequence, config), optional_blocks(config.blocks)


def main() -> int:
    parsed = argument_parser(__doc__, "starry_night", data=True).parse_args()
    if not has_recordings(parsed.data, STARRY_NIGHT):
        return 0

    sequence = ekfslam.open_sequence(parsed.data / STARRY_NIGHT)
    stated = sequence.noise
    assert stated is not None
    noise, own = noise_table(sequence), own_errors(sequence)
    choices = choices_of(sequence)
    filters: dict[str, tuple[Variant | None, Noise, tuple[StateBlock, ...]]] = {"dead-reckoning": (None, stated, ())}
    filters |= {variant: (variant, stated, ()) for variant in VARIANTS}
    filters |= {f"{variant}{CHOSEN}": (variant, *errors_of(sequence, choices[STATED])) for variant in VARIANTS}
    filters |= {f"invariant, {name}": ("invariant", *errors_of(sequence, choices[name])) for name in OTHERS}

    starts = range(0, len(sequence) - WINDOW_FRAMES + 1, WINDOW_FRAMES)
    of_truth = noise_of_truth(own["truth"])
    with one_thread():
        windows = {
            name: [
                # The start is drawn alike for all filters.
                run_window(sequence, variant, k, k + WINDOW_FRAMES, assumed, np.random.default_rng(k), has, of_truth)
                for k in starts
            ]
            for name, (variant, assumed, has) in filters.items()
        }

    table = consistency_table(windows)
    text = markdown(noise, table, len(starts), choices, own)
    summary = {
        "windows": len(starts),
        "frames": WINDOW_FRAMES,
        "consistency": table,
        "chosen": {name: dataclasses.asdict(choice) for name, choice in choices.items()},
        "own_errors": {name: value.tolist() for name, value in own.items()},
        "noise": noise,
    }
    figures = {"autocorrelation": plot_autocorrelation(sequence), "nees": plot_windows(windows)}
    write(parsed.out, "summary", summary, text, figures)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
