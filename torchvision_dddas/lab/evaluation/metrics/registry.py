"""Every measure and group of measures: its title, unit, direction and decimals, and its computation from counts.

Tables, reports, comparisons and the goals of sweeps read the registry. A new measure is computed in its group's module
and has one line in METRICS. A new group has its counts beside its measures, and an entry in GROUPS.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from torchvision_dddas.lab.evaluation.metrics import boxes, metres, pixels, tracking
from torchvision_dddas.lab.evaluation.metrics.boxes import BoxCounts, OneTarget
from torchvision_dddas.lab.evaluation.metrics.metres import LocatedCounts
from torchvision_dddas.lab.evaluation.metrics.pixels import Pixels, Still, add_counts
from torchvision_dddas.lab.evaluation.metrics.tracking import TargetTrack, TrackCounts

Counts = dict[str, Pixels | BoxCounts | OneTarget | TrackCounts | TargetTrack | Still | LocatedCounts]
"""The counts of a clip by group; counts add over frames and clips."""


class Metric(NamedTuple):
    """The description of a measure for tables and reports.

    title: the heading in reports. short: the heading of a narrow column. better: 1 if larger values are better, -1 if
    smaller values are better, 0 if neither is. digits: the number of decimals. unit: empty for shares and counts.
    is_share: whether the values lie between 0 and 1.
    """

    title: str
    meaning: str = ""
    better: int = 1
    digits: int = 3
    is_share: bool = True
    unit: str = ""
    short: str = ""


def _distance(title: str, meaning: str, short: str = "") -> Metric:
    return Metric(f"{title}, m", meaning, -1, 2, False, "m", short)


METRICS: Mapping[str, Metric] = {
    "f": Metric("F", "harmonic mean of precision and recall, of pixels"),
    "f1": Metric("F1", "harmonic mean of precision and recall"),
    "precision": Metric("precision", "share of the found pixels or boxes that are true", short="prec."),
    "recall": Metric("recall", "share of the true pixels or boxes that were found"),
    "specificity": Metric("specificity", "share of the background that was not detected", short="spec."),
    "accuracy": Metric("accuracy", "share of all that was classified correctly", short="acc."),
    "gmean": Metric("Gmean", "geometric mean of recall and specificity"),
    "ap": Metric("AP", "average precision: area below precision over recall"),
    "log_average_miss_rate": Metric("LAMR", "log-average miss rate, 0.01 to 1 false positives per image", -1),
    "miss_rate_at_0.1": Metric(
        "missed at 0.1", "share missed at 0.1 false positives per image", -1, short="miss at 0.1"
    ),
    "miss_rate_at_1": Metric("missed at 1", "share missed at 1 false positive per image", -1, short="miss at 1"),
    "hit": Metric("hit", "share of frames in which the target is hit"),
    "iou_0.3": Metric("IoU ≥ 0.3", "share of frames in which a box meets the target at IoU 0.3"),
    "other_blobs_per_frame": Metric("other blobs", "boxes elsewhere, a frame", -1, 2, False),
    "hota": Metric("HOTA", "detection and association weighed evenly, over all IoUs"),
    "deta": Metric("DetA", "detection accuracy of HOTA"),
    "assa": Metric("AssA", "association accuracy of HOTA"),
    "mota": Metric("MOTA", "1 less misses, false boxes and switches, for each true box"),
    "motp": Metric("MOTP", "mean IoU of the boxes found"),
    "idf1": Metric("IDF1", "share of boxes that carry the right identity"),
    "ar_2": Metric("AR₂", "accuracy ratio of links over two frames", short="AR_2"),
    "ar_3": Metric("AR₃", "accuracy ratio of links over three frames", short="AR_3"),
    "mostly_tracked": Metric("mostly tracked", "share of targets found in over 80 % of their frames"),
    "mostly_lost": Metric("mostly lost", "share of targets found in under 20 % of their frames", -1),
    "found": Metric("found", "share of frames in which the target has a box"),
    "same_identity": Metric("same identity", "share of frames in which the target has the identity it has most"),
    "n_switches": Metric("switches", "changes of identity", -1, 0, False, short="IDsw"),
    "n_fragmentations": Metric("fragments", "interruptions of a track", -1, 0, False, short="frag."),
    "false_blobs_per_frame": Metric("false blobs", "a frame", -1, 2, False),
    "alarmed": Metric("alarmed", "share of frames with any false blob", -1),
    "located": Metric("located", "share of the true positions that were found"),
    "belongs": Metric("belongs", "share of the found positions that belong to a target"),
    "mean_m": _distance("mean", "mean error on the Earth, metres"),
    "median_m": _distance("median", "median error on the Earth, metres", "median"),
    "p95_m": _distance("95 %", "error that 95 % of the positions stay below, metres", "95 %"),
    "rms_m": _distance("RMS", "root mean square of the errors, metres"),
    "in_ellipse": Metric(
        "in ellipse", "share of positions whose 95 % ellipse contains the true position", 0, short="inside"
    ),
    "relative_mean_m": _distance("team mean", "mean error relative to the team, metres"),
    "relative_median_m": _distance("team median", "median error relative to the team, metres", "to team"),
    "relative_p95_m": _distance("team 95 %", "error relative to the team that 95 % stay below, metres", "95 %"),
    "relative_rms_m": _distance("team RMS", "root mean square of the errors relative to the team"),
    "relative_in_ellipse": Metric(
        "team in ellipse", "share whose ellipse relative to the team contains the position", 0, short="inside"
    ),
}


class MetricGroup(NamedTuple):
    """Measures that come from the same counts.

    title: name in reports. tasks: the tasks of a study that can have the group. columns: the measures of its table on
    the terminal. shown: the measures of its table in reports. compared: the measures that a comparison of two studies
    tests; the first is also compared clip by clip. counts: its counts, all zero. measures: function from counts to
    measures by name. Both are None if the measures come from samples that are pooled, `boxes.Ranking` and
    `metres.measures`.
    """

    title: str
    tasks: tuple[str, ...]
    columns: tuple[str, ...]
    shown: tuple[str, ...]
    compared: tuple[str, ...]
    counts: Any = None
    measures: Callable[[Any], dict[str, float]] | None = None


RANKED, METRES = "ranking", "metres"
"""The groups whose measures come from samples: detections ranked by score, errors on the ground."""

_PIXELS = ("f", "precision", "recall", "specificity", "accuracy", "gmean")
_BOXES = ("f1", "precision", "recall")
_RANKED = ("ap", "log_average_miss_rate", "miss_rate_at_0.1", "miss_rate_at_1")
_ONE_TARGET = ("hit", "iou_0.3", "other_blobs_per_frame")
_TARGET_TRACK = ("found", "same_identity", "n_switches", "n_fragmentations")
_STILL = ("false_blobs_per_frame", "alarmed")

GROUPS: Mapping[str, MetricGroup] = {
    "pixels": MetricGroup("pixels", ("motion",), _PIXELS, _PIXELS, _PIXELS, Pixels(), pixels.measures),
    "boxes": MetricGroup("boxes, IoU ≥ 0.5", ("motion", "people"), _BOXES, _BOXES, _BOXES, BoxCounts(), boxes.measures),
    RANKED: MetricGroup("boxes ranked by score", ("motion", "people"), _RANKED, _RANKED, _RANKED[:2]),
    "target": MetricGroup(
        "one labelled target",
        ("motion",),
        _ONE_TARGET,
        _ONE_TARGET,
        ("hit", "other_blobs_per_frame"),
        OneTarget(),
        boxes.one_target_measures,
    ),
    "tracks": MetricGroup(
        "tracks",
        ("tracking", "association"),
        ("hota", "deta", "assa", "mota", "idf1", "n_switches", "ar_3"),
        ("hota", "idf1", "mota", "deta", "assa", "recall", "precision", "n_switches", "ar_2", "ar_3"),
        ("hota", "mota", "idf1", "ar_3"),
        TrackCounts(),
        tracking.measures,
    ),
    "target_track": MetricGroup(
        "the labelled target's track, IoU ≥ 0.3",
        ("tracking",),
        _TARGET_TRACK,
        _TARGET_TRACK,
        ("found", "same_identity"),
        TargetTrack(),
        tracking.one_target_measures,
    ),
    "still": MetricGroup(
        "false alarms where nothing moves", ("motion",), _STILL, _STILL, _STILL[:1], Still(), pixels.still_measures
    ),
    "location": MetricGroup(
        "targets that were located",
        ("location",),
        ("located", "belongs"),
        ("located", "belongs", "n_targets", "n_told", "n_strays"),
        ("located",),
        LocatedCounts(),
        metres.located_measures,
    ),
    METRES: MetricGroup(
        "errors on the ground",
        ("location",),
        ("median_m", "p95_m", "in_ellipse", "relative_median_m", "relative_p95_m", "relative_in_ellipse"),
        (
            *("median_m", "mean_m", "rms_m", "p95_m", "in_ellipse", "relative_median_m", "relative_mean_m"),
            *("relative_rms_m", "relative_p95_m", "relative_in_ellipse"),
        ),
        ("median_m", "in_ellipse", "relative_median_m", "relative_in_ellipse"),
    ),
}
"""The order is that of metrics.json, of tables and of reports."""

HEADLINES: Mapping[str, tuple[tuple[str, str], ...]] = {
    "motion": (("pixels", "f"), ("boxes", "f1"), ("target", "hit"), ("still", "false_blobs_per_frame")),
    "tracking": (("tracks", "hota"), ("target_track", "same_identity")),
    "association": (("tracks", "hota"), ("tracks", "idf1")),
    "people": ((RANKED, "ap"), ("boxes", "f1")),
    "location": ((METRES, "median_m"), ("location", "located")),
}
"""The group and measure that sum up a task; the first that a clip has is used."""

_WITH_WORST = ("f", "f1", "idf1")


def describe(name: str) -> Metric:
    """Return the description of a measure; a title made from its name if it is not in METRICS."""
    if name in METRICS:
        return METRICS[name]
    if name.startswith("n_"):
        return Metric(name.removeprefix("n_").replace("_", " "), "how many", 0, 0, False)
    return Metric(name.replace("_", " "), better=0)


def is_lower_better(name: str) -> bool:
    """Return whether smaller values of a measure are better; False if unknown."""
    return describe(name).better < 0


def title_of_group(group: str) -> str:
    """Return the title of a group; its name for an unknown group."""
    return GROUPS[group].title if group in GROUPS else group


def groups_of_task(task: str) -> tuple[str, ...]:
    """Return the groups of measures that a task can have. The truth of a clip decides which of them it has."""
    return tuple(name for name, group in GROUPS.items() if task in group.tasks)


def measure_names(group: str) -> tuple[str, ...]:
    """Return the measures of a group, and its counts of which smaller values are better."""
    counts = GROUPS[group].counts
    names = GROUPS[group].shown if counts is None else figures({group: counts})[group]
    return tuple(name for name in names if not name.startswith("n_") or is_lower_better(name))


def measure(group: str, counts: Any) -> dict[str, float]:
    """Return the measures of a group's counts."""
    measures = GROUPS[group].measures
    assert measures is not None
    return measures(counts)


def figures(counts: Counts) -> dict[str, dict[str, float]]:
    """Return the measures of each group, and the counts that they come from as n_NAME."""
    groups: dict[str, dict[str, float]] = {}
    for group, value in counts.items():
        by_name: dict[str, int] = value.by_name() if isinstance(value, TrackCounts) else value._asdict()
        groups[group] = {**measure(group, value), **{f"n_{k}": v for k, v in by_name.items()}}
    return groups


def pooled(clips: Sequence[Counts]) -> Counts:
    """Return the counts of all clips together, in their order."""
    whole: Counts = {}
    for counts in clips:
        for group, value in counts.items():
            whole[group] = add_counts(whole[group], value) if group in whole else value
    return whole


def mean(clips: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Return the mean of each measure over the clips that have it, and the worst value of F, F1 and IDF1."""
    means: dict[str, dict[str, float]] = {}
    for group in GROUPS:
        having = [clip[group] for clip in clips if group in clip]
        for name in having[0] if having else ():
            values = [v for clip in having if not math.isnan(v := clip[name])]
            if name.startswith("n_") or not values:
                continue
            means.setdefault(group, {})[name] = float(np.mean(values))
            if name in _WITH_WORST:
                means[group][f"worst_{name}"] = min(values)
    return means
