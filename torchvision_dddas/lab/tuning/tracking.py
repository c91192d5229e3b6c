"""The family of tracking: the negative log-likelihood of the true links under the association scores."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.config import Settings, TrackParameters
from torchvision_dddas.detection import load_engine
from torchvision_dddas.errors import InputError
from torchvision_dddas.functional import log_partition
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.studies.records import Task
from torchvision_dddas.lab.evaluation.studies.stages import open_clip
from torchvision_dddas.lab.tuning.examples import OwnedBoxes, boxed_frames, match_owners, stack_padded, true_tracks
from torchvision_dddas.lab.tuning.family import Example, Family
from torchvision_dddas.lab.tuning.parameters import with_tensors
from torchvision_dddas.tracking import CameraMotion, kalman
from torchvision_dddas.tracking.appearance import (
    appearance_scores,
    blend_histograms,
    similarity,
    strip_histograms,
    visible_shares,
)
from torchvision_dddas.tracking.kalman import transform_boxes
from torchvision_dddas.tracking.scene import SceneState, SceneStatistics
from torchvision_dddas.tracking.score_tracker import is_remembered
from torchvision_dddas.tracking.scores import BoxLook, association_scores, is_near_border, newborn_scores
from torchvision_dddas.tracking.smoother import FILLED
from torchvision_dddas.types import DetectionTable

FRAMES = 25
"""Frames of a stretch: at an interval of 5 they cover the tracker's memory of 125 frames."""

MISSED = 4.0
"""Margin of a true link by detections. By likelihood alone, the best gate is so narrow that true links are lost to
avoid false alarms, and after each broken link the track counts as another target. Chosen from 0, 2, 4 and 6 by IDF1 on
MOT15 sequences that were held out; not each was tried with all margins of wrong links, pulls and parameters."""

# Rounds of messages for each frame. More rounds change the loss by less than a hundredth in a crowd.
_ROUNDS = 10


@dataclass(frozen=True)
class TrackingFamily(Family):
    """The family `tracking`. interval: frames between examples. missed: margin, as `link_nll` takes it."""

    interval: int = 1
    name: str = "tracking"
    task: Task = "association"
    measure: str = "association.tracks.idf1"
    softness: tuple[float, float] = (1.0, 1.0)
    """The likelihood needs softness 1. Below it, the loss asks only for the best assignment and ignores all others."""
    missed: float = 0.0

    def at(self, interval_frames: int, task: Task) -> "TrackingFamily":
        """Return this family for a task. Association tracks the true boxes; tracking tracks detections."""
        if task != "tracking":
            return replace(self, interval=interval_frames)
        measure = self.measure.replace("association", task)
        return replace(self, interval=interval_frames, task=task, measure=measure, missed=MISSED)

    def check(self, names: Sequence[str], settings: Settings) -> None:
        """See `Family.check`."""
        if settings.track.mode != "default":
            mine = f"{', '.join(names)}: no effect under track.mode={settings.track.mode}"
            raise InputError(f"{mine}; add --set track.mode=default")

    def clip_examples(self, clip: Clip, settings: Settings) -> Iterator[tuple[int, Mapping[str, np.ndarray]]]:
        """Yield stretches of the clip's true tracks, as rows of `Stretches`. The last may be short, with two frames."""
        frames = list(_tracked_frames(clip, self._boxes(clip, settings), settings, self.interval))
        for start in range(0, len(frames), FRAMES):
            piece = frames[start : start + FRAMES]
            if len(piece) > 1:
                yield piece[0]["frame"], _stack_frames(piece)

    def _boxes(self, clip: Clip, settings: Settings) -> OwnedBoxes:
        """Return the boxes to track. Raise InputError if detections are wanted and the clip has none."""
        table = true_tracks(clip, self.interval)
        if self.task == "association":
            certain = np.ones(len(table.frame))
            box_px = np.asarray(table.box_px, float)
            extent = DetectionTable("", table.frame, box_px, certain, np.arange(len(certain))).extent
            return OwnedBoxes(table, certain, certain > 0, extent)
        if clip.given is None:
            raise InputError(
                f"{clip.name} has no public detections, which tuning for the task 'tracking' needs; leave it out, or "
                "tune for true boxes: --measure association.tracks.idf1"
            )
        assert clip.truth is not None
        found = match_owners(read_detections(clip.given), clip.truth, self.interval, settings.track)
        if not len(found.score):
            raise InputError(
                f"{clip.given} has no box that track.doubt = {settings.track.doubt:g} accepts on frames 1, "
                f"{1 + self.interval}, {1 + 2 * self.interval}, ...; raise track.doubt, or leave {clip.name} out"
            )
        return found

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """Return the nats per link at softness 1, (B,). See `Family.loss`."""
        track = with_tensors(batch[0].settings.track, "track", parameters)
        device = next(iter(parameters.values())).device
        stretches = stack_padded(Stretches, [example.content for example in batch], device, pad="edge")
        return link_nll(track, stretches, self.interval, softness, self.missed)


@dataclass(frozen=True)
class Stretches:
    """Stretches of T frames each, in which box n always belongs to target n; float64 and bool.

    time, step, density, missing, turnover: as in `SceneState`. size: width and height of the picture. box_px: x, y,
    width, height; any numbers if the target is absent. there: whether a target is seen. certain: whether its score is
    1. begins: whether its score allows a new track. motion: homographies from the previous frame. likeness: similarity
    of tracks (rows) and boxes, NaN if unknown. visible: visible shares of the boxes. own: whether the boxes are moving
    targets that `dddas detect` found.
    """

    time: Float[Tensor, "B T"]
    step: Float[Tensor, "B T"]
    density: Float[Tensor, "B T"]
    missing: Float[Tensor, "B T"]
    turnover: Float[Tensor, "B T"]
    size: Float[Tensor, "B 2"]
    box_px: Float[Tensor, "B T N 4"]
    there: Bool[Tensor, "B T N"]
    certain: Bool[Tensor, "B T N"]
    begins: Bool[Tensor, "B T N"]
    motion: Float[Tensor, "B T 3 3"]
    likeness: Float[Tensor, "B T N N"]
    visible: Float[Tensor, "B T N"]
    own: Bool[Tensor, "B"]


_OF_BOXES = ("box_px", "there", "certain", "begins", "visible")
_LEARNED = ("time", "step", "density", "missing", "turnover")


def _tracked_frames(clip: Clip, boxes: OwnedBoxes, settings: Settings, interval: int) -> Iterator[dict[str, Any]]:
    """Yield the boxes of each frame, and the scene statistics of a tracker that has followed all targets until then."""
    size = open_clip(clip).size if clip.pictures else boxes.size
    scene, camera = SceneStatistics(size), CameraMotion(load_engine("onboard", settings))
    before: tuple[float, np.ndarray] | None = None
    seen: dict[int, float] = {}  # time at which each target with a track was last seen
    for number, identity, box_px, image in boxed_frames(clip, boxes.table, interval):
        motion = signature = None
        if image is not None:
            motion, _ = camera.update(image)
            signature = strip_histograms(image, box_px) if settings.track.appearance != "never" else None
        rows, time = boxes.table.frame == number, number / interval
        begins = boxes.begins[rows]
        gap, last = (1.0, None) if before is None else (time - before[0], before[1])
        scene.add_look(last if last is None or motion is None else transform_boxes(last, motion), box_px, gap)
        yield {
            **vars(scene.state(time)),
            "frame": number,
            "identity": identity,
            "box_px": box_px,
            "certain": boxes.score[rows] >= 1,
            "begins": begins,
            "there": True,
            "visible": visible_shares(box_px),
            "motion": np.eye(3) if motion is None else motion,
            "signature": signature,
            "size": size or (1e6, 1e6),  # unknown: no border on the right and below
            "own": boxes.own,
        }
        followed = np.array([who in seen for who in identity.tolist()], bool)
        missed = np.array([round(time - seen[who]) - 1 for who in identity[followed].tolist()])
        births = (begins & ~followed & ~is_near_border(box_px, size)).sum() if before is not None else 0
        scene.add_links(missed, int(births))
        seen |= dict.fromkeys(identity[begins | followed].tolist(), time)
        before = time, box_px


def _stack_frames(frames: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Return the fields of `Stretches`."""
    names = np.unique(np.concatenate([frame["identity"] for frame in frames]))
    shape = (len(frames), len(names))
    found = {name: np.zeros(shape, bool) for name in _OF_BOXES} | {"box_px": np.ones((*shape, 4))}
    found |= {"visible": np.ones(shape), "likeness": np.full((*shape, len(names)), np.nan)}
    signature, hits = None, np.zeros(len(names), np.int64)
    for t, frame in enumerate(frames):
        here, seen = np.searchsorted(names, frame["identity"]), frame["signature"]
        for name in _OF_BOXES:
            found[name][t, here] = frame[name]
        if seen is not None and len(here):
            if signature is None:
                signature = np.zeros((len(names), seen.shape[1]))
            found["likeness"][t][:, here] = similarity(signature, seen)
            hits[here] += 1
            signature[here] = blend_histograms(signature[here], seen, frame["visible"], hits[here])
    found |= {name: np.stack([np.asarray(frame[name], float) for frame in frames]) for name in (*_LEARNED, "motion")}
    return found | {"size": np.asarray(frames[0]["size"], float), "own": np.asarray(frames[0]["own"])}


@dataclass
class _Tracks:
    """The state of all targets. alive: whether it has a track. sure: whether it is not a false alarm.

    All fields are tensors. The tracker's formulas accept tensors, although they are annotated for arrays.
    """

    state: Any
    alive: Any
    hits: Any
    sure: Any


def link_nll(
    parameters: TrackParameters, stretches: Stretches, interval: int, softness: float, missed: float = 0.0
) -> Float[Tensor, "B"]:
    """Return the negative log-likelihood of the true links, (B,), per box that could be linked; in nats at softness 1.

    parameters: numbers or tensors. interval: frames between looks. softness: temperature of the assignment, above 0.
    missed: margin, in the unit of scores. For each true link that an assignment lacks, its score must be lower than the
    true one by this margin. Links that already have the margin cost almost nothing, so that the doubtful links count.
    Source: Gimpel and Smith, 2010 (softmax-margin); as softness vanishes it becomes the structured hinge.
    Unlike in the tracker, neighbours do not predict the motion of a target with a single detection.
    """
    mine = _with_own(parameters, stretches.own)
    # The tracker's formulas are annotated for arrays, but accept tensors.
    data: Any = stretches
    has_motion = not bool(torch.equal(data.motion, torch.eye(3).to(data.motion).expand_as(data.motion)))
    has_likeness = not bool(data.likeness.isnan().all())
    size = (data.size[:, :1], data.size[:, 1:])
    no = torch.zeros_like(data.there[:, 0])
    tracks: _Tracks | None = None
    scores: list[Tensor] = []
    true_sum, boxes = (data.time.new_zeros(len(data.time)) for _ in range(2))
    for t in range(data.time.shape[1]):
        box, there = data.box_px[:, t], data.there[:, t]
        scene = SceneState(**{name: getattr(data, name)[:, t, None] for name in _LEARNED}, size=size)
        begun: Any = kalman.start(box, scene.time, mine.scatter, scene.step, mine.size_scatter)
        if tracks is None:
            tracks = _Tracks(begun, no, no.long(), no)
        elif has_motion:
            tracks.state = kalman.transform(tracks.state, data.motion[:, t])
        if tracks.alive.any():
            score = _link_scores(tracks, box, scene, mine)
            if has_likeness:
                score = score + appearance_scores(data.likeness[:, t], data.visible[:, t], parameters)
            score = score - missed * torch.eye(score.shape[-1]).to(score)
            scores.append(score.masked_fill(~(tracks.alive[:, :, None] & there[:, None]), -torch.inf))
            true = tracks.alive & there
            true_sum = true_sum + torch.where(true, score.diagonal(dim1=1, dim2=2), 0.0).sum(1)
            boxes = boxes + torch.where(tracks.alive.any(1), there.sum(1), 0)
        tracks = _update_tracks(tracks, begun, data, t, scene, interval, mine)
    if not scores:
        return true_sum
    possible = _drop_empty_rows(_drop_empty_rows(torch.stack(scores, 1)).transpose(-1, -2))
    return (log_partition(possible, softness, rounds=_ROUNDS).sum(1) - true_sum) / boxes.clamp(min=1)


def _link_scores(tracks: _Tracks, box_px: Any, scene: SceneState, parameters: TrackParameters) -> Any:
    """Return the scores of tracks and boxes, (B, N, N), without appearance."""
    look = BoxLook.of(tracks.state, _looks_since(tracks.state, scene) - 1, box_px, scene, parameters)
    at_rest: Any = torch.zeros_like(tracks.state[None, ..., :2])
    scores: Any = newborn_scores(look, parameters, at_rest), association_scores(look, parameters)
    return torch.where((tracks.hits == 1)[..., None], *scores)


def _looks_since(state: Any, scene: SceneState) -> Any:
    """Return the number of looks since each target was seen, (B, N)."""
    return (scene.time - state[..., kalman.SEEN].detach()).round()


def _drop_empty_rows(score: Float[Tensor, "B T N M"]) -> Float[Tensor, "B T K M"]:
    """Drop rows in which no pair is possible, as far as every frame has some. Most targets are absent from a frame."""
    possible = score.detach().isfinite().any(-1)
    first = possible.to(torch.int8).argsort(-1, descending=True)[..., : max(int(possible.sum(-1).max()), 1)]
    return torch.take_along_dim(score, first[..., None], -2)


def _update_tracks(
    tracks: _Tracks, begun: Any, data: Any, t: int, scene: SceneState, interval: int, parameters: TrackParameters
) -> _Tracks:
    """Return the tracks after a frame, each linked to its own box: `ScoreTracker._commit` on the true links."""
    box, there, certain = data.box_px[:, t], data.there[:, t], data.certain[:, t]
    linked = there & tracks.alive
    new = there & ~tracks.alive & data.begins[:, t]
    predicted: Any = kalman.predict(tracks.state, scene.time, parameters.wander * scene.step)
    is_cut: Any = is_near_border(box, scene.size)
    updated: Any = kalman.update(predicted, box, scene.time, parameters.scatter, parameters.size_scatter, is_cut)
    state = torch.where(linked[..., None], updated, torch.where(new[..., None], begun, tracks.state))
    hits = torch.where(new, 1, tracks.hits + linked.long())
    sure = (tracks.sure & ~new) | ((linked | new) & certain) | (hits >= parameters.hits)
    looks = _looks_since(state, scene)
    last: Any = state.detach()
    kept: Any = is_remembered(last, scene.time, looks, interval, scene.size, parameters)
    return _Tracks(state, (tracks.alive | new) & kept & (sure | (looks <= FILLED + 1)), hits, sure)


def _with_own(parameters: TrackParameters, own: Bool[Tensor, "B"]) -> TrackParameters:
    """Return the parameters with scatter as (B, 1), chosen by whether a stretch's boxes are own targets."""
    chosen = {}
    for name in ("scatter", "size_scatter"):
        pair = (getattr(parameters, key) for key in (f"own_{name}", name))
        other, usual = (torch.as_tensor(value, dtype=torch.float64, device=own.device) for value in pair)
        chosen[name] = torch.where(own[:, None], other, usual)
    return TrackParameters.model_construct(**{**dict(parameters), **chosen})
