"""Targets on the ground as the sinks are given them."""

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.io.maps.ground_tracks import Gathered, GroundTracks
from torchvision_dddas.types import AerialLocations, CameraPose, Fix, LandmarkObservations, Positions

ORIGIN = (-110.95, 32.23)
NAMES = ("alpha", "bravo", "charlie", "delta & <co>")
START = 1_600_000_000.25  # 2020-09-13T12:26:40.250Z

DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
"""Axes of a camera that looks straight down, north up."""


def positions(frame, east_north, covariance=None, origin=ORIGIN, target=None):
    """The targets of a frame, numbered from 1 if not said otherwise; covariance: (2, 2) of all of them."""
    places = np.array(east_north, float).reshape(-1, 2)
    n = len(places)
    return Positions(
        np.full(n, frame),
        np.arange(1, n + 1) if target is None else np.array(target),
        places,
        np.tile(np.eye(2) if covariance is None else np.array(covariance, float), (n, 1, 1)),
        np.full(n, 0.75),
        origin,
        None if origin is None else geometry.lonlat(places, origin),
    )


def grounded(frame, east_north=((1, 2), (3, 4)), by="pose", rate=10.0, states=("used",) * 4, origin=ORIGIN, **rest):
    """A frame; what is not named is as in a good one. rest: more of the fix, or `adjustments`, or `covariance`."""
    at = positions(frame, east_north if by else (), rest.pop("covariance", None), origin)
    n, seen = len(at), len(states)
    adjustments = rest.pop("adjustments", ())
    pose = CameraPose(np.array([0.1 * frame, -5.0, 50.0]), DOWN) if by == "pose" else None
    fix = Fix(frame, by, rest.pop("pose", pose), landmark=np.arange(seen), state=states, **rest)
    marks = LandmarkObservations(
        np.arange(seen),
        np.zeros((seen, 2)),
        np.array([[-20, -20], [20, -20], [20, 20], [-20, 20.0]])[:seen],
        np.full(seen, 0.7),
        np.ones(seen),
        np.zeros(seen),
    )
    velocity = np.tile((3.0, 4.0), (n, 1))
    return AerialLocations(
        frame,
        (frame - 1) / rate,
        at,
        np.arange(n),
        at.covariance_m2 / 4,
        velocity,
        np.zeros((2, 4)),
        fix,
        marks,
        adjustments,
    )


def tracks(frames, start_utc_s=START, rate=10.0, timed=True) -> GroundTracks:
    """What is kept of frames' positions."""
    kept = Gathered()
    for at in frames:
        kept.add(at, (int(at.frame[0]) - 1) / rate if timed else float("nan"), np.tile((0.0, 2.0), (len(at), 1)))
    return kept.tracks(frames[0].lonlat_deg is not None if frames else True, start_utc_s)
