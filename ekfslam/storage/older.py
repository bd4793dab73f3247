"""Archives of older format versions in the terms of this release.

The version of a run is that of the release that wrote it. Version 1 has no log. Version 3 added hygiene and parameters,
version 4 the state blocks and the errors of tracks in the log, version 5 the coordinates of all dimensions, version 6
inputs of any process in the log.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from ekfslam.arrays import Array
from ekfslam.config import HygieneConfig
from ekfslam.data.noise import Noise
from ekfslam.filters.log import Log
from ekfslam.geometry import se3
from ekfslam.stored import FLAGS, FRAMES, NOT_NEGATIVE, NUMBERS, Item, Layout, whole, zeros

# Data sets of a log of versions before 6, in which velocities were the only inputs.
_TWIST = Item("twist", "twist", ("T", "u"), "m/s (0-2), rad/s (3-5)", "none")  # that of the first frame drives nothing
_FROM_4 = (
    Item("up", "up", ("T", "U"), "1", "world"),  # against gravity at the prediction, or (T, 0)
    *(
        Item(f"velocity_{name}", f"velocity_{name}", ("measured",), "1", "none", check)
        for name, check in (
            ("frame", FRAMES),
            ("axis", whole(0, 5)),
            ("value", NUMBERS),
            ("std", NOT_NEGATIVE),
            ("is_biased", FLAGS),
        )
    ),
)


def former(version: int) -> Mapping[type, Layout]:
    """Return the data sets of records that a release of this format version wrote, and this one does not."""
    return {Log: (_TWIST, *_FROM_4)} if version < 6 else {}


def completed(record: type, found: dict[str, Any], version: int) -> dict[str, Any]:
    """Return the fields of a record with those that a release of this format version did not write, but no others."""
    if record is Log and "tau_s" in found:
        found.setdefault("doubt", np.ones(len(found["tau_s"])))  # early releases of version 6 lack it
    if record is not Log or version > 5:
        return found
    if version < 4 and {"twist", "T_linear", "T_predicted", "T_updated", "frame"} <= found.keys():
        found = {**_blocks_of_a_pose(found), **found}
    if "tau_s" in found:
        found.setdefault("is_gap", np.zeros(len(found["tau_s"]), dtype=bool))  # some releases of version 4 lack it
    return _generic(found)


def _generic(log: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a log with velocities as the inputs of a process."""
    found = {name.replace("velocity_", "measured_"): value for name, value in log.items()}
    if "up" in found:
        found["curved"] = found.pop("up")
    if {"twist", "tau_s"} <= found.keys():
        twist, tau_s = found.pop("twist"), found["tau_s"]
        found |= {"input_frame": np.arange(1, len(tau_s)), "input_dt_s": tau_s[1:], "inputs": twist[1:]}
        found["way_m"] = np.linalg.norm(twist[:, :3], axis=1) * tau_s
    return found


def _blocks_of_a_pose(log: dict[str, Any]) -> dict[str, Any]:
    """Return the fields that version 4 added to a log, for a filter with the pose as its only block."""
    predicted = log["T_predicted"]

    def coordinates(T: Array) -> Array:
        return se3.log(T @ se3.inverse(predicted))

    departed = np.concatenate([predicted[:1], log["T_updated"][:-1]])
    updated = coordinates(log["T_updated"])
    return {
        **zeros(_FROM_4, T=len(predicted)),
        "seen_twist": log["twist"],
        "T_departed": departed,
        "T_linear_before": departed,
        "departed": np.concatenate([np.zeros((1, 6)), updated[:-1]]),
        "linear": coordinates(log["T_linear"]),
        "updated": updated,
        "previous": np.full(len(log["frame"]), -1),
    }


def config_of(config: dict[str, Any], noise: Noise, version: int) -> dict[str, Any]:
    """Return a configuration of an older version in the keys of this release.

    Before the coordinates could be chosen, landmarks were positions in world. Before version 4, ``drift`` was a share
    of the distance driven, which says nothing about today's drift in px. Before version 3, the filter had the rules of
    hygiene.
    """
    if version < 4 and "noise" in config:
        config = {**config, "noise": {**config["noise"], "drift": None}}
    config = {**config, "filter": {"landmark_coordinates": "xyz", **config.get("filter", {})}}
    if "hygiene" in config:
        return config
    rest = dict(config.get("filter", {}))
    std = noise.pixel_std_px
    rules = {
        "restart_at_repeats": rest.pop("restart_at_repeats", False),
        "min_disparity_sigma": rest.pop("min_disparity_px", 0.0) / float(np.hypot(std[0], std[2])),
        "max_row_mismatch_sigma": rest.pop("max_row_mismatch_px", 0.0) / float(np.hypot(std[1], std[3])),
        "reused_id_sigma": 0.0,
    }
    return {**config, "filter": rest, "hygiene": {**asdict(HygieneConfig()), **rules}}
