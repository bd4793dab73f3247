"""Short studies."""

from __future__ import annotations

import dataclasses

from ekfslam.studies.study import LEVELS


def short(level: str = "mid", frames: int = 8, **changes):
    return {level: dataclasses.replace(LEVELS[level], frames=frames, **changes)}
