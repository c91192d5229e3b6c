"""Conditions of a simulated radio link: latency, jitter, loss, dropouts and the vehicle's clock."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from torchvision_dddas.errors import InputError

_RANGES = {"latency": (0.0, 60.0), "jitter": (0.0, 60.0), "loss": (0.0, 1.0), "clock": (-1e9, 1e9)}


@dataclass(frozen=True)
class LinkConditions:
    """Conditions of a link in both directions.

    latency: shortest delay, seconds. jitter: largest additional delay, seconds, uniform. loss: share of lost datagrams
    and messages. clock: the vehicle's clock is ahead by this time, seconds. dropout: the link is silent for the first
    number of seconds at the end of each period of the second number.
    """

    latency: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    clock: float = 0.0
    dropout: tuple[float, float] = (0.0, math.inf)


def parse_link(text: str) -> LinkConditions:
    """Parse the text of --link. Raise InputError for unknown names and values out of range.

    >>> parse_link("latency=0.5,dropout=2/20").dropout
    (2.0, 20.0)
    """
    values: dict[str, Any] = {}
    for part in text.split(","):
        name, _, given = part.strip().partition("=")
        try:
            numbers = tuple(map(float, given.split("/")))
            if name == "dropout":
                silent_s, every_s = values[name] = numbers
                is_right = 0 <= silent_s < every_s < math.inf
            else:
                (values[name],) = numbers
                is_right = _RANGES[name][0] <= numbers[0] <= _RANGES[name][1]
        except (ValueError, KeyError):
            is_right = False
        if not is_right:
            wanted = "latency=S,jitter=S,loss=SHARE,dropout=S/EVERY_S,clock=S, such as latency=0.5,loss=0.05"
            raise InputError(f"--link {text}: {part!r} is no condition of a link; wanted {wanted}")
    return LinkConditions(**values)


class LinkDelay:
    """Decides when each datagram or message of one direction arrives. They arrive in the order of sending."""

    def __init__(self, conditions: LinkConditions, seed: int, stream: int) -> None:
        """stream: number of the direction, so that directions with the same seed differ."""
        self.conditions, self._rng = conditions, np.random.default_rng([seed, 90, stream])
        self._begin_s, self._last_s = time.monotonic(), -math.inf

    def arrival_s(self, now_s: float) -> float:
        """Return when it arrives if something is sent at a time; NaN if it is lost."""
        here, (silent_s, every_s) = self.conditions, self.conditions.dropout
        chance, late = self._rng.uniform(size=2).tolist()
        if chance < here.loss or (silent_s and (now_s - self._begin_s) % every_s >= every_s - silent_s):
            return math.nan
        self._last_s = max(self._last_s, now_s + here.latency + here.jitter * late)
        return self._last_s


class DelayedWriter:
    """Calls `write` with each item when the item arrives, in a thread of its own if the link has a delay."""

    def __init__(self, write: Callable[[Any], object], delay: LinkDelay) -> None:
        self._write, self._delay, self._closing = write, delay, False
        self._waiting, self._changed = deque[tuple[float, Any]](), threading.Condition()
        self._thread: threading.Thread | None = None
        if delay.conditions.latency or delay.conditions.jitter:
            self._thread = threading.Thread(target=self._run, name="link", daemon=True)
            self._thread.start()

    def send(self, item: Any) -> None:
        """Send an item. It may be lost."""
        arrival_s = self._delay.arrival_s(time.monotonic())
        if self._thread is None and not math.isnan(arrival_s):
            self._write(item)
        elif not math.isnan(arrival_s):
            with self._changed:
                self._waiting.append((arrival_s, item))
                self._changed.notify()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the thread. Items that have not arrived are lost."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._closing and (not self._waiting or self._waiting[0][0] > time.monotonic()):
                    self._changed.wait(max(0.0, self._waiting[0][0] - time.monotonic()) if self._waiting else None)
                if self._closing:
                    return
                item = self._waiting.popleft()[1]
            self._write(item)
