"""Affinities of the source's association: how many links of two frames they get wrong.

Examples are stretches of a clip, some windows each, of its true boxes as the task `association` takes them: with
histograms where the clip has pictures, by location alone where it has none, as `targets.paper` does it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from torchvision_dddas.config import PaperParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.evaluation.studies.record import Task
from torchvision_dddas.tracking.dispersion import dissimilarity, joined_at, speaking
from torchvision_dddas.tracking.gating import alternatives
from torchvision_dddas.tracking.source_tracker import Look, affinity
from torchvision_dddas.tuning.clip_boxes import boxed
from torchvision_dddas.tuning.family import Example, Tick
from torchvision_dddas.tuning.soft_affinities import Windows, unlikeliness, wrong_links

WINDOWS = 10
"""Windows of an example."""

SOFTNESS: Mapping[str, tuple[float, float]] = {"wrong": (0.1, 0.02), "likelihood": (0.05, 0.05)}
"""Of affinities, by loss, at the first and the last step.

wrong: the targets that are expected to be linked wrongly. likelihood: of the true links; it follows those that no
parameter can save, the more so the colder it is.
"""


@dataclass(frozen=True)
class Stretch:
    """Windows in the order of their frames, each the fields of `Windows` without its first axis; and the settings."""

    windows: Sequence[Mapping[str, np.ndarray]]
    settings: Settings


@dataclass(frozen=True)
class Affinities:
    """The family `paper`. interval: frames between looks."""

    interval: int = 1
    name: str = "paper"
    task: Task = "association"
    measure: str = "association.tracks.idf1"
    losses: tuple[str, ...] = tuple(SOFTNESS)
    loss_name: str = "wrong"

    @property
    def softness(self) -> tuple[float, float]:
        """Of the loss that is taken."""
        return SOFTNESS[self.loss_name]

    def by(self, loss_name: str) -> "Affinities":
        """The same with one of its losses; see `family.Choosing`."""
        return replace(self, loss_name=loss_name)

    def at(self, interval_frames: int, task: Task) -> "Affinities":
        """The same for a study's interval; see `family.Timed`."""
        return replace(self, interval=interval_frames)

    def check(self, names: Sequence[str], settings: Settings) -> None:
        """Raises InputError for parameters that these settings never ask, and settings that have no loss here."""
        paper = settings.paper
        idle = {
            "dispersion": ("paper.weight",),
            "fixed": ("paper.lowest_dispersion", "paper.location_cut", "paper.appearance_cut"),
        }[paper.rule]
        other = "fixed" if paper.rule == "dispersion" else "dispersion"
        if settings.track.mode != "paper":
            raise InputError(f"{', '.join(names)}: no say under track.mode={settings.track.mode}; use --config paper")
        if mine := [name for name in names if name in idle]:
            raise InputError(
                f"{', '.join(mine)}: no say under paper.rule={paper.rule}; add --set paper.rule={other}, or leave out"
            )
        if paper.gate == "off" and "paper.threshold" in names:
            raise InputError("paper.threshold: no say under paper.gate=off; add --set paper.gate=one_dummy")
        if paper.window != 2:
            raise InputError(
                f"paper.window={paper.window}: only windows of two frames can be learned from; add --set paper.window=2"
            )
        if paper.gated != "features":
            raise InputError(f"paper.gated={paper.gated}: its gate cannot be softened; add --set paper.gated=features")

    def examples(self, clips: Sequence[Clip], settings: Settings, tick: Tick = lambda: None) -> list[Example]:
        """Stretches of the clips' true boxes. See `family.Family`."""
        found = []
        for clip in clips:
            if clip.truth is None or clip.truth.tracks is None or not len(clip.truth.tracks.frame):
                raise InputError(f"{clip.name} has no true identities, which tuning the tracker needs; leave it out")
            windows = list(_windows(clip, clip.truth.tracks.every(self.interval), settings.paper, self.interval))
            for start in range(0, len(windows), WINDOWS):
                piece = windows[start : start + WINDOWS]
                frame = piece[0][0]
                found.append(Example(clip.name, frame, Stretch([window for _, window in piece], settings)))
                tick()
        return found

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """(B,) of a box of the newer frames: the share of wrong ones, or nats. See `family.Family`."""
        settings: Settings = batch[0].content.settings
        tuned = {name.removeprefix("paper."): value for name, value in parameters.items()}
        paper = PaperParameters.model_construct(**(dict(settings.paper) | tuned))
        device = next(iter(parameters.values())).device
        windows = together([window for example in batch for window in example.content.windows], device)
        lost = (wrong_links if self.loss_name == "wrong" else unlikeliness)(paper, windows, softness)
        owner = np.repeat(np.arange(len(batch)), [len(example.content.windows) for example in batch])
        of = torch.as_tensor(owner, device=device)
        total, boxes = (lost.new_zeros(len(batch)).index_add(0, of, part) for part in (lost, _boxes(windows, lost)))
        return total / boxes.clamp(min=1)


def family() -> Affinities:
    """What `family.family_of` calls."""
    return Affinities()


def together(windows: Sequence[Mapping[str, np.ndarray]], device: torch.device | str = "cpu") -> Windows:
    """Windows as one batch: those with fewer targets are filled up with nobody."""
    parts = {}
    for field in fields(Windows):
        rows = [window[field.name] for window in windows]
        shape = np.max([row.shape for row in rows], axis=0).astype(int).tolist() if rows[0].ndim else []
        stacked = np.zeros((len(rows), *shape), rows[0].dtype)
        for place, row in zip(stacked, rows, strict=True) if shape else ():
            place[tuple(slice(size) for size in row.shape)] = row
        parts[field.name] = torch.as_tensor(stacked if shape else np.stack(rows), device=device)
    return Windows(**cast(Any, parts))


def _boxes(windows: Windows, like: Tensor) -> Tensor:
    return windows.now.sum(1).to(like)


def _windows(
    clip: Clip, table: TrackTable, parameters: PaperParameters, interval: int
) -> Iterator[tuple[int, Mapping[str, np.ndarray]]]:
    """The newer frame's number and what is known of it and the one before."""
    before: tuple[np.ndarray, Look] | None = None
    for number, identity, look in _looks(clip, table, interval):
        if before is not None:
            yield number, window_of((look, before[1]), (identity, before[0]), parameters)
        before = identity, look


def window_of(
    looks: tuple[Look, Look], identities: tuple[np.ndarray, np.ndarray], parameters: PaperParameters
) -> dict[str, np.ndarray]:
    """One of `Windows`, without its first axis. looks, identities: newer frame first."""
    counts = [len(look) for look in looks]
    pictured = all(look.has_picture or not len(look) for look in looks)
    features = [[look.centre_px for look in looks]]
    features += [[look.histogram(parameters.histogram) for look in looks]] if pictured else features
    similarity = np.stack([affinity(pair, parameters) for pair in features])
    joined, there = np.zeros((2, 2, max(counts), max(counts))), np.zeros((2, max(counts)), bool)
    for frame, count in enumerate(counts):
        there[frame, :count] = True
        for place, pair in enumerate(features):
            joined[place, frame, :count, :count] = joined_at(dissimilarity(pair[frame]))
    return {
        "similarity": similarity,
        "alternative": np.stack([alternatives(score, parameters.gate) for score in similarity]),
        "now": np.ones(counts[0], bool),
        "before": np.ones(counts[1], bool),
        "true": identities[0][:, None] == identities[1][None],
        "joined_at": joined,
        "there": there,
        "speaks": np.arange(2) < speaking(counts, parameters),
        "pictured": np.array(pictured),
    }


def _looks(clip: Clip, table: TrackTable, interval: int) -> Iterator[tuple[int, np.ndarray, Look]]:
    """Number, identities and look of each frame from the first to the last with boxes."""
    from torchvision_dddas.tracking.histograms import rgb_histograms

    for number, identity, box_px, image in boxed(clip, table, interval):
        counted = None if image is None else rgb_histograms(image, box_px)
        yield number, identity, Look(box_px, None if counted is None else lambda counted=counted: counted)  # type: ignore[misc]
