"""The clip with its people drawn in: body, feet, probability, and where it was searched."""

from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas.sinks.drawing import colour_picture, label, line_width, rectangle, whole
from torchvision_dddas.sinks.overlay import TEXT, WARNING, caption
from torchvision_dddas.sinks.whole import remove, temporary
from torchvision_dddas.types import Recognized

PERSON = (80, 220, 80)  # BGR
CUT = (60, 160, 255)
SEARCHED = (200, 170, 90)


def drawn_people(recognized: Recognized) -> np.ndarray:
    """The frame with everything found in it, (H, W, 3) uint8 BGR.

    A person whom the border cuts has another colour and a `?`: box and feet may go on outside.
    """
    picture, people = colour_picture(recognized.frame.image), recognized.people
    thick = line_width(picture)
    for region in recognized.regions_px if recognized.regions_px is not None else ():
        rectangle(picture, region, SEARCHED, 1)
    for box, cut, feet in zip(people.box_px, people.cut, people.feet_px, strict=True):
        colour = CUT if cut else PERSON
        rectangle(picture, box, colour, thick)
        cv2.circle(picture, tuple(whole(feet).tolist()), 3 * thick, colour, -1, cv2.LINE_AA)
        cv2.circle(picture, tuple(whole(feet).tolist()), 3 * thick, (0, 0, 0), 1, cv2.LINE_AA)
    for box, cut, score in zip(people.box_px, people.cut, people.score, strict=True):  # above all boxes
        label(picture, box, f"{score:.2f}{'?' if cut else ''}", CUT if cut else PERSON)
    lines = [(_words(recognized), TEXT)]
    if recognized.cause:
        lines.append((recognized.cause, WARNING))
    caption(picture, lines)
    return picture


def _words(recognized: Recognized) -> str:
    searched = "everywhere" if recognized.regions_px is None else f"in {recognized.share:.0%} of the windows"
    return f"frame {recognized.frame.number}  people {len(recognized.people)}  searched {searched}"


class Still:
    """overlay.png of one picture; of several the last."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "overlay.png"
        self._part = temporary(self._path)

    def write(self, recognized: Recognized) -> None:
        """Draw it. Raises OSError if the disk refuses."""
        _, content = cv2.imencode(".png", drawn_people(recognized))
        self._part.write_bytes(content.tobytes())

    def close(self, complete: bool) -> None:
        """Put it in its place, if there is one."""
        if self._part.exists():
            self._part.replace(self._path)

    def discard(self) -> None:
        """Remove what was begun."""
        remove(self._part)
