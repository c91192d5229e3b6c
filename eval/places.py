"""Measure places of people: on real data by ranging and by people as landmarks; by telemetry alone in simulation.

python eval/places.py ranging DATA      distances to people against world positions of PETS09-S2L1 and TUD-Stadtmitte
python eval/places.py landmarks DATA    places of people, with other people of known place as moving landmarks
python eval/places.py telemetry         targets located by telemetry alone, simulated; needs no data

DATA is a folder of MOTChallenge 2015 sequences whose gt.txt has world metres in columns 8 to 10. PETS comes with its
camera (Tsai). The camera of TUD is fitted to the true feet and their world positions. Both sets of world positions were
computed from the lower edges of the true boxes with these cameras, so the foot rows of true boxes only have the error
of the camera model. Detections are those of det/det.txt that overlap a true box.
"""

import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import bench
import numpy as np
from clips import truth_of
from geo_error import flight_of, inside_ellipses
from geo_scene import (
    ALTITUDE_SIGMA,
    CAMERA,
    FOCAL_SIGMA,
    HEADING_SIGMA,
    POSITION_SIGMA_M,
    SIZE_PX,
    TILT_SIGMA,
    looking,
    turned,
)
from scipy.optimize import least_squares, linear_sum_assignment

from torchvision_dddas.config import AerialParameters, GroundParameters, Settings, load_config, with_parameters
from torchvision_dddas.geo import AerialLocator
from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.plane_homography import load_solver, locate_pixels
from torchvision_dddas.geo.ranging import range_people, touches_border
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.lab.evaluation.metrics.boxes import iou
from torchvision_dddas.types import Camera, Flight, LandmarkObservations, Poses, Sightings, Telemetry, Tracks

SIZES = {"PETS09-S2L1": (768, 576), "TUD-Stadtmitte": (640, 480)}
RATE_HZ = {"PETS09-S2L1": 7.0, "TUD-Stadtmitte": 25.0}
FOOT_SIGMA_PX = {"PETS09-S2L1": 0.4, "TUD-Stadtmitte": 1.5}
"""Standard deviation along each axis of a true box's foot from the true camera's prediction."""
SURVEYED = {
    "focal_sigma": 0.002,
    "height_sigma_m": 0.03,
    "pitch_sigma_rad": float(np.radians(0.1)),
    "heading_sigma_rad": float(np.radians(0.1)),
    "position_sigma_m": 0.05,
}
"""Standard deviations of the parameters of such cameras."""


@dataclass(frozen=True)
class People:
    """Boxes and their people's truth: frame, who (N,), box_px (N, 4), cut (N,), east_north_m (N, 2)."""

    frame: np.ndarray
    who: np.ndarray
    box_px: np.ndarray
    cut: np.ndarray
    east_north_m: np.ndarray

    @property
    def foot_px(self) -> np.ndarray:
        """(N, 2) middles of the lower edges."""
        return self.box_px[:, :2] + self.box_px[:, 2:] * (0.5, 1.0) - 0.5


def read_sequences(data: Path) -> Iterator[tuple[str, str, People, Camera]]:
    """Yield sequence, kind of boxes, people and camera. End the program with one line if there are none."""
    places = [data / name for name in SIZES if (data / name / "gt/gt.txt").is_file()]
    for place in places:
        name, size = place.name, SIZES[place.name]
        truth = truth_of(place)
        box = truth.tracks.box_px - (1, 1, 0, 0)
        people = People(
            truth.tracks.frame, truth.tracks.identity, box, touches_border(box, size), truth.positions.east_north_m
        )
        camera = tsai_camera(place / "View_001.xml") if name.startswith("PETS") else fit_camera(people, size)
        yield name, "true boxes", people, camera
        if (place / "det/det.txt").is_file():
            yield name, "detections", match_detections(place / "det/det.txt", people, size), camera
    if not places:
        sys.exit(f"{data} holds neither {' nor '.join(SIZES)}; nothing was measured")


def match_detections(path: Path, truth: People, size: tuple[int, int], least: float = 0.5) -> People:
    """Match a detector's boxes one to one with true boxes (IoU at least `least`). Return them with their truth."""
    table = read_detections(path)
    cut = touches_border(table.box_px, size) if table.cut is None else table.cut
    ours, theirs = [], []
    for number in np.unique(table.frame):
        rows = np.arange(len(table))[table.rows(number)]
        there = np.flatnonzero(truth.frame == number)
        shared = iou(table.box_px[rows], truth.box_px[there])
        for a, b in zip(*linear_sum_assignment(-np.where(shared < least, 0, shared)), strict=True):
            if shared[a, b] >= least:
                ours.append(rows[a])
                theirs.append(there[b])
    return People(truth.frame[theirs], truth.who[theirs], table.box_px[ours], cut[ours], truth.east_north_m[theirs])


def tsai_camera(path: Path) -> Camera:
    """Read the camera of a Tsai calibration file, in metres. Convert its distortion to OpenCV's up to fourth power."""
    root = ET.parse(path).getroot()
    part = {kind: {k: float(v) for k, v in node.attrib.items()} for kind in ("Geometry", "Intrinsic", "Extrinsic")
            if (node := root.find(kind)) is not None}  # fmt: skip
    geometry, inner, outer = part["Geometry"], part["Intrinsic"], part["Extrinsic"]
    (sa, sb, sg), (ca, cb, cg) = (f([outer["rx"], outer["ry"], outer["rz"]]) for f in (np.sin, np.cos))
    about_x = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
    about_y = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    about_z = np.array([[cg, -sg, 0], [sg, cg, 0], [0, 0, 1]])
    camera_from_world = about_z @ about_y @ about_x
    east, north, up = -camera_from_world.T @ [outer["tx"], outer["ty"], outer["tz"]] / 1000
    right, down, ahead = camera_from_world
    bend = inner["kappa1"] * inner["focal"] ** 2
    return Camera(
        path.stem,
        (int(geometry["width"]), int(geometry["height"])),
        (inner["focal"] * inner["sx"] / geometry["dpx"], inner["focal"] / geometry["dpy"]),
        (inner["cx"], inner["cy"]),
        (east, north),
        heading_rad=np.arctan2(ahead[0], ahead[1]),
        pitch_rad=np.arcsin(-ahead[2]),
        roll_rad=np.arctan2(-right[2], -down[2]),
        height_m=up,
        k1=-bend,
        k2=3 * bend**2,
        **SURVEYED,
    )


def fit_camera(people: People, size: tuple[int, int]) -> Camera:
    """Fit a camera to the feet's rows and columns. It has square pixels and its axis through the middle."""
    box, middle = people.box_px, (np.array(size) - 1) / 2
    feet = box[:, :2] + box[:, 2:] * (0.5, 1) - 0.5
    centre = people.east_north_m.mean(axis=0)

    def miss(p: np.ndarray) -> np.ndarray:
        focal, place, height, (heading, pitch, roll) = np.exp(p[0]), p[1:3], np.exp(p[3]), p[4:7]
        away = people.east_north_m - place
        ahead = away @ [np.sin(heading), np.cos(heading)]
        depth = ahead * np.cos(pitch) + height * np.sin(pitch)
        x = away @ [np.cos(heading), -np.sin(heading)] / depth
        y = (height * np.cos(pitch) - ahead * np.sin(pitch)) / depth
        turned = np.stack([x * np.cos(roll) + y * np.sin(roll), y * np.cos(roll) - x * np.sin(roll)], axis=1)
        return (turned * focal + middle - feet).ravel()

    best = None
    for turn in np.radians(range(0, 360, 30)):
        place = centre - 25 * np.array([np.sin(turn), np.cos(turn)])
        start = [np.log(2 * size[0]), *place, np.log(2.0), turn, 0.05, 0.0]
        found = least_squares(miss, start, x_scale=[0.1, 1, 1, 0.1, 0.1, 0.1, 0.1], loss="soft_l1", max_nfev=300)
        best = found if best is None or found.cost < best.cost else best
    assert best is not None
    focal, height = np.exp(best.x[[0, 3]])
    heading, pitch, roll = best.x[4:7]
    return Camera(
        "fitted", size, (focal, focal), (middle[0], middle[1]), (best.x[1], best.x[2]),
        heading_rad=heading, pitch_rad=pitch, roll_rad=roll, height_m=height, **SURVEYED,
    )  # fmt: skip


# -- ranging ---------------------------------------------------------------------------------------------------------

WAYS: dict[str, tuple[GroundParameters, bool]] = {
    "eq. 13–15, 1.8 m": (GroundParameters(mode="paper", body_height_m=1.8), False),
    "height, 1.8 m": (GroundParameters(use="height", body_height_m=1.8), False),
    "height, 1.7 m": (GroundParameters(use="height", body_height_m=1.7), False),
    "height, calibrated": (GroundParameters(use="height"), True),
    "foot row": (GroundParameters(use="feet"), False),
    "both, calibrated": (GroundParameters(), True),
}
"""Parameters, and whether the body height is calibrated."""


def measure_ranging(options: bench.Options) -> tuple[str, Any]:
    """Measure errors of distances from the camera's ground point to each person.

    The body height is calibrated on one half of the frames and used on the other half, both ways.
    """
    parts, found = [], {}
    for name, kind, people, camera in read_sequences(options.data):
        far, rows = np.linalg.norm(people.east_north_m - camera.place, axis=1), []
        early = people.frame <= np.median(people.frame)
        for way, (parameters, calibrated) in WAYS.items():
            error, covered, heights = np.full(len(far), np.nan), np.full(len(far), np.nan), []
            for half in (early, ~early):
                height = fit_height(people, camera, ~half) if calibrated else parameters.body_height_m
                seen = range_all(people, camera, parameters.model_copy(update={"body_height_m": height}))
                error[half] = (seen.distance_m / far - 1)[half]
                covered[half] = inside_ellipses(seen.east_north_m - people.east_north_m, seen.covariance_m2)[half]
                heights.append(height)
            error[people.cut] = np.nan
            known = np.isfinite(error)
            inside = f"{100 * np.nanmean(covered[known]):.1f} %" if np.isfinite(covered[known]).any() else "–"
            bias = f"{100 * error[known].mean():+.1f} %", f"{100 * np.median(error[known]):+.1f} %"
            cells = [int(known.sum()), f"{100 * np.median(np.abs(error[known])):.1f} %", *bias, inside]
            rows.append([way, *cells, f"{np.mean(heights):.2f} m"])
        found[f"{name}, {kind}"] = rows
        head = [f"{name}, {kind}", "people", "median error", "bias (mean)", "bias (median)", "in 95 % ellipses"]
        parts.append(bench.format_table([*head, "body height"], rows))
    return "\n\n".join(parts), found


def range_all(people: People, camera: Camera, parameters: GroundParameters) -> Sightings:
    """Return the ranges of all people."""
    n = len(people.frame)
    poses = Poses(np.tile(camera.place, (n, 1)), np.full(n, camera.heading_rad), np.full(n, camera.pitch_rad))
    return range_people(people.box_px, people.cut, camera, poses, poses.place, parameters)


def fit_height(people: People, camera: Camera, use: np.ndarray) -> float:
    """Return the body height at which the median person has the right distance."""
    found = range_all(people, camera, GroundParameters(use="height", body_height_m=1.75))
    far = np.linalg.norm(people.east_north_m - camera.place, axis=1)
    return float(np.nanmedian((1.75 * far / found.distance_m)[use & ~people.cut]))


# -- people as landmarks ---------------------------------------------------------------------------------------------

MODES = {
    "homography": ("homography", False, 0.0),
    "pose without telemetry": ("pose", False, 0.0),
    "pose": ("pose", True, 0.0),
    "pose over time": ("pose", True, 20.0),
}
"""`aerial.mode`, whether there is telemetry, and `aerial.correlation_s`."""
LANDMARK_SIGMA_M = 0.02


def measure_landmarks(options: bench.Options) -> tuple[str, Any]:
    """Measure errors of people located by others of known place. These are chosen at random or nearest to a line.

    The telemetry is that of the true camera with errors drawn once per seed: 1 % in the focal length, 1° of tilt, 5° of
    heading, 2 % of the height, a GPS with 3.5 m in 95 %. Without telemetry only the focal length is known.
    """
    parts, found = [], {}
    for name, kind, people, camera in read_sequences(options.data):
        rows = []
        keep = people.frame % (1 if kind == "detections" else options.every) == 0
        some = People(*(getattr(people, field)[keep] for field in People.__dataclass_fields__))
        sigma_px = np.full(len(some.frame), FOOT_SIGMA_PX[name])
        if kind == "detections":
            sigma_px = np.hypot(GroundParameters().feet_sigma * some.box_px[:, 3], 0.5)
        for n, choice, mode in ((n, c, m) for n in (4, 6) for c in ("by chance", "nearest to a line") for m in MODES):
            off, inside = [], []
            for seed in range(options.seeds if choice == "by chance" else min(options.seeds, 3)):
                rng = np.random.default_rng([seed, n]) if choice == "by chance" else None
                known, flight = draw_telemetry(camera, np.random.default_rng([seed, 99]))
                chosen = choose_landmarks(some, n, rng)
                one = locate_others(some, sigma_px, chosen, known, flight, mode, RATE_HZ[name])
                off.append(one[0])
                inside.append(one[1])
            far, within = np.concatenate(off), np.concatenate(inside)
            there = far[np.isfinite(far)]
            if len(there):
                cells = [f"{100 * len(there) / len(far):.1f} %", f"{np.median(there):.3f}", f"{there.mean():.3f}"]
                cells += [f"{np.quantile(there, 0.95):.2f}", f"{100 * np.nanmean(within):.1f} %"]
                rows.append([mode, f"{n}, {choice}", *cells])
                bench.log(name, kind, *rows[-1])
        found[f"{name}, {kind}"] = rows
        head = [f"{name}, {kind}", "landmarks", "located", "median m", "mean m", "95 % below", "in ellipses"]
        parts.append(bench.format_table(head, rows, words=2))
    return "\n\n".join(parts), found


def choose_landmarks(people: People, n: int, rng: np.random.Generator | None) -> dict[int, np.ndarray]:
    """Choose the rows of n landmarks in every frame with more people.

    With rng, each person has a random rank, and the first in the picture are chosen. Else those nearest to a line are.
    """
    ids = np.unique(people.who)
    rank = dict(zip(ids, rng.permutation(len(ids)), strict=True)) if rng else {}

    def width(some: np.ndarray) -> float:
        centred = people.east_north_m[some] - people.east_north_m[some].mean(axis=0)
        length, width = np.linalg.svd(centred, compute_uv=False)
        return float(width / length)

    found = {}
    for number in np.unique(people.frame).tolist():
        rows = np.flatnonzero(people.frame == number)
        if len(rows) > n and rng:
            found[number] = rows[np.argsort([rank[w] for w in people.who[rows]])[:n]]
        elif len(rows) > n:
            found[number] = min((rows[list(some)] for some in combinations(range(len(rows)), n)), key=width)
    return found


def draw_telemetry(camera: Camera, rng: np.random.Generator) -> tuple[Camera, Flight]:
    """Return the known camera, with an error in its focal length, and its telemetry."""
    axes = looking(*(np.array(a) for a in (camera.heading_rad, camera.pitch_rad, camera.roll_rad)))
    axes = turned(rng.normal(0, (TILT_SIGMA, TILT_SIGMA, HEADING_SIGMA))) @ axes
    sigma = (POSITION_SIGMA_M, POSITION_SIGMA_M, ALTITUDE_SIGMA * camera.height_m)
    place = np.array([*camera.place, camera.height_m]) + rng.normal(0, sigma)
    share = np.exp(rng.normal(0, FOCAL_SIGMA))
    known = replace(camera, focal_px=(camera.focal_px[0] * share, camera.focal_px[1] * share))
    return known, flight_of(axes, place)


def locate_others(
    people: People, sigma_px: np.ndarray, chosen: dict[int, np.ndarray], camera: Camera, flight: Flight, mode: str,
    rate_hz: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return errors in metres of people who are not landmarks, NaN without a place, and whether ellipses hold them."""
    method, has_telemetry, correlation_s = MODES[mode]
    settings = with_parameters(Settings(), {"aerial.mode": method, "aerial.correlation_s": correlation_s})
    georeferencer, far, inside = Georeferencer(camera, settings, load_solver("onboard")), [], []
    for number, some in chosen.items():
        marks = LandmarkObservations(
            people.who[some], people.foot_px[some], people.east_north_m[some], np.full(len(some), LANDMARK_SIGMA_M),
            sigma_px[some], np.zeros(len(some)),
        )  # fmt: skip
        fix = georeferencer.update(number, number / rate_hz, flight if has_telemetry else None, marks, None)
        for one in np.setdiff1d(np.flatnonzero(people.frame == number), some):
            off, held = np.full((1, 2), np.nan), np.full(1, np.nan)
            if fix.by:
                place, covariance = locate_pixels(fix, camera, people.foot_px[one, None], float(sigma_px[one]))
                off = place - people.east_north_m[one]
                held = inside_ellipses(off, covariance)
            far.append(np.linalg.norm(off))
            inside.append(held[0])
    return np.array(far), np.array(inside)


# -- telemetry alone -------------------------------------------------------------------------------------------------

ERRORS = {"consumer drone (default)": None, "rtk": "rtk", "cheap": "cheap"}
"""Kind of the telemetry's errors, and the configuration with these errors."""
VIEWS_DEG, ALTITUDES_M = (90, 60, 45, 30), (40.0, 120.0)
TARGETS = 12
"""Targets per flight, anywhere in the picture."""


def measure_telemetry(options: bench.Options) -> tuple[str, Any]:
    """Measure errors of targets located by telemetry alone. Its errors are drawn with the parameters' sigmas.

    Each flight has its own errors, which its targets share. Pixels have an error of 1 px.
    """
    rows = []
    for name, config in ERRORS.items():
        settings = load_config(config)
        for height in ALTITUDES_M:
            for pitch in VIEWS_DEG:
                found = [
                    fly_once(np.random.default_rng([seed, pitch, int(height)]), height, np.radians(pitch), settings)
                    for seed in range(options.seeds)
                ]
                off, within = (np.concatenate(part) for part in zip(*found, strict=True))
                there = off[np.isfinite(off)]
                cells = [f"{100 * len(there) / len(off):.0f} %", f"{np.median(there):.2f}"]
                cells += [f"{np.quantile(there, 0.95):.2f}", f"{100 * np.nanmean(within):.1f} %"]
                rows.append([name, f"{height:.0f} m, {pitch}°", *cells])
                bench.log(*rows[-1])
    head = ["errors of", "above ground, below the horizon", "placed", "median m", "95 % below", "in 95 % ellipses"]
    return bench.format_table(head, rows, words=2), {"seeds": options.seeds, "rows": rows}


def fly_once(
    rng: np.random.Generator, height_m: float, pitch_rad: float, settings: Settings
) -> tuple[np.ndarray, np.ndarray]:
    """Return errors of the targets of a picture in metres, NaN without a place, and whether ellipses hold them."""
    sigma, count = settings.aerial, TARGETS
    heading = np.array(rng.uniform(0, 2 * np.pi))
    axes = looking(heading, np.array(pitch_rad), np.array(0.0))
    shown = rng.uniform((0, 0), SIZE_PX, (count, 2))
    share = np.exp(rng.normal(0, sigma.focal_sigma))
    flat = (shown - CAMERA.centre_px) / (np.array(CAMERA.focal_px) * share)
    way = np.c_[flat, np.ones(count)] @ axes.T
    true_m = np.where(way[:, 2:] < -0.01, way[:, :2] / -way[:, 2:], np.nan) * height_m
    said = draw_flight(rng, axes, np.array([0.0, 0.0, height_m]), sigma)
    one = np.ones(2)
    telemetry = Telemetry(
        np.array([0.0, 1.0]), said.altitude_m * one, 0 * one, np.tile(said.place, (2, 1)), False,
        heading_rad=said.heading_rad * one, pitch_rad=said.pitch_rad * one, roll_rad=said.roll_rad * one,
    )  # fmt: skip
    box = np.c_[shown + rng.normal(0, sigma.target_sigma_px, (count, 2)) - 2, np.full((count, 2), 5.0)]
    settings = with_parameters(settings, {"aerial.point": "centre", "aerial.own_sigma": 0.0})
    tracks = Tracks(1, np.arange(1, count + 1), box, np.ones(count), np.arange(count))
    found = AerialLocator(CAMERA, telemetry, settings=settings).locate(tracks)
    off, within = np.full(count, np.nan), np.full(count, np.nan)
    away = found.positions.east_north_m - true_m[found.row]
    off[found.row], within[found.row] = np.linalg.norm(away, axis=1), inside_ellipses(away, found.relative_m2)
    return off, within


def draw_flight(rng: np.random.Generator, axes: np.ndarray, place: np.ndarray, sigma: AerialParameters) -> Flight:
    """Return the telemetry of a camera, with errors by the parameters."""
    tilt, heading = np.radians((sigma.tilt_sigma_deg, sigma.heading_sigma_deg))
    up = np.hypot(sigma.altitude_sigma * place[2], sigma.altitude_sigma_m)
    shift = rng.normal(0, (sigma.position_sigma_m, sigma.position_sigma_m, up))
    return flight_of(turned(rng.normal(0, (tilt, tilt, heading))) @ axes, place + shift)


if __name__ == "__main__":
    studies = {
        "ranging": (measure_ranging, {"data": Path}),
        "landmarks": (measure_landmarks, {"data": Path, "--seeds": 10, "--every": 1}),
        "telemetry": (measure_telemetry, {"--seeds": 400}),
    }
    bench.main(__doc__, studies)
