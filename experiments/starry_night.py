"""Starry Night: is the filter consistent on real measurements, and is their noise what the file says it is?

The indoor recording of UTIAS (`dataset3.mat`) is rare in that everything is known: the pose at every frame from a
motion capture system, the positions of all 20 landmarks, and the variances of velocities and pixels. So the covariance
can be held against the true error of pose and map,

    eps = e^T P^-1 e,   expected: 6 for a pose, 3 for a landmark,

and the noise against its model by what the measurements leave at the truth,

    r(k) = z(k) - M pi(T_cam_imu T_imu_world(k) m),   w(k) = u(k) + log(T_imu_world(k) T_imu_world(k-1)^-1) / tau.

The recording is cut into windows of 100 frames. Each starts from the true pose, displaced by a draw from the prior that
the filter is given, with an empty map; windows are the samples. Gates are off: the question is what the noise model as
stated is worth, and nothing shall be hidden.

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
from threadpoolctl import threadpool_limits

import ekfslam
from ekfslam.arrays import Array, IntArray
from ekfslam.config import FilterConfig, Variant
from ekfslam.data.sequence import WITHOUT_TRACKS, Noise, Observations, Sequence
from ekfslam.evaluation.consistency import chi2_bounds, invariant_landmark_error, nees, pose_error
from ekfslam.evaluation.tables import MISSING, document, markdown_table
from ekfslam.evaluation.trajectory import match_landmarks
from ekfslam.figures.style import BOUNDS, EXPECTED, SERIES, SKY_BLUE, ZERO, log_axis, marker_of, styled
from ekfslam.filters import JointEKF
from ekfslam.filters.loop import run_filter
from ekfslam.geometry import camera, se3
from ekfslam.models.sensors.stereo import Rig

VARIANTS: tuple[Variant, ...] = ("invariant", "fej", "standard")
WINDOW_FRAMES = 100
PRIOR_POSITION_M, PRIOR_ROTATION_RAD = 0.01, 0.01
LAGS, SHOWN_LAGS = 40, (1, 2, 5, 10, 20)  # frames
PROBABILITY = 0.95
ROWS = ("uL", "vL", "uR", "vR")
AXES = ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z")


# --- The noise -------------------------------------------------------------------------------------------------------


def pixel_residuals(sequence: Sequence) -> Array:
    """Measured minus true pixels (K, 4) of every observation, all of whose landmarks are known."""
    truth, seen = truth_of(sequence), sequence.observations
    position = dict(zip(truth.landmark.tolist(), truth.position_m, strict=True))
    points = np.array([position[i] for i in seen.landmark.tolist()])
    q = se3.apply(sequence.T_cam_imu @ se3.inverse(truth.T_world_imu[seen.frame]), points)
    return seen.pixels_px - camera.project(sequence.camera, q)


def velocity_residuals(sequence: Sequence) -> Array:
    """Measured minus true velocities (T-1, 6), m/s and rad/s, of the intervals that end at frames 1, 2, ..."""
    T = se3.inverse(truth_of(sequence).T_world_imu)
    tau = np.diff(sequence.time_s)[:, None]
    return sequence.twist[1:] + se3.log(T[1:] @ se3.inverse(T[:-1])) / tau


def autocorrelation(values: Array, lags: int, group: IntArray, index: IntArray) -> Array:
    """Correlation (lags+1, n) of values (K, n) with themselves ``lag`` frames later, within groups.

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
    """Standard deviation (n,) of values (K, n), found from the median absolute deviation, which spares gross errors."""
    return np.median(np.abs(values - np.median(values, axis=0)), axis=0) / 0.6745


# --- Windows ---------------------------------------------------------------------------------------------------------


NOTHING_SEEN: dict[str, Any] = {
    "observations": Observations(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty((0, 4))),
    "attributes": WITHOUT_TRACKS,
}


@dataclass(frozen=True)
class Window:
    """One variant on one window: pose NEES (n,) after each frame, landmark NEES (m,) and pose error (6,) at the end."""

    pose_nees: Array
    landmark_nees: Array
    final_error: Array


def run_window(
    sequence: Sequence, variant: Variant | None, start: int, stop: int, noise: Noise, rng: np.random.Generator
) -> Window:
    """Filter the frames ``start`` to ``stop - 1``; the variant None is dead reckoning, which sees nothing."""
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
    ekf = JointEKF(Rig(sequence.camera, sequence.T_cam_imu, noise), config, truth.T_world_imu[start] @ se3.exp(xi))
    T_world_imu, covariance = np.empty((stop - start, 4, 4)), np.empty((stop - start, 6, 6))
    frames = dataclasses.replace(sequence, **NOTHING_SEEN) if variant is None else sequence
    for i, _ in enumerate(run_filter(ekf, frames, range(start, stop))):
        T_world_imu[i], covariance[i] = ekf.T_world_imu, ekf.P[:6, :6]

    error = pose_error(T_world_imu, truth.T_world_imu[start:stop])
    landmarks = ekf.landmarks()
    rows, known = match_landmarks(landmarks, truth)
    m_hat, m_true = landmarks.position_m[rows], truth.position_m[known]
    if variant == "invariant":
        d = invariant_landmark_error(m_hat, m_true, T_world_imu[-1], truth.T_world_imu[stop - 1])
    else:
        d = m_true - m_hat
    return Window(nees(error, covariance), nees(d, landmarks.covariance[rows]), error[-1])


# --- Tables and figures ----------------------------------------------------------------------------------------------

STYLES = {
    **{name: marker_of(name) for name in ("dead-reckoning", *VARIANTS)},
    "invariant, wider pixels": {**marker_of("invariant"), "color": SKY_BLUE, "marker": "v"},
}


def noise_table(sequence: Sequence) -> dict[str, dict[str, dict[str, float]]]:
    """Stated and real noise: ``{"pixels" or "velocities": {row or axis: {figure: value}}}``."""
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
    """The factor (n,) on a standard deviation that makes the mean of correlated samples as uncertain as it is.

    ``sqrt(1 + 2 sum rho)`` over the lags (lags+1, n) before the correlation first vanishes; white noise has 1.
    """
    before = np.cumprod(rho[1:] > 0, axis=0)
    return np.sqrt(1.0 + 2.0 * np.sum(rho[1:] * before, axis=0))


def consistency_table(windows: dict[str, list[Window]]) -> dict[str, dict[str, float]]:
    """Means and medians over windows, the samples, for every filter."""
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
            "position_rms_end_m": np.sqrt(np.mean(np.sum(error[:, :3] ** 2, axis=1))),
            "rotation_rms_end_rad": np.sqrt(np.mean(np.sum(error[:, 3:] ** 2, axis=1))),
        }
        if len(runs[0].landmark_nees):
            per_window = np.array([run.landmark_nees.mean() for run in runs])
            table[name]["landmark_nees_mean"] = per_window.mean()
            table[name]["landmark_nees_median_window"] = np.median(per_window)
    return {name: {key: float(value) for key, value in row.items()} for name, row in table.items()}


@styled
def plot_autocorrelation(sequence: Sequence) -> Figure:
    """Autocorrelation of the pixel residuals of each landmark, and of the velocity residuals, over the lag."""
    seen = sequence.observations
    r, w = pixel_residuals(sequence), velocity_residuals(sequence)
    rho_r = autocorrelation(r, LAGS, seen.landmark, seen.frame)
    rho_w = autocorrelation(w, LAGS, np.zeros(len(w), dtype=np.int64), np.arange(1, len(sequence)))
    figure = Figure(figsize=(9.0, 3.8))
    axes = figure.subplots(1, 2, sharey=True)
    for ax, title, names, rho, count in (
        (axes[0], "pixels, per landmark", ROWS, rho_r, len(r)),
        (axes[1], "velocities", [f"${name}$" for name in AXES], rho_w, len(w)),
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
    """NEES of the pose at the end of every window, and of its landmarks there, with chi-square bounds."""
    figure = Figure(figsize=(9.0, 6.2))
    pose_ax, landmark_ax = figure.subplots(2, 1, sharex=True)
    bounds_label = f"{100 * PROBABILITY:g} % chi-square bounds"
    for ax, dof, label in ((pose_ax, 6, bounds_label), (landmark_ax, 3, None)):
        ax.axhspan(*chi2_bounds(dof, PROBABILITY), **BOUNDS, label=label)
        ax.axhline(dof, **EXPECTED)
    for i, (name, runs) in enumerate(windows.items()):
        # Side by side, or filters that agree would hide one another.
        number = np.arange(1, len(runs) + 1) + 0.14 * (i - (len(windows) - 1) / 2)
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


def markdown(noise: dict[str, dict[str, dict[str, float]]], table: dict[str, dict[str, float]], count: int) -> str:
    """The report of the experiment."""
    low, high = chi2_bounds(6, PROBABILITY, count)
    landmark_low, landmark_high = chi2_bounds(3, PROBABILITY, count)
    return document(
        f"# Starry Night\n\n{count} windows of {WINDOW_FRAMES} frames, noise as the file states it.",
        markdown_table(
            [
                *("filter", "pose NEES, all frames", "pose NEES, last frame (median)", "landmark NEES (median)"),
                *("m", "rad"),
            ],
            ([name, *consistency_cells(row)] for name, row in table.items()),
        ),
        f"Expected 6 and 3; {100 * PROBABILITY:g} % of means of {count} windows lie in {low:.2f}-{high:.2f} for the "
        f"last frame's pose and, were a window's landmarks one sample, in {landmark_low:.2f}-{landmark_high:.2f}. "
        "m and rad: root mean square errors of the pose at the last frame, in stored coordinates. *Wider pixels* have "
        "the stated standard deviations times the inflation below, by which correlation in time makes the mean of many "
        "pixels more uncertain than that of white ones, `sqrt(1 + 2 sum rho)`.",
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


def consistency_cells(row: dict[str, float]) -> list[str]:
    """One filter of `consistency_table`."""

    def with_median(mean: str, median: str) -> str:
        return f"{row[mean]:.2f} ({row[median]:.2f})" if mean in row else MISSING

    return [
        f"{row['pose_nees_mean']:.2f}",
        with_median("pose_nees_end_mean", "pose_nees_end_median"),
        with_median("landmark_nees_mean", "landmark_nees_median_window"),
        f"{row['position_rms_end_m']:.3f}",
        f"{row['rotation_rms_end_rad']:.4f}",
    ]


def noise_cells(row: dict[str, float], digits: int) -> list[str]:
    """One row or axis of `noise_table`."""
    sizes = [f"{row[key]:.{digits}f}" for key in ("stated_std", "std", "robust_std", "mean", "largest")]
    return [*sizes, *(f"{row[f'autocorrelation_{lag}']:.2f}" for lag in SHOWN_LAGS), f"{row['inflation']:.2f}"]


def main() -> int:
    parsed = argument_parser(__doc__, "starry_night", data=True).parse_args()
    if not has_recordings(parsed.data, STARRY_NIGHT):
        return 0

    sequence = ekfslam.open_sequence(parsed.data / STARRY_NIGHT)
    stated = sequence.noise
    assert stated is not None
    noise = noise_table(sequence)
    wider = Noise(stated.twist_std, stated.pixel_std_px * [row["inflation"] for row in noise["pixels"].values()])
    filters: dict[str, tuple[Variant | None, Noise]] = {"dead-reckoning": (None, stated)}
    filters |= {variant: (variant, stated) for variant in VARIANTS}
    filters["invariant, wider pixels"] = ("invariant", wider)

    starts = range(0, len(sequence) - WINDOW_FRAMES + 1, WINDOW_FRAMES)
    with threadpool_limits(1, user_api="blas"):
        windows = {
            name: [
                # The start is drawn alike for all filters.
                run_window(sequence, variant, k, k + WINDOW_FRAMES, assumed, np.random.default_rng(k))
                for k in starts
            ]
            for name, (variant, assumed) in filters.items()
        }

    table = consistency_table(windows)
    text = markdown(noise, table, len(starts))
    summary = {"windows": len(starts), "frames": WINDOW_FRAMES, "consistency": table, "noise": noise}
    figures = {"autocorrelation": plot_autocorrelation(sequence), "nees": plot_windows(windows)}
    write(parsed.out, "summary", summary, text, figures)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
