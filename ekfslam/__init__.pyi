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
from .data.images import ImageRecording
from .data.imu import attach_inertial
from .data.inputs import InertialNoise, InertialSamples, Velocities
from .data.noise import Noise
from .data.opening import attach_truth, open_images
from .data.readers.hdf5 import write_sequence
from .data.readers.kitti_raw import open_kitti_raw
from .data.readers.registry import Reader, Source
from .data.readers.tum import read_trajectory
from .data.sequence import Observations, Sequence, Truth
from .data.trajectory import Trajectory
from .data.velocities import attach_velocities
from .errors import EkfslamError
from .filters.live import LiveEKF
from .filters.result import Result
from .frontend.opening import open_sequence
from .frontend.track import TrackReport, track
from .geometry.camera import StereoCamera
from .given import trajectory_covariance
from .live_stereo import LiveStereo
from .others import Others
from .page.report import write_report
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
    "InertialNoise",
    "InertialSamples",
    "LiveEKF",
    "LiveStereo",
    "Noise",
    "NoiseConfig",
    "Observations",
    "Others",
    "Posterior",
    "PosteriorConfig",
    "Reader",
    "Result",
    "Sequence",
    "Source",
    "StereoCamera",
    "Study",
    "TrackReport",
    "Trajectory",
    "Truth",
    "TruthConfig",
    "TunedNoise",
    "Velocities",
    "attach_inertial",
    "attach_truth",
    "attach_velocities",
    "check",
    "check_consistency",
    "compare",
    "open_images",
    "open_kitti_raw",
    "open_sequence",
    "posterior",
    "read_archive",
    "read_trajectory",
    "run",
    "smooth",
    "track",
    "trajectory_covariance",
    "tune",
    "write_archive",
    "write_report",
    "write_sequence",
]
