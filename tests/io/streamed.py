"""Frames as the streams are given them."""

import numpy as np

from tests.io.ground import NAMES, ORIGIN, START, grounded
from torchvision_dddas.io.streams import About
from torchvision_dddas.types import Confirmation, Detections, Frame, FrameResult, TrackedFrame, Tracks

ABOUT = About(START, geographic=True, landmarks=NAMES)


def tracked(number=1, targets=2, kind="moving", rate=10.0, **rest):
    """Targets of which the last is a box between two detections; and a detection that has no identity."""
    boxes = np.array([[10.0 * k, 20.0, 30.0, 40.0] for k in range(1, targets + 2)])
    seen = targets - 1 if targets > 1 else targets
    heading, speed = np.full((2, seen + 1), np.nan)
    heading[0], speed[0] = -np.pi / 2, 1.5
    area = np.full(seen + 1, 64.0)
    found = Detections(boxes[[*range(seen), targets]], np.full(seen + 1, 0.875), area, heading, speed, kind)
    rows = np.array([*range(seen), -1][:targets], np.int64)
    link = np.where(rows >= 0, 0.75, np.nan)
    tracks = Tracks(number, np.arange(1, targets + 1), boxes[:targets], np.full(targets, 0.875), rows, link)
    frame = Frame(number, (number - 1) / rate, np.zeros((4, 4), np.uint8), taken_s=rest.pop("taken_s", float("nan")))
    return TrackedFrame(number, frame, found, tracks, **rest)


def located(number=1, targets=2, origin=ORIGIN, on_ground=True, rate=10.0, **rest):
    """A frame of which every target but the last is located."""
    own = tracked(number, targets, rate=rate, **rest)
    if not on_ground:
        return FrameResult(own)
    ground = grounded(number, [(k, 2 * k) for k in range(targets - 1)], rate=rate, origin=origin)
    degrees = None if origin is None else np.tile(ORIGIN, (len(ground.marks), 1))
    n, ones = targets - 1, np.ones(targets - 1)
    people = Confirmation(
        *(number, np.arange(n), ("human",) * n, np.full(n, 0.75), (("alpha",),) * n),
        *(np.ones(n, np.int64), ones, ones, ones),
    )
    return FrameResult(own, ground, ("motion",) * 4, degrees, people)
