"""GroundLocations targets as Cursor-on-Target events while they come, at most one a target and second."""

import numpy as np

from torchvision_dddas.io.maps.cot import STALE_S, event, event_uid
from torchvision_dddas.io.maps.ellipses import semi_axes
from torchvision_dddas.io.maps.ground_tracks import iso_utc
from torchvision_dddas.io.streams.about import About
from torchvision_dddas.io.streams.json_lines import utc
from torchvision_dddas.types import FrameResult

EVERY_S = 1.0


class CotEvents:
    """Remembers when each target was told last, of those told lately. Feed it frames in order."""

    def __init__(self, about: About) -> None:
        self._about = about
        self._told_s: dict[int, float] = {}
        self._begun_utc_s: float | None = None  # once told it stays: a target keeps its name when the clock is set

    def __call__(self, surveyed: FrameResult | None) -> list[bytes]:
        """The events of a frame, a message with its line end each; of places without longitude or latitude none."""
        grounded = None if surveyed is None else surveyed.grounded
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
            if target in self._told_s or not (abs(longitude) <= 180 and abs(latitude) <= 90):
                continue
            self._told_s[target] = now_s
            uid = event_uid(self._about.source, self._begun_utc_s, target)
            sigma_m, velocity = axes[row, 0], grounded.velocity_m_s[row]
            messages.append(event(uid, target, (time, stale), (longitude, latitude), sigma_m, velocity).encode())
        return messages

    def _utc(self, time_s: float) -> float:
        return self._about.start_utc_s + time_s

    def _forget(self, now_s: float) -> None:
        """Those told a second ago are due again; and after a time before the last one all are."""
        # A hair less, so that the rounding of time stamps costs no event.
        self._told_s = {target: at for target, at in self._told_s.items() if 0 <= now_s - at < EVERY_S - 1e-6}
