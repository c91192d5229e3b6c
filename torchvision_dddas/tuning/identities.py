"""Identities: how unlikely the true links are by the scores that the tracker gives them.

Examples are stretches of a clip, some tens of looks each, prepared as `dddas track` would see them: the pace, the rate
of births and the likenesses are those of the looks so far, the camera's motion is registered. For the task
`association` they are the true boxes; for `tracking` the clip's public detections: who is missed has none, who is seen
has the box that was found, and a false alarm is a target of its own that is seen once, so that any link to it is wrong.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from torchvision_dddas.config import Settings, TrackParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.evaluation.metrics.truth import Truth
from torchvision_dddas.evaluation.studies.record import Task
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.tracking.appearance_score import blended, likeness, visible_share
from torchvision_dddas.tracking.kalman import carried_boxes
from torchvision_dddas.tracking.scores import births_of, near_border
from torchvision_dddas.tracking.speed_prior import Pace
from torchvision_dddas.tuning.clip_boxes import boxed
from torchvision_dddas.tuning.family import Example, Tick
from torchvision_dddas.tuning.matching import Owned, owned
from torchvision_dddas.tuning.soft_scores import Looks, unlikeliness
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
    pace, before = Pace(settings.track.speed), None
    size = _size(clip, boxes)
    seen, doubtful, births, known = 0, 0, 0, set[int]()
    for number, identity, box_px, step, signature in _shown(clip, boxes.table, settings, interval):
        score = boxes.score[boxes.table.frame == number]
        if before is not None:
            pace.add(before if step is None else carried_boxes(before, step), box_px, interval)
        seen += len(box_px)
        doubtful += int((score < 1).sum())
        doubt = doubtful / max(seen, 1)
        fixed = {
            "interval": float(interval),
            "size": np.array(size, float),
            "usual": pace.usual,
            "known": float(pace.known),
            "births": births_of(births, seen, doubt, interval),
            "doubt": doubt,
            "own": boxes.own,
        }
        yield _Look(number, identity, box_px, score, step, signature, fixed)
        begun = (score >= settings.track.birth_score) & ~np.isin(identity, list(known))
        births += int((begun & ~near_border(box_px, size)).sum()) if before is not None else 0
        known |= set(identity[begun].tolist())
        before = box_px


def _size(clip: Clip, boxes: Owned) -> tuple[float, float]:
    from torchvision_dddas.evaluation.studies.stages import opened

    if clip.pictures:
        width, height = opened(clip).size
        return float(width), float(height)
    return boxes.size if boxes.size is not None else (1e6, 1e6)


def _extent(table: TrackTable) -> tuple[float, float] | None:
    ones = np.ones(len(table.frame))
    return DetectionTable("", table.frame, np.asarray(table.box_px, float), ones, np.arange(len(ones))).extent


def _shown(
    clip: Clip, table: TrackTable, settings: Settings, interval: int
) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]]:
    """Number, identities, boxes, camera's motion and histograms of each look from the first to the last with boxes."""
    from torchvision_dddas.detection.engine import load_engine
    from torchvision_dddas.tracking.appearance import strips
    from torchvision_dddas.tracking.camera_motion import Camera

    camera, looks_matter = Camera(load_engine("onboard", settings)), settings.track.appearance != "never"
    for number, identity, box_px, image in boxed(clip, table, interval):
        if image is None:
            yield number, identity, box_px, None, None
            continue
        step, _ = camera.step(image)
        yield number, identity, box_px, step, strips(image, box_px) if looks_matter else None


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
        visible[t, here] = visible_share(look.box_px)
        if look.signature is not None and len(here):
            if signature is None:
                signature = np.zeros((len(names), look.signature.shape[1]))
            alike[t][:, here] = likeness(signature, look.signature)
            hits[here] += 1
            signature[here] = blended(signature[here], look.signature, visible[t, here], hits[here])
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
