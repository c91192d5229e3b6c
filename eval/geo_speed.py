"""How long geo-localization takes: homographies of landmarks, the camera's pose a frame, degrees to metres and back.

    python eval/geo_speed.py [--rounds 15] [--write eval/README.md] [--json FILE]

The pose is fitted to the scenes of geo_scene.py: 1080p, 50 m high, GPS of 3.5 m. All take their turns, so that whatever
else the machine does meets them all; figures are medians over the turns of the time of one call, with the lower and
upper quartile. A call is the whole of it, from NumPy arrays to NumPy arrays; the processor's time is told as well, as
the clock's grows with the load of the machine. No data are needed.
"""

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle torch threads must not spin through the others' turns

import cv2
import numpy as np
import onnxruntime
import report
from geo_error import flight_of, marks_of, settings_for
from geo_scene import CAMERA, Case, scenes

from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.plane_solvers import load_solver
from torchvision_dddas.geometry import east_north, lonlat

ORIGIN = (-110.95, 32.23)
SETS, POINTS, FRAMES = 10_000, 1_000_000, 50


def tasks() -> dict[str, tuple[Callable[[], object], int, float]]:
    """What is timed: a call, how often it is made in a turn, and how many things it does each time."""
    found: dict[str, tuple[Callable[[], object], int, float]] = {}
    backs = ["onboard"] + ["torch"] * (find_spec("torch") is not None)
    solvers = {name: load_solver(name) for name in backs}
    for n in (4, 6, 16):
        ground, image = landmarks(n, 1)
        weight = np.ones((1, n))
        rows, right = system(ground[0], image[0])
        for name, solver in solvers.items():
            found[f"{name}, one set of {n}"] = lambda s=solver, g=ground, i=image, w=weight: s.solve(g, i, w), 50, 1
        found[f"onboard, as printed, one set of {n}"] = (
            lambda g=ground, i=image: solvers["onboard"].solve_raw(g, i),
            50,
            1,
        )
        found[f"numpy.linalg.lstsq, one set of {n}"] = lambda a=rows, k=right: np.linalg.lstsq(a, k), 50, 1
        found[f"cv2.findHomography, one set of {n}"] = (
            lambda g=ground[0], i=image[0]: cv2.findHomography(g, i, 0),
            50,
            1,
        )
    ground, image = landmarks(6, SETS)
    weight = np.ones((SETS, 6))
    for name, solver in solvers.items():
        found[f"{name}, batch of {SETS} sets of 6"] = lambda s=solver: s.solve(ground, image, weight), 1, SETS
    found[f"onboard, as printed, batch of {SETS} sets of 6"] = (
        lambda: solvers["onboard"].solve_raw(ground, image),
        1,
        SETS,
    )

    def one_by_one() -> None:
        for g, i in zip(ground, image, strict=True):
            cv2.findHomography(g, i, 0)

    found[f"cv2.findHomography, {SETS} sets of 6"] = one_by_one, 1, SETS
    for n in (4, 6, 8):
        found[f"camera's pose, {n} landmarks"] = poses(n), 1, FRAMES
    metres = np.random.default_rng(0).uniform(-2000, 2000, (POINTS, 2))
    degrees = lonlat(metres, ORIGIN)
    found[f"{POINTS} points to degrees"] = lambda: lonlat(metres, ORIGIN), 1, 1
    found[f"{POINTS} points to metres"] = lambda: east_north(degrees, ORIGIN), 1, 1
    return found


def landmarks(n: int, sets: int) -> tuple[np.ndarray, np.ndarray]:
    """Their places and their pixels, (sets, n, 2) each, from 50 m above and a little tilted, with 1 px of noise."""
    rng = np.random.default_rng(n)
    ground = rng.uniform(-12.5, 12.5, (sets, n, 2))
    flat = ground * (27.4, -27.4) / (1 + ground @ (1e-3, 2e-3))[..., None]
    return ground, rng.normal(np.array([959.5, 539.5]) + flat, 1)


def system(ground: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and k of the source's equations."""
    (x, y), (u, v) = ground.T, image.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    upper = np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], 1)
    lower = np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], 1)
    return np.concatenate([upper, lower]), np.concatenate([u, v])


def poses(n: int) -> Callable[[], object]:
    """Frames that stand alone, each laid on the ground with all checks of its landmarks."""
    batch = scenes(Case(landmarks=n), FRAMES)
    frames = [(flight_of(batch.axes[s], batch.place[s]), marks_of(batch, s)) for s in range(FRAMES)]
    solver = load_solver("onboard")

    def run() -> None:
        registrar = Georeferencer(CAMERA, settings_for("pose"), solver)
        for number, (flight, marks) in enumerate(frames, 1):
            registrar.update(number, number / 10, flight, marks)

    return run


def measured(rounds: int) -> dict[str, dict[str, float]]:
    """Seconds a thing: median, quartiles, processor's."""
    todo = tasks()
    wall: dict[str, list[float]] = {name: [] for name in todo}
    processor: dict[str, list[float]] = {name: [] for name in todo}
    for turn in range(-1, rounds):
        for name, (call, often, things) in todo.items():
            for _ in range(often):
                begin, spent = time.perf_counter(), time.process_time()
                call()
                spent, took = time.process_time() - spent, time.perf_counter() - begin
                if turn >= 0:  # the first turn warms caches
                    wall[name].append(took / things)
                    processor[name].append(spent / things)
    return {
        name: {
            "median_s": float(np.median(held)),
            "quarter_s": float(np.quantile(held, 0.25)),
            "three_quarters_s": float(np.quantile(held, 0.75)),
            "processor_s": float(np.median(processor[name])),
        }
        for name, held in wall.items()
    }


def table(figures: dict[str, dict[str, float]], machine: str) -> str:
    """In Markdown."""
    rows = [machine, "", "| | median | quartiles | processor |", "| --- | ---: | ---: | ---: |"]
    for name, held in figures.items():
        scale, unit = next(
            (s, u) for s, u in ((1, "s"), (1e3, "ms"), (1e6, "µs")) if held["median_s"] * s >= 0.2 or s == 1e6
        )
        median, low, high, processor = (scale * value for value in held.values())
        each = " (a set)" if f"{SETS} sets" in name else " (a frame)" if "pose" in name else ""
        rows.append(f"| {name}{each} | {median:.3g} {unit} | {low:.3g}–{high:.3g} | {processor:.3g} |")
    return "\n".join(rows)


def main() -> None:
    """Measure, print a table, write it and JSON where wanted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--write", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    figures = measured(options.rounds)
    machine = (
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}; "
        f"ONNX Runtime {onnxruntime.__version__} on one thread, NumPy {np.__version__}, OpenCV {cv2.__version__}:"
    )
    made = table(figures, machine)
    print(made)
    if options.write:
        report.put(options.write, "geo speed", made)
    if options.json:
        content = {"machine": machine, "load": os.getloadavg(), "seconds": figures}
        options.json.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
