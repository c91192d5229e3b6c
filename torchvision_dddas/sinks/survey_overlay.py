"""The clip with its tracks and landmarks drawn in: which landmarks laid the picture on the ground, and how well."""

from collections.abc import Sequence

import cv2
import numpy as np

from torchvision_dddas.sinks.drawing import Colour, label, line_width, whole
from torchvision_dddas.sinks.overlay import TEXT, WARNING
from torchvision_dddas.sinks.track_overlay import TrackPictures
from torchvision_dddas.types import Grounded, Surveyed

STATES: dict[str, Colour] = {"used": (90, 230, 90), "reassigned": (60, 220, 255), "excluded": WARNING}
"""The colour of a landmark by what became of it."""


class SurveyPictures:
    """Draws surveyed frames, given in order."""

    def __init__(self, size: tuple[int, int], names: Sequence[str]) -> None:
        """size: (width, height) of the pictures. names: of the landmarks."""
        self._tracks, self._names = TrackPictures(size), tuple(names)

    def __call__(self, surveyed: Surveyed) -> np.ndarray:
        """The frame with tracks and landmarks, (H, W, 3) uint8 BGR."""
        grounded = surveyed.grounded
        if grounded is None:
            return self._tracks(surveyed.followed)
        picture = self._tracks(surveyed.followed, [_line(grounded)])
        state = dict(zip(grounded.fix.landmark.tolist(), grounded.fix.state, strict=True))
        arm = 6 * line_width(picture)
        for which, place in zip(grounded.marks.landmark.tolist(), grounded.marks.image_px, strict=True):
            if not np.isfinite(place).all():
                continue
            became = state.get(which, "excluded")
            colour = STATES.get(became, WARNING)
            middle = whole(place).tolist()
            cv2.circle(picture, middle, 2 * arm, colour, line_width(picture), cv2.LINE_AA)
            cv2.drawMarker(picture, middle, colour, cv2.MARKER_CROSS, arm, line_width(picture))
            name = self._names[which] + ("" if became == "used" else f" {became}")
            label(picture, np.array([place[0] + 2 * arm, place[1] - arm, 0, 0]), name, colour)
        return picture


def _line(grounded: Grounded) -> tuple[str, Colour]:
    """How the frame lies on the ground, in words."""
    fix = grounded.fix
    if not fix.by:
        return f"not located: {fix.cause}", WARNING
    used = len(fix.state) - fix.state.count("excluded")
    text = f"located by {fix.by}, {used} of {len(fix.state)} landmarks, {len(grounded.positions)} targets"
    spread = np.sqrt(np.trace(grounded.positions.covariance_m2, axis1=1, axis2=2))
    if np.isfinite(spread).any():
        text += f" to {np.nanmedian(spread):.2f} m"
    remarks = "; ".join([*fix.changes, fix.cause]).strip("; ")
    return (f"{text}; {remarks}", WARNING) if remarks else (text, TEXT)
