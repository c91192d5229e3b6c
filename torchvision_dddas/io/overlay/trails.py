"""Where each identity has been, as the camera sees those places now."""

import cv2
import numpy as np

from torchvision_dddas.types import TrackedFrame

Place = tuple[int, float, float]
"""Frame number, u_px, v_px."""


class Trails:
    """The last places of every identity, carried along with the camera's motion. Show it the frames in order.

    length: places kept of an identity. memory_frames: it is forgotten when it has not been seen for so long.
    """

    def __init__(self, length: int, memory_frames: int = 250) -> None:
        self.length, self.memory = length, memory_frames
        self.places: dict[int, list[Place]] = {}

    def add(self, followed: TrackedFrame) -> None:
        """Carry all places to this frame, and add the centres of its boxes."""
        if followed.now_from_before is not None:
            self._carry(followed.now_from_before)
        number, tracks = followed.number, followed.tracks
        for identity, (x, y, w, h) in zip(tracks.identity.tolist(), tracks.box_px.tolist(), strict=True):
            trail = self.places.setdefault(identity, [])
            trail.append((number, x + w / 2, y + h / 2))
            del trail[: -self.length]
        for identity in [i for i, trail in self.places.items() if number - trail[-1][0] > self.memory]:
            del self.places[identity]

    def _carry(self, now_from_before: np.ndarray) -> None:
        points = np.array([place[1:] for trail in self.places.values() for place in trail], float)
        if len(points) == 0:
            return
        moved = iter(cv2.perspectiveTransform(points[None], now_from_before)[0].tolist())
        for trail in self.places.values():
            trail[:] = [(place[0], *next(moved)) for place in trail]
