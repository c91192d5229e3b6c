"""What overlays show: targets with tint and heading, tracks with trails, people, landmarks and orders."""

import math
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np

from torchvision_dddas.io.overlay.drawing import (
    TEXT,
    WARNING,
    Colour,
    caption,
    colour_picture,
    drawable,
    identity_colour,
    label,
    line_width,
    rectangle,
)
from torchvision_dddas.types import AerialLocations, Command, FrameResult, PeopleFrame, Scene, TrackedFrame

TARGET: Colour = (40, 190, 255)
UNTRACKED: Colour = (150, 150, 150)
PERSON: Colour = (80, 220, 80)
CUT: Colour = (60, 160, 255)
UNLIKELY: Colour = (150, 150, 150)
SEARCHED: Colour = (200, 170, 90)
ORDER: Colour = (255, 255, 255)
LANDMARK: dict[str, Colour] = {"used": (90, 230, 90), "reassigned": (60, 220, 255), "excluded": WARNING}
"""The colour of a landmark by its state in the fix."""
LETTERS = {"human": "H", "not_human": "N"}
"""What ground vehicles say of a target, in one letter."""
LIKELY = 0.5
"""The least probability of a person that is drawn as one."""
TRAIL_LENGTH = 12


def draw_scene(scene: Scene) -> np.ndarray:
    """The frame with its targets, (H, W, 3) uint8 BGR; the caption says when not to trust it."""
    picture = colour_picture(scene.frame.image)
    thick = line_width(picture)
    foreground = (scene.mask > 0).astype(np.uint8)
    if foreground.any():
        where = foreground > 0
        picture[where] = (0.7 * picture[where] + 0.3 * np.array(TARGET)).astype(np.uint8)
        outlines = cv2.findContours(foreground, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
        cv2.drawContours(picture, outlines, -1, TARGET, 1)
    found = scene.detections
    for box, heading, speed in zip(found.box_px, found.heading_rad, found.speed_px, strict=True):
        x, y, w, h = (round(float(v)) for v in box)
        cv2.rectangle(picture, (x, y), (x + w - 1, y + h - 1), TARGET, thick)
        if not math.isnan(heading):
            length = 14 * thick + 4 * min(float(np.nan_to_num(speed)), 12.0)
            middle = np.array([x + w / 2, y + h / 2])
            tip = middle + length * np.array([math.cos(heading), math.sin(heading)])
            start, end = drawable(np.stack([middle, tip])).tolist()
            cv2.arrowedLine(picture, start, end, TEXT, thick, cv2.LINE_AA, tipLength=0.35)
    lines = [(f"frame {scene.frame.number}  interval {scene.interval_frames}  targets {len(found)}", TEXT)]
    if not scene.reliable:
        lines.append((f"registration unreliable: {scene.cause}", WARNING))
    caption(picture, lines)
    return picture


def draw_people(found: PeopleFrame) -> np.ndarray:
    """The frame with its people, (H, W, 3) uint8 BGR.

    A person whom the border cuts has another colour and a `?`. People below LIKELY have thin grey boxes underneath.
    """
    picture, people = colour_picture(found.frame.image), found.people
    thick = line_width(picture)
    for region in found.regions_px if found.regions_px is not None else ():
        rectangle(picture, region, SEARCHED, 1)
    worst_first = np.argsort(people.score, kind="stable")
    likely = worst_first[people.score[worst_first] >= LIKELY]
    for i in worst_first:
        sure = people.score[i] >= LIKELY
        colour = _colour(people.cut[i]) if sure else UNLIKELY
        rectangle(picture, people.box_px[i], colour, thick if sure else max(1, thick // 2))
        feet, radius = tuple(drawable(people.feet_px[i]).tolist()), 3 * thick if sure else thick
        cv2.circle(picture, feet, radius, colour, -1, cv2.LINE_AA)
        if sure:
            cv2.circle(picture, feet, radius, (0, 0, 0), 1, cv2.LINE_AA)
    for i in likely:  # above all boxes
        cut = people.cut[i]
        label(picture, people.box_px[i], f"{people.score[i]:.2f}{'?' if cut else ''}", _colour(cut))
    lines = [(_words(found), TEXT)]
    if found.cause:
        lines.append((found.cause, WARNING))
    caption(picture, lines)
    return picture


def _colour(cut: bool) -> Colour:
    return CUT if cut else PERSON


def _words(found: PeopleFrame) -> str:
    searched = "everywhere" if found.regions_px is None else f"in {found.share:.0%} of the windows"
    likely = int((found.people.score >= LIKELY).sum())
    unlikely = len(found.people) - likely
    people = f"people {likely}" + (f" + {unlikely} unlikely" if unlikely else "")
    return f"frame {found.frame.number}  {people}  searched {searched}"


class Trails:
    """The last places of every identity, moved along with the camera's motion. Frames are added in order.

    length: places kept per identity. memory_frames: an identity unseen for so long is forgotten.
    places: identity -> frame number, u_px, v_px of each place.
    """

    def __init__(self, length: int, memory_frames: int = 250) -> None:
        self.length, self.memory = length, memory_frames
        self.places: dict[int, list[tuple[int, float, float]]] = {}

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


class TrackPictures:
    """Draws frames with tracks and trails, given in order."""

    def __init__(self, size: tuple[int, int]) -> None:
        """size: (width, height) of the pictures, for frames that could not be read."""
        self.size = size
        self._trails = Trails(TRAIL_LENGTH)

    def skip(self, followed: TrackedFrame) -> None:
        """Add a frame to the trails without drawing it."""
        self._trails.add(followed)

    def __call__(
        self,
        followed: TrackedFrame,
        more: Sequence[tuple[str, Colour]] = (),
        kinds: Mapping[int, str] | None = None,
    ) -> np.ndarray:
        """The frame with boxes, numbers and trails, (H, W, 3) uint8 BGR; black where it could not be read.

        more: further lines of the caption with their colours. kinds: text behind the number of an identity.
        """
        self._trails.add(followed)
        kinds = kinds or {}
        width, height = self.size
        blank = np.zeros((height, width, 3), np.uint8)
        picture = blank if followed.frame is None else colour_picture(followed.frame.image)
        thick = line_width(picture)
        tracks, given = followed.tracks, followed.detections
        for row in followed.untracked:
            rectangle(picture, given.box_px[row], UNTRACKED, 1)
        for identity, box, row in zip(tracks.identity.tolist(), tracks.box_px, tracks.row, strict=True):
            colour = identity_colour(identity)
            way = drawable(np.array([place[1:] for place in self._trails.places[identity]]))
            cv2.polylines(picture, [way], False, colour, thick, cv2.LINE_AA)
            rectangle(picture, box, colour, thick + 1 if row >= 0 else 1)
            label(picture, box, f"{identity} {kinds[identity]}" if identity in kinds else str(identity), colour)
        lines = [(f"frame {followed.number}  identities {len(tracks)}  detections {len(given)}", TEXT)]
        if followed.cause:
            lines.append((followed.cause, WARNING))
        caption(picture, [*lines, *more])
        return picture


class RunPictures:
    """Draws frames of a run with tracks, landmarks, what ground vehicles say, and what they were asked to do.

    Frames are shown in order; each is drawn once however many callers want it, and not at all if none does.
    """

    def __init__(self, size: tuple[int, int], names: Sequence[str]) -> None:
        """size: (width, height) of the pictures. names: of the landmarks."""
        self._tracks, self._names = TrackPictures(size), tuple(names)
        self._shown: FrameResult | None = None
        self._picture: np.ndarray | None = None

    def show(self, result: FrameResult) -> None:
        """Go on to the next frame, if it is not the same."""
        if result is self._shown:
            return
        if self._shown is not None and self._picture is None:
            self._tracks.skip(self._shown.tracked)
        self._shown, self._picture = result, None

    def __call__(self, result: FrameResult) -> np.ndarray:
        """The picture of a frame, (H, W, 3) uint8 BGR. The caller must not draw on it."""
        self.show(result)
        if self._picture is None:
            self._picture = self._draw(result)
        return self._picture

    def _draw(self, result: FrameResult) -> np.ndarray:
        grounded, command = result.locations, result.command
        commanded = "" if command is None else summarize_command(command)
        lines = [(commanded, TEXT)] if commanded else []
        if grounded is None:
            return self._tracks(result.tracked, lines)
        picture = self._tracks(result.tracked, [_location_line(grounded), *lines], _letters(result))
        state = dict(zip(grounded.fix.landmark.tolist(), grounded.fix.state, strict=True))
        arm = 6 * line_width(picture)
        for which, place in zip(grounded.marks.landmark.tolist(), grounded.marks.image_px, strict=True):
            if not np.isfinite(place).all():
                continue
            became = state.get(which, "excluded")
            colour = LANDMARK.get(became, WARNING)
            middle = drawable(place).tolist()
            cv2.circle(picture, middle, 2 * arm, colour, line_width(picture), cv2.LINE_AA)
            cv2.drawMarker(picture, middle, colour, cv2.MARKER_CROSS, arm, line_width(picture))
            name = self._names[which] + ("" if became == "used" else f" {became}")
            label(picture, np.array([place[0] + 2 * arm, place[1] - arm, 0, 0]), name, colour)
        self._draw_orders(picture, result)
        return picture

    def _draw_orders(self, picture: np.ndarray, result: FrameResult) -> None:
        """Draw an arrow from each vehicle towards its goal, at most a tenth of the picture long."""
        grounded, command, scale = result.locations, result.command, command_metres(result)
        if grounded is None or command is None or scale is None or not command.orders:
            return
        turned = pixels_per_metre(grounded)
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
            ends = drawable(np.stack([start, tip])).tolist()
            cv2.arrowedLine(picture, ends[0], ends[1], ORDER, line_width(picture) + 1, cv2.LINE_AA, tipLength=0.3)


def _letters(result: FrameResult) -> dict[int, str]:
    """The letter of each identity that ground vehicles were asked about."""
    confirmed, grounded = result.confirmed, result.locations
    if confirmed is None or grounded is None:
        return {}
    targets = grounded.positions.target[confirmed.row].tolist()
    return {target: LETTERS.get(kind, "?") for target, kind in zip(targets, confirmed.kind, strict=True)}


def _location_line(grounded: AerialLocations) -> tuple[str, Colour]:
    """By what the frame was located and how well."""
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


ToMetres = Callable[[np.ndarray], np.ndarray]
"""(2,) local metres of a place in a command."""


def command_metres(result: FrameResult) -> ToMetres | None:
    """A function from the places of a frame's commands to local metres; None where the frame does not tell enough.

    Commands are in degrees where landmarks have degrees, else in local metres. The scale follows from the landmarks.
    """
    grounded, degrees = result.locations, result.mark_lonlat_deg
    if grounded is None:
        return None
    if degrees is None:
        return lambda place: np.asarray(place, float)
    east_north_m = grounded.marks.east_north_m
    both = np.isfinite(degrees).all(axis=1) & np.isfinite(east_north_m).all(axis=1)
    # Less than some metres apart, rounding would dominate the scale.
    if both.sum() < 2 or (np.ptp(east_north_m[both], axis=0) < 1.0).any():
        return None
    middle_deg, middle_m = degrees[both].mean(axis=0), east_north_m[both].mean(axis=0)
    scale = np.ptp(east_north_m[both], axis=0) / np.ptp(degrees[both], axis=0)

    def to_metres(place: np.ndarray) -> np.ndarray:
        place = np.asarray(place, float)
        # A place that is no such longitude and latitude is in local metres already.
        return place if np.abs(place - middle_deg).max() > 1.0 else middle_m + (place - middle_deg) * scale

    return to_metres


def pixels_per_metre(grounded: AerialLocations) -> np.ndarray | None:
    """(2, 2) pixels to the right and down of a metre to the east and north about the landmarks; None where unknown."""
    marks = grounded.marks
    both = np.isfinite(marks.image_px).all(axis=1) & np.isfinite(marks.east_north_m).all(axis=1)
    place, pixel = marks.east_north_m[both], marks.image_px[both]
    if len(place) < 3:
        return None
    apart = place - place.mean(axis=0)
    if np.linalg.svd(apart, compute_uv=False)[-1] < 1.0:  # all but on one line
        return None
    return np.asarray(np.linalg.lstsq(apart, pixel - pixel.mean(axis=0), rcond=None)[0].T)


def summarize_command(command: Command) -> str:
    """A command in a few words."""
    words = [f"every {command.every}"] if command.every > 1 else []
    sent = [order.vehicle for order in command.orders]
    if sent:
        words.append(f"sent: {', '.join(sent)}")
    if command.altitude_m is not None and math.isfinite(command.altitude_m):
        words.append(f"fly at {command.altitude_m:.0f} m")
    return "; ".join(words)
