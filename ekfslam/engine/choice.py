"""The choice between the engine and the reference filter, and its reason in words."""

from __future__ import annotations

from importlib import import_module

from ekfslam.config import FilterConfig
from ekfslam.errors import ConfigError
from ekfslam.models.model import Model
from ekfslam.models.sensors.monocular import Monocular
from ekfslam.models.sensors.stereo import Rig

MISSING = ""  # the reason why there is no engine at all
try:
    if not hasattr(import_module("ekfslam.engine._engine"), "Filter"):
        MISSING = "not built in this version"
except ModuleNotFoundError:
    MISSING = "not built"
except ImportError as error:
    MISSING = f"its module cannot be loaded: {error}"


def obstacle(model: Model, config: FilterConfig) -> str:
    """Return why the engine cannot run a model with some settings; an empty text if it can."""
    own = [block.name for block in model.blocks if block.retraction == "own"]
    has_view = "view" in model.layout
    camera = [*model.layout.coupled("camera"), *model.layout.coupled("sensor")]
    if MISSING:
        return MISSING
    if type(model.sensor) not in (Rig, Monocular):
        return f"own sensor {type(model.sensor).__name__}"
    if own:
        return f"block {own[0]} has its own retract"
    if isinstance(model.sensor, Monocular) and not has_view:
        return "one camera with landmarks in xyz"
    if camera and not has_view:
        return f"block {camera[0].name} with landmarks in xyz, without track errors"
    if config.variant == "fej":
        return "variant fej"
    return "iterations > 1" if config.iterations > 1 else ""


def uses_engine(model: Model, config: FilterConfig) -> bool:
    """Return whether the engine runs a model; raise `ConfigError` if it must and cannot."""
    reason = "" if config.engine == "reference" else obstacle(model, config)
    if config.engine == "engine" and reason:
        raise ConfigError(f"filter.engine = 'engine' is impossible: {reason}")
    return config.engine != "reference" and not reason


def in_words(model: Model, config: FilterConfig) -> str:
    """Return which filter runs a model, and why if it is the reference filter."""
    if uses_engine(model, config):
        return "engine"
    reason = "as requested" if config.engine == "reference" else obstacle(model, config)
    return f"reference filter ({reason})"
