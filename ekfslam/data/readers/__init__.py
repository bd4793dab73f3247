"""Readers, one file a format, found by `ekfslam.data.readers.registry`. The content of a source decides, not its name.

- Tracks: .npz of the report and its later edition (`ece276a`), .npy from 2025 on (`ece276a_npy`), .mat of UTIAS
  (`utias`), ekfslam's own HDF5 files (`hdf5`), and simulated worlds (`simulated`).
- Stereo images: KITTI (`kitti_odometry`, `kitti_raw`), EuRoC and TUM-VI (`euroc`), bags of ROS and MCAP (`bags`), plain
  folders (`image_folders`), and the course data (`ece276a_npy`).
- True poses: `kitti_odometry`, `kitti_raw`, `tum`, `euroc`. Velocities: `velocity_text`.

A drive folder of KITTI raw without images is a recording without tracks, which serves dead reckoning.
"""

from ekfslam.data.readers.hdf5 import read_sequence, write_sequence

__all__ = ["read_sequence", "write_sequence"]
