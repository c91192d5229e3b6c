"""People of known place as moving landmarks: how far off the other people are, on PETS09-S2L1 and TUD-Stadtmitte.

    python eval/geo_people.py DATA [--seeds 10] [--detections PETS.csv --interval 5] [--write eval/README.md]

DATA is a folder of MOTChallenge 2015 sequences whose gt.txt has world metres in columns 8 to 10. A few people are taken
for landmarks: the middle of their boxes' lower edge, and their world position. They are chosen by chance and stay
landmarks until they leave; or, the hardest case, they are in every frame those most nearly on one line. All others are
located by their boxes, and compared with their world positions. Frames with too few people are left out.

What a camera's telemetry would say is the true camera with errors drawn once a seed, the same in all frames: 1 % in the
focal length, 1° of tilt each way, 5° of heading, 2 % of the height, a GPS of 3.5 m in 95 %. Without telemetry the focal
length alone is known, as well as that. The lens's distortion is known. Everybody's world position is what such boxes
gave through the true camera: so the errors here are those of the pose, of whole pixels and of that camera's model.
"""

import argparse
import json
import sys
import time
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import report
from geo_error import INSIDE, flight_of
from geo_scene import ALTITUDE_SIGMA, FOCAL_SIGMA, HEADING_SIGMA, POSITION_SIGMA_M, TILT_SIGMA, looking, turned
from ranging_error import SIZES, People, detected, fitted, identities, read_truth, tsai

from torchvision_dddas.config import GroundParameters, Settings, with_parameters
from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.plane_homography import locate_pixels
from torchvision_dddas.geo.plane_solvers import load_solver
from torchvision_dddas.types import Camera, Flight, LandmarkObservations

RATE_HZ = {"PETS09-S2L1": 7.0, "TUD-Stadtmitte": 25.0}
SIGMA_M = 0.02
"""Of a landmark's place: that of an RTK receiver; the truth's own grain is as large."""

PIXEL_SIGMA = {"PETS09-S2L1": 0.4, "TUD-Stadtmitte": 1.5}
"""Of a true box's foot, along u and v each: what the true camera leaves unexplained."""

WAYS = {
    "homography": ("homography", False, 0.0),
    "pose without telemetry": ("pose", False, 0.0),
    "pose": ("pose", True, 0.0),
    "pose over time": ("pose", True, 20.0),
}
"""aerial.mode, whether there is telemetry, and aerial.correlation_s."""


@dataclass(frozen=True)
class Crowd:
    """People of a clip: frame (N,), who (N,), foot_px (N, 2), sigma_px (N,) of that, east_north_m (N, 2)."""

    frame: np.ndarray
    who: np.ndarray
    foot_px: np.ndarray
    sigma_px: np.ndarray
    east_north_m: np.ndarray


def crowd_of(people: People, truth: People, who: np.ndarray, sigma_px: float | None) -> Crowd:
    """Their feet. sigma_px: of each; None: by the height of the box, as ranging has it."""
    box = people.box_px
    known = {(f, *p): w for f, p, w in zip(truth.frame, truth.east_north_m, who, strict=True)}
    return Crowd(
        people.frame,
        np.array([known[f, *p] for f, p in zip(people.frame, people.east_north_m, strict=True)]),
        box[:, :2] + box[:, 2:] * (0.5, 1.0) - 0.5,
        np.full(len(box), sigma_px) if sigma_px else np.hypot(GroundParameters().feet_sigma * box[:, 3], 0.5),
        people.east_north_m,
    )


def landmarks(crowd: Crowd, n: int, rng: np.random.Generator | None) -> dict[int, np.ndarray]:
    """Rows of n landmarks for every frame that has more people; without rng the frame's most nearly on one line.

    With it everyone has a rank, and those who rank first among the people in the picture serve.
    """
    ids = np.unique(crowd.who)
    rank = dict(zip(ids, rng.permutation(len(ids)), strict=True)) if rng else {}
    found = {}
    for number in np.unique(crowd.frame):
        rows = np.flatnonzero(crowd.frame == number)
        if len(rows) <= n:
            continue
        if rng:
            found[int(number)] = rows[np.argsort([rank[w] for w in crowd.who[rows]])[:n]]
        else:
            sets = [rows[list(some)] for some in combinations(range(len(rows)), n)]
            found[int(number)] = min(sets, key=lambda some: narrow(crowd.east_north_m[some]))
    return found


def narrow(east_north_m: np.ndarray) -> float:
    """Width as a share of the length."""
    length, width = np.linalg.svd(east_north_m - east_north_m.mean(axis=0), compute_uv=False)
    return float(width / length)


def told(camera: Camera, rng: np.random.Generator) -> tuple[Camera, Flight]:
    """The camera as it is known, its focal length a little wrong, and what its telemetry says."""
    axes = looking(*(np.array(a) for a in (camera.heading_rad, camera.pitch_rad, camera.roll_rad)))
    axes = turned(rng.normal(0, (TILT_SIGMA, TILT_SIGMA, HEADING_SIGMA))) @ axes
    sigma = (POSITION_SIGMA_M, POSITION_SIGMA_M, ALTITUDE_SIGMA * camera.height_m)
    place = np.array([*camera.place, camera.height_m]) + rng.normal(0, sigma)
    share = np.exp(rng.normal(0, FOCAL_SIGMA))
    known = replace(camera, focal_px=(camera.focal_px[0] * share, camera.focal_px[1] * share))
    return known, flight_of(axes, place)


def follow(
    crowd: Crowd, rows: dict[int, np.ndarray], camera: Camera, flight: Flight, way: str, rate_hz: float
) -> tuple[np.ndarray, np.ndarray]:
    """Errors in metres of all who are no landmarks, NaN where nothing was said, and whether ellipses hold them."""
    mode, has_telemetry, alike_s = WAYS[way]
    settings = with_parameters(Settings(), {"aerial.mode": mode, "aerial.correlation_s": alike_s})
    registrar, far, inside = Georeferencer(camera, settings, load_solver("onboard")), [], []
    for number, some in rows.items():
        n = len(some)
        marks = LandmarkObservations(
            crowd.who[some], crowd.foot_px[some], crowd.east_north_m[some], np.full(n, SIGMA_M), crowd.sigma_px[some],
            np.zeros(n),
        )  # fmt: skip
        fix = registrar.update(number, number / rate_hz, flight if has_telemetry else None, marks, None)
        others = np.setdiff1d(np.flatnonzero(crowd.frame == number), some)
        for one in others:
            if fix.by == "":
                far.append(np.nan)
                inside.append(np.nan)
                continue
            place, covariance = locate_pixels(fix, camera, crowd.foot_px[one, None], float(crowd.sigma_px[one]))
            off = place[0] - crowd.east_north_m[one]
            far.append(float(np.linalg.norm(off)))
            sound = np.isfinite(covariance).all() and np.isfinite(off).all()
            inside.append(float(off @ np.linalg.solve(covariance[0], off) < INSIDE) if sound else np.nan)
    return np.array(far), np.array(inside)


def study(crowd: Crowd, camera: Camera, rate_hz: float, seeds: int, every: int = 1) -> list[dict[str, object]]:
    """A row for each number of landmarks, choice and way. every: of so many frames one."""
    crowd = Crowd(*(getattr(crowd, k)[crowd.frame % every == 0] for k in Crowd.__dataclass_fields__))
    found = []
    for n in (4, 5, 6):
        for choice in ("by chance", "nearest to a line"):
            many = seeds if choice == "by chance" else min(seeds, 3)
            for way in WAYS:
                errors, inside, frames, begun = [], [], 0, time.perf_counter()
                for seed in range(many):
                    rng = np.random.default_rng([seed, n])
                    rows = landmarks(crowd, n, rng if choice == "by chance" else None)
                    known, flight = told(camera, np.random.default_rng([seed, 99]))
                    far, within = follow(crowd, rows, known, flight, way, rate_hz)
                    errors.append(far)
                    inside.append(within)
                    frames += len(rows)
                far, within = np.concatenate(errors), np.concatenate(inside)
                if not len(far):
                    continue
                known_far = far[np.isfinite(far)]
                middle = [float(np.nanmean(e)) for e in errors if np.isfinite(e).any()]
                found.append(
                    {
                        "n": n, "choice": choice, "way": way, "seeds": many, "frames": frames // many,
                        "places": len(far) // many, "answered": len(known_far) / len(far),
                        "median": float(np.median(known_far)), "mean": float(known_far.mean()),
                        "p95": float(np.quantile(known_far, 0.95)), "spread": float(np.std(middle)),
                        "inside": float(np.nanmean(within)) if np.isfinite(within).any() else float("nan"),
                        "ms": 1e3 * (time.perf_counter() - begun) / frames,
                    }
                )  # fmt: skip
                print(found[-1], file=sys.stderr, flush=True)
    return found


def table(name: str, rows: list[dict]) -> str:
    """Markdown."""
    lines = [
        f"| {name} | landmarks | frames | places | told | median m | mean m | 95 % below | in ellipses |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    lines += [
        f"| {row['way']} | {row['n']}, {row['choice']} | {row['frames']} | {row['places']} "
        f"| {100 * row['answered']:.1f} % | {row['median']:.3f} | {row['mean']:.3f} | {row['p95']:.2f} "
        f"| {100 * row['inside']:.1f} % |"
        for row in rows
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of the sequences")
    parser.add_argument("--seeds", type=int, default=10, help="choices of landmarks, each with errors of its own")
    parser.add_argument("--every", type=int, default=1, help="use one of so many frames")
    parser.add_argument("--detections", type=Path, help="boxes of a detector on the PETS clip")
    parser.add_argument("--interval", type=int, default=1, help="frames from one of its frames to the next")
    parser.add_argument("--write", type=Path, help="a text whose marks <!-- geo-people --> take the tables")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    tables, found = [], {}
    for name, size in SIZES.items():
        folder = options.data / name
        if not (folder / "gt" / "gt.txt").is_file():
            print(f"{folder} has no gt/gt.txt: skipped", file=sys.stderr)
            continue
        truth = read_truth(folder, size)
        who = identities(folder)
        camera = tsai(folder / "View_001.xml") if name.startswith("PETS") else fitted(truth, size)
        kinds = {f"{name}, true boxes": crowd_of(truth, truth, who, PIXEL_SIGMA[name])}
        if name.startswith("PETS") and options.detections is not None:
            seen = detected(options.detections, options.interval, truth, size)
            kinds[f"{name}, detections"] = crowd_of(seen, truth, who, None)
        for kind, crowd in kinds.items():
            every = 1 if kind.endswith("detections") else options.every
            found[kind] = study(crowd, camera, RATE_HZ[name], options.seeds, every)
            if not found[kind]:
                continue
            tables.append(table(kind, found[kind]))
            print(tables[-1] + "\n")
    if not tables:
        sys.exit("nothing to measure: no sequence with world positions was found")
    if options.json:
        options.json.write_text(json.dumps(found, indent=1), encoding="utf-8")
    if options.write:
        report.put(options.write, "geo-people", "\n\n".join(tables))


if __name__ == "__main__":
    main()
