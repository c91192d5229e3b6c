"""What the instruments were asked to do, in words, where it is new."""

import math
from collections.abc import Collection

import numpy as np

from torchvision_dddas.io.output.run_log import ORDERED, RunLog
from torchvision_dddas.types import AerialLocations, Command, FrameResult, Order

_FAR_M = 15.0
"""A goal that moved by less is the same: it goes with a crowd."""
UAV = "uav"


class Orders:
    """Remembers what was asked for last."""

    def __init__(self) -> None:
        self._goal: dict[str, np.ndarray] = {}

    def note(self, surveyed: FrameResult, log: RunLog, explained: Collection[str] = ()) -> None:
        """Tell of a frame's orders what is new in them, but for those of `explained`: adjustments tell of them."""
        command, frame = surveyed.command, surveyed.followed.number
        if command is None:
            return
        scale = metres(surveyed)
        if command.look_at is not None and UAV not in explained and self._new(UAV, command.look_at, scale):
            height = "" if command.altitude_m is None else f" from {command.altitude_m:.0f} m"
            log.add(frame, ORDERED, f"the UAV keeps {_place(command.look_at, scale)} in view{height}", short="UAV sent")
        for order in command.orders:
            if order.vehicle not in explained and self._new(order.vehicle, order.goal, scale):
                log.add(frame, ORDERED, _words(order, scale), short=f"{order.vehicle} sent")

    def _new(self, who: str, goal: np.ndarray, scale: "Metres | None") -> bool:
        there = np.asarray(goal, float) if scale is None else scale(goal)
        far = _FAR_M if scale is not None else 0.0
        last = self._goal.get(who)
        if last is not None and float(np.linalg.norm(there - last)) <= far:
            return False
        self._goal[who] = there
        return True


class Metres:
    """Local metres of places in degrees near those of which both are known."""

    def __init__(self, degrees: np.ndarray, east_north_m: np.ndarray) -> None:
        """degrees, east_north_m: (n, 2) of the same places, two or more that differ along both axes."""
        self._degree, self._metre = degrees.mean(axis=0), east_north_m.mean(axis=0)
        self._scale = np.ptp(east_north_m, axis=0) / np.ptp(degrees, axis=0)

    def __call__(self, place: np.ndarray) -> np.ndarray:
        """(2,) east, north. What is no such longitude and latitude are local metres already: so the steering speaks."""
        if np.abs(np.asarray(place, float) - self._degree).max() > 1.0:
            return np.asarray(place, float)
        return self._metre + (np.asarray(place, float) - self._degree) * self._scale


class _Same(Metres):
    def __init__(self) -> None:
        pass

    def __call__(self, place: np.ndarray) -> np.ndarray:
        return np.asarray(place, float)


def metres(surveyed: FrameResult) -> Metres | None:
    """What turns the places of orders into local metres; None where this frame does not tell."""
    grounded, degrees = surveyed.grounded, surveyed.mark_lonlat_deg
    if grounded is None:
        return None
    if degrees is None:
        return _Same()
    both = np.isfinite(degrees).all(axis=1) & np.isfinite(grounded.marks.east_north_m).all(axis=1)
    # Apart by some metres along both axes, else the scale is told by rounding.
    if both.sum() < 2 or (np.ptp(grounded.marks.east_north_m[both], axis=0) < 1.0).any():
        return None
    return Metres(degrees[both], grounded.marks.east_north_m[both])


def _place(place: np.ndarray, scale: Metres | None) -> str:
    if scale is None:
        return "{:.7g}, {:.7g}".format(*place)
    return "({:.1f}, {:.1f}) m".format(*scale(place))


def _words(order: Order, scale: Metres | None) -> str:
    text = f"{order.vehicle} goes to {_place(order.goal, scale)} at {order.speed_m_s:g} m/s"
    if order.look_at is not None:
        text += f" and looks at {_place(order.look_at, scale)}"
    return text


def in_picture(grounded: AerialLocations) -> np.ndarray | None:
    """(2, 2) pixels to the right and down of a metre to the east and north about the landmarks; None where unknown."""
    marks = grounded.marks
    both = np.isfinite(marks.image_px).all(axis=1) & np.isfinite(marks.east_north_m).all(axis=1)
    place, pixel = marks.east_north_m[both], marks.image_px[both]
    if len(place) < 3:
        return None
    apart = place - place.mean(axis=0)
    if np.linalg.svd(apart, compute_uv=False)[-1] < 1.0:  # all but on one line
        return None
    return np.asarray(np.linalg.lstsq(apart, pixel - pixel.mean(axis=0), rcond=None)[0].T)


def summary(command: Command) -> str:
    """A command in a few words."""
    words = [f"every {command.every}"] if command.every > 1 else []
    sent = [order.vehicle for order in command.orders]
    if sent:
        words.append(f"sent: {', '.join(sent)}")
    if command.altitude_m is not None and math.isfinite(command.altitude_m):
        words.append(f"fly at {command.altitude_m:.0f} m")
    return "; ".join(words)
