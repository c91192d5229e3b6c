"""A map of a run as a picture: tracks with their numbers and 95 % ellipses, landmarks, the camera's path and view."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import cv2
import numpy as np

from torchvision_dddas.geometry import rays, undistort_pixels
from torchvision_dddas.io.maps.ground_tracks import GroundTracks, ring_m, semi_axes
from torchvision_dddas.io.overlay import Colour, identity_colour
from torchvision_dddas.types import Camera, Fix, Ortho

FINE = 2
"""The map is drawn larger by this factor and then reduced, so that thin lines and small letters look clean."""
WIDTH = 1400
LEFT, RIGHT, TOP, BOTTOM = 86, 24, 46, 106
SHORTEST, TALLEST = 420, 880
INK, GRID, PAPER = (60, 60, 60), (222, 222, 222), (255, 255, 255)
MARK, LOOK, VIEW, PATH = (30, 30, 200), (150, 110, 40), (0, 130, 240), (120, 120, 120)
EVENTS: dict[str, tuple[str, str, Colour]] = {
    "enter": ("E", "entered", (60, 130, 20)),
    "leave": ("L", "left", (40, 70, 190)),
    "cross": ("X", "crossed", (170, 90, 30)),
    "dwell": ("D", "dwelt", (0, 130, 200)),
    "present": ("P", "inside at first", (110, 110, 110)),
    "join": ("J", "joined", (120, 40, 120)),
    "split": ("S", "split off", (150, 110, 0)),
    "gather": ("G", "gathered", (120, 40, 120)),
    "scatter": ("C", "scattered", (150, 110, 0)),
    "human": ("H", "judged human", (60, 130, 20)),
    "not_human": ("N", "judged not human", (40, 70, 190)),
}
"""The letter, name and colour of each kind of event: at zones, of crowds, and confirmations by ground vehicles."""
AREA, FUSED = (150, 60, 120), (110, 130, 0)
_LINES_ACROSS = 12
_SUB = 3  # fractional bits of the pixel coordinates that OpenCV draws
_MOST_SIGNS = 400
_LOOKS_APART_M = 2.0
_LOWEST = math.sin(math.radians(3))  # flatter rays are cut at the distance of a ray 3 degrees below the horizon


class Signs:
    """Map signs: zones, events, and looks, which are the places from which ground vehicles saw targets.

    zones: name, rings (N, 2), and whether the zone is a line. At most 800 events and 400 looks are kept. Successive
    looks of a vehicle are at least 2 m apart.
    """

    def __init__(self) -> None:
        self.looks: list[tuple[np.ndarray, np.ndarray]] = []
        self.zones: list[tuple[str, list[np.ndarray], bool]] = []
        self.events: list[tuple[str, np.ndarray]] = []
        self._last: dict[str, np.ndarray] = {}

    def add_event(self, kind: str, east_north_m: np.ndarray) -> None:
        """Add an event, if its place is known: an event at a zone or of crowds, or a new confirmation of a target."""
        if len(self.events) < 2 * _MOST_SIGNS and np.isfinite(east_north_m).all():
            self.events.append((kind, np.array(east_north_m, float)))

    def add_look(self, vehicle: str, from_m: np.ndarray, at_m: np.ndarray) -> None:
        """Add a look: the places of a vehicle and of a target that it saw."""
        last = self._last.get(vehicle)
        if not np.isfinite(from_m).all() or (last is not None and np.linalg.norm(from_m - last) < _LOOKS_APART_M):
            return
        self._last[vehicle] = np.array(from_m, float)
        if len(self.looks) < _MOST_SIGNS:
            self.looks.append((np.array(from_m, float), np.array(at_m, float)))


@dataclass(frozen=True)
class CameraPath:
    """The camera's places (M, 2), and the outline of its last view (K, 2), east and north in m; empty if unknown.

    views: frame number, time and outline of some of its views.
    """

    east_north_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    view_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    views: Sequence[tuple[int, float, np.ndarray]] = ()


def map_picture(
    tracks: GroundTracks,
    landmarks: GroundTracks,
    names: Sequence[str] = (),
    camera: CameraPath | None = None,
    photo: Ortho | None = None,
    title: str = "",
    signs: Signs | None = None,
) -> np.ndarray:
    """Return the map, (H, 1400, 3) uint8 BGR, north up, over a photo of the ground or a plain grid.

    Places far outside the range of the middle 96 % are not shown; a text states how many lie outside. The line of a
    track is interrupted at gaps.
    """
    camera, signs = camera or CameraPath(), signs or Signs()
    frame = frame_around(extent(tracks, landmarks, camera, signs))
    picture = np.full(((frame.height + TOP + BOTTOM) * FINE, WIDTH * FINE, 3), 255, np.uint8)
    plot = picture[frame.plot]
    if photo is not None:
        # Fade the photo, so that the drawing over it stands out.
        plot[:] = (0.75 * ground_photo(frame, photo) + 0.25 * 255).astype(np.uint8)
    _draw_grid(picture, frame, photo is not None)
    _draw_zones(plot, frame, signs)
    if len(camera.view_m):
        _dashes(plot, frame.pixels(np.concatenate([camera.view_m, camera.view_m[:1]])), VIEW, 2)
    if len(camera.east_north_m):
        _line(plot, frame.pixels(camera.east_north_m), INK, 1, halo=True)
    for rows in landmarks.of.values():
        _line(plot, frame.pixels(landmarks.east_north_m[rows]), PATH, 1)
    for target, rows in tracks.of.items():
        for piece in tracks.pieces(rows):
            _line(plot, frame.pixels(tracks.east_north_m[piece]), _dark(target), 2, halo=True)
    last = {target: tracks.east_north_m[rows.stop - 1] for target, rows in tracks.of.items()}
    marked = {mark: landmarks.east_north_m[rows.stop - 1] for mark, rows in landmarks.of.items()}
    for (target, place), ring in zip(last.items(), _last_rings(tracks), strict=True):
        if np.isfinite(ring).all():
            _line(plot, frame.pixels(np.concatenate([ring, ring[:1]])), _dark(target), 1, halo=True)
        _disc(plot, frame.pixels(place), 4, _dark(target))
    for from_m, at_m in signs.looks:
        _draw_look(plot, frame.pixels(from_m), frame.pixels(at_m))
    for kind, place in signs.events:
        _draw_letter(plot, frame.pixels(place), EVENTS[kind][0], EVENTS[kind][2])
    labels = _Labels(picture, frame, [*(place for _, place in signs.events), *last.values(), *marked.values()])
    for mark, place in marked.items():
        _draw_landmark(plot, frame.pixels(place))
        labels.add(place, names[mark], MARK)
    for target, place in last.items():
        labels.add(place, str(target), _dark(target))
    for name, rings, _ in signs.zones:
        labels.add(rings[0][0], name, AREA)
    _draw_scale(picture, frame)
    if len(camera.east_north_m):
        _draw_camera(plot, frame.pixels(camera.east_north_m[-1]))
    _write(picture, title, (LEFT + 26, TOP - 14), 0.62)
    _draw_legend(picture, frame, camera, len(landmarks) > 0, signs)
    places = frame.pixels(tracks.east_north_m) / FINE
    outside = int(((places < 0) | (places > (frame.width, frame.height))).any(axis=1).sum())
    count = f"{len(tracks.of)} identities, {len(tracks)} places" + (f", {outside} outside the map" if outside else "")
    _write(picture, count, (LEFT, TOP + frame.height + BOTTOM - 12), 0.5)
    _draw_event_legend(picture, LEFT + 30 + _text_width(count, 0.5), TOP + frame.height + BOTTOM - 17, signs)
    return cv2.resize(picture, None, fx=1 / FINE, fy=1 / FINE, interpolation=cv2.INTER_AREA)


def view_of(fix: Fix, camera: Camera) -> np.ndarray:
    """Return (K, 2) local metres of the ground (up = 0) along the picture's border; empty if unknown."""
    width, height = camera.size_px
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], float)
    share = np.linspace(0, 1, 8, endpoint=False)[:, None]
    border = np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    if fix.pose is not None and fix.pose.place_m[2] > 0:
        directions = rays(border, fix.pose, camera)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        reach_m = fix.pose.place_m[2] / np.maximum(-directions[:, 2], _LOWEST)
        view = fix.pose.place_m[:2] + directions[:, :2] * reach_m[:, None]
        return view[np.isfinite(view).all(axis=1)]
    if fix.image_from_ground is None or not np.isfinite(np.linalg.cond(fix.image_from_ground)):
        return np.zeros((0, 2))
    if fix.by != "paper":
        border = undistort_pixels(border, camera)
        border = border[np.isfinite(border).all(axis=1)]
    ground = np.c_[border, np.ones(len(border))] @ np.linalg.inv(fix.image_from_ground).T
    # If the border crosses the horizon, the third coordinates have both signs, and the view has no outline.
    has_one_sign = (ground[:, 2] > 0).all() or (ground[:, 2] < 0).all()
    return ground[:, :2] / ground[:, 2:] if has_one_sign else np.zeros((0, 2))


# --------------------------------------------------------------------------------------------------------------------
# The frame.


@dataclass(frozen=True)
class MapFrame:
    """West and south edge in local metres, metres per pixel, and the plot's size in pixels of the finished picture."""

    west_m: float
    south_m: float
    metres_a_pixel: float
    width: int
    height: int

    def pixels(self, east_north_m: np.ndarray) -> np.ndarray:
        """Return (..., 2) x, y in the plot, in pixels of the enlarged picture."""
        fine = FINE / self.metres_a_pixel
        return (np.asarray(east_north_m, float) - (self.west_m, self.south_m)) * (fine, -fine) + (0, self.height * FINE)

    @property
    def box_m(self) -> list[float]:
        """West, south, east and north edge in local metres."""
        wide, high = self.width * self.metres_a_pixel, self.height * self.metres_a_pixel
        return [self.west_m, self.south_m, self.west_m + wide, self.south_m + high]

    @property
    def plot(self) -> tuple[slice, slice]:
        """Rows and columns of the plot in the enlarged picture."""
        return slice(TOP * FINE, (TOP + self.height) * FINE), slice(LEFT * FINE, (LEFT + self.width) * FINE)


def frame_around(east_north_m: np.ndarray) -> MapFrame:
    """Return a frame that shows all places with a margin around them; ten metres wide without places."""
    known = east_north_m[np.isfinite(east_north_m).all(axis=1)]
    low, high = (known.min(axis=0), known.max(axis=0)) if len(known) else (np.zeros(2), np.zeros(2))
    middle, size = (low + high) / 2, np.maximum((high - low) * 1.16, 10.0)
    width = WIDTH - LEFT - RIGHT
    height = round(min(max(width * size[1] / size[0], SHORTEST), TALLEST))
    metres = max(size[0] / width, size[1] / height)
    west, south = middle - np.array([width, height]) * metres / 2
    return MapFrame(float(west), float(south), float(metres), width, height)


def extent(tracks: GroundTracks, landmarks: GroundTracks, camera: CameraPath, signs: Signs) -> np.ndarray:
    """Return places that the map must show: also the camera's path and view, zones and ellipses, if they are near."""
    targets = tracks.east_north_m[np.isfinite(tracks.east_north_m).all(axis=1)]
    if len(targets):
        low, high = np.percentile(targets, (2, 98), axis=0)
        reach = np.maximum(high - low, 20.0)
        targets = targets[((targets >= low - reach) & (targets <= high + reach)).all(axis=1)]
    shown = np.concatenate([targets, landmarks.east_north_m])
    zones = [np.concatenate(rings)[None] for _, rings, _ in signs.zones]
    for more in (camera.east_north_m[None], camera.view_m[None], *zones, _last_rings(tracks)):
        if len(shown) == 0:
            shown = more.reshape(-1, 2)
        elif more.size:
            reach = 1.5 * max(float(np.ptp(shown, axis=0).max()), 20.0)
            is_near = np.abs(more - (shown.min(axis=0) + shown.max(axis=0)) / 2) <= reach
            shown = np.concatenate([shown, more[is_near.all(axis=(1, 2))].reshape(-1, 2)])
    return shown


def _last_rings(tracks: GroundTracks) -> np.ndarray:
    """Return (T, 72, 2) the 95 % ellipse of each target's last place; NaN if unknown."""
    last = [rows.stop - 1 for rows in tracks.of.values()]
    return tracks.east_north_m[last, None] + ring_m(*semi_axes(tracks.covariance_m2[last]), points=72)


def round_step(span: float, lines: int) -> float:
    """Return a step of 1, 2 or 5 times a power of ten, so that about `lines` steps cover a span."""
    power = 10.0 ** math.floor(math.log10(span / lines))
    return next(power * k for k in (1, 2, 5, 10) if power * k >= span / lines)


def ground_photo(frame: MapFrame, photo: Ortho) -> np.ndarray:
    """Warp the photo into the frame's plot, (H, W, 3) in pixels of the enlarged picture; white outside the photo."""
    fine, size = FINE / frame.metres_a_pixel, (frame.width * FINE, frame.height * FINE)
    plot_from_metres = np.array([[fine, 0, -frame.west_m * fine], [0, -fine, size[1] + frame.south_m * fine]])
    whole = np.vstack([photo.east_north_from_pixel, [0, 0, 1]])
    image, plot_from_pixel = photo.image, np.vstack([plot_from_metres @ whole, [0, 0, 1]])
    # Reduce a photo that is much finer than the map first, because warping does not average pixels.
    coarser = int(1 / max(np.sqrt(abs(np.linalg.det(plot_from_pixel[:2, :2]))), 1e-3))
    if coarser > 1:
        small = max(image.shape[1] // coarser, 1), max(image.shape[0] // coarser, 1)
        share = np.array([image.shape[1] / small[0], image.shape[0] / small[1]])
        image = cv2.resize(image, small, interpolation=cv2.INTER_AREA)
        # Pixel coordinates start at the centre of the first pixel.
        plot_from_pixel = plot_from_pixel @ np.array(
            [[share[0], 0, (share[0] - 1) / 2], [0, share[1], (share[1] - 1) / 2], [0, 0, 1]]
        )
    return cv2.warpAffine(image, plot_from_pixel[:2], size, flags=cv2.INTER_LINEAR, borderValue=PAPER)


def _draw_grid(picture: np.ndarray, frame: MapFrame, over_photo: bool) -> None:
    """Draw grid lines in the plot, and their numbers outside the plot."""
    rows, columns = frame.plot
    plot = picture[rows, columns]
    size = np.array([frame.width, frame.height]) * frame.metres_a_pixel
    step = round_step(float(size[0]), _LINES_ACROSS)
    digits = max(0, -math.floor(math.log10(step)))
    for axis, start in enumerate((frame.west_m, frame.south_m)):
        for k in range(math.ceil(start / step), math.floor((start + size[axis]) / step) + 1):
            at = round(float(frame.pixels(np.full(2, k * step))[axis]))
            lines = plot if axis == 0 else plot.swapaxes(0, 1)
            part = lines[:, max(at - 1, 0) : at + 1]
            part[:] = part // 2 + 128 if over_photo else GRID
            text = f"{k * step:.{digits}f}"
            wide = _text_width(text, 0.5)
            below, beside = (
                (at / FINE + LEFT - wide / 2, frame.height + TOP + 20),
                (LEFT - wide - 8, at / FINE + TOP + 5),
            )
            _write(picture, text, below if axis == 0 else beside, 0.5)
    cv2.rectangle(picture, (columns.start, rows.start), (columns.stop, rows.stop), INK, FINE)
    _write(picture, "north, m", (10, TOP - 12), 0.5)
    _write(picture, "east, m", (WIDTH - RIGHT - _text_width("east, m", 0.5), frame.height + TOP + 40), 0.5)


def _draw_scale(picture: np.ndarray, frame: MapFrame) -> None:
    """Draw a scale bar of a round length and an arrow to the north, outside the plot."""
    length = round_step(frame.width * frame.metres_a_pixel, _LINES_ACROSS)
    right, low = WIDTH - RIGHT - 4, TOP + frame.height + BOTTOM - 18
    left = right - length / frame.metres_a_pixel
    for a, b in (((left, low - 5), (left, low + 5)), ((right, low - 5), (right, low + 5)), ((left, low), (right, low))):
        cv2.line(picture, _fine(*a), _fine(*b), INK, 2 * FINE)
    text = f"{length:g} m"
    _write(picture, text, (left - _text_width(text, 0.5) - 12, low + 5), 0.5)
    x, y = WIDTH - RIGHT - 12, 8
    cv2.arrowedLine(picture, _fine(x, y + 30), _fine(x, y), INK, 2 * FINE, cv2.LINE_AA, tipLength=0.4)
    _write(picture, "N", (x - 12 - _text_width("N", 0.55), y + 26), 0.55)


def _draw_legend(picture: np.ndarray, frame: MapFrame, camera: CameraPath, has_landmarks: bool, signs: Signs) -> None:
    def target(picture: np.ndarray, at: np.ndarray) -> None:
        turn = np.linspace(0, 2 * np.pi, 40)
        _line(picture, at + FINE * np.stack([13 * np.cos(turn), 7 * np.sin(turn)], axis=1), _dark(1), 1)
        _disc(picture, at, 4, _dark(1))

    def view(picture: np.ndarray, at: np.ndarray) -> None:
        _dashes(picture, at + FINE * np.array([[-14.0, 0], [14, 0]]), VIEW, 2)

    def look(picture: np.ndarray, at: np.ndarray) -> None:
        _draw_look(picture, at - (9.0 * FINE, 0.0), at)

    entries: list[tuple[bool, str, Callable[[np.ndarray, np.ndarray], None]]] = [
        (True, "target: number, way, 95 % ellipse of the last place", target),
        (has_landmarks, "landmark", _draw_landmark),
        (len(camera.east_north_m) > 0, "camera", _draw_camera),
        (len(camera.view_m) > 0, "its last view", view),
        (len(signs.looks) > 0, "seen from here", look),
    ]
    x, y = LEFT + 8.0, TOP + frame.height + 62
    shown = [(text, draw) for is_shown, text, draw in entries if is_shown]
    for text, draw in shown:
        draw(picture, np.array([x, y]) * FINE)
        _write(picture, text, (x + 20, y + 5), 0.5)
        x += 20 + _text_width(text, 0.5) + (40 if len(shown) < 6 else 22)


def _draw_event_legend(picture: np.ndarray, x: float, y: float, signs: Signs) -> None:
    kinds = {kind for kind, _ in signs.events}
    for kind, (letter, text, colour) in EVENTS.items():
        if kind in kinds:
            _draw_letter(picture, np.array([x, y]) * FINE, letter, colour)
            _write(picture, text, (x + 14, y + 5), 0.5)
            x += 34 + _text_width(text, 0.5)


def _draw_zones(plot: np.ndarray, frame: MapFrame, signs: Signs) -> None:
    """Draw areas tinted and outlined, and lines with an arrow in the direction `to_right`."""
    areas = [[frame.pixels(ring) for ring in rings] for _, rings, is_line in signs.zones if not is_line]
    tinted = plot.copy()
    for rings in areas:
        cv2.fillPoly(tinted, [_fixed(ring) for ring in rings], AREA, cv2.LINE_AA, _SUB)
    cv2.addWeighted(tinted, 0.12, plot, 0.88, 0, dst=plot)
    for ring in (ring for rings in areas for ring in rings):
        _line(plot, np.concatenate([ring, ring[:1]]), AREA, 2)
    for line in (frame.pixels(ring) for _, rings, is_line in signs.zones if is_line for ring in rings):
        _line(plot, line, AREA, 3)
        k = len(line) // 2
        middle, way = (line[k - 1] + line[k]) / 2, line[k] - line[k - 1]
        right = np.array([-way[1], way[0]]) / max(float(np.hypot(*way)), 1e-9)  # y grows downward
        tip, across = middle + 26 * FINE * right, way / max(float(np.hypot(*way)), 1e-9)
        _line(plot, np.array([middle, tip]), AREA, 2)
        _fill(plot, tip + FINE * np.array([8 * right, 5 * across, -5 * across]), AREA)


# --------------------------------------------------------------------------------------------------------------------
# Signs and lines; places are in pixels of the enlarged picture.


class _Labels:
    """Writes labels beside their places. A label that would cover another label or a sign is moved around its place."""

    def __init__(self, picture: np.ndarray, frame: MapFrame, signs_m: Sequence[np.ndarray]) -> None:
        """signs_m: places of signs that no label may cover."""
        self._picture, self._frame = picture, frame
        self._low = TOP + frame.height
        self._taken = [(x - 6, y - 6, x + 6, y + 6) for x, y in map(self._pixel, signs_m)]

    def add(self, east_north_m: np.ndarray, text: str, colour: Colour) -> None:
        """Write a label beside a place, if the map shows the place."""
        x, y = self._pixel(east_north_m)
        if not (LEFT <= x <= WIDTH - RIGHT and TOP <= y <= self._low):
            return
        wide = _text_width(text, 0.5)
        places = [(x + 9, y - 6), (x + 9, y + 16), (x - 9 - wide, y - 6), (x - 9 - wide, y + 16)]
        places += [(x - wide / 2, y - 12), (x - wide / 2, y + 22), (x + 22, y + 5), (x - 22 - wide, y + 5)]
        boxes = [(left - 1, low - 13, left + wide + 1, low + 2) for left, low in places]
        chosen = next((k for k, box in enumerate(boxes) if self._is_free(box)), 0)
        self._taken.append(boxes[chosen])
        _write(self._picture, text, places[chosen], 0.5, colour, halo=True)

    def _pixel(self, east_north_m: np.ndarray) -> tuple[float, float]:
        x, y = (self._frame.pixels(east_north_m) / FINE + (LEFT, TOP)).tolist()
        return x, y

    def _is_free(self, box: tuple[float, float, float, float]) -> bool:
        left, top, right, low = box
        is_inside = left > LEFT and right < WIDTH - RIGHT and top > TOP and low < self._low
        return is_inside and not any(left < b[2] and b[0] < right and top < b[3] and b[1] < low for b in self._taken)


def _draw_camera(picture: np.ndarray, at: np.ndarray) -> None:
    _fill(picture, at + FINE * np.array([[0, -9], [8, 6], [-8, 6]]), INK)


def _draw_landmark(picture: np.ndarray, at: np.ndarray) -> None:
    for size, colour in ((9, PAPER), (7, MARK)):
        _fill(picture, at + FINE * size * np.array([[0, -1], [1, 0], [0, 1], [-1, 0]]), colour)


def _draw_look(picture: np.ndarray, from_xy: np.ndarray, at_xy: np.ndarray) -> None:
    """Draw a wedge from the place of a vehicle, open towards the target that it saw."""
    way = at_xy - from_xy
    edge = np.arctan2(way[1], way[0]) + np.linspace(-0.38, 0.38, 9)
    shape = np.vstack([from_xy, from_xy + 26.0 * FINE * np.stack([np.cos(edge), np.sin(edge)], axis=1)])
    low = np.floor(np.clip(shape.min(axis=0) - 2, 0, None)).astype(int)
    high = np.ceil(shape.max(axis=0) + 2).astype(int)
    part = picture[low[1] : max(high[1], 0), low[0] : max(high[0], 0)]
    if part.size:
        tinted = part.copy()
        _fill(tinted, shape - low, LOOK)
        cv2.addWeighted(tinted, 0.35, part, 0.65, 0, dst=part)
    _dashes(picture, shape[[1, 0, -1]], LOOK, 1, dash=400.0 * FINE)


def _draw_letter(picture: np.ndarray, at: np.ndarray, letter: str, colour: Colour) -> None:
    """Draw a disc with a letter, such as H for human."""
    _disc(picture, at, 9, colour)
    (wide, high), _ = cv2.getTextSize(letter, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * FINE, 2 * FINE)
    x, y = np.round(np.clip(np.nan_to_num(at), -30_000, 30_000)).astype(int).tolist()
    cv2.putText(picture, letter, (x - wide // 2, y + high // 2), 0, 0.5 * FINE, PAPER, 2 * FINE, cv2.LINE_AA)


def _disc(picture: np.ndarray, at: np.ndarray, radius: int, colour: Colour) -> None:
    """Draw a disc with a white rim. radius: in pixels of the finished picture."""
    centre = _fixed(at).tolist()
    cv2.circle(picture, centre, ((radius + 1) * FINE) << _SUB, PAPER, -1, cv2.LINE_AA, _SUB)
    cv2.circle(picture, centre, (radius * FINE) << _SUB, colour, -1, cv2.LINE_AA, _SUB)


def _fill(picture: np.ndarray, points: np.ndarray, colour: Colour) -> None:
    cv2.fillPoly(picture, [_fixed(points)], colour, cv2.LINE_AA, _SUB)


def _line(picture: np.ndarray, points: np.ndarray, colour: Colour, thick: int, halo: bool = False) -> None:
    """Draw a line through (N, 2) pixels. thick: in pixels of the finished picture. halo: draw a white rim."""
    if len(points) > 99:
        # Simplify a long track, because drawing its jitter within a pixel would take most of the time.
        points = cv2.approxPolyDP(points.astype(np.float32)[:, None], 0.4 * FINE, False)[:, 0]
    if halo:
        cv2.polylines(picture, [_fixed(points)], False, PAPER, (thick + 2) * FINE, cv2.LINE_AA, _SUB)
    cv2.polylines(picture, [_fixed(points)], False, colour, thick * FINE, cv2.LINE_AA, _SUB)


def _dashes(picture: np.ndarray, points: np.ndarray, colour: Colour, thick: int, dash: float = 9.0 * FINE) -> None:
    """Draw the part of a dashed line that lies in the picture."""
    height, width = picture.shape[:2]
    whole = np.clip(np.nan_to_num(points), -1e6, 1e6).round().astype(int).tolist()
    for a, b in pairwise(whole):
        is_inside, *ends = cv2.clipLine((0, 0, width, height), a, b)
        if is_inside:
            start, end = (np.array(e, float) for e in ends)
            count = max(int(np.hypot(*(end - start)) / dash), 1)
            for k in range(0, count, 2):
                piece = start + (end - start) * np.array([[k], [min(k + 1, count)]]) / count
                _line(picture, piece, colour, thick)


def _write(
    picture: np.ndarray, text: str, at: tuple[float, float], size: float, colour: Colour = INK, halo: bool = False
) -> None:
    """Write a text that starts at a place of the finished picture. OpenCV only draws ASCII, so others become `?`."""
    text = text.encode("ascii", "replace").decode()
    for tint, thick in ((PAPER, 4 * FINE), (colour, FINE))[not halo :]:
        cv2.putText(picture, text, _fine(*at), cv2.FONT_HERSHEY_SIMPLEX, size * FINE, tint, thick, cv2.LINE_AA)


def _text_width(text: str, size: float) -> float:
    """Return the width of a text in pixels of the finished picture."""
    return float(cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size * FINE, FINE)[0][0] / FINE)


def _fine(x: float, y: float) -> tuple[int, int]:
    """Convert a place of the finished picture to pixels of the enlarged picture."""
    return round(x * FINE), round(y * FINE)


def _fixed(points: np.ndarray) -> np.ndarray:
    """Return fixed-point pixels for OpenCV. Pixels far outside are clipped."""
    return np.round(np.clip(np.nan_to_num(points), -30_000, 30_000) * 2**_SUB).astype(np.int32)


def _dark(target: int) -> Colour:
    """Return a target's colour in the overlay, made darker for a white background."""
    blue, green, red = (round(0.72 * c) for c in identity_colour(target))
    return blue, green, red
