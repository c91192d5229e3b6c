"""Detect when crowds join, split, gather and scatter on the ground, by the distances between their rims."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from torchvision_dddas.types import Bool, Float, Int, ZoneEvent

# A crowd that has been seen for this time is settled. Only settled crowds have events. Parts that have been apart for
# this time have split.
_SETTLED_S = 2.0
# Crowds that have been together for this time have joined: two crowds of 2.5 m that walk at 1 m/s need 11 s to pass.
_PASSING_S = 15.0
# Targets faster than running people, over `_SETTLED_S`, are not crowds, and have no events.
_FASTEST_M_S = 4.0
# A crowd splits at `join_m` plus this slack. A part may move this far before it becomes a separate blob, and places and
# radii jitter by less.
_SLACK_M = 2.0
# Two joins of one crowd within _GATHER_S are a gathering, two splits within _SCATTER_S a scattering.
_GATHER_S, _SCATTER_S = 20.0, 5.0


@dataclass(eq=False)
class _Blob:
    """A target with one identity: its last place in metres, the times when it was seen, and its crowd.

    crowd: 0 for none yet. mark: its time and place `_SETTLED_S` ago, or less. drives: whether it was ever too fast.
    """

    identity: int
    first_s: float
    last_s: float
    place_m: np.ndarray
    radius_m: float
    at_edge: bool
    mark: tuple[float, np.ndarray]
    crowd: int = 0
    drives: bool = False

    @property
    def is_settled(self) -> bool:
        """Whether the blob has been seen long enough to have events."""
        return self.last_s - self.first_s >= _SETTLED_S

    def follow(self, before: "_Blob") -> None:
        """Take over the history of the same blob from its previous sighting."""
        self.first_s, self.crowd, self.mark, self.drives = before.first_s, before.crowd, before.mark, before.drives
        lapse = self.last_s - self.mark[0]
        if lapse >= _SETTLED_S:
            self.drives |= float(np.hypot(*(self.place_m - self.mark[1]))) > _FASTEST_M_S * lapse
            self.mark = self.last_s, self.place_m

    def gap_m(self, other: "_Blob") -> float:
        """Return the gap between the rims of two blobs."""
        return float(np.hypot(*(self.place_m - other.place_m))) - self.radius_m - other.radius_m


@dataclass(frozen=True)
class _Change:
    """A possible join or split. host: the other crowd. frame, time_s, place_m: when and where it began."""

    host: int
    frame: int
    time_s: float
    place_m: np.ndarray


@dataclass
class CrowdEvents:
    """Events of crowds, which are targets up to join_m apart. Feed it the identities of `CrowdIdentities` in order.

    Crowds join if they come within join_m of each other, or share a blob, and are still together 15 s later. A crowd
    splits if parts of it have been more than join_m plus 2 m apart for 2 s. An event is therefore reported some seconds
    after its time, which is the time when the crowds met or parted.
    """

    join_m: float
    _blobs: dict[int, _Blob] = field(default_factory=dict)
    _joining: dict[int, _Change] = field(default_factory=dict)  # by crowd
    _splitting: dict[int, _Change] = field(default_factory=dict)  # by blob
    _told: list[ZoneEvent] = field(default_factory=list)

    def update(
        self,
        frame: int,
        time_s: float,
        identity: Int[np.ndarray, " N"],
        place_m: Float[np.ndarray, "N 2"],
        radius_m: Float[np.ndarray, " N"],
        at_edge: Bool[np.ndarray, " N"] | None = None,
    ) -> list[ZoneEvent]:
        """Return the events that a frame settles. place_m, radius_m: NaN if unknown; such crowds count as not seen.

        at_edge: whether the picture's edge cuts a crowd, which may then appear or vanish without an event.
        """
        edge = np.zeros(len(identity), bool) if at_edge is None else at_edge
        seen = []
        for k in np.flatnonzero(np.isfinite(place_m).all(axis=1) & np.isfinite(radius_m)):
            mark = time_s, place_m[k]
            blob = _Blob(int(identity[k]), time_s, time_s, place_m[k], float(radius_m[k]), bool(edge[k]), mark)
            blob.follow(self._blobs.get(blob.identity, blob))
            self._blobs[blob.identity] = blob
            if blob.drives:
                self._joining.pop(blob.identity, None)
            else:
                seen.append(blob)
        groups = self._group(seen)
        self._meet(frame, time_s, groups)
        self._part(frame, time_s, groups)
        events = [*self._settle_splits(time_s, groups), *self._settle_joins(time_s)]
        self._blobs = {n: b for n, b in self._blobs.items() if time_s - b.last_s <= _PASSING_S}
        return events

    def flush(self) -> list[ZoneEvent]:
        """Return the joins that are open at the end of a clip, if half of their time has passed."""
        now_s = max((blob.last_s for blob in self._blobs.values()), default=0.0)
        self._splitting.clear()
        return list(self._settle_joins(now_s, 0.5))

    def _group(self, seen: list[_Blob]) -> list[list[_Blob]]:
        """Group blobs that are together, by single linkage; former groups stay together for a little further."""
        groups: list[list[_Blob]] = []
        for blob in seen:
            near = [group for group in groups if any(self._is_together(blob, other) for other in group)]
            groups = [group for group in groups if group not in near]
            groups.append([blob, *(other for group in near for other in group)])
        for group in groups:  # a new blob joins the crowd beside it, except at the edge
            for blob in sorted((blob for blob in group if not blob.is_settled), key=lambda blob: blob.first_s):
                known = [other for other in group if other.crowd and other is not blob and not blob.at_edge]
                nearest = min(known, key=lambda other: (not other.is_settled, blob.gap_m(other)), default=blob)
                blob.crowd = nearest.crowd or blob.identity
        return groups

    def _is_together(self, one: _Blob, other: _Blob) -> bool:
        hosts = [self._joining[b.crowd].host for b in (one, other) if b.crowd in self._joining]
        crowds = {one.crowd, other.crowd}
        were = len(crowds) == 1 or 0 in crowds or crowds.intersection(hosts)
        return one.gap_m(other) <= self.join_m + (_SLACK_M if were else 0.0)

    def _meet(self, frame: int, time_s: float, groups: list[list[_Blob]]) -> None:
        """Begin possible joins of crowds that have met, and end those of crowds that have parted."""
        here = {blob.crowd for group in groups for blob in group}
        for group in groups:
            hosts = {change.host for change in self._joining.values()}
            settled = [blob for blob in group if blob.is_settled]
            settled.sort(key=lambda blob: (blob.crowd not in hosts, blob.first_s, blob.identity))
            for blob in settled[1:]:
                if blob.crowd not in {settled[0].crowd, *hosts}:
                    self._joining.setdefault(blob.crowd, _Change(settled[0].crowd, frame, time_s, blob.place_m))
            crowds = {blob.crowd for blob in group}
            apart = [c for c in crowds & self._joining.keys() if self._joining[c].host in here - crowds]
            self._joining = {c: change for c, change in self._joining.items() if c not in apart}
        for crowd, change in list(self._joining.items()):
            if change.host not in here and crowd in here:  # the host is the crowd that is still seen
                del self._joining[crowd]
                self._joining[change.host] = replace(change, host=crowd)
        settled = [blob for group in groups for blob in group if blob.is_settled]
        met = {*here, *self._joining, *(change.host for change in self._joining.values())}
        for blob in self._blobs.values():
            near = [other for other in settled if blob.gap_m(other) <= self.join_m]
            has_gone = blob.crowd not in met and time_s - blob.last_s <= _SETTLED_S
            if near and has_gone and blob.is_settled and not blob.at_edge:
                host = min(near, key=blob.gap_m).crowd
                self._joining[blob.crowd] = _Change(host, frame, blob.last_s, blob.place_m)

    def _part(self, frame: int, time_s: float, groups: list[list[_Blob]]) -> None:
        """Begin a possible split for each part of a crowd that is away from its main part."""
        seen = sorted((b for group in groups for b in group), key=lambda b: (b.identity == b.crowd, b.radius_m))
        main = {blob.crowd: blob for blob in seen}
        for group in groups:
            for blob in group:
                if main[blob.crowd] in group:
                    self._splitting.pop(blob.identity, None)
                else:
                    self._splitting.setdefault(blob.identity, _Change(blob.crowd, frame, time_s, blob.place_m))

    def _settle_splits(self, time_s: float, groups: list[list[_Blob]]) -> Iterator[ZoneEvent]:
        lost = [n for n in self._splitting if time_s - self._blobs[n].last_s > _SETTLED_S or self._blobs[n].drives]
        self._splitting = {n: change for n, change in self._splitting.items() if n not in lost}
        for number, change in list(self._splitting.items()):
            group = next((group for group in groups if self._blobs[number] in group), None)
            if number not in self._splitting or group is None or time_s - change.time_s < _SETTLED_S:
                continue
            hidden = [crowd for crowd, other in self._joining.items() if other.host == change.host]
            apart = [self._blobs[n] for n, other in self._splitting.items() if other.host == change.host]
            for blob in [b for b in apart if any(self._is_together(b, other) for other in group)]:
                del self._splitting[blob.identity]
                blob.crowd = hidden[0] if hidden else number
            if hidden:  # the crowd hidden behind its host has reappeared
                del self._joining[hidden[0]]
            else:
                yield from self._tell("split", "scatter", number, change, _SCATTER_S)

    def _settle_joins(self, time_s: float, share: float = 1.0) -> Iterator[ZoneEvent]:
        """Yield the joins that are settled. share: required share of the time for which a join stays open."""
        for number, change in list(self._joining.items()):
            host = change.host
            is_back = any(other.host == host for other in self._splitting.values())  # the crowd may have reappeared
            if time_s - change.time_s < share * _PASSING_S or is_back:
                continue
            del self._joining[number]
            for blob in self._blobs.values():
                blob.crowd = host if blob.crowd == number else blob.crowd
            others = self._joining.items()
            self._joining = {n: replace(c, host=host) if c.host == number else c for n, c in others}
            if not any(blob.drives for blob in self._blobs.values() if blob.identity == number):
                yield from self._tell("join", "gather", number, change, _GATHER_S)

    def _tell(self, kind: str, many: str, number: int, change: _Change, within_s: float) -> Iterator[ZoneEvent]:
        """Yield the event, and a gathering or scattering if the same crowd had such an event shortly before."""
        where = {"frame": change.frame, "time_s": change.time_s, "east_north_m": change.place_m}
        event = ZoneEvent(kind, "", change.host, others=(number,), **where)  # type: ignore[arg-type]
        yield event
        self._told = [e for e in self._told if change.time_s - e.time_s <= within_s or e.kind not in (kind, many)]
        if kind == "join":  # crowds that joined the joining crowd now belong to the host
            self._told = [replace(e, target=change.host) if e.target == number else e for e in self._told]
        same = [e for e in self._told if e.kind == kind and e.target == change.host]
        if same and not any(e.kind == many and e.target == change.host for e in self._told):
            others = (*(n for e in same for n in e.others), number)
            self._told.append(ZoneEvent(many, "", change.host, others=others, **where))  # type: ignore[arg-type]
            yield self._told[-1]
        self._told.append(event)
