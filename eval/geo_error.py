"""How far targets are off that are located from the air by landmarks, beside the Cramér-Rao bound: simulated.

    python eval/geo_error.py [--seeds 200] [--quick] [--write eval/README.md] [--json FILE] [--plot docs/geo_error.png]

1080p, a lens of 70 degrees; telemetry with errors of 1 % in the focal length, 1° of tilt, 5° of heading, 2 % of the
altitude and a GPS of 3.5 m in 95 %. Landmarks stand in a disc of 25 m radius, see geo_scene.py; targets within 10 m of
its middle (crowd) or all over it (disc). Every frame stands alone, but for the study over time. No data are needed.

pose: the camera's, by landmarks and telemetry; homography: by landmarks alone, weighted, in metres; paper: the source's
normal equations in raw degrees. The ellipses are those of 95 %. An error is that of the place relative to the team; the
error that all receivers share comes on top, where there is one.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import geo_plots
import geo_tables
import numpy as np
import report
import results
from geo_scene import (
    BOUNDS,
    CAMERA,
    GPS,
    LAYOUTS,
    Case,
    Scenes,
    chosen,
    flights,
    mean_length,
    outlying,
    scenes,
    swapped,
)

from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.plane_homography import absolute_covariance, fix_by_homography, locate_pixels
from torchvision_dddas.geo.plane_solvers import load_solver
from torchvision_dddas.geo.pose_estimation import fit_pose, independent_expectation, pose_prior
from torchvision_dddas.geometry import lonlat
from torchvision_dddas.types import Fix, Flight, LandmarkObservations

METHODS = ("pose", "homography", "paper")
ORIGIN = (-110.9, 32.2)
INSIDE = 5.991
"""Of chi2 with two degrees of freedom, in 95 %."""

TARGETS = 20
ALIKE_S = 20.0
"""What the registrar takes the time constant of the errors of telemetry and receivers to be, in flights."""

NO_TIME_S = 1e-3
"""Errors alike over no longer than this are new in every frame."""


@dataclass(frozen=True)
class Found:
    """What a method says of a batch: off_m (S, T, 2), NaN where it says nothing; inside (S, T) of the ellipses.

    flagged: (S,) whether landmarks were reassigned or excluded. states: what became of each.
    """

    off_m: np.ndarray
    inside: np.ndarray
    flagged: np.ndarray
    states: list[tuple[str, ...]]


def settings_for(method: str) -> Settings:
    """Frames stand alone; the rest are the defaults, which the simulated telemetry keeps to."""
    return with_parameters(Settings(), {"aerial.mode": method, "aerial.correlation_s": 0.0})


def marks_of(batch: Scenes, s: int) -> LandmarkObservations:
    """The landmarks of one scene as the package has them."""
    n = batch.case.landmarks
    return LandmarkObservations(
        np.arange(n),
        batch.marks_px[s],
        batch.marks[s],
        batch.sigma_m[s],
        np.full(n, batch.case.pixel_sigma),
        np.zeros(n),
    )


def flight_of(axes: np.ndarray, place: np.ndarray) -> Flight:
    """Telemetry that says so."""
    right, down, forward = axes.T
    return Flight(
        altitude_m=place[2],
        place=(place[0], place[1]),
        heading_rad=float(np.arctan2(forward[0], forward[1])),
        pitch_rad=float(np.arcsin(-forward[2])),
        roll_rad=float(np.arctan2(-right[2], -down[2])),
    )


def run(batch: Scenes, method: str) -> Found:
    """Locate the targets of every scene."""
    settings, solver = settings_for(method), load_solver("onboard")
    count, targets = batch.targets_px.shape[:2]
    off, inside = np.full((count, targets, 2), np.nan), np.full((count, targets), np.nan)
    flagged, states = np.zeros(count, bool), []
    for s in range(count):
        marks, flight = marks_of(batch, s), flight_of(batch.axes[s], batch.place[s])
        degrees = (lonlat(marks.east_north_m, ORIGIN), ORIGIN) if method == "paper" else None
        fix = Georeferencer(CAMERA, settings, solver).update(1, 0.0, flight, marks, degrees)
        off[s], inside[s] = judged(fix, batch.targets_px[s], batch.true_targets[s] + batch.common_m[s], batch.case)
        flagged[s] = any(state != "used" for state in fix.state)
        states.append(fix.state)
    return Found(off, inside, flagged, states)


def judged(fix: Fix, targets_px: np.ndarray, where_m: np.ndarray, case: Case) -> tuple[np.ndarray, np.ndarray]:
    """How far each target is off, (T, 2), and whether its ellipse holds that, (T,); NaN where nothing is said."""
    if fix.by == "":
        return np.full(targets_px.shape, np.nan), np.full(len(targets_px), np.nan)
    found, covariance = locate_pixels(fix, CAMERA, targets_px, case.pixel_sigma)
    off = found - where_m
    known = np.isfinite(off).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    inside = np.full(len(off), np.nan)
    inside[known] = np.einsum("ti,tij,tj->t", off[known], np.linalg.inv(covariance[known]), off[known]) < INSIDE
    return off, inside


# --------------------------------------------------------------------------------------------------------------------
# Figures.


def figures(case: Case, seeds: int) -> dict[str, object]:
    """Of one case, a row of the table: for each method and for crowd and disc, errors, ellipses and the bound."""
    batch = scenes(case, seeds, TARGETS)
    found: dict[str, object] = asdict(case)
    for method in METHODS:
        if method == "paper" and not (
            case.layout == "ring" and case.gps in ("exact", "3.5 m") and (case.tilt_deg, case.pixel_sigma) == (0, 1)
        ):
            continue
        result = run(batch, method)
        bound = mean_length(BOUNDS[method](batch)) if method in BOUNDS else np.full(result.inside.shape, np.nan)
        found[method] = {"flagged": float(result.flagged.mean())} | {
            where: summary(result.off_m[:, part], result.inside[:, part], bound[:, part])
            for where, part in PARTS.items()
        }
        if case.common_m:
            found[f"{method}, absolute"] = {
                where: float(lengths(away[:, part]).mean()) for where, part in PARTS.items()
            }
    return found


PARTS = {"crowd": slice(0, TARGETS // 2), "disc": slice(TARGETS // 2, TARGETS)}


def shared(case: Case, seeds: int) -> dict[str, object]:
    """What becomes of places where all receivers share an error: relative to the team, and on the Earth."""
    batch, settings = scenes(case, seeds, TARGETS), with_parameters(Settings(), {"aerial.correlation_s": 0.0})
    off, inside = {"relative": [], "absolute": []}, {"relative": [], "absolute": []}
    for s in range(seeds):
        fix = Georeferencer(CAMERA, settings, load_solver("onboard")).update(
            1, 0.0, flight_of(batch.axes[s], batch.place[s]), marks_of(batch, s)
        )
        found, covariance = locate_pixels(fix, CAMERA, batch.targets_px[s], case.pixel_sigma)
        truth = batch.true_targets[s]
        for kind, where, spread in (
            ("relative", truth + batch.common_m[s], covariance),
            ("absolute", truth, absolute_covariance(covariance, case.common_m)),
        ):
            away = found - where
            off[kind].append(np.linalg.norm(away, axis=1))
            inside[kind].append(np.einsum("ti,tij,tj->t", away, np.linalg.inv(spread), away) < INSIDE)
    return asdict(case) | {k: {"mean": float(np.mean(off[k])), "inside": float(np.mean(inside[k]))} for k in off}


def lengths(off_m: np.ndarray) -> np.ndarray:
    """Of the errors that are known."""
    far = np.linalg.norm(off_m, axis=-1)
    return far[np.isfinite(far)]


def summary(off_m: np.ndarray, inside: np.ndarray, bound: np.ndarray) -> dict[str, float]:
    """Mean, median, the bound's mean and the share within ellipses; answered: share of places that were told."""
    far = lengths(off_m)
    known = inside[np.isfinite(inside)]
    none = float("nan")
    return {
        "mean": float(far.mean()) if len(far) else none,
        "median": float(np.median(far)) if len(far) else none,
        "bound": float(bound.mean()),
        "inside": float(known.mean()) if len(known) else none,
        "answered": len(far) / (off_m.size // 2),
    }


def cases(quick: bool) -> list[Case]:
    """The rows of the table, each once."""
    plain = Case()
    heights = (50.0, 200.0) if quick else (50.0, 100.0, 200.0)
    rows = [
        replace(plain, gps=gps, landmarks=n, altitude_m=height) for gps in GPS for n in (4, 6) for height in heights
    ]
    rows += [
        replace(plain, landmarks=n, gps=gps, altitude_m=height)
        for gps in ("exact", "1.5 m", "3.5 m")
        for height in heights
        for n in (5, 7, 8)
        if not quick
    ]
    rows += [
        replace(plain, layout=name, landmarks=n, gps=gps)
        for name in LAYOUTS[1:]
        for gps in ("exact", "1.5 m", "3.5 m")
        for n in (4, 6)
    ]
    rows += [replace(plain, layout="small ring", landmarks=6, gps="two RTK")]
    rows += [
        replace(plain, pixel_sigma=sigma, gps=gps, altitude_m=height)
        for sigma in (0.5, 2.0)
        for gps in ("exact", "1.5 m")
        for height in (50.0, 200.0)
    ]
    rows += [
        replace(plain, tilt_deg=tilt, gps=gps, altitude_m=height)
        for tilt in (20.0, 45.0)
        for gps in ("exact", "1.5 m", "3.5 m")
        for height in (50.0, 200.0)
    ]
    return list(dict.fromkeys(rows))


def six_or_four(layout: str, gps: str, seeds: int) -> dict[str, object]:
    """What six landmarks gain over four of them, and over four laid out by themselves, in the same scenes, by the pose.

    Mean over scenes of the difference of the mean errors of the disc's targets, its standard error, and the shares.
    """
    six = scenes(Case(landmarks=6, layout=layout, gps=gps), seeds, TARGETS)
    rng = np.random.default_rng(11)
    rows = np.stack([np.sort(rng.permutation(6)[:4]) for _ in range(seeds)])
    few = {
        "four of them": chosen(six, rows),
        "four by themselves": scenes(replace(six.case, landmarks=4), seeds, TARGETS),
    }
    found: dict[str, object] = {"layout": layout, "gps": gps}
    for method in ("pose", "homography"):
        all_six = per_scene(run(six, method))
        for name, batch in few.items():
            four = per_scene(run(batch, method))
            both = np.isfinite(all_six) & np.isfinite(four)
            gain, told = (all_six - four)[both], bool(both.sum() > 1)
            found[f"{method}, {name}"] = {
                "six": float(np.nanmean(all_six)),
                "four": float(np.nanmean(four)) if told else float("nan"),
                "ratio of medians": float(np.median(all_six[both]) / np.median(four[both])) if told else float("nan"),
                "difference": float(gain.mean()) if told else float("nan"),
                "error": float(gain.std(ddof=1) / np.sqrt(len(gain))) if told else float("nan"),
            }
    return found


def per_scene(result: Found) -> np.ndarray:
    """(S,) mean error of a scene's targets, those that were told; NaN where none was."""
    far = np.linalg.norm(result.off_m, axis=-1)
    told = np.isfinite(far)
    return np.where(told, far, 0).sum(axis=1) / np.where(told.any(axis=1), told.sum(axis=1), np.nan)


def middle(off_m: np.ndarray) -> tuple[float, float]:
    """Mean and median of the errors that are known."""
    far = lengths(off_m)
    return (float(far.mean()), float(np.median(far))) if len(far) else (float("nan"), float("nan"))


def faults(kind: str, case: Case, seeds: int) -> dict[str, object]:
    """What becomes of scenes whose landmarks are as they should be, swapped, or one of them 30 m off."""
    batch = scenes(case, seeds, TARGETS)
    broken = {"none": batch, "swap": swapped(batch), "30 m off": outlying(batch, 30.0)}[kind]
    result, before, bare = run(broken, "pose"), blind(broken, "pose"), blind(broken, "homography")
    right = [state[0] == "excluded" and "excluded" not in state[1:] for state in result.states]
    apart = (broken.marks_px != batch.marks_px).any(axis=2)
    should = [tuple(np.where(rows, "reassigned", "used").tolist()) for rows in apart]
    mended = [state == wanted for state, wanted in zip(result.states, should, strict=True)]
    return {
        "fault": kind, **asdict(case),
        "flagged": float(result.flagged.mean()),
        "found": float(np.mean(right if kind == "30 m off" else mended)),
        "homography": middle(bare.off_m), "before": middle(before.off_m), "after": middle(result.off_m),
        "homography told": float(np.isfinite(bare.off_m[..., 0]).mean()),
        "crowd": float(lengths(result.off_m[:, PARTS["crowd"]]).mean()),
        "inside": float(np.nanmean(result.inside)),
        "answered": float(np.isfinite(result.off_m[..., 0]).mean()),
    }  # fmt: skip


def blind(batch: Scenes, method: str) -> Found:
    """What landmarks give that are taken as they come, whatever is wrong with them."""
    settings, solver = settings_for(method), load_solver("onboard")
    off, inside = np.full(batch.targets_px.shape, np.nan), np.full(batch.targets_px.shape[:2], np.nan)
    for s in range(len(batch)):
        if method == "homography":
            fix = fix_by_homography(1, marks_of(batch, s), solver, settings.aerial.least_spread)
        else:
            prior = pose_prior(flight_of(batch.axes[s], batch.place[s]), CAMERA, settings.aerial)
            assert prior is not None
            solution = fit_pose(marks_of(batch, s), CAMERA, independent_expectation(prior, batch.sigma_m[s]))
            fix = Fix(1, "") if solution is None else Fix(1, "pose", solution.pose, solution.covariance[:7, :7])
        off[s], inside[s] = judged(fix, batch.targets_px[s], batch.true_targets[s] + batch.common_m[s], batch.case)
    return Found(off, inside, np.zeros(len(off), bool), [])


def over_time(
    case: Case, seeds: int, seconds: float, rate_hz: float, true_alike_s: tuple[float, float]
) -> dict[str, object]:
    """Errors of each frame by itself and of the registrar's state over time, in the second half of the flights."""
    frames = round(seconds * rate_hz)
    batches = flights(case, seeds, frames, 1 / rate_hz, true_alike_s)
    found: dict[str, object] = asdict(case) | {"flights": seeds, "alike_s": true_alike_s}
    alone, by_flight = load_solver("onboard"), {}
    for name, alike_s in (("single frames", 0.0), ("over time", ALIKE_S)):
        settings = with_parameters(settings_for("pose"), {"aerial.correlation_s": alike_s})
        far, inside = np.full((2, seeds, frames, batches[0].targets_px.shape[1]), np.nan)
        for s in range(seeds):
            registrar = Georeferencer(CAMERA, settings, alone)
            for f, batch in enumerate(batches):
                flight = flight_of(batch.axes[s], batch.place[s])
                fix = registrar.update(f + 1, f / rate_hz, flight, marks_of(batch, s))
                off, inside[s, f] = judged(fix, batch.targets_px[s], batch.true_targets[s], case)
                far[s, f] = np.linalg.norm(off, axis=1)
        late = slice(frames // 2, None)
        by_flight[name] = np.nanmean(far[:, late], axis=(1, 2))
        found[name] = {
            "mean": float(np.nanmean(far[:, late])),
            "median": float(np.nanmedian(far[:, late])),
            "inside": float(np.nanmean(inside[:, late])),
        }
    gain = by_flight["over time"] - by_flight["single frames"]
    found["gain"] = [float(gain.mean()), float(gain.std(ddof=1) / np.sqrt(seeds))]
    return found


TABLES = (
    ("main", "Every frame by itself; mean error in metres", geo_tables.main_table),
    ("main", "In raw degrees; disc, mean error in metres", geo_tables.paper_table),
    ("six", "Six landmarks or four, from 50 m; mean error in metres, ± standard error", geo_tables.six_table),
    ("faults", "Swapped identities, a GPS 30 m off; error of all targets in metres", geo_tables.fault_table),
    ("common", "An error of 3.5 m in 95 % that all receivers share, from 50 m; in metres", geo_tables.common_table),
    ("time", "Flights of 20 s at 5 Hz, from 50 m, second half; error of all targets in metres", geo_tables.time_table),
)


def told(found: dict[str, list[dict]]) -> str:
    """All tables of what was measured."""
    return "\n\n".join(f"{title}:\n\n{table(found[study])}" for study, title, table in TABLES if study in found)


def shown(found: dict[str, Any]) -> dict[str, list[dict]]:
    """The studies as the text has them: not every altitude and number of landmarks."""
    parts = {name: found[name] for name in ("main", "six", "faults", "common", "time") if name in found}
    few = [row for row in parts.get("main", []) if row["altitude_m"] != 100 and row["landmarks"] in (4, 6)]
    return parts | ({"main": few} if few else {})


def together(workers: int, jobs: Iterable[Callable[[], dict[str, object]]]) -> list[dict]:
    """Results of all jobs, in order."""
    with ProcessPoolExecutor(workers) as pool:
        waiting = [pool.submit(job) for job in jobs]
        found = []
        for done, job in enumerate(waiting, 1):
            found.append(job.result())
            print(f"\r{done} of {len(waiting)} ", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return found


def main() -> None:
    """Simulate, print, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200, help="scenes of a case")
    parser.add_argument("--quick", action="store_true", help="fewer cases, 60 scenes each")
    parser.add_argument("--only", choices=("main", "six", "faults", "common", "time"), help="one of the studies")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--write", type=Path, help="a text whose marks <!-- geo-error --> take the tables")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    seeds = 60 if options.quick else options.seeds
    begun, found = time.perf_counter(), {}
    studies = {
        "main": [partial(figures, case, seeds) for case in cases(options.quick)],
        "six": [partial(six_or_four, name, gps, seeds) for name in LAYOUTS for gps in ("exact", "1.5 m", "3.5 m")],
        "faults": [
            partial(faults, kind, Case(landmarks=n, gps=gps, altitude_m=height), max(seeds // 2, 50))
            for kind in ("none", "swap", "30 m off")
            for gps, height in (("3.5 m", 50.0), ("3.5 m", 200.0), ("1.5 m", 50.0))
            for n in (4, 6)
        ],
        "common": [
            partial(shared, Case(landmarks=n, gps=gps, common_m=GPS["3.5 m"]), seeds)
            for gps in ("2 cm RTK", "1.5 m")
            for n in (4, 6)
        ],
        "time": [
            partial(over_time, Case(landmarks=n, gps=gps), max(seeds // 10, 10), 20.0, 5.0, alike_s)
            for n, gps, alike_s in (
                (4, "exact", (20.0, 20.0)),
                (4, "1.5 m", (20.0, 20.0)),
                (4, "3.5 m", (20.0, 20.0)),
                (4, "3.5 m", (4.0, 4.0)),
                (4, "3.5 m", (100.0, 100.0)),
                (4, "3.5 m", (NO_TIME_S, NO_TIME_S)),
                (4, "3.5 m", (20.0, NO_TIME_S)),
                (4, "3.5 m", (NO_TIME_S, 20.0)),
                (6, "3.5 m", (20.0, 20.0)),
            )
        ],
    }
    for name, jobs in studies.items():
        if options.only in (None, name):
            found[name] = together(options.workers, jobs)
    print(told(found))
    print(f"\n{seeds} scenes a case, {TARGETS} targets each; {time.perf_counter() - begun:.0f} s", file=sys.stderr)
    if options.json:
        options.json.write_text(json.dumps({"seeds": seeds, **found}, indent=1), encoding="utf-8")
    if options.write:
        report.place(options.write, "geo-error", told(shown(found)))
        results.keep("geo-error", {"command": results.command(), "day": results.today(), "seeds": seeds, **found})
    if options.plot and "main" in found:
        geo_plots.draw(found["main"], options.plot)


if __name__ == "__main__":
    main()
