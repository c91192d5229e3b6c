"""Frames as the streams are given them, and outlets that fail when told to."""

import errno
import os

import numpy as np

from tests.io.ground import ORIGIN, START, grounded
from torchvision_dddas.io.streams import About
from torchvision_dddas.types import Confirmation, Detections, Frame, FrameResult, TrackedFrame, Tracks

NAMES = ("alpha", "bravo", "charlie", "delta & <co>")
ABOUT = About(START, geographic=True, landmarks=NAMES)


def followed(number=1, targets=2, kind="moving", rate=10.0, **rest):
    """Targets of which the last is a box between two detections; and a detection that has no identity."""
    boxes = np.array([[10.0 * k, 20.0, 30.0, 40.0] for k in range(1, targets + 2)])
    seen = targets - 1 if targets > 1 else targets
    unknown = np.full(seen + 1, np.nan)
    heading, speed = unknown.copy(), unknown.copy()
    heading[0], speed[0] = -np.pi / 2, 1.5
    detected = boxes[[*range(seen), targets]]
    found = Detections(detected, np.full(seen + 1, 0.875), np.full(seen + 1, 64.0), heading, speed, kind)
    rows = np.array([*range(seen), -1][:targets], np.int64)
    tracks = Tracks(number, np.arange(1, targets + 1), boxes[:targets], np.full(targets, 0.875), rows)
    frame = Frame(number, (number - 1) / rate, np.zeros((4, 4), np.uint8), taken_s=rest.pop("taken_s", float("nan")))
    return TrackedFrame(number, frame, found, tracks, **rest)


def surveyed(number=1, targets=2, origin=ORIGIN, on_ground=True, rate=10.0, **rest):
    """A frame of which every target but the last is located."""
    own = followed(number, targets, rate=rate, **rest)
    if not on_ground:
        return FrameResult(own)
    places = [(k, 2 * k) for k in range(targets - 1)]
    ground = grounded(number, places, rate=rate, origin=origin)
    degrees = None if origin is None else np.tile(ORIGIN, (len(ground.marks), 1))
    seen = len(places)
    confirmed = Confirmation(
        number,
        np.arange(seen),
        ("human",) * seen,
        np.full(seen, 0.75),
        (("alpha",),) * seen,
        np.ones(seen, np.int64),
        np.ones(seen),
        np.ones(seen),
        np.ones(seen),
    )
    return FrameResult(own, ground, ("motion",) * 4, degrees, confirmed)


class Clock:
    """A clock that stands still until it is set."""

    def __init__(self):
        self.now_s = 100.0

    def __call__(self):
        return self.now_s


class Told(list):
    """What a stream told."""

    def __call__(self, kind, text):
        assert kind == "sink"
        self.append(text)


class FlakyOutlet:
    """Takes messages while `trouble` is None and somebody reads, keeps the last otherwise; counts the attempts."""

    def __init__(self, most_bytes=0, kept=1000):
        self.most_bytes, self.most_kept = most_bytes, kept
        self.lost, self.reason, self.trouble = 0, "it is read too slowly", None
        self.kept, self.got, self.attempts = [], [], 0
        self.closed, self.read, self.path = False, True, None

    def put(self, messages):
        self.kept += messages
        self.lost += max(0, len(self.kept) - self.most_kept)
        self.kept = self.kept[-self.most_kept :]

    def flush(self):
        self.attempts += 1
        if self.trouble is not None:
            raise OSError(self.trouble, {errno.ENOSPC: "No space left on device"}.get(self.trouble, "broken"))
        if self.read:
            self.got += self.kept
            self.kept = []

    def mend(self):
        pass

    def handle(self):
        return None if self.path is None else os.open(self.path, os.O_CREAT | os.O_WRONLY)

    def close(self):
        self.closed = True
        self.lost += len(self.kept)
