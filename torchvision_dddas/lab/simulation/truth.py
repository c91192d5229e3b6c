"""Write the truth of a simulated run in the formats of `dddas evaluate`: masks, boxes, identities, places."""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from scipy import ndimage

from torchvision_dddas.io.atomic_files import write_whole
from torchvision_dddas.io.images import Masks
from torchvision_dddas.io.maps.formats import encode_geojson, geojson
from torchvision_dddas.io.maps.ground_tracks import Gathered
from torchvision_dddas.io.output import PipelineRecorder
from torchvision_dddas.io.tables import TextFiles
from torchvision_dddas.types import Bodies, FrameResult, Positions, Truth

COLUMNS = (
    *("frame", "target", "kind", "people", "east_m", "north_m", "longitude_deg", "latitude_deg"),
    *("east_m_s", "north_m_s", "visible_px"),
)
_STANDS_M_S = 0.1  # slower targets count as standing
_FEWEST_PX = 6  # boxes of targets with fewer visible pixels do not count

LonLat = Callable[[np.ndarray], np.ndarray]


class TruthOutput:
    """Writes truth/: masks/000001.png ..., gt.txt, people.txt, positions.csv, tracks.geojson. Takes a Truth per frame.

    The masks hold the numbers of the moving targets, including ground vehicles. gt.txt lists the targets without the
    landmarks in MOTChallenge format. Boxes of standing targets and of targets with fewer than 6 visible pixels are
    marked 0 (do not count). people.txt lists every person in the same format, by person numbers. positions.csv has all
    targets, visible or not; the place of a crowd is the mean of its people's places on the ground.
    """

    files = tuple(f"truth/{name}" for name in ("gt.txt", "people.txt", "positions.csv", "tracks.geojson"))

    def __init__(self, folder: Path, lonlat: LonLat, masks: bool = True) -> None:
        """lonlat: converts local metres (N, 2) to longitudes and latitudes (N, 2). masks: whether to write masks."""
        self._folder, self._lonlat = folder / "truth", lonlat
        content = {"gt.txt": "", "people.txt": "", "positions.csv": ",".join(COLUMNS) + "\n"}
        self._files = TextFiles({self._folder / name: first for name, first in content.items()})
        self._masks = Masks(self._folder) if masks else None
        self._targets, self._landmarks = Gathered(), Gathered()

    def write(self, truth: Truth) -> None:
        """Add a frame. Raises OSError if the files cannot be written."""
        self._folder.mkdir(parents=True, exist_ok=True)
        all_, shown, people = _gather_targets(truth.bodies), _label_boxes(truth.mask), _label_boxes(truth.people)
        lonlat, is_landmark = self._lonlat(all_.east_north_m), all_.kind == "ugv"
        boxes, places = [], []
        for row, target in enumerate(all_.target.tolist()):
            *box, pixels = shown.get(target, (0, 0, 0, 0, 0))
            if pixels and not is_landmark[row]:
                counts = all_.fastest_m_s[row] >= _STANDS_M_S and pixels >= _FEWEST_PX
                boxes.append(_mot_line(truth.frame, target, box, counts))
            (e, n), (x, y), (ve, vn) = all_.east_north_m[row], lonlat[row], all_.velocity_m_s[row]
            places.append(
                f"{truth.frame},{target},{all_.kind[row]},{all_.people[row]},{e:.4f},{n:.4f},{x:.9f},{y:.9f},"
                f"{ve:.4f},{vn:.4f},{pixels}\n"
            )
        persons = truth.bodies.number[truth.bodies.kind == "person"].tolist()
        bodies = [_mot_line(truth.frame, number, people[number][:4], True) for number in persons if number in people]
        self._files.write("".join(boxes), "".join(bodies), "".join(places))
        for gathered, which in ((self._targets, ~is_landmark), (self._landmarks, is_landmark)):
            count = int(which.sum())
            positions = Positions(
                np.full(count, truth.frame),
                all_.target[which],
                all_.east_north_m[which],
                np.full((count, 2, 2), np.nan),
                np.ones(count),
                (0.0, 0.0),
                lonlat[which],
            )
            gathered.add(positions, truth.time_s, all_.velocity_m_s[which])
        if self._masks is not None:
            self._masks.add(truth.frame, moving_mask(truth))

    def close(self, complete: bool) -> None:
        """Put the tables in their places and write the map. Raises OSError if they cannot be written."""
        self._folder.mkdir(parents=True, exist_ok=True)
        self._files.close()
        targets, landmarks = self._targets.tracks(True), self._landmarks.tracks(True)
        # Replace the landmarks' target numbers by their rows in the team.
        numbers, row = np.unique(landmarks.target, return_inverse=True)
        names = tuple(f"ugv{k + 1}" for k in range(len(numbers)))
        content = encode_geojson(geojson(targets, landmarks=replace(landmarks, target=row), names=names))
        write_whole(self._folder / "tracks.geojson", content)

    def discard(self) -> None:
        """Remove the unfinished files."""
        self._files.discard()


class _Targets(NamedTuple):
    """The targets of a moment, one row per target, sorted by number.

    kind: (N,) str. people: (N,) number of people. east_north_m, velocity_m_s: (N, 2) means over the target's bodies.
    fastest_m_s: (N,) greatest speed of its bodies.
    """

    target: np.ndarray
    kind: np.ndarray
    people: np.ndarray
    east_north_m: np.ndarray
    velocity_m_s: np.ndarray
    fastest_m_s: np.ndarray


def _gather_targets(bodies: Bodies) -> _Targets:
    target, first, row, count = np.unique(bodies.target, return_index=True, return_inverse=True, return_counts=True)
    place, velocity, fastest = np.zeros((len(target), 2)), np.zeros((len(target), 2)), np.zeros(len(target))
    np.add.at(place, row, bodies.place_m[:, :2])
    np.add.at(velocity, row, bodies.velocity_m_s)
    np.maximum.at(fastest, row, np.hypot(*bodies.velocity_m_s.T))
    kind = bodies.kind[first]
    people = np.where(kind == "person", count, 0)
    return _Targets(target, kind, people, place / count[:, None], velocity / count[:, None], fastest)


def moving_mask(truth: Truth) -> np.ndarray:
    """Return the mask (H, W) uint16 of a frame without standing targets."""
    all_ = _gather_targets(truth.bodies)
    still = all_.target[all_.fastest_m_s < _STANDS_M_S]
    return np.where(np.isin(truth.mask, still), 0, truth.mask) if len(still) else truth.mask


def _label_boxes(labels: np.ndarray) -> dict[int, tuple[int, int, int, int, int]]:
    """Return {label: (x and y of the top left pixel, width, height, number of pixels)}."""
    count = np.bincount(labels.ravel()).tolist()
    return {
        number: (box[1].start, box[0].start, box[1].stop - box[1].start, box[0].stop - box[0].start, count[number])
        for number, box in enumerate(ndimage.find_objects(labels), 1)
        if box is not None
    }


def _mot_line(frame: int, identity: int, box: Sequence[int], counts: bool) -> str:
    return f"{frame},{identity},{box[0]},{box[1]},{box[2]},{box[3]},{counts:d},-1,-1,-1\n"


class SimulatedRunRecorder(PipelineRecorder):
    """The output folder of a run in a simulated world: the files of `dddas run`, and truth/ for `dddas evaluate`."""

    files: ClassVar[tuple[str, ...]] = (*PipelineRecorder.files, *TruthOutput.files)
    saved: ClassVar[tuple[str, ...]] = (*PipelineRecorder.saved, "truth")
    _truth: "_TruthUntil | None" = None

    def record_truth(self, lonlat: LonLat) -> None:
        """Write the truth too. Call after `begin`. lonlat: converts world metres (N, 2) to longitude and latitude."""
        if "truth" in self.save:
            self._truth = _TruthUntil(TruthOutput(self.folder, lonlat, masks=False))
            self._parts.append(self._truth)

    def add_truth(self, truth: Truth) -> None:
        """Add the truth of a frame before its result. Both are written together, so that both end at the same frame."""
        if self._truth is not None:
            self._truth.ahead.append(truth)


class _TruthUntil:
    """A part that writes the queued truth of a frame together with the frame's result."""

    def __init__(self, output: TruthOutput) -> None:
        self.ahead: deque[Truth] = deque()
        self._output, self.discard = output, output.discard

    def write(self, item: FrameResult) -> None:
        self._write(item.tracked.number)

    def close(self, complete: bool) -> None:
        self._write(math.inf if complete else 0)
        self._output.close(complete)

    def _write(self, until: float) -> None:
        while self.ahead and self.ahead[0].frame <= until:
            self._output.write(self.ahead.popleft())
