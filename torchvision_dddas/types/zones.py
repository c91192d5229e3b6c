"""Zones of the ground or of the picture, and the events of targets at zones."""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.types.record import Record


@dataclass(frozen=True)
class Zone(Record):
    """A named area, or a line that targets cross.

    rings: outlines (N, 2) of an area, without a repeated first point; rings in rings are holes. For a line, its pieces.
    unit: deg (WGS84, longitude and latitude), m (the run's local metres, east and north) or px (u, v of the picture).
    dwell_s: a target that has been inside for this time dwells.

    >>> td.Zone("door", (np.array([[0.0, 0], [4, 0], [4, 3]]),), unit="m")
    Zone(name='door', rings=1 item, unit='m')
    """

    name: str
    rings: tuple[np.ndarray, ...]
    is_line: bool = False
    unit: str = "deg"
    dwell_s: float = 10.0


def _unknown() -> np.ndarray:
    return np.full(2, np.nan)


@dataclass(frozen=True)
class ZoneEvent(Record):
    """An event of a target at a zone, or of a crowd with other crowds. Unknown values are NaN, unknown texts empty.

    kind: enter, leave, present (inside when first seen), dwell, or cross (a line). direction: to_right or to_left of
    the line in its direction, for a crossing. frame, time_s: frame and time of the event. The moment when the target
    passed the border is interpolated between two frames; `frame` is the later frame. east_north_m, lonlat_deg,
    image_px: (2,) the target's place at that moment. speed_m_s, or speed_px_s at a zone in pixels. inside_s: time that
    it has been inside (leave, dwell). is_first: whether the target has not been counted at this zone before. others:
    the crowds that join the target or split off it. The kinds of these events are join, split, gather and scatter.
    Their zone is empty; frame, time_s and the place state where the other crowd was last (join) or first (split) seen
    alone.

    >>> td.ZoneEvent("enter", "door", target=7, frame=12, time_s=1.2, speed_m_s=1.4).describe()
    'target 7 enters door at 1.4 m/s'
    """

    kind: str
    zone: str
    target: int
    frame: int
    time_s: float
    label: str = ""
    class_id: int = -1
    is_first: bool = False
    direction: str = ""
    inside_s: float = float("nan")
    speed_m_s: float = float("nan")
    speed_px_s: float = float("nan")
    east_north_m: np.ndarray = field(default_factory=_unknown)
    lonlat_deg: np.ndarray = field(default_factory=_unknown)
    image_px: np.ndarray = field(default_factory=_unknown)
    others: tuple[int, ...] = ()

    def describe(self) -> str:
        """Return the event in words."""
        if self.others:
            ways = {"join": "joined by", "gather": "joined by", "split": "left by", "scatter": "left by"}
            return f"{self.kind}: crowd {self.target} is {ways[self.kind]} {' and '.join(map(str, self.others))}"
        words = {"enter": "enters", "leave": "leaves", "present": "is seen in", "dwell": "dwells in"}
        text = f"target {self.target} {words.get(self.kind, 'crosses')} {self.zone}"
        text += f" {self.direction.replace('_', ' the ')}" if self.direction else ""
        return text + (f" at {self.speed_m_s:.1f} m/s" if self.speed_m_s == self.speed_m_s else "")


def most_common(classes: Counter[tuple[str, int]]) -> tuple[str, int]:
    """Return the most frequent label and number among a target's boxes; "" and -1 if none has any.

    >>> from collections import Counter
    >>> types.most_common(Counter({("", -1): 9, ("car", 2): 5, ("bus", 5): 1}))
    ('car', 2)
    """
    known = [one for one in classes if one != ("", -1)]
    return max(known, key=lambda one: classes[one], default=("", -1))
