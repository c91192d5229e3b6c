"""The clip with its tracks and landmarks drawn in: which landmarks laid the picture on the ground, and how well."""

from collections.abc import Sequence

import cv2
import numpy as np

from torchvision_dddas.io.maps.map_signs import LETTERS
from torchvision_dddas.io.output.command_log import in_picture, metres, summary
from torchvision_dddas.io.overlay.detection_overlay import TEXT, WARNING
from torchvision_dddas.io.overlay.drawing import Colour, label, line_width, whole
from torchvision_dddas.io.overlay.track_overlay import TrackPictures
from torchvision_dddas.types import AerialLocations, FrameResult

STATES: dict[str, Colour] = {"used": (90, 230, 90), "reassigned": (60, 220, 255), "excluded": WARNING}
"""The colour of a landmark by what became of it."""
ORDER: Colour = (255, 255, 255)


class SurveyPictures:
    """Draws surveyed frames, given in order."""

    def __init__(self, size: tuple[int, int], names: Sequence[str]) -> None:
        """size: (width, height) of the pictures. names: of the landmarks."""
        self._tracks, self._names = TrackPictures(size), tuple(names)

    def skip(self, surveyed: FrameResult) -> None:
        """Take note of a frame that is not drawn."""
        self._tracks.skip(surveyed.followed)

    def __call__(self, surveyed: FrameResult) -> np.ndarray:
        """The frame with tracks and landmarks, what ground vehicles say and are asked, (H, W, 3) uint8 BGR."""
        grounded = surveyed.grounded
        asked = [] if surveyed.command is None else [(words, TEXT) for words in [summary(surveyed.command)] if words]
        if grounded is None:
            return self._tracks(surveyed.followed, asked)
        picture = self._tracks(surveyed.followed, [_line(grounded), *asked], _letters(surveyed))
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
        self._draw_orders(picture, surveyed)
        return picture

    def _draw_orders(self, picture: np.ndarray, surveyed: FrameResult) -> None:
        """An arrow from each vehicle towards where it was sent, to that place or as long as a tenth of the picture."""
        grounded, command, scale = surveyed.grounded, surveyed.command, metres(surveyed)
        if grounded is None or command is None or scale is None or not command.orders:
            return
        turned = in_picture(grounded)
        if turned is None:
            return
        rows = {self._names[k]: row for row, k in enumerate(grounded.marks.landmark.tolist())}
        for order in command.orders:
            row = rows.get(order.vehicle)
            if row is None or not np.isfinite(grounded.marks.image_px[row]).all():
                continue
            way = turned @ (scale(order.goal) - grounded.marks.east_north_m[row])
            long = float(np.hypot(*way))
            if not long > 4 * line_width(picture):
                continue
            start = grounded.marks.image_px[row]
            tip = start + way * min(1.0, picture.shape[0] / 10 / long)
            ends = whole(np.stack([start, tip])).tolist()
            cv2.arrowedLine(picture, ends[0], ends[1], ORDER, line_width(picture) + 1, cv2.LINE_AA, tipLength=0.3)


class Once:
    """The picture of each frame, drawn once however many want it, and where nobody does not at all."""

    def __init__(self, pictures: SurveyPictures) -> None:
        self._pictures = pictures
        self._item: FrameResult | None = None
        self._picture: np.ndarray | None = None

    def show(self, surveyed: FrameResult) -> None:
        """The next frame; nothing where it is the same."""
        if surveyed is self._item:
            return
        if self._item is not None and self._picture is None:
            self._pictures.skip(self._item)
        self._item, self._picture = surveyed, None

    def __call__(self, surveyed: FrameResult) -> np.ndarray:
        """The picture of the frame shown last, (H, W, 3) uint8 BGR, which nobody may draw on."""
        self.show(surveyed)
        if self._picture is None:
            self._picture = self._pictures(surveyed)
        return self._picture


def _letters(surveyed: FrameResult) -> dict[int, str]:
    """The letter of each identity that ground vehicles were asked about."""
    confirmed, grounded = surveyed.confirmed, surveyed.grounded
    if confirmed is None or grounded is None:
        return {}
    targets = grounded.positions.target[confirmed.row].tolist()
    return {target: LETTERS.get(kind, "?") for target, kind in zip(targets, confirmed.kind, strict=True)}


def _line(grounded: AerialLocations) -> tuple[str, Colour]:
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
