"""Every parameter: its default, unit, range and meaning; read from TOML files and `group.parameter=value` overrides."""

import math
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import tomli_w
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic.fields import FieldInfo

from torchvision_dddas.errors import InputError, printable

# --------------------------------------------------------------------------------------------------------------------
# The parameters. A new one is a line in a group: type, default, meaning, unit, lowest, highest.


def _odd(value: int) -> int:
    if value % 2 == 0:
        raise ValueError("not odd")
    return value


Odd = Annotated[int, AfterValidator(_odd)]


def parameter(default: Any, meaning: str, unit: str = "-", low: float | None = None, high: float | None = None) -> Any:
    """A field of a group: default, meaning, unit (`-` for a bare number) and inclusive range."""
    return Field(default, ge=low, le=high, description=meaning, json_schema_extra={"unit": unit})


class Group(BaseModel):
    """Parameters of one subject: frozen, without unknown names or silent conversion ("5" is no number)."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, validate_default=True)

    @model_validator(mode="after")
    def _lowest_below_highest(self) -> "Group":
        for low in type(self).model_fields:
            high = low.replace("minimum_", "maximum_").replace("min_", "max_").replace("_min", "_max")
            if high != low and high in type(self).model_fields and getattr(self, low) > getattr(self, high):
                raise ValueError(f"{low} = {getattr(self, low)} is above {high} = {getattr(self, high)}")
        return self


EVIDENCE_SCALE, EVIDENCE_CAP = 16.0, 240
"""Evidence is kept in 8-bit maps: in sixteenths of the local noise, clipped at 15 noise units."""

HALF = 127
"""Above this level a smoothed silhouette of 0 and 255 is set."""

WHITE = 248
"""From this grey level on a pixel may be clipped."""

EXPOSURE_PIXELS = 5000
"""The exposure of a warped picture is fitted to some so many pixels."""


def exposure_step(shape: tuple[int, ...]) -> int:
    """Every so many-th row and column of a picture, (H, W), shows the exposure well enough."""
    return max(math.isqrt(shape[0] * shape[1] // EXPOSURE_PIXELS), 1)


class RegistrationParameters(Group):
    """How the background's motion between two frames is found (appendix B, steps S1 to S3)."""

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
        1.0, "largest error of a point tracked forth and back; 0 switches the check off", "px", 0, 20
    )
    ransac_px: float = parameter(2.0, "a point this close to the model's prediction is an inlier", "px", 0.1, 20)
    hypotheses: int = parameter(128, "number of models that RANSAC draws", "models", 8, 4096)
    redetect_frames: int = parameter(
        5, "detect keypoints every so many frames, and track the inliers in between (onboard)", "frames", 1, 60
    )
    halved_corners: bool = parameter(False, "detect keypoints at half resolution: faster, less accurate")
    halved: bool = parameter(False, "register frames at half resolution: faster, half as accurate (onboard)")
    direct: bool = parameter(
        False, "register a frame with each frame that it is compared with, as the source does; else steps are chained"
    )
    min_inliers: int = parameter(20, "with fewer inliers the registration is unreliable", "points", 4, 5000)
    min_inlier_share: float = parameter(0.4, "with a smaller share of inliers registration is unreliable", "-", 0, 1)

    def cell_side(self, width: int, height: int) -> int:
        """Side in pixels of the cells with one keypoint each that keeps their number within the budget."""
        return max(self.cell_px, math.ceil(math.sqrt(width * height / self.keypoints)))


class IntervalParameters(Group):
    """The detection interval and the rule that steers it (appendix B, eq. 2)."""

    rule: bool = parameter(True, "adapt the interval to altitude, speed and frame rate; false keeps `frames`")
    frames: int = parameter(3, "interval at the start; the only one if `rule` is false", "frames", 1, 60)
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
        "time of a look, in frames at the reference rate (O in eq. 2); 0: measured, as by `run --live` if not set",
        "frames",
        0,
        10,
    )
    memory_frames: int = parameter(
        9, "looks over which the medians of the background flow and of a look's time are taken", "frames", 1, 100
    )


class DifferenceParameters(Group):
    """What makes a pixel foreground (appendix B, step S4)."""

    kind: Literal["normalized", "to_reference", "between_later", "to_next"] = parameter(
        "normalized",
        "normalized: difference to both neighbours in units of local noise, exposure corrected; to_reference: "
        "min(|I(t) - W1|, |I(t) - W2|) in grey levels, clear changes of exposure corrected; between_later: |W2 - "
        "W1|, the source's eq. 9; to_next: |I(t) - W1|, one interval later alone, the source's earlier chain",
    )
    near_frames: Annotated[tuple[Annotated[int, Field(ge=1, le=30)], ...], Field(min_length=1)] = parameter(
        (1, 2),
        "distances to the neighbours on both sides; without a wide pair the longest follows the interval, this at 3",
        "frames",
    )
    wide_frames: int = parameter(6, "distance of the pair of frames that fills large targets; 0: off", "frames", 0, 60)
    noise_levels: float = parameter(4.0, "noise of a flat region (normalized)", "grey levels", 0.1, 50)
    gradient_share: float = parameter(0.12, "share of the local gradient that counts as registration noise", "-", 0, 2)
    threshold: float = parameter(3.5, "larger differences are foreground; in noise units if normalized", "-", 0.1, 255)
    peak: float = parameter(7.0, "smallest peak difference of a target, same unit as the threshold", "-", 0, 255)
    blur_px: Odd = parameter(5, "Gaussian kernel of the smoothing, odd; 1 switches it off", "px", 1, 31)
    blur_of: Literal["difference", "silhouette"] = parameter(
        "difference", "smooth the difference before the threshold, or as the source does the silhouette after it"
    )
    border_px: int = parameter(4, "width of the strip along a warped frame's border that is ignored", "px", 0, 50)
    halved: bool = parameter(False, "compare frames at half resolution: faster, coarser outlines (onboard)")


class MorphologyParameters(Group):
    """How the silhouette is cleaned (appendix B, step S5)."""

    erode_px: int = parameter(3, "ellipse that erodes the silhouette: precision for recall; 1: off", "px", 1, 31)
    dilate_px: int = parameter(1, "ellipse that dilates it afterwards: recall for precision; 1: off", "px", 1, 101)
    close_px: int = parameter(25, "ellipse that closes gaps between fragments of one target; 1: off", "px", 1, 101)
    close_m: float = parameter(0.0, "with telemetry: largest gap to close, at most close_px; 0: close_px", "m", 0, 100)
    hull: bool = parameter(True, "replace every blob by its convex hull")


class RefineParameters(Group):
    """Redrawing a target's outline by its motion and its colours."""

    on: bool = parameter(True, "refine outlines; false keeps the blobs of the morphology")
    spatial_px: float = parameter(90.0, "distance over which evidence spreads where colours are constant", "px", 1, 500)
    colour_levels: float = parameter(80.0, "change of colour that stops the spread", "grey levels", 1, 1000)
    share: float = parameter(0.55, "share of foreground evidence above which a pixel is foreground", "-", 0.05, 0.95)
    shadow_share: float = parameter(0.01, "shadows are removed from blobs up to this share of the picture", "-", 0, 1)


class PersistenceParameters(Group):
    """What a blob must show over time to be a target: moving as one, steadily, unlike its surroundings."""

    on: bool = parameter(True, "test blobs by flow and persistence; false accepts every blob")
    flow_share: float = parameter(0.3, "share of a blob's core that moves steadily to pass the flow test", "-", 0, 1)
    sure_share: float = parameter(0.7, "a large blob with at least this share needs no further frames", "-", 0, 1)
    links: int = parameter(3, "frames of five (two before, itself, two after) that must show a blob", "frames", 1, 5)
    passes: int = parameter(2, "number of these frames in which it must pass the flow test", "frames", 0, 5)
    large_share: float = parameter(0.02, "a blob of this share of the picture needs one link, no flow test", "-", 0, 1)
    weak_links: int = parameter(4, "`links` for a blob that only the wide pair of frames shows", "frames", 1, 5)
    weak_passes: int = parameter(3, "`passes` for a blob that only the wide pair of frames shows", "frames", 0, 5)
    trusted_blobs: int = parameter(
        4, "with at most this many blobs per frame one link is enough: parallax causes many", "blobs", 0, 1000
    )


class SmallParameters(Group):
    """Small slow targets: weak evidence over a longer gap, confirmed by steady travel."""

    on: bool = parameter(True, "detect small slow targets while the interval is long enough")
    from_interval: int = parameter(3, "shortest interval at which they are detected", "frames", 1, 60)
    gap_frames: int = parameter(6, "distance to the neighbours on both sides, at most the interval", "frames", 1, 30)
    gap_move_px: float = parameter(
        1.4, "with telemetry: a walker moves by this over the gap, unless gap_frames is set; 0: gap_frames", "px", 0, 30
    )
    threshold: float = parameter(6.0, "smallest difference of a candidate", "grey levels", 1, 255)
    noise_ratio: float = parameter(
        6.0, "smallest difference of a candidate as a multiple of the picture's mean difference", "-", 0, 100
    )
    close_px: int = parameter(13, "ellipse that joins the parts of a candidate; 1 switches it off", "px", 1, 31)
    min_area_px: int = parameter(12, "smallest area of a candidate", "px", 1, 10_000)
    max_box_px: int = parameter(1500, "largest box area of a candidate", "px", 10, 1_000_000)
    max_candidates: int = parameter(80, "with more candidates in a frame none is tracked", "blobs", 1, 10_000)
    max_blobs: int = parameter(4, "with more large blobs than this, parallax is tested for", "blobs", 0, 1000)
    parallax_px: float = parameter(0.15, "residual of inliers that means parallax: no small targets then", "px", 0, 10)
    gate_px: float = parameter(4.0, "largest distance of a candidate from the track's prediction", "px", 0.5, 50)
    hits: int = parameter(10, "frames with a candidate that a track needs to be confirmed", "frames", 2, 60)
    min_travel_px: float = parameter(3.0, "smallest distance that a confirmed track has travelled", "px", 0, 100)
    sureness: float = parameter(8.0, "smallest speed of a confirmed track, in its standard deviations", "-", 1, 100)
    misses: int = parameter(3, "a track ends after this many frames without a candidate", "frames", 0, 30)


class HistoryParameters(Group):
    """The motion history, its gradient and the segmentation by motion (appendix B, step S5)."""

    on: bool = parameter(True, "motion history: heading and speed without flow, and splits of touching targets")
    duration_frames: float = parameter(6.0, "how long a silhouette stays in the history", "frames", 1, 120)
    delta_min_frames: float = parameter(0.5, "smallest difference of time stamps with a gradient", "frames", 0, 60)
    delta_max_frames: float = parameter(4.0, "largest difference of time stamps with a gradient", "frames", 0, 120)
    segmentation_threshold_frames: float = parameter(
        1.0, "neighbours whose time stamps differ by more belong to different motions", "frames", 0, 60
    )


class GateParameters(Group):
    """Which blobs can be targets; the bounds in metres hold when telemetry is given (appendix A)."""

    min_area_px: int = parameter(300, "smallest foreground area of a target", "px", 1, 1_000_000)
    min_size_m: float = parameter(0.2, "smallest length of a target on the ground", "m", 0, 100)
    max_size_m: float = parameter(25.0, "largest length of a target on the ground", "m", 0.1, 1000)
    max_speed_m_s: float = parameter(60.0, "largest speed of a target over ground", "m/s", 0.1, 500)
    focal_px: float = parameter(1000.0, "focal length: a bound in px is m x focal length / altitude", "px", 10, 100_000)
    expected_size_m: float = parameter(
        1.7, "size of a typical small target: sets the smallest area if telemetry is given", "m", 0.05, 100
    )
    expected_share: float = parameter(0.1, "smallest foreground share of the expected target's square", "-", 0.01, 1)


class TrackParameters(Group):
    """Which detections become tracks, how they are linked, and how long a track lives. Lengths are in box heights."""

    mode: Literal["default", "paper"] = parameter(
        "default", "default: links scored by motion, size and appearance; paper: the source's affinity"
    )
    look_ahead: bool = parameter(True, "decide with the next frame in view (K = 3); false decides at once")
    appearance: Literal["always", "ambiguous", "never"] = parameter(
        "ambiguous", "compare appearance: always, only where locations are ambiguous, or never"
    )
    doubt: float = parameter(
        8.0,
        "a detection is tracked if its doubt, 1 / score - 1, is at most this many times the usual one",
        "-",
        0,
        1000,
    )
    birth_doubt: float = parameter(3.0, "the same of a detection that may start a track", "-", 0, 1000)
    hits: int = parameter(3, "detections that confirm a track; a single one of score 1 is enough", "frames", 1, 60)
    smooth: bool = parameter(True, "move boxes with a score below 1 to the smoothed track")
    memory_frames: int = parameter(125, "how long an unseen track is kept", "frames", 1, 10_000)
    memory_outside_frames: int = parameter(10, "how long a track that left the picture is kept", "frames", 1, 10_000)
    wander: float = parameter(0.3, "change of velocity between looks, as a share of the usual step", "-", 1e-3, 10)
    scatter: float = parameter(0.06, "standard deviation of a detection's centre", "heights", 1e-3, 1)
    size_scatter: float = parameter(0.1, "standard deviation of the logarithm of a detection's height", "-", 1e-3, 10)
    tail: float = parameter(
        4.0, "degrees of freedom of the distance's distribution: few tolerate sharp turns and stops", "-", 0.1, 100
    )
    upright: float = parameter(0.6, "standing targets move this much less up and down than across", "-", 0.1, 2)
    crossing: float = parameter(
        0.2, "share of the targets at the picture's border that come or go in a look", "-", 0, 1
    )
    hiding: float = parameter(
        0.75, "chance that a target that was not detected stays so at the next look", "-", 0.01, 1
    )
    rest_drift: float = parameter(0.03, "drift per look of an unseen target that may stand still", "heights", 1e-4, 1)
    rest_price: float = parameter(1.0, "cost of assuming that a lost target stood still", "-", 0, 20)
    own_scatter: float = parameter(0.2, "`scatter` for moving targets that dddas detected", "heights", 1e-3, 1)
    own_size_scatter: float = parameter(
        1.0, "`size_scatter` for moving targets that dddas detected, which split and merge", "-", 1e-3, 10
    )
    appearance_weight: float = parameter(10.0, "weight of the similarity of appearance", "-", 0, 100)
    appearance_offset: float = parameter(0.86, "similarity of appearance that is neutral for a link", "-", 0, 1)


class PaperParameters(Group):
    """The source's association (appendix C, III); each reading of its text is an option, by default one that links."""

    window: int = parameter(3, "number of frames associated at once: K of the source", "frames", 2, 3)
    rule: Literal["dispersion", "fixed"] = parameter(
        "dispersion", "weight of location: dispersion computes it (III-D), fixed takes `weight`"
    )
    weight: float = parameter(0.7, "share of location in the affinity if the rule is fixed", "-", 0, 1)
    lowest_dispersion: float = parameter(
        0.65, "a feature of larger dispersion distinguishes targets: LL of III-D", "-", 0, 1
    )
    location_cut: float = parameter(
        0.25, "dissimilarity at which clusters of locations end: G of 2 dimensions, normalised (III-E)", "-", 0, 1
    )
    appearance_cut: float = parameter(
        0.296, "dissimilarity at which clusters of histograms end: G of 3 dimensions, normalised (III-E)", "-", 0, 1
    )
    dispersion_of: Literal["smallest", "smallest_if_counts_differ", "newest"] = parameter(
        "smallest_if_counts_differ", "which frame of the window gives the dispersion"
    )
    gate: Literal["one_dummy", "every_dummy", "off"] = parameter(
        "one_dummy", "entries to raise to 1 - threshold: with one dummy, with any number (as printed), or none"
    )
    gated: Literal["features", "affinity"] = parameter(
        "features", "gate location and appearance, or their weighted sum"
    )
    threshold: float = parameter(0.4, "a dummy's entry is raised if all real ones are below 1 - threshold", "-", 0, 1)
    dummy: Literal["zero", "formula"] = parameter(
        "formula", "affinity with a dummy before the gate: eq. 4 and 5 with a zero vector, or zero as the text says"
    )
    histogram: Literal["channel", "count"] = parameter(
        "channel", "channel: histograms sum to 1 per channel; count: they hold counts, so size matters too"
    )
    histogram_scale: float = parameter(
        0.4, "share of the dissimilarity of histograms that counts; 1: as printed, which the gate cuts", "-", 0.1, 1
    )
    exact_targets: int = parameter(12, "largest number of targets a frame for the exact solution", "targets", 0, 1000)
    gap: float = parameter(0.005, "relaxation aims at a solution within this share of the bound", "-", 0, 1)


class PeopleParameters(Group):
    """Recognizing people by HOG and a linear SVM (appendix A, III-B): which windows are scored, and what they yield."""

    classifier: str = parameter("opencv", "opencv: OpenCV's default people detector; or a file with a linear SVM")
    graphs: str = parameter("shipped", "onboard: shipped, or a folder of ONNX graphs made by `dddas export`")
    window_width_px: int = parameter(64, "width of the classifier's window", "px", 8, 1024)
    window_height_px: int = parameter(128, "height of the classifier's window", "px", 8, 1024)
    cell_px: int = parameter(8, "side of a cell; each cell has one histogram", "px", 2, 64)
    block_px: int = parameter(16, "side of a block of cells; each block is normalised", "px", 2, 256)
    block_stride_px: int = parameter(8, "distance between blocks in a window", "px", 1, 256)
    window_stride_px: int = parameter(8, "distance between windows in each pyramid level", "px", 1, 256)
    bins: int = parameter(9, "orientation bins of a histogram, over 180 degrees, or 360 if signed", "bins", 2, 36)
    signed: bool = parameter(False, "distinguish a gradient from its opposite")
    clip: float = parameter(0.2, "largest share of a block's norm that one element may have (L2-Hys)", "-", 0.01, 1)
    gamma: bool = parameter(True, "take the square root of the grey levels first")
    scale_step: float = parameter(1.05, "ratio of the sizes of successive pyramid levels", "-", 1.01, 2)
    enlarge: float = parameter(
        1.5,
        "scale of the first pyramid level; at 1.5 bodies are found from 64 px; the cost grows with its square",
        "-",
        1,
        4,
    )
    max_levels: int = parameter(64, "largest number of pyramid levels", "levels", 1, 200)
    padding_px: int = parameter(24, "reflected border of each level, to detect people at the border", "px", 0, 256)
    threshold: float = parameter(0.0, "smallest score of a window that may be a person", "-", -10, 10)
    suppression: Literal["nms", "opencv", "none"] = parameter(
        "nms", "nms keeps the best of overlapping windows; opencv averages groups; none keeps all"
    )
    overlap: float = parameter(0.4, "nms: bodies with a larger intersection over union are the same person", "-", 0, 1)
    contained: float = parameter(0.7, "nms: so are bodies that share more of the smaller one; 1: off", "-", 0, 1)
    settle: float = parameter(0.75, "nms: a box is the mean of windows that overlap the best by this", "-", 0, 1)
    group: int = parameter(2, "opencv: groups of at most this many windows are dropped", "windows", 0, 100)
    group_distance: float = parameter(0.2, "opencv: edges within this distance, in box sizes, form a group", "-", 0, 1)
    height_share: float = parameter(0.738, "body height divided by window height", "-", 0.1, 1)
    width_share: float = parameter(0.5, "body width divided by window width", "-", 0.1, 1)
    feet_share: float = parameter(0.845, "distance from window top to feet, divided by window height", "-", 0.1, 1.2)
    probability_slope: float = parameter(2.6, "probability = 1 / (1 + exp(-slope (score - even)))", "-", 0.01, 100)
    probability_even: float = parameter(0.8, "score at which the probability of a person is 0.5", "-", -10, 10)
    search: Literal["everywhere", "regions"] = parameter(
        "everywhere", "search the whole picture, or regions where people are expected and the rest in turns"
    )
    rescan_frames: int = parameter(
        10, "regions: frames in which the whole picture is searched once, some levels in each", "frames", 1, 10_000
    )
    look_share: float = parameter(
        1.0,
        "regions: largest cost of a frame, as a share of the whole search; 1: no limit (--live: at most 0.1)",
        "-",
        0.001,
        1,
    )
    region_margin: float = parameter(0.2, "regions: margin around an expected body", "heights", 0, 5)
    region_scales: float = parameter(1.15, "regions: a body may be larger or smaller by this factor", "-", 1, 4)

    @model_validator(mode="after")
    def _cells_fill_blocks_and_blocks_the_window(self) -> "PeopleParameters":
        if self.block_px % self.cell_px:
            raise ValueError(f"block_px = {self.block_px} is no multiple of cell_px = {self.cell_px}")
        for name in ("window_width_px", "window_height_px"):
            more = getattr(self, name) - self.block_px
            if more < 0 or more % self.block_stride_px:
                raise ValueError(
                    f"blocks of block_px = {self.block_px} every block_stride_px = {self.block_stride_px} do not fill "
                    f"{name} = {getattr(self, name)}; wanted {self.block_px} + a multiple of {self.block_stride_px}"
                )
        return self

    @property
    def blocks(self) -> tuple[int, int]:
        """Blocks of a window, (across, down)."""
        across, down = (
            (side - self.block_px) // self.block_stride_px + 1 for side in (self.window_width_px, self.window_height_px)
        )
        return across, down

    @property
    def features(self) -> int:
        """Numbers of the descriptor of one window."""
        across, down = self.blocks
        return across * down * (self.block_px // self.cell_px) ** 2 * self.bins

    @property
    def descriptor(self) -> dict[str, object]:
        """What the descriptor is, as files of classifiers tell it; lengths in px, the window as (width, height)."""
        return {
            "window": (self.window_width_px, self.window_height_px),
            "cell": self.cell_px,
            "block": self.block_px,
            "stride": self.block_stride_px,
            "bins": self.bins,
            "signed": self.signed,
            "clip": self.clip,
            "gamma": self.gamma,
        }


class GroundParameters(Group):
    """Where people stand, seen from the ground (appendix A, IV-C), and which of several sightings are one person."""

    mode: Literal["default", "paper"] = parameter(
        "default", "default: height and foot row with covariances, on the ellipsoid; paper: eq. 13 to 15"
    )
    use: Literal["both", "height", "feet"] = parameter(
        "both", "measure distance by the body's height, the row of the feet, or both by variance"
    )
    body_height_m: float = parameter(1.75, "height of a typical person", "m", 0.3, 3)
    body_height_sigma_m: float = parameter(0.1, "standard deviation of people's heights", "m", 0, 1)
    height_sigma: float = parameter(0.05, "standard deviation of a box's height, in box heights", "-", 0, 1)
    feet_sigma: float = parameter(0.03, "standard deviation of the foot row, in box heights", "-", 0, 1)
    gate_sigmas: float = parameter(3.0, "sightings at a larger distance are different people", "-", 0.5, 10)
    within_frames: int = parameter(0, "frames of several cameras this close count as simultaneous", "frames", 0, 1000)


class ConfirmParameters(Group):
    """When people seen from the ground decide what a blob seen from the air is: two fidelities (appendix A, III-B)."""

    gate_probability: float = parameter(
        0.99, "share of people inside the gate of their own blob, by both covariances", "-", 0.5, 0.9999
    )
    spread_m: float = parameter(0.5, "sigma of people around their blob's position, maybe a crowd's", "m", 0, 20)
    unknown_sigma_m: float = parameter(2.0, "standard deviation of positions without covariance", "m", 0.01, 100)
    inside_sigmas: float = parameter(2.0, "a blob is well inside a view if this many of its sigmas are", "-", 0, 10)
    body_width_m: float = parameter(0.6, "nearer objects within this distance of the line of sight occlude", "m", 0, 10)
    least_score: float = parameter(0.5, "people of a lower probability say nothing about their blob", "-", 0.5, 1)
    detection_rate: float = parameter(
        0.7, "share of a person's observations in which one is recognized", "-", 0.01, 0.999
    )
    false_rate: float = parameter(0.05, "share of other blobs' observations with a person recognized", "-", 0.001, 0.99)
    crowd_share: float = parameter(0.5, "in pictures: detection rate in a crowd's blob over that of one", "-", 0, 1)
    prior: float = parameter(0.5, "share of blobs that are people", "-", 0.01, 0.99)
    fresh: float = parameter(0.3, "weight of a vehicle's repeated observation: its errors are correlated", "-", 0, 1)
    limit: float = parameter(7.0, "largest absolute log-odds, so that later observations still count", "-", 0.5, 50)
    share: float = parameter(
        0.5, "in pictures: smallest intersection of a person's and a blob's box, over the smaller box", "-", 0.01, 1
    )


class LandmarkParameters(Group):
    """How ground vehicles serve as landmarks: found by colour, separated from targets, tracked (appendix A, IV-A)."""

    differentiation: Literal["exact", "greedy"] = parameter(
        "exact", "assignment of blobs to landmarks: most pairs at the least distance, or greedy"
    )
    centre: Literal["motion", "colour"] = parameter(
        "motion", "position of a landmark with a blob: the blob's centre, or the colour's (if in the vehicle's middle)"
    )
    reach_px: float = parameter(40.0, "largest distance between a landmark's colour and its blob", "px", 0, 10000)
    interval_frames: int = parameter(
        10, "frames between two separations of landmarks from targets (tracking interval)", "frames", 1, 10000
    )
    least_area_px: int = parameter(12, "smaller patches of colour are ignored", "px", 1, 1_000_000)
    pixel_sigma: float = parameter(1.0, "standard deviation of a landmark's position in the picture", "px", 0.01, 100)
    sigma_m: float = parameter(
        1.43, "standard deviation of a landmark's report where none is given: GPS with 3.5 m at 95 %", "m", 0, 1000
    )
    common_sigma_m: float = parameter(0.0, "sigma of the error common to all receivers of the team", "m", 0, 1000)
    gap_s: float = parameter(5.0, "a landmark ends after such a dropout without planned waypoints", "s", 0, 3600)
    drift_m_s: float = parameter(0.5, "growth of the position's uncertainty during a dropout", "m/s", 0, 100)
    height_m: float = parameter(0.0, "height of the colour (or of the point given in pixels) above ground", "m", 0, 20)
    length_m: float = parameter(
        4.0, "vehicle length: a moving blob at its colour up to this length is the landmark, not a target", "m", 0.1, 50
    )
    least: int = parameter(4, "number of landmarks used where detection is good (4-or-more rule)", "landmarks", 4, 64)
    rule: Literal["all", "source"] = parameter(
        "all", "all: use every landmark; source: use more than `least` only where detection is poor"
    )
    poor_speed_m_s: float = parameter(
        2.0, "source rule: detection is poor if landmarks move faster than this on average", "m/s", 0, 100
    )


class AerialParameters(Group):
    """How the picture from the air is georeferenced by landmarks and telemetry (appendix A, IV-B)."""

    mode: Literal["pose", "homography", "paper"] = parameter(
        "pose", "pose: from landmarks and telemetry; homography: landmarks only; paper: as printed, in degrees"
    )
    hfov_deg: float = parameter(
        70.0, "field of view where camera and telemetry give none; of the longer side unless set", "deg", 1, 170
    )
    pitch_deg: float = parameter(
        90.0, "angle of the optical axis below the horizon if neither gives it; 90 is straight down", "deg", -90, 90
    )
    focal_sigma: float = parameter(
        0.01, "relative standard deviation of a given focal length, unless the camera's file gives it", "-", 0, 1
    )
    focal_guess_sigma: float = parameter(0.2, "relative sigma of a focal length that follows from hfov_deg", "-", 0, 1)
    tilt_sigma_deg: float = parameter(1.0, "standard deviation of the reported tilt, per axis", "deg", 0, 90)
    tilt_guess_sigma_deg: float = parameter(15.0, "standard deviation of the tilt if pitch_deg is used", "deg", 0, 180)
    heading_sigma_deg: float = parameter(5.0, "standard deviation of the reported heading", "deg", 0, 180)
    course_sigma_deg: float = parameter(
        10.0, "sigma of a camera's heading that is taken from the vehicle's nose or course", "deg", 0, 180
    )
    altitude_sigma: float = parameter(0.02, "relative standard deviation of the altitude", "-", 0, 10)
    altitude_sigma_m: float = parameter(0.0, "standard deviation added to it, in metres", "m", 0, 1000)
    position_sigma_m: float = parameter(
        1.43, "standard deviation of the vehicle's position, east and north: 3.5 m at 95 %", "m", 0, 1000
    )
    target_sigma_px: float = parameter(1.0, "standard deviation of a target's position in the picture", "px", 0, 100)
    own_sigma: float = parameter(0.13, "additional sigma for targets that dddas detected, in box sides", "sides", 0, 2)
    point: Literal["auto", "centre", "foot"] = parameter(
        "auto",
        "point of a box on the ground: centre, foot, or auto: the table's feet, the foot for tables of dddas, "
        "else the centre",
    )
    shadows: bool = parameter(False, "blobs are bodies with shadows: the foot is found from the sun's direction")
    sun_azimuth_deg: float = parameter(0.0, "direction of the sun, clockwise from north", "deg", 0, 360)
    sun_height_deg: float = parameter(
        0.0, "elevation of the sun; 0: from the telemetry's clock, no shadows without a clock", "deg", 0, 90
    )
    target_height_m: float = parameter(1.7, "height of the body whose foot is wanted", "m", 0, 100)
    gate_probability: float = parameter(0.999, "share of right landmarks that pass the test", "-", 0.5, 0.999999)
    correlation_s: float = parameter(
        20.0, "correlation time of telemetry and receiver errors; 0: independent in each frame", "s", 0, 10000
    )
    least_spread: float = parameter(0.02, "landmarks of a smaller width over length count as collinear", "-", 0, 1)
    clock_offset_s: float = parameter(0.0, "added to times of telemetry and landmarks: the clip's time", "s", -1e6, 1e6)
    time_zone: str = parameter(
        "", "of a log whose dates are in local time: a name, Europe/Berlin, or hours from UTC, +02:00"
    )
    order: Literal["auto", "lat-lon", "lon-lat"] = parameter(
        "auto", "of two coordinates in one field of a log, GPS(48.1, 11.5); auto: as its program writes them"
    )


class CrowdParameters(Group):
    """Moving targets that go together as one crowd."""

    join_m: float = parameter(
        0.0, "targets located from the air with gaps up to this are one crowd; 0: off", "m", 0, 100
    )
    speed_m_s: float = parameter(1.5, "largest velocity difference over ground within a crowd", "m/s", 0.01, 100)


class SteeringParameters(Group):
    """How what is found steers where the instruments go and look, in a run whose source can be steered."""

    on: bool = parameter(True, "steer the vehicles; false flies as planned")
    sampling: bool = parameter(False, "process every k-th frame, k from the interval rule; needs a clip in order")
    sampling_share: float = parameter(0.5, "k as a share of the rule's interval before its bounds", "-", 0.01, 10)
    least_move_px: float = parameter(3.0, "a walker moves by at least this between processed frames", "px", 0, 100)
    maximum_every: int = parameter(8, "largest k, however slow the scene", "frames", 1, 60)
    follow: bool = parameter(True, "the UAV keeps the crowds in view; false flies as planned")
    look: bool = parameter(True, "UGVs drive to targets that need a closer look; false drives as planned")
    fast_m_s: float = parameter(3.0, "speed of a UGV far from its goal", "m/s", 0, 30)
    slow_m_s: float = parameter(1.0, "speed of a UGV near its goal: its motion degrades its position", "m/s", 0, 30)
    near_m: float = parameter(6.0, "distance to the goal that counts as near", "m", 0, 1000)
    station_m: float = parameter(12.0, "distance of UGVs from the crowd they observe", "m", 2, 1000)
    look_m: float = parameter(14.0, "largest distance at which a UGV recognizes people: bodies of 64 px", "m", 1, 1000)
    picture_s: float = parameter(1.0, "time between two pictures of one UGV", "s", 0.01, 3600)
    maximum_altitude_m: float = parameter(0.0, "largest altitude of the UAV; 0: twice the initial one", "m", 0, 10_000)


class LiveParameters(Group):
    """A run that must keep up with a camera."""

    pace: float = parameter(1.0, "playback speed of a file over real time; 0: as fast as possible", "-", 0, 1000)
    queue_frames: int = parameter(2, "frames that may wait; beyond that the oldest is dropped", "frames", 1, 64)
    deadline_ms: float = parameter(80.0, "largest latency from camera to results without look-ahead", "ms", 1, 60_000)
    shed: bool = parameter(True, "reduce the load when processing is too slow; false drops frames instead")
    load: float = parameter(0.85, "largest share of the time between frames that processing may take", "-", 0.1, 1)
    calm_s: float = parameter(5.0, "time with spare capacity after which the load is raised again", "s", 0.1, 600)
    least_keypoints: int = parameter(80, "smallest number of keypoints under load", "-", 16, 10_000)
    maximum_every: int = parameter(8, "process at least one of this many frames under load", "frames", 1, 60)
    stall_s: float = parameter(5.0, "a stream without frames for this long counts as lost", "s", 0.1, 600)
    retry_s: float = parameter(0.5, "first delay before a lost stream is opened again; then it doubles", "s", 0.01, 600)
    retry_most_s: float = parameter(5.0, "longest delay before a lost stream is opened again", "s", 0.01, 3600)
    lost_s: float = parameter(40.0, "a camera lost for so long ends the run (exit code 70); 0: never", "s", 0, 86_400)
    watchdog_s: float = parameter(30.0, "a step that takes longer counts as hung; 0: no watchdog", "s", 0, 3600)
    status_s: float = parameter(2.0, "time between two writes of the status and the results", "s", 0.1, 600)

    @model_validator(mode="after")
    def _pauses_grow(self) -> "LiveParameters":
        if self.retry_most_s < self.retry_s:
            raise ValueError(f"retry_most_s = {self.retry_most_s:g} is below retry_s = {self.retry_s:g}")
        return self


class LevelParameters(Group):
    """How pictures of 16 bits, as those of thermal cameras, become pictures of 8 bits."""

    black: int = parameter(0, "value that becomes black; both 0: black and white follow the clip", "counts", 0, 65535)
    white: int = parameter(0, "value that becomes white", "counts", 0, 65535)

    @property
    def given(self) -> tuple[int, int] | None:
        """Black and white as `open_video` takes them; None where the clip gives them."""
        return (self.black, self.white) if self.white else None


class Settings(Group):
    """All parameters, by group."""

    registration: RegistrationParameters = RegistrationParameters()
    interval: IntervalParameters = IntervalParameters()
    difference: DifferenceParameters = DifferenceParameters()
    morphology: MorphologyParameters = MorphologyParameters()
    refine: RefineParameters = RefineParameters()
    persistence: PersistenceParameters = PersistenceParameters()
    small: SmallParameters = SmallParameters()
    history: HistoryParameters = HistoryParameters()
    gates: GateParameters = GateParameters()
    track: TrackParameters = TrackParameters()
    paper: PaperParameters = PaperParameters()
    people: PeopleParameters = PeopleParameters()
    ground: GroundParameters = GroundParameters()
    confirm: ConfirmParameters = ConfirmParameters()
    landmarks: LandmarkParameters = LandmarkParameters()
    aerial: AerialParameters = AerialParameters()
    crowds: CrowdParameters = CrowdParameters()
    steering: SteeringParameters = SteeringParameters()
    live: LiveParameters = LiveParameters()
    levels: LevelParameters = LevelParameters()


# --------------------------------------------------------------------------------------------------------------------
# Describing them.


@dataclass(frozen=True)
class Parameter:
    """One row of the table of parameters, ready to print."""

    name: str
    default: object
    unit: str
    range: str
    meaning: str


def all_parameters() -> list[Parameter]:
    """Every parameter in the order of the groups, for `dddas settings` and the README."""
    return [describe_parameter(name, field) for name, field in _parameter_fields()]


def describe_parameter(name: str, field: FieldInfo) -> Parameter:
    """The row of one parameter."""
    return Parameter(name, field.default, _unit(field), range_of(field), field.description or "")


def changes(settings: Settings) -> dict[str, object]:
    """The parameters that differ from their defaults: `{"group.parameter": value}`."""
    now = {name: getattr(getattr(settings, name.split(".")[0]), name.split(".")[1]) for name, _ in _parameter_fields()}
    return {name: now[name] for name, field in _parameter_fields() if now[name] != field.default}


def is_set(settings: Settings, name: str) -> bool:
    """Whether somebody has set a parameter, `group.parameter`: its value counts then, also where it is the default."""
    group, key = name.split(".")
    return key in getattr(settings, group).model_fields_set


def _parameter_fields() -> Iterator[tuple[str, FieldInfo]]:
    for group, holder in Settings.model_fields.items():
        for name, field in type(holder.default).model_fields.items():
            yield f"{group}.{name}", field


def _unit(field: FieldInfo) -> str:
    extra = field.json_schema_extra
    return str(extra["unit"]) if isinstance(extra, dict) and "unit" in extra else ""


def range_of(field: FieldInfo) -> str:
    """In words: `true or false`, `homography or affine`, `50 to 5000`, `3 to 15, odd`, `a list of 1 to 30`."""
    kind, rules = field.annotation, list(field.metadata)
    many = get_origin(kind) is tuple
    if many:  # the rules of a list's elements hang on the elements
        kind, *inner = get_args(get_args(kind)[0]) or get_args(kind)[:1]
        rules += [rule for entry in inner for rule in (entry.metadata if isinstance(entry, FieldInfo) else [entry])]
    if kind is bool:
        return "true or false"
    if kind is str:
        return "a name or a file"
    if get_origin(kind) is Literal:
        return " or ".join(str(choice) for choice in get_args(kind))
    low = next((rule.ge for rule in rules if getattr(rule, "ge", None) is not None), None)
    high = next((rule.le for rule in rules if getattr(rule, "le", None) is not None), None)
    words = f"{low} to {high}" + (", odd" if any(getattr(rule, "func", None) is _odd for rule in rules) else "")
    return f"a list of {words}" if many else words


# --------------------------------------------------------------------------------------------------------------------
# Changing and loading them.


def load_config(
    config: str | Path | None = None, overrides: Sequence[str] = (), base: Mapping[str, object] | None = None
) -> Settings:
    """The defaults, changed by base, then by a TOML file and then by `group.parameter=value` overrides.

    config: the name of a shipped configuration (`source`, `fast`), a TOML file, or several between commas, of which a
    later one overrides those before. base: `{"group.parameter": value}`.
    Raises InputError with one line: no such file, bad TOML, unknown parameter (with the nearest names), value out of
    range.
    """
    settings = with_parameters(Settings(), base or {})
    several = isinstance(config, str) and "," in config and not is_file(Path(config))
    for one in str(config).split(",") if several else [] if config is None else [config]:
        path = _config_file(one)
        settings = with_parameters(settings, _flat(read_toml(path), str(path)), origin=str(path))
    return with_parameters(settings, dict(parse_override(text) for text in overrides))


def with_parameters(settings: Settings, values: Mapping[str, object], origin: str = "") -> Settings:
    """A copy of the settings with `{"group.parameter": value}` changed and everything checked again.

    origin: where the values come from, put before the message. Raises InputError for an unknown parameter or a bad
    value.
    """
    before = f"{origin}: " if origin else ""
    fields = dict(_parameter_fields())
    content = settings.model_dump(exclude_unset=True)
    for name, value in values.items():
        if name not in fields:
            raise InputError(f"{before}unknown parameter '{name}'; {nearest(name, list(fields))}")
        group, key = name.split(".")
        content.setdefault(group, {})[key] = tuple(value) if isinstance(value, list) else value
    try:
        return Settings.model_validate(content)
    except ValidationError as error:
        raise InputError(before + _explain(error, fields)) from None


def check_settings(settings: Any) -> Settings:
    """The settings that a class was given, the defaults for None. Raises InputError for anything else."""
    if settings is not None and not isinstance(settings, Settings):
        made = f": td.load_settings({settings!r}) makes them" if isinstance(settings, str | Path) else ""
        raise InputError(f"settings must be of type Settings, got {type(settings).__name__}{made}")
    return settings or Settings()


def config_names() -> list[str]:
    """The shipped configurations that `--config` takes by name."""
    return sorted(path.stem for path in config_folder().glob("*.toml"))


def config_folder() -> Path:
    """Of the shipped ones: inside the package when installed from a wheel; at the top of the tree in a checkout."""
    package = Path(__file__).resolve().parent
    return next((p for p in (package / "configs", package.parent / "configs") if p.is_dir()), package / "configs")


def _config_file(config: str | Path) -> Path:
    path = Path(config)
    if is_file(path):
        return path
    if path.suffix == ".toml" or len(path.parts) > 1:
        raise InputError(f"no such configuration file: {path}")
    shipped = config_folder() / f"{config}.toml"
    if not is_file(shipped):
        raise InputError(
            f"no configuration is named '{config}'; give one of {', '.join(config_names())}, or a TOML file"
        )
    return shipped


def is_file(path: Path) -> bool:
    """Whether there is such a file; a name that no file can have has none."""
    try:
        return path.is_file()
    except OSError:  # too long, or in a folder that may not be entered
        return False


def read_toml(path: str | Path, what: str = "") -> dict[str, Any]:
    """What a TOML file holds. what: what the file is, for messages. Raises InputError with file and line."""
    name = f"{what} {path}".strip()
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        # The parser takes time as the square of a key's length.
        if any(line.count(".") > _MOST_DOTS and _has_long_key(line) for line in text.splitlines()):
            raise ValueError(f"a key has more than {_MOST_DOTS} dots")
        return tomllib.loads(text)
    except OSError as error:
        raise InputError(f"{name} cannot be read: {error.strerror}") from None
    except RecursionError:
        raise InputError(f"{name} is not valid TOML: its brackets are nested too deeply") from None
    except ValueError as error:  # no UTF-8, no TOML, or a number of thousands of digits
        raise InputError(f"{name} is not valid TOML: {str(error).split(';')[0]}") from None


_MOST_DOTS = 100


def _has_long_key(line: str) -> bool:
    """Whether a line has a key of endless parts, a.b.c, and not only many numbers with a point."""
    run = 0
    for part in line.split("."):
        run = run + 1 if (word := part.strip()) and not set(word) & set(" ,=\t") else 0
        if run > _MOST_DOTS:
            return True
    return False


def format_toml(content: Mapping[str, Any], comments: Sequence[str] = ()) -> str:
    r"""TOML text of plain values, lists and tables, which read_toml reads as the same. comments: lines above it.

    TOML has no half characters (lone surrogates, as in names of files that are no UTF-8): they become text, \udc80.
    """
    text = tomli_w.dumps(_whole_characters(content), indent=1)
    while (shorter := _ARRAY.sub(lambda found: "[" + ", ".join(re.split(r",\n *", found[1])[:-1]) + "]", text)) != text:
        text = shorter
    lines = [printable(" ".join(comment.splitlines())) for comment in comments]
    return "".join(f"# {line}\n" for line in lines) + ("\n" if comments else "") + text


# An array without further arrays in it, one element a line, as tomli_w writes it.
_ARRAY = re.compile(r"\[\n +((?:[^\n]*,\n *)+?)\]")


def _whole_characters(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, Mapping):
        return {_whole_characters(key): _whole_characters(inner) for key, inner in value.items()}
    return [_whole_characters(inner) for inner in value] if isinstance(value, list | tuple) else value


def _flat(content: dict[str, Any], origin: str) -> dict[str, object]:
    """`{group: {parameter: value}}` → `{"group.parameter": value}`."""
    flat: dict[str, object] = {}
    for group, parameters in content.items():
        if not isinstance(parameters, dict):
            hint = nearest(group, [name for name, _ in _parameter_fields()])
            raise InputError(f"{origin}: '{group}' stands outside a [group]; {hint}")
        flat |= {f"{group}.{name}": value for name, value in parameters.items()}
    return flat


def parse_override(text: str) -> tuple[str, object]:
    """`group.parameter=value` as name and value. Raises InputError where it is none."""
    name, equals, value = (part.strip() for part in text.partition("="))
    if not equals or not name or not value:
        raise InputError(f"'{text}' is no override; wanted group.parameter=value, such as registration.keypoints=500")
    try:
        return name, tomllib.loads(f"value = {value}")["value"]
    except (ValueError, RecursionError):  # the latter for brackets without end, which no parameter takes
        try:
            return name, float(value)  # TOML takes 0.3, but not .3
        except ValueError:
            return name, value  # a bare word: a choice such as affine


def nearest(name: str, known: list[str], where: str = "`dddas settings` lists them all") -> str:
    """Names that look like it, by their whole or by the parameter alone; otherwise where to find the list."""
    key = name.rpartition(".")[2]
    same = [full for full in known if full.rpartition(".")[2] == key]
    alike = get_close_matches(key, [full.rpartition(".")[2] for full in known], n=2)
    near = same + get_close_matches(name, known, n=3) + [k for k in known if k.rpartition(".")[2] in alike]
    near = list(dict.fromkeys(near))[:3]
    return f"did you mean {' or '.join(near)}?" if near else where


def _explain(error: ValidationError, fields: Mapping[str, FieldInfo]) -> str:
    """One line for the first thing that is wrong: parameter, value, wanted range and unit."""
    first = error.errors()[0]
    name = ".".join(str(part) for part in first["loc"][:2])
    if name not in fields:  # a rule across two parameters of one group
        return f"{name}: {str(first['msg']).removeprefix('Value error, ')}"
    return describe_error(name, first["input"], fields[name])


def describe_error(name: str, value: object, field: FieldInfo) -> str:
    """What a parameter must be, by its range and unit, and what it is instead."""
    words, comma, odd = range_of(field).partition(",")
    if field.annotation in (int, float):
        words = f"{'a whole number ' if field.annotation is int else ''}between {words.replace(' to ', ' and ')}"
    unit = "" if _unit(field) in ("-", "") else f" {_unit(field)}"
    return f"{name} must be {words}{unit}{comma}{odd}, got {value!r}"
