"""Plan where to search for people in a frame: everywhere, around expected people, or around moving targets.

The surroundings of expected people are searched in every frame, and the rest of the picture a few levels at a time. A
person scores at several neighbouring levels and is found as soon as one of them is searched. A search of a tenth of the
levels in each frame therefore finds new people sooner than a search of all levels in every tenth frame.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.geometry import shared_px
from torchvision_dddas.people import pyramid
from torchvision_dddas.types import Adjustment, Float, Part, People

Regions = tuple[np.ndarray, np.ndarray]
"""(region_px, heights_px): (R, 4) boxes that must contain a body, and (R, 2) its smallest and largest height."""

# Range of the body height, and margins of the search region, in blob heights. A blob may be a group, or only the legs
# of a body.
_BLOB_HEIGHTS = (0.5, 2.5)
_ABOVE, _BELOW, _BESIDE = 1.5, 0.5, 0.35
_EXPLAINED = 0.5  # a blob is not searched if expected people cover at least this share of it

# Gains of the filter: shares of the innovation that correct position and size, and velocity. Windows lie on a grid of
# 0.08 body heights, so two looks alone determine a velocity poorly.
_PLACE_GAIN, _VELOCITY_GAIN = 0.6, 0.2
_NEAR_HEIGHTS = 0.5  # gate: largest distance between an expected and a found person, in body heights

_DEAR = 0.8  # if regions cost more than this share of a whole search, the whole picture is searched
_CHANGED, _LITTLE = 2.0, 0.02  # a change of the share by this factor is recorded; smaller shares count as _LITTLE
_TURN = 0.382  # distance between the levels searched in successive frames, as a share of all levels


@dataclass(frozen=True)
class SearchPlan:
    """The parts of a frame to search.

    regions_px: (R, 4) regions that are searched in addition to the levels whose turn it is; None: the whole picture.
    share: share of all windows that are searched.
    """

    parts: list[Part]
    regions_px: np.ndarray | None
    share: float
    adjustments: tuple[Adjustment, ...] = ()


def _grown(box_px: Float[np.ndarray, "N 4"], beside: float, above: float, below: float) -> Float[np.ndarray, "N 4"]:
    """Return boxes with margins, which are given in box heights."""
    return box_px + box_px[:, 3:] * np.array([-beside, -above, 2 * beside, above + below])


class ExpectedPeople:
    """Predicts the positions of people from earlier positions and velocities.

    A person who is not found stays expected for four times the number of frames in which they were found, at most for
    twice `rescan_frames`. A person who was missed is thus searched again, and a false alarm of one frame is soon
    dropped.
    """

    def __init__(self, parameters: PeopleParameters) -> None:
        self.parameters = parameters
        self.frame = 0
        self.place_px = np.zeros((0, 2))  # centres
        self.velocity_px = np.zeros((0, 2))
        self.size_px = np.zeros((0, 2))
        self.found = np.zeros(0, int)  # looks in which each was found
        self.seen = np.zeros(0, int)  # frame in which each was found last

    def __len__(self) -> int:
        return len(self.found)

    def box_px(self, frame: int) -> np.ndarray:
        """Return the (N, 4) predicted boxes at a frame."""
        place = self.place_px + self.velocity_px * (frame - self.frame)
        return np.concatenate([place - self.size_px / 2, self.size_px], axis=1)

    def regions(self, frame: int) -> Regions:
        """Return the search regions around the predicted boxes."""
        box_px, scales = self.box_px(frame), self.parameters.region_scales
        return _grown(box_px, *[self.parameters.region_margin] * 3), box_px[:, 3:] * (1 / scales, scales)

    def update(self, frame: int, people: People) -> int:
        """Correct the predictions by the people found, and return how many expected people were found."""
        steps = max(frame - self.frame, 1)
        box_px = self.box_px(frame)
        place, size = people.box_px[:, :2] + people.box_px[:, 2:] / 2, people.box_px[:, 2:]
        row, column = _pairs(box_px, people.box_px, self.parameters.region_scales)
        self.place_px = box_px[:, :2] + box_px[:, 2:] / 2
        innovation = place[column] - self.place_px[row]
        self.place_px[row] += _PLACE_GAIN * innovation
        self.velocity_px[row] += _VELOCITY_GAIN * innovation / steps
        self.size_px[row] *= (size[column] / self.size_px[row]) ** _PLACE_GAIN
        self.found[row] += 1
        self.seen[row] = frame
        stay = frame - self.seen <= np.minimum(4 * self.found, 2 * self.parameters.rescan_frames)
        new = np.setdiff1d(np.arange(len(people)), column)
        self.place_px = np.concatenate([self.place_px[stay], place[new]])
        self.velocity_px = np.concatenate([self.velocity_px[stay], np.zeros((len(new), 2))])
        self.size_px = np.concatenate([self.size_px[stay], size[new]])
        self.found = np.concatenate([self.found[stay], np.ones(len(new), int)])
        self.seen = np.concatenate([self.seen[stay], np.full(len(new), frame)])
        self.frame = frame
        return len(row)


def _pairs(expected_px: np.ndarray, found_px: np.ndarray, scales: float) -> tuple[np.ndarray, np.ndarray]:
    """Pair expected and found boxes greedily, the nearest first, within the gate; return the rows of both.

    An optimal assignment would need SciPy, whose import takes 40 MB.
    """
    apart = expected_px[:, None, :2] + expected_px[:, None, 2:] / 2 - found_px[:, :2] - found_px[:, 2:] / 2
    height = expected_px[:, None, 3]
    far = np.linalg.norm(apart, axis=2) / height
    ratio = np.abs(np.log(found_px[:, 3] / height))
    away = np.where((far > _NEAR_HEIGHTS) | (ratio > np.log(scales) + 0.05), np.inf, far + ratio)
    pairs = []
    while np.isfinite(nearest := away.min(initial=np.inf)):
        row, column = np.argwhere(away == nearest)[0]
        pairs.append((row, column))
        away[row], away[:, column] = np.inf, np.inf
    rows, columns = np.array(pairs, int).reshape(-1, 2).T
    return rows, columns


class Search:
    """Plans where to search in each frame. Pass the people found by each plan to `update`.

    With `people.search = everywhere` the plan is the whole picture, or, with blobs, only their surroundings. With
    `regions` the plan is the surroundings of expected people, the surroundings of blobs that no expected person covers,
    and some levels of the whole picture, so that all levels are searched once in `rescan_frames` frames. The whole
    picture is searched in the first frame, and when all expected people are lost, as after a cut. With
    `people.look_share` below 1 no frame costs more than this share of a whole search: regions and bands of levels are
    then also searched in turns. blobs: returns the (N, 4) boxes of a frame's moving targets.
    """

    def __init__(self, parameters: PeopleParameters, blobs: Callable[[int], np.ndarray] | None = None) -> None:
        self.blobs = blobs
        self.steered = parameters.search == "regions"
        self.expected = ExpectedPeople(parameters)
        self.plans = 0
        self.retune(parameters)
        self.there = 0  # number of people found in the last frame
        self.lost = 0  # number of people found in the frame before, if the last frame found none of them, else 0
        self.reported = 1.0  # share of windows in the last recorded adjustment

    def retune(self, parameters: PeopleParameters) -> None:
        """Use these parameters from the next frame on. The choice between regions and everywhere stays unchanged."""
        self.parameters = self.expected.parameters = parameters

    def update(self, frame: int, people: People, plan: SearchPlan) -> None:
        """Add the people found by a plan."""
        self.plans += 1
        if not self.steered:
            return
        again = self.expected.update(frame, people)
        # A single person is often missed for one frame, so only the loss of several people triggers a whole search. A
        # whole search that finds nobody is not repeated.
        self.lost = self.there if self.there > 1 and not again and plan.regions_px is not None else 0
        self.there = len(people)

    def plan(self, frame: int, size: tuple[int, int]) -> SearchPlan:
        """Return where to search in a frame of (width, height)."""
        parameters = self.parameters
        everywhere = pyramid.everywhere(size, parameters)
        is_bound = parameters.look_share < 1
        if not self.steered and self.blobs is None:
            return SearchPlan(everywhere, None, 1.0)
        if self.steered and not is_bound:
            if not self.plans or frame - self.expected.frame > parameters.rescan_frames:
                return SearchPlan(everywhere, None, 1.0)
            if self.lost:
                return self._whole(frame, everywhere, f"none of {_persons(self.lost)} expected was found")
        regions = self._regions(frame)
        region_px, heights_px = (np.concatenate(parts) for parts in zip(*regions, strict=True))
        all_windows = pyramid.cost(everywhere, parameters)
        if self.steered and is_bound:
            # The cost is limited to `people.look_share` of a whole search. Half of the limit is for the levels whose
            # turn it is; the rest is for the surroundings of expected people, and then of moving targets.
            whole = pyramid.pixels(everywhere)
            most = parameters.look_share * whole
            tiles = pyramid.tiles(everywhere, most / 2, parameters)
            parts = self._due(tiles, max(parameters.rescan_frames, math.ceil(pyramid.pixels(tiles) / (most / 2))))
            costs = 0.0
            for each in regions:
                wanted = pyramid.within(*each, size, parameters)
                costs += pyramid.pixels(wanted)
                parts += self._thinned(wanted, most - pyramid.pixels(parts))
            around = min(costs / whole, parameters.look_share)
        else:
            parts = pyramid.within(region_px, heights_px, size, parameters)
            around = pyramid.cost(parts, parameters) / all_windows
            if not self.steered:
                return SearchPlan(parts, region_px, around)
            if around > _DEAR:
                why = f"{len(region_px)} regions would need {around:.0%} of the windows"
                return self._whole(frame, everywhere, why)
            due = self._due(everywhere, parameters.rescan_frames)
            levels = {part.level for part in due}
            parts = due + [part for part in parts if part.level not in levels]
        share = pyramid.cost(parts, parameters) / all_windows
        return SearchPlan(parts, region_px, share, self._report(frame, around))

    def _regions(self, frame: int) -> tuple[Regions, Regions]:
        """Return the regions around expected people, and those around blobs that expected people do not cover."""
        known = moving = np.zeros((0, 4)), np.zeros((0, 2))
        if self.steered:
            known = self.expected.regions(frame)
        if self.blobs is not None:
            box_px = np.asarray(self.blobs(frame), float).reshape(-1, 4)
            if self.steered:
                # Area of each blob that expected people cover. Overlaps of expected people count twice.
                covered = shared_px(box_px[:, None], self.expected.box_px(frame)).sum(axis=1)
                box_px = box_px[covered / box_px[:, 2:].prod(axis=1) < _EXPLAINED]
            moving = _grown(box_px, _BESIDE, _ABOVE, _BELOW), box_px[:, 3:] * _BLOB_HEIGHTS
        return known, moving

    def _thinned(self, parts: list[Part], most_px: float) -> list[Part]:
        """Return the parts on every k-th level, in turns, so that they cost about `most_px`; on one level at least.

        This loses few people, because a body scores at several neighbouring levels.
        """
        levels = sorted({part.level for part in parts})
        every = min(math.ceil(pyramid.pixels(parts) / max(most_px, 1)), len(levels))
        due = set(levels[self.plans % every :: every]) if every else set()
        return [part for part in parts if part.level in due]

    def _due(self, parts: list[Part], rounds: int) -> list[Part]:
        """Return the parts whose turn it is: each once in `rounds` frames, far from the parts of the last frame."""
        step = min((k for k in range(1, rounds + 1) if math.gcd(k, rounds) == 1), key=lambda k: abs(k - _TURN * rounds))
        return parts[self.plans * step % rounds :: rounds]

    def _whole(self, frame: int, everywhere: list[Part], why: str) -> SearchPlan:
        """Return the plan to search the whole picture, and record the reason."""
        old, self.reported = self.reported, 1.0
        moved = (Adjustment(frame, "people.regions_share", old, 1.0, why),) if old != 1.0 else ()
        return SearchPlan(everywhere, None, 1.0, moved)

    def _report(self, frame: int, share: float) -> tuple[Adjustment, ...]:
        """Record the share of windows in regions if it has changed much since the last record."""
        low, high = sorted((max(share, _LITTLE), max(self.reported, _LITTLE)))
        if high < _CHANGED * low:
            return ()
        why = f"{_persons(len(self.expected))} expected" + ("" if self.blobs is None else ", and moving targets")
        old, self.reported = self.reported, round(share, 4)
        return (Adjustment(frame, "people.regions_share", old, self.reported, why),)


def _persons(count: int) -> str:
    return f"{count} {'person' if count == 1 else 'people'}"
