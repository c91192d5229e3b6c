"""Measure the benefit of detection intervals (appendix B, eq. 2) on rendered flights with truth. Needs no data.

python eval/intervals.py fixed     rules beside fixed intervals: accuracy against time, by altitude and speed
python eval/intervals.py search    the constants that choose the processed frames, with flights left out
python eval/intervals.py small     a walker's motion between the frames that show small targets, with flights left out
"""

from collections.abc import Sequence
from itertools import product
from typing import Any

import bench
import cv2
import numpy as np
from accuracy import is_drawn_later, move_later
from bench import Spread
from simulated import fly
from simulated_clips import Case, walking

from torchvision_dddas.config import load_config, with_parameters
from torchvision_dddas.control import fit_settings
from torchvision_dddas.detection import MotionDetector
from torchvision_dddas.lab.evaluation.metrics import boxes as box_metrics
from torchvision_dddas.lab.evaluation.metrics import pixels as pixel_metrics
from torchvision_dddas.lab.evaluation.metrics.pixels import add_counts
from torchvision_dddas.lab.simulation import SimulatorSource
from torchvision_dddas.types import Scene, Truth

FLIGHTS = tuple(product((50.0, 100.0, 200.0), (2.0, 5.0, 10.0)))
"""Altitude in m and speed in m/s of each flight."""
INTERVALS = (1, 2, 3, 5, 8)
LOOP: Case = {"steering.follow": False, "steering.look": False}
"""The closed loop chooses the frames. The vehicles fly as planned."""
LOOKED: dict[str, Case] = {
    "closed loop": LOOP,
    **{str(every): {"steering.on": False, "interval.rule": False, "every": every} for every in INTERVALS},
}
COMPARED: dict[str, Case] = {
    "by the rule": {"interval.rule": True},
    **{str(frames): {"interval.rule": False, "interval.frames": frames} for frames in INTERVALS},
}
MEASURED = {"default": ("F1 of boxes", "box_f1")}
"""Measure of a configuration, else F of pixels. The default finds crowds, for which boxes are a better measure."""


def measure_fixed(options: bench.Options) -> tuple[str, Any]:
    """Measure accuracy against processor time by detection interval: rules beside fixed intervals.

    First table: only every N-th frame is processed. The figures are the error of each crowd's known place at each
    moment (10 m for unknown crowds) and processor time per second of clip. The closed loop chooses the frames. Vehicles
    fly as planned with exact instruments, so that errors come from detection and the time between looks. Other tables:
    every frame is processed, and the interval is the distance of compared frames. The figures include processor ms per
    frame. Masks that show the movers of a later frame are scored at that frame.
    """
    studies = {"looked": [[way] for way in LOOKED], **{config: [list(COMPARED)] for config in options.configs}}
    cases = [
        {"study": study, "ways": ways, "altitude_m": a, "speed_m_s": s, "seed": seed, "seconds": options.seconds}
        for study, parts in studies.items()
        for a, s in FLIGHTS
        for seed in range(options.seeds)
        for ways in parts
    ]
    results = bench.run_cases(cases, fly_case, options.jobs, options.cache)
    tables = []
    for study in studies:
        ways, digits, what = LOOKED, 2, "known to within m / s a s"
        if study != "looked":
            later = " at t + Δt" if is_drawn_later(_config(study)) else ""
            ways, digits, what = COMPARED, 0, f"`{study}`: {_measured(study)[0]}{later} / ms"
        rows = []
        for of in (*FLIGHTS, None):
            here = [
                result
                for case, result in zip(cases, results, strict=True)
                if case["study"] == study and of in (None, (case["altitude_m"], case["speed_m_s"]))
            ]
            cells = []
            for way in ways:
                a, b = (Spread(result[way][k] for result in here if way in result) for k in (0, 1))
                cells.append(f"{a.text(spread=False)} / {b.text(digits, spread=False)}")
            rows.append(["all" if of is None else _name(of), *cells])
        tables.append(bench.format_table([what, *ways], rows))
    return "\n\n".join([*tables, f"Flights of {options.seconds:g} s, {options.seeds} a row."]), results


def fly_case(case: Case) -> Case:
    """Return {way to choose the interval: [accuracy, time]} on a flight to and fro over two crowds."""
    source = flight(case["altitude_m"], case["speed_m_s"], case["seed"], case["seconds"])
    if case["study"] == "looked":
        (way,) = case["ways"]
        run = fly(source, LOOKED[way])
        return {way: [run["score"]["knowledge_m"], run["cpu"]]}
    return detect_in_ways(source, case["study"], {way: COMPARED[way] for way in case["ways"]})


def detect_in_ways(source: SimulatorSource, config: str, ways: dict[str, Case]) -> Case:
    """Return {way: [accuracy, ms per frame]} of a configuration with each way's settings on every frame."""
    cv2.setNumThreads(1)
    frames, truths, found = list(source), source.truths(), {}
    for way, changed in ways.items():
        settings = with_parameters(fit_settings(_config(config), source), changed)
        detector = MotionDetector(settings, backend="onboard", rate_hz=source.rate_hz, telemetry=source.telemetry())
        start = bench.now()[1]
        scenes = [scene for frame in frames for scene in detector.update(frame)] + detector.flush()
        spent_ms = 1e3 * float(bench.now()[1] - start) / len(frames)
        found[way] = [score_scenes(scenes, truths, is_drawn_later(settings))[_measured(config)[1]], spent_ms]
    return found


def flight(altitude_m: float, speed_m_s: float, seed: int, seconds: float, rate_hz: float = 10.0) -> SimulatorSource:
    """Return a flight to and fro over two crowds, with exact instruments and without ground vehicles."""
    uav = {"altitude_m": altitude_m, "speed_m_s": speed_m_s, "start_m": (-15.0, 0.0), "way_m": ((15.0, 0.0),)}
    uav |= {"place_error95_m": 0.0, "angle_error_deg": 0.0, "heading_error_deg": 0.0, "altitude_error": 0.0}
    clip = {"seconds": seconds, "located_by": "telemetry", "rate_hz": rate_hz}
    return SimulatorSource(walking(seed, seconds, uav=uav, team={"ugvs": 0}, clip=clip))


def score_scenes(scenes: Sequence[Scene], truths: Sequence[Truth], is_later: bool) -> dict[str, float]:
    """Return measures of masks and F1 of boxes at an IoU of 0.5. is_later: masks show movers of a later frame."""
    found = dict(enumerate((scene.mask, scene.detections.box_px) for scene in scenes))
    pixels, boxes = pixel_metrics.Pixels(), box_metrics.BoxCounts()
    for at, (mask, box_px) in (move_later(scenes) if is_later else found).items():
        pixels = add_counts(pixels, pixel_metrics.count(mask, truths[at].mask))
        boxes = add_counts(boxes, box_metrics.match(box_px, box_metrics.boxes_of(truths[at].mask)))
    return {**pixel_metrics.measures(pixels), "box_f1": box_metrics.measures(boxes)["f1"]}


def _config(name: str) -> Any:
    return load_config(None if name == "default" else name)


def _measured(config: str) -> tuple[str, str]:
    return MEASURED.get(config, ("F of pixels", "f"))


def _name(of: tuple[float, float]) -> str:
    return "{:g} m, {:g} m/s".format(*of)


# -- the constants that choose the frames ----------------------------------------------------------------------------

GRID: dict[str, Sequence[float]] = {
    "steering.least_move_px": (1.5, 3.0, 4.0, 6.0),
    "steering.maximum_every": (5, 8),
    "steering.sampling_share": (0.5, 1.0),
}
SAME_M = 0.02
"""Settings whose errors differ by less are equally good. The fastest of them is chosen."""
SEARCH_SEED = 100
"""The flights of the search differ from those of `fixed`."""


def measure_search(options: bench.Options) -> tuple[str, Any]:
    """Measure the error of the known places of crowds by the constants that choose the processed frames.

    Left out: the constants for a flight are the best on all other flights, and the fastest of equally good ones.
    """
    points = list(product(*GRID.values()))
    cases = [
        {"point": point, "altitude_m": a, "speed_m_s": s, "seed": SEARCH_SEED + seed, "seconds": options.seconds}
        for a, s in FLIGHTS
        for seed in range(options.seeds)
        for point in points
    ]
    results = bench.run_cases(cases, fly_point, options.jobs, options.cache)
    shape = (len(FLIGHTS), options.seeds, len(points), 2)
    figures = np.array(results, float).reshape(shape).mean(axis=1)  # (flight, point, error and time)

    def best(error_time: np.ndarray) -> int:
        as_good = error_time[:, 0] < error_time[:, 0].min() + SAME_M
        return int(np.where(as_good, error_time[:, 1], np.inf).argmin())

    head = [name.partition(".")[2] for name in GRID]
    mean = figures.mean(axis=0)
    rows = [[*(f"{v:g}" for v in points[k]), *(f"{v:.2f}" for v in mean[k])] for k in np.argsort(mean[:, 0])]
    text = bench.format_table([*head, "known to within m", "s a s"], rows)
    left, out = [], []
    for k, of in enumerate(FLIGHTS):
        at = best(np.delete(figures, k, axis=0).mean(axis=0))
        out.append(figures[k, at])
        left.append([_name(of), *(f"{v:g}" for v in points[at]), *(f"{v:.2f}" for v in out[-1])])
    left.append(["all", *("" for _ in GRID), *(f"{v:.2f}" for v in np.mean(out, axis=0))])
    text += "\n\n" + bench.format_table(["left out", *head, "known to within m", "s a s"], left)
    chosen = ", ".join(f"{n} {v:g}" for n, v in zip(head, points[best(mean)], strict=True))
    end = f"Chosen on all: {chosen}. Flights of {options.seconds:g} s, {options.seeds} a point."
    return f"{text}\n\n{end}", figures.tolist()


def fly_point(case: Case) -> list[float]:
    """Return the error and time of a flight."""
    source = flight(case["altitude_m"], case["speed_m_s"], case["seed"], case["seconds"])
    run = fly(source, {**LOOP, **dict(zip(GRID, case["point"], strict=True))})
    return [run["score"]["knowledge_m"], run["cpu"]]


# -- how far apart the frames are that show small targets ------------------------------------------------------------

MOVES_PX = (0.0, 0.7, 1.0, 1.4, 2.0, 3.0)
"""Values of `small.gap_move_px`; 0: always `small.gap_frames`."""
RATES_HZ = (10.0, 25.0)
"""Pictures per second. At a higher rate, the same motion takes more frames."""


def measure_small(options: bench.Options) -> tuple[str, Any]:
    """Measure accuracy by `small.gap_move_px`, a walker's motion between the frames that show small targets.

    Every frame is processed. Figures are the mean F1 of boxes in the default. Left out: the value for the flights of an
    altitude and rate is the best on all other flights.
    """
    scenes = list(product(RATES_HZ, sorted({a for a, _ in FLIGHTS})))
    cases = [
        {"rate_hz": rate, "altitude_m": a, "speed_m_s": s, "seed": SEARCH_SEED + seed, "seconds": options.seconds}
        for rate, a in scenes
        for s in sorted({s for _, s in FLIGHTS})
        for seed in range(options.seeds)
    ]
    results = bench.run_cases(cases, fly_small, options.jobs, options.cache)
    figures = np.array(results, float).reshape(len(scenes), -1, len(MOVES_PX), len(MEASURED)).mean(axis=1)
    rows, out = [], []
    for (rate, a), found, k in zip(scenes, figures, range(len(scenes)), strict=True):
        chosen = int(np.delete(figures, k, axis=0).mean(axis=(0, 2)).argmax())
        out.append(found[chosen])
        cells = [" / ".join(f"{v:.2f}" for v in found[m]) for m in (*range(len(MOVES_PX)), chosen)]
        rows.append([f"{rate:g} Hz, {a:g} m", *cells, f"{MOVES_PX[chosen]:g}"])
    mean = figures.mean(axis=0)
    cells = [" / ".join(f"{v:.2f}" for v in of) for of in (*mean, np.mean(out, axis=0))]
    rows.append(["all", *cells, f"{MOVES_PX[int(mean.mean(axis=1).argmax())]:g}"])
    head = ["default", *(f"{move:g} px" for move in MOVES_PX), "left out", "chosen, px"]
    end = f"Flights of {options.seconds:g} s, {len(cases) // len(scenes)} a row."
    return f"{bench.format_table(head, rows)}\n\n{end}", figures.tolist()


def fly_small(case: Case) -> list[list[float]]:
    """Return the accuracy of the default on a flight for each value of `small.gap_move_px`."""
    arguments = [case[name] for name in ("altitude_m", "speed_m_s", "seed", "seconds", "rate_hz")]
    ways = {f"{move}": {"small.gap_move_px": move} for move in MOVES_PX}
    found = [detect_in_ways(flight(*arguments), config, ways) for config in MEASURED]
    return [[of[way][0] for of in found] for way in ways]


if __name__ == "__main__":
    common = {"--seconds": 5.0, "--jobs": 1, "--cache": None}
    studies = {
        "fixed": (measure_fixed, {"--seeds": 3, "--configs": ["default", "fast", "source"], **common}),
        "search": (measure_search, {"--seeds": 2, **common}),
        "small": (measure_small, {"--seeds": 2, **common, "--seconds": 3.8}),
    }
    bench.main(__doc__, studies)
