"""Identities shared by several views, from whole tracks matched over the ground that the views have in common."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import best_pairs, transfer
from torchvision_dddas.tracking.view_registration import (
    SCATTER,
    ViewTargets,
    are_one,
    fit_map,
    hypotheses,
    pair_up,
    refine,
    score_pairs,
)
from torchvision_dddas.types import DetectionTable, Positions, SharedFrame, Tracks, ViewMap, identities_of

# Evidence that two tracks are one target: the share kept from frame to frame; the weight of a frame, because errors of
# successive frames are correlated; the least evidence that links two tracks; and the bonus of a link in force.
_FORGET, _WEIGHT, _LINK, _STAY = 0.98, 0.25, 2.0, 2.0
# A map is tested on this many past frames, with this step.
_TRACED, _TRACED_EVERY = 45, 3
_SEARCH_EVERY, _SLOWEST = 10, 60
_SCORE, _RIVALS, _RIVAL = 10.0, 4, 0.7
"""Log likelihood ratio of an accepted map; number of maps that are traced; rejection limit for a rival, as a share."""
_LOST, _IDLE = 0.35, 30
"""A map is lost below this share of common targets with a partner, or after this many frames without three pairs."""
_MOTION_FRAMES = 10
_STIFFNESS = 0.3
"""How far a map may move in a frame beyond a common shift, in box sizes."""
_REMEMBERED = 1000
"""Number of moments for which the identity of a track is kept after its last sighting."""
_MOST_TRACKS = 2000
"""Tracks of a view with evidence; beyond this number, only the most recently used half is kept."""
_UNKNOWN_M = 2.0
"""Standard deviation of places without a covariance."""


class _Follower:
    """A map that is tracked from frame to frame, with the evidence that tracks of the two views are one target."""

    def __init__(self, b_from_a: np.ndarray) -> None:
        self.map, self.quality, self.last, self.idle = b_from_a, 0.7, 0.0, 0
        self._rows: tuple[dict[int, int], dict[int, int]] = {}, {}
        self._evidence = np.zeros((64, 64))

    def evidence(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return (N, M) evidence that tracks of a and of b are one target, as log likelihood ratios."""
        return self._evidence[np.ix_(*self._places(a, b))]

    def _places(self, a: np.ndarray, b: np.ndarray) -> list[list[int]]:
        found = []
        for axis, (rows, numbers) in enumerate(zip(self._rows, (a, b), strict=True)):
            if len(rows) > _MOST_TRACKS:
                recent = list(rows)[-_MOST_TRACKS // 2 :]
                self._evidence = self._evidence.take([rows[number] for number in recent], axis)
                rows.clear()
                rows.update(zip(recent, range(len(recent)), strict=True))
            for number in numbers.tolist():
                rows[number] = rows.pop(number, len(rows))  # moved to the end: most recently used
            found.append([rows[number] for number in numbers.tolist()])
            if len(rows) > self._evidence.shape[axis]:
                pad = [(0, 0), (0, 0)]
                pad[axis] = (0, len(rows))
                self._evidence = np.pad(self._evidence, pad)
        return found

    def step(self, a: ViewTargets, b: ViewTargets, frames: int = 1) -> None:
        """Track the map to a frame that is `frames` frames later or earlier."""
        start = self.map
        places = self._places(a.identity, b.identity)
        old = self._evidence[np.ix_(*places)]
        known = best_pairs(old, _LINK)
        if len(known):
            off = b.place[known[:, 1]] - transfer(start, a.place[known[:, 0]])
            shift = np.eye(3)
            shift[:2, 2] = np.median(off, axis=0)
            start = fit_map(shift @ start, a, b, known, _STIFFNESS)
        pairs = best_pairs(score_pairs(start, a, b) + np.clip(old, -4, 4) / 2)
        self.map = fit_map(start, a, b, pairs, _STIFFNESS)
        _, self.last, share = pair_up(self.map, a, b)
        self._evidence[np.ix_(*places)] = old * _FORGET**frames + _WEIGHT * frames * score_pairs(self.map, a, b)
        if min(len(a.place), len(b.place)) and len(pairs) > 2:
            self.quality += 0.1 * (share - self.quality)
            self.idle = 0
        else:
            self.idle += frames


def _search(frames: Sequence[tuple[ViewTargets, ViewTargets]], rng: np.random.Generator) -> _Follower | None:
    """Return the likeliest map at the last frame, traced back over some frames; None if chance explains it."""
    a, b = frames[-1]
    around = rng.choice(a.place)
    coarse = [refine(start, a, b, around) for start in hypotheses(a, b, around)]
    coarse.sort(key=lambda one: -one[0])
    best: list[tuple[float, _Follower, np.ndarray]] = []
    for _, found in coarse:
        there = transfer(found, a.place)
        if len(best) == _RIVALS or any(are_one(there, transfer(other, a.place), b) for _, _, other in best):
            continue
        follower, scores = _Follower(found), list[float]()
        for back in range(0, min(_TRACED, len(frames)), _TRACED_EVERY):
            follower.step(*frames[-1 - back], frames=_TRACED_EVERY)
            scores.append(follower.last)
        best.append((float(np.mean(scores)), follower, found))
    best.sort(key=lambda one: -one[0])
    if not best or best[0][0] < _SCORE or (len(best) > 1 and best[1][0] > _RIVAL * best[0][0]):
        return None
    _, follower, found = best[0]
    for back in range(_TRACED, len(frames), _TRACED_EVERY):
        follower.step(*frames[-1 - back], frames=_TRACED_EVERY)
        if follower.quality < _LOST:
            break
    follower.map, follower.quality = found, max(follower.quality, 0.7)
    return follower


class _PairOfViews:
    """The registration of two views. While it is unknown, it is searched again."""

    def __init__(self, memory_frames: int) -> None:
        self.follower: _Follower | None = None
        self._past: list[tuple[int, _Follower]] = []
        self._memory_frames = memory_frames
        self._rng = np.random.default_rng(0)
        self._count, self._wait, self._next = 0, _SEARCH_EVERY, 0

    def update(
        self,
        frames: Sequence[tuple[ViewTargets, ViewTargets]],
        motion_a: np.ndarray | None = None,
        motion_b: np.ndarray | None = None,
    ) -> None:
        """Track the map to the last of some frames, or search for it. motion_a, motion_b: motion of each camera."""
        self._count += 1
        if self.follower is not None:
            if motion_a is not None or motion_b is not None:
                now_a, now_b = (np.eye(3) if m is None else m for m in (motion_a, motion_b))
                self.follower.map = now_b @ self.follower.map @ np.linalg.inv(now_a)
            self.follower.step(*frames[-1])
            if self.follower.quality < _LOST or self.follower.idle > _IDLE:
                self._past.append((self._count, self.follower))
                self.follower, self._wait = None, _SEARCH_EVERY
        self._past = [one for one in self._past if one[0] > self._count - self._memory_frames]
        both = [one for one in frames if len(one[0].place) and len(one[1].place)]  # leave out the gaps of a slower view
        is_now = bool(both) and both[-1] is frames[-1]
        if self.follower is None and is_now and len(frames) > _MOTION_FRAMES and self._count >= self._next:
            self.follower = _search(both, self._rng)
            self._wait = _SEARCH_EVERY if self.follower else min(self._wait + _SEARCH_EVERY // 2, _SLOWEST)
            self._next = self._count + self._wait

    def links(self, a: np.ndarray, b: np.ndarray, before: set[tuple[int, int]]) -> list[tuple[float, int, int]]:
        followers = [follower for _, follower in self._past] + ([self.follower] if self.follower else [])
        if not followers or not len(a) or not len(b):
            return []
        score = np.sum([follower.evidence(a, b) for follower in followers], axis=0)
        stay = np.array([[_STAY * ((i, j) in before) for j in b.tolist()] for i in a.tolist()])
        total = score + stay
        return [(total[i, j], int(a[i]), int(b[j])) for i, j in best_pairs(total, _LINK).tolist()]


class MultiViewTracker:
    """Give the tracks of several views identities that all views share, one moment after another.

    Views may be boxes in pixels from unknown cameras; the homography over the ground is then found from the tracks. Or
    they are places in metres with covariances; then only a common shift is estimated. A moment is settled
    `delay_frames` later; `update` returns the moments that it settles, in order, and `flush` the rest.

    >>> first = td.Tracks(1, np.array([7]), np.array([[10.0, 20, 5, 9]]), np.ones(1), np.zeros(1, int))
    >>> second = td.Tracks(1, np.array([4]), np.array([[40.0, 20, 5, 9]]), np.ones(1), np.zeros(1, int))
    >>> shared = td.MultiViewTracker(views=2)
    >>> frames = shared.update([first, second]) + shared.flush()
    >>> frames[0].own, frames[0].shared
    ((array([7]), array([4])), (array([1]), array([2])))
    """

    def __init__(self, views: int = 2, *, delay_frames: int = 50) -> None:
        """delay_frames: number of later moments used to match tracks. Raise InputError for numbers out of range."""
        if views < 2 or delay_frames < 0:
            raise InputError(f"needs 2 or more views and a delay of 0 or more; got {views} and {delay_frames}")
        self.views, self.delay_frames = views, delay_frames
        pairs = list(combinations(range(views), 2))
        self._pairs = {pair: _PairOfViews(delay_frames) for pair in pairs}
        self._linked: dict[tuple[int, int], set[tuple[int, int]]] = {pair: set() for pair in pairs}
        self._frames: deque[tuple[ViewTargets, ...]] = deque(maxlen=max(delay_frames, _TRACED) + 1)
        self._given: deque[tuple[tuple[Tracks | Positions, ...], dict[tuple[int, int], ViewMap]]] = deque()
        self._extent = [np.array([np.inf, np.inf, -np.inf, -np.inf]) for _ in range(views)]
        self._seen: dict[_Track, tuple[int, int]] = {}  # first and last moment of each track
        self._shared: dict[_Track, int] = {}
        self._count = self._settled = self._last = 0

    def update(
        self,
        views: Sequence[Tracks | Positions],
        camera_motion: Sequence[np.ndarray | None] | None = None,
    ) -> list[SharedFrame]:
        """Add a moment of all views, and return the moments that it settles.

        views: the tracks of each view, or the positions of its targets; empty if a view has no frame at this moment.
        camera_motion: for each view, the (3, 3) pixel homography from the moment before, NaN or None if unknown.
        Raise InputError for another number of views or motions, other types, and an identity twice in a view.
        """
        if len(views) != self.views:
            raise InputError(f"the tracker has {self.views} views, got {len(views)}; give empty tracks for a gap")
        if len({*map(type, views)}) > 1 or not isinstance(views[0], Tracks | Positions):
            raise InputError("views must be Tracks of all views, or Positions of all; give one kind")
        motions = [_known_motion(motion) for motion in camera_motion or [None] * self.views]
        if len(motions) != self.views:
            raise InputError(
                f"camera_motion has {len(motions)} entries for {self.views} views; give None where unknown"
            )
        for number, view in enumerate(views, 1):
            if len(np.unique(identities_of(view))) < len(view):
                raise InputError(f"view {number} has an identity twice at moment {self._count + 1}; give each once")
        self._frames.append(tuple(self._describe(k, view) for k, view in enumerate(views)))
        for k, view in enumerate(views):
            for own in identities_of(view).tolist():
                first, _ = self._seen.get((k, own), (self._count, 0))
                self._seen[k, own] = first, self._count
        maps = {}
        for (i, j), pair in self._pairs.items():
            pair.update([(frame[i], frame[j]) for frame in self._frames], motions[i], motions[j])
            found = pair.follower
            maps[i, j] = ViewMap(None, 0.0) if found is None else ViewMap(found.map, found.quality)
        self._given.append((tuple(views), maps))
        self._count += 1
        return [self._settle()] if len(self._given) > self.delay_frames else []

    def flush(self) -> list[SharedFrame]:
        """Return the moments that are not settled yet."""
        return [self._settle() for _ in range(len(self._given))]

    def _describe(self, k: int, view: Tracks | Positions) -> ViewTargets:
        identity = identities_of(view)
        if isinstance(view, Positions):
            place, size = view.east_north_m, np.ones(len(view))
            is_known = np.isfinite(view.covariance_m2).all((1, 2))[:, None, None]
            covariance = np.where(is_known, view.covariance_m2, _UNKNOWN_M**2 * np.eye(2)) + 0.01 * np.eye(2)
            corners = np.array([np.inf, np.inf, -np.inf, -np.inf]), place, place
        else:
            box = view.box_px
            size = np.sqrt(box[:, 2] * box[:, 3])
            # The middle of a standing object is above the lower edge of its box; people are thin.
            rise = np.where(box[:, 3] > 1.6 * box[:, 2], 0.1, 0.3) * box[:, 3]
            place = view.foot_px - np.c_[np.zeros(len(box)), rise]
            covariance = (SCATTER * size)[:, None, None] ** 2 * np.eye(2)
            corners = self._extent[k], box[:, :2], box[:, :2] + box[:, 2:]
        extent, low, high = corners
        extent = np.r_[np.vstack([low, extent[:2]]).min(0), np.vstack([high, extent[2:]]).max(0)]
        self._extent[k] = extent
        motion = np.full((len(place), 2), np.nan)
        # A slower view may lack a frame at that moment.
        for back in range(_MOTION_FRAMES, min(2 * _MOTION_FRAMES, len(self._frames) + 1)):
            if len(before := self._frames[-back][k].identity):
                _, here, there = np.intersect1d(identity, before, return_indices=True)
                motion[here] = (place[here] - self._frames[-back][k].place[there]) * _MOTION_FRAMES / back
                break
        return ViewTargets(identity, place, covariance, size, motion, extent)

    def _settle(self) -> SharedFrame:
        at, self._settled = self._settled, self._settled + 1
        views, maps = self._given.popleft()
        links: list[tuple[float, _Track, _Track]] = []
        alive = [self._alive(k, at) for k in range(self.views)]
        for (i, j), pair in self._pairs.items():
            found = pair.links(alive[i], alive[j], self._linked[i, j])
            self._linked[i, j] = {(a, b) for _, a, b in found}
            links += [(score, (i, a), (j, b)) for score, a, b in found]
        present = [(k, own) for k, view in enumerate(views) for own in identities_of(view).tolist()]
        self._number(_join(present, links))
        named = tuple(self._name(k, view) for k, view in enumerate(views))
        self._seen = {track: seen for track, seen in self._seen.items() if seen[1] >= at - _REMEMBERED}
        self._shared = {track: shared for track, shared in self._shared.items() if track in self._seen}
        return SharedFrame(at + 1, named, tuple(identities_of(view) for view in views), maps)

    def _number(self, groups: Sequence[list["_Track"]]) -> None:
        """Give each group the oldest identity of its tracks that no other group has, or a new identity."""
        taken: set[int] = set()
        known = [(sorted(self._shared[track] for track in group if track in self._shared), group) for group in groups]
        for numbers, group in sorted(known, key=lambda one: (not one[0], one)):
            shared = next((number for number in numbers if number not in taken), 0)
            if not shared:
                shared = self._last = self._last + 1
            taken.add(shared)
            self._shared |= dict.fromkeys(group, shared)

    def _name(self, k: int, view: Tracks | Positions) -> Tracks | Positions:
        shared = np.array([self._shared[k, own] for own in identities_of(view).tolist()], np.int64)
        return replace(view, identity=shared) if isinstance(view, Tracks) else replace(view, target=shared)

    def _alive(self, k: int, at: int) -> np.ndarray:
        """Return the tracks of a view that exist at a moment: first seen then or before, last seen then or later."""
        own = [own for (view, own), (first, last) in self._seen.items() if view == k and first <= at <= last]
        return np.array(own, np.int64)


def _known_motion(motion: np.ndarray | None) -> np.ndarray | None:
    if motion is None or not np.isfinite(motion).all():
        return None
    if np.shape(motion) != (3, 3) or not np.linalg.det(motion):
        raise InputError(f"camera_motion must be an invertible (3, 3) homography, got {np.shape(motion)}")
    return motion


_Track = tuple[int, int]
"""The number of a view, from 0, and the view's own identity of a target."""


def _join(present: Sequence[_Track], links: Sequence[tuple[float, _Track, _Track]]) -> list[list[_Track]]:
    """Group tracks of one target, best links first; a group has at most one track of each view."""
    groups = {track: [track] for track in present}
    for _, one, other in sorted(links, reverse=True):
        if one in groups and other in groups and groups[one] is not groups[other]:
            joined = groups[one] + groups[other]
            if len({view for view, _ in joined}) == len(joined):
                groups |= dict.fromkeys(joined, joined)
    return list({id(group): group for group in groups.values()}.values())


def share_identities(
    tables: Sequence[DetectionTable | Positions], rates_hz: Sequence[float] = (), delay_frames: int = 150
) -> Iterator[SharedFrame]:
    """Share the identities of tables, each of one view; every row needs an identity.

    rates_hz: frame rate of each table; without rates, equal frame numbers are the same moment. All clips begin at the
    same time.
    """
    tracker = MultiViewTracker(len(tables), delay_frames=delay_frames)
    fastest = max(rates_hz, default=1.0)
    slower = [fastest / rate for rate in rates_hz] or [1.0] * len(tables)
    moments = [np.round((table.frame - 1) * step).astype(np.int64) for table, step in zip(tables, slower, strict=True)]
    owns = [_identities(table) for table in tables]
    for moment in np.unique(np.concatenate(moments)).tolist():
        rows = [slice(*np.searchsorted(at, [moment, moment + 1])) for at in moments]
        given = zip(tables, owns, rows, strict=True)
        yield from tracker.update([_view_of(table, own, row, moment) for table, own, row in given])
    yield from tracker.flush()


def _identities(table: DetectionTable | Positions) -> np.ndarray:
    """Return (N,) the table's identities; a row without one gets a unique number."""
    if isinstance(table, Positions):
        return table.target
    own, top = table.targets, int(table.targets.max(initial=0))
    is_known = np.zeros(len(own), bool) if table.identity is None else table.identity > 0
    return np.where(is_known, own, top + 1 + np.arange(len(own)))


def _view_of(table: DetectionTable | Positions, own: np.ndarray, rows: slice, moment: int) -> Tracks | Positions:
    if isinstance(table, Positions):
        return table[rows]
    label, class_id = table.classes(rows)
    frame = int(table.frame[rows][0]) if rows.stop > rows.start else moment + 1
    return Tracks(frame, own[rows], table.box_px[rows], table.score[rows], label=label, class_id=class_id)
