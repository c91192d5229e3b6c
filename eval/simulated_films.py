"""Studies on the simulator's films as files, in the form that `dddas run CLIP --telemetry LOG` reads. Need no data.

python eval/simulated_films.py identities   number of identities of five movers, by pitch and seed
python eval/simulated_films.py boxes        precision and recall of the default in the village and in thermal pictures
python eval/simulated_films.py write OUT    clips with frames/ and truth.json for `eval/tracklets.py learn`

--cache FILE keeps finished cases.
"""

import csv
import json
import math
import shutil
import tempfile
from collections import defaultdict
from itertools import product
from pathlib import Path
from typing import Any

import bench
import numpy as np
from bench import Spread

from torchvision_dddas.config import load_config
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.lab.evaluation.metrics.boxes import iou
from torchvision_dddas.lab.evaluation.metrics.matching import match, pair
from torchvision_dddas.lab.evaluation.metrics.tracking import count_identity, identity_measures
from torchvision_dddas.lab.evaluation.metrics.truth import TrackTable
from torchvision_dddas.lab.simulation import Scenario, load_scenario, record_scenario
from torchvision_dddas.pipeline import AerialInput, Pipeline, assemble_files

LEAST = 0.25
"""Least IoU of a right box. People are about 15 px high, and their shadows are as large as the people."""
HIDDEN_SHARE = 0.5
"""A box with a smaller share of the target's usual area shows a part of the target and does not count."""

DRY = ["world.shore_m=0", "uav.size_m=0"]
"""Overrides for the village without water and without the UAV's shadow."""

Case = dict[str, Any]
Clip = list[list[Case]]
"""Boxes of each frame: box (x, y, width, height), cls, state (moving, still or unsure), id."""


def film(case: Case, folder: Path) -> tuple[Scenario, Clip]:
    """Film a scenario into a folder. Return the scenario and its truth."""
    changed = [f"uav.{name}={case[name]}" for name in ("pitch_deg", "altitude_m") if case.get(name)]
    scenario = load_scenario(case["scenario"], changed + (DRY if case.get("is_dry") else []), case["seed"])
    record = record_scenario(folder, scenario, ("frames",), case.get("frames"), case["scenario"])
    with (folder / "truth" / "positions.csv").open(newline="", encoding="utf-8") as file:
        kinds = {int(row["target"]): row["kind"] for row in csv.DictReader(file)}
    rows = np.loadtxt(folder / "truth" / "gt.txt", delimiter=",", ndmin=2)
    usual = {number: np.median(np.prod(rows[rows[:, 1] == number, 4:6], axis=1)) for number in np.unique(rows[:, 1])}
    clip: Clip = [[] for _ in range(record.frames)]
    for frame, number, *box, moves in rows[:, :7].tolist():
        is_whole = box[2] * box[3] >= HIDDEN_SHARE * usual[number]
        state = "still" if not moves else "moving" if is_whole else "unsure"
        clip[int(frame) - 1].append({"box": box, "cls": kinds[int(number)], "state": state, "id": int(number)})
    pictures = [path.read_bytes() for path in sorted((folder / "frames").iterdir())]
    for k in range(1, len(clip)):
        if pictures[k] == pictures[k - 1]:  # a repeated picture shows the last frame's truth
            clip[k] = clip[k - 1]
    return scenario, clip


def run(folder: Path, scenario: Scenario) -> list[Any]:
    """Return the tracked frames of a film by `dddas run` with the log and the default configuration."""
    source = open_source(folder / "frames", rate_hz=scenario.clip.rate_hz)
    log = folder / "telemetry.csv"
    given = AerialInput(None, log, folder / "camera.toml", None, None, None)
    assembly = assemble_files(given, log, load_config(None), source, "onboard", str(folder))
    return [result.tracked for result in Pipeline.from_assembly(assembly, pictures=False)(source)]


# -- identities ------------------------------------------------------------------------------------------------------


def measure_identities(options: bench.Options) -> tuple[str, Any]:
    """Measure the identities of five movers past a parked car, filmed from 40 m, and IDF1 at an IoU of 0.25."""
    cases = _cases("movers", options)
    results = bench.run_cases(cases, count_identities, options.jobs, options.cache)
    rows = []
    for pitch in options.pitches:
        of = [found for case, found in zip(cases, results, strict=True) if case["pitch_deg"] == pitch]
        rows.append([f"{pitch:g}°", ", ".join(str(one["identities"]) for one in of), _mean(of, "idf1")])
    rows.append(["all", Spread([one["identities"] for one in results]).text(1), _mean(results, "idf1")])
    text = bench.format_table(["pitch", "identities by seed", "IDF1"], rows)
    return f"{text}\n\nFive movers; seeds 1 to {options.seeds}.", dict(zip(map(str, cases), results, strict=True))


def count_identities(case: Case) -> Case:
    """Return the number of identities in a film's tracks, and IDF1."""
    with tempfile.TemporaryDirectory() as out:
        scenario, clip = film(case, Path(out))
        tracked = run(Path(out), scenario)
    # A moving target counts as soon as one pixel is visible.
    truth = [(k, r["id"], r["box"]) for k, boxes in enumerate(clip, 1) for r in boxes if r["state"] != "still"]
    found = [
        (one.number, number, box)
        for one in tracked
        for number, box in zip(one.tracks.identity.tolist(), one.tracks.box_px.tolist(), strict=True)
    ]
    counts = count_identity(pair(_table(truth), _table(found)), LEAST)
    return {"identities": len({number for _, number, _ in found}), **identity_measures(counts)}


def _table(rows: list[tuple[int, int, list[float]]]) -> TrackTable:
    frame, identity = (np.array([row[k] for row in rows], np.int64) for k in (0, 1))
    return TrackTable(frame, identity, np.array([row[2] for row in rows], float).reshape(-1, 4))


# -- boxes -----------------------------------------------------------------------------------------------------------


def measure_boxes(options: bench.Options) -> tuple[str, Any]:
    """Measure precision and recall of detections at an IoU of 0.25. Boxes on mostly hidden targets do not count."""
    village = _cases("village", options)
    cases = [*village, *(case | {"is_dry": True} for case in village), *_cases("thermal", options)[: options.seeds]]
    results = bench.run_cases(cases, count_boxes, options.jobs, options.cache)
    groups: dict[str, list[Case]] = defaultdict(list)
    for case, found in zip(cases, results, strict=True):
        how = f"{case['pitch_deg']:g}°" if case["scenario"] == "village" else "2 looks a second"
        groups[f"{case['scenario']}, {how}{', without water' * case.get('is_dry', False)}"].append(found)
    names = ["precision", "recall", "recall of cars", "recall of people", "false a picture"]
    rows = [[name, *(_mean(found, key) for key in names)] for name, found in groups.items()]
    text = bench.format_table(["film", *names], rows)
    return f"{text}\n\nSeeds 1 to {options.seeds}: mean.", dict(zip(map(str, cases), results, strict=True))


def count_boxes(case: Case) -> Case:
    """Return the counts for precision and recall in a film."""
    with tempfile.TemporaryDirectory() as out:
        scenario, clip = film({**case, "pitch_deg": case["pitch_deg"] * (case["scenario"] == "village")}, Path(out))
        tracked = run(Path(out), scenario)
    hits, true, false = defaultdict[str, int](int), defaultdict[str, int](int), 0
    for one in tracked:
        moving = [row for row in clip[one.number - 1] if row["state"] == "moving"]
        unsure = _boxes([row["box"] for row in clip[one.number - 1] if row["state"] == "unsure"])
        found = one.detections.box_px
        i, j = match(iou(_boxes([row["box"] for row in moving]), found), LEAST)
        for row in moving:
            true[row["cls"]] += 1
        for k in i.tolist():
            hits[moving[k]["cls"]] += 1
        others = np.delete(found, j, axis=0)
        false += int((iou(others, unsure).max(axis=1, initial=0) < LEAST / 2).sum())
    right = sum(hits.values())
    return {
        "precision": right / max(right + false, 1),
        "recall": right / max(sum(true.values()), 1),
        "recall of cars": hits["car"] / true["car"] if true["car"] else math.nan,
        "recall of people": hits["person"] / true["person"] if true["person"] else math.nan,
        "false a picture": false / max(len(tracked), 1),
    }


# -- clips to learn from ---------------------------------------------------------------------------------------------


def write_clips(options: bench.Options) -> tuple[str, Any]:
    """Write films as clips with frames/, truth.json, telemetry.csv and clip.json."""
    cases = [
        {**case, "altitude_m": altitude, "frames": options.frames}
        for name, altitude in product(options.scenarios, options.altitudes)
        for case in _cases(name, options)
    ]
    for case in cases:
        name = f"simulated_{case['scenario']}_{case['altitude_m']:g}_{case['pitch_deg']:g}_{case['seed']}"
        out = options.out / name
        with tempfile.TemporaryDirectory() as made:
            scenario, clip = film(case, Path(made))
            out.mkdir(parents=True, exist_ok=True)
            shutil.rmtree(out / "frames", ignore_errors=True)
            shutil.move(Path(made) / "frames", out / "frames")
            shutil.copy(Path(made) / "telemetry.csv", out)
        (out / "truth.json").write_text(json.dumps(clip), encoding="utf-8")
        note = {"rate": scenario.clip.rate_hz, "altitude": scenario.uav.altitude_m, "pitch": case["pitch_deg"]}
        (out / "clip.json").write_text(json.dumps(note), encoding="utf-8")
        bench.log(out.name)
    return f"{len(cases)} clips", {}


def _cases(scenario: str, options: bench.Options) -> list[Case]:
    seeds = range(1, options.seeds + 1)
    return [{"scenario": scenario, "pitch_deg": pitch, "seed": seed} for pitch in options.pitches for seed in seeds]


def _boxes(rows: list[list[float]]) -> np.ndarray:
    return np.array(rows, float).reshape(-1, 4)


def _mean(results: list[Case], name: str) -> str:
    return Spread([one[name] for one in results]).text(2, spread=False)


if __name__ == "__main__":
    common = {"--seeds": 3, "--jobs": 1, "--cache": None}
    clips: Case = {
        "out": Path,
        "--scenarios": ["movers", "village", "thermal"],
        "--pitches": [60.0, 45.0, 30.0],
        "--altitudes": [40.0],
        "--frames": 50,
        "--seeds": 3,
    }
    studies = {
        "identities": (measure_identities, {"--pitches": [90.0, 45.0, 30.0], **common}),
        "boxes": (measure_boxes, {"--pitches": [60.0, 45.0, 30.0], **common}),
        "write": (write_clips, clips),
    }
    bench.main(__doc__, studies)
