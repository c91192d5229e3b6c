"""The family of the source's association: expected wrong links of two frames."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.config import PaperParameters, Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.records import Task
from torchvision_dddas.functional import dispersion, log_partition, step
from torchvision_dddas.tracking.source_tracker import (
    Features,
    affinity,
    best_alternatives,
    blend_gate,
    frames_considered,
    histogram_cut,
    joined_at,
    pair_gain_over_alone,
    rgb_histograms,
    scale_histograms,
)
from torchvision_dddas.tuning.examples import boxed_frames, stack_padded, true_tracks
from torchvision_dddas.tuning.family import Example, Family
from torchvision_dddas.tuning.parameters import with_tensors

WINDOWS = 10
"""Windows of an example."""

SOFTNESS: Mapping[str, tuple[float, float]] = {"wrong": (0.1, 0.02), "likelihood": (0.05, 0.05)}
"""Of affinities, by loss, at the first and the last step.

wrong: the expected number of wrongly linked targets. likelihood: of the true links; links that no parameter can save
dominate it, the more so the lower the softness.
"""

# Rounds of messages; more change the loss by less than a hundredth in a crowd.
_ROUNDS = 10


@dataclass(frozen=True)
class SourceFamily(Family):
    """The family `paper`: the source's association. interval: frames between the two frames of a window."""

    interval: int = 1
    name: str = "paper"
    task: Task = "association"
    measure: str = "association.tracks.idf1"
    losses: tuple[str, ...] = tuple(SOFTNESS)
    loss_name: str = "wrong"

    @property
    def softness(self) -> tuple[float, float]:  # type: ignore[override]
        """That of the chosen loss."""
        return SOFTNESS[self.loss_name]

    def at(self, interval_frames: int, task: Task) -> "SourceFamily":
        """See `Family.at`."""
        return replace(self, interval=interval_frames)

    def check(self, names: Sequence[str], settings: Settings) -> None:
        """Raises InputError for parameters without effect under these settings, and settings that have no loss."""
        paper = settings.paper
        if settings.track.mode != "paper":
            mode = settings.track.mode
            raise InputError(f"{', '.join(names)}: no effect under track.mode={mode}; use --config paper")
        idle, other = {
            "dispersion": ("weight", "fixed"),
            "fixed": ("lowest_dispersion location_cut appearance_cut", "dispersion"),
        }[paper.rule]
        if mine := [name for name in names if name.removeprefix("paper.") in idle.split()]:
            raise InputError(
                f"{', '.join(mine)}: no effect under paper.rule={paper.rule}; add --set paper.rule={other} or leave out"
            )
        if paper.gate == "off" and "paper.threshold" in names:
            raise InputError("paper.threshold: no effect under paper.gate=off; add --set paper.gate=one_dummy")
        if paper.window != 2:
            raise InputError(
                f"paper.window={paper.window}: only windows of two frames can be tuned; add --set paper.window=2"
            )
        if paper.gated != "features":
            raise InputError(f"paper.gated={paper.gated}: its gate cannot be softened; add --set paper.gated=features")

    def clip_examples(self, clip: Clip, settings: Settings) -> Iterator[tuple[int, Sequence[Mapping[str, np.ndarray]]]]:
        """Stretches of windows of the clip's true boxes, each window a row of `Windows`."""
        windows: list[tuple[int, Mapping[str, np.ndarray]]] = []
        before: tuple[Features, np.ndarray] | None = None
        for number, identity, box_px, image in boxed_frames(clip, true_tracks(clip, self.interval), self.interval):
            histograms = None if image is None else rgb_histograms(image, box_px)
            now = Features(box_px, None if histograms is None else lambda held=histograms: held), identity  # type: ignore[misc]
            if before is not None:
                windows.append((number, build_window((now[0], before[0]), (now[1], before[1]), settings.paper)))
            before = now
        for start in range(0, len(windows), WINDOWS):
            numbers, rows = zip(*windows[start : start + WINDOWS], strict=True)
            yield numbers[0], rows

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """(B,) per box of the newer frames: the share of wrong links, or nats. See `Family.loss`."""
        paper = with_tensors(batch[0].settings.paper, "paper", parameters)
        device = next(iter(parameters.values())).device
        windows = stack_padded(Windows, [window for example in batch for window in example.content], device)
        loss = (wrong_links if self.loss_name == "wrong" else links_nll)(paper, windows, softness)
        owner = np.repeat(np.arange(len(batch)), [len(example.content) for example in batch])
        row, boxes = torch.as_tensor(owner, device=device), windows.now.sum(1).to(loss)
        total, count = (loss.new_zeros(len(batch)).index_add(0, row, part) for part in (loss, boxes))
        return total / count.clamp(min=1)


@dataclass(frozen=True)
class Windows:
    """W windows of two frames: targets of the newer one (N) as rows, of the older one (M) as columns; float64 and bool.

    similarity, alternative: of both features, location first, with a dummy first on both axes, as
    `source_tracker.affinity` and `source_tracker.best_alternatives` return them. now, before: whether a target is
    there. true: the true links. joined_at: of each two of P targets of the newer and of the older frame, as
    `source_tracker.joined_at` returns it; there: whether a target is there. speaks: whether a frame counts in the
    dispersion. pictured: whether its appearance is known.
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


def build_window(
    features: Sequence[Features], identities: Sequence[np.ndarray], parameters: PaperParameters
) -> dict[str, np.ndarray]:
    """The fields of one row of `Windows`. features, identities: of both frames, the newer one first."""
    counts = [len(frame) for frame in features]
    pictured = all(frame.has_picture or not len(frame) for frame in features)
    values = [[frame.centre_px for frame in features]]
    values += [[frame.histogram(parameters.histogram) for frame in features]] if pictured else values
    by_location, by_appearance = (affinity(pair, parameters) for pair in values)
    similarity = np.stack([by_location, scale_histograms(by_appearance, parameters.histogram_scale)])
    joined, there = np.zeros((2, 2, max(counts), max(counts))), np.zeros((2, max(counts)), bool)
    for frame, count in enumerate(counts):
        there[frame, :count] = True
        for place, pair in enumerate(values):
            joined[place, frame, :count, :count] = joined_at(pair[frame])
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


def links_nll(parameters: PaperParameters, windows: Windows, softness: float) -> Float[Tensor, "W"]:
    """Negative log-likelihood of the true links, in nats a window.

    parameters: numbers or tensors; `gated` must be features. softness: above 0, in the unit of affinities: an
    assignment worse by this is e times less likely; also the width of the soft thresholds of gate and rule.
    """
    score = _possible_gains(parameters, windows, softness)
    true = torch.where(windows.true, score, 0.0).sum((1, 2))
    return (log_partition(score, softness, _ROUNDS) - true) / softness


def wrong_links(parameters: PaperParameters, windows: Windows, softness: float) -> Float[Tensor, "W"]:
    """Expected number of targets of the newer frame that are linked wrongly, or not although they were there before.

    As softness vanishes it tends to the number that the best assignment links wrongly. The expectation of a sum over
    links is the slope of the log-partition along it. It is taken as a difference over one softness, so that a link that
    no parameter can save counts once at most. parameters, softness: as in `links_nll`.
    """
    score = _possible_gains(parameters, windows, softness)
    known = windows.true.any(2, keepdim=True)
    # One wrong for each who was there before; a true link is one less, any link of a newcomer one more.
    more = torch.where(windows.true, -1.0, torch.where(known, 0.0, 1.0)).to(score)
    with_more, plain = (log_partition(each, softness, _ROUNDS) for each in (score + softness * more, score))
    return known.sum((1, 2)) + (with_more - plain) / softness


def _possible_gains(parameters: PaperParameters, windows: Windows, softness: float) -> Float[Tensor, "W N M"]:
    gain = link_gains(parameters, windows, softness)
    return gain.masked_fill(~(windows.now[:, :, None] & windows.before[:, None]), -torch.inf)


def link_gains(parameters: PaperParameters, windows: Windows, softness: float = 0.0) -> Float[Tensor, "W N M"]:
    """The gain of each link over leaving both targets alone; undefined where a target is not there."""
    weight = location_weight(parameters, windows, softness)
    share = torch.stack([weight, 1 - weight], 1)[:, :, None, None]
    gate = step(1 - parameters.threshold - windows.alternative, softness).to(windows.similarity)
    gain: Tensor = pair_gain_over_alone((share * blend_gate(windows.similarity, gate, parameters.threshold)).sum(1))
    return gain


def location_weight(parameters: PaperParameters, windows: Windows, softness: float = 0.0) -> Float[Tensor, "W"]:
    """The weight of location: tends to that of the hard association as softness vanishes, or is the fixed one."""
    if parameters.rule == "fixed":
        fixed = torch.as_tensor(parameters.weight).to(windows.similarity)
        return torch.where(windows.pictured, fixed, 1.0)
    by_feature = []
    for feature, cut in enumerate((parameters.location_cut, histogram_cut(parameters))):
        # The smallest dispersion of the frames that count.
        of_frames = dispersion(windows.joined_at[:, feature], windows.there, cut, softness)
        smallest = of_frames.masked_fill(~windows.speaks, torch.inf).amin(1)
        by_feature.append(step(smallest - parameters.lowest_dispersion, softness))
    by_location, by_appearance = by_feature
    return torch.where(windows.pictured, by_location + (1 - by_location) * (1 - by_appearance) / 2, 1.0)
