"""Results of a pipeline with targets that walk given ways, for the tests of zones and summaries."""

import numpy as np

from torchvision_dddas.geometry import lonlat
from torchvision_dddas.types import (
    AerialLocations,
    CameraPose,
    Detections,
    Fix,
    Frame,
    FrameResult,
    LandmarkObservations,
    Positions,
    TrackedFrame,
    Tracks,
)

ORIGIN = (-110.95, 32.23)
ABOVE = CameraPose(np.array([0.0, 0, 30]), np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]))


def result(frame, places, rate_hz=5.0, located=True, origin=ORIGIN, labels=None, motion=None, sigma_m=2.0):
    """A frame in which target k is at places[k - 1], metres east and north, or nowhere (None); 10 px a metre."""
    there = [k for k, place in enumerate(places) if place is not None]
    at, n = np.array([places[k] for k in there], float).reshape(-1, 2), len(there)
    unknown, time_s = np.full(n, np.nan), (frame - 1) / rate_hz
    # The middle of the lower edge is at 10 px a metre, north upward from v = 200.
    boxes = np.c_[at * (10, -10) + (-1.5, 200 - 7), np.full((n, 2), (4.0, 8.0))]
    named = np.array([(labels or {}).get(k + 1, "") for k in there], object)
    tracks = Tracks(frame, np.array(there, int) + 1, boxes, np.ones(n), np.arange(n), label=named)
    picture = Frame(frame, time_s, np.zeros((240, 320), np.uint8))
    found = Detections(boxes, np.ones(n), unknown, unknown, unknown)
    tracked = TrackedFrame(frame, picture, found, tracks, motion)
    if not located:
        return FrameResult(tracked)
    degrees = None if origin is None else lonlat(at, origin)
    variance = np.tile(sigma_m**2 * np.eye(2), (n, 1, 1))
    positions = Positions(np.full(n, frame), np.array(there, int) + 1, at, variance, np.ones(n), origin, degrees)
    rest = np.arange(n), variance, np.full((n, 2), np.nan), boxes, Fix(frame, "pose", ABOVE), LandmarkObservations()
    return FrameResult(tracked, AerialLocations(frame, time_s, positions, *rest))


def walk(*ways, seconds=12.0, rate_hz=5.0, noise_m=0.0, seed=0, **how):
    """The results of targets whose places are functions of the time."""
    rng = np.random.default_rng(seed)
    for k in range(int(seconds * rate_hz)):
        at = [way(k / rate_hz) for way in ways]
        at = [None if place is None else np.array(place) + rng.normal(0, 1, 2) * noise_m for place in at]
        yield result(k + 1, at, rate_hz, **how)
