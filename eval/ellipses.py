"""Test whether error ellipses have their stated coverage, in simulated worlds, over seeds. Needs no data.

python eval/ellipses.py boxes        the errors of located targets from rendered video, by the side of their boxes
python eval/ellipses.py centres DATA the centres of found boxes in real clips, as shares of their sides
python eval/ellipses.py landmarks    landmarks with stated errors that are right, and 3 and 10 times too small
python eval/ellipses.py scales       two landmarks, with a prior on the scale of their stated errors
python eval/ellipses.py heading      the offsets of a log's headings and of its clock, estimated from pictures
python eval/ellipses.py flight       the errors of a log, estimated from known points in single pictures

An error that all frames of a run share is drawn once per run, so coverage in a single run may be 0 % or 100 %. Shares
are means over runs, with 90 % intervals of a bootstrap by run. --cache FILE keeps finished cases.
"""

import json
import re
import subprocess
import sys
import tempfile
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import bench
import cv2
import geo_error
import geo_scene
import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import AerialParameters, load_config
from torchvision_dddas.control import StartedSource
from torchvision_dddas.geo import (
    AerialLocator,
    Look,
    describe_clock_offset,
    estimate_flight_errors,
    find_heading_offset,
    pose_prior,
)
from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.plane_homography import load_solver, locate_pixels
from torchvision_dddas.geo.pose_estimation import find_pose, independent_expectation, project_landmarks
from torchvision_dddas.geometry import axes_of, ground_with_slopes, project, turned
from torchvision_dddas.lab.evaluation.metrics.boxes import iou
from torchvision_dddas.lab.evaluation.metrics.crowds import Crowd, CrowdScorer, FoundTargets, TrueFrame
from torchvision_dddas.lab.simulation import SimulatorSource, load_scenario, scenario_settings
from torchvision_dddas.pipeline import Pipeline, assemble_mission
from torchvision_dddas.types import CameraPose, Fix, Flight, LandmarkObservations, Telemetry

CHI2 = {"68 %": -2 * np.log(0.32), "95 %": -2 * np.log(0.05)}
RESAMPLES = 2000
Case = dict[str, Any]


def share_of(inside: np.ndarray, groups: np.ndarray, seed: int = 0) -> str:
    """Format a share in percent with its 90 % interval by a bootstrap over groups, whose errors share causes."""
    rng, names = np.random.default_rng(seed), np.unique(groups)
    counts = np.array([[inside[groups == name].sum(), (groups == name).sum()] for name in names])
    drawn = counts[rng.integers(0, len(names), (RESAMPLES, len(names)))].sum(axis=1)
    low, high = np.quantile(drawn[:, 0] / drawn[:, 1], (0.05, 0.95))
    return f"{100 * inside.mean():.0f} % [{100 * low:.0f}, {100 * high:.0f}]"


# -- boxes -----------------------------------------------------------------------------------------------------------


class _Watching(CrowdScorer):
    """Records for each located target: people in its box, side of the box in px, error (2,), covariance (2, 2)."""

    def _judge_places(
        self, truth: TrueFrame, targets: FoundTargets, found: list[Crowd], people_in: np.ndarray, covers: np.ndarray
    ) -> None:
        super()._judge_places(truth, targets, found, people_in, covers)
        for row in np.flatnonzero(targets.located & people_in.any(axis=1)):
            off = targets.place_m[row] - truth.place_m[people_in[row]].mean(axis=0)
            side = float(np.sqrt(np.prod(targets.box_px[row, 2:])))
            self.kept.append([int(people_in[row].sum()), side, *off, *targets.covariance_m2[row].ravel()])

    def __init__(self, local: Any) -> None:
        super().__init__(local)
        self.kept: list[list[float]] = []


def fly(case: Case) -> list[list[float]]:
    """Run a shipped scenario as `dddas run sim:NAME` does. Return the records of its located targets."""
    cv2.setNumThreads(1)
    scenario = load_scenario(case["scenario"], (), case["seed"])
    own = scenario_settings(scenario)
    own.setdefault("landmarks.common_sigma_m", scenario.gps.common_m)
    source = SimulatorSource(scenario, case["scenario"])
    started: Any = StartedSource(source)
    ready = assemble_mission(
        started, load_config(None, (), base=own), "onboard", scenario.clip.located_by == "landmarks"
    )
    scorer = _Watching(partial(geometry.east_north, origin_deg=source.origin_deg))
    for result in Pipeline.from_assembly(ready)(started):
        for truth in source.truths():
            scorer.feed(truth)
        scorer.feed(result)
    return scorer.kept


def measure_boxes(options: bench.Options) -> tuple[str, Any]:
    """Measure errors of targets found in rendered video, relative to the side of the box, and the ellipses' coverage.

    Errors in metres are converted to pixels at the box's middle. They contain other errors than the box's.
    """
    cases = [{"scenario": name, "seed": seed} for name in options.scenarios for seed in range(41, 41 + options.seeds)]
    results = bench.run_cases(cases, fly, options.jobs, options.cache)
    rows = []
    for name in (*options.scenarios, "all"):
        mine = [(k, np.array(r)) for k, (c, r) in enumerate(zip(cases, results, strict=True))
                if name in (c["scenario"], "all") and r]  # fmt: skip
        run = np.concatenate([np.full(len(r), k) for k, r in mine])
        kept = np.concatenate([r for _, r in mine])
        off, covariance = kept[:, 2:4], kept[:, 4:].reshape(-1, 2, 2)
        squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)
        axis = np.sqrt(CHI2["95 %"] * np.linalg.eigvalsh(covariance)[:, 1])
        far = np.linalg.norm(off, axis=1)
        shares = [share_of(squares < most, run) for most in CHI2.values()]
        quantiles = [f"{q:.2f}" for q in (np.median(far), np.quantile(far, 0.95), np.median(axis))]
        rows.append([name, len(mine), len(kept), *quantiles, *shares])
    head = ["scenario", "runs", "positions", "median error m", "95 % below m", "median semi-axis m"]
    return bench.format_table([*head, *(f"in {name} ellipses" for name in CHI2)], rows, words=2), results


# -- centres ---------------------------------------------------------------------------------------------------------

CLIPS = (
    *("aerial_hit_60_30", "aerial_hit_60_70", "aerial_hit_130_50", "aerial_car14_a", "aerial_group1_a"),
    *("aerial_MountainBike6", "uav123_person12"),
)


def measure_centres(options: bench.Options) -> tuple[str, Any]:
    """Compare boxes of `dddas detect` with the labelled boxes that they overlap most, at an IoU of 0.1 or more.

    rms: root mean square of the offsets along u and v, in sides of the found box. robust: estimate by the median.
    """
    rows = []
    for clip in CLIPS:
        place = options.data / "moving_camera" / clip
        with tempfile.TemporaryDirectory() as folder:
            command = ["detect", str(place / "frames"), "--out", f"{folder}/found", "--save", "none"]
            program = "import sys; from torchvision_dddas.cli import main; sys.exit(main())"
            subprocess.run([sys.executable, "-c", program, *command], check=True, capture_output=True)
            found = np.loadtxt(f"{folder}/found/detections.txt", delimiter=",", ndmin=2)
        shares = []
        for frame, *box in found[:, [0, 2, 3, 4, 5]].tolist():
            labels = labels_of(place)[int(frame) - 1]
            overlap = iou(np.array([box]), labels)[0] if len(labels) else np.zeros(1)
            if overlap.max() >= 0.1:
                label = labels[overlap.argmax()]
                off = np.array(box[:2]) - label[:2] + (np.array(box[2:]) - label[2:]) / 2
                shares.append(np.linalg.norm(off) / np.sqrt(2 * box[2] * box[3]))
        robust = np.median(shares) / np.sqrt(np.log(2))
        rows.append([clip, len(shares), f"{np.sqrt(np.mean(np.square(shares))):.2f}", f"{robust:.2f}"])
        bench.log(*rows[-1])
    return bench.format_table(["clip", "boxes", "rms", "robust"], rows), rows


@cache
def labels_of(place: Path) -> list[np.ndarray]:
    """Return the labelled boxes (N, 4) of each frame."""
    if (place / "truth.json").exists():
        frames = json.loads((place / "truth.json").read_text(encoding="utf-8"))
        return [np.reshape([one["box"] for one in frame], (-1, 4)) for frame in frames]
    boxes = np.genfromtxt(place / "boxes_xywh.txt", delimiter=",", ndmin=2)
    return [box[None][np.isfinite(box[None]).all(axis=1)] for box in boxes]


# -- landmarks -------------------------------------------------------------------------------------------------------


def measure_landmarks(options: bench.Options) -> tuple[str, Any]:
    """Simulate pictures from 100 m, receivers with 3.5 m in 95 %, targets in the landmarks' disc (geo_scene.py)."""
    rows, settings, solver = [], geo_error.settings_for("pose"), load_solver("onboard")
    for n in options.landmarks:
        for tilt in (0.0, 45.0):
            case = geo_scene.Case(landmarks=n, tilt_deg=tilt, altitude_m=100.0)
            batch = geo_scene.scenes(case, options.seeds, 20)
            for too_small in (1.0, 3.0, 10.0):
                found = []
                for s, (flight, marks) in enumerate(geo_error.georeferencer_inputs(batch)):
                    stated = replace(marks, sigma_m=marks.sigma_m / too_small)
                    fix = Georeferencer(geo_scene.CAMERA, settings, solver).update(1, 0.0, flight, stated)
                    found.append(locate_pixels(fix, geo_scene.CAMERA, batch.targets_px[s], case.pixel_sigma))
                place, covariance = (np.array(part) for part in zip(*found, strict=True))
                off = (place - batch.true_targets).reshape(-1, 2)
                squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance.reshape(-1, 2, 2)), off)
                scene = np.repeat(np.arange(options.seeds), 20)
                shares = [share_of(squares < most, scene) for most in CHI2.values()]
                median = f"{np.median(np.linalg.norm(off, axis=1)):.2f}"
                rows.append([n, f"{tilt:.0f}°", f"{too_small:g} times too small", median, *shares])
                bench.log(*rows[-1])
    head = ["landmarks", "tilt", "stated errors", "median error m", *(f"in {name} ellipses" for name in CHI2)]
    return bench.format_table(head, rows, words=3), rows


# -- scales ----------------------------------------------------------------------------------------------------------

SCALES = np.array([1, 1.5, 2, 3, 4, 6, 8, 12, 16])
RULES = {"80 % right": (0.8, 1.0), "80 % right, where the picture makes it less": (0.8, 0.8)}
"""Prior probability that errors are as stated (other scales share the rest), and the posterior probability above which
they are taken as stated."""


def locate_by_scale(case: geo_scene.Case, too_small: float, count: int) -> dict[str, np.ndarray]:
    """Return squared errors in sigmas by each rule. Places and covariances are those of the mixture over SCALES."""
    batch, plain = geo_scene.scenes(case, count, 20), geo_error.settings_for("pose").aerial
    squares: dict[str, list[np.ndarray]] = {name: [] for name in RULES}
    for s, (flight, marks) in enumerate(geo_error.georeferencer_inputs(batch)):
        prior, found, log = pose_prior(flight, geo_scene.CAMERA, plain), [], []
        told, slopes = project_landmarks(
            marks, geo_scene.CAMERA, prior.pose, marks.east_north_m, np.ones(len(marks), bool)
        )
        missing, by_pose = marks.image_px.ravel() - told, slopes[:, :7] @ np.linalg.inv(prior.information)
        for scale in SCALES:
            taken = replace(marks, sigma_m=marks.sigma_m / too_small * scale)
            blur = np.diag(np.repeat(marks.pixel_sigma, 2) ** 2)
            blur += (slopes[:, 7:] * np.repeat(taken.sigma_m, 2) ** 2) @ slopes[:, 7:].T + by_pose @ slopes[:, :7].T
            log.append(-(missing @ np.linalg.solve(blur, missing) + np.linalg.slogdet(blur)[1]) / 2)
            pose = find_pose(taken, geo_scene.CAMERA, independent_expectation(prior, taken.sigma_m))
            fix = Fix(1, "pose", pose.pose, pose.covariance[:7, :7])
            found.append(locate_pixels(fix, geo_scene.CAMERA, batch.targets_px[s], case.pixel_sigma))
        places, covariances = (np.array(part) for part in zip(*found, strict=True))
        for name, (right, sure) in RULES.items():
            chance = np.exp(log - np.max(log)) * np.r_[right, np.full(len(SCALES) - 1, (1 - right) / (len(SCALES) - 1))]
            chance = chance / chance.sum() if chance[0] < sure * chance.sum() else np.eye(len(SCALES))[0]
            middle = np.einsum("s,sti->ti", chance, places)
            apart, off = places - middle, middle - batch.true_targets[s]
            spread = np.einsum("s,stij->tij", chance, covariances + apart[..., :, None] * apart[..., None, :])
            squares[name].append(np.einsum("ti,tij,tj->t", off, np.linalg.inv(spread), off))
    return {name: np.concatenate(parts) for name, parts in squares.items()}


def measure_scales(options: bench.Options) -> tuple[str, Any]:
    """Simulate the scenes of `landmarks` with two landmarks."""
    rows = []
    for tilt in (0.0, 45.0):
        for too_small in (1.0, 3.0, 10.0):
            found = locate_by_scale(geo_scene.Case(100.0, 2, tilt_deg=tilt), too_small, options.seeds)
            scene = np.repeat(np.arange(options.seeds), 20)
            shares = [share_of(squares < CHI2["95 %"], scene) for squares in found.values()]
            rows.append([f"{tilt:.0f}°", f"{too_small:g} times too small", *shares])
            bench.log(*rows[-1])
    return bench.format_table(["tilt", "stated errors", *(f"in 95 %: {name}" for name in RULES)], rows, words=2), rows


# -- heading ---------------------------------------------------------------------------------------------------------

SPEED_M_S = 8.0
GRADES = {"exact": 0.0, "consumer": 1.0, "twice": 2.0}
"""Errors of the log relative to the defaults: lasting tilt 1° and height 2 %, receiver 1.43 m over 20 s. A tenth of
each error is new in every sample. Registrations have an error of 0.1 px in every frame."""


def fly_heading(case: Case) -> list[float]:
    """Return error and standard deviation of the estimated heading offset, degrees, and error of the clock offset, s.

    Values without an estimate are NaN. The clock offset, 0.5 to 3 s, is taken from the note.
    """
    rng, camera, grade = np.random.default_rng(case["seed"]), geo_scene.CAMERA, case["grade"]
    time_s, height = np.arange(0, 60, 0.1), case["altitude_m"]
    course = rng.uniform(0, 2 * np.pi) + np.where(case["turns"], 1.5 * np.sin(time_s / rng.uniform(5, 9)), 0.0)
    steps = SPEED_M_S * 0.1 * np.stack([np.sin(course), np.cos(course)], axis=1)
    place, heading = np.cumsum(steps, axis=0), course + rng.normal(0, 0.02, len(time_s)).cumsum() * 0.1
    pitch = np.full(len(time_s), np.radians(case["pitch_deg"]))
    grid = np.array([[0.2, 0.2], [0.8, 0.2], [0.2, 0.8], [0.8, 0.8], [0.5, 0.5], [0.5, 0.2]]) * camera.size_px
    seen = [(0.0, np.full((3, 3), np.nan))]
    poses = [
        CameraPose(np.array([*p, height]), axes_of(h, t, 0.0)) for p, h, t in zip(place, heading, pitch, strict=True)
    ]
    for before, now, when in zip(poses[:-1], poses[1:], time_s[1:], strict=True):
        ground = ground_with_slopes(before, camera, grid)[0]
        pixels = project(np.c_[ground, np.zeros(len(ground))], now, camera) + rng.normal(0, 0.1, grid.shape)
        seen.append((when, cv2.findHomography(grid, pixels)[0]))
    offset = rng.normal(0, np.radians(5.0))
    slow = np.zeros((len(time_s), 2))
    slow[0] = rng.normal(0, 1.43, 2)
    for k in range(1, len(slow)):
        slow[k] = np.exp(-0.1 / 20) * slow[k - 1] + np.sqrt(1 - np.exp(-0.2 / 20)) * rng.normal(0, 1.43, 2)
    tilt, taller = np.radians(rng.normal(0, 1, 2)), rng.normal(0, 0.02)
    white = rng.normal(0, 0.1, (6, len(time_s)))
    angle = np.radians(1) * white[:3] * grade
    telemetry = Telemetry(
        time_s, height * np.exp(grade * (taller + 0.02 * white[3])), np.full(len(time_s), SPEED_M_S),
        place + grade * (slow + 1.43 * white[4:].T), False, heading_rad=heading - offset + angle[0],
        pitch_rad=pitch + grade * tilt[0] + angle[1], roll_rad=grade * tilt[1] + angle[2],
    )  # fmt: skip
    found = find_heading_offset(AerialLocator(camera, telemetry), seen)
    # A roll about a camera axis that points down changes the heading too.
    true = offset - grade * tilt[1] * np.sin(pitch[0])
    late_s = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 3.0)
    note = describe_clock_offset(AerialLocator(camera, replace(telemetry, time_s=time_s - late_s)), seen)
    told = re.search(r"clock_offset_s=(-?[\d.]+)", note)
    errors = [np.nan, np.nan] if found is None else np.degrees([found[0] - true, found[1]]).tolist()
    return [*errors, float(told[1]) - late_s if told else np.nan]


def measure_heading(options: bench.Options) -> tuple[str, Any]:
    """Simulate flights of 60 s at SPEED_M_S and 10 pictures per second. Offsets are drawn with a sigma of 5°."""
    rows = []
    for turns in (True,) if options.turning else (True, False):
        for pitch in options.pitches:
            for altitude in options.altitudes:
                for name, grade in GRADES.items():
                    case = {
                        "turns": turns,
                        "pitch_deg": pitch,
                        "altitude_m": altitude,
                        "grade": grade,
                        "speed_m_s": 8.0,
                    }
                    cases = [{**case, "seed": seed} for seed in range(options.seeds)]
                    found = bench.run_cases(cases, fly_heading, options.jobs, options.cache)
                    error, sigma, clock_s = np.array(found, float).T
                    known = np.isfinite(error)
                    cells = [f"{np.sqrt((error[known] ** 2).mean()):.2f}", f"{np.median(sigma[known]):.2f}"]
                    inside = np.abs(error[known]) < 1.96 * sigma[known]
                    way = "turns" if turns else "straight"
                    cells.append(f"{100 * inside.mean():.0f} %")
                    cells += [f"{np.isfinite(clock_s).sum()} of {len(clock_s)}", f"{np.nanmax(np.abs(clock_s)):.3f}"]
                    rows.append([way, f"{pitch:.0f}°", f"{altitude:.0f}", name, *cells])
                    bench.log(*rows[-1])
    head = ["flight", "pitch", "AGL m", "errors of the log", "heading, rms error °", "sigma °", "within 1.96 sigma"]
    return bench.format_table([*head, "clock told", "largest error s"], rows, words=1), rows


# -- flight ----------------------------------------------------------------------------------------------------------

TRUE = {"aerial.heading_offset_deg": 4.0, "aerial.pitch_offset_deg": 1.0, "aerial.heading_sigma_deg": 1.5,
        "aerial.tilt_sigma_deg": 0.5, "aerial.position_sigma_m": 0.8, "aerial.altitude_sigma": 0.01}  # fmt: skip
"""Errors of the simulated logs: 90 % of the variance lasts for 20 s, and 10 % is new in each picture."""
FLIGHTS = {
    "all ways, three heights": {},
    "5 % of the points wrong": {"wrong": 0.05},
    "headings off by 40°": {"offset_deg": 40.0},
    "pictures every 3 s, not 60 s": {"interval_s": 3.0},
    "one way, one height": {"one_way": True},
}


def look_at_points(case: Case) -> list[Look]:
    """Simulate pictures of 1 to 4 known points (0.1 m) from 30 to 120 m with a pitch of 30° to 90°."""
    rng, camera, looks = np.random.default_rng(case["seed"]), geo_scene.CAMERA, []
    offset_deg = case.get("offset_deg", TRUE["aerial.heading_offset_deg"])
    interval_s, slow = case.get("interval_s", 60.0), rng.normal(0, 1, 6)
    keeps = np.exp(-interval_s / AerialParameters().correlation_s)
    for k in range(case["pictures"]):
        one_way = case.get("one_way", False)
        heading = 0.3 if one_way else rng.uniform(0, 2 * np.pi)
        pitch = np.radians(50 if one_way else rng.choice([30, 50, 70, 90]))
        height = 60.0 if one_way else rng.choice([30, 60, 120])
        told = CameraPose(np.array([*rng.uniform(-20, 20, 2), height]), axes_of(heading, pitch, 0.0))
        slow = keeps * slow + np.sqrt(1 - keeps**2) * rng.normal(0, 1, 6)
        error = np.sqrt(0.9) * slow + np.sqrt(0.1) * rng.normal(0, 1, 6)
        sigma_deg = [TRUE[f"aerial.{name}_sigma_deg"] for name in ("tilt", "tilt", "heading")]
        turn = np.radians(error[:3] * sigma_deg - [0, 0, offset_deg])
        sigma_m = [TRUE["aerial.position_sigma_m"]] * 2 + [TRUE["aerial.altitude_sigma"] * height]
        lower = axes_of(heading, pitch + np.radians(TRUE["aerial.pitch_offset_deg"]), 0.0)
        pose = CameraPose(told.place_m + error[3:] * sigma_m, turned(turn) @ lower)
        n = rng.integers(1, 5)
        pixels = rng.uniform(0.1, 0.9, (n, 2)) * camera.size_px
        places = ground_with_slopes(pose, camera, pixels)[0] + rng.normal(0, 0.1, (n, 2))
        wrong = rng.random(n) < case.get("wrong", 0.0)
        places[wrong] += rng.uniform(-30, 30, (wrong.sum(), 2))
        n_of = np.full(n, 0.1), np.ones(n), np.zeros(n)
        marks = LandmarkObservations(np.arange(n), pixels + rng.normal(0, 1, (n, 2)), places, *n_of)
        flight = Flight(height, place=tuple(told.place_m[:2]), heading_rad=heading, pitch_rad=pitch, roll_rad=0.0)
        looks.append(Look(k + 1, interval_s * k, pose_prior(flight, camera, AerialParameters()), marks))
    return looks


def measure_flights(options: bench.Options) -> tuple[str, Any]:
    """Compare the output of `dddas calibrate-flight` with the true errors: median and 90 % range over flights."""
    rows = []
    for flight, what in FLIGHTS.items():
        for pictures in options.pictures:
            cases = [{**what, "pictures": pictures, "seed": seed} for seed in range(options.seeds)]
            found = [
                estimate_flight_errors(look_at_points(case), geo_scene.CAMERA, AerialParameters()) for case in cases
            ]
            values, cells = [one.settings(AerialParameters()) for one in found], []
            for name in TRUE:
                known = [value[name] for value in values if name in value]
                low, middle, high = np.quantile(known, [0.05, 0.5, 0.95]) if known else [np.nan] * 3
                share = "" if len(known) == len(found) else f", {len(known)} of {len(found)}"
                cells.append(f"{middle:.3g} [{low:.3g}, {high:.3g}]{share}" if known else "kept")
            true = what.get("offset_deg", TRUE["aerial.heading_offset_deg"])
            within = np.mean(
                [abs(np.degrees(one.offset[0]) - true) < 1.96 * np.degrees(one.offset_sigma[0]) for one in found]
            )
            rows.append([flight, pictures, *cells, f"{100 * within:.0f} %"])
            bench.log(*rows[-1])
    head = ["flight", "pictures", *(f"{name.removeprefix('aerial.')} ({true:g})" for name, true in TRUE.items())]
    return bench.format_table([*head, "offset within 1.96 sigma"], rows, words=1), rows


if __name__ == "__main__":
    bench.main(
        __doc__,
        {
            "boxes": (
                measure_boxes,
                {
                    "--scenarios": ["joining", "crossing", "splitting", "movers", "scattering"],
                    "--seeds": 3,
                    "--jobs": 1,
                    "--cache": None,
                },
            ),
            "centres": (measure_centres, {"data": Path}),
            "landmarks": (measure_landmarks, {"--landmarks": [2, 4, 6, 8], "--seeds": 100}),
            "scales": (measure_scales, {"--seeds": 60}),
            "flight": (measure_flights, {"--pictures": [8, 20, 40], "--seeds": 40}),
            "heading": (
                measure_heading,
                {
                    "--seeds": 8,
                    "--pitches": [90.0, 60.0, 30.0],
                    "--altitudes": [50.0, 100.0, 200.0],
                    "--turning": False,
                    "--jobs": 1,
                    "--cache": None,
                },
            ),
        },
    )
