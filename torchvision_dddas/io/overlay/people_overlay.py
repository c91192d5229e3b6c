"""The clip with its people drawn in: body, feet, probability, and where it was searched."""

from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas.io.atomic_files import remove, temporary
from torchvision_dddas.io.overlay.detection_overlay import TEXT, WARNING, caption
from torchvision_dddas.io.overlay.drawing import Colour, colour_picture, label, line_width, rectangle, whole
from torchvision_dddas.types import PeopleFrame

PERSON = (80, 220, 80)  # BGR
CUT = (60, 160, 255)
UNLIKELY = (150, 150, 150)
SEARCHED = (200, 170, 90)
LIKELY = 0.5
"""Probability from which on a person is drawn as one."""


def drawn_people(recognized: PeopleFrame) -> np.ndarray:
    """The frame with everything found in it, (H, W, 3) uint8 BGR.

    A person whom the border cuts has another colour and a `?`: box and feet may go on outside. Who is less likely than
    not one has a thin grey box without a number, below the others.
    """
    picture, people = colour_picture(recognized.frame.image), recognized.people
    thick = line_width(picture)
    for region in recognized.regions_px if recognized.regions_px is not None else ():
        rectangle(picture, region, SEARCHED, 1)
    worst_first = np.argsort(people.score, kind="stable")
    likely = worst_first[people.score[worst_first] >= LIKELY]
    for i in worst_first:
        sure = people.score[i] >= LIKELY
        colour = _colour(people.cut[i]) if sure else UNLIKELY
        rectangle(picture, people.box_px[i], colour, thick if sure else max(1, thick // 2))
        feet, radius = tuple(whole(people.feet_px[i]).tolist()), 3 * thick if sure else thick
        cv2.circle(picture, feet, radius, colour, -1, cv2.LINE_AA)
        if sure:
            cv2.circle(picture, feet, radius, (0, 0, 0), 1, cv2.LINE_AA)
    for i in likely:  # above all boxes
        cut = people.cut[i]
        label(picture, people.box_px[i], f"{people.score[i]:.2f}{'?' if cut else ''}", _colour(cut))
    lines = [(_words(recognized), TEXT)]
    if recognized.cause:
        lines.append((recognized.cause, WARNING))
    caption(picture, lines)
    return picture


def _colour(cut: bool) -> Colour:
    return CUT if cut else PERSON


def _words(recognized: PeopleFrame) -> str:
    searched = "everywhere" if recognized.regions_px is None else f"in {recognized.share:.0%} of the windows"
    likely = int((recognized.people.score >= LIKELY).sum())
    unlikely = len(recognized.people) - likely
    people = f"people {likely}" + (f" + {unlikely} unlikely" if unlikely else "")
    return f"frame {recognized.frame.number}  {people}  searched {searched}"


class Still:
    """overlay.png of one picture; of several the last."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "overlay.png"
        self._part = temporary(self._path)

    def write(self, recognized: PeopleFrame) -> None:
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
