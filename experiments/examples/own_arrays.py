"""A recording from plain arrays, with nothing in files; stretches of it; velocities from a text file.

It shows `Sequence.from_tracks`, ``sequence[100:300]`` and ``sequence.between``, `attach_velocities`, and a recording
without velocities.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

import ekfslam
from ekfslam.data.simulate import Loop, simulate


def main() -> None:
    # What a tracker of one's own would give: pixels (uL, vL, uR, vR) of every frame and track, NaN where unseen.
    recorded = simulate(Loop(frames=120))
    seen, truth = recorded.observations, recorded.truth
    assert truth is not None
    pixels = np.full((len(recorded), int(seen.ids.max()) + 1, 4), np.nan)
    pixels[seen.frame, seen.landmark] = seen.pixels_px

    tracks = ekfslam.Sequence.from_tracks(recorded.time_s, pixels, recorded.camera, T_world_imu=truth.T_world_imu)
    print(f"built: {len(tracks)} frames, {len(tracks.observations)} observations, attributes {dict(tracks.attributes)}")
    try:
        ekfslam.Sequence.from_tracks(recorded.time_s, pixels, recorded.camera, twist=recorded.twist)
    except ekfslam.EkfslamError as error:
        print(f"refused: {error}")

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "velocities.csv"
        table = np.column_stack([recorded.time_s, recorded.twist])
        np.savetxt(path, table, delimiter=",", header="frame: imu\ntime,vx,vy,vz,wx,wy,wz")
        moving = ekfslam.attach_velocities(tracks, path)
    print(f"velocities: {moving.notes[-1].split(': ')[-1]}")

    whole = ekfslam.Sequence.from_tracks(
        recorded.time_s,
        pixels,
        recorded.camera,
        twist=recorded.twist,
        T_cam_imu=recorded.T_cam_imu,
        T_world_imu=truth.T_world_imu,
        noise=recorded.noise,
    )
    for name, part in (("frames 20:80", whole[20:80]), ("from 3 to 6 s", whole.between(3.0, 6.0))):
        result = ekfslam.run(part)
        assert part.truth is not None
        error_m = np.linalg.norm(result.T_world_imu[:, :3, 3] - part.truth.T_world_imu[:, :3, 3], axis=1)
        print(f"{name}: {len(part)} frames, largest error of a position {error_m.max():.3f} m")


if __name__ == "__main__":
    main()
