"""What lasts over frames: blobs that are linked and move steadily, and small candidates that travel."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from torchvision_dddas.config import PersistenceParameters, SmallParameters
from torchvision_dddas.detection.blob_motion import Motion
from torchvision_dddas.detection.blobs import Blob, Box, box_slices, label_parts
from torchvision_dddas.geometry import occupied, transfer

# Two blobs may be one target when their areas differ by less than this factor ...
_SIZE_RATIO = 2.5
# ... and the predicted box overlaps the found one, or lies close and moves alike (px a frame).
_LEAST_IOU, _VELOCITY_PX = 0.3, 0.6

# A small track is straight when its points lie this close to a constant velocity, px (root mean square).
_STRAIGHT_PX = 2.0
# Its motion is measured over so many frames at most.
_MEMORY_FRAMES = 30
# It has travelled when it has gone so many of its own lengths, and more of them for each other candidate in the frame:
# clutter, parallax above all, drifts too.
_LENGTHS, _LENGTHS_EACH = 0.25, 0.005
# Where tracklets are used too, it must have left its own place: on the open clips, slower ones were all false.
_LENGTHS_BESIDE_TRACKLETS = 1.0


Links = dict[int, list[int | None]]
"""Of every blob the one that continues it in the next (1) or last (-1) frame; None: there is none."""


@dataclass(frozen=True)
class Sighting:
    """The blobs of one frame and their motions. next_from_this: (3, 3) to the following frame, None at a cut.

    links: those found so far; every frame is judged beside up to four others, and looks for the same ones each time.
    """

    blobs: Sequence[Blob]
    motions: Sequence[Motion]
    next_from_this: np.ndarray | None
    links: Links = field(default_factory=dict)

    @cached_property
    def columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of the N blobs: areas (N,), centres, sizes, and velocities (0 where unknown), (N, 2) each."""
        return (
            np.array([blob.area_px for blob in self.blobs]),
            np.array([blob.centre_px for blob in self.blobs]),
            np.array([blob.box[2:] for blob in self.blobs]),
            np.nan_to_num([motion.velocity_px for motion in self.motions]),
        )


def find_persistent(
    sightings: Sequence[Sighting], index: int, size: tuple[int, int], parameters: PersistenceParameters
) -> list[bool]:
    """Which blobs of `sightings[index]` are targets, judged by up to two frames before and after it.

    A blob that is linked over enough frames and moves steadily in enough of them is a target. Where blobs are few, or
    a blob is large, one link is enough, because parallax makes many small blobs. Weak blobs need the full test.
    size: (width, height) of the picture. Source: appendix B, S5, wants independently moving targets; we test each
    blob and not each pixel, which keeps targets whole.
    """
    crowded = np.median([sum(not blob.weak for blob in s.blobs) for s in sightings]) > parameters.trusted_blobs
    possible = min(index, 2) + 1 + min(len(sightings) - 1 - index, 2)
    verdicts = []
    for i, (blob, motion) in enumerate(zip(sightings[index].blobs, sightings[index].motions, strict=True)):
        # The frames in which it is seen, and those of them in which it moves steadily.
        links, passes = 1, int(motion.steady > parameters.flow_share)
        for direction in (1, -1):
            seen = i
            for at in (index, index + direction):
                if (following := _follow(seen, sightings, at, direction)) is None:
                    break
                seen = following
                links += 1
                passes += sightings[at + direction].motions[seen].steady > parameters.flow_share
        if blob.weak:
            verdicts.append(links >= parameters.weak_links and passes >= parameters.weak_passes)
            continue
        steady = links >= min(parameters.links, possible) and passes >= min(parameters.passes, possible)
        share = blob.area_px / (size[0] * size[1])
        large = share >= parameters.large_share
        linked = links >= 2 or possible < 2
        trusted = (linked and large) if crowded else (linked or share >= parameters.large_share / 5)
        sure = motion.steady > parameters.sure_share and share >= parameters.large_share / 10
        verdicts.append(steady or trusted or sure)
    return verdicts


def _follow(i: int, sightings: Sequence[Sighting], at: int, direction: int) -> int | None:
    """The blob one frame on (or back) that continues blob i of `sightings[at]`, if any."""
    if not 0 <= at + direction < len(sightings):
        return None
    links = sightings[at].links
    if direction not in links:
        step = sightings[at if direction > 0 else at - 1].next_from_this
        links[direction] = _find_links(sightings[at], sightings[at + direction], step, direction)
    return links[direction][i]


def _find_links(here: Sighting, there: Sighting, step: np.ndarray | None, direction: int) -> list[int | None]:
    if step is None or not there.blobs:
        return [None] * len(here.blobs)
    there_from_here = step if direction > 0 else np.linalg.inv(step)
    areas, centres, sizes, velocities = (column[:, None] for column in here.columns)
    other_areas, other_centres, other_sizes, other_velocities = there.columns
    # Where they are by their own motion, and where they are if that was measured wrongly.
    ahead = np.concatenate([centres + direction * velocities, centres], axis=1)
    places = transfer(there_from_here, ahead.reshape(-1, 2)).reshape(-1, 2, 1, 2)
    half, other_half = sizes[:, None] / 2, other_sizes / 2
    low = np.maximum(places - half, other_centres - other_half)
    high = np.minimum(places + half, other_centres + other_half)
    both = np.prod(np.maximum(high - low, 0), axis=3)
    either = (np.prod(sizes, axis=2) + np.prod(other_sizes, axis=1))[:, None] - both
    overlap = (both / either).max(axis=1)
    away, unlike = other_centres - places[:, 0], other_velocities - velocities
    near = (np.hypot(*away.T).T < 0.5 * np.hypot(*sizes.T).T) & (np.hypot(*unlike.T).T < _VELOCITY_PX)
    ratio = other_areas / np.maximum(areas, 1)
    fits = (ratio > 1 / _SIZE_RATIO) & (ratio < _SIZE_RATIO) & ((overlap >= _LEAST_IOU) | near)
    best = np.where(fits, overlap, -1.0).argmax(axis=1)
    found = np.take_along_axis(fits, best[:, None], axis=1)[:, 0]
    return [int(k) if is_found else None for k, is_found in zip(best, found, strict=True)]


@dataclass
class SmallTrack:
    """One small candidate over time. points_px: (N, 2) centres, all in the coordinates of the latest frame.

    frames: their numbers. boxes: their boxes in their own frames.
    """

    frames: list[int]
    points_px: np.ndarray
    boxes: list[Box]
    velocity_px: np.ndarray = field(default_factory=lambda: np.zeros(2))
    confirmed: bool = False


def find_small_boxes(small: np.ndarray, parameters: SmallParameters) -> list[Box]:
    """Boxes of the candidates in a (H, W) uint8 mask; none at all where there are too many to tell them apart."""
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
    """The tracks of small slow targets, confirmed once they have travelled steadily. Feed it every frame in order."""

    def __init__(self, parameters: SmallParameters, beside_tracklets: bool = False) -> None:
        """beside_tracklets: whether targets are judged by tracklets too."""
        self.parameters = parameters
        self._lengths = _LENGTHS_BESIDE_TRACKLETS if beside_tracklets else _LENGTHS
        self.tracks: list[SmallTrack] = []
        self.counts: deque[int] = deque(maxlen=20)

    def step(self, frame: int, this_from_last: np.ndarray | None, boxes: Sequence[Box]) -> None:
        """Take the candidates of one frame. this_from_last: (3, 3) registration; None at a cut drops all tracks."""
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
        # The nearest first. Gates hardly ever overlap, and where they do the best sum is the same but for odd cases;
        # an exact assignment would bring 44 MB of SciPy into memory.
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
        """Fit a constant velocity to the latest frames; confirm a track that travels straight, far and surely."""
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
