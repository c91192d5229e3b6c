"""Draw overlays: targets with tint and heading, tracks with trails, people, landmarks and orders."""

import math
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np

from torchvision_dddas.types import (
    AerialLocations,
    Command,
    Detections,
    FrameResult,
    PeopleFrame,
    Scene,
    TrackedFrame,
    Zone,
)

Colour = tuple[int, int, int]
"""Blue, green, red."""

TEXT: Colour = (255, 255, 255)
WARNING: Colour = (60, 60, 255)
TARGET: Colour = (40, 190, 255)
UNTRACKED: Colour = (150, 150, 150)
PERSON: Colour = (80, 220, 80)
CUT: Colour = (60, 160, 255)
UNLIKELY: Colour = (150, 150, 150)
SEARCHED: Colour = (200, 170, 90)
ORDER: Colour = (255, 255, 255)
AREA: Colour = (220, 120, 190)
LANDMARK: dict[str, Colour] = {"used": (90, 230, 90), "reassigned": (60, 220, 255), "excluded": WARNING}
"""The colour of a landmark by its state in the fix."""
LETTERS = {"human": "H", "not_human": "N"}
"""The letter for each kind of target that ground vehicles report."""
LIKELY = 0.5
"""People with a lower probability are drawn as unlikely."""
_GOLDEN_DEG = 137.508  # consecutive identities get very different hues
TRAIL_LENGTH = 12
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def identity_colour(identity: int) -> Colour:
    """Return the colour of an identity. It is the same in every frame and on maps."""
    hue = identity * _GOLDEN_DEG % 360 / 2
    value = 255 - 55 * (identity // 5 % 2)
    (blue, green, red), *_ = cv2.cvtColor(np.array([[[hue, 200, value]]], np.uint8), cv2.COLOR_HSV2BGR)[0].tolist()
    return blue, green, red


def colour_picture(image: np.ndarray) -> np.ndarray:
    """Return a copy of a grey or colour image to draw on, (H, W, 3) uint8 BGR."""
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()


def line_width(picture: np.ndarray) -> int:
    """Return the width of drawn lines in pixels, which depends on the picture's height."""
    return max(1, round(picture.shape[0] / 480))


def drawable(points: np.ndarray) -> np.ndarray:
    """Return whole pixels that OpenCV can draw. Places far outside the picture are moved nearer."""
    return np.clip(np.nan_to_num(points), -30_000, 30_000).round().astype(np.int32)


def rectangle(picture: np.ndarray, box: np.ndarray, colour: Colour, thick: int) -> None:
    """Draw a box (x, y, width, height)."""
    x, y, right, bottom = drawable(np.array([*box[:2], *(box[:2] + box[2:])])).tolist()
    cv2.rectangle(picture, (x, y), (right - 1, bottom - 1), colour, thick)


def label(picture: np.ndarray, box: np.ndarray, text: str, colour: Colour) -> None:
    """Write a text on a coloured patch, above the box if there is room, and within the right edge of the picture."""
    scale, thick = max(picture.shape[0] / 1200, 0.35), line_width(picture)
    (width, height), _ = cv2.getTextSize(text, _FONT, scale, thick)
    x, y = drawable(box[:2]).tolist()
    if 0 <= x < picture.shape[1]:
        x = max(min(x, picture.shape[1] - width - 4), 0)
    top = y - height - 4 if y >= height + 4 else y
    cv2.rectangle(picture, (x, top), (x + width + 3, top + height + 3), colour, -1)
    cv2.putText(picture, text, (x + 2, top + height + 1), _FONT, scale, (0, 0, 0), thick, cv2.LINE_AA)


def _caption(picture: np.ndarray, *lines: tuple[str, Colour]) -> None:
    """Write lines that are not empty, each in its colour, along the lower edge, shortened to fit the width."""
    shown = [(text, colour) for text, colour in lines if text]
    height, width = picture.shape[:2]
    size, row, thick = max(height / 1000, 0.35), max(12, round(height / 28)), line_width(picture)
    top = max(height - row * len(shown) - row // 3, 0)
    picture[top:] = picture[top:] // 3
    for i, (text, colour) in enumerate(shown):
        plain = text.replace("×", "x").replace("−", "-").encode("ascii", "replace").decode()  # OpenCV's font is ASCII
        while len(plain) > 8 and cv2.getTextSize(plain, _FONT, size, thick)[0][0] > width - 8:
            plain = plain.removesuffix("...")[:-1] + "..." if len(plain) > 12 else plain[:-1]
        cv2.putText(picture, plain, (4, top + row * (i + 1) - row // 5), _FONT, size, colour, thick, cv2.LINE_AA)


def _arrow(picture: np.ndarray, start: np.ndarray, tip: np.ndarray, colour: Colour, thick: int, head: float) -> None:
    ends = drawable(np.stack([start, tip])).tolist()
    cv2.arrowedLine(picture, ends[0], ends[1], colour, thick, cv2.LINE_AA, tipLength=head)


def draw_scene(scene: Scene) -> np.ndarray:
    """Return the frame with its targets, (H, W, 3) uint8 BGR. The caption warns of an unreliable registration."""
    picture = colour_picture(scene.frame.image)
    foreground = scene.mask > 0
    if foreground.any():
        picture[foreground] = (0.7 * picture[foreground] + 0.3 * np.array(TARGET)).astype(np.uint8)
        outlines = cv2.findContours(foreground.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
        cv2.drawContours(picture, outlines, -1, TARGET, 1)
    found = scene.detections
    draw_detections(picture, found)
    text = f"frame {scene.frame.number}  interval {scene.interval_frames}  targets {len(found)}"
    doubt = "" if scene.reliable else f"registration unreliable: {scene.cause}"
    _caption(picture, (text, TEXT), (doubt, WARNING))
    return picture


def draw_detections(picture: np.ndarray, found: Detections) -> None:
    """Draw boxes with the direction and speed of their motion."""
    thick = line_width(picture)
    for box, heading, speed in zip(found.box_px, found.heading_rad, found.speed_px, strict=True):
        rectangle(picture, box, TARGET, thick)
        if not math.isnan(heading):
            length = 14 * thick + 4 * min(float(np.nan_to_num(speed)), 12.0)
            middle = box[:2] + box[2:] / 2
            _arrow(picture, middle, middle + length * np.array([np.cos(heading), np.sin(heading)]), TEXT, thick, 0.35)


def draw_people(found: PeopleFrame) -> np.ndarray:
    """Return the frame with its people, (H, W, 3) uint8 BGR.

    People cut by the border have another colour and a `?`. People below LIKELY have thin grey boxes under the others.
    """
    picture, people = colour_picture(found.frame.image), found.people
    thick = line_width(picture)
    for region in found.regions_px if found.regions_px is not None else ():
        rectangle(picture, region, SEARCHED, 1)
    worst_first = np.argsort(people.score, kind="stable").tolist()
    likely = [i for i in worst_first if people.score[i] >= LIKELY]
    colours = [CUT if cut else PERSON for cut in people.cut]
    for i in worst_first:
        sure = people.score[i] >= LIKELY
        rectangle(picture, people.box_px[i], colours[i] if sure else UNLIKELY, thick if sure else max(1, thick // 2))
        feet, radius = drawable(people.feet_px[i]).tolist(), 3 * thick if sure else thick
        cv2.circle(picture, feet, radius, colours[i] if sure else UNLIKELY, -1, cv2.LINE_AA)
        if sure:
            cv2.circle(picture, feet, radius, (0, 0, 0), 1, cv2.LINE_AA)
    for i in likely:  # draw labels over all boxes
        label(picture, people.box_px[i], f"{people.score[i]:.2f}{'?' if people.cut[i] else ''}", colours[i])
    searched = "everywhere" if found.regions_px is None else f"in {found.share:.0%} of the windows"
    unlikely = f" + {len(people) - len(likely)} unlikely" if len(likely) < len(people) else ""
    text = f"frame {found.frame.number}  people {len(likely)}{unlikely}  searched {searched}"
    _caption(picture, (text, TEXT), (found.cause, WARNING))
    return picture


class Trails:
    """The last places of every identity, moved along with the camera's motion. Frames are added in order.

    length: places kept per identity. memory_frames: an identity that is unseen for more frames is removed.
    places: identity -> frame number, u_px, v_px of each place.
    """

    def __init__(self, length: int, memory_frames: int = 250) -> None:
        self.length, self.memory = length, memory_frames
        self.places: dict[int, list[tuple[int, float, float]]] = {}

    def add(self, tracked: TrackedFrame) -> None:
        """Move all places into this frame by the camera's motion, and add the centres of its boxes."""
        if tracked.now_from_before is not None and self.places:
            points = np.array([place[1:] for trail in self.places.values() for place in trail], float)
            moved = iter(cv2.perspectiveTransform(points[None], tracked.now_from_before)[0].tolist())
            for trail in self.places.values():
                trail[:] = [(place[0], *next(moved)) for place in trail]
        number, tracks = tracked.number, tracked.tracks
        for identity, (x, y, w, h) in zip(tracks.identity.tolist(), tracks.box_px.tolist(), strict=True):
            trail = self.places.setdefault(identity, [])
            trail.append((number, x + w / 2, y + h / 2))
            del trail[: -self.length]
        for identity in [i for i, trail in self.places.items() if number - trail[-1][0] > self.memory]:
            del self.places[identity]

    def speed(self, identity: int) -> float:
        """Return the speed over the ground since the previous place, pixels a frame; NaN without a previous place."""
        trail = self.places[identity]
        if len(trail) < 2:
            return math.nan
        (before, u0, v0), (now, u1, v1) = trail[-2:]
        return math.hypot(u1 - u0, v1 - v0) / (now - before)


class RunPictures:
    """Draw frames of a run with tracks, landmarks, reports of ground vehicles, and orders to vehicles.

    Frames are shown in order. A frame is drawn only if a caller asks for it, and once for all callers.
    """

    def __init__(self, size: tuple[int, int], names: Sequence[str] = (), zones: Sequence[Zone] = ()) -> None:
        """size: (width, height) of the pictures, for frames that could not be read. names: the landmarks' names.

        zones: zones in pixels are drawn, and others are ignored.
        """
        self._size, self._names = size, tuple(names)
        self._zones = [zone for zone in zones if zone.unit == "px"]
        self._trails = Trails(TRAIL_LENGTH)
        self._shown: FrameResult | None = None
        self._picture: np.ndarray | None = None

    def show(self, result: FrameResult) -> None:
        """Add a frame to the trails, unless it is the frame that was shown last."""
        if result is not self._shown:
            self._trails.add(result.tracked)
            self._shown, self._picture = result, None

    def __call__(self, result: FrameResult) -> np.ndarray:
        """Return the picture of a frame, (H, W, 3) uint8 BGR; black if the frame could not be read.

        The caller must not draw on it.
        """
        self.show(result)
        if self._picture is None:
            self._picture = self._draw(result)
        return self._picture

    def _draw(self, result: FrameResult) -> np.ndarray:
        tracked, located = result.tracked, result.locations
        width, height = self._size
        black = np.zeros((height, width, 3), np.uint8)
        picture = black if tracked.frame is None else colour_picture(tracked.frame.image)
        thick = line_width(picture)
        for zone in self._zones:
            cv2.polylines(picture, list(map(drawable, zone.rings)), not zone.is_line, AREA, thick, cv2.LINE_AA)
            label(picture, np.array([*zone.rings[0][0], 0.0, 0.0]), zone.name, AREA)
        draw_tracks(picture, tracked, self._trails, target_words(result))
        text = f"frame {tracked.number}  identities {len(tracked.tracks)}  detections {len(tracked.detections)}"
        place = ("", TEXT) if located is None else _summarize_location(located)
        command = "" if result.command is None else _summarize_command(result.command)
        _caption(picture, (text, TEXT), (tracked.cause, WARNING), place, (command, TEXT))
        if located is not None:
            self._draw_landmarks(picture, located)
            self._draw_orders(picture, result, located)
        return picture

    def _draw_landmarks(self, picture: np.ndarray, located: AerialLocations) -> None:
        states = dict(zip(located.fix.landmark.tolist(), located.fix.state, strict=True))
        thick = line_width(picture)
        arm = 6 * thick
        for which, place in zip(located.marks.landmark.tolist(), located.marks.image_px, strict=True):
            if not np.isfinite(place).all():
                continue
            state = states.get(which, "excluded")
            colour, middle = LANDMARK.get(state, WARNING), drawable(place).tolist()
            cv2.circle(picture, middle, 2 * arm, colour, thick, cv2.LINE_AA)
            cv2.drawMarker(picture, middle, colour, cv2.MARKER_CROSS, arm, thick)
            name = self._names[which] + ("" if state == "used" else f" {state}")
            label(picture, np.array([place[0] + 2 * arm, place[1] - arm, 0, 0]), name, colour)

    def _draw_orders(self, picture: np.ndarray, result: FrameResult, located: AerialLocations) -> None:
        """Draw an arrow from each vehicle towards its goal, at most a tenth of the picture long."""
        to_metres, marks = command_metres(result), located.marks
        if result.command is None or to_metres is None or not result.command.orders:
            return
        to_pixels = _pixels_per_metre(located)
        if to_pixels is None:
            return
        rows = {self._names[k]: row for row, k in enumerate(marks.landmark.tolist())}
        for order in result.command.orders:
            row = rows.get(order.vehicle)
            if row is None or not np.isfinite(marks.image_px[row]).all():
                continue
            way = to_pixels @ (to_metres(order.goal) - marks.east_north_m[row])
            length = float(np.hypot(*way))
            if length > 4 * line_width(picture):
                tip = marks.image_px[row] + way * min(1.0, picture.shape[0] / 10 / length)
                _arrow(picture, marks.image_px[row], tip, ORDER, line_width(picture) + 1, 0.3)


def draw_tracks(picture: np.ndarray, tracked: TrackedFrame, trails: Trails, words: Mapping[int, str]) -> None:
    """Draw trails, boxes and identities. words: identity -> text behind its number."""
    thick, tracks = line_width(picture), tracked.tracks
    for row in tracked.untracked:
        rectangle(picture, tracked.detections.box_px[row], UNTRACKED, 1)
    for identity, box, row in zip(tracks.identity.tolist(), tracks.box_px, tracks.row, strict=True):
        colour = identity_colour(identity)
        way = drawable(np.array([place[1:] for place in trails.places[identity]]))
        cv2.polylines(picture, [way], False, colour, thick, cv2.LINE_AA)
        rectangle(picture, box, colour, thick + 1 if row >= 0 else 1)
        label(picture, box, f"{identity}{words.get(identity, '')}", colour)


def target_words(result: FrameResult) -> dict[int, str]:
    """Return a text for each target: the letter of its kind, and the fused number if several platforms see it."""
    located, confirmed, fused = result.locations, result.confirmed, result.fused
    words: dict[int, str] = {}
    if confirmed is not None and located is not None:
        targets = located.positions.target[confirmed.row].tolist()
        words = {t: f" {LETTERS.get(kind, '?')}" for t, kind in zip(targets, confirmed.kind, strict=True)}
    if fused is not None:
        rows = zip(fused.target.tolist(), fused.seen_by, strict=True)
        numbers = {seen.get(fused.by): f" fused {number}" for number, seen in rows if len(seen) > 1}
        words = {k: words.get(k, "") + numbers.get(k, "") for k in words.keys() | numbers.keys()}
    return words


def _summarize_location(located: AerialLocations) -> tuple[str, Colour]:
    """Return a text on the method and the precision of the frame's location, and the colour of the text."""
    fix = located.fix
    if not fix.by:
        return f"not located: {fix.cause}", WARNING
    used = len(fix.state) - fix.state.count("excluded")
    landmarks = f"{used} of {len(fix.state)} landmarks, " if fix.state else ""
    text = f"located by {fix.by}, {landmarks}{len(located.positions)} targets"
    sigma_m = np.sqrt(np.trace(located.positions.covariance_m2, axis1=1, axis2=2))
    if np.isfinite(sigma_m).any():
        text += f" to {np.nanmedian(sigma_m):.2f} m"
    remarks = "; ".join([*fix.changes, fix.cause]).strip("; ")
    return (f"{text}; {remarks}", WARNING) if remarks else (text, TEXT)


def _summarize_command(command: Command) -> str:
    words = [f"every {command.every}"] if command.every > 1 else []
    if command.orders:
        words.append(f"sent: {', '.join(order.vehicle for order in command.orders)}")
    if command.altitude_m is not None and math.isfinite(command.altitude_m):
        words.append(f"fly at {command.altitude_m:.0f} m")
    return "; ".join(words)


ToMetres = Callable[[np.ndarray], np.ndarray]
"""A function that returns the local metres (2,) of a place in a command."""


def command_metres(result: FrameResult) -> ToMetres | None:
    """Return a function from the places of a frame's commands to local metres; None if the scale is unknown.

    Commands are in degrees if landmarks have degrees, else in local metres. The scale follows from the landmarks.
    """
    located, degrees = result.locations, result.mark_lonlat_deg
    if located is None:
        return None
    if degrees is None:
        return lambda place: np.asarray(place, float)
    metres = located.marks.east_north_m
    both = np.isfinite(degrees).all(axis=1) & np.isfinite(metres).all(axis=1)
    # If landmarks are less than a metre apart, rounding would dominate the scale.
    if both.sum() < 2 or (np.ptp(metres[both], axis=0) < 1.0).any():
        return None
    middle_deg, middle_m = degrees[both].mean(axis=0), metres[both].mean(axis=0)
    scale = np.ptp(metres[both], axis=0) / np.ptp(degrees[both], axis=0)

    def to_metres(place: np.ndarray) -> np.ndarray:
        place = np.asarray(place, float)
        # A place more than a degree from the landmarks is already in local metres.
        return place if np.abs(place - middle_deg).max() > 1.0 else middle_m + (place - middle_deg) * scale

    return to_metres


def _pixels_per_metre(located: AerialLocations) -> np.ndarray | None:
    """Return (2, 2) pixels right and down per metre east and north, near the landmarks; None if unknown."""
    marks = located.marks
    both = np.isfinite(marks.image_px).all(axis=1) & np.isfinite(marks.east_north_m).all(axis=1)
    place, pixel = marks.east_north_m[both], marks.image_px[both]
    apart = place - place.mean(axis=0) if len(place) >= 3 else np.zeros((2, 2))
    if np.linalg.svd(apart, compute_uv=False)[-1] < 1.0:  # fewer than three places, or nearly on one line
        return None
    return np.asarray(np.linalg.lstsq(apart, pixel - pixel.mean(axis=0), rcond=None)[0].T)
