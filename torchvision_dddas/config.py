"""Every parameter: its default, unit, range and meaning; read from TOML files and `group.parameter=value` overrides."""

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

from torchvision_dddas.errors import InputError

# --------------------------------------------------------------------------------------------------------------------
# The parameters. A new one is a line in a group: type, default, unit, lowest, highest, meaning.


def _odd(value: int) -> int:
    if value % 2 == 0:
        raise ValueError("not odd")
    return value


Odd = Annotated[int, AfterValidator(_odd)]


def parameter(default: Any, unit: str, low: float | None = None, high: float | None = None, *, meaning: str) -> Any:
    """A field of a group: default, unit (`-` for a bare number), inclusive range, and what it does."""
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


class RegistrationParameters(Group):
    """How the background's motion between two frames is found (appendix B, steps S1 to S3)."""

    model: Literal["homography", "affine"] = parameter(
        "homography", "-", meaning="the background's motion: homography, or the earlier affine baseline"
    )
    keypoints: int = parameter(500, "points", 50, 5000, meaning="budget of good features to track in a frame")
    cell_px: int = parameter(
        16, "px", 4, 256, meaning="side of the grid cell that yields its best point; grows until the budget holds"
    )
    quality: float = parameter(
        0.01, "-", 1e-4, 0.5, meaning="smaller eigenvalue of a point, as a share of the frame's largest"
    )
    block_px: Odd = parameter(5, "px", 3, 15, meaning="window over which the structure tensor is summed, odd")
    window_px: Odd = parameter(21, "px", 5, 51, meaning="Lucas-Kanade's window, odd")
    levels: int = parameter(4, "levels", 0, 6, meaning="pyramid levels above the full resolution")
    iterations: int = parameter(30, "steps", 1, 100, meaning="Lucas-Kanade steps a level at most")
    epsilon_px: float = parameter(0.01, "px", 1e-4, 1, meaning="a Lucas-Kanade step shorter than this ends the search")
    forward_backward_px: float = parameter(
        1.0, "px", 0, 20, meaning="a point tracked there and back may miss its start by this; 0 leaves the check out"
    )
    ransac_px: float = parameter(
        2.0, "px", 0.1, 20, meaning="a point this close to the model's prediction is an inlier"
    )
    hypotheses: int = parameter(128, "models", 8, 4096, meaning="models drawn by RANSAC")
    redetect_frames: int = parameter(
        1, "frames", 1, 60, meaning="new keypoints every so many frames; between, inliers are carried on (onboard)"
    )
    halved: bool = parameter(False, "-", meaning="search pictures of half the size: quicker, half as exact (onboard)")
    min_inliers: int = parameter(20, "points", 4, 5000, meaning="fewer inliers make the registration unreliable")
    min_inlier_share: float = parameter(
        0.4, "-", 0, 1, meaning="a smaller share of inliers makes the registration unreliable"
    )


class IntervalParameters(Group):
    """The detection interval and the rule that steers it (appendix B, eq. 2)."""

    rule: bool = parameter(True, "-", meaning="steer the interval by altitude, speed and rate; false keeps `frames`")
    frames: int = parameter(3, "frames", 1, 60, meaning="the interval at the start, and for good where the rule is off")
    minimum_frames: int = parameter(3, "frames", 1, 60, meaning="shortest interval that the rule may choose")
    maximum_frames: int = parameter(8, "frames", 1, 60, meaning="longest interval that the rule may choose")
    reference_altitude_m: float = parameter(
        20.0, "m", 1, 1000, meaning="altitude above ground at which the interval is one frame"
    )
    reference_speed_m_s: float = parameter(
        5.0, "m/s", 0.1, 100, meaning="ground speed at which the interval is one frame"
    )
    reference_rate_hz: float = parameter(10.0, "1/s", 1, 240, meaning="frame rate at which the interval is one frame")
    reference_flow: float = parameter(
        0.02,
        "widths",
        1e-4,
        1,
        meaning="without telemetry: background flow a frame, as a share of the width, at which the interval is one",
    )
    lowest_speed_m_s: float = parameter(
        0.5, "m/s", 0.01, 10, meaning="floor of the speed, so that hovering gives the longest interval"
    )
    cost: float = parameter(1.0, "-", 0.1, 10, meaning="cost of one step relative to its reference (O in eq. 2)")
    memory_frames: int = parameter(
        9, "frames", 1, 100, meaning="steps over which the background flow's median is taken"
    )


class DifferenceParameters(Group):
    """What makes a pixel foreground (appendix B, step S4)."""

    kind: Literal["normalized", "to_reference", "between_later"] = parameter(
        "normalized",
        "-",
        meaning="normalized: the difference to both neighbours in units of local noise, exposure corrected; "
        "to_reference: min(|I(t) - W1|, |I(t) - W2|) in grey levels, a clear change of exposure undone; "
        "between_later: |W2 - W1|, the source's eq. 9",
    )
    near_frames: Annotated[tuple[Annotated[int, Field(ge=1, le=30)], ...], Field(min_length=1)] = parameter(
        (1, 2), "frames", meaning="distances of the neighbours on either side of the reference frame"
    )
    wide_frames: int = parameter(6, "frames", 0, 60, meaning="distance of the pair that fills large targets; 0 is none")
    noise_levels: float = parameter(4.0, "grey levels", 0.1, 50, meaning="noise of a flat region (normalized)")
    gradient_share: float = parameter(
        0.12, "-", 0, 2, meaning="share of the local gradient that counts as noise, for errors of registration"
    )
    threshold: float = parameter(
        3.5, "-", 0.1, 255, meaning="a larger difference is foreground: noise units if normalized, else grey levels"
    )
    peak: float = parameter(7.0, "-", 0, 255, meaning="a target's largest difference reaches at least this, same unit")
    blur_px: Odd = parameter(5, "px", 1, 31, meaning="Gaussian kernel on the difference, odd; 1 is none")
    border_px: int = parameter(4, "px", 0, 50, meaning="strip inside a warped frame's border that counts as outside")
    halved: bool = parameter(
        False, "-", meaning="compare pictures of half the size: quicker, coarser outlines (onboard)"
    )


class MorphologyParameters(Group):
    """How the silhouette is cleaned (appendix B, step S5)."""

    erode_px: int = parameter(
        3, "px", 1, 31, meaning="ellipse that erodes the silhouette: precision up, recall down; 1 is none"
    )
    close_px: int = parameter(
        25, "px", 1, 101, meaning="ellipse that closes gaps between fragments of one target; 1 is none"
    )
    close_m: float = parameter(
        0.0, "m", 0, 100, meaning="with telemetry: gaps up to this on the ground, close_px at the most; 0: close_px"
    )
    hull: bool = parameter(True, "-", meaning="take the convex hull of every blob")


class RefineParameters(Group):
    """Redrawing a target's outline by its motion and its colours."""

    on: bool = parameter(True, "-", meaning="refine outlines; false leaves the blobs of the morphology")
    spatial_px: float = parameter(90.0, "px", 1, 500, meaning="how far evidence spreads where colours do not change")
    colour_levels: float = parameter(80.0, "grey levels", 1, 1000, meaning="change of colour that stops the spread")
    share: float = parameter(
        0.55, "-", 0.05, 0.95, meaning="share of foreground evidence that makes a pixel foreground"
    )
    shadow_share: float = parameter(
        0.01, "-", 0, 1, meaning="cast shadows are cut off blobs of at most this share of the picture"
    )


class PersistenceParameters(Group):
    """What a blob must show over time to be a target: moving as one, steadily, unlike its surroundings."""

    on: bool = parameter(True, "-", meaning="test blobs by flow and persistence; false passes every blob")
    flow_share: float = parameter(0.3, "-", 0, 1, meaning="share of a blob's core that must move steadily for the test")
    sure_share: float = parameter(0.7, "-", 0, 1, meaning="share at which a large blob needs no further frames")
    links: int = parameter(3, "frames", 1, 5, meaning="of two frames before, itself and two after: seen in so many")
    passes: int = parameter(2, "frames", 0, 5, meaning="of those, so many pass the flow test")
    large_share: float = parameter(
        0.02, "-", 0, 1, meaning="a blob of this share of the picture needs one link and no flow test"
    )
    weak_links: int = parameter(4, "frames", 1, 5, meaning="a blob that only the wide pair shows: seen in so many ...")
    weak_passes: int = parameter(3, "frames", 0, 5, meaning="... and passing the flow test in so many")
    trusted_blobs: int = parameter(
        4, "blobs", 0, 1000, meaning="where no more blobs are seen a frame, one link does: parallax comes in crowds"
    )


class SmallParameters(Group):
    """Small slow targets: weak evidence over a longer gap, confirmed by steady travel."""

    on: bool = parameter(True, "-", meaning="look for small slow targets while the interval is long enough")
    from_interval: int = parameter(3, "frames", 1, 60, meaning="shortest interval at which they are looked for")
    gap_frames: int = parameter(
        6, "frames", 1, 30, meaning="distance of the neighbours on either side, no longer than the interval"
    )
    threshold: float = parameter(6.0, "grey levels", 1, 255, meaning="a larger difference makes a candidate, ...")
    noise_ratio: float = parameter(6.0, "-", 0, 100, meaning="... one that is also this many times the picture's mean")
    close_px: int = parameter(13, "px", 1, 31, meaning="ellipse that joins the parts of a candidate; 1 is none")
    min_area_px: int = parameter(12, "px", 1, 10_000, meaning="smallest area of a candidate")
    max_box_px: int = parameter(1500, "px", 10, 1_000_000, meaning="largest box of a candidate, pixels of area")
    max_candidates: int = parameter(80, "blobs", 1, 10_000, meaning="with more of them in a frame, none is followed")
    max_blobs: int = parameter(
        4, "blobs", 0, 1000, meaning="with more large blobs than this about, parallax may be at work, ..."
    )
    parallax_px: float = parameter(
        0.15, "px", 0, 10, meaning="... and is where inliers miss the registration by more: no small target is reported"
    )
    gate_px: float = parameter(
        4.0, "px", 0.5, 50, meaning="a candidate this close to a track's prediction continues it"
    )
    hits: int = parameter(10, "frames", 2, 60, meaning="frames with a candidate that confirm a track at the earliest")
    min_travel_px: float = parameter(3.0, "px", 0, 100, meaning="a confirmed track has travelled at least this")
    sureness: float = parameter(8.0, "-", 1, 100, meaning="... at a speed of so many of its standard deviations")
    misses: int = parameter(3, "frames", 0, 30, meaning="frames without a candidate after which a track ends")


class HistoryParameters(Group):
    """The motion history, its gradient and the segmentation by motion (appendix B, step S5)."""

    on: bool = parameter(
        True, "-", meaning="heading and speed from the history where the chain computes no flow; part touching targets"
    )
    duration_frames: float = parameter(6.0, "frames", 1, 120, meaning="how long a silhouette stays in the history")
    delta_min_frames: float = parameter(
        0.5, "frames", 0, 60, meaning="smallest difference of time stamps that makes a gradient"
    )
    delta_max_frames: float = parameter(
        4.0, "frames", 0, 120, meaning="largest difference of time stamps that makes a gradient"
    )
    segmentation_threshold_frames: float = parameter(
        1.0, "frames", 0, 60, meaning="neighbours whose stamps differ by more belong to different motions"
    )


class GateParameters(Group):
    """Which blobs can be targets; the bounds in metres hold when telemetry is given (appendix A)."""

    min_area_px: int = parameter(300, "px", 1, 1_000_000, meaning="smallest foreground area of a target")
    min_size_m: float = parameter(0.2, "m", 0, 100, meaning="shortest longer side of a target on the ground")
    max_size_m: float = parameter(25.0, "m", 0.1, 1000, meaning="longest longer side of a target on the ground")
    max_speed_m_s: float = parameter(60.0, "m/s", 0.1, 500, meaning="fastest target over ground")
    focal_px: float = parameter(
        1000.0, "px", 10, 100_000, meaning="focal length: px bounds are metric bounds x focal / altitude"
    )
    expected_size_m: float = parameter(
        1.7, "m", 0.05, 100, meaning="size of a typical small target: sets the smallest area when telemetry is given"
    )
    expected_share: float = parameter(
        0.1, "-", 0.01, 1, meaning="share of the expected target's square that its foreground fills at least"
    )


class TrackParameters(Group):
    """Which detections become tracks, how they are linked, and how long a track lives. Lengths are in box heights."""

    mode: Literal["default", "paper"] = parameter(
        "default", "-", meaning="default: links scored by motion, size and appearance; paper: the source's affinity"
    )
    look_ahead: bool = parameter(True, "-", meaning="decide with the next frame in view (K = 3); false decides at once")
    appearance: Literal["always", "ambiguous", "never"] = parameter(
        "ambiguous", "-", meaning="compare pictures of targets: always, where locations leave a doubt, or never"
    )
    min_score: float = parameter(0.7, "-", 0, 1, meaning="detections of a lower score are no part of any track")
    birth_score: float = parameter(0.95, "-", 0, 1, meaning="a detection of at least this score may begin a track")
    hits: int = parameter(3, "frames", 1, 60, meaning="detections that confirm a track; one of score 1 does so alone")
    smooth: bool = parameter(True, "-", meaning="move boxes of a score below 1 to where their track was")
    memory_frames: int = parameter(125, "frames", 1, 10_000, meaning="how long a track that is not seen is remembered")
    memory_outside_frames: int = parameter(10, "frames", 1, 10_000, meaning="the same once it has left the picture")
    speed: float = parameter(0.07, "heights/frame", 1e-4, 10, meaning="typical speed at the start; adapts to the scene")
    agility: float = parameter(0.009, "heights/frame", 1e-5, 1, meaning="change of velocity in one frame at that speed")
    scatter: float = parameter(0.06, "heights", 1e-3, 1, meaning="scatter of a detection's centre")
    size_scatter: float = parameter(0.1, "-", 1e-3, 10, meaning="scatter of the logarithm of a detection's height")
    prior: float = parameter(4.0, "-", -20, 20, meaning="what any link is worth before it is compared: opens the gate")
    tail: float = parameter(
        4.0, "-", 0.1, 100, meaning="freedom of the distance's law: a small one forgives sharp turns and stops"
    )
    upright: float = parameter(
        0.6, "-", 0.1, 2, meaning="distances of standing targets up and down count as larger by one over this"
    )
    rest_drift: float = parameter(
        0.03, "heights", 1e-4, 1, meaning="drift in one frame of a target that may stand still unseen"
    )
    rest_price: float = parameter(1.0, "-", 0, 20, meaning="price of taking a lost target to have stood still")
    missed: float = parameter(0.5, "-", 0, 20, meaning="price of a gap in a track")
    border: float = parameter(4.0, "-", 0, 20, meaning="price of a return after a gap at the picture's border")
    left: float = parameter(2.0, "-", 0, 20, meaning="price of a return after a gap of who was last seen at the border")
    births: float = parameter(2.0, "-", 0, 10, meaning="price of a return after a gap where targets keep appearing")
    own_scatter: float = parameter(0.2, "heights", 1e-3, 1, meaning="scatter for the moving targets found in a clip")
    own_size_scatter: float = parameter(1.0, "-", 1e-3, 10, meaning="size_scatter for those, which part and join")
    own_births: float = parameter(0.0, "-", 0, 10, meaning="births for those: most are parts of known targets")
    appearance_weight: float = parameter(10.0, "-", 0, 100, meaning="weight of the appearance's likeness")
    appearance_offset: float = parameter(
        0.86, "-", 0, 1, meaning="likeness that speaks neither for a link nor against it"
    )


class PaperParameters(Group):
    """The source's association as printed (appendix C, III); each reading that it leaves open is a named option."""

    window: int = parameter(3, "frames", 2, 3, meaning="frames associated at once: K of the source")
    rule: Literal["dispersion", "fixed"] = parameter(
        "dispersion", "-", meaning="the weight of location: chosen by the dispersions (III-D), or `weight` for good"
    )
    weight: float = parameter(0.7, "-", 0, 1, meaning="share of location in the affinity where the rule is fixed")
    lowest_dispersion: float = parameter(
        0.65, "-", 0, 1, meaning="a feature above this tells targets apart: LL of III-D"
    )
    location_cut: float = parameter(
        0.25, "-", 0, 1, meaning="clusters of locations end at this dissimilarity: the normalised G; empirical"
    )
    appearance_cut: float = parameter(
        0.25, "-", 0, 1, meaning="clusters of histograms end at this dissimilarity; empirical"
    )
    dispersion_of: Literal["smallest", "smallest_if_counts_differ", "newest"] = parameter(
        "smallest",
        "-",
        meaning="which frame of the window speaks for it; the source: smallest if counts differ",
    )
    gate: Literal["one_dummy", "every_dummy", "off"] = parameter(
        "one_dummy",
        "-",
        meaning="entries raised to 1 - threshold: with exactly one dummy; with any number, as printed; none",
    )
    gated: Literal["features", "affinity"] = parameter(
        "features", "-", meaning="gate location and appearance each before they are weighed, or their weighted sum"
    )
    threshold: float = parameter(
        0.4, "-", 0, 1, meaning="an entry with a dummy is raised where all real alternatives are below 1 - threshold"
    )
    dummy: Literal["zero", "formula"] = parameter(
        "zero", "-", meaning="affinity with a dummy before the gate: none, or eq. 4 and 5 with a vector of zeros"
    )
    histogram: Literal["channel", "count"] = parameter(
        "channel", "-", meaning="histograms add up to 1 in each channel, or hold counts, so that size matters too"
    )
    exact_targets: int = parameter(
        12, "targets", 0, 1000, meaning="three frames with no more targets in any are solved exactly, others ..."
    )
    gap: float = parameter(
        0.005, "-", 0, 1, meaning="... by relaxation, to within this share of the bound where that can be had in time"
    )


class PeopleParameters(Group):
    """Recognizing people by HOG and a linear SVM (appendix A, III-B): which windows are scored, and what they yield."""

    classifier: str = parameter(
        "opencv", "-", meaning="opencv: the coefficients of its default people detector; or a file of a linear SVM's"
    )
    graphs: str = parameter(
        "shipped", "-", meaning="onboard: the ONNX graphs; a folder that `dddas export` made, or shipped"
    )
    window_width_px: int = parameter(64, "px", 8, 1024, meaning="width of the window that the classifier sees")
    window_height_px: int = parameter(128, "px", 8, 1024, meaning="height of the window that the classifier sees")
    cell_px: int = parameter(8, "px", 2, 64, meaning="side of a cell, which has one histogram")
    block_px: int = parameter(16, "px", 2, 256, meaning="side of a block of cells, which is normalised as one")
    block_stride_px: int = parameter(8, "px", 1, 256, meaning="distance from block to block in a window")
    window_stride_px: int = parameter(
        8, "px", 1, 256, meaning="distance from window to window in each level of the pyramid"
    )
    bins: int = parameter(
        9, "bins", 2, 36, meaning="directions of a histogram, over half a turn, or a whole one if signed"
    )
    signed: bool = parameter(False, "-", meaning="tell a gradient from its opposite; false folds them together")
    clip: float = parameter(
        0.2, "-", 0.01, 1, meaning="largest share of a block's norm that one number may have (L2-Hys)"
    )
    gamma: bool = parameter(True, "-", meaning="take square roots of the levels first")
    scale_step: float = parameter(
        1.05, "-", 1.01, 2, meaning="how much smaller each level of the pyramid is than the last"
    )
    enlarge: float = parameter(
        1.5,
        "-",
        1,
        4,
        meaning="the pyramid begins with the picture so many times larger, in whole scale steps: bodies are found from "
        "height_share x window_height_px / enlarge, 64 px; the cost grows with its square",
    )
    max_levels: int = parameter(64, "levels", 1, 200, meaning="levels of the pyramid at most")
    padding_px: int = parameter(
        24, "px", 0, 256, meaning="border that each level is given by reflection, for people at it"
    )
    threshold: float = parameter(0.0, "-", -10, 10, meaning="a window whose score is above it may be a person")
    suppression: Literal["nms", "opencv", "none"] = parameter(
        "nms",
        "-",
        meaning="one box a person: nms keeps the best of windows that overlap; opencv averages groups; none keeps all",
    )
    overlap: float = parameter(0.4, "-", 0, 1, meaning="nms: bodies that share more of their union are the same person")
    contained: float = parameter(
        0.7,
        "-",
        0,
        1,
        meaning="nms: so are those that share more of the smaller one, as legs do with the body; 1: none",
    )
    settle: float = parameter(
        0.75,
        "-",
        0,
        1,
        meaning="nms: the box is the mean, by score, of windows that share this much of their union with the best; "
        "1: the best alone",
    )
    group: int = parameter(2, "windows", 0, 100, meaning="opencv: a group of no more windows than this is dropped")
    group_distance: float = parameter(0.2, "-", 0, 1, meaning="opencv: edges this close, in box sizes, make a group")
    height_share: float = parameter(0.738, "-", 0.1, 1, meaning="body height over window height")
    width_share: float = parameter(0.5, "-", 0.1, 1, meaning="width of the body's box over window width")
    feet_share: float = parameter(0.845, "-", 0.1, 1.2, meaning="from the window's top to the feet, over window height")
    probability_slope: float = parameter(
        2.6, "-", 0.01, 100, meaning="probability = 1 / (1 + exp(-slope (score - even)))"
    )
    probability_even: float = parameter(0.8, "-", -10, 10, meaning="score at which a person is as likely as not")
    search: Literal["everywhere", "regions"] = parameter(
        "everywhere",
        "-",
        meaning="look at the whole picture in every frame, or around what is expected there and at the rest in turns",
    )
    rescan_frames: int = parameter(
        10, "frames", 1, 10_000, meaning="regions: in so many frames the whole picture, some of its levels in each"
    )
    look_share: float = parameter(
        1.0,
        "-",
        0.001,
        1,
        meaning="regions: what a look may cost at most, as a share of one at the whole picture, so none takes long: "
        "picture and regions are then searched in turns from the first look on; 1: no bound. --live takes 0.1 at most",
    )
    region_margin: float = parameter(0.2, "heights", 0, 5, meaning="regions: so far around a body that is expected")
    region_scales: float = parameter(1.15, "-", 1, 4, meaning="regions: a body may be this much larger or smaller")

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
        "default", "-", meaning="default: height and foot row with covariances, on the ellipsoid; paper: eq. 13 to 15"
    )
    use: Literal["both", "height", "feet"] = parameter(
        "both",
        "-",
        meaning="what tells the distance: the body's height, the row of its feet, or both by their variances",
    )
    body_height_m: float = parameter(1.75, "m", 0.3, 3, meaning="height of a typical person")
    body_height_sigma_m: float = parameter(0.1, "m", 0, 1, meaning="standard deviation of people's heights")
    height_sigma: float = parameter(0.05, "-", 0, 1, meaning="standard deviation of a box's height, in heights")
    feet_sigma: float = parameter(0.03, "-", 0, 1, meaning="standard deviation of the foot row, in box heights")
    gate_sigmas: float = parameter(3.0, "-", 0.5, 10, meaning="sightings further apart than this are not of one person")
    within_frames: int = parameter(
        0, "frames", 0, 1000, meaning="frames of several cameras no further apart are one look"
    )


class ConfirmParameters(Group):
    """When people seen from the ground decide what a blob seen from the air is: two fidelities (appendix A, III-B)."""

    gate_probability: float = parameter(
        0.99, "-", 0.5, 0.9999, meaning="share of people who lie within the gate of their own blob, by both covariances"
    )
    spread_m: float = parameter(
        0.5, "m", 0, 20, meaning="standard deviation of people about their blob's position, which may be a crowd's"
    )
    unknown_sigma_m: float = parameter(
        2.0, "m", 0.01, 100, meaning="standard deviation of a position whose table gives no covariance"
    )
    inside_sigmas: float = parameter(
        2.0, "-", 0, 10, meaning="a blob so many of its standard deviations within a view is well within it"
    )
    body_width_m: float = parameter(0.6, "m", 0, 10, meaning="what stands nearer, this close to a line of sight, hides")
    least_score: float = parameter(
        0.5, "-", 0.5, 1, meaning="a person less probable than this tells neither for nor against their blob"
    )
    detection_rate: float = parameter(0.7, "-", 0.01, 0.999, meaning="share of looks at a person that recognize one")
    false_rate: float = parameter(
        0.05, "-", 0.001, 0.99, meaning="share of looks at another blob that recognize one there"
    )
    crowd_share: float = parameter(
        0.5, "-", 0, 1, meaning="in pictures: detection rate in a blob as wide as several people, over that of one"
    )
    prior: float = parameter(0.5, "-", 0.01, 0.99, meaning="share of the blobs that are people")
    fresh: float = parameter(
        0.3, "-", 0, 1, meaning="weight of a look that follows another of the same vehicle: they err alike"
    )
    limit: float = parameter(
        7.0, "-", 0.5, 50, meaning="log-odds never pass this, so that later looks can still turn them"
    )
    share: float = parameter(
        0.5, "-", 0.01, 1, meaning="in pictures: share of the smaller of a person's and a blob's box that both hold"
    )


class LandmarkParameters(Group):
    """How ground vehicles serve as landmarks: found by colour, told from targets, followed (appendix A, IV-A)."""

    differentiation: Literal["exact", "greedy"] = parameter(
        "exact", "-", meaning="which blob is which landmark: as many as possible at the least distance; or row by row"
    )
    centre: Literal["motion", "colour"] = parameter(
        "motion",
        "-",
        meaning="where a landmark that has a blob is: the blob's centre, or its colour's, the better one where the "
        "colour is in the middle of the vehicle",
    )
    reach_px: float = parameter(
        40.0, "px", 0, 10000, meaning="a blob further from a landmark's colour is not the landmark's"
    )
    interval_frames: int = parameter(
        10, "frames", 1, 10000, meaning="every so many frames landmarks are told from targets anew (tracking interval)"
    )
    least_area_px: int = parameter(12, "px", 1, 1_000_000, meaning="a patch of colour smaller than this is none")
    pixel_sigma: float = parameter(
        1.0, "px", 0.01, 100, meaning="standard deviation of a landmark's place in the picture"
    )
    sigma_m: float = parameter(
        1.43, "m", 0, 1000, meaning="of a landmark's report where it does not say: a GPS of 3.5 m in 95 %"
    )
    common_sigma_m: float = parameter(
        0.0, "m", 0, 1000, meaning="standard deviation of the error that all the team's receivers share"
    )
    gap_s: float = parameter(
        5.0, "s", 0, 3600, meaning="a dropout of reports longer than this without planned waypoints ends a landmark"
    )
    drift_m_s: float = parameter(0.5, "m/s", 0, 100, meaning="how fast a place gets uncertain during a dropout")
    height_m: float = parameter(
        0.0, "m", 0, 20, meaning="height of the colour above ground, or of the point that the table has pixels of"
    )
    length_m: float = parameter(
        4.0, "m", 0.1, 50, meaning="length of a vehicle: what moves at its colour and is no longer is it, and no target"
    )
    least: int = parameter(
        4, "landmarks", 4, 64, meaning="landmarks used where they are detected well (4-or-more rule)"
    )
    rule: Literal["all", "source"] = parameter(
        "all", "-", meaning="all: every landmark at hand; source: more than `least` only where detection is poor"
    )
    poor_speed_m_s: float = parameter(
        2.0, "m/s", 0, 100, meaning="source rule: landmarks that move faster on average count as poorly detected"
    )


class AerialParameters(Group):
    """How the picture from the air is laid on the ground by landmarks and telemetry (appendix A, IV-B)."""

    mode: Literal["pose", "homography", "paper"] = parameter(
        "pose",
        "-",
        meaning="pose: the camera's, by landmarks and telemetry; homography: by landmarks alone; paper: raw degrees",
    )
    hfov_deg: float = parameter(
        70.0, "deg", 1, 170, meaning="width of the field of view where neither camera nor telemetry says it"
    )
    pitch_deg: float = parameter(
        90.0, "deg", -90, 90, meaning="how far the camera looks below the horizon where neither says it; 90: down"
    )
    focal_sigma: float = parameter(
        0.01,
        "-",
        0,
        1,
        meaning="standard deviation, as a share, of a focal length that is given, unless the camera's file says it",
    )
    focal_guess_sigma: float = parameter(0.2, "-", 0, 1, meaning="the same where it is not given but hfov_deg guessed")
    tilt_sigma_deg: float = parameter(1.0, "deg", 0, 90, meaning="standard deviation of the reported tilt, each way")
    tilt_guess_sigma_deg: float = parameter(
        15.0, "deg", 0, 180, meaning="the same where the telemetry does not say it but pitch_deg is taken"
    )
    heading_sigma_deg: float = parameter(5.0, "deg", 0, 180, meaning="standard deviation of the reported heading")
    altitude_sigma: float = parameter(0.02, "-", 0, 10, meaning="standard deviation of the altitude, as a share of it")
    altitude_sigma_m: float = parameter(0.0, "m", 0, 1000, meaning="and in metres")
    position_sigma_m: float = parameter(
        1.43, "m", 0, 1000, meaning="standard deviation of the vehicle's place, east and north each: 3.5 m in 95 %"
    )
    target_sigma_px: float = parameter(
        1.0, "px", 0, 100, meaning="standard deviation of a target's place in the picture"
    )
    own_sigma: float = parameter(
        0.13, "sides", 0, 2, meaning="the same of boxes that dddas found moving, beside it, in sides of the box"
    )
    point: Literal["auto", "centre", "foot"] = parameter(
        "auto",
        "-",
        meaning="which point of a box is on the ground: its centre; the foot of a body whose middle is the centre; "
        "auto: the feet that the table names, the foot for tables of dddas, else the centre",
    )
    shadows: bool = parameter(
        False, "-", meaning="what moves is a body and its shadow: the foot is sought by where the sun stands"
    )
    sun_azimuth_deg: float = parameter(0.0, "deg", 0, 360, meaning="where the sun stands, clockwise from north")
    sun_height_deg: float = parameter(
        0.0, "deg", 0, 90, meaning="how high above the horizon; 0: by the telemetry's clock, no shadows without one"
    )
    target_height_m: float = parameter(1.7, "m", 0, 100, meaning="height of the body whose foot is sought")
    gate_probability: float = parameter(
        0.999, "-", 0.5, 0.999999, meaning="share of right landmarks that pass the test against what is expected"
    )
    correlation_s: float = parameter(
        20.0,
        "s",
        0,
        10000,
        meaning="time over which errors of telemetry and receivers stay alike; 0: frames stand alone",
    )
    least_spread: float = parameter(
        0.02, "-", 0, 1, meaning="landmarks whose width is a smaller share of their length count as on one line"
    )
    clock_offset_s: float = parameter(
        0.0, "s", -1e6, 1e6, meaning="added to the times of telemetry and landmarks to get those of the clip"
    )


class CrowdParameters(Group):
    """Moving targets that go together as one crowd."""

    join_m: float = parameter(
        0.0, "m", 0, 100, meaning="targets located from the air with gaps up to this are one crowd; 0: each on its own"
    )
    speed_m_s: float = parameter(
        1.5, "m/s", 0.01, 100, meaning="targets whose velocities over ground differ by more do not go together"
    )


class SteeringParameters(Group):
    """How what is found steers where the instruments go and look, in a run whose source can be steered."""

    on: bool = parameter(True, "-", meaning="steer the instruments; false flies as planned, whatever is found")
    sampling: bool = parameter(
        False, "-", meaning="look at every k-th frame only, k by the rule of the interval; the clip must be in order"
    )
    sampling_share: float = parameter(
        0.5, "-", 0.01, 10, meaning="k as a share of the interval that the rule gives before its bounds"
    )
    least_move_px: float = parameter(
        1.5, "px", 0, 100, meaning="k is large enough for a walker to move by this from look to look: less hardly shows"
    )
    maximum_every: int = parameter(5, "frames", 1, 60, meaning="largest k, however slow the scene")
    follow: bool = parameter(
        True, "-", meaning="the aerial vehicle keeps the crowds in view; false: it flies as planned"
    )
    look: bool = parameter(True, "-", meaning="ground vehicles go where targets need a closer look; false: as planned")
    fast_m_s: float = parameter(3.0, "m/s", 0, 30, meaning="speed of a ground vehicle far from its goal")
    slow_m_s: float = parameter(1.0, "m/s", 0, 30, meaning="and near it, where its own motion must not spoil its place")
    near_m: float = parameter(6.0, "m", 0, 1000, meaning="what counts as near")
    station_m: float = parameter(12.0, "m", 2, 1000, meaning="how far from a crowd ground vehicles stand about it")
    look_m: float = parameter(
        14.0, "m", 1, 1000, meaning="up to this distance a ground vehicle's camera recognizes people: 64 px of body"
    )
    picture_s: float = parameter(1.0, "s", 0.01, 3600, meaning="time between two pictures of one ground vehicle")
    maximum_altitude_m: float = parameter(
        0.0, "m", 0, 10_000, meaning="the aerial vehicle climbs no higher to see more; 0: twice its altitude at first"
    )


class LiveParameters(Group):
    """A run that must keep up with a camera."""

    pace: float = parameter(
        1.0, "-", 0, 1000, meaning="a file plays so many times as fast as it was filmed; 0: as fast as it is taken"
    )
    queue_frames: int = parameter(2, "frames", 1, 64, meaning="pictures that may wait; of more the oldest is dropped")
    deadline_ms: float = parameter(
        80.0,
        "ms",
        1,
        60_000,
        meaning="what a picture may take from camera to results, those it waits for apart",
    )
    shed: bool = parameter(
        True, "-", meaning="look at less when it takes too long; false: pictures are dropped instead"
    )
    load: float = parameter(
        0.85, "-", 0.1, 1, meaning="share of the time between two pictures that looking at one may take"
    )
    calm_s: float = parameter(5.0, "s", 0.1, 600, meaning="more is looked at again after so long with time to spare")
    least_keypoints: int = parameter(80, "-", 16, 10_000, meaning="no fewer keypoints than this, however busy")
    maximum_every: int = parameter(
        8, "frames", 1, 60, meaning="at least one of so many pictures is looked at, however busy"
    )
    stall_s: float = parameter(5.0, "s", 0.1, 600, meaning="a stream that sends nothing for so long counts as lost")
    retry_s: float = parameter(0.5, "s", 0.01, 600, meaning="a lost stream is opened again after this, then twice that")
    retry_most_s: float = parameter(30.0, "s", 0.01, 3600, meaning="... and so on up to this")
    watchdog_s: float = parameter(30.0, "s", 0, 3600, meaning="a step that takes so long counts as hung; 0: none does")
    status_s: float = parameter(
        2.0, "s", 0.1, 600, meaning="how often the state of the run is written, and results are put to disk"
    )

    @model_validator(mode="after")
    def _pauses_grow(self) -> "LiveParameters":
        if self.retry_most_s < self.retry_s:
            raise ValueError(f"retry_most_s = {self.retry_most_s:g} is below retry_s = {self.retry_s:g}")
        return self


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
    return [
        Parameter(name, field.default, _unit(field), range_of(field), field.description or "")
        for name, field in _parameter_fields()
    ]


def changes(settings: Settings) -> dict[str, object]:
    """The parameters that differ from their defaults: `{"group.parameter": value}`."""
    now = {name: getattr(getattr(settings, name.split(".")[0]), name.split(".")[1]) for name, _ in _parameter_fields()}
    return {name: now[name] for name, field in _parameter_fields() if now[name] != field.default}


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

    config: the name of a shipped configuration (`source`, `fast`) or a TOML file. base: `{"group.parameter": value}`.
    Raises InputError with one line: no such file, bad TOML, unknown parameter (with the nearest names), value out of
    range.
    """
    settings = with_parameters(Settings(), base or {})
    if config is not None:
        path = _config_file(config)
        settings = with_parameters(settings, _flat(read_toml(path), str(path)), origin=str(path))
    return with_parameters(settings, dict(parse_override(text) for text in overrides))


def with_parameters(settings: Settings, values: Mapping[str, object], origin: str = "") -> Settings:
    """A copy of the settings with `{"group.parameter": value}` changed and everything checked again.

    origin: where the values come from, put before the message. Raises InputError for an unknown parameter or a bad
    value.
    """
    before = f"{origin}: " if origin else ""
    fields = dict(_parameter_fields())
    content = settings.model_dump()
    for name, value in values.items():
        if name not in fields:
            raise InputError(f"{before}unknown parameter '{name}'; {nearest(name, list(fields))}")
        group, key = name.split(".")
        content[group][key] = tuple(value) if isinstance(value, list) else value
    try:
        return Settings.model_validate(content)
    except ValidationError as error:
        raise InputError(before + _explain(error, fields)) from None


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
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{name} cannot be read: {error.strerror}") from None
    except RecursionError:
        raise InputError(f"{name} is not valid TOML: its brackets are nested too deeply") from None
    except ValueError as error:  # no UTF-8, no TOML, or a number of thousands of digits
        raise InputError(f"{name} is not valid TOML: {str(error).split(';')[0]}") from None


def format_toml(content: Mapping[str, Any], comments: Sequence[str] = ()) -> str:
    """TOML text of plain values, lists and tables, which read_toml reads as the same. comments: lines above it."""
    text = tomli_w.dumps(content, indent=1)
    while (shorter := _ARRAY.sub(lambda found: "[" + ", ".join(re.split(r",\n *", found[1])[:-1]) + "]", text)) != text:
        text = shorter
    return "".join(f"# {line}\n" for line in comments) + ("\n" if comments else "") + text


# An array without further arrays in it, one element a line, as tomli_w writes it.
_ARRAY = re.compile(r"\[\n +((?:[^\n]*,\n *)+?)\]")


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
