"""A flight over landmarks and targets that move, and the files that it leaves: the truth that locating must find."""

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from tests.upright import pixels
from torchvision_dddas.geometry import lonlat
from torchvision_dddas.types import Camera

ORIGIN = (-110.95, 32.23)
LANDMARKS = np.array([[-18.0, -9.0], [17.0, -10.0], [16.0, 11.0], [-17.0, 10.0], [3.0, -14.0], [-2.0, 15.0]])
TARGETS = np.array([[-8.0, -4.0], [6.0, 5.0], [11.0, -7.0], [-9.0, 8.0]])


def level(east_north):
    return np.zeros(len(east_north))


@dataclass
class Overflight:
    """All in metres about ORIGIN, the ground at its height there; noise by standard deviations, 0 for none.

    body_m: height of the targets, whose middle is the box's. pace: of the targets, 1 for walkers. geographic: whether
    files are in degrees.
    """

    landmarks: int = 4
    frames: int = 10
    rate_hz: float = 10.0
    height_m: float = 50.0
    pitch_deg: float = 90.0
    heading_rad: float = 0.4
    body_m: float = 0.0
    pace: float = 1.0
    size: tuple[int, int] = (1280, 720)
    focal_px: float = 914.0
    geographic: bool = True
    ground: Callable = level
    gps_m: float = 0.0
    pixel: float = 0.0
    seed: int = 0
    gps: np.ndarray = field(init=False)

    def __post_init__(self):
        self.rng = np.random.default_rng(self.seed)
        # A receiver's error lasts longer than a short clip.
        self.gps = self.rng.normal(0, 1, (self.landmarks, 2)) * self.gps_m

    def numbers(self):
        return range(1, self.frames + 1)

    def time(self, frame):
        return (frame - 1) / self.rate_hz

    def marks(self, frame):
        way = np.array([[0.8, 0.2], [-0.5, 0.4], [0.1, -0.9], [0.6, 0.6], [-0.4, 0.1], [0.3, -0.3]])
        return (LANDMARKS + way * self.time(frame))[: self.landmarks]

    def targets(self, frame):
        way = self.pace * np.array([[1.4, 0.2], [-1.2, 0.7], [-0.3, 1.3], [1.1, -0.6]])
        return TARGETS + way * self.time(frame)

    def vehicle(self, frame):
        """East, north and up; the camera looks at the origin in the first frame."""
        back = self.height_m / np.tan(np.radians(self.pitch_deg)) if self.pitch_deg < 90 else 0.0
        place = np.array([1.5 * self.time(frame) - back * np.sin(self.heading_rad), -back * np.cos(self.heading_rad)])
        return np.array([*place, self.height_m + float(self.ground(place[None])[0])])

    def shown(self, frame, east_north, up_m=0.0):
        """Pixels of points on the ground."""
        points = np.column_stack([east_north, self.ground(east_north) + up_m])
        at = self.vehicle(frame)
        camera = Camera(
            "truth",
            self.size,
            (self.focal_px, self.focal_px),
            ((self.size[0] - 1) / 2, (self.size[1] - 1) / 2),
            heading_rad=self.heading_rad,
            pitch_rad=np.radians(self.pitch_deg),
            height_m=at[2],
        )
        seen = pixels(points, camera, at[:2])
        return seen + self.rng.normal(0, 1, seen.shape) * self.pixel

    def _place(self, east_north):
        if not self.geographic:
            return "east_m,north_m", np.asarray(east_north)
        return "longitude_deg,latitude_deg", lonlat(np.asarray(east_north), ORIGIN)

    def landmarks_csv(self, keep=lambda frame, k: True, pictured=True):
        lines = []
        for frame in self.numbers():
            where = self.marks(frame)
            kind, place = self._place(where + self.gps)
            for k, (uv, at) in enumerate(zip(self.shown(frame, where), place, strict=True)):
                if keep(frame, k):
                    seen = f",{uv[0]:.4f},{uv[1]:.4f}" if pictured else ""
                    lines.append(f"{frame},ugv{k}{seen},{at[0]:.10f},{at[1]:.10f},{self.gps_m or 0.02}")
        return "\n".join([f"frame,landmark,{'u_px,v_px,' if pictured else ''}{kind},sigma_m", *lines]) + "\n"

    def telemetry_csv(self, shift_s=0.0, **other):
        lines = []
        for frame in self.numbers():
            at = self.vehicle(frame)
            kind, place = self._place(at[None, :2])
            row = {
                "time_s": self.time(frame) + shift_s,
                "altitude_m": self.height_m,
                "speed_m_s": 1.5,
                **dict(zip(kind.split(","), place[0].tolist(), strict=True)),
                "heading_deg": np.degrees(self.heading_rad),
                "pitch_deg": self.pitch_deg,
                "roll_deg": 0.0,
                **other,
            }
            lines.append(",".join(f"{value:.10f}" for value in row.values()))
        return "\n".join([",".join(row), *lines]) + "\n"

    def tracks_txt(self, identities=True):
        lines = []
        for frame in self.numbers():
            for k, (u, v) in enumerate(self.shown(frame, self.targets(frame), self.body_m / 2), 1):
                box = f"{u + 0.5 - 10:.4f},{v + 0.5 - 10:.4f},20,20"
                lines.append(f"{frame},{k if identities else -1},{box},1,-1,-1,-1")
        return "\n".join(lines) + "\n"

    def camera_toml(self):
        return f"focal_px = {self.focal_px}\nwidth_px = {self.size[0]}\nheight_px = {self.size[1]}\n"

    def errors(self, rows):
        """(N,) metres between rows of positions.csv and the truth."""
        return np.array(
            [
                np.hypot(*(np.array([float(r["east_m"]), float(r["north_m"])]) - self.at_origin(int(r["frame"]), r)))
                for r in rows
            ]
        )

    def at_origin(self, frame, row):
        """Where the target of a row is, in the metres of the run, which begin at the first landmark's first place."""
        where = self.targets(frame)[int(row["target"]) - 1]
        return where - (self.marks(1)[0] + self.gps[0] if self.geographic else 0)


COLOURS = {"ugv0": (0, 0, 220), "ugv1": (30, 200, 30), "ugv2": (220, 60, 20), "ugv3": (20, 210, 230)}
"""BGR that the first landmarks wear: hues 0, 60, 112 and 28."""

SHADES = ((225, 225, 225), (245, 245, 245), (215, 215, 215), (235, 235, 235))

COLOURS_TOML = """
[ugv0]
low = [174, 120, 70]
high = [6, 255, 255]
[ugv1]
low = [50, 120, 70]
high = [70, 255, 255]
[ugv2]
low = [104, 120, 70]
high = [120, 255, 255]
[ugv3]
low = [22, 120, 70]
high = [34, 255, 255]
"""
_METRE_PX = 20
_REACH_M = 60.0


def texture(seed=0):
    """Ground of grey-brown noise, ±_REACH_M about the origin, (H, W, 3) uint8, north at its upper edge."""
    rng = np.random.default_rng(seed)
    side = int(2 * _REACH_M * _METRE_PX)
    grey = np.full((side, side), 118.0, np.float32)
    for cell, strength in ((4.0, 14), (1.0, 16), (0.3, 14), (0.12, 10)):
        small = rng.normal(0, strength, (int(2 * _REACH_M / cell),) * 2).astype(np.float32)
        grey += cv2.resize(small, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.clip(grey[..., None] * np.array([0.92, 1.0, 1.05]), 0, 255).astype(np.uint8)


def pictures(flight, seed=0):
    """The clip of a flight, frame by frame: landmarks of 2.4 m in COLOURS, grey targets of 2 m, on level ground."""
    ground, rng = texture(seed), np.random.default_rng(seed)
    corners = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    ends = _REACH_M * corners
    inside = (_REACH_M + ends * (1, -1)) * _METRE_PX - 0.5
    for frame in flight.numbers():
        image_from_texture = cv2.getPerspectiveTransform(
            inside.astype(np.float32), flight.shown(frame, ends).astype(np.float32)
        )
        picture = cv2.warpPerspective(ground, image_from_texture, flight.size, flags=cv2.INTER_AREA)
        bodies = list(zip(flight.marks(frame), COLOURS.values(), (1.2, 1.2, 1.2, 1.2), strict=False))
        bodies += [(place, SHADES[k], 1.0) for k, place in enumerate(flight.targets(frame))]
        for place, bgr, half in bodies:
            # A lighter roof, so that there is something to see within the outline.
            for share, light in ((1.0, 0.75), (0.6, 1.0)):
                outline = np.round(flight.shown(frame, place + half * share * corners) * 16).astype(np.int32)
                cv2.fillConvexPoly(picture, outline, [light * value for value in bgr], cv2.LINE_AA, 4)
        yield np.clip(picture + rng.normal(0, 1.5, picture.shape), 0, 255).astype(np.uint8)
