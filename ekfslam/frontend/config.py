"""Settings of the front end."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FrontEndConfig:
    """How images become tracks. Lengths are in pixels.

    Args:
        features: How many are wanted in a frame; about two thirds are seen.
        refill: Share of them below which new ones are detected.
        corner_block: Window of the structure tensor of a corner.
        corner_quality: Least eigenvalue of a corner, as a share of the largest in the image.
        spacing: Least distance between features.
        border: Least distance from the border of the image.
        buckets: Columns and rows of the grid over which new features are spread.
        match_patch: Side of the patch that is sought along the row of the right image.
        max_disparity, min_disparity: Of a new feature.
        match_score: Least normalised cross-correlation of a new feature.
        match_margin: By how much that must be above the second peak.
        row_limit: Largest row difference of a pair, after the rotation of the right camera is taken out.
        window: Side of the window of Lucas-Kanade.
        levels: Levels of its pyramid.
        backward_limit: Largest error when a feature is tracked there and back.
        template: Side of the patch of first sight.
        template_score: Least correlation with it, in the left and in the right image.
        template_shift: How far alignment to it may move a feature.
        pixel_std: Standard deviation of a row, in the motion of the rig.
        kernel: Scale of the robust kernel there, in standard deviations.
        residual_limit: Observations with larger residuals are not reported.
        strikes: After so many of them in a row, a feature is dropped,
        residual_drop: or at once with such a residual.
        samples: Of three points each, where the motion is not known beforehand.
        rotation_deg: Prior standard deviation of the right camera's rotation against its calibration, each axis.
        rotation_gap: Frames between the two frames from which yaw is found.
        settling: Frames at the start whose pixels are corrected by the rotation known after them.
        seed: Of random samples.
    """

    features: int = 120
    refill: float = 0.9
    corner_block: int = 5
    corner_quality: float = 4e-4
    spacing: int = 10
    border: int = 9
    buckets: tuple[int, int] = (12, 4)
    match_patch: int = 11
    max_disparity: float = 180.0
    min_disparity: float = 2.0
    match_score: float = 0.75
    match_margin: float = 0.03
    row_limit: float = 1.0
    window: int = 15
    levels: int = 3
    backward_limit: float = 0.7
    template: int = 15
    template_score: tuple[float, float] = (0.8, 0.7)
    template_shift: float = 2.0
    pixel_std: float = 0.3
    kernel: float = 2.0
    residual_limit: float = 2.0
    strikes: int = 2
    residual_drop: float = 10.0
    samples: int = 200
    rotation_deg: float = 0.1
    rotation_gap: int = 4
    settling: int = 10
    seed: int = 0
