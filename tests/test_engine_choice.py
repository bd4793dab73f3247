"""The choice between the engine and the reference filter."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ekfslam.cli import main
from ekfslam.config import CalibrationConfig, FilterConfig
from ekfslam.data.noise import Noise
from ekfslam.engine import choice
from ekfslam.errors import ConfigError
from ekfslam.geometry.camera import StereoCamera
from ekfslam.models.blocks import CameraJitter, StateBlock
from ekfslam.models.build import model_of
from ekfslam.models.model import Model
from ekfslam.models.sensors.stereo import Rig

CAMERA = StereoCamera(500.0, 500.0, 320.0, 240.0, 0.5)
RIG = Rig(CAMERA, np.eye(4), Noise.isotropic(0.05, 0.001, 1.0))


@dataclasses.dataclass(frozen=True)
class Offset(StateBlock):
    """A vector of the user's own."""

    name = "offset"
    size = 2


@dataclasses.dataclass(frozen=True)
class Angle(Offset):
    """A block with an error of its own."""

    name = "angle"

    def retract(self, value, correction):
        return np.remainder(value + correction, 2 * np.pi)


@dataclasses.dataclass(frozen=True)
class OwnRig(Rig):
    """A sensor of the user's own."""


def model(sensor=RIG, *blocks: StateBlock, **settings) -> Model:
    return model_of(sensor, sensor.noise, np.eye(4), np.zeros((6, 6)), blocks=blocks, **settings)


@pytest.fixture(autouse=True)
def built(monkeypatch):
    """The choice does not depend on whether the engine is built here."""
    monkeypatch.setattr(choice, "MISSING", "")


def test_the_engine_runs_a_block_of_data_alone():
    assert choice.in_words(model(RIG, Offset()), FilterConfig()) == "engine"


@pytest.mark.parametrize(
    ("chosen", "settings", "reason"),
    [
        (model(RIG, Angle()), {}, "block angle has its own retract"),
        (model(OwnRig(CAMERA, np.eye(4), RIG.noise)), {}, "own sensor OwnRig"),
        (
            model(calibration=CalibrationConfig(time_s=0.01), coordinates="xyz"),
            {},
            "block calibration with landmarks in xyz, without track errors",
        ),
        (
            model(RIG, CameraJitter(), coordinates="xyz"),
            {},
            "block camera_jitter with landmarks in xyz, without track errors",
        ),
        (model(), {"variant": "fej"}, "variant fej"),
        (model(), {"iterations": 2}, "iterations > 1"),
        (model(), {"engine": "reference"}, "as requested"),
    ],
)
def test_the_reason_for_the_reference_filter_is_named(chosen, settings, reason):
    assert choice.in_words(chosen, FilterConfig(**settings)) == f"reference filter ({reason})"


def test_an_engine_that_is_not_built_leaves_the_reference_filter(monkeypatch):
    monkeypatch.setattr(choice, "MISSING", "not built")
    assert choice.in_words(model(), FilterConfig()) == "reference filter (not built)"


def test_asking_for_the_engine_where_it_cannot_run_is_an_error():
    with pytest.raises(ConfigError, match=r"filter\.engine = 'engine' is impossible: variant fej"):
        choice.uses_engine(model(), FilterConfig(engine="engine", variant="fej"))


def test_info_names_the_filter_and_the_reason(capsys, monkeypatch):
    monkeypatch.setattr(choice, "MISSING", "not built")
    assert main(["info", "builtin:city", "--frames", "0:5"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("filter  ")]
    assert [line.split(maxsplit=1)[1] for line in lines] == ["reference filter (not built)"]
