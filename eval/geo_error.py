"""Errors of targets located from the air by landmarks, beside the Cramér-Rao bound; simulated, no data needed.

python eval/geo_error.py [--seeds 200] [--only main]

1080p, a lens of 70 degrees; telemetry with errors of 1 % in the focal length, 1° of tilt, 5° of heading, 2 % of the
altitude and a GPS of 3.5 m in 95 %. Landmarks stand in a disc of 25 m radius (geo_scene.py), targets within 10 m of its
middle (crowd) or all over it (disc). Every frame stands alone, except in the study over time.

pose: the camera's, by landmarks and telemetry; homography: by landmarks alone, weighted, in metres; paper: the source's
normal equations in raw degrees. Ellipses are those of 95 %. An error is that of the place relative to the team; an
error that all receivers share comes on top.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import bench
import numpy as np
from geo_scene import (
    BOUNDS,
    CAMERA,
    GPS,
    LAYOUTS,
    Case,
    Scenes,
    flights,
    mean_length,
    outlying,
    scenes,
    swapped,
)

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.plane_homography import fix_by_homography, locate_pixels
from torchvision_dddas.geo.plane_solvers import load_solver
from torchvision_dddas.geo.pose_estimation import fit_pose, independent_expectation, pose_prior
from torchvision_dddas.geometry import lonlat
from torchvision_dddas.types import Fix, Flight, LandmarkObservations

METHODS = ("pose", "homography", "paper")
ORIGIN = (-110.9, 32.2)
CHI2_95 = 5.991
"""Of chi2 with two degrees of freedom."""
TARGETS = 20
PARTS = {"crowd": slice(0, TARGETS // 2), "disc": slice(TARGETS // 2, TARGETS)}
CORRELATION_S = 20.0
"""Time constant of the errors that the georeferencer assumes in flights."""
WHITE_S = 1e-3
"""Errors with a time constant this short are independent from frame to frame."""
Row = dict[str, Any]


@dataclass(frozen=True)
class Found:
    """Results of a method for a batch: off_m (S, T, 2), NaN where there is no place; inside (S, T) of the ellipses.

    states: what became of each landmark, by scene.
    """

    off_m: np.ndarray
    inside: np.ndarray
    states: list[tuple[str, ...]]

    @property
    def distance_m(self) -> np.ndarray:
        """(S, T) errors, NaN where there is no place."""
        return np.linalg.norm(self.off_m, axis=-1)


def settings_for(method: str) -> Settings:
    """The defaults, which the simulated telemetry keeps to, with frames that stand alone."""
    return with_parameters(Settings(), {"aerial.mode": method, "aerial.correlation_s": 0.0})


def landmarks_of(batch: Scenes, s: int) -> LandmarkObservations:
    """The landmarks of one scene as the package takes them."""
    n = batch.case.landmarks
    sigma_px = np.full(n, batch.case.pixel_sigma)
    return LandmarkObservations(
        np.arange(n), batch.marks_px[s], batch.marks[s], batch.sigma_m[s], sigma_px, np.zeros(n)
    )


def flight_of(axes: np.ndarray, place: np.ndarray) -> Flight:
    """Telemetry of a camera with these axes at this place."""
    right, down, forward = axes.T
    return Flight(
        altitude_m=place[2],
        place=(place[0], place[1]),
        heading_rad=float(np.arctan2(forward[0], forward[1])),
        pitch_rad=float(np.arcsin(-forward[2])),
        roll_rad=float(np.arctan2(-right[2], -down[2])),
    )


def georeferencer_inputs(batch: Scenes) -> list[tuple[Flight, LandmarkObservations]]:
    """Telemetry and landmarks of each scene."""
    return [(flight_of(batch.axes[s], batch.place[s]), landmarks_of(batch, s)) for s in range(len(batch))]


def locate(batch: Scenes, method: str) -> Found:
    """Locate the targets of every scene with all checks of the landmarks."""

    def fix_of(flight: Flight, landmarks: LandmarkObservations) -> Fix:
        degrees = (lonlat(landmarks.east_north_m, ORIGIN), ORIGIN) if method == "paper" else None
        return Georeferencer(CAMERA, settings_for(method), load_solver("onboard")).update(
            1, 0.0, flight, landmarks, degrees
        )

    return _locate(batch, fix_of)


def locate_unchecked(batch: Scenes, method: str) -> Found:
    """The same with landmarks taken as they come, whatever is wrong with them."""
    aerial, solver = settings_for(method).aerial, load_solver("onboard")

    def fix_of(flight: Flight, landmarks: LandmarkObservations) -> Fix:
        if method == "homography":
            return fix_by_homography(1, landmarks, solver, aerial.least_spread)
        prior = pose_prior(flight, CAMERA, aerial)
        assert prior is not None
        solution = fit_pose(landmarks, CAMERA, independent_expectation(prior, landmarks.sigma_m))
        return Fix(1, "") if solution is None else Fix(1, "pose", solution.pose, solution.covariance[:7, :7])

    return _locate(batch, fix_of)


def _locate(batch: Scenes, fix_of: Callable[[Flight, LandmarkObservations], Fix]) -> Found:
    off, inside, states = [], [], []
    for s, (flight, landmarks) in enumerate(georeferencer_inputs(batch)):
        fix = fix_of(flight, landmarks)
        one = judge(fix, batch.targets_px[s], batch.true_targets[s] + batch.common_m[s], batch.case.pixel_sigma)
        off.append(one[0])
        inside.append(one[1])
        states.append(fix.state)
    return Found(np.array(off), np.array(inside), states)


def judge(fix: Fix, targets_px: np.ndarray, true_m: np.ndarray, pixel_sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Error of each target, (T, 2), and whether its ellipse holds that, (T,); NaN where there is no place."""
    if fix.by == "":
        return np.full(targets_px.shape, np.nan), np.full(len(targets_px), np.nan)
    found, covariance = locate_pixels(fix, CAMERA, targets_px, pixel_sigma)
    off = found - true_m
    return off, inside_ellipses(off, covariance)


def inside_ellipses(off: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(T,) whether errors lie within 95 % ellipses; NaN where either is not finite."""
    known = np.isfinite(off).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    inside = np.full(len(off), np.nan)
    inside[known] = np.einsum("ti,tij,tj->t", off[known], np.linalg.inv(covariance[known]), off[known]) < CHI2_95
    return inside


# -- studies ---------------------------------------------------------------------------------------------------------


def compare_methods(case: Case, seeds: int) -> Row:
    """For each method, and for crowd and disc: errors, coverage of the ellipses and the bound."""
    batch, row = scenes(case, seeds, TARGETS), asdict(case)
    plain = case.layout == "ring" and case.gps in ("exact", "3.5 m") and (case.tilt_deg, case.pixel_sigma) == (0, 1)
    for method in METHODS if plain else METHODS[:2]:
        found = locate(batch, method)
        bound = mean_length(BOUNDS[method](batch)) if method in BOUNDS else np.full(found.inside.shape, np.nan)
        row[method] = {
            where: summarize(found.distance_m[:, part], found.inside[:, part], bound[:, part])
            for where, part in PARTS.items()
        }
    return row


def summarize(far: np.ndarray, inside: np.ndarray, bound: np.ndarray | float = np.nan) -> dict[str, float]:
    """Mean and median error, mean bound, share within ellipses, and share of targets with a place."""
    known = far[np.isfinite(far)]
    return {
        "mean": float(known.mean()) if len(known) else np.nan,
        "median": float(np.median(known)) if len(known) else np.nan,
        "bound": float(np.mean(bound)),
        "inside": float(np.nanmean(inside)) if np.isfinite(inside).any() else np.nan,
        "answered": len(known) / far.size,
    }


def break_landmarks(kind: str, case: Case, seeds: int) -> Row:
    """What becomes of scenes whose landmarks are correct, swapped, or one of them 30 m off."""
    batch = scenes(case, seeds, TARGETS)
    broken = {"none": batch, "swap": swapped(batch), "30 m off": outlying(batch, 30.0)}[kind]
    found = locate(broken, "pose")
    alone = [state[0] == "excluded" and "excluded" not in state[1:] for state in found.states]
    moved = (broken.marks_px != batch.marks_px).any(axis=2)
    wanted = [tuple(np.where(rows, "reassigned", "used").tolist()) for rows in moved]
    mended = [state == right for state, right in zip(found.states, wanted, strict=True)]
    return {
        "fault": kind, **asdict(case),
        "flagged": float(np.mean([any(one != "used" for one in state) for state in found.states])),
        "found": float(np.mean(alone if kind == "30 m off" else mended)),
        **{f"{method}, unchecked": summarize(here.distance_m, here.inside)
           for method in ("homography", "pose") for here in [locate_unchecked(broken, method)]},
        "pose": summarize(found.distance_m, found.inside),
    }  # fmt: skip


def follow_flights(case: Case, seeds: int, true_correlation_s: tuple[float, float]) -> Row:
    """Each frame alone and the filter over time, in the second half of flights of 20 s at 5 Hz."""
    rate_hz, frames = 5.0, 100
    batches = flights(case, seeds, frames, 1 / rate_hz, true_correlation_s)
    found: Row = asdict(case) | {"flights": seeds, "correlation_s": true_correlation_s}
    by_flight = {}
    for name, correlation_s in (("single frames", 0.0), ("over time", CORRELATION_S)):
        settings = with_parameters(settings_for("pose"), {"aerial.correlation_s": correlation_s})
        far, inside = np.full((2, seeds, frames, batches[0].targets_px.shape[1]), np.nan)
        for s in range(seeds):
            georeferencer = Georeferencer(CAMERA, settings, load_solver("onboard"))
            for f, batch in enumerate(batches):
                flight = flight_of(batch.axes[s], batch.place[s])
                fix = georeferencer.update(f + 1, f / rate_hz, flight, landmarks_of(batch, s))
                off, inside[s, f] = judge(fix, batch.targets_px[s], batch.true_targets[s], case.pixel_sigma)
                far[s, f] = np.linalg.norm(off, axis=1)
        found[name] = summarize(far[:, frames // 2 :], inside[:, frames // 2 :])
        by_flight[name] = np.nanmean(far[:, frames // 2 :], axis=(1, 2))
    gain = by_flight["over time"] - by_flight["single frames"]
    found["gain"] = [float(gain.mean()), float(gain.std(ddof=1) / np.sqrt(seeds))]
    return found


def list_cases(quick: bool) -> list[Case]:
    """The cases of the main table, each once."""
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


def list_studies(seeds: int, quick: bool) -> Mapping[str, list[Callable[[], Row]]]:
    """The cases of each study."""
    alike, white = (CORRELATION_S, CORRELATION_S), WHITE_S
    times = [(4, "exact", alike), (4, "1.5 m", alike), (4, "3.5 m", alike), (4, "3.5 m", (4.0, 4.0))]
    times += [(4, "3.5 m", (100.0, 100.0)), (4, "3.5 m", (white, white)), (4, "3.5 m", (20.0, white))]
    times += [(4, "3.5 m", (white, 20.0)), (6, "3.5 m", alike)]
    situations = [(g, h, n) for g, h in (("3.5 m", 50.0), ("3.5 m", 200.0), ("1.5 m", 50.0)) for n in (4, 6)]
    return {
        "main": [partial(compare_methods, case, seeds) for case in list_cases(quick)],
        "faults": [
            partial(break_landmarks, kind, Case(landmarks=n, gps=g, altitude_m=h), max(seeds // 2, 2))
            for kind in ("none", "swap", "30 m off")
            for g, h, n in situations
        ],
        "time": [partial(follow_flights, Case(landmarks=n, gps=g), max(seeds // 10, 2), a) for n, g, a in times],
    }


# -- tables ----------------------------------------------------------------------------------------------------------


def format_main(rows: list[Row]) -> str:
    """A row a case."""
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


def format_faults(rows: list[Row]) -> str:
    """What tests of the landmarks find and mend."""
    head = ["fault", "GPS", "n", "AGL m", "homography, unchecked: mean (median)", "pose, unchecked", "flagged"]
    head += ["found and mended", "pose: mean (median)", "in ellipses"]
    cells = []
    for row in rows:
        pairs = [
            f"{metres(row[key]['mean'])} ({metres(row[key]['median'])})"
            for key in ("homography, unchecked", "pose, unchecked", "pose")
        ]
        found = "–" if row["fault"] == "none" else percent(row["found"])
        line = [row["fault"], row["gps"], row["landmarks"], f"{row['altitude_m']:.0f}", *pairs[:2]]
        cells.append([*line, percent(row["flagged"]), found, pairs[2], percent(row["pose"]["inside"])])
    return bench.format_table(head, cells, words=2)


def format_time(rows: list[Row]) -> str:
    """What earlier frames gain."""
    head = ["GPS", "n", "time constants of errors: telemetry, receivers", "flights"]
    head += ["single frames: mean (median)", "in ellipses", "over time: mean (median)", "in ellipses", "gain"]
    cells = []
    for row in rows:
        times = ", ".join("white" if one < 0.01 else f"{one:g} s" for one in row["correlation_s"])
        line = [row["gps"], row["landmarks"], times, row["flights"]]
        for part in (row["single frames"], row["over time"]):
            line += [f"{metres(part['mean'])} ({metres(part['median'])})", percent(part["inside"])]
        cells.append([*line, f"{row['gain'][0]:+.3f} ± {row['gain'][1]:.3f}"])
    return bench.format_table(head, cells)


def percent(share: float) -> str:
    """With a digit."""
    return "–" if np.isnan(share) else f"{100 * share:.1f} %"


def metres(value: float) -> str:
    """With no more digits than are significant."""
    if not np.isfinite(value):
        return "–"
    return f"{value:.3f}" if value < 0.3 else f"{value:.2f}" if value < 10 else f"{value:.0f}"


TABLES: dict[str, tuple[str, Callable[[list[Row]], str]]] = {
    "main": ("Every frame by itself; mean error in metres", format_main),
    "faults": ("Swapped identities, a GPS 30 m off; error of all targets in metres", format_faults),
    "time": ("Flights of 20 s at 5 Hz, from 50 m, second half; error of all targets in metres", format_time),
}


def panels(rows: list[Row]) -> list[dict[str, Any]]:
    """Errors of a crowd by altitude and by number of landmarks, beside the bounds."""
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
    """Simulate all studies, or one of them."""
    found = {}
    for name, cases in list_studies(options.seeds, options.quick).items():
        if options.only in ("", name):
            found[name] = bench.run_cases(cases, _call, options.jobs)
    if "main" in found:
        bench.draw(options.plot, panels(found["main"]), columns=3)
    text = "\n\n".join(f"{TABLES[name][0]}:\n\n{TABLES[name][1](rows)}" for name, rows in found.items())
    return text, {"seeds": options.seeds, **found}


def _call(case: Callable[[], Row]) -> Row:
    return case()


if __name__ == "__main__":
    options = {"--seeds": 200, "--quick": False, "--only": "", "--jobs": 1, "--plot": None}
    bench.main(__doc__, {"": (measure_errors, options)})
