"""What flows through a study: what is asked, what was found in a clip, and what became of each case."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.evaluation.datasets.record import Clip

if TYPE_CHECKING:
    from torchvision_dddas.evaluation.studies.scored import Scored

Task = Literal["motion", "tracking", "association", "people", "location"]

TASKS: Mapping[Task, str] = {
    "motion": "what moves in the clip's pictures, against masks, boxes or one target; in a still clip all is false",
    "tracking": "identities of what was found, or of the data set's own detections, against true tracks",
    "association": "identities of the true boxes, at each interval-th frame, against the true identities",
    "people": "persons in each picture, against true boxes",
    "location": "places on the ground, in metres, against the true ones",
}


@dataclass(frozen=True)
class Source:
    """A data set of a study. clips: patterns of names (fnmatch); options: what its kind takes beside, by name."""

    kind: str
    folder: Path
    clips: tuple[str, ...] = ("*",)
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Spec:
    """A study, as its TOML file says.

    tasks: empty for all that each clip allows. config, overrides: as --config and --set.
    """

    name: str
    sources: tuple[Source, ...]
    tasks: tuple[Task, ...] = ()
    config: str | None = None
    overrides: tuple[str, ...] = ()
    backend: str = "auto"
    interval: int = 1


@dataclass(frozen=True)
class Found:
    """What was found in a clip, a row a box, ordered by frame.

    frame: (N,) int64 from 1. box_px: (N, 4) float64 x, y, width, height. score: (N,) in [0, 1]. identity: (N,) int64,
    -1 where none. east_north_m: (N, 2), covariance_m2: (N, 2, 2), NaN where not located. looked: (L,) int64, the frames
    that were looked at. masks: PNG bytes of frames whose truth is a mask, nonzero is foreground. steps: by frame, the
    (3, 3) homography from the frame before it that was read, of reliable ones. more: further columns (N, ...) that a
    later stage needs, by name; of location lonlat_deg (N, 2) and relative_m2 (N, 2, 2), the covariance relative to the
    team, where they are known. seconds: by stage, over the clip. peak_mb: the most that the process held.
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
class Case:
    """A task on a clip, and what became of it. cause: in one line, why there is no result; empty where there is one."""

    clip: Clip
    task: Task
    found: Found | None = None
    scored: "Scored | None" = None
    cause: str = ""


@dataclass(frozen=True)
class Results:
    """A study that was run. left_out: in words, clips and tasks without a case. facts: versions, back end, terms."""

    spec: Spec
    settings: Settings
    cases: tuple[Case, ...]
    left_out: tuple[str, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)
