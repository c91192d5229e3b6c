"""The family of the source's association: expected wrong links of two frames."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.config import PaperParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.evaluation.studies.spec import Task
from torchvision_dddas.functional.assignment import dispersion, log_partition
from torchvision_dddas.functional.soft import step
from torchvision_dddas.tracking.source_affinity import (
    best_alternatives,
    blend_gate,
    dissimilarity,
    frames_considered,
    joined_at,
    pair_gain_over_alone,
)
from torchvision_dddas.tracking.source_tracker import Features, affinity
from torchvision_dddas.tuning.examples import boxed
from torchvision_dddas.tuning.family import Example, Tick

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


@dataclass(frozen=True)
class Windows:
    """W windows of two frames, the newer one's targets (N) as rows, the older one's (M) as columns; float64.

    similarity, alternative: with a dummy first on both axes, as `targets.paper.affinity` and
    `targets.gating.alternatives` have them, of both features. now, before: who is there. true: the true links.
    joined_at: of each two targets of the newer and the older frame, P places each, as `targets.dispersion` has it.
    there: who is. speaks: which of the frames has a say in the dispersion. pictured: whether appearance is known.
    """

    similarity: Float[Tensor, "W 2 N1 M1"]
    alternative: Float[Tensor, "W 2 N1 M1"]
    now: Bool[Tensor, "W N"]
    before: Bool[Tensor, "W M"]
    true: Bool[Tensor, "W N M"]
    joined_at: Float[Tensor, "W 2 2 P P"]
    there: Bool[Tensor, "W 2 P"]
    speaks: Bool[Tensor, "W 2"]
    pictured: Bool[Tensor, "W"]


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
    before: tuple[np.ndarray, Features] | None = None
    for number, identity, look in _looks(clip, table, interval):
        if before is not None:
            yield number, window_of((look, before[1]), (identity, before[0]), parameters)
        before = identity, look


def window_of(
    looks: tuple[Features, Features], identities: tuple[np.ndarray, np.ndarray], parameters: PaperParameters
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
        "alternative": np.stack([best_alternatives(score, parameters.gate) for score in similarity]),
        "now": np.ones(counts[0], bool),
        "before": np.ones(counts[1], bool),
        "true": identities[0][:, None] == identities[1][None],
        "joined_at": joined,
        "there": there,
        "speaks": np.arange(2) < frames_considered(counts, parameters),
        "pictured": np.array(pictured),
    }


def _looks(clip: Clip, table: TrackTable, interval: int) -> Iterator[tuple[int, np.ndarray, Features]]:
    """Number, identities and look of each frame from the first to the last with boxes."""
    from torchvision_dddas.tracking.appearance import rgb_histograms

    for number, identity, box_px, image in boxed(clip, table, interval):
        counted = None if image is None else rgb_histograms(image, box_px)
        yield number, identity, Features(box_px, None if counted is None else lambda counted=counted: counted)  # type: ignore[misc]


# Of messages; more change the loss by less than a hundredth where targets crowd.
_ROUNDS = 10

LOCATION, APPEARANCE = 0, 1
"""Places of the two features on their axis."""


def unlikeliness(parameters: PaperParameters, windows: Windows, softness: float) -> Float[Tensor, "W"]:
    """Minus the logarithm of the true links' probability: nats a window.

    parameters: numbers or tensors; `gated` must be features. softness: above 0, of an affinity: by how much an
    assignment is worse that is e times less likely, and the width of the gate's threshold and of the rule's.
    """
    score = _possible(link_gains(parameters, windows, softness), windows)
    told = torch.where(windows.true, score, 0.0).sum((1, 2))
    return (log_partition(score, softness, _ROUNDS) - told) / softness


def wrong_links(parameters: PaperParameters, windows: Windows, softness: float) -> Float[Tensor, "W"]:
    """How many targets of the newer frame are expected to be linked wrongly, or not though they were there before.

    As softness vanishes it is how many the best assignment links wrongly. What is expected of a sum over links is the
    slope of the log-partition along it, taken here as a difference over one softness: between the slopes at its ends,
    so that a link that no parameter can save counts once and no more. parameters, softness: as in `unlikeliness`.
    """
    score = _possible(link_gains(parameters, windows, softness), windows)
    known = windows.true.any(2, keepdim=True)
    # Beside one wrong for each who was there before: a true link is one less, any of a newcomer one more.
    more = torch.where(windows.true, -1.0, torch.where(known, 0.0, 1.0)).to(score)
    with_more, plain = (log_partition(each, softness, _ROUNDS) for each in (score + softness * more, score))
    return known.sum((1, 2)) + (with_more - plain) / softness


def _possible(score: Float[Tensor, "W N M"], windows: Windows) -> Float[Tensor, "W N M"]:
    return score.masked_fill(~(windows.now[:, :, None] & windows.before[:, None]), -torch.inf)


def link_gains(parameters: PaperParameters, windows: Windows, softness: float = 0.0) -> Float[Tensor, "W N M"]:
    """What each link is worth above leaving both targets with nobody; any number where one is not there."""
    weight = location_weight(parameters, windows, softness)
    share = torch.stack([weight, 1 - weight], 1)[:, :, None, None]
    how_far = step(1 - parameters.threshold - windows.alternative, softness).to(windows.similarity)
    gain: Tensor = pair_gain_over_alone((share * blend_gate(windows.similarity, how_far, parameters.threshold)).sum(1))
    return gain


def location_weight(parameters: PaperParameters, windows: Windows, softness: float = 0.0) -> Float[Tensor, "W"]:
    """The weight of location: that of `targets.dispersion.location_weight` as softness vanishes, or the fixed one."""
    if parameters.rule == "fixed":
        fixed = torch.as_tensor(parameters.weight).to(windows.similarity)
        return torch.where(windows.pictured, fixed, 1.0)
    by_location, by_appearance = (
        step(_of_window(windows, feature, cut, softness) - parameters.lowest_dispersion, softness)
        for feature, cut in ((LOCATION, parameters.location_cut), (APPEARANCE, parameters.appearance_cut))
    )
    return torch.where(windows.pictured, by_location + (1 - by_location) * (1 - by_appearance) / 2, 1.0)


def _of_window(windows: Windows, feature: int, cut: float | Tensor, softness: float) -> Float[Tensor, "W"]:
    """The smallest dispersion of the frames that have a say."""
    of_frames = dispersion(windows.joined_at[:, feature], windows.there, cut, softness)
    return of_frames.masked_fill(~windows.speaks, torch.inf).amin(1)
