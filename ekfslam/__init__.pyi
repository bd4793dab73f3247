from .config import (
    MODES,
    VARIANTS,
    CalibrationConfig,
    Config,
    FilterConfig,
    HygieneConfig,
    NoiseConfig,
    PosteriorConfig,
    TruthConfig,
)
from .data.readers import open_sequence, write_sequence
from .data.sequence import Sequence
from .errors import EkfslamError
from .filters.live import LiveEKF
from .filters.result import Result
from .reports import Comparison, check, check_consistency, compare
from .runner import run
from .smoother.posterior import Posterior, posterior, smooth
from .storage.archive import read_archive, write_archive
from .studies.study import LEVELS, Study
from .studies.tuning import TunedNoise, tune

__version__: str

__all__ = [
    "LEVELS",
    "MODES",
    "VARIANTS",
    "CalibrationConfig",
    "Comparison",
    "Config",
    "EkfslamError",
    "FilterConfig",
    "HygieneConfig",
    "LiveEKF",
    "NoiseConfig",
    "Posterior",
    "PosteriorConfig",
    "Result",
    "Sequence",
    "Study",
    "TruthConfig",
    "TunedNoise",
    "check",
    "check_consistency",
    "compare",
    "open_sequence",
    "posterior",
    "read_archive",
    "run",
    "smooth",
    "tune",
    "write_archive",
    "write_sequence",
]
