"""Parameters of the detection of moving targets, and constants of its maps."""

import math
from typing import Annotated, Literal

from pydantic import Field

from torchvision_dddas.config.group import Group, Odd, parameter

EVIDENCE_SCALE, EVIDENCE_CAP = 16.0, 240
"""Evidence is stored in 8-bit maps, in steps of 1/16 of the local noise, clipped at 15 noise units."""

HALF = 127
"""A smoothed silhouette of 0 and 255 is set above this level."""

WHITE = 248
"""Pixels with at least this grey level may be clipped."""

EXPOSURE_PIXELS = 2000
"""Approximate number of pixels to which the exposure of a warped picture is fitted."""


def exposure_step(shape: tuple[int, ...]) -> int:
    """Return the step of the rows and columns of a picture, (H, W), that are used to fit the exposure.

    The step is odd, because compressed pictures have less contrast on a grid of 2, 4 or 8 px.
    """
    return math.isqrt(shape[0] * shape[1] // EXPOSURE_PIXELS) | 1


class RegistrationParameters(Group):
    """Registration: the background's motion between two frames (appendix B, steps S1 to S3)."""

    model: Literal["homography", "affine"] = parameter(
        "homography", "model of the background's motion; affine is the earlier baseline"
    )
    keypoints: int = parameter(500, "largest number of keypoints in a frame (Shi-Tomasi corners)", "points", 50, 5000)
    corners: Literal["cells", "frame"] = parameter(
        "cells", "keypoints: the best corner of every grid cell, or the best of the whole frame, as the source has them"
    )
    min_distance_px: int = parameter(8, "smallest distance between keypoints (corners = frame)", "px", 1, 100)
    cell_px: int = parameter(
        16, "side of the grid cells, which keep their best point each; grows until `keypoints` suffice", "px", 4, 256
    )
    quality: float = parameter(0.01, "smallest eigenvalue of a point as a share of the frame's largest", "-", 1e-4, 0.5)
    block_px: Odd = parameter(5, "window over which the structure tensor is summed, odd", "px", 3, 15)
    window_px: Odd = parameter(21, "Lucas-Kanade's window, odd", "px", 5, 51)
    levels: int = parameter(4, "pyramid levels above full resolution", "levels", 0, 6)
    iterations: int = parameter(30, "largest number of Lucas-Kanade steps per level", "steps", 1, 100)
    epsilon_px: float = parameter(0.01, "Lucas-Kanade stops when a step is shorter than this", "px", 1e-4, 1)
    forward_backward_px: float = parameter(
        1.0, "largest error of a point tracked forward and back; 0 switches the check off", "px", 0, 20
    )
    ransac_px: float = parameter(2.0, "a point this close to the model's prediction is an inlier", "px", 0.1, 20)
    hypotheses: int = parameter(128, "number of models that RANSAC draws", "models", 8, 4096)
    redetect_frames: int = parameter(
        5, "frames between detections of keypoints; the inliers are tracked in between (onboard)", "frames", 1, 60
    )
    halved_corners: bool = parameter(False, "detect keypoints at half resolution: faster, less accurate")
    halved: bool = parameter(False, "register frames at half resolution: faster, half as accurate (onboard)")
    direct: bool = parameter(
        False, "register a frame directly to each compared frame, as the source does; false chains successive steps"
    )
    min_inliers: int = parameter(20, "with fewer inliers the registration is unreliable", "points", 4, 5000)
    min_inlier_share: float = parameter(0.2, "with a smaller inlier share the registration is unreliable", "-", 0, 1)

    def cell_side(self, width: int, height: int) -> int:
        """Return the side in pixels of the grid cells, such that one keypoint a cell is within the budget."""
        return max(self.cell_px, math.ceil(math.sqrt(width * height / self.keypoints)))


class IntervalParameters(Group):
    """The detection interval and the rule that controls it (appendix B, eq. 2)."""

    rule: bool = parameter(True, "adapt the interval to altitude, speed and frame rate; false keeps `frames`")
    frames: int = parameter(3, "interval at the start, and throughout if `rule` is false", "frames", 1, 60)
    minimum_frames: int = parameter(3, "shortest interval that the rule may choose", "frames", 1, 60)
    maximum_frames: int = parameter(8, "longest interval that the rule may choose", "frames", 1, 60)
    reference_altitude_m: float = parameter(20.0, "altitude at which the interval is one frame", "m", 1, 1000)
    reference_speed_m_s: float = parameter(5.0, "ground speed at which the interval is one frame", "m/s", 0.1, 100)
    reference_rate_hz: float = parameter(10.0, "frame rate at which the interval is one frame", "1/s", 1, 240)
    reference_flow: float = parameter(
        0.02,
        "without telemetry: background flow per frame at which the interval is one frame; 0 keeps `frames`",
        "widths",
        0,
        1,
    )
    lowest_speed_m_s: float = parameter(
        0.5, "slower speeds count as this speed, so that hovering gives the longest interval", "m/s", 0.01, 10
    )
    cost: float = parameter(
        1.0,
        "computing time of a look, in frames at the reference rate (O in eq. 2); 0: measured (default of run --live)",
        "frames",
        0,
        10,
    )
    memory_frames: int = parameter(
        9, "number of looks in the medians of the background flow and of a look's time", "frames", 1, 100
    )


class DifferenceParameters(Group):
    """The difference of frames that makes a pixel foreground (appendix B, step S4)."""

    kind: Literal["normalized", "to_reference", "between_later", "to_next"] = parameter(
        "normalized",
        "normalized: difference to both neighbours in units of local noise, exposure corrected; to_reference: "
        "min(|I(t) - W1|, |I(t) - W2|) in grey levels, clear changes of exposure corrected; between_later: |W2 - "
        "W1|, the source's eq. 9; to_next: |I(t) - W1|, one interval later alone, the source's earlier chain",
    )
    near_frames: Annotated[tuple[Annotated[int, Field(ge=1, le=30)], ...], Field(min_length=1)] = parameter(
        (1, 2),
        "distances to the neighbours on both sides; without a wide pair the longest is multiplied by interval / 3",
        "frames",
    )
    wide_frames: int = parameter(6, "distance of the wide pair, which fills large targets; 0: off", "frames", 0, 60)
    noise_levels: float = parameter(4.0, "noise of a flat region (normalized)", "grey levels", 0.1, 50)
    gradient_share: float = parameter(0.12, "share of the local gradient that counts as registration noise", "-", 0, 2)
    threshold: float = parameter(3.5, "larger differences are foreground; in noise units if normalized", "-", 0.1, 255)
    peak: float = parameter(7.0, "smallest peak difference of a target, same unit as the threshold", "-", 0, 255)
    blur_px: Odd = parameter(5, "Gaussian kernel of the smoothing, odd; 1 switches it off", "px", 1, 31)
    blur_of: Literal["difference", "silhouette"] = parameter(
        "difference", "smooth the difference before the threshold, or the silhouette after it, as the source does"
    )
    border_px: int = parameter(4, "width of the strip along a warped frame's border that is ignored", "px", 0, 50)
    halved: bool = parameter(False, "compare frames at half resolution: faster, coarser outlines (onboard)")
    ignore: str = parameter("", "mask picture of the frames' size: pixels that are not black are ignored")


class TrackletParameters(Group):
    """Judging targets by tracklets, which follow candidates over several looks; needs the normalized difference."""

    on: bool = parameter(True, "judge targets by tracklets, and find targets that blobs miss")
    accept: float = parameter(-1.0, "smallest score (log odds) of a tracklet that counts as a target", "-", -10, 10)


class MorphologyParameters(Group):
    """Cleaning of the silhouette (appendix B, step S5)."""

    erode_px: int = parameter(3, "ellipse that erodes the silhouette; larger: fewer false pixels; 1: off", "px", 1, 31)
    dilate_px: int = parameter(1, "ellipse that then dilates it; larger: fewer missed pixels; 1: off", "px", 1, 101)
    close_px: int = parameter(25, "ellipse that closes gaps between fragments of one target; 1: off", "px", 1, 101)
    close_m: float = parameter(0.0, "with telemetry: largest gap to close, up to close_px; 0: close_px", "m", 0, 100)
    hull: bool = parameter(True, "replace every blob by its convex hull")


class RefineParameters(Group):
    """Refinement of a target's outline by its motion and its colours."""

    on: bool = parameter(True, "refine outlines; false keeps the blobs of the morphology")
    spatial_px: float = parameter(90.0, "distance over which evidence spreads where colours are constant", "px", 1, 500)
    colour_levels: float = parameter(80.0, "change of colour that stops the spread", "grey levels", 1, 1000)
    share: float = parameter(0.55, "share of foreground evidence above which a pixel is foreground", "-", 0.05, 0.95)
    shadow_share: float = parameter(0.01, "shadows are removed from blobs up to this share of the picture", "-", 0, 1)


class SmallParameters(Group):
    """Small slow targets: weak evidence over a longer gap, confirmed by steady travel."""

    on: bool = parameter(
        True,
        "detect small slow targets while the interval is long enough; beside tracklets only with telemetry or "
        "gates.person_px, or if a parameter of small is set",
    )
    from_interval: int = parameter(3, "shortest interval at which small targets are detected", "frames", 1, 60)
    gap_frames: int = parameter(6, "distance to the neighbours on both sides, at most the interval", "frames", 1, 30)
    gap_move_px: float = parameter(
        1.4, "with telemetry: walkers move by this over the gap, unless gap_frames is set; 0: gap_frames", "px", 0, 30
    )
    threshold: float = parameter(6.0, "smallest difference of a candidate", "grey levels", 1, 255)
    noise_ratio: float = parameter(
        6.0, "smallest difference of a candidate as a multiple of the picture's mean difference", "-", 0, 100
    )
    close_px: int = parameter(13, "ellipse that joins the parts of a candidate; 1 switches it off", "px", 1, 31)
    min_area_px: int = parameter(12, "smallest area of a candidate", "px", 1, 10_000)
    max_box_px: int = parameter(1500, "largest box area of a candidate", "px", 10, 1_000_000)
    max_candidates: int = parameter(80, "in frames with more candidates none is tracked", "blobs", 1, 10_000)
    max_blobs: int = parameter(4, "with more large blobs than this, the parallax test is applied", "blobs", 0, 1000)
    parallax_px: float = parameter(0.15, "search for no small targets if inlier residuals exceed this", "px", 0, 10)
    gate_px: float = parameter(4.0, "largest distance of a candidate from the track's prediction", "px", 0.5, 50)
    hits: int = parameter(10, "frames with a candidate that a track needs to be confirmed", "frames", 2, 60)
    min_travel_px: float = parameter(3.0, "smallest distance that a confirmed track has travelled", "px", 0, 100)
    sureness: float = parameter(8.0, "smallest speed of a confirmed track, in its standard deviations", "-", 1, 100)
    misses: int = parameter(3, "a track ends after this many frames without a candidate", "frames", 0, 30)


class HistoryParameters(Group):
    """The motion history, its gradient and the segmentation by motion (appendix B, step S5)."""

    on: bool = parameter(True, "motion history: heading, speed and splits of touching targets without tracklets")
    duration_frames: float = parameter(6.0, "time for which a silhouette stays in the history", "frames", 1, 120)
    delta_min_frames: float = parameter(0.5, "smallest difference of time stamps with a gradient", "frames", 0, 60)
    delta_max_frames: float = parameter(4.0, "largest difference of time stamps with a gradient", "frames", 0, 120)
    segmentation_threshold_frames: float = parameter(
        1.0, "neighbours whose time stamps differ by more belong to different motions", "frames", 0, 60
    )


class GateParameters(Group):
    """Bounds for targets. The bounds in metres apply if telemetry is given (appendix A)."""

    min_area_px: int = parameter(300, "smallest foreground area of a target", "px", 1, 1_000_000)
    min_size_m: float = parameter(0.2, "smallest length of a target on the ground", "m", 0, 100)
    max_size_m: float = parameter(25.0, "largest length of a target on the ground", "m", 0.1, 1000)
    max_speed_m_s: float = parameter(60.0, "largest speed of a target over ground", "m/s", 0.1, 500)
    focal_px: float = parameter(1000.0, "focal length: a bound in px is m x focal length / distance", "px", 10, 100_000)
    expected_size_m: float = parameter(
        1.7, "size of a typical small target; with telemetry it sets the smallest area", "m", 0.05, 100
    )
    tiny_px: float = parameter(
        7.0, "people smaller than this (side of a square) get the settings for tiny people; 0: never", "px", 0, 1000
    )
    person_px: float = parameter(
        0.0, "size of people in the picture if telemetry does not give it; 0: unknown", "px", 0, 1000
    )
    expected_share: float = parameter(0.1, "smallest foreground share of the expected target's square", "-", 0.01, 1)
