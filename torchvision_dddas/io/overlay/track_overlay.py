"""The clip with its tracks drawn in: a colour and a number an identity, and the way that it came."""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from torchvision_dddas.io.overlay.detection_overlay import TEXT, WARNING, caption
from torchvision_dddas.io.overlay.drawing import Colour, colour_picture, label, line_width, rectangle, whole
from torchvision_dddas.io.overlay.trails import Trails
from torchvision_dddas.types import TrackedFrame

LENGTH = 12
"""Places that a trail shows."""
UNTRACKED = (150, 150, 150)
_GOLDEN_DEG = 137.508  # neighbours in number are far apart in hue, for any count of them


def colour_of(identity: int) -> tuple[int, int, int]:
    """The BGR colour of an identity, the same in every frame."""
    hue = identity * _GOLDEN_DEG % 360 / 2
    value = 255 - 55 * (identity // 5 % 2)
    (blue, green, red), *_ = cv2.cvtColor(np.array([[[hue, 200, value]]], np.uint8), cv2.COLOR_HSV2BGR)[0].tolist()
    return blue, green, red


class TrackPictures:
    """Draws followed frames, given in order; remembers where the identities have been."""

    def __init__(self, size: tuple[int, int]) -> None:
        """size: (width, height) of the pictures, for frames that could not be read."""
        self.size = size
        self._trails = Trails(LENGTH)

    def skip(self, followed: TrackedFrame) -> None:
        """Take note of a frame that is not drawn."""
        self._trails.add(followed)

    def __call__(
        self,
        followed: TrackedFrame,
        more: Sequence[tuple[str, Colour]] = (),
        kinds: Mapping[int, str] | None = None,
    ) -> np.ndarray:
        """The frame with boxes, numbers and trails, (H, W, 3) uint8 BGR; black where it could not be read.

        more: further lines of the caption, each with its colour. kinds: what stands behind the number of an identity.
        """
        self._trails.add(followed)
        kinds = kinds or {}
        picture = _picture(followed, self.size)
        thick = line_width(picture)
        tracks, given = followed.tracks, followed.detections
        for row in followed.untracked:
            rectangle(picture, given.box_px[row], UNTRACKED, 1)
        for identity, box, row in zip(tracks.identity.tolist(), tracks.box_px, tracks.row, strict=True):
            colour = colour_of(identity)
            way = whole(np.array([place[1:] for place in self._trails.places[identity]]))
            cv2.polylines(picture, [way], False, colour, thick, cv2.LINE_AA)
            rectangle(picture, box, colour, thick + 1 if row >= 0 else 1)
            label(picture, box, f"{identity} {kinds[identity]}" if identity in kinds else str(identity), colour)
        lines = [(f"frame {followed.number}  identities {len(tracks)}  detections {len(given)}", TEXT)]
        if followed.cause:
            lines.append((followed.cause, WARNING))
        caption(picture, [*lines, *more])
        return picture


def _picture(followed: TrackedFrame, size: tuple[int, int]) -> np.ndarray:
    if followed.frame is None:
        return np.zeros((size[1], size[0], 3), np.uint8)
    return colour_picture(followed.frame.image)
