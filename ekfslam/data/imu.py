"""Inertial samples from elsewhere: of a file, a folder or a bag, for a recording of tracks or of images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ekfslam.data.images import ImageRecording
from ekfslam.data.inertial import NOT_STATED, InertialRows, covered_frames, samples_of
from ekfslam.data.inputs import InertialNoise, InertialSamples, Velocities
from ekfslam.data.readers.fields import BODY_IS_CAMERA
from ekfslam.data.readers.imu_yaml import find_chain, read_chain, read_imu_yaml
from ekfslam.data.readers.registry import Source, expected, read_as
from ekfslam.data.sequence import Sequence
from ekfslam.data.velocities import NO_VELOCITIES, Recording, of_body
from ekfslam.errors import CalibrationError, ExtrinsicsError, LostDataError, UnknownFormatError
from ekfslam.geometry.camera import T_CAM_BODY

_DROPPED = "its densities are not used"  # in a note on a file that states some


def attach_inertial(recording: Recording, path: str | Path, noise: str | Path | None = None) -> Recording:
    """Return a recording, of tracks or of images, with the inertial samples of a file in place of its own.

    The body of the recording has to be the inertial unit. If no file of the recording states ``T_cam_imu``, that of
    ``cam0`` in a chain of Kalibr beside the samples is taken; its ``timeshift_cam_imu`` is always applied.

    Args:
        recording: Recording, with velocities or without.
        path: Text file (see `readers.imu_text`), folder ``imu0`` of EuRoC, bag, or .npz with arrays of samples.
        noise: ``sensor.yaml`` or ``imu.yaml`` with the densities; by default such a file beside the samples.

    Raises:
        UnknownFormatError: A file is missing or of unknown content.
        CalibrationError: The file of densities does not state all four.
        ExtrinsicsError: Nothing states ``T_cam_imu``.
        LostDataError: The samples do not cover two frames.
        DataError: Stamps go back, a line is malformed, or units cannot be right; the error says what to do.
    """
    source = Source.at(path)
    rows: InertialRows | None = read_as(source, "inertial")
    if rows is None:
        problem = source.problem or "unknown content"
        raise UnknownFormatError(f"{path}: no inertial samples ({problem}); {expected('inertial')}")
    rows = _with_chain(rows, Path(path), _lacks_extrinsics(recording))
    if noise is not None:
        rows = replace(rows, noise=_stated(noise), notes=tuple(note for note in rows.notes if _DROPPED not in note))
    if rows.T_cam_imu is None and _lacks_extrinsics(recording):
        message = "no file states T_cam_imu, from the inertial unit to the left camera"
        remedy = f"put camchain-imucam.yaml of Kalibr beside {path}, or T_cam_imu into the calibration"
        raise ExtrinsicsError(f"{message}; {remedy}", source=recording.source)
    return with_rows(recording, rows)


def attach_inertial_noise(recording: Recording, path: str | Path) -> Recording:
    """Return a recording with the noise densities of ``sensor.yaml`` or ``imu.yaml`` for its inertial samples."""
    if recording.inertial is None:
        raise LostDataError("there are no inertial samples, hence no densities of their noise", source=recording.source)
    changes = _with_samples(recording, replace(recording.inertial, noise=_stated(path)))
    changes["notes"] = (
        *(note for note in recording.notes if not note.startswith(NOT_STATED) and _DROPPED not in note),
        f"Noise densities from {path}.",
    )
    return replace(recording, **changes)


def with_inertial_files(recording: Recording, samples: str | Path | None, noise: str | Path | None) -> Recording:
    """Return a recording with the samples and the densities of files, if any are given; ``none`` leaves its own out."""
    if str(samples) == "none" and not Path("none").exists():
        notes = (*recording.notes, "The inertial samples of the recording are left out.")
        if isinstance(recording, ImageRecording):
            return replace(recording, inertial=None, notes=notes)
        return replace(recording, inputs=tuple(x for x in recording.inputs if isinstance(x, Velocities)), notes=notes)
    if samples is not None:
        return attach_inertial(recording, samples, noise)
    return recording if noise is None else attach_inertial_noise(recording, noise)


def _stated(path: str | Path) -> InertialNoise:
    read = read_imu_yaml(Path(path))
    if read.noise is None:
        raise CalibrationError(" ".join(read.notes), source=str(path))
    return read.noise


def _with_samples(recording: Sequence | ImageRecording, samples: InertialSamples) -> dict[str, Any]:
    if isinstance(recording, ImageRecording):
        return {"inertial": samples}
    return {"inputs": (*(each for each in recording.inputs if isinstance(each, Velocities)), samples)}


def _with_chain(rows: InertialRows, place: Path, takes_extrinsics: bool) -> InertialRows:
    """Return the rows with what a chain of Kalibr beside them states."""
    chain = find_chain(place if place.is_dir() else place.parent)
    if chain is None:
        return rows
    late_s, T_cam_imu, notes = read_chain(chain)
    rows = replace(rows, late_s=late_s)
    return replace(rows, T_cam_imu=T_cam_imu, notes=(*rows.notes, *notes)) if takes_extrinsics else rows


def _lacks_extrinsics(recording: Sequence | ImageRecording) -> bool:
    return any(BODY_IS_CAMERA in note for note in recording.notes)


def with_rows(recording: Recording, rows: InertialRows) -> Recording:
    """Return a recording with samples on its clock; frames that they do not cover are left out. See `samples_of`."""
    found: tuple[str, ...]
    samples, found = samples_of(rows)
    begin, end = covered_frames(samples, recording.time_s, rows.source)
    notes: list[str] = [note for note in recording.notes if not note.startswith(NO_VELOCITIES)]
    if rows.T_cam_imu is not None:
        notes = [note for note in notes if BODY_IS_CAMERA not in note]
    notes += [f"Inertial samples from {rows.source}.", *found]
    if (left_out := len(recording.time_s) - (end - begin)) > 0:
        recording = recording[begin:end]
        notes.append(f"{left_out} frames before or after all inertial samples are left out.")
    changes: dict[str, Any] = {} if rows.T_cam_imu is None else of_body(recording, rows.T_cam_imu)
    if np.array_equal(changes.get("T_cam_imu", recording.T_cam_imu), T_CAM_BODY):
        notes.append("No file states T_cam_imu: the inertial unit is taken to be the left camera, x forward.")
    attributes = {**recording.attributes, **rows.attributes}
    attributes |= {"imu_late_s": rows.late_s} if rows.late_s else {}
    changes |= _with_samples(recording, samples)
    return replace(recording, notes=tuple(notes), attributes=attributes, **changes)
