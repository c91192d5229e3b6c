"""What may be a landmark: patches of its colour, each followed over time, and the one that it most likely is."""

from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.config import LandmarkParameters
from torchvision_dddas.geo.colour_patches import Patches
from torchvision_dddas.geometry import cheapest, transfer

# What speaks for a patch, in logarithms of its area: something moves at it; it has travelled over the ground; it is the
# landmark already. Against it, at most: it is far from where the landmark should be.
_BLOB, _TRAVEL, _LOCK, _FAR = 2.0, 3.0, 1.0, 4.0
# A patch of this many times the usual area is no better than one of half as many, and one that fills its box by less
# than this is a shadow or a roof's edge rather than a vehicle's plate.
_LARGE, _FILL = 2.0, 0.5
# How much a new frame changes a velocity, an area, a share of frames.
_GAIN = 0.3
# So many patches of a colour are followed.
_MOST = 16
# By so much more must speak for the best patch than for the next before it is taken for the landmark.
_MARGIN = 1.0
# Only patches of at least this logarithm less than its size can be taken for it.
_ALIKE = 2.0


@dataclass
class Candidate:
    """A patch over time. Places are in the picture of the frame at hand; where it was not seen, as predicted.

    origin_px: where the ground lies now on which it was seen first. moving: share of the late frames in which
    something moved at it. seen, missed: frames in which it was, and since. row: among the frame's patches; -1: missed.
    """

    centre_px: np.ndarray
    box_px: np.ndarray
    area_px: float
    origin_px: np.ndarray
    velocity_px: np.ndarray = field(default_factory=lambda: np.zeros(2))
    moving: float = 0.0
    seen: int = 1
    missed: int = 0
    row: int = -1

    @property
    def fill(self) -> float:
        """Share of its box that it fills: half for a square on its corner."""
        return float(self.area_px / self.box_px[2:].prod())

    @property
    def travelled(self) -> float:
        """How far it went over the ground, in its own sizes, up to 1."""
        return float(min(np.linalg.norm(self.centre_px - self.origin_px) / np.sqrt(self.area_px), 1.0))


class Candidates:
    """The patches of one colour, and which of them is the landmark."""

    def __init__(self, parameters: LandmarkParameters) -> None:
        self._parameters = parameters
        self._all: list[Candidate] = []
        self.lock: Candidate | None = None
        self.sure = False
        self._blind = False

    def advance(self, now_from_before: np.ndarray | None) -> None:
        """Go on to the next picture; without the background's motion patches are looked for further around."""
        self._blind = now_from_before is None
        if now_from_before is not None and self._all:
            places = np.array([(one.centre_px, one.origin_px) for one in self._all])
            places = transfer(now_from_before, places.reshape(-1, 2)).reshape(places.shape)
            for one, (centre, origin) in zip(self._all, places, strict=True):
                one.centre_px, one.origin_px = centre, origin
        for one in self._all:
            one.centre_px = one.centre_px + one.velocity_px

    def see(self, found: Patches, moving: np.ndarray) -> None:
        """Take in the patches of a frame; moving: (P,) bool, whether something moves at each."""
        largest = self._foremost(found)
        taken = self._continue(found, largest)
        for one in self._all:
            one.row = taken.get(id(one), -1)
            if one.row < 0:
                one.missed += 1
                continue
            centre = found.centre_px[one.row]
            one.velocity_px = one.velocity_px + _GAIN * (centre - one.centre_px)
            one.centre_px, one.box_px, one.seen, one.missed = centre, found.box_px[one.row], one.seen + 1, 0
            one.area_px += _GAIN * (found.area_px[one.row] - one.area_px)
            one.moving += _GAIN * (moving[one.row] - one.moving)
        new = [
            Candidate(
                *(found.centre_px[row], found.box_px[row], float(found.area_px[row]), found.centre_px[row]),
                moving=float(moving[row]),
                row=int(row),
            )
            for row in largest
            if row not in taken.values()
        ]
        self._all = [one for one in self._all if one.missed <= min(self._parameters.interval_frames, one.seen)] + new
        if self.lock is not None and not any(one is self.lock for one in self._all):
            self.lock, self.sure = None, False

    def _foremost(self, found: Patches) -> np.ndarray:
        """The rows of the patches worth following, however many shadows there are."""
        area, near = found.area_px, np.zeros(len(found), bool)
        if self.lock is not None:
            area = np.minimum(area, _LARGE * self.lock.area_px)
            near = np.linalg.norm(found.centre_px - self.lock.centre_px, axis=1) <= self._parameters.reach_px
        fill = found.area_px / found.box_px[:, 2:].prod(axis=1)
        return np.lexsort((-area * np.minimum(fill / _FILL, 1.0) ** 4, ~near))[:_MOST]

    def _continue(self, found: Patches, rows: np.ndarray) -> dict[int, int]:
        """Which patch goes on with which candidate, by the candidate's id."""
        if not self._all or not len(rows):
            return {}
        before = np.array([one.centre_px for one in self._all])
        gate = np.array([np.sqrt(one.area_px) * (1 + 0.2 * one.missed) + 4 for one in self._all])
        reach = max(self._parameters.reach_px, 4.0)
        gate = np.full(len(gate), reach) if self._blind else np.minimum(gate, reach)
        apart = np.linalg.norm(before[:, None] - found.centre_px[rows][None], axis=2) / gate[:, None]
        change = np.log(found.area_px[rows][None] / np.array([one.area_px for one in self._all])[:, None])
        cost = np.where(apart <= 1, apart + 0.3 * np.abs(change), 100.0)
        pairs = zip(*cheapest(cost), strict=True)
        return {id(self._all[i]): int(rows[j]) for i, j in pairs if cost[i, j] < 100}

    def decide(self, expected_px: np.ndarray, usual_px: float, anew: bool) -> None:
        """Which patch is the landmark: as before, unless it is lost or in doubt, or the question is put anew.

        `sure` tells whether clearly more speaks for it than for the next best.
        expected_px: (2,) where it should be, NaN for unknown. usual_px: area of the landmarks' patches, inf: unknown.
        """
        if not self._all or not (anew or self.lock is None or not self.sure):
            return
        sizes = np.array([self._size(one, usual_px) for one in self._all])
        signs = np.array([self._signs(one, expected_px, usual_px) for one in self._all])
        held = np.array([_LOCK * (one is self.lock) for one in self._all])
        best = int((sizes + signs + held).argmax())
        same, self.lock = self._all[best] is self.lock, self._all[best]
        # Size alone does not tell a vehicle from a roof.
        rivals = sizes > sizes[best] - _ALIKE
        rivals[best] = False
        clear = not rivals.any() or signs[best] - signs[rivals].max() >= _MARGIN
        self.sure = bool(clear or (same and self.sure))

    @staticmethod
    def _size(one: Candidate, usual_px: float) -> float:
        return float(np.log(min(one.area_px, _LARGE * usual_px)))

    def _signs(self, one: Candidate, expected_px: np.ndarray, usual_px: float) -> float:
        """What speaks for a candidate beside its size."""
        score = 4 * np.log(min(one.fill / _FILL, 1.0)) + _BLOB * one.moving + _TRAVEL * one.travelled
        if np.isfinite(usual_px):
            score -= max(np.log(one.area_px / (_LARGE * usual_px)), 0.0)
        if np.isfinite(expected_px).all():
            away = np.linalg.norm(one.centre_px - expected_px) / (2 * max(self._parameters.reach_px, 1.0))
            score -= min(away**2 / 2, _FAR)
        return float(score)
