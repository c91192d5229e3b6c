"""A camera that swings over a scene that was filmed by another one: true boxes and pictures as it would see them."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas.evaluation.metrics.matching import TrackTable
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.tracking.kalman import transform_boxes
from torchvision_dddas.types import Frame

CAMERAS = {
    "still": (0.0, 0.0, 0.0, False),
    "pans 10 px": (10.0, 0.0, 0.0, False),
    "turns 1.5°": (0.0, 1.5, 0.0, False),
    "zooms 4 %": (0.0, 0.0, 0.04, False),
    "trembles": (0.0, 0.0, 0.0, True),
    "all of these": (10.0, 1.5, 0.04, True),
}
"""The fastest pan (px), turn (degrees) and zoom (share) in a frame, and whether it trembles as well."""

_PERIODS = (70, 110, 90, 60)  # frames, of the pan across and along, the turn and the zoom
TREMBLE = (10.0, 2.0, 0.05)
"""Sd in px, degrees and as a share of a place, turn and zoom that are new in each frame."""


def flight(frames: int, size: tuple[int, int], camera: tuple[float, float, float, bool]) -> np.ndarray:
    """Where a scene of (width, height) pixels is in each picture: (frames, 3, 3), picture from scene."""
    pan, turn, zoom, trembles = camera
    swing = [np.sin(2 * np.pi * np.arange(frames) / period) * period / (2 * np.pi) for period in _PERIODS]
    shaken = np.random.default_rng(0).standard_normal((4, frames)) * trembles
    across, along = pan * swing[0] + TREMBLE[0] * shaken[0], pan / 2 * swing[1] + TREMBLE[0] * shaken[1]
    angle = np.deg2rad(turn * swing[2] + TREMBLE[1] * shaken[2])
    scale = np.exp(zoom * swing[3] + TREMBLE[2] * shaken[3])
    middle = np.array([[1, 0, -size[0] / 2], [0, 1, -size[1] / 2], [0, 0, 1]])
    maps = np.tile(np.eye(3), (frames, 1, 1))
    maps[:, 0, 0] = maps[:, 1, 1] = scale * np.cos(angle)
    maps[:, 1, 0] = scale * np.sin(angle)
    maps[:, 0, 1] = -maps[:, 1, 0]
    maps[:, 0, 2], maps[:, 1, 2] = across, along
    return np.linalg.inv(middle) @ maps @ middle


def seen(truth: TrackTable, maps: np.ndarray) -> TrackTable:
    """The boxes in the pictures: centres are carried, sides stretch by the zoom and stay upright."""
    box_px = truth.box_px.copy()
    for number in np.unique(truth.frame):
        here = truth.frame == number
        box_px[here] = transform_boxes(truth.box_px[here], maps[number - 1])
    return truth._replace(box_px=box_px)


class Filmed:
    """The source of a video's pictures as the camera sees them; beyond the video's border it is mirrored."""

    def __init__(self, video: Path, maps: np.ndarray) -> None:
        self.video, self.maps, self.last = str(video), maps, 0
        self.size = open_source(self.video).size

    def every(self, interval: int) -> Iterator[Frame]:
        """Every interval-th frame from the first."""
        for frame in open_source(self.video).every(interval):
            if frame.number <= len(self.maps):
                self.last = frame.number
                mirrored = {"borderMode": cv2.BORDER_REFLECT}
                image = cv2.warpPerspective(frame.image, self.maps[frame.number - 1], self.size, **mirrored)  # type: ignore[call-overload]
                yield replace(frame, image=image)


def translation(step: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """What a homography does to the middle of the picture, as a translation (3, 3)."""
    middle = np.array([size[0] / 2, size[1] / 2, 1])
    there = step @ middle
    moved = there / there[2] - middle
    return np.array([[1, 0, moved[0]], [0, 1, moved[1]], [0, 0, 1]])
