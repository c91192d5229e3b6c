"""Small clips whose truth is known, one maker for each family of parameters."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.synthetic_clip import film_into
from torchvision_dddas.lab.evaluation.datasets.kinds import read
from torchvision_dddas.lab.evaluation.datasets.record import Clip, DatasetSource
from torchvision_dddas.lab.evaluation.metrics.truth import ClipTruth, TrackTable

PERSON = np.array([20.0, 50.0])


def filmed_clip(place: Path, frames: int) -> Clip:
    """Pictures of 240 x 180 with masks of what moves."""
    film_into(place / "film", 3, frames, (240, 180))
    (found,) = read(DatasetSource("folder", place), place).clips
    return found


def walk(name: str = "walk", people: int = 4, frames: int = 150, seed: int = 0, true: bool = True) -> Clip:
    """People who walk about for a while."""
    draw = np.random.default_rng(seed)
    place = draw.uniform(100, 400, (people, 2)) + np.cumsum(draw.normal(0, 0.5, (frames, people, 2)), axis=0).cumsum(0)
    frame = np.repeat(np.arange(1, frames + 1), people)
    identity = np.tile(np.arange(1, people + 1), frames)
    box_px = np.concatenate([place.reshape(-1, 2) - PERSON / 2, np.tile(PERSON, (len(frame), 1))], axis=1)
    table = TrackTable(frame, identity, box_px)
    truth = ClipTruth("boxes", Path(name), {}, {int(f): box_px[frame == f] for f in np.unique(frame)}, table)
    return Clip(name, Path(name), truth=truth if true else None)


def seen(clip: Clip, place: Path, false: int = 1, miss: float = 0.1, seed: int = 1) -> Clip:
    """The clip with public detections: some people missed, boxes that scatter, and false alarms in each frame."""
    draw = np.random.default_rng(seed)
    assert clip.truth is not None
    lines = []
    for frame, boxes in clip.truth.boxes.items():
        for x, y, width, height in boxes[draw.uniform(size=len(boxes)) >= miss] + draw.normal(0, 0.5, (1, 4)):
            lines.append(f"{frame},-1,{x:.2f},{y:.2f},{width:.2f},{height:.2f},{draw.choice([0.8, 0.99, 1.0])}")
        for x, y in draw.uniform(-200, 700, (false, 2)):
            lines.append(f"{frame},-1,{x:.2f},{y:.2f},20,50,{draw.choice([0.8, 0.99])}")
    path = place / f"{clip.name}.txt"
    path.write_text("\n".join(lines) + "\n")
    return replace(clip, given=path)
