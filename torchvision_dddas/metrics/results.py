"""Reading back what `dddas detect --out` wrote."""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas.errors import InputError


@dataclass(frozen=True)
class Result:
    """A result folder. frames: how many the clip had. boxes: (N, 4) of each frame with targets. state: of the run."""

    folder: Path
    frames: int
    boxes: dict[int, np.ndarray]
    has_masks: bool
    state: str

    def boxes_at(self, frame: int) -> np.ndarray:
        """(N, 4) boxes of a frame."""
        return self.boxes.get(frame, np.zeros((0, 4)))

    def mask_at(self, frame: int) -> np.ndarray:
        """(H, W) mask of a frame. Raises InputError if it is not there."""
        path = self.folder / "masks" / f"{frame:06d}.png"
        mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
        if mask is None:
            raise InputError(f"{path} is missing or no picture; run dddas detect again with --save masks")
        return mask if mask.ndim == 2 else mask.max(axis=2)


def is_result(folder: Path) -> bool:
    """Whether a folder looks like one that dddas detect wrote."""
    return (folder / "detections.txt").is_file()


def load(folder: Path) -> Result:
    """Read a result folder. Raises InputError if it is none."""
    if not is_result(folder):
        raise InputError(f"{folder} is no result of dddas detect: it holds no detections.txt")
    try:
        text = (folder / "detections.txt").read_text(encoding="utf-8")
        table = np.array([[float(v) for v in row.split(",")[:6]] for row in text.splitlines() if row.strip()]).reshape(
            -1, 6
        )
    except ValueError as error:
        raise InputError(f"{folder / 'detections.txt'} is no table of detections: {error}") from error
    boxes = {int(f): table[table[:, 0] == f, 2:6] for f in np.unique(table[:, 0])}
    try:
        record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        frames, state, outputs = int(record["frames"]["written"]), str(record["state"]), record["outputs"]
    except (OSError, ValueError, KeyError, TypeError):
        # Tables of another program: the masks and boxes themselves must say how long the clip is.
        numbers = [int(p.stem) for p in (folder / "masks").glob("*.png") if p.stem.isdecimal()]
        frames, state, outputs = max([*numbers, *boxes, 0]), "complete", ["masks"] if numbers else []
    return Result(folder, frames, boxes, "masks" in outputs, state)
