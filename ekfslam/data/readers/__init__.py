"""Readers, one file a format, found by `ekfslam.data.readers.registry`. The content of a source decides, not its name.

- Tracks: `ece276a` (.npz), `ece276a_npy` (.npy), `utias` (.mat), `hdf5` (ekfslam's own), `simulated`.
- Stereo images: `kitti_odometry`, `kitti_raw`, `euroc` (and TUM-VI), `bags`, `image_folders`, `ece276a_npy`.
- True poses: `kitti_odometry`, `kitti_raw`, `tum`, `euroc`. Velocities: `velocity_text`.
"""

from ekfslam.data.readers.hdf5 import read_sequence, write_sequence

__all__ = ["read_sequence", "write_sequence"]
