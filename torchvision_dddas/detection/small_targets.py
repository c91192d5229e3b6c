"""Small slow targets: weak candidates tracked over many frames, confirmed once they have travelled steadily."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from torchvision_dddas.config import SmallParameters
from torchvision_dddas.geometry import occupied, transfer

# A track is straight when its points lie this close to a constant velocity, px (root mean square).
_STRAIGHT_PX = 2.0
# Its motion is measured over so many frames at most.
_MEMORY_FRAMES = 30
# It has travelled when it has gone so many of its own lengths, and more of them for each other candidate in the frame:
# clutter, parallax above all, drifts too.
_LENGTHS, _LENGTHS_EACH = 0.25, 0.005


@dataclass
class Track:
    """One candidate over time. points_px: (N, 2) centres, all in the coordinates of the latest frame.

    frames: their numbers. boxes: their boxes in their own frames.
    """

    frames: list[int]
    points_px: np.ndarray
    boxes: list[tuple[int, int, int, int]]
    velocity_px: np.ndarray = field(default_factory=lambda: np.zeros(2))
    missed: int = 0
    confirmed: bool = False


def find_candidates(small: np.ndarray, parameters: SmallParameters) -> list[tuple[int, int, int, int]]:
    """Boxes of the candidates in a (H, W) uint8 mask; none at all where there are too many to tell them apart."""
    boxes: list[tuple[int, int, int, int]] = []
    for left, top, wide, high in occupied(small, 2):
        part = small[top : top + high, left : left + wide]
        count, _, stats, _ = cv2.connectedComponentsWithStats(part, ltype=cv2.CV_32S)
        boxes += [
            (left + x, top + y, w, h)
            for x, y, w, h, area in stats[1:count].tolist()
            if area >= parameters.min_area_px and w * h <= parameters.max_box_px
        ]
    return sorted(boxes, key=lambda box: (box[1], box[0])) if len(boxes) <= parameters.max_candidates else []


class SmallTracks:
    """The tracks of candidates. Feed it every frame in order."""

    def __init__(self, parameters: SmallParameters) -> None:
        self.parameters = parameters
        self.tracks: list[Track] = []
        self.counts: deque[int] = deque(maxlen=20)

    def step(self, frame: int, this_from_last: np.ndarray | None, boxes: Sequence[tuple[int, int, int, int]]) -> None:
        """Take the candidates of one frame. this_from_last: (3, 3) registration; None at a cut drops all tracks."""
        if this_from_last is None:
            self.tracks = []
        self.counts.append(len(boxes))
        for track in self.tracks:
            tip = np.vstack([track.points_px[-1] - track.velocity_px, track.points_px])
            moved = transfer(this_from_last, tip)  # type: ignore[arg-type]
            track.points_px = moved[1:]
            track.velocity_px = moved[-1] - moved[0]
        centres = np.array([[x + (w - 1) / 2, y + (h - 1) / 2] for x, y, w, h in boxes]).reshape(-1, 2)
        taken = self._continue(frame, centres, boxes)
        for i in set(range(len(boxes))) - taken:
            self.tracks.append(Track([frame], centres[i : i + 1], [boxes[i]]))
        self.tracks = [t for t in self.tracks if frame - t.frames[-1] <= self.parameters.misses]

    def _continue(self, frame: int, centres: np.ndarray, boxes: Sequence[tuple[int, int, int, int]]) -> set[int]:
        if not self.tracks or not len(centres):
            return set()
        ahead = np.array([t.points_px[-1] + t.velocity_px * (frame - t.frames[-1]) for t in self.tracks])
        distance = np.linalg.norm(ahead[:, None] - centres[None], axis=2)
        near = np.argwhere(distance <= self.parameters.gate_px)
        near = near[np.argsort(distance[near[:, 0], near[:, 1]], kind="stable")]
        rows: set[int] = set()
        taken: set[int] = set()
        # The nearest first. Gates hardly ever overlap, and where they do the best sum is the same but for odd cases;
        # an exact assignment would bring 44 MB of SciPy into memory.
        for row, column in near.tolist():
            if row in rows or column in taken:
                continue
            track = self.tracks[row]
            track.frames.append(frame)
            track.points_px = np.vstack([track.points_px, centres[column]])
            track.boxes.append(boxes[column])
            rows.add(row)
            taken.add(column)
            self._judge(track)
        return taken

    def _judge(self, track: Track) -> None:
        """Fit a constant velocity to the latest frames; confirm a track that travels straight, far and surely."""
        recent = np.array(track.frames) > track.frames[-1] - _MEMORY_FRAMES
        time, points = np.array(track.frames, float)[recent], track.points_px[recent]
        if len(time) < 2:
            return
        span = time - time.mean()
        spread = float((span**2).sum())
        velocity = (span[:, None] * points).sum(axis=0) / spread
        miss = points - points.mean(axis=0) - span[:, None] * velocity
        rms = float(np.sqrt((miss**2).sum(axis=1).mean()))
        if len(time) >= 3:
            track.velocity_px = velocity
        if len(time) < self.parameters.hits:
            return
        speed = float(np.hypot(*velocity))
        sigma = max(rms, 0.3) / np.sqrt(spread)
        length = float(np.median([max(w, h) for _, _, w, h in track.boxes]))
        travel = speed * (time[-1] - time[0])
        lengths = _LENGTHS + _LENGTHS_EACH * float(np.median(self.counts))
        far = travel >= max(self.parameters.min_travel_px, lengths * length)
        track.confirmed |= bool(far and rms <= _STRAIGHT_PX and speed / sigma >= self.parameters.sureness)
