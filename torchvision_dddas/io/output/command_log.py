"""What the instruments were asked to do, in words, where it is new."""

from collections.abc import Collection

import numpy as np

from torchvision_dddas.io.output.run_log import ORDERED, RunLog
from torchvision_dddas.io.overlay.layers import ToMetres, command_metres
from torchvision_dddas.types import FrameResult, Order

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
        scale = command_metres(surveyed)
        if command.look_at is not None and UAV not in explained and self._new(UAV, command.look_at, scale):
            height = "" if command.altitude_m is None else f" from {command.altitude_m:.0f} m"
            log.add(frame, ORDERED, f"the UAV keeps {_place(command.look_at, scale)} in view{height}", short="UAV sent")
        for order in command.orders:
            if order.vehicle not in explained and self._new(order.vehicle, order.goal, scale):
                log.add(frame, ORDERED, _words(order, scale), short=f"{order.vehicle} sent")

    def _new(self, who: str, goal: np.ndarray, scale: ToMetres | None) -> bool:
        there = np.asarray(goal, float) if scale is None else scale(goal)
        far = _FAR_M if scale is not None else 0.0
        last = self._goal.get(who)
        if last is not None and float(np.linalg.norm(there - last)) <= far:
            return False
        self._goal[who] = there
        return True


def _place(place: np.ndarray, scale: ToMetres | None) -> str:
    if scale is None:
        return "{:.7g}, {:.7g}".format(*place)
    return "({:.1f}, {:.1f}) m".format(*scale(place))


def _words(order: Order, scale: ToMetres | None) -> str:
    text = f"{order.vehicle} goes to {_place(order.goal, scale)} at {order.speed_m_s:g} m/s"
    if order.look_at is not None:
        text += f" and looks at {_place(order.look_at, scale)}"
    return text
