"""The records of a study: its request, the findings in its clips, and their scores."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings
    from torchvision_dddas.lab.evaluation.datasets.record import Clip, DatasetSource
    from torchvision_dddas.lab.evaluation.metrics.registry import Counts

Task = Literal["motion", "tracking", "association", "people", "location"]

TASKS: Mapping[Task, str] = {
    "motion": "moving targets in the pictures, against masks, boxes or one target; in a still clip all are false",
    "tracking": "identities of detected targets, or of the data set's own detections, against true tracks",
    "association": "identities of the true boxes, at each interval-th frame, against the true identities",
    "people": "persons in each picture, against true boxes",
    "location": "places on the ground, in metres, against the true ones",
}


@dataclass(frozen=True)
class Spec:
    """A study. tasks: if empty, all tasks that each clip allows. config, overrides: as --config and --set."""

    name: str
    sources: "tuple[DatasetSource, ...]"
    tasks: tuple[Task, ...] = ()
    config: str | None = None
    overrides: tuple[str, ...] = ()
    backend: str = "auto"
    interval: int = 1


@dataclass(frozen=True)
class Findings:
    """The findings in a clip: one row per box, ordered by frame.

    frame: (N,) int64 from 1.
    box_px: (N, 4) float64 x, y, width, height.
    score: (N,) in [0, 1].
    identity: (N,) int64, -1 for none.
    east_north_m, covariance_m2: (N, 2) and (N, 2, 2), NaN if not located.
    looked: (L,) int64, the frames that were processed.
    masks: PNG bytes by frame, if the truth is a mask; nonzero is foreground.
    steps: by frame, the (3, 3) homography from the previous frame that was read, if reliable.
    more: further columns (N, ...) that a later stage needs, by name. The location task has lonlat_deg (N, 2) and
    relative_m2 (N, 2, 2), the covariance relative to the landmarks, NaN if unknown.
    seconds: time by stage, over the clip. peak_mb: the largest memory of the process.
    """

    frame: np.ndarray
    box_px: np.ndarray
    score: np.ndarray
    identity: np.ndarray
    east_north_m: np.ndarray
    covariance_m2: np.ndarray
    looked: np.ndarray
    masks: Mapping[int, bytes] = field(default_factory=dict)
    steps: Mapping[int, np.ndarray] = field(default_factory=dict)
    more: Mapping[str, np.ndarray] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    peak_mb: float = float("nan")
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Scored:
    """The counts of one case, which add over frames and clips.

    frames: (F,) the scored frames.
    counts: over the clip, by group.
    per_frame: by group and count, (F,) float64 each; NaN in frames that the group does not use.
    ranked: by group, (M, 3) of each detection: score, whether it is right (1, 0; NaN: not judged), frame.
    samples: by name, (S,) each: frame, identity, error_m and other values of every located target.
    notes: lines about data that were left out.
    """

    frames: np.ndarray
    counts: "Counts"
    per_frame: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    ranked: Mapping[str, np.ndarray] = field(default_factory=dict)
    samples: Mapping[str, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Case:
    """A task on a clip, and its result. cause: one line on why there is no result; otherwise empty."""

    clip: "Clip"
    task: Task
    found: Findings | None = None
    scored: Scored | None = None
    cause: str = ""


@dataclass(frozen=True)
class Results:
    """A study that was run. left_out: clips and tasks without a case. facts: versions, engine, terms of use."""

    spec: Spec
    settings: "Settings"
    cases: tuple[Case, ...]
    left_out: tuple[str, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ScoredCase:
    """The data of a case that a study's folder keeps for comparison with another study."""

    task: str
    clip: str
    scored: Scored


@dataclass(frozen=True)
class ScoredStudy:
    """The cases of a study, ordered by task and clip name."""

    name: str
    cases: tuple[ScoredCase, ...]


def round_as_written(box_px: np.ndarray) -> np.ndarray:
    """Round (N, 4) boxes to a hundredth of a pixel as in tables, because scores must equal those of the files."""
    hundredths = box_px * 100
    written = np.round(hundredths) / 100
    # Round half a hundredth as the decimal text of the number is rounded. The product may round otherwise.
    for i, j in np.argwhere(np.abs(np.abs(hundredths - np.floor(hundredths)) - 0.5) < 1e-6):
        written[i, j] = float(f"{box_px[i, j]:.2f}")
    return written
