"""The family of tracking: how unlikely the true links are by the association scores."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchvision_dddas.config import Settings, TrackParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.evaluation.metrics.truth import Truth
from torchvision_dddas.evaluation.studies.spec import Task
from torchvision_dddas.functional.assignment import log_partition
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.appearance import appearance_scores, blend_histograms, similarity, visible_shares
from torchvision_dddas.tracking.kalman import transform_boxes
from torchvision_dddas.tracking.scores import (
    SceneState,
    SpeedPrior,
    association_scores,
    birth_rate,
    blend_speed,
    is_near_border,
    is_remembered,
)
from torchvision_dddas.tracking.smoother import FILLED
from torchvision_dddas.tuning.examples import Owned, boxed, owned
from torchvision_dddas.tuning.family import Example, Tick
from torchvision_dddas.types import DetectionTable

LOOKS = 25
"""Looks of a stretch: with the memory of 125 frames all that counts at an interval of 5."""

MISSED = 4.0
"""Margin of a true link by detections. A likelihood alone would rather link nothing than a false alarm, and closes the
gate; of a track that breaks, all that follows counts as another target. Of 0, 2, 4 and 6, not each with all margins of
wrong links, pulls and sets of parameters, the best by IDF1 of MOT15 sequences held out: chosen by them, that is."""


@dataclass(frozen=True)
class Stretch:
    """One of `modules.links.Looks`, without its first axis, and the settings that hold for what is not tuned."""

    looks: Mapping[str, np.ndarray]
    settings: Settings


@dataclass(frozen=True)
class Identities:
    """The family `tracking`. interval: frames between looks."""

    interval: int = 1
    name: str = "tracking"
    task: Task = "association"
    measure: str = "association.tracks.idf1"
    softness: tuple[float, float] = (1.0, 1.0)
    """A likelihood is one at softness 1 alone: colder, it asks for the best assignment whatever the others are."""
    missed: float = 0.0
    """Margin for each true link that an assignment lacks, in the unit of scores; of detections, MISSED."""
    wrong: float = 0.0
    """The same for each link that it has and the truth has not."""

    def at(self, interval_frames: int, task: Task) -> "Identities":
        """The same for a study's interval, and for the boxes that its task follows; see `family.Timed`."""
        if task != "tracking":
            return replace(self, interval=interval_frames)
        measure = self.measure.replace("association", task)
        return replace(self, interval=interval_frames, task=task, measure=measure, missed=MISSED)

    def check(self, names: Sequence[str], settings: Settings) -> None:
        """Raises InputError where these settings associate by another rule. See `family.Particular`."""
        if settings.track.mode != "default":
            mine = f"{', '.join(names)}: no say under track.mode={settings.track.mode}"
            raise InputError(f"{mine}; add --set track.mode=default, or tune paper.threshold and its like")

    def examples(self, clips: Sequence[Clip], settings: Settings, tick: Tick = lambda: None) -> list[Example]:
        """Stretches of the clips' true tracks, by true boxes or by detections. See `family.Family`."""
        found = []
        for clip in clips:
            if clip.truth is None or clip.truth.tracks is None or not len(clip.truth.tracks.frame):
                raise InputError(f"{clip.name} has no true identities, which tuning the tracker needs; leave it out")
            for stretch in _stretches(clip, self._boxes(clip, clip.truth, settings), settings, self.interval):
                found.append(Example(clip.name, int(stretch.looks["frame"][0]), stretch))
                tick()
        return found

    def _boxes(self, clip: Clip, truth: Truth, settings: Settings) -> Owned:
        """Whose boxes are followed. Raises InputError where detections are wanted and the clip has none."""
        assert truth.tracks is not None, "asked for where there is truth"
        if self.task == "association":
            table = truth.tracks.every(self.interval)
            return Owned(table, np.ones(len(table.frame)), _extent(table))
        if clip.given is None:
            raise InputError(
                f"{clip.name} has no public detections, which tuning for the task 'tracking' needs; leave it out, or "
                "tune for true boxes: --measure association.tracks.idf1"
            )
        found = owned(read_detections(clip.given), truth, self.interval, settings.track.min_score)
        if not len(found.score):
            raise InputError(
                f"{clip.given} has no box of score {settings.track.min_score:g} or more on frames 1, "
                f"{1 + self.interval}, {1 + 2 * self.interval}, ...; lower track.min_score, or leave {clip.name} out"
            )
        return found

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """(B,) nats a link, at softness 1. See `family.Family`."""
        settings: Settings = batch[0].content.settings
        tuned = {name.removeprefix("track."): value for name, value in parameters.items() if name.startswith("track.")}
        track = TrackParameters.model_construct(**(dict(settings.track) | tuned))
        device = next(iter(parameters.values())).device
        return unlikeliness(
            track, together([example.content for example in batch], device), softness, self.missed, self.wrong
        )


def family() -> Identities:
    """What `family.family_of` calls."""
    return Identities()


@dataclass(frozen=True)
class Looks:
    """Stretches of clips, T looks each, in which box n is always target n; float64 but for what is yes or no.

    frame: numbers. interval: usual distance of the looks. size: width and height of the picture. usual, known: of the
    speed prior. births, doubt: as in SceneState. box_px: x, y, width, height, any where none is there. there: whether a
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


def together(stretches: Sequence[Stretch], device: torch.device | str = "cpu") -> Looks:
    """Stretches as one batch: those with fewer looks or targets are filled up with looks at which nobody is."""
    shapes = [stretch.looks["there"].shape for stretch in stretches]
    most = {"T": max(shape[0] for shape in shapes), "N": max(shape[1] for shape in shapes)}
    parts: dict[str, Any] = {}
    for field in fields(Looks):
        axes = cast(Any, field.type).dim_str.split()[1:]
        rows = []
        for stretch in stretches:
            value = stretch.looks[field.name]
            rows.append(_filled(value, [most.get(axis, size) for axis, size in zip(axes, value.shape, strict=True)]))
        parts[field.name] = torch.as_tensor(np.stack(rows), device=device)
    return Looks(**parts)


def _filled(value: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """Repeated at its ends up to a shape; what is not there is so on, as only numbers are repeated."""
    wider = [(0, size - had) for size, had in zip(shape, value.shape, strict=True)]
    if not value.ndim:
        return value
    if value.dtype == bool or not value.size:
        return np.pad(value, wider, constant_values=False if value.dtype == bool else 1.0)
    return np.pad(value, wider, mode="edge")


def _stretches(clip: Clip, boxes: Owned, settings: Settings, interval: int) -> Iterator[Stretch]:
    """The clip in pieces of LOOKS looks, the last one maybe shorter; none of a single look."""
    looks = list(_looks(clip, boxes, settings, interval))
    for start in range(0, len(looks), LOOKS):
        piece = looks[start : start + LOOKS]
        if len(piece) > 1:
            yield Stretch(_stacked(piece, settings.track.birth_score), settings)


@dataclass
class _Look:
    """One look at the boxes, and what the tracker knows by then."""

    frame: int
    identity: np.ndarray
    box_px: np.ndarray
    score: np.ndarray
    step: np.ndarray | None
    signature: np.ndarray | None
    fixed: dict[str, Any]


def _looks(clip: Clip, boxes: Owned, settings: Settings, interval: int) -> Iterator[_Look]:
    pace, before = SpeedPrior(settings.track.speed), None
    size = _size(clip, boxes)
    seen, doubtful, births, known = 0, 0, 0, set[int]()
    for number, identity, box_px, step, signature in _shown(clip, boxes.table, settings, interval):
        score = boxes.score[boxes.table.frame == number]
        if before is not None:
            pace.add(before if step is None else transform_boxes(before, step), box_px, interval)
        seen += len(box_px)
        doubtful += int((score < 1).sum())
        doubt = doubtful / max(seen, 1)
        fixed = {
            "interval": float(interval),
            "size": np.array(size, float),
            "usual": pace.usual,
            "known": float(pace.known),
            "births": birth_rate(births, seen, doubt, interval),
            "doubt": doubt,
            "own": boxes.own,
        }
        yield _Look(number, identity, box_px, score, step, signature, fixed)
        begun = (score >= settings.track.birth_score) & ~np.isin(identity, list(known))
        births += int((begun & ~is_near_border(box_px, size)).sum()) if before is not None else 0
        known |= set(identity[begun].tolist())
        before = box_px


def _size(clip: Clip, boxes: Owned) -> tuple[float, float]:
    from torchvision_dddas.evaluation.studies.stages import open_clip

    if clip.pictures:
        width, height = open_clip(clip).size
        return float(width), float(height)
    return boxes.size if boxes.size is not None else (1e6, 1e6)


def _extent(table: TrackTable) -> tuple[float, float] | None:
    ones = np.ones(len(table.frame))
    return DetectionTable("", table.frame, np.asarray(table.box_px, float), ones, np.arange(len(ones))).extent


def _shown(
    clip: Clip, table: TrackTable, settings: Settings, interval: int
) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]]:
    """Number, identities, boxes, camera's motion and histograms of each look from the first to the last with boxes."""
    from torchvision_dddas.detection import load_engine
    from torchvision_dddas.tracking import CameraMotion
    from torchvision_dddas.tracking.appearance import strip_histograms

    camera, looks_matter = CameraMotion(load_engine("onboard", settings)), settings.track.appearance != "never"
    for number, identity, box_px, image in boxed(clip, table, interval):
        if image is None:
            yield number, identity, box_px, None, None
            continue
        step, _ = camera.update(image)
        yield number, identity, box_px, step, strip_histograms(image, box_px) if looks_matter else None


def _stacked(looks: Sequence[_Look], birth_score: float) -> dict[str, np.ndarray]:
    """The fields of `Looks`, box n always target n. birth_score: of a box that may begin a track."""
    names = np.unique(np.concatenate([look.identity for look in looks]))
    shape = (len(looks), len(names))
    box_px, visible, score = np.ones((*shape, 4)), np.ones(shape), np.full(shape, -1.0)
    alike = np.full((*shape, len(names)), np.nan)
    signature, hits = None, np.zeros(len(names), np.int64)
    for t, look in enumerate(looks):
        here = np.searchsorted(names, look.identity)
        box_px[t, here], score[t, here] = look.box_px, look.score
        visible[t, here] = visible_shares(look.box_px)
        if look.signature is not None and len(here):
            if signature is None:
                signature = np.zeros((len(names), look.signature.shape[1]))
            alike[t][:, here] = similarity(signature, look.signature)
            hits[here] += 1
            signature[here] = blend_histograms(signature[here], look.signature, visible[t, here], hits[here])
    fixed = {key: np.stack([np.asarray(look.fixed[key]) for look in looks]) for key in looks[0].fixed}
    once = {key: fixed.pop(key)[0] for key in ("interval", "size", "own")}
    return {
        **fixed,
        **once,
        "frame": np.array([look.frame for look in looks], float),
        "box_px": box_px,
        "there": score >= 0,
        "certain": score >= 1,
        "begins": (score >= 0) & (score >= birth_score),
        "step": np.stack([np.eye(3) if look.step is None else look.step for look in looks]),
        "likeness": alike,
        "visible": visible,
    }


# Of messages a look; more change the loss by less than a hundredth where targets crowd.
_ROUNDS = 10


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
        speed = blend_speed(parameters.speed, usual, known)
        sight = SceneState(frame, interval, speed, births, doubt, size)
        begun: Any = kalman.start(box, frame, mine.scatter, speed, mine.size_scatter)
        if tracks is None:
            no = torch.zeros_like(there)
            tracks = _Tracks(begun, no, torch.zeros_like(there, dtype=torch.int64), no, no)
        elif moves:
            step: Any = looks.step[:, look]
            tracks.state = kalman.transform(tracks.state, step)
        if tracks.alive.any():
            score: Any = association_scores(tracks.state, tracks.left, box, sight, mine)
            if compares:
                score = score + appearance_scores(likeness[:, look], visible[:, look], parameters)
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


def _after(
    tracks: _Tracks, begun: Any, looks: Looks, look: int, sight: SceneState, parameters: TrackParameters
) -> _Tracks:
    """The tracks after a look, each with its own box: `Tracker._commit` on what is true."""
    box: Any = looks.box_px[:, look]
    there, certain = looks.there[:, look], looks.certain[:, look]
    on = there & tracks.alive
    later: Any = kalman.predict(tracks.state, sight.frame, sight.agility(parameters))
    seen: Any = kalman.update(later, box, sight.frame, parameters.scatter, parameters.size_scatter)
    new = there & ~tracks.alive & looks.begins[:, look]
    state = torch.where(on[..., None], seen, torch.where(new[..., None], begun, tracks.state))
    hits = torch.where(new, 1, tracks.hits + on.long())
    sure = (tracks.sure & ~new) | ((on | new) & certain) | (hits >= parameters.hits)
    held: Any = state.detach()
    kept: Any = is_remembered(held, sight.frame, sight.interval, sight.size, parameters)
    late = sight.frame - state[..., kalman.SEEN] > (FILLED + 1) * sight.interval
    at_border: Any = is_near_border(box, sight.size)
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
