"""Measure errors of targets located from the air by landmarks, beside the Cramér-Rao bound. Simulated; needs no data.

python eval/geo_error.py [--seeds 200] [--quick] [--methods]

The camera has 1080p and a lens of 70 degrees. Telemetry has errors of 1 % in the focal length, 1° of tilt, 5° of
heading, 2 % of the altitude, and a GPS with 3.5 m in 95 %. Landmarks stand in a disc of 25 m radius (geo_scene.py),
targets within 10 m of its middle (crowd) or in the whole disc (disc). Every frame is located by itself.

pose: camera pose by landmarks and telemetry. homography: by landmarks alone, weighted, in metres. paper: the source's
normal equations in raw degrees. findHomography, solvePnP: OpenCV's functions on the landmarks alone, in metres;
solvePnP uses the lens of the telemetry. Ellipses are for 95 %. Errors are relative to the team, without the error that
all receivers share. --methods: only the table of methods (appendix A, Tables I and II).
"""

from dataclasses import asdict, replace
from functools import partial
from typing import Any

import bench
import cv2
import numpy as np
from geo_scene import (
    BOUNDS,
    CAMERA,
    FOCAL_PX,
    GPS,
    LAYOUTS,
    Case,
    Scenes,
    mean_length,
    scenes,
)

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.plane_homography import load_solver, locate_pixels
from torchvision_dddas.geometry import lonlat
from torchvision_dddas.types import Fix, Flight, LandmarkObservations

METHODS = ("pose", "homography", "paper")
NEEDS = {
    "paper": ("source: plane homography in raw degrees", "4", "no", "no"),
    "findHomography": ("OpenCV: findHomography, in metres", "4", "no", "no"),
    "solvePnP": ("OpenCV: solvePnP, POSIT's successor", "4", "yes", "no"),
    "homography": ("ours, `aerial.mode=homography`", "4", "no", "no"),
    "pose": ("ours, default: the camera's pose", "0", "yes", "yes"),
}
"""{method: (name, number of landmarks that it needs, whether it needs the lens, whether it needs telemetry)}."""
PUBLISHED_M = {50.0: 1.3, 200.0: 3.5}
"""The source's mean errors with four landmarks of exact places (appendix A, Fig. 7), from video with found targets."""
ORIGIN = (-110.9, 32.2)
CHI2_95 = 5.991
"""95 % quantile of chi2 with two degrees of freedom."""
TARGETS = 20
PARTS = {"crowd": slice(0, TARGETS // 2), "disc": slice(TARGETS // 2, TARGETS)}
Row = dict[str, Any]


def settings_for(method: str) -> Settings:
    """Return the default settings, whose errors the simulated telemetry has, with independent frames."""
    return with_parameters(Settings(), {"aerial.mode": method, "aerial.correlation_s": 0.0})


def landmarks_of(batch: Scenes, s: int) -> LandmarkObservations:
    """Return the landmarks of a scene in the package's record."""
    n = batch.case.landmarks
    sigma_px = np.full(n, batch.case.pixel_sigma)
    return LandmarkObservations(
        np.arange(n), batch.marks_px[s], batch.marks[s], batch.sigma_m[s], sigma_px, np.zeros(n)
    )


def flight_of(axes: np.ndarray, place: np.ndarray) -> Flight:
    """Return the telemetry of a camera with some axes at a place."""
    right, down, forward = axes.T
    return Flight(
        altitude_m=place[2],
        place=(place[0], place[1]),
        heading_rad=float(np.arctan2(forward[0], forward[1])),
        pitch_rad=float(np.arcsin(-forward[2])),
        roll_rad=float(np.arctan2(-right[2], -down[2])),
    )


def georeferencer_inputs(batch: Scenes) -> list[tuple[Flight, LandmarkObservations]]:
    """Return the telemetry and landmarks of each scene."""
    return [(flight_of(batch.axes[s], batch.place[s]), landmarks_of(batch, s)) for s in range(len(batch))]


def locate(batch: Scenes, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Return target errors (S, T) in metres, NaN without a place, and (S, T) whether the ellipses hold them."""
    off, inside, solver = [], [], load_solver("onboard")
    for s, (flight, landmarks) in enumerate(georeferencer_inputs(batch)):
        degrees = (lonlat(landmarks.east_north_m, ORIGIN), ORIGIN) if method == "paper" else None
        fix = Georeferencer(CAMERA, settings_for(method), solver).update(1, 0.0, flight, landmarks, degrees)
        true_m = batch.true_targets[s] + batch.common_m[s]
        one = judge(fix, batch.targets_px[s], true_m, batch.case.pixel_sigma)
        off.append(np.linalg.norm(one[0], axis=1))
        inside.append(one[1])
    return np.array(off), np.array(inside)


def locate_by_opencv(batch: Scenes, method: str) -> np.ndarray:
    """Return target errors (S, T) in metres by an OpenCV function, NaN without a solution."""
    errors = np.full(batch.targets_px.shape[:2], np.nan)
    inverse_lens = np.array([[1 / FOCAL_PX, 0, -CAMERA.centre_px[0] / FOCAL_PX], [0, 1 / FOCAL_PX, 0], [0, 0, 1]])
    inverse_lens[1, 2] = -CAMERA.centre_px[1] / FOCAL_PX
    for s in range(len(batch)):
        ground, image, targets = batch.marks[s], batch.marks_px[s], batch.targets_px[s]
        if method == "findHomography":
            image_from_ground, _ = cv2.findHomography(ground, image)
        else:
            solid = np.c_[ground, np.zeros(len(ground))]
            lens = np.linalg.inv(inverse_lens)
            known, turn, shift = cv2.solvePnP(solid, image, lens, None, flags=cv2.SOLVEPNP_IPPE)
            image_from_ground = None
            if known:
                turn, shift = cv2.solvePnPRefineLM(solid, image, lens, None, turn, shift)
                image_from_ground = lens @ np.c_[cv2.Rodrigues(turn)[0][:, :2], shift]
        if image_from_ground is not None:
            found = cv2.perspectiveTransform(targets[None], np.linalg.inv(image_from_ground))[0]
            errors[s] = np.linalg.norm(found - batch.true_targets[s] - batch.common_m[s], axis=1)
    return errors


def judge(fix: Fix, targets_px: np.ndarray, true_m: np.ndarray, pixel_sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the error (T, 2) of each target, and (T,) whether its ellipse holds the error; NaN without a place."""
    if fix.by == "":
        return np.full(targets_px.shape, np.nan), np.full(len(targets_px), np.nan)
    found, covariance = locate_pixels(fix, CAMERA, targets_px, pixel_sigma)
    off = found - true_m
    return off, inside_ellipses(off, covariance)


def inside_ellipses(off: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return (T,) whether errors lie within 95 % ellipses; NaN if an error or covariance is not finite."""
    known = np.isfinite(off).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    inside = np.full(len(off), np.nan)
    inside[known] = np.einsum("ti,tij,tj->t", off[known], np.linalg.inv(covariance[known]), off[known]) < CHI2_95
    return inside


# -- studies ---------------------------------------------------------------------------------------------------------


def compare_methods(case: Case, seeds: int) -> Row:
    """Return errors, coverage of the ellipses and the bound for each method, for crowd and disc."""
    batch, row = scenes(case, seeds, TARGETS), asdict(case)
    plain = case.layout == "ring" and case.gps in ("exact", "3.5 m") and (case.tilt_deg, case.pixel_sigma) == (0, 1)
    for method in METHODS if plain else METHODS[:2]:
        far, inside = locate(batch, method)
        bound = mean_length(BOUNDS[method](batch)) if method in BOUNDS else np.full(inside.shape, np.nan)
        row[method] = {where: summarize(far[:, part], inside[:, part], bound[:, part]) for where, part in PARTS.items()}
    for method in ("findHomography", "solvePnP") if plain else ():
        far = locate_by_opencv(batch, method)
        row[method] = {where: summarize(far[:, part], np.full(1, np.nan)) for where, part in PARTS.items()}
    return row


def summarize(far: np.ndarray, inside: np.ndarray, bound: np.ndarray | float = np.nan) -> dict[str, float]:
    """Return mean and median error, mean bound, share within ellipses, and share of targets with a place."""
    known = far[np.isfinite(far)]
    return {
        "mean": float(known.mean()) if len(known) else np.nan,
        "median": float(np.median(known)) if len(known) else np.nan,
        "bound": float(np.mean(bound)),
        "inside": float(np.nanmean(inside)) if np.isfinite(inside).any() else np.nan,
        "answered": len(known) / far.size,
    }


def list_methods() -> list[Case]:
    """Return the cases of the table of methods."""
    return [Case(gps=g, landmarks=n, altitude_m=h) for g in ("exact", "3.5 m") for n in (4, 6) for h in PUBLISHED_M]


def list_cases(quick: bool) -> list[Case]:
    """Return the distinct cases of the main table."""
    plain, heights = Case(), (50.0, 200.0) if quick else (50.0, 100.0, 200.0)
    some = ("exact", "1.5 m", "3.5 m")
    rows = [replace(plain, gps=g, landmarks=n, altitude_m=h) for g in GPS for n in (4, 6) for h in heights]
    if not quick:
        rows += [replace(plain, gps=g, landmarks=n, altitude_m=h) for g in some for h in heights for n in (5, 7, 8)]
    rows += [replace(plain, layout=name, landmarks=n, gps=g) for name in LAYOUTS[1:] for g in some for n in (4, 6)]
    rows += [replace(plain, layout="small ring", landmarks=6, gps="two RTK")]
    ends = (50.0, 200.0)
    rows += [replace(plain, pixel_sigma=s, gps=g, altitude_m=h) for s in (0.5, 2.0) for g in some[:2] for h in ends]
    rows += [replace(plain, tilt_deg=t, gps=g, altitude_m=h) for t in (20.0, 45.0) for g in some for h in ends]
    return list(dict.fromkeys(rows))


# -- tables ----------------------------------------------------------------------------------------------------------


def format_main(rows: list[Row]) -> str:
    """Format the main table, one row per case."""
    head = ["layout", "GPS", "n", "AGL m", "pixels", "tilt"]
    for method in METHODS[:2]:
        head += [f"{method}: crowd (bound)", "disc (bound)", "median", "in ellipses"]
    cells = []
    for row in rows:
        line = [row["layout"], row["gps"], row["landmarks"], f"{row['altitude_m']:.0f}"]
        line += [f"{row['pixel_sigma']:g}", f"{row['tilt_deg']:.0f}°"]
        for method in METHODS[:2]:
            crowd, disc = row[method]["crowd"], row[method]["disc"]
            line += [f"{metres(part['mean'])} ({metres(part['bound'])})" for part in (crowd, disc)]
            line += [metres(disc["median"]), percent((crowd["inside"] + disc["inside"]) / 2)]
        cells.append(line)
    raw = [
        [row["gps"], row["landmarks"], f"{row['altitude_m']:.0f}"]
        + [metres(row[method]["disc"]["mean"]) for method in METHODS]
        + [metres(row["paper"]["disc"]["median"]), percent(row["paper"]["disc"]["answered"])]
        for row in rows
        if "paper" in row
    ]
    raw_head = ["GPS", "n", "AGL m", "pose", "homography in metres", "raw degrees: mean", "median", "places found"]
    tables = bench.format_table(head, cells, words=2), bench.format_table(raw_head, raw)
    return f"{tables[0]}\n\nIn raw degrees; disc, mean error in metres:\n\n{tables[1]}"


def format_methods(rows: list[Row]) -> str:
    """Format a row per method: mean and median errors in the disc at the two altitudes of the source."""
    cases, lines = [(g, n) for g in ("exact", "3.5 m") for n in (4, 6)], []
    at = {(row["gps"], row["landmarks"], row["altitude_m"]): row for row in rows if "paper" in row}
    for method, needs in NEEDS.items():
        cells = []
        for g, n in cases:
            discs = [at[g, n, h][method]["disc"] for h in PUBLISHED_M]
            mean, median = (" / ".join(metres(disc[key]) for disc in discs) for key in ("mean", "median"))
            cells.append(f"{mean} ({median})")
        found = [at[g, n, h][method]["disc"]["answered"] for g, n in cases for h in PUBLISHED_M]
        lines.append([*needs, *cells, percent(float(np.mean(found)))])
    published = " / ".join(f"{far:g}" for far in PUBLISHED_M.values())
    lines.append(["source, published, from found targets", "4", "no", "no", published, "–", "–", "–", "–"])
    head = ["method", "landmarks", "lens", "telemetry", *(f"{g}, {n} landmarks" for g, n in cases), "places found"]
    return bench.format_table(head, lines, words=4)


def percent(share: float) -> str:
    """Format a share in percent with a digit."""
    return "–" if np.isnan(share) else f"{100 * share:.1f} %"


def metres(value: float) -> str:
    """Format metres with the significant digits."""
    if not np.isfinite(value):
        return "–"
    return f"{value:.3f}" if value < 0.3 else f"{value:.2f}" if value < 10 else f"{value:.0f}"


def panels(rows: list[Row]) -> list[dict[str, Any]]:
    """Return plots of a crowd's errors by altitude and by number of landmarks, beside the bounds."""
    usual = {"layout": "ring", "pixel_sigma": 1.0, "tilt_deg": 0.0, "common_m": 0.0}
    plain = [row for row in rows if all(row[k] == v for k, v in usual.items())]
    found = []
    for x, fixed, label in (("altitude_m", ("landmarks", 4), "m, 4 landmarks"), ("landmarks", ("altitude_m", 50), "")):
        for gps in ("exact", "1.5 m", "3.5 m"):
            here = sorted((r for r in plain if r["gps"] == gps and r[fixed[0]] == fixed[1]), key=lambda r: r[x])
            lines = {
                f"{method}: {name}": {"x": [r[x] for r in here], "y": [r[method]["crowd"][key] for r in here]}
                | {"style": style}
                for method in METHODS[:2]
                for name, key, style in (("mean", "mean", "o"), ("bound", "bound", "-"))
            }
            found.append({"title": f"GPS: {gps}", "xlabel": f"{x} {label}", "ylabel": "error, m", "lines": lines})
    return found


def measure_errors(options: bench.Options) -> tuple[str, Any]:
    """Simulate all cases and format their errors."""
    cv2.setNumThreads(1)
    work = partial(compare_methods, seeds=options.seeds)
    cases = list_methods() if options.methods else list_cases(options.quick)
    found = bench.run_cases(cases, work, options.jobs)
    heights = " / ".join(f"{h:g}" for h in PUBLISHED_M)
    methods = f"Mean (median) error in metres, all over the disc, at {heights} m:\n\n{format_methods(found)}"
    if options.methods:
        return methods, {"seeds": options.seeds, "methods": found}
    bench.draw(options.plot, panels(found), columns=3)
    return f"Every frame by itself; mean error in metres:\n\n{format_main(found)}\n\n{methods}", {
        "seeds": options.seeds,
        "main": found,
    }


if __name__ == "__main__":
    options = {"--seeds": 200, "--quick": False, "--methods": False, "--jobs": 1, "--plot": None}
    bench.main(__doc__, {"": (measure_errors, options)})
