"""The clip with its tracks drawn in: a colour and a number an identity, and the way that it came."""

import cv2
import numpy as np

from torchvision_dddas.sinks.overlay import TEXT, WARNING, caption
from torchvision_dddas.sinks.trails import Trails
from torchvision_dddas.types import Followed

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

    def __call__(self, followed: Followed) -> np.ndarray:
        """The frame with boxes, numbers and trails, (H, W, 3) uint8 BGR; black where it could not be read."""
        self._trails.add(followed)
        picture = _picture(followed, self.size)
        thick = max(1, round(picture.shape[0] / 480))
        tracks, given = followed.tracks, followed.detections
        for row in followed.untracked:
            _rectangle(picture, given.box_px[row], UNTRACKED, 1)
        for identity, box, row in zip(tracks.identity.tolist(), tracks.box_px, tracks.row, strict=True):
            colour = colour_of(identity)
            way = _whole(np.array([place[1:] for place in self._trails.places[identity]]))
            cv2.polylines(picture, [way], False, colour, thick, cv2.LINE_AA)
            _rectangle(picture, box, colour, thick + 1 if row >= 0 else 1)
            _label(picture, box, str(identity), colour)
        lines = [(f"frame {followed.number}  identities {len(tracks)}  detections {len(given)}", TEXT)]
        if followed.cause:
            lines.append((followed.cause, WARNING))
        caption(picture, lines)
        return picture


def _picture(followed: Followed, size: tuple[int, int]) -> np.ndarray:
    if followed.frame is None:
        return np.zeros((size[1], size[0], 3), np.uint8)
    image = followed.frame.image
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()


def _whole(points: np.ndarray) -> np.ndarray:
    """Pixels that OpenCV can draw: far outside is as good as farther."""
    return np.clip(np.nan_to_num(points), -30_000, 30_000).round().astype(np.int32)


def _rectangle(picture: np.ndarray, box: np.ndarray, colour: tuple[int, int, int], thick: int) -> None:
    x, y, right, bottom = _whole(np.array([*box[:2], *(box[:2] + box[2:])])).tolist()
    cv2.rectangle(picture, (x, y), (right - 1, bottom - 1), colour, thick)


def _label(picture: np.ndarray, box: np.ndarray, text: str, colour: tuple[int, int, int]) -> None:
    """The number on a patch of its colour, above the box where there is room."""
    scale = max(picture.shape[0] / 1200, 0.35)
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    x, y = _whole(box[:2]).tolist()
    top = y - height - 4 if y >= height + 4 else y
    cv2.rectangle(picture, (x, top), (x + width + 3, top + height + 3), colour, -1)
    cv2.putText(picture, text, (x + 2, top + height + 1), cv2.FONT_HERSHEY_SIMPLEX, scale, (0, 0, 0), 1, cv2.LINE_AA)
