"""A map of a run: tracks with their numbers and 95 % ellipses, landmarks, the camera's path and last view."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import cv2
import numpy as np

from torchvision_dddas.geo.projection import rays, undistort_pixels
from torchvision_dddas.io.maps.ellipses import ring_m, semi_axes
from torchvision_dddas.io.maps.ground_tracks import GroundTracks
from torchvision_dddas.io.maps.map_drawing import (
    BOTTOM,
    FINE,
    INK,
    LEFT,
    MARK,
    PAPER,
    TOP,
    Labels,
    MapFrame,
    blank,
    dashes,
    draw_camera,
    draw_dot,
    draw_grid,
    draw_landmark,
    draw_look,
    draw_scale,
    draw_verdict,
    frame_around,
    line,
    text_width,
    write,
)
from torchvision_dddas.io.overlay import Colour, identity_colour
from torchvision_dddas.types import Camera, Fix, Ortho

_MOST_SIGNS = 400
_LOOKS_APART_M = 2.0
VIEW = (0, 130, 240)
_LOWEST = float(np.sin(np.radians(3)))  # flatter rays end where one at 3 degrees reaches the ground


class Signs:
    """Map signs of what ground vehicles did: where a target was found human or not, and from where they looked.

    Each vehicle has a look every 2 m; there are at most 400 looks and 400 verdicts.
    """

    def __init__(self) -> None:
        self.verdicts: list[tuple[int, str, np.ndarray]] = []
        self.looks: list[tuple[np.ndarray, np.ndarray]] = []
        self._last: dict[str, np.ndarray] = {}

    def add_verdict(self, target: int, kind: str, east_north_m: np.ndarray) -> None:
        """Add the place where a target was first found human or not_human, or otherwise than before."""
        if len(self.verdicts) < _MOST_SIGNS:
            self.verdicts.append((target, kind, np.array(east_north_m, float)))

    def add_look(self, vehicle: str, from_m: np.ndarray, at_m: np.ndarray) -> None:
        """Add the places of a vehicle and of a target that it saw."""
        last = self._last.get(vehicle)
        if not np.isfinite(from_m).all() or (last is not None and np.linalg.norm(from_m - last) < _LOOKS_APART_M):
            return
        self._last[vehicle] = np.array(from_m, float)
        if len(self.looks) < _MOST_SIGNS:
            self.looks.append((np.array(from_m, float), np.array(at_m, float)))


@dataclass(frozen=True)
class CameraPath:
    """The camera's places (M, 2), and the outline of its last view (K, 2), east and north in m; empty if unknown."""

    east_north_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    view_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))


def map_picture(
    tracks: GroundTracks,
    landmarks: GroundTracks,
    names: Sequence[str] = (),
    camera: CameraPath | None = None,
    photo: Ortho | None = None,
    title: str = "",
    signs: Signs | None = None,
) -> np.ndarray:
    """(H, 1400, 3) uint8 BGR, north up, over a photo of the ground or a plain grid.

    A few places far from all others, farther than the middle 96 % reach, do not stretch the map; it says how
    many lie outside. Lines are broken where a target was not located for a while.
    """
    camera = camera or CameraPath()
    frame = frame_around(_extent(tracks.east_north_m, landmarks.east_north_m, camera))
    picture = blank(frame)
    plot = picture[frame.plot]
    if photo is not None:
        _draw_photo(plot, frame, photo)
    draw_grid(picture, frame, photo is not None)
    _draw_way(plot, frame, camera)
    labels = Labels(frame)
    for rows in landmarks.of.values():
        line(plot, frame.pixels(landmarks.east_north_m[rows]), (120, 120, 120), 1)
    for target, rows in tracks.of.items():
        for piece in _pieces(tracks, rows):
            line(plot, frame.pixels(tracks.east_north_m[piece]), _dark(target), 2, halo=True)
    for target, rows in tracks.of.items():
        _draw_last(plot, frame, tracks, rows.stop - 1, _dark(target))
    if signs is not None:
        for from_m, at_m in signs.looks:
            draw_look(plot, frame.pixels(from_m), frame.pixels(at_m))
        for _, kind, place in signs.verdicts:
            draw_verdict(plot, frame.pixels(place), kind)
            labels.keep_free(place)
    for shown in (tracks, landmarks):
        for rows in shown.of.values():
            labels.keep_free(shown.east_north_m[rows.stop - 1])
    for mark, rows in landmarks.of.items():
        draw_landmark(plot, frame.pixels(landmarks.east_north_m[rows.stop - 1]))
        labels.add(picture, landmarks.east_north_m[rows.stop - 1], names[mark], MARK)
    for target, rows in tracks.of.items():
        labels.add(picture, tracks.east_north_m[rows.stop - 1], str(target), _dark(target))
    draw_scale(picture, frame)
    if len(camera.east_north_m):
        draw_camera(plot, frame.pixels(camera.east_north_m[-1]))
    write(picture, title, (LEFT + 26, TOP - 14), 0.62)
    _legend(picture, frame, tracks, camera, len(landmarks) > 0, signs or Signs())
    return cv2.resize(picture, None, fx=1 / FINE, fy=1 / FINE, interpolation=cv2.INTER_AREA)


def view_of(fix: Fix, camera: Camera) -> np.ndarray:
    """(K, 2) local metres of the ground at up = 0 along the picture's border; empty where that is not known."""
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
    # Pixels on both sides of the horizon have scales of both signs.
    has_one_sign = (ground[:, 2] > 0).all() or (ground[:, 2] < 0).all()
    return ground[:, :2] / ground[:, 2:] if has_one_sign else np.zeros((0, 2))


def _extent(targets: np.ndarray, landmarks: np.ndarray, camera: CameraPath) -> np.ndarray:
    """Places that the map must show: the camera's way and view too, unless they go far beyond all others."""
    targets = targets[np.isfinite(targets).all(axis=1)]
    if len(targets):
        low, high = np.percentile(targets, (2, 98), axis=0)
        reach = np.maximum(high - low, 20.0)
        targets = targets[((targets >= low - reach) & (targets <= high + reach)).all(axis=1)]
    shown = np.concatenate([targets, landmarks])
    for more in (camera.east_north_m, camera.view_m):
        if len(shown) == 0:
            shown = more
        elif len(more):
            reach = 1.5 * max(float(np.ptp(shown, axis=0).max()), 20.0)
            if (np.abs(more - (shown.min(axis=0) + shown.max(axis=0)) / 2) <= reach).all():
                shown = np.concatenate([shown, more])
    return shown


def _pieces(tracks: GroundTracks, rows: slice) -> list[slice]:
    steps = np.diff(tracks.frame[rows])
    breaks = (np.flatnonzero(steps > 4 * max(np.median(steps), 1)) + 1 + rows.start).tolist() if len(steps) else []
    edges = [rows.start, *breaks, rows.stop]
    return [slice(a, b) for a, b in pairwise(edges)]


def _draw_photo(plot: np.ndarray, frame: MapFrame, photo: Ortho) -> None:
    """The photo, a little faded, so that what is drawn over it stands out."""
    fine = FINE / frame.metres_a_pixel
    plot_from_metres = np.array([[fine, 0, -frame.west_m * fine], [0, -fine, plot.shape[0] + frame.south_m * fine]])
    whole = np.vstack([photo.east_north_from_pixel, [0, 0, 1]])
    image, plot_from_pixel = photo.image, np.vstack([plot_from_metres @ whole, [0, 0, 1]])
    # Warping takes single pixels: a photo that is much finer than the map is reduced first.
    coarser = int(1 / max(np.sqrt(abs(np.linalg.det(plot_from_pixel[:2, :2]))), 1e-3))
    if coarser > 1:
        size = max(image.shape[1] // coarser, 1), max(image.shape[0] // coarser, 1)
        share = np.array([image.shape[1] / size[0], image.shape[0] / size[1]])
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        # Pixels count from the centre of the first one.
        plot_from_pixel = plot_from_pixel @ np.array(
            [[share[0], 0, (share[0] - 1) / 2], [0, share[1], (share[1] - 1) / 2], [0, 0, 1]]
        )
    size = plot.shape[1], plot.shape[0]
    warped = cv2.warpAffine(image, plot_from_pixel[:2], size, flags=cv2.INTER_LINEAR, borderValue=PAPER)
    plot[:] = (0.75 * warped + 0.25 * 255).astype(np.uint8)


def _draw_way(plot: np.ndarray, frame: MapFrame, camera: CameraPath) -> None:
    if len(camera.view_m):
        dashes(plot, frame.pixels(np.concatenate([camera.view_m, camera.view_m[:1]])), VIEW, 2)
    if len(camera.east_north_m):
        line(plot, frame.pixels(camera.east_north_m), INK, 1, halo=True)


def _draw_last(plot: np.ndarray, frame: MapFrame, tracks: GroundTracks, row: int, colour: Colour) -> None:
    centre = tracks.east_north_m[row]
    if np.isfinite(tracks.covariance_m2[row]).all():
        ring = centre + ring_m(*semi_axes(tracks.covariance_m2[row : row + 1]), points=72)[0]
        line(plot, frame.pixels(np.concatenate([ring, ring[:1]])), colour, 1, halo=True)
    draw_dot(plot, frame.pixels(centre), colour)


def _legend(
    picture: np.ndarray, frame: MapFrame, tracks: GroundTracks, camera: CameraPath, marked: bool, signs: Signs
) -> None:
    y = TOP + frame.height + 62
    x = LEFT + 8.0
    ring = np.array([x, y]) + np.array([13, 7]) * np.array([(np.cos(t), np.sin(t)) for t in np.linspace(0, 6.2832, 40)])
    entries = [("target: number, way, 95 % ellipse of the last place", "ring")]
    entries += [("landmark", "mark")] if marked else []
    entries += [("camera", "camera")] if len(camera.east_north_m) else []
    entries += [("what it saw last", "view")] if len(camera.view_m) else []
    kinds = {kind for _, kind, _ in signs.verdicts}
    entries += [(f"told {kind.replace('_', ' ')}", kind) for kind in ("human", "not_human") if kind in kinds]
    entries += [("seen from here", "look")] if signs.looks else []
    for text, kind in entries:
        at = np.array([x, y]) * FINE
        if kind == "ring":
            line(picture, ring * FINE, _dark(1), 1)
            draw_dot(picture, at, _dark(1))
        elif kind == "mark":
            draw_landmark(picture, at)
        elif kind == "camera":
            draw_camera(picture, at)
        elif kind == "look":
            draw_look(picture, at - (9.0 * FINE, 0.0), at)
        elif kind in kinds:
            draw_verdict(picture, at, kind)
        else:
            dashes(picture, at + FINE * np.array([[-14.0, 0], [14, 0]]), VIEW, 2)
        write(picture, text, (x + 20, y + 5), 0.5)
        x += 20 + text_width(text, 0.5) + (40 if len(entries) < 6 else 22)
    places = frame.pixels(tracks.east_north_m) / FINE
    outside = int(((places < 0) | (places > (frame.width, frame.height))).any(axis=1).sum())
    text = f"{len(tracks.of)} targets, {len(tracks)} places" + (f", {outside} outside the map" if outside else "")
    write(picture, text, (LEFT, TOP + frame.height + BOTTOM - 12), 0.5)


def _dark(target: int) -> Colour:
    """A target's colour as in the overlay, darker for white paper."""
    blue, green, red = (round(0.72 * c) for c in identity_colour(target))
    return blue, green, red
