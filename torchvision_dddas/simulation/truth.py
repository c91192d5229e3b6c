"""What is true of a simulated run, as the tools that judge results read it: masks, boxes, identities, places."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from torchvision_dddas.io.atomic_files import remove, temporary, write_whole
from torchvision_dddas.io.images import Masks
from torchvision_dddas.io.maps.formats import encode_geojson, geojson
from torchvision_dddas.io.maps.ground_tracks import Gathered, GroundTracks
from torchvision_dddas.io.output import PipelineRecorder
from torchvision_dddas.io.output.recorder import uninterrupted
from torchvision_dddas.io.tables import TextFiles
from torchvision_dddas.types import Bodies, FrameResult, Positions, Truth

COLUMNS = (
    *("frame", "target", "kind", "people", "east_m", "north_m", "longitude_deg", "latitude_deg"),
    *("east_m_s", "north_m_s", "visible_px"),
)

STANDS_M_S = 0.1  # what is slower stands: nothing shows that it could move

FEWEST_PX = 6  # A target of which less shows counts for nothing

LonLat = Callable[[np.ndarray], np.ndarray]


class TruthOutput:
    """truth/: masks/000001.png ..., gt.txt, people.txt, positions.csv, tracks.geojson. Takes a Truth a frame.

    The masks hold the numbers of the targets that move, ground vehicles among them. gt.txt is MOTChallenge text of the
    targets without the landmarks; boxes of what stands, or of which fewer than FEWEST_PX show, are marked 0: they do
    not count. people.txt: the same of every person, by their own numbers. positions.csv has all targets, in the picture
    or not: of a crowd the middle of its people on the ground.
    """

    files = tuple(f"truth/{name}" for name in ("gt.txt", "people.txt", "positions.csv", "tracks.geojson"))

    def __init__(self, folder: Path, lonlat: LonLat, masks: bool = True) -> None:
        """lonlat: (N, 2) longitudes and latitudes of (N, 2) local metres. masks: whether to write them."""
        self._folder = folder / "truth"
        self._lonlat = lonlat
        content = {"gt.txt": "", "people.txt": "", "positions.csv": ",".join(COLUMNS) + "\n"}
        self._files = TextFiles({self._folder / name: first for name, first in content.items()})
        self._masks = Masks(self._folder) if masks else None
        self._targets, self._landmarks = Gathered(), Gathered()

    def write(self, truth: Truth) -> None:
        """Add a frame. Raises OSError if the disk refuses."""
        self._folder.mkdir(parents=True, exist_ok=True)
        found = gather_targets(truth.bodies)
        shown = label_boxes(truth.mask)
        people = label_boxes(truth.people)
        fleet = found.kind == "ugv"
        moves = dict(zip(found.target.tolist(), (found.fastest_m_s >= STANDS_M_S).tolist(), strict=True))
        rows = []
        for target, landmark in zip(found.target.tolist(), fleet.tolist(), strict=True):
            if target in shown and not landmark:
                counts = moves[target] and shown[target][4] >= FEWEST_PX
                rows.append(_mot(truth.frame, target, shown[target], counts))
        persons = truth.bodies.number[truth.bodies.kind == "person"].tolist()
        bodies = [_mot(truth.frame, number, people[number], True) for number in persons if number in people]
        lonlat = self._lonlat(found.east_north_m)
        places = [
            f"{truth.frame},{target},{kind},{count},{e:.4f},{n:.4f},{x:.9f},{y:.9f},{ve:.4f},{vn:.4f},{px}\n"
            for target, kind, count, (e, n), (x, y), (ve, vn), px in zip(
                found.target.tolist(),
                found.kind.tolist(),
                found.people.tolist(),
                found.east_north_m.tolist(),
                lonlat.tolist(),
                found.velocity_m_s.tolist(),
                [shown[t][4] if t in shown else 0 for t in found.target.tolist()],
                strict=True,
            )
        ]
        self._files.write("".join(rows), "".join(bodies), "".join(places))
        for gathered, which in ((self._targets, ~fleet), (self._landmarks, fleet)):
            count = int(which.sum())
            positions = Positions(
                np.full(count, truth.frame),
                found.target[which],
                found.east_north_m[which],
                np.full((count, 2, 2), np.nan),
                np.ones(count),
                (0.0, 0.0),
                lonlat[which],
            )
            gathered.add(positions, truth.time_s, found.velocity_m_s[which])
        if self._masks is not None:
            self._masks.add(truth.frame, moving_mask(truth))

    def close(self, complete: bool) -> None:
        """Put the tables in their places and write the map. Raises OSError if they cannot be written."""
        self._folder.mkdir(parents=True, exist_ok=True)
        self._files.close()
        if self._masks is not None:
            self._masks.close(complete)
        targets, fleet = self._targets.tracks(True), self._landmarks.tracks(True)
        content = encode_geojson(geojson(targets, landmarks=_ranked(fleet), names=_names(fleet)))
        write_whole(self._folder / "tracks.geojson", content)

    def discard(self) -> None:
        """Remove what was begun."""
        self._files.discard()
        remove(temporary(self._folder / "tracks.geojson"))
        if self._masks is not None:
            self._masks.discard()


class Targets(NamedTuple):
    """The targets of a moment, one row a target, by number.

    kind: (N,) of str. people: (N,) how many bodies it has. east_north_m, velocity_m_s: (N, 2) their middle's.
    fastest_m_s: (N,) of any of them.
    """

    target: np.ndarray
    kind: np.ndarray
    people: np.ndarray
    east_north_m: np.ndarray
    velocity_m_s: np.ndarray
    fastest_m_s: np.ndarray


def gather_targets(bodies: Bodies) -> Targets:
    """The targets that bodies are, or are part of."""
    target, first, row, count = np.unique(bodies.target, return_index=True, return_inverse=True, return_counts=True)
    place, velocity = (np.zeros((len(target), 2)) for _ in range(2))
    fastest = np.zeros(len(target))
    np.add.at(place, row, bodies.place_m[:, :2])
    np.add.at(velocity, row, bodies.velocity_m_s)
    np.maximum.at(fastest, row, np.hypot(*bodies.velocity_m_s.T))
    kind = bodies.kind[first]
    people = np.where(kind == "person", count, 0)
    return Targets(target, kind, people, place / count[:, None], velocity / count[:, None], fastest)


def moving_mask(truth: Truth) -> np.ndarray:
    """(H, W) uint16, the mask of a frame without the targets that stand."""
    found = gather_targets(truth.bodies)
    still = found.target[found.fastest_m_s < STANDS_M_S]
    return np.where(np.isin(truth.mask, still), 0, truth.mask) if len(still) else truth.mask


def label_boxes(labels: np.ndarray) -> dict[int, tuple[int, int, int, int, int]]:
    """Number -> x, y of the top left pixel, width, height of the box about its pixels, and how many they are."""
    v, u = np.nonzero(labels)
    numbers, row, count = np.unique(labels[v, u], return_inverse=True, return_counts=True)
    low, high = np.full((len(numbers), 2), labels.size), np.full((len(numbers), 2), -1)
    places = np.stack([u, v], axis=1)
    np.minimum.at(low, row, places)
    np.maximum.at(high, row, places)
    size = high - low + 1
    return {
        number: (x, y, w, h, px)
        for number, (x, y), (w, h), px in zip(
            numbers.tolist(), low.tolist(), size.tolist(), count.tolist(), strict=True
        )
    }


def _mot(frame: int, identity: int, box: tuple[int, int, int, int, int], counts: bool) -> str:
    return f"{frame},{identity},{box[0]},{box[1]},{box[2]},{box[3]},{counts:d},-1,-1,-1\n"


def _ranked(fleet: GroundTracks) -> GroundTracks:
    """Landmarks by their place in the team, from 0, in place of their targets' numbers."""
    return replace(fleet, target=np.unique(fleet.target, return_inverse=True)[1])


def _names(fleet: GroundTracks) -> tuple[str, ...]:
    return tuple(f"ugv{k + 1}" for k in range(len(np.unique(fleet.target))))


class SimulatedRunRecorder(PipelineRecorder):
    """The folder of a run in a simulated world: what `dddas run` writes, and truth/ for `dddas evaluate`."""

    files: ClassVar[tuple[str, ...]] = (*PipelineRecorder.files, *TruthOutput.files)
    saved: ClassVar[tuple[str, ...]] = (*PipelineRecorder.saved, "truth")

    def record_truth(self, lonlat: LonLat) -> None:
        """Call after `begin`. lonlat: (N, 2) longitudes and latitudes of (N, 2) metres of the world."""
        self._truth = TruthOutput(self.folder, lonlat, masks=False) if "truth" in self.save else None
        self._ahead: deque[Truth] = deque()

    def add_truth(self, truth: Truth) -> None:
        """Add the truth of a frame before its result; both are written together, so that both end at one frame."""
        if self._truth is not None:
            self._ahead.append(truth)

    def write(self, item: FrameResult) -> None:
        """Write a frame and the truth until then. Raises InputError if the disk refuses."""
        with uninterrupted():
            super().write(item)
            self._write_truth(item.tracked.number)

    def close(self, complete: bool) -> None:
        """Put everything in its place; without `truth` in save, that of an earlier run is removed."""
        with uninterrupted():
            with self._refusals():
                if self._truth is None:
                    for name in TruthOutput.files:
                        remove(self.folder / name)
                else:
                    if complete:
                        self._write_truth(math.inf)
                    self._truth.close(complete)
            super().close(complete)

    def discard(self) -> None:
        """Leave only what is whole."""
        with uninterrupted():
            truth = getattr(self, "_truth", None)
            if truth is not None:
                truth.discard()
            super().discard()

    def _write_truth(self, until: float) -> None:
        with self._refusals():
            while self._truth is not None and self._ahead and self._ahead[0].frame <= until:
                self._truth.write(self._ahead.popleft())
