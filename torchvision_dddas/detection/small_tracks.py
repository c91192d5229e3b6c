"""Find small slow targets: track candidates of a few pixels, and confirm them once they have travelled steadily."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.config import SmallParameters
from torchvision_dddas.detection.blobs import Box, box_slices, label_parts
from torchvision_dddas.geometry import occupied, transfer

# A small track is straight if its points deviate from a constant velocity by at most this, px (root mean square).
_STRAIGHT_PX = 2.0
# A track's motion is measured over at most this many frames.
_MEMORY_FRAMES = 30
# A track must travel _LENGTHS times its own length, plus _LENGTHS_EACH times its length for each candidate in the
# frame, because clutter, above all parallax, drifts too.
_LENGTHS, _LENGTHS_EACH = 0.25, 0.005
# With tracklets a track must travel its own length: on the open clips, all tracks that travelled less were false.
_LENGTHS_BESIDE_TRACKLETS = 1.0


@dataclass
class SmallTrack:
    """One small candidate over N frames.

    frames: the frame numbers. points_px: (N, 2) centres, all in the coordinates of the latest frame. boxes: the boxes,
    each in the coordinates of its own frame.
    """

    frames: list[int]
    points_px: np.ndarray
    boxes: list[Box]
    velocity_px: np.ndarray = field(default_factory=lambda: np.zeros(2))
    confirmed: bool = False


def find_small_boxes(small: np.ndarray, parameters: SmallParameters) -> list[Box]:
    """Return the boxes of the candidates in a (H, W) uint8 mask, or no boxes if there are too many to track them."""
    boxes: list[Box] = []
    for part in occupied(small, 2):
        stats = label_parts(small[box_slices(part)])[1]
        boxes += [
            (part[0] + x, part[1] + y, w, h)
            for x, y, w, h, area in stats.tolist()
            if area >= parameters.min_area_px and w * h <= parameters.max_box_px
        ]
    return sorted(boxes, key=lambda box: (box[1], box[0])) if len(boxes) <= parameters.max_candidates else []


class SmallTracks:
    """The tracks of small slow targets. Call `step` for every frame in order."""

    def __init__(self, parameters: SmallParameters, beside_tracklets: bool = False) -> None:
        """Start without tracks. beside_tracklets: whether targets are also judged by tracklets."""
        self.parameters = parameters
        self._lengths = _LENGTHS_BESIDE_TRACKLETS if beside_tracklets else _LENGTHS
        self.tracks: list[SmallTrack] = []
        self.counts: deque[int] = deque(maxlen=20)

    def step(self, frame: int, this_from_last: np.ndarray | None, boxes: Sequence[Box]) -> None:
        """Assign a frame's candidates to tracks. this_from_last: (3, 3) registration; None, at a cut, drops all."""
        self.counts.append(len(boxes))
        if this_from_last is None:
            self.tracks = []
        else:
            for track in self.tracks:
                tip = np.vstack([track.points_px[-1] - track.velocity_px, track.points_px])
                moved = transfer(this_from_last, tip)
                track.points_px, track.velocity_px = moved[1:], moved[-1] - moved[0]
        centres = np.array([[x + (w - 1) / 2, y + (h - 1) / 2] for x, y, w, h in boxes]).reshape(-1, 2)
        pairs = []
        if self.tracks and boxes:
            ahead = np.array([t.points_px[-1] + t.velocity_px * (frame - t.frames[-1]) for t in self.tracks])
            distance = np.linalg.norm(ahead[:, None] - centres[None], axis=2)
            near = np.argwhere(distance <= self.parameters.gate_px)
            pairs = near[np.argsort(distance[near[:, 0], near[:, 1]], kind="stable")].tolist()
        # Assign the nearest pairs first. Gates rarely overlap, and if they do, the result is nearly always the same as
        # that of an optimal assignment, for which SciPy would take 44 MB of memory.
        rows: set[int] = set()
        taken: set[int] = set()
        for row, column in pairs:
            if row not in rows and column not in taken:
                rows.add(row)
                taken.add(column)
                track = self.tracks[row]
                track.frames.append(frame)
                track.points_px = np.vstack([track.points_px, centres[column]])
                track.boxes.append(boxes[column])
                self._judge(track)
        new = [SmallTrack([frame], centres[i : i + 1], [boxes[i]]) for i in range(len(boxes)) if i not in taken]
        self.tracks = [t for t in self.tracks + new if frame - t.frames[-1] <= self.parameters.misses]

    def _judge(self, track: SmallTrack) -> None:
        """Fit a constant velocity to the latest frames, and confirm a track that is straight, long and significant."""
        recent = np.array(track.frames) > track.frames[-1] - _MEMORY_FRAMES
        time, points = np.array(track.frames, float)[recent], track.points_px[recent]
        if len(time) < 2:
            return
        span = time - time.mean()
        spread = float((span**2).sum())
        velocity = (span[:, None] * points).sum(axis=0) / spread
        if len(time) >= 3:
            track.velocity_px = velocity
        if len(time) < self.parameters.hits:
            return
        miss = points - points.mean(axis=0) - span[:, None] * velocity
        rms = float(np.sqrt((miss**2).sum(axis=1).mean()))
        speed, sigma = float(np.hypot(*velocity)), max(rms, 0.3) / np.sqrt(spread)
        length = float(np.median([max(w, h) for _, _, w, h in track.boxes]))
        lengths = self._lengths + _LENGTHS_EACH * float(np.median(self.counts))
        far = speed * (time[-1] - time[0]) >= max(self.parameters.min_travel_px, lengths * length)
        track.confirmed |= bool(far and rms <= _STRAIGHT_PX and speed / sigma >= self.parameters.sureness)
