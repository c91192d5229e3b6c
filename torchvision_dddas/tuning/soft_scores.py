"""How likely the true links are, by the tracker's own scores: a loss with a gradient in the tracker's parameters.

Targets are followed by who they truly are, look after look, each with the states that the tracker would have; at every
look the scores of all links are the tracker's (`targets.links`), and the odds of all assignments follow from them
(`ops.relax.assignment`). What is lost is the logarithm of the true assignment's probability, a link at a time.

Left out: the tracker's view of the next look (K = 3), and that it looks at pictures only in doubt.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.config import TrackParameters
from torchvision_dddas.functional.soft.assignment import log_partition
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.appearance_score import scores_of
from torchvision_dddas.tracking.scores import Sight, link_scores, near_border
from torchvision_dddas.tracking.smoother import FILLED
from torchvision_dddas.tracking.speed_prior import speed_of
from torchvision_dddas.tracking.track_memory import remembered

# Of messages a look; more change the loss by less than a hundredth where targets crowd.
_ROUNDS = 10


@dataclass(frozen=True)
class Looks:
    """Stretches of clips, T looks each, in which box n is always target n; float64 but for what is yes or no.

    frame: numbers. interval: usual distance of the looks. size: width and height of the picture. usual, known: of the
    pace. births, doubt: as `Sight` has them. box_px: x, y, width, height, any where none is there. there: whether a
    target is seen. certain: with the score 1. begins: with a score that may begin a track. step: homographies from the
    look before. likeness: of tracks (rows) and boxes, NaN where unknown. visible: shares of the boxes. own: whether the
    boxes are of moving targets that were found in the clip.
    """

    frame: Float[Tensor, "B T"]
    interval: Float[Tensor, "B"]
    size: Float[Tensor, "B 2"]
    usual: Float[Tensor, "B T"]
    known: Float[Tensor, "B T"]
    births: Float[Tensor, "B T"]
    doubt: Float[Tensor, "B T"]
    box_px: Float[Tensor, "B T N 4"]
    there: Bool[Tensor, "B T N"]
    certain: Bool[Tensor, "B T N"]
    begins: Bool[Tensor, "B T N"]
    step: Float[Tensor, "B T 3 3"]
    likeness: Float[Tensor, "B T N N"]
    visible: Float[Tensor, "B T N"]
    own: Bool[Tensor, "B"]


@dataclass
class _Tracks:
    """Of all targets; alive: who has a track. sure: who is no false alarm. left: last seen at the border.

    Tensors, which the tracker's formulas take though they are annotated for arrays.
    """

    state: Any
    alive: Any
    hits: Any
    sure: Any
    left: Any


def unlikeliness(
    parameters: TrackParameters, looks: Looks, softness: float, missed: float = 0.0, wrong: float = 0.0
) -> Float[Tensor, "B"]:
    """What the true links lack in likelihood, per box that a link was possible to; at softness 1 in nats.

    parameters: numbers or tensors. softness: temperature of the assignment, above 0. missed, wrong: margins, in the
    unit of scores: by so much for each true link that it lacks, and for each other link that it has, an assignment is
    to be worse than the true one. What is that much better already costs next to nothing, so that what is in doubt
    counts. Source of the margins: Gimpel and Smith, 2010 (softmax-margin); softness to 0 makes it the structured hinge.
    """
    mine = _for_each(parameters, looks.own)
    size: Any = (looks.size[:, :1], looks.size[:, 1:])
    moves = not bool(torch.equal(looks.step, torch.eye(3).to(looks.step).expand_as(looks.step)))
    interval: Any = looks.interval[:, None]
    likeness: Any = looks.likeness
    visible: Any = looks.visible
    compares = not bool(looks.likeness.isnan().all())
    tracks: _Tracks | None = None
    scores, told, boxes = [], looks.frame.new_zeros(len(looks.frame)), looks.frame.new_zeros(len(looks.frame))
    for look in range(looks.frame.shape[1]):
        frame: Any = looks.frame[:, look, None]
        box: Any = looks.box_px[:, look]
        there = looks.there[:, look]
        usual: Any = looks.usual[:, look, None]
        known: Any = looks.known[:, look, None]
        doubt: Any = looks.doubt[:, look, None]
        births: Any = looks.births[:, look, None, None]
        speed = speed_of(parameters.speed, usual, known)
        sight = Sight(frame, interval, speed, births, doubt, size)
        begun: Any = kalman.started(box, frame, mine.scatter, speed, mine.size_scatter)
        if tracks is None:
            no = torch.zeros_like(there)
            tracks = _Tracks(begun, no, torch.zeros_like(there, dtype=torch.int64), no, no)
        elif moves:
            step: Any = looks.step[:, look]
            tracks.state = kalman.carried(tracks.state, step)
        if tracks.alive.any():
            score: Any = link_scores(tracks.state, tracks.left, box, sight, mine)
            if compares:
                score = score + scores_of(likeness[:, look], visible[:, look], parameters)
            true = tracks.alive & there
            margin = wrong - (wrong + missed) * torch.eye(score.shape[-1]).to(score)
            rival = score + margin
            scores.append(rival.masked_fill(~(tracks.alive[:, :, None] & there[:, None]), -torch.inf))
            told = told + torch.where(true, score.diagonal(dim1=1, dim2=2) - missed, 0.0).sum(1)
            boxes = boxes + torch.where(tracks.alive.any(1), there.sum(1), 0)
        tracks = _after(tracks, begun, looks, look, sight, mine)
    if not scores:
        return told
    free = _dense(_dense(torch.stack(scores, 1)).transpose(-1, -2))
    return (log_partition(free, softness, _ROUNDS).sum(1) - told) / boxes.clamp(min=1)


def _dense(score: Float[Tensor, "B T N M"]) -> Float[Tensor, "B T K M"]:
    """Without rows in which no pair is possible, as far as every look has some: most targets are not there."""
    possible = score.detach().isfinite().any(-1)
    first = possible.to(torch.int8).argsort(-1, descending=True)[..., : max(int(possible.sum(-1).max()), 1)]
    return torch.take_along_dim(score, first[..., None], -2)


def _after(tracks: _Tracks, begun: Any, looks: Looks, look: int, sight: Sight, parameters: TrackParameters) -> _Tracks:
    """The tracks after a look, each with its own box: `Tracker._commit` on what is true."""
    box: Any = looks.box_px[:, look]
    there, certain = looks.there[:, look], looks.certain[:, look]
    on = there & tracks.alive
    later: Any = kalman.predicted(tracks.state, sight.frame, sight.agility(parameters))
    seen: Any = kalman.updated(later, box, sight.frame, parameters.scatter, parameters.size_scatter)
    new = there & ~tracks.alive & looks.begins[:, look]
    state = torch.where(on[..., None], seen, torch.where(new[..., None], begun, tracks.state))
    hits = torch.where(new, 1, tracks.hits + on.long())
    sure = (tracks.sure & ~new) | ((on | new) & certain) | (hits >= parameters.hits)
    held: Any = state.detach()
    kept: Any = remembered(held, sight.frame, sight.interval, sight.size, parameters)
    late = sight.frame - state[..., kalman.SEEN] > (FILLED + 1) * sight.interval
    at_border: Any = near_border(box, sight.size)
    left = torch.where(on | new, at_border, tracks.left)
    return _Tracks(state, (tracks.alive | new) & kept & (sure | ~late), hits, sure, left)


def _for_each(parameters: TrackParameters, own: Bool[Tensor, "B"]) -> TrackParameters:
    """With the scatter and births of own targets where the boxes are such: (B, 1), and (B, 1, 1) of births."""

    def picked(name: str) -> Tensor:
        pair = (getattr(parameters, key) for key in (f"own_{name}", name))
        other, usual = (torch.as_tensor(value, dtype=torch.float64, device=own.device) for value in pair)
        return torch.where(own[:, None], other, usual)

    each = {"scatter": picked("scatter"), "size_scatter": picked("size_scatter"), "births": picked("births")[..., None]}
    return TrackParameters.model_construct(**(dict(parameters) | each))
