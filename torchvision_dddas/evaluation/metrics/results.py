"""Reading back what `dddas detect --out` or `dddas track --out` wrote, or MOTChallenge text of any program."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics import mot_text
from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.io.image_bytes import decoded

DETECTIONS, TRACKS = "detections.txt", "tracks.txt"


@dataclass(frozen=True)
class Result:
    """A result. frames: the last one of the run, 0 where nothing says. state: of the run.

    place: the folder or file. detected: (N, 4) boxes of each frame with targets, None where only tracks were written.
    tracks: the boxes with identities, None where there are none.
    """

    place: Path
    frames: int
    detected: dict[int, np.ndarray] | None
    has_masks: bool
    state: str
    tracks: TrackTable | None = None

    @property
    def name(self) -> str:
        """What to call it: the folder's name, or the file's without its ending."""
        place = self.place.resolve()
        return place.stem if place.is_file() else place.name

    def boxes_at(self, frame: int) -> np.ndarray:
        """(N, 4) boxes of a frame: the detections, or the tracks' where there are none."""
        if self.detected is not None:
            return self.detected.get(frame, np.zeros((0, 4)))
        return np.zeros((0, 4)) if self.tracks is None else self.tracks.box_px[self.tracks.frame == frame]

    def mask_at(self, frame: int) -> np.ndarray:
        """(H, W) mask of a frame. Raises InputError if it is not there."""
        path = self.place / "masks" / f"{frame:06d}.png"
        mask = decoded(path.read_bytes(), cv2.IMREAD_UNCHANGED) if path.is_file() else None
        if mask is None:
            raise InputError(f"{path} is missing or no picture; run dddas detect again with --save masks")
        return mask if mask.ndim == 2 else mask.max(axis=2)


def is_result(place: Path) -> bool:
    """Whether a place looks like a result: a file, or a folder that dddas detect or dddas track wrote."""
    return place.is_file() or any((place / name).is_file() for name in (DETECTIONS, TRACKS))


def load(place: Path) -> Result:
    """Read a result folder, or a file of MOTChallenge text. Raises InputError if it is none."""
    if place.is_file():
        rows = mot_text.read_rows(place, "result")
        if rows.named:
            return Result(place, 0, None, False, "complete", mot_text.with_identities(rows, place))
        return Result(place, 0, _by_frame(rows.table), False, "complete")
    if not is_result(place):
        raise InputError(
            f"{place} is no result of dddas detect: it holds no {DETECTIONS}; nor of dddas track: no {TRACKS}"
        )
    detected = tracks = None
    if (place / DETECTIONS).is_file():
        detected = _by_frame(mot_text.read_rows(place / DETECTIONS, "detections").table)
    if (place / TRACKS).is_file():
        tracks = mot_text.with_identities(mot_text.read_rows(place / TRACKS, "tracks"), place / TRACKS)
    try:
        record = json.loads((place / "run.json").read_text(encoding="utf-8"))
        looks, state, outputs = int(record["frames"]["written"]), str(record["state"]), list(record["outputs"])
        # dddas track writes every interval-th frame, from wherever its table begins; dddas detect each.
        counted = max(looks - 1, 0) * int(record.get("interval_frames", 1)) + min(looks, 1)
        frames = int(record.get("last_frame", counted)) if looks else 0
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        # Tables of another program: only masks can say how long the clip is, as there is one for each frame.
        numbers = [int(p.stem) for p in (place / "masks").glob("*.png") if p.stem.isdecimal()]
        frames, state, outputs = max(numbers, default=0), "complete", ["masks"] if numbers else []
    return Result(place, frames, detected, "masks" in outputs, state, tracks)


def _by_frame(table: TrackTable) -> dict[int, np.ndarray]:
    return {int(f): table.box_px[table.frame == f] for f in np.unique(table.frame)}
