"""What a stage finds, gathered frame by frame."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np

from torchvision_dddas.evaluation.studies.record import Found
from torchvision_dddas.types import Scene, TrackedFrame

Tick = Callable[[], object]


@dataclass
class Rows:
    """What was found so far, frame by frame."""

    looked: list[int] = field(default_factory=list)
    columns: dict[str, list[np.ndarray]] = field(default_factory=dict)
    masks: dict[int, bytes] = field(default_factory=dict)
    steps: dict[int, np.ndarray] = field(default_factory=dict)
    more: dict[str, np.ndarray] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add(self, number: int, seconds: Mapping[str, float], **columns: np.ndarray) -> None:
        """The boxes of a frame, a row each, in columns of one length."""
        self.looked.append(number)
        for stage, spent in seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent
        count = len(columns["box_px"])
        columns.setdefault("identity", np.full(count, -1))
        columns.setdefault("east_north_m", np.full((count, 2), np.nan))
        columns.setdefault("covariance_m2", np.full((count, 2, 2), np.nan))
        for name, column in {"frame": np.full(count, number), **columns}.items():
            self.columns.setdefault(name, []).append(column)

    def found(self, peak_mb: float) -> Found:
        """All of it."""
        empty = {"frame": (0,), "box_px": (0, 4), "score": (0,), "identity": (0,)}
        empty |= {"east_north_m": (0, 2), "covariance_m2": (0, 2, 2)}
        joined = {name: np.zeros(shape) for name, shape in empty.items()}
        joined |= {name: np.concatenate(parts) for name, parts in self.columns.items()}
        return Found(
            joined.pop("frame").astype(np.int64),
            joined.pop("box_px").astype(float),
            joined.pop("score").astype(float),
            joined.pop("identity").astype(np.int64),
            joined.pop("east_north_m"),
            joined.pop("covariance_m2"),
            np.array(self.looked, np.int64),
            self.masks,
            self.steps,
            {**joined, **self.more},
            self.seconds,
            peak_mb,
            tuple(self.notes),
        )


class Kept:
    """What of a clip's scenes later stages and measures need, scene by scene."""

    def __init__(self, wanted: set[int], tick: Tick) -> None:
        """wanted: the frames whose masks are kept."""
        self._wanted, self._tick = wanted, tick
        self._rows, self._causes = Rows(), dict[int, str]()

    def add(self, scene: Scene) -> None:
        """The next scene."""
        number, found, rows = scene.frame.number, scene.detections, self._rows
        more = {"area_px": found.area_px, "heading_rad": found.heading_rad, "speed_px": found.speed_px}
        rows.add(number, scene.seconds, box_px=found.box_px, score=found.score, middle_px=found.middle_px, **more)
        if number in self._wanted:
            # One bit would do; the numbers of the targets cost little more, and pictures of results show them.
            mask = np.minimum(scene.mask, 255).astype(np.uint8)
            rows.masks[number] = cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        if scene.step is not None and scene.step.reliable:
            rows.steps[number] = scene.step.later_from_earlier
        if not scene.reliable:
            self._causes[number] = scene.cause
        self._tick()

    def rows(self) -> Rows:
        """All of it, and in words how many frames could not be trusted."""
        if self._causes:
            first = min(self._causes)
            told = f"{len(self._causes)} frames with unreliable registration, first {first}: {self._causes[first]}"
            self._rows.notes.append(told)
        return self._rows


def scenes_kept(scenes: Iterator[Scene], wanted: set[int], tick: Tick) -> Rows:
    """What is kept of a clip's scenes."""
    kept = Kept(wanted, tick)
    for scene in scenes:
        kept.add(scene)
    return kept.rows()


def followed_kept(followed: Iterator[TrackedFrame], tick: Tick) -> Rows:
    """The tracks of frames in order, as `tracks.txt` has them."""
    rows = Rows()
    for here in followed:
        tracks = here.tracks
        rows.add(here.number, here.seconds, box_px=written(tracks.box_px), score=tracks.score, identity=tracks.identity)
        tick()
    return rows


def written(box_px: np.ndarray) -> np.ndarray:
    """Boxes to two digits, as the tables that commands write have them: what is scored is what they would score."""
    return np.array([[float(f"{value:.2f}") for value in box] for box in box_px.tolist()]).reshape(-1, 4)
