from .config import (
    MODES,
    VARIANTS,
    CalibrationConfig,
    Config,
    FilterConfig,
    FrontEndConfig,
    HygieneConfig,
    NoiseConfig,
    PosteriorConfig,
    TruthConfig,
)
from .data.images import ImageRecording, open_images
from .data.readers import write_sequence
from .data.sequence import Sequence
from .errors import EkfslamError
from .filters.result import Result
from .frontend.opening import open_sequence
from .frontend.track import TrackReport, track
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
    "FrontEndConfig",
    "HygieneConfig",
    "ImageRecording",
    "NoiseConfig",
    "Posterior",
    "PosteriorConfig",
    "Result",
    "Sequence",
    "Study",
    "TrackReport",
    "TruthConfig",
    "TunedNoise",
    "check",
    "check_consistency",
    "compare",
    "open_images",
    "open_sequence",
    "posterior",
    "read_archive",
    "run",
    "smooth",
    "track",
    "tune",
    "write_archive",
    "write_sequence",
]
