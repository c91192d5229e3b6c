"""How right what was found in a clip is: counts that add over clips, frame by frame, and what curves are drawn of."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.clip import Counts
from torchvision_dddas.evaluation.studies.stored import DamagedError, packed, unpacked
from torchvision_dddas.io.atomic_files import write_whole

SCORES = "scores.bin"
"""The file of a study's folder that holds its counts, frame by frame."""


@dataclass(frozen=True)
class Scored:
    """One case's counts, which add over frames and clips.

    frames: (F,) those scored. counts: by group, over the clip. per_frame: by group and count, (F,) float64 each, NaN in
    frames that the group has no use for; for spread, plots and the worst frames. ranked: by group, (M, 3) of each
    detection its score, whether it is right (1, 0) or does not count (NaN), and its frame. samples: by name, (S,) each,
    what is no count: frame, identity, error_m and such of every target that was located. notes: what was left out.
    """

    frames: np.ndarray
    counts: Counts
    per_frame: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    ranked: Mapping[str, np.ndarray] = field(default_factory=dict)
    samples: Mapping[str, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ScoredCase:
    """What a study keeps of a case, to be compared with that of another study."""

    task: str
    clip: str
    scored: Scored


@dataclass(frozen=True)
class ScoredStudy:
    """A study's cases, by task and name, as they lie in its folder."""

    name: str
    cases: tuple[ScoredCase, ...]


def write_scores(folder: Path, name: str, cases: Iterable[ScoredCase]) -> None:
    """Write a study's counts beside its figures, whole or not at all. Raises OSError."""
    ordered = tuple(sorted(cases, key=lambda case: (case.task, case.clip)))
    write_whole(folder / SCORES, packed(ScoredStudy(name, ordered)))


def read_scores(folder: Path) -> ScoredStudy:
    """Read them back. Raises InputError where the folder holds no study, or its file is damaged."""
    place = folder / SCORES
    try:
        study = unpacked(place.read_bytes())
    except FileNotFoundError:
        raise InputError(
            f"{folder} holds no study: no {SCORES}; wanted a folder that dddas evaluate --dataset wrote"
        ) from None
    except OSError as error:
        raise InputError(f"{place} cannot be read: {error.strerror}") from None
    except DamagedError as error:
        raise InputError(f"{place} is damaged or of another version ({error}); run the study again") from None
    if not isinstance(study, ScoredStudy):
        raise InputError(f"{place} holds no scores of a study; run the study again")
    return study
