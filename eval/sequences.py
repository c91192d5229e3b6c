"""Sequences with true identities for studies of tuned trackers, and IDF1 by hard decisions."""

from collections.abc import Sequence
from pathlib import Path

from torchvision_dddas.config import Settings
from torchvision_dddas.evaluation.datasets.kinds import read
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.scoring import score
from torchvision_dddas.evaluation.studies.spec import Source, Task
from torchvision_dddas.evaluation.studies.stages import find
from torchvision_dddas.evaluation.studies.summary import measures


def identified(data: Path, kinds: Sequence[str]) -> list[Clip]:
    """Those of a folder with true identities of several targets, each name once, of the kind that is named first."""
    found: dict[str, Clip] = {}
    for kind in kinds:
        for clip in read(Source(kind, data), data).clips:
            if clip.truth is not None and clip.truth.tracks is not None:
                found.setdefault(clip.name, clip)
    return list(found.values())


def idf1(clip: Clip, task: Task, settings: Settings, interval: int) -> float:
    """Of the tracker as it runs."""
    found = find(clip, task, settings, "onboard", interval)
    return float(measures([score(clip, task, found, interval)])["tracks"]["idf1"])
