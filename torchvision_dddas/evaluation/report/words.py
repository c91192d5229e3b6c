"""What tasks, groups and measures are called on the page, what they mean, and which stand first."""

from typing import NamedTuple

TITLES = {
    "motion": "Motion",
    "tracking": "Tracking",
    "association": "Association",
    "people": "People",
    "location": "Location",
}

GROUPS = {
    "pixels": "pixels",
    "boxes": "boxes, IoU ≥ 0.5",
    "target": "one labelled target",
    "tracks": "tracks",
    "target_track": "the labelled target's track, IoU ≥ 0.3",
    "still": "false alarms where nothing moves",
    "ranking": "boxes ranked by score",
    "location": "targets that were located",
    "metres": "errors on the ground",
}


class Measure(NamedTuple):
    """A measure's name and meaning; better: 1 where more is, -1 where less is, 0 where neither; digits: decimals."""

    name: str
    meaning: str = ""
    better: int = 1
    digits: int = 3
    share: bool = True


MEASURES = {
    "f": Measure("F", "harmonic mean of precision and recall, of pixels"),
    "f1": Measure("F1", "harmonic mean of precision and recall"),
    "precision": Measure("precision", "share of what was found that is true"),
    "recall": Measure("recall", "share of what is true that was found"),
    "specificity": Measure("specificity", "share of the background that was left alone"),
    "accuracy": Measure("accuracy", "share of all that was judged rightly"),
    "gmean": Measure("Gmean", "geometric mean of recall and specificity"),
    "ap": Measure("AP", "average precision: area below precision over recall"),
    "log_average_miss_rate": Measure("LAMR", "log-average miss rate, 0.01 to 1 false positives an image", -1),
    "miss_rate_at_0.1": Measure("missed at 0.1", "share missed at 0.1 false positives an image", -1),
    "miss_rate_at_1": Measure("missed at 1", "share missed at 1 false positive an image", -1),
    "hit": Measure("hit", "share of frames in which the target is hit"),
    "iou_0.3": Measure("IoU ≥ 0.3", "share of frames in which a box meets the target at IoU 0.3"),
    "other_blobs_per_frame": Measure("other blobs", "boxes elsewhere, a frame", 0, 2, False),
    "hota": Measure("HOTA", "detection and association weighed evenly, over all IoUs"),
    "deta": Measure("DetA", "detection accuracy of HOTA"),
    "assa": Measure("AssA", "association accuracy of HOTA"),
    "mota": Measure("MOTA", "1 less misses, false boxes and switches, for each true box"),
    "motp": Measure("MOTP", "mean IoU of the boxes found"),
    "idf1": Measure("IDF1", "share of boxes that carry the right identity"),
    "ar_2": Measure("AR₂", "accuracy ratio of links over two looks"),
    "ar_3": Measure("AR₃", "accuracy ratio of links over three looks"),
    "mostly_tracked": Measure("mostly tracked", "share of targets found in over 80 % of their frames"),
    "mostly_lost": Measure("mostly lost", "share of targets found in under 20 % of their frames", -1),
    "found": Measure("found", "share of frames in which the target has a box"),
    "same_identity": Measure("same identity", "share of frames in which the target has the identity it has most"),
    "n_switches": Measure("switches", "changes of identity", -1, 0, False),
    "n_fragmentations": Measure("fragments", "interruptions of a track", -1, 0, False),
    "false_blobs_per_frame": Measure("false blobs", "a frame", -1, 2, False),
    "alarmed": Measure("alarmed", "share of frames with any false blob", -1),
    "located": Measure("located", "share of the true places that were told"),
    "belongs": Measure("belongs", "share of the told places that are somebody's"),
    "mean_m": Measure("mean, m", "mean error on the Earth, metres", -1, 2, False),
    "median_m": Measure("median, m", "median error on the Earth, metres", -1, 2, False),
    "p95_m": Measure("95 %, m", "error that 95 % of the places stay below, metres", -1, 2, False),
    "rms_m": Measure("RMS, m", "root mean square of the errors, metres", -1, 2, False),
    "in_ellipse": Measure("in ellipse", "share of the places whose 95 % ellipse holds the true one", 0),
    "relative_mean_m": Measure("team mean, m", "mean error relative to the team, metres", -1, 2, False),
    "relative_median_m": Measure("team median, m", "median error relative to the team, metres", -1, 2, False),
    "relative_p95_m": Measure("team 95 %, m", "error relative to the team that 95 % stay below, metres", -1, 2, False),
    "relative_rms_m": Measure("team RMS, m", "root mean square of the errors relative to the team", -1, 2, False),
    "relative_in_ellipse": Measure("team in ellipse", "share whose ellipse relative to the team holds the place", 0),
}

SHOWN = {
    "pixels": ("f", "precision", "recall", "specificity", "accuracy", "gmean"),
    "boxes": ("f1", "precision", "recall"),
    "ranking": ("ap", "log_average_miss_rate", "miss_rate_at_0.1", "miss_rate_at_1"),
    "still": ("false_blobs_per_frame", "alarmed"),
    "location": ("located", "belongs", "n_targets", "n_told", "n_strays"),
    "metres": (
        *("median_m", "mean_m", "rms_m", "p95_m", "in_ellipse", "relative_median_m", "relative_mean_m"),
        *("relative_rms_m", "relative_p95_m", "relative_in_ellipse"),
    ),
    "target": ("hit", "iou_0.3", "other_blobs_per_frame"),
    "tracks": ("hota", "idf1", "mota", "deta", "assa", "recall", "precision", "n_switches", "ar_2", "ar_3"),
    "target_track": ("found", "same_identity", "n_switches", "n_fragmentations"),
}
"""The measures of a group's table in order; the others are in metrics.json. A group that is not here shows all."""

HEADLINES = {
    "motion": (("pixels", "f"), ("boxes", "f1"), ("target", "hit"), ("still", "false_blobs_per_frame")),
    "tracking": (("tracks", "hota"), ("target_track", "same_identity")),
    "association": (("tracks", "ar_3"), ("tracks", "idf1")),
    "people": (("ranking", "ap"), ("boxes", "f1")),
    "location": (("metres", "median_m"), ("location", "located")),
}
"""What a task is judged by at a glance, the first that there is."""


def measure(name: str) -> Measure:
    """What is known of a measure; its name alone where that is all."""
    if name in MEASURES:
        return MEASURES[name]
    if name.endswith("_m"):
        return Measure(name.removesuffix("_m").replace("_", " ") + ", m", "metres", -1, 2, False)
    if name.startswith("n_"):
        return Measure(name.removeprefix("n_").replace("_", " "), "how many", 0, 0, False)
    return Measure(name.replace("_", " "), "", 0)
