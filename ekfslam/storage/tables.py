"""Tables of a result: columns for CSV files and pandas, and the groups of an archive for xarray.

Units stand in the names of columns. Covariances are along the axes of world: of the position ``cov_xx_m2``, of the
rotation about these axes ``rot_cov_xx_rad2`` (`Result.position_covariance_world` says of which errors).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ekfslam.arrays import Array
from ekfslam.errors import ArchiveError, MissingPackageError
from ekfslam.filters.result import REASONS, Result
from ekfslam.storage.trajectories import position_and_quaternion
from ekfslam.stored import Item, coordinate, values_of

if TYPE_CHECKING:
    import pandas
    import xarray

Columns = dict[str, NDArray]

_XYZ = ("x", "y", "z")
_UPPER = tuple((i, j) for i in range(3) for j in range(i, 3))


def _named(names: tuple[str, ...], values: Array) -> Columns:
    return dict(zip(names, values.T, strict=True))


def covariance_columns(P: Array, name: str = "cov_{}_m2") -> Columns:
    """Return the six different entries of covariances (n, 3, 3)."""
    return {name.format(_XYZ[i] + _XYZ[j]): P[:, i, j] for i, j in _UPPER}


def _trajectory(result: Result) -> Columns:
    names = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
    return {
        "time_s": result.time_s,
        **_named(names, position_and_quaternion(result.T_world_imu)),
        **covariance_columns(result.position_covariance_world),
        **covariance_columns(result.rotation_covariance_world, "rot_cov_{}_rad2"),
    }


def _landmarks(result: Result) -> Columns:
    landmarks = result.landmarks
    return {
        "id": landmarks.id,
        **_named(("x_m", "y_m", "z_m"), landmarks.position_m),
        **covariance_columns(landmarks.covariance),
        **_named(("initial_x_m", "initial_y_m", "initial_z_m"), landmarks.initial_position_m),
        "first_frame": landmarks.first_frame,
        "last_frame": landmarks.last_frame,
        "observations": landmarks.observations,
    }


def _innovation(result: Result) -> Columns:
    return {"time_s": result.time_s, **vars(result.innovation)}


def _inertial(result: Result) -> Columns:
    found = result.inertial
    if found is None:
        raise ArchiveError(f"{result.sequence_name}: no table 'inertial': no inertial samples moved the poses")
    columns: Columns = {"time_s": result.time_s}
    for name, values, std, unit in (
        ("v_world", result.velocity_world_m_s, result.velocity_std_world_m_s, "m_s"),
        ("gyro_bias", found.gyro_bias_rad_s, found.std("gyro_bias"), "rad_s"),
        ("accel_bias", found.accel_bias_m_s2, found.std("accel_bias"), "m_s2"),
    ):
        columns |= _named(tuple(f"{name}_{axis}_{unit}" for axis in _XYZ), values)
        columns |= _named(tuple(f"{name}_{axis}_std_{unit}" for axis in _XYZ), std)
    return {**columns, **_named(("tilt_x_std_rad", "tilt_y_std_rad"), result.tilt_std_rad)}


def _rejections(result: Result) -> Columns:
    found = result.rejections
    reason = np.array(REASONS)[found.reason]
    return {"frame": found.frame, "time_s": result.time_s[found.frame], "landmark": found.landmark, "reason": reason}


TABLES: Mapping[str, Callable[[Result], Columns]] = MappingProxyType(
    {
        "trajectory": _trajectory,
        "landmarks": _landmarks,
        "innovation": _innovation,
        "rejections": _rejections,
        "inertial": _inertial,
    }
)


def columns(result: Result, table: str) -> Columns:
    """Return the columns (n,) of a table by name; raise an `ArchiveError` if there is no such table."""
    if table not in TABLES:
        raise ArchiveError(f"{result.sequence_name}: there is no table {table!r}; known: {', '.join(TABLES)}")
    return TABLES[table](result)


def dataframe(result: Result, table: str = "trajectory") -> pandas.DataFrame:
    """Return a table for pandas: ``trajectory``, ``landmarks``, ``innovation``, ``rejections`` or ``inertial``.

    Units stand in the names of its columns.

    Raises:
        MissingPackageError: pandas is not installed.
        ArchiveError: There is no such table.
    """
    return _package("pandas", "to_dataframe").DataFrame(columns(result, table))


def dataset(result: Result, group: str = "trajectory") -> xarray.Dataset:
    """Return a group of an archive as xarray reads it: ``trajectory``, ``landmarks``, ``innovation``, ``rejections``.

    Raises:
        MissingPackageError: xarray is not installed.
        ArchiveError: There is no such group.
    """
    groups: dict[str, list[tuple[Item, NDArray]]] = {}
    for name, item, value in values_of(result):
        groups.setdefault(item.place[0] or name.partition(".")[0], []).append((item, value))
    if group not in groups:
        raise ArchiveError(f"{result.sequence_name}: there is no group {group!r}; known: {', '.join(groups)}")
    names = () if result.parameters is None else result.parameters.name
    given = {"time": result.time_s, "parameter": np.array(names)}
    variables: dict[str, Any] = {}
    coordinates: dict[str, Any] = {}
    for item, value in groups[group]:
        for name, length in zip(item.dims, value.shape, strict=True):
            along = coordinate(name, length, given)
            along = along.astype(str) if along.dtype.kind == "S" else along
            coordinates.setdefault(name, ((name,), along, {"units": "s" if name == "time" else "1"}))
        place = coordinates if item.place[1] in item.dims else variables
        place[item.place[1]] = (item.dims, value, {"units": item.units, "frame": item.frame})
    return _package("xarray", "to_xarray").Dataset(variables, coordinates)


def _package(name: str, what: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise MissingPackageError(name, "paper", what) from None
