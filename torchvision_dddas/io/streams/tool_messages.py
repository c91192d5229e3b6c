"""A frame as messages for other tools: rows of MOTChallenge text, and Cursor-on-Target events."""

from dataclasses import replace

import numpy as np

from torchvision_dddas.io.maps import STALE_S, event, event_uid, iso_utc, semi_axes
from torchvision_dddas.io.output.tables import track_rows
from torchvision_dddas.io.streams.json_lines import utc
from torchvision_dddas.io.streams.stream import About
from torchvision_dddas.io.tables import MOT_TRACKS
from torchvision_dddas.types import FrameResult, TrackedFrame

PEOPLE_FROM = 1_000_000
"""Added to the identities of people, who are tracked apart from targets: the format has no column for a kind."""

_FARTHEST_PX = 1e7
EVERY_S = 1.0
"""Seconds between two events of a target."""


def mot_rows(result: FrameResult | None, people: TrackedFrame | None, most_bytes: int = 0) -> list[bytes]:
    """`frame,identity,x,y,width,height,score,-1,-1,-1`, a line per box with an identity: targets, then people.

    One message per frame, or several of whole lines if it is longer than most_bytes. Infinite boxes are left out.
    """
    text = "" if result is None else MOT_TRACKS.format_rows(track_rows(_with_identity(result.tracked, 0)))
    text += "" if people is None else MOT_TRACKS.format_rows(track_rows(_with_identity(people, PEOPLE_FROM)))
    messages = [b""]
    for line in text.encode("ascii").splitlines(keepends=True):
        if messages[-1] and 0 < most_bytes < len(messages[-1]) + len(line):
            messages.append(b"")
        messages[-1] += line
    return [message for message in messages if message]


def _with_identity(followed: TrackedFrame, more: int) -> TrackedFrame:
    tracks = followed.tracks
    shown = np.isfinite(tracks.score) & (np.abs(tracks.box_px) < _FARTHEST_PX).all(axis=1)
    rows = replace(
        tracks,
        identity=tracks.identity[shown] + more,
        box_px=tracks.box_px[shown],
        score=tracks.score[shown],
        row=tracks.row[shown],
    )
    return replace(followed, tracks=rows)


class CotEvents:
    """Cursor-on-Target events of frames, given in order: at most one per target and second."""

    def __init__(self, about: About) -> None:
        self._about = about
        self._sent_s: dict[int, float] = {}
        self._begun_utc_s: float | None = None  # stays when the clock is set, so that targets keep their uid

    def __call__(self, result: FrameResult | None) -> list[bytes]:
        """The events of a frame, a message with its line end each; none for places without longitude and latitude."""
        grounded = None if result is None else result.locations
        degrees = None if grounded is None else grounded.positions.lonlat_deg
        if grounded is None or degrees is None or utc(self._utc(grounded.time_s)) is None:
            return []
        if self._begun_utc_s is None:
            self._begun_utc_s = self._about.start_utc_s
        self._forget(grounded.time_s)
        at, now_s = grounded.positions, grounded.time_s
        axes, _ = semi_axes(at.covariance_m2, chi2=1.0)
        time, stale = iso_utc(np.array([self._utc(now_s), self._utc(now_s + STALE_S)]))
        messages = []
        for row, target in enumerate(at.target.tolist()):
            longitude, latitude = degrees[row].tolist()
            if target in self._sent_s or not (abs(longitude) <= 180 and abs(latitude) <= 90):
                continue
            self._sent_s[target] = now_s
            uid = event_uid(self._about.source, self._begun_utc_s, target)
            sigma_m, velocity = axes[row, 0], grounded.velocity_m_s[row]
            messages.append(event(uid, target, (time, stale), (longitude, latitude), sigma_m, velocity).encode())
        return messages

    def _utc(self, time_s: float) -> float:
        return self._about.start_utc_s + time_s

    def _forget(self, now_s: float) -> None:
        """Forget targets sent a second ago; all of them where time went back."""
        # Rounded time stamps must not skip an event.
        self._sent_s = {target: at for target, at in self._sent_s.items() if 0 <= now_s - at < EVERY_S - 1e-6}
