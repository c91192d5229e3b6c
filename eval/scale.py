"""Find the size of people below which the settings for tiny people are better: `python eval/scale.py [DATA]`.

The data are simulated flights at several heights, with crowds, with single walkers and cars, and without movers; and
thermal pictures of DATA (clips with telemetry.csv and truth.json), in full and in reduced size. Heights and thermal
clips are left out in turn. Their limit is the best on all others, with equal weights of simulated and thermal rows. A
box finds a simulated target if it shares 0.3 of the smaller of the two and is not much larger, and a thermal target at
an IoU of 0.25.
"""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import bench
import cv2
import numpy as np
import tracklets
from bench import Spread
from simulated_clips import Case, walking

from torchvision_dddas.config import load_config, with_parameters
from torchvision_dddas.control import fit_settings
from torchvision_dddas.detection import MotionDetector, with_logged_focal
from torchvision_dddas.detection.person_scale import person_px
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.lab.evaluation.metrics import boxes as box_metrics
from torchvision_dddas.lab.evaluation.metrics.crowds import COVERING, LARGEST, MARGIN_PX
from torchvision_dddas.lab.simulation import Scenario, SimulatorSource
from torchvision_dddas.types import Flight, Scene, Telemetry

WAYS: dict[str, Case] = {
    "usual": {"gates.tiny_px": 0.0},
    "tiny, blobs alone": {"gates.tiny_px": 1000.0, "tracklets.on": False},
    "tiny": {"gates.tiny_px": 1000.0},
    "default": {},
}
"""Settings for larger people, for tiny people without and with tracklets, and of the default."""
LIMITS_PX = (0.0, 2.0, 3.0, 4.5, 6.0, 7.0, 8.0, 10.0, 12.0, 1000.0)
VIEWS = tuple(product((30.0, 50.0, 75.0, 100.0, 150.0, 200.0), (90.0, 45.0)))
"""Height in m and pitch in degrees of each flight."""
SCENES = ("crowds", "singles", "still")
REDUCED = (1.0, 1.5, 2.0, 3.0)
RATE_HZ = 7.5
"""Rate of the thermal clips, by their clip.json."""
SKIPPED = 3
"""Unscored frames at the start, where windows look in one direction only."""


def measure_scale(options: bench.Options) -> tuple[str, Any]:
    """Measure F1 by the size of people for each way, and choose the limit with heights and clips left out."""
    cases: list[Case] = [
        {"altitude_m": altitude, "pitch_deg": pitch, "seed": seed, "seconds": options.seconds, "scene": scene}
        for (altitude, pitch), scene, seed in product(VIEWS, SCENES, range(options.seeds))
    ]
    flown = bench.run_cases(cases, fly, options.jobs, options.cache)
    rows: list[tuple[str, str, float, dict[str, list[float]]]] = []  # group left out, name, px, F1 and boxes by way
    for altitude, pitch in VIEWS:
        here = [
            (c, r) for c, r in zip(cases, flown, strict=True) if (c["altitude_m"], c["pitch_deg"]) == (altitude, pitch)
        ]
        found = {}
        for way in WAYS:
            f1 = [Spread(r[way][0] for c, r in here if c["scene"] == scene).mean for scene in SCENES[:2]]
            found[way] = [*f1, Spread(r[way][1] for c, r in here if c["scene"] == "still").mean]
        rows.append((f"{altitude:g} m", f"{altitude:g} m, {pitch:g}°", here[0][1]["px"], found))
    thermal: list[tuple[str, str, float, dict[str, list[float]]]] = []
    if options.data is not None:
        places = sorted(p.parent for p in options.data.glob("*/telemetry.csv") if (p.parent / "truth.json").is_file())
        for place, reduced in product(places, REDUCED):
            result = bench.run_cases([{"place": str(place), "reduced": reduced}], look, 1, options.cache)[0]
            thermal.append((place.name, f"{place.name} / {reduced:g}", result["px"], {w: result[w] for w in WAYS}))
    head = ["people px", "flight", *(f"{way}: crowds / singles / boxes where nothing moves" for way in WAYS)]
    text = bench.format_table(head, _cells(rows), words=2)
    if thermal:
        text += "\n\n" + bench.format_table(
            ["people px", "clip", *(f"{w}: F1 / false" for w in WAYS)], _cells(thermal), 2
        )
    kinds = [rows, thermal] if thermal else [rows]
    chosen = {of: _best(kinds, of) for of in dict.fromkeys(row[0] for kind in kinds for row in kind)}
    left = [[of, f"{limit:g}", f"{_mean(kinds, limit, of):.2f}"] for of, limit in chosen.items()]
    text += "\n\n" + bench.format_table(["left out", "limit chosen on the others, px", "its F1"], left, words=2)
    mean = [[f"{limit:g}", *(f"{_mean([kind], limit):.3f}" for kind in kinds)] for limit in LIMITS_PX]
    text += "\n\n" + bench.format_table(["limit px", *("simulated", "thermal")[: len(kinds)]], mean)
    return f"{text}\n\n{options.seeds} seeds, flights of {options.seconds:g} s.", {"flown": flown, "thermal": thermal}


def _cells(rows: Sequence[tuple[str, str, float, dict[str, list[float]]]]) -> list[list[str]]:
    ordered = sorted(rows, key=lambda row: row[2])
    return [
        [f"{px:.1f}", name, *(" / ".join(f"{v:.2f}" for v in found[way]) for way in WAYS)]
        for _, name, px, found in ordered
    ]


def _mean(kinds: Sequence[Any], limit_px: float, only: str = "", but: str = "") -> float:
    """Return mean F1 with a limit over a group of rows, or all other groups. Kinds have equal weights."""
    means = []
    for rows in kinds:
        values = [
            np.mean(found["tiny" if px < limit_px else "usual"][:-1])
            for of, _, px, found in rows
            if (not only or of == only) and of != but
        ]
        means.append(float(np.mean(values)) if values else np.nan)
    return float(np.nanmean(means)) if np.isfinite(means).any() else np.nan


def _best(kinds: Sequence[Any], left_out: str) -> float:
    return max(LIMITS_PX, key=lambda limit: _mean(kinds, limit, but=left_out))


# -- simulated flights -----------------------------------------------------------------------------------------------


def fly(case: Case) -> Case:
    """Return F1 and boxes per frame of each way, and the size of people."""
    cv2.setNumThreads(1)
    source = flight_over(case)
    frames, truths, found = list(source), source.truths(), {}
    for way, changed in WAYS.items():
        settings = with_parameters(fit_settings(load_config(), source), changed)
        scenes = detect(frames, settings, source.rate_hz, source.telemetry())
        pairs = [(s.detections.box_px, box_metrics.boxes_of(t.mask, 4)) for s, t in zip(scenes, truths, strict=True)]
        hit, boxes, true = np.sum([covered(*pair) for pair in pairs[SKIPPED:]], axis=0)
        found[way] = [2 * hit / max(boxes + true, 1), boxes / (len(pairs) - SKIPPED)]
    view = Flight(case["altitude_m"], pitch_rad=float(np.radians(case["pitch_deg"])))
    return {"px": person_px(view, float(source.camera.focal_px[0])), **found}


def flight_over(case: Case) -> SimulatorSource:
    """Return a flight with exact instruments over two crowds, over walkers and cars, or over trees and buildings."""
    altitude, pitch, seconds, seed = (case[name] for name in ("altitude_m", "pitch_deg", "seconds", "seed"))
    uav = {"altitude_m": altitude, "pitch_deg": pitch, "speed_m_s": 3.0, "start_m": (-15.0, 0.0)}
    uav |= {"way_m": ((15.0, 0.0),), "place_error95_m": 0.0, "angle_error_deg": 0.0, "heading_error_deg": 0.0}
    tables: dict[str, dict[str, object]] = {"uav": uav | {"altitude_error": 0.0}, "team": {"ugvs": 0}}
    tables["clip"] = {"seconds": seconds, "located_by": "telemetry"}
    if case["scene"] == "crowds":
        return SimulatorSource(walking(seed, seconds, **tables))
    content: dict[str, Any] = {"seed": seed, **tables}
    if case["scene"] == "still":
        return SimulatorSource(Scenario.model_validate(content | {"world": {"buildings": 6, "trees_per_ha": 12.0}}))
    rng, reach = np.random.default_rng([seed, 9]), 0.4 * altitude / np.sin(np.radians(pitch))
    walkers = [
        {
            "people": 1,
            "start_m": (float(rng.uniform(-reach, reach)), float(0.75 * rng.uniform(-reach, reach))),
            "radius_m": 0.0,
            "speed_m_s": float(rng.uniform(0.8, 2.2)),
            "heading_deg": float(rng.uniform(0, 360)),
        }
        for _ in range(8)
    ]
    cars = [
        {"start_m": (float(-rng.uniform(0, reach)), float(side * rng.uniform(0.3, 0.6) * reach)), "speed_m_s": 5.0}
        for side in (1, -1)
    ]
    return SimulatorSource(Scenario.model_validate(content | {"crowd": tuple(walkers), "car": tuple(cars)}))


def detect(frames: Sequence[Any], settings: Any, rate_hz: float, telemetry: Telemetry) -> list[Scene]:
    """Return one scene per frame."""
    detector = MotionDetector(settings, backend="onboard", rate_hz=rate_hz, telemetry=telemetry)
    return [scene for frame in frames for scene in detector.update(frame)] + detector.flush()


def covered(found: np.ndarray, true: np.ndarray) -> tuple[int, int, int]:
    """Return the numbers of true boxes that are covered by a box of their own, of boxes, and of true boxes."""
    common, _ = box_metrics.areas(true[:, None], found[None])
    area, other = true[:, 2:].prod(axis=1), found[:, 2:].prod(axis=1)
    share = common / np.minimum(area[:, None], other)
    share[other > LARGEST * (true[:, 2:] + 2 * MARGIN_PX).prod(axis=1)[:, None] / 2] = 0
    hits = 0
    for row in range(len(true)):
        if len(found) and share[row].max() >= COVERING:
            hits += 1
            share[:, share[row].argmax()] = 0
    return hits, len(found), len(true)


# -- thermal pictures ------------------------------------------------------------------------------------------------


def look(case: Case) -> Case:
    """Return F1 and false boxes per picture of each way, and the size of people."""
    cv2.setNumThreads(1)
    place, reduced = Path(case["place"]), case["reduced"]
    telemetry = read_telemetry(place / "telemetry.csv")
    pictures = [frame.image for frame in open_source(place / "frames")]
    pictures = [cv2.resize(p, None, fx=1 / reduced, fy=1 / reduced, interpolation=cv2.INTER_AREA) for p in pictures]
    _, true, unsure, _ = tracklets.read_truth(place, 1, pictures)
    flight, size, found = telemetry.at(0.0), pictures[0].shape[1::-1], {}
    assert flight is not None
    for way, changed in WAYS.items():
        settings, _ = with_logged_focal(with_parameters(load_config(), changed), telemetry, size)
        scenes = detect(pictures, settings, RATE_HZ, telemetry)
        counts = np.zeros(3, int)
        for scene, movers, others in zip(scenes, true, unsure, strict=True):
            box = scene.detections.box_px * reduced
            near = box_metrics.iou(box, others).max(axis=1, initial=0) >= 0.2
            hit, false, missed = box_metrics.match(box, movers, 0.25)
            alike = box_metrics.iou(box, movers).max(axis=1, initial=0) >= 0.25
            counts += (hit, max(false - int((near & ~alike).sum()), 0), missed)
        hit, false, missed = counts.tolist()
        found[way] = [2 * hit / max(2 * hit + false + missed, 1), false / len(scenes)]
    return {"px": person_px(flight, settings.gates.focal_px), **found}


if __name__ == "__main__":
    options = {"data": None, "--seeds": 2, "--seconds": 3.0, "--jobs": 1, "--cache": None}
    bench.main(__doc__, {"": (measure_scale, options)})
