"""Draw results on one frame, as the overlays of runs show them."""

import math
from collections.abc import Iterable

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.overlay import (
    TARGET,
    TRAIL_LENGTH,
    Trails,
    colour_picture,
    draw_detections,
    draw_tracks,
    label,
    target_words,
)
from torchvision_dddas.types import Detections, Frame, FrameResult, Scene, TrackedFrame, Tracks, as_picture

Tracked = FrameResult | TrackedFrame | Tracks
"""The results of one frame, with identities."""


def draw(frame: Frame | np.ndarray, result: Tracked | Scene | Detections | Iterable[Tracked]) -> np.ndarray:
    """Return a copy of a frame, (H, W, 3) uint8 BGR, with the boxes, identities, classes and speeds of a result.

    result: a result of `Pipeline`, `Tracker` or a detector, or the tracks of the last frames, oldest first. The last
    tracks are drawn; earlier tracks give trails and speeds. Speeds are in m/s for located targets, else in pixels
    per frame. Trails and speeds exclude the camera's motion for results of `Pipeline`; `Tracks` do not contain it.
    Raise InputError if frame is not a picture, or for a result of another type.

    >>> frame = td.Frame(1, 0.0, np.zeros((48, 64, 3), np.uint8))
    >>> tracks = td.Tracks(1, np.array([7]), np.array([[10.0, 20, 20, 9]]), np.ones(1), np.zeros(1, int))
    >>> drawn = td.draw(frame, tracks)
    >>> drawn.shape, bool(drawn.any())
    ((48, 64, 3), True)
    """
    picture = colour_picture(as_picture(frame.image if isinstance(frame, Frame) else frame))
    found = result.detections if isinstance(result, Scene) else result
    if isinstance(found, Detections):
        draw_detections(picture, found)
        for box, name, score, speed in zip(found.box_px, found.label, found.score, found.speed_px, strict=True):
            label(picture, box, f"{name or found.kind} {score:.2f}{_speed_text(float(speed), 'px')}", TARGET)
        return picture
    trails, whole, tracked = Trails(TRAIL_LENGTH), None, None
    for whole in [found] if isinstance(found, Tracked) or not isinstance(found, Iterable) else found:
        tracked = _tracked_of(whole)
        trails.add(tracked)
    if tracked is not None:
        draw_tracks(picture, tracked, trails, _words(whole, tracked.tracks, trails))
    return picture


def _tracked_of(result: object) -> TrackedFrame:
    if isinstance(result, Tracks):
        if np.ndim(result.frame):
            raise InputError("draw got a table of several frames; wanted the tracks of each frame, oldest first")
        return TrackedFrame(result.frame, None, Detections(), result)
    tracked = result.tracked if isinstance(result, FrameResult) else result
    if not isinstance(tracked, TrackedFrame):
        raise InputError(f"draw got {type(result).__name__}; wanted a result of Pipeline, Tracker or a detector")
    return tracked


def _words(result: object, tracks: Tracks, trails: Trails) -> dict[int, str]:
    """Return a text for each identity: its class, its speed, and the reports of other platforms."""
    identities = tracks.identity.tolist()
    speeds = {identity: _speed_text(trails.speed(identity), "px") for identity in identities}
    others: dict[int, str] = {}
    if isinstance(result, FrameResult):
        others, located = target_words(result), result.locations
        if located is not None:
            metres = np.hypot(*located.velocity_m_s.T).tolist()
            known = zip(located.positions.target.tolist(), metres, strict=True)
            speeds |= {target: _speed_text(speed, "m/s") for target, speed in known if math.isfinite(speed)}
    names = zip(identities, tracks.label, strict=True)
    return {k: (f" {name}" if name else "") + speeds[k] + others.get(k, "") for k, name in names}


def _speed_text(speed: float, unit: str) -> str:
    return "" if math.isnan(speed) else f" {speed:.1f} {unit}"
