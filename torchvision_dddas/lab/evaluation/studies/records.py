"""The records of a study: what it asks for, what it finds in its clips, and how right that is."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from torchvision_dddas.config import Settings
    from torchvision_dddas.lab.evaluation.datasets.record import Clip, Source
    from torchvision_dddas.lab.evaluation.metrics.registry import Counts

Task = Literal["motion", "tracking", "association", "people", "location"]

TASKS: Mapping[Task, str] = {
    "motion": "what moves in the clip's pictures, against masks, boxes or one target; in a still clip all is false",
    "tracking": "identities of what was found, or of the data set's own detections, against true tracks",
    "association": "identities of the true boxes, at each interval-th frame, against the true identities",
    "people": "persons in each picture, against true boxes",
    "location": "places on the ground, in metres, against the true ones",
}


@dataclass(frozen=True)
class Spec:
    """A study. tasks: empty for all that each clip allows. config, overrides: as --config and --set."""

    name: str
    sources: "tuple[Source, ...]"
    tasks: tuple[Task, ...] = ()
    config: str | None = None
    overrides: tuple[str, ...] = ()
    backend: str = "auto"
    interval: int = 1


@dataclass(frozen=True)
class Found:
    """What was found in a clip: one row per box, ordered by frame.

    frame: (N,) int64 from 1.
    box_px: (N, 4) float64 x, y, width, height.
    score: (N,) in [0, 1].
    identity: (N,) int64, -1 where there is none.
    east_north_m, covariance_m2: (N, 2) and (N, 2, 2), NaN where not located.
    looked: (L,) int64, the frames that were processed.
    masks: PNG bytes by frame, where the truth is a mask; nonzero is foreground.
    steps: by frame, the (3, 3) homography from the previous frame that was read; reliable ones only.
    more: further columns (N, ...) that a later stage needs, by name. The location task has lonlat_deg (N, 2) and
        relative_m2 (N, 2, 2), the covariance relative to the team, NaN where unknown.
    seconds: time by stage, over the clip. peak_mb: the most memory that the process held.
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
    samples: by name, (S,) each: frame, identity, error_m and the like of every located target.
    notes: what was left out.
    """

    frames: np.ndarray
    counts: "Counts"
    per_frame: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    ranked: Mapping[str, np.ndarray] = field(default_factory=dict)
    samples: Mapping[str, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Case:
    """A task on a clip, and its result. cause: one line on why there is no result, else empty."""

    clip: "Clip"
    task: Task
    found: Found | None = None
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
    """What a study's folder keeps of a case, for comparison with another study."""

    task: str
    clip: str
    scored: Scored


@dataclass(frozen=True)
class ScoredStudy:
    """A study's cases, ordered by task and clip name."""

    name: str
    cases: tuple[ScoredCase, ...]


def round_as_written(box_px: np.ndarray) -> np.ndarray:
    """Round (N, 4) boxes to a hundredth of a pixel, as tables have them: scores must be those of the files."""
    hundredths = box_px * 100
    written = np.round(hundredths) / 100
    # Half a hundredth is rounded as the decimal text of the number is, which may differ from the product's rounding.
    for i, j in np.argwhere(np.abs(np.abs(hundredths - np.floor(hundredths)) - 0.5) < 1e-6):
        written[i, j] = float(f"{box_px[i, j]:.2f}")
    return written
