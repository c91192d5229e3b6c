"""Where people are searched in a frame: everywhere, around those seen before, around what moves; the feedback rule.

The surroundings of expected people are searched in every frame, the rest of the picture a few levels at a time. A
person scores at several neighbouring levels, and is found at the first of them: so a tenth of the levels in each frame
finds newcomers sooner than all levels in each tenth frame.
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
"""region_px (R, 4), which a body must lie in; heights_px (R, 2), its least and largest height."""

# What a blob says of a body, in blob heights: it may be a group, or the legs alone, whose body is above them.
_BLOB_HEIGHTS = (0.5, 2.5)
_ABOVE, _BELOW, _BESIDE = 1.5, 0.5, 0.35
_EXPLAINED = 0.5  # a blob of which those expected cover this share is theirs

# Of the difference between where a person was expected and found, so much goes into place and size, and velocity.
# Windows stand on a grid of 0.08 body heights: two looks alone would say little of a velocity.
_PLACE_GAIN, _VELOCITY_GAIN = 0.6, 0.2
_NEAR_HEIGHTS = 0.5  # a person expected no further from one that is found may be this one

_DEAR = 0.8  # regions that cost more than this share of a whole look are not worth their name
_CHANGED, _LITTLE = 2.0, 0.02  # a share that grew or shrank by this factor is worth a line; less than that is none
_TURN = 0.382  # levels that have their turn in frames after one another are so far apart, as a share of the round


@dataclass(frozen=True)
class SearchPlan:
    """The parts of a frame to search. regions_px: (R, 4), beside the levels whose turn it is; None: everywhere.

    share: of all windows that are searched.
    """

    parts: list[Part]
    regions_px: np.ndarray | None
    share: float
    adjustments: tuple[Adjustment, ...] = ()


def _grown(box_px: Float[np.ndarray, "N 4"], beside: float, above: float, below: float) -> Float[np.ndarray, "N 4"]:
    """Boxes with margins, in their heights."""
    return box_px + box_px[:, 3:] * np.array([-beside, -above, 2 * beside, above + below])


class ExpectedPeople:
    """Predicts where people are, from where they were found and their velocity.

    A person who is not found stays expected for four times as many frames as they were found in, at most twice
    `rescan_frames`: a person who was missed comes back, and a false alarm of one frame is soon forgotten.
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
        """(N, 4) boxes at a frame."""
        place = self.place_px + self.velocity_px * (frame - self.frame)
        return np.concatenate([place - self.size_px / 2, self.size_px], axis=1)

    def regions(self, frame: int) -> Regions:
        """Around them."""
        box_px, scales = self.box_px(frame), self.parameters.region_scales
        return _grown(box_px, *[self.parameters.region_margin] * 3), box_px[:, 3:] * (1 / scales, scales)

    def update(self, frame: int, people: People) -> int:
        """Correct by the people found; returns how many of those expected are among them."""
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
    """Rows of the expected and of the found boxes that are the same person: the nearest first, none beyond the gate.

    SciPy would find the pairs that are nearest in all, and take 40 MB to be imported.
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
    """Plans where to search frame after frame; `update` takes what was found by each plan.

    `people.search = everywhere`: the whole picture. `regions`: around those expected, and the whole picture level by
    level in `rescan_frames` frames; all of it in one look at first, and when all who were expected are lost, as after
    a cut. With `people.look_share` below 1 no look takes more windows: then also these come in turns, levels in bands.
    blobs: (N, 4) boxes of a frame's movers. With `everywhere` only their surroundings are then looked at; with
    `regions` those too, where no one expected explains them.
    """

    def __init__(self, parameters: PeopleParameters, blobs: Callable[[int], np.ndarray] | None = None) -> None:
        self.blobs = blobs
        self.steered = parameters.search == "regions"
        self.expected = ExpectedPeople(parameters)
        self.plans = 0
        self.retune(parameters)
        self.there = 0  # people whom the last look found
        self.lost = 0  # how many the look before it had found, where it found none of them
        self.reported = 1.0  # share of windows in the last line of the record

    def retune(self, parameters: PeopleParameters) -> None:
        """Search as these say from the next look on; whether in regions or everywhere stays as it was."""
        self.parameters = self.expected.parameters = parameters

    def update(self, frame: int, people: People, plan: SearchPlan) -> None:
        """Add what was found by a plan."""
        self.plans += 1
        if not self.steered:
            return
        again = self.expected.update(frame, people)
        # One alone is often missed for a frame, and after a look that found nobody none is new.
        self.lost = self.there if self.there > 1 and not again and plan.regions_px is not None else 0
        self.there = len(people)

    def plan(self, frame: int, size: tuple[int, int]) -> SearchPlan:
        """Where to search a frame of (width, height)."""
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
            # A look that costs `people.look_share` of one at all: what is due, around those expected, around movers.
            # Half of what it may take is for the rest of the picture.
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
                why = f"{len(region_px)} regions would take {around:.0%} of the windows"
                return self._whole(frame, everywhere, why)
            due = self._due(everywhere, parameters.rescan_frames)
            levels = {part.level for part in due}
            parts = due + [part for part in parts if part.level not in levels]
        share = pyramid.cost(parts, parameters) / all_windows
        return SearchPlan(parts, region_px, share, self._report(frame, around))

    def _regions(self, frame: int) -> tuple[Regions, Regions]:
        """Around those expected, and around what moves: bodies from half to 2.5 times as high as a blob."""
        known = moving = np.zeros((0, 4)), np.zeros((0, 2))
        if self.steered:
            known = self.expected.regions(frame)
        if self.blobs is not None:
            box_px = np.asarray(self.blobs(frame), float).reshape(-1, 4)
            if self.steered:
                # Of each blob the share that those expected cover, those that overlap counted twice.
                covered = shared_px(box_px[:, None], self.expected.box_px(frame)).sum(axis=1)
                box_px = box_px[covered / box_px[:, 2:].prod(axis=1) < _EXPLAINED]
            moving = _grown(box_px, _BESIDE, _ABOVE, _BELOW), box_px[:, 3:] * _BLOB_HEIGHTS
        return known, moving

    def _thinned(self, parts: list[Part], most_px: float) -> list[Part]:
        """Those on every so many-th level, others in each look, so that they cost about so much; on one at least.

        A body scores at several levels that lie together.
        """
        levels = sorted({part.level for part in parts})
        every = min(math.ceil(pyramid.pixels(parts) / max(most_px, 1)), len(levels))
        due = set(levels[self.plans % every :: every]) if every else set()
        return [part for part in parts if part.level in due]

    def _due(self, parts: list[Part], rounds: int) -> list[Part]:
        """Those whose turn it is: each comes once in so many looks, far from those before."""
        step = min((k for k in range(1, rounds + 1) if math.gcd(k, rounds) == 1), key=lambda k: abs(k - _TURN * rounds))
        return parts[self.plans * step % rounds :: rounds]

    def _whole(self, frame: int, everywhere: list[Part], why: str) -> SearchPlan:
        """A look at all, which the record explains."""
        old, self.reported = self.reported, 1.0
        moved = (Adjustment(frame, "people.regions_share", old, 1.0, why),) if old != 1.0 else ()
        return SearchPlan(everywhere, None, 1.0, moved)

    def _report(self, frame: int, share: float) -> tuple[Adjustment, ...]:
        """A line of the record, where the share of windows in regions has changed much since the last one."""
        low, high = sorted((max(share, _LITTLE), max(self.reported, _LITTLE)))
        if high < _CHANGED * low:
            return ()
        why = f"{_persons(len(self.expected))} expected" + ("" if self.blobs is None else ", and what moves")
        old, self.reported = self.reported, round(share, 4)
        return (Adjustment(frame, "people.regions_share", old, self.reported, why),)


def _persons(count: int) -> str:
    return f"{count} {'person' if count == 1 else 'people'}"
