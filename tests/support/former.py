"""Archives as older releases wrote them."""

import h5py
import numpy as np

NEW_IN_6 = ("input_frame", "input_dt", "inputs", "way", "curved")
NEW_IN_6 += tuple(f"measured_{name}" for name in ("frame", "axis", "value", "std", "is_biased"))
NEW_IN_4 = ("imu_twist", "seen_twist", "T_imu_world_departed", "T_imu_world_linear_before", "departed", "linear")
NEW_IN_4 += ("updated", "up", "previous", "velocity_frame", "velocity_axis", "velocity_value", "velocity_std")
NEW_IN_4 += ("velocity_is_biased", "is_gap")


def age_log(log: h5py.Group, version: int) -> None:
    """Rewrite the log of a run, made with one velocity a frame, as a release of format version 3, 4 or 5 had it."""
    found = {name: log[name][()] for name in NEW_IN_6}
    first = log["initial_covariance"][:6, :6]
    twist = np.concatenate([np.zeros((1, 6)), found["inputs"]])
    former = {"twist": twist, "imu_twist": twist, "up": found["curved"]}
    former |= {name.replace("measured", "velocity"): found[name] for name in NEW_IN_6 if name.startswith("measured")}
    for name in (*NEW_IN_6, "initial_covariance", "prior_coordinate", "prior_coordinate_2"):
        del log[name]
    log["initial_covariance"] = first
    for name, value in former.items():
        log[name] = value
    if version < 4:
        for name in NEW_IN_4:
            del log[name]
