"""What tuning by gradient is worth, by hard decisions on data that nothing was learned from.

python eval/tuning.py recovery           perturbed parameters of motion, on simulated scenes
python eval/tuning.py registration       tolerances that are three times too wide or narrow
python eval/tuning.py default            the shipped parameters of the difference beside those before they were tuned
python eval/tuning.py folds STUDY.toml   each clip with masks left out in turn
python eval/tuning.py identities DATA    the tracker's parameters, each sequence left out in turn
python eval/tuning.py affinities DATA    the source's association, the same
python eval/tuning.py colours            ranges of landmarks' colours from labelled pictures, simulated
python eval/tuning.py ellipses           coverage of 95 % ellipses once noise levels were tuned, simulated

Gradient descent beside random search or Optuna at equal time: `dddas tune` and `dddas sweep --search` on one study.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import bench
import clips
import cv2
import geo_error
import numpy as np
import torch
from geo_scene import CAMERA, Case, scenes
from robustness import corner_distance

from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.detection import detect_motion, load_engine
from torchvision_dddas.evaluation.datasets import folder
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics import pixels as segmentation
from torchvision_dddas.evaluation.metrics.truth import labels_of
from torchvision_dddas.evaluation.studies.runner import plan_study, run_study
from torchvision_dddas.evaluation.studies.spec import Task, read_spec
from torchvision_dddas.evaluation.studies.stages import open_clip
from torchvision_dddas.evaluation.studies.summary import measures
from torchvision_dddas.geo.colour_calibration import build_ranges, find_samples, hue_difference, pool_samples, to_hsv
from torchvision_dddas.geo.colours import OpenCVColourFinder
from torchvision_dddas.geo.georeferencer import Georeferencer
from torchvision_dddas.geo.plane_solvers import load_solver
from torchvision_dddas.simulation import CarPlan, CrowdPlan, Fault, Scenario, Shot, Simulator
from torchvision_dddas.simulation.ground_vehicles import marker_plates
from torchvision_dddas.tuning.aerial_examples import Seen, kept, look_at
from torchvision_dddas.tuning.colours import fit_colours
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.tuning.motion import Masks
from torchvision_dddas.tuning.parameters import TUNABLE, Parameters, chosen
from torchvision_dddas.tuning.places import family as places_family
from torchvision_dddas.tuning.registration import family as registration_family
from torchvision_dddas.tuning.source_association import Affinities
from torchvision_dddas.tuning.tracking import Identities
from torchvision_dddas.types import Colours

MOTION = ("difference.noise_levels", "difference.gradient_share", "difference.threshold", "difference.peak")
SIZE, FRAMES, FACTOR, WITHIN = (320, 240), 16, 3.0, 0.9
BASE = {"gates.min_area_px": 60, "morphology.close_px": 9}
"""People are some ten pixels tall at this size."""
TOLERANCES = ("registration.ransac_px", "registration.forward_backward_px")
BEFORE = {"difference.threshold": 4.0, "difference.gradient_share": 0.15, "refine.spatial_px": 60.0}


# -- what moves ------------------------------------------------------------------------------------------------------


def measure_recovery(options: bench.Options) -> tuple[str, Any]:
    """Parameters that start off by factors of 1/3 to 3 and learn from the masks of one scene.

    F of pixels of the hard pipeline at the shipped, perturbed and tuned parameters, on that scene and on another. A
    seed has recovered where F on its scene is at least 0.9 of that of the shipped parameters.
    """
    shipped, rows = with_parameters(load_config(), BASE), []
    for seed in range(options.seeds):
        with tempfile.TemporaryDirectory() as place:
            learned, other = (film_clip(Path(place), 2 * seed + k, SIZE) for k in (0, 1))
            factors = FACTOR ** np.random.default_rng([seed, 7]).uniform(-1, 1, len(MOTION))
            start = scaled(shipped, dict(zip(MOTION, factors.tolist(), strict=True)))
            tuned = start
            for after in (False, True):  # first far from what is right, then with the hard steps after the hulls
                family, plan = Masks(after=after), Plan(options.steps, 4, 0.15, seed, most_watched=4)
                tuned = descend(family, Parameters(tuned, MOTION), family.examples([learned], tuned), plan).settings
            rows.append([measure_f(clip, s) for clip in (learned, other) for s in (shipped, start, tuned)])
        bench.log(seed, np.round(rows[-1], 3))
    table = np.array(rows)
    parts = {"learned from": table[:, :3], "not learned from": table[:, 3:]}
    cells = [
        [name, *(f"{value:.3f}" for value in part.mean(axis=0)), f"{(part[:, 2] / part[:, 0]).min():.2f}"]
        for name, part in parts.items()
    ]
    text = bench.format_table(["scene", "shipped", "perturbed", "tuned", "least, tuned / shipped"], cells)
    recovered = int((table[:, 2] >= WITHIN * table[:, 0]).sum())
    return f"{text}\n\nRecovered: {recovered} of {options.seeds} seeds.", rows


def measure_registration(options: bench.Options) -> tuple[str, Any]:
    """Tolerances of the registration that start at three times and a third of the shipped values.

    They learn from masks; the true homographies are used for judging only: mean distance over the corners, px.
    """
    shipped, cells, found = with_parameters(load_config(), BASE), [], {}
    for name, factor in (("three times", 3.0), ("a third", 1 / 3)):
        rows = []
        for seed in range(options.seeds):
            with tempfile.TemporaryDirectory() as place:
                numbers = 2 * seed, 2 * seed + 1
                pair = [film_clip(Path(place), number, SIZE) for number in numbers]
                start, family = scaled(shipped, dict.fromkeys(TOLERANCES, factor)), registration_family()
                plan = Plan(options.steps, 4, 0.15, seed, most_watched=4)
                tuned = descend(family, Parameters(start, TOLERANCES), family.examples(pair[:1], start), plan).settings
                rows.append(
                    [
                        [(corner_error(clip, number, s), measure_f(clip, s)) for s in (shipped, start, tuned)]
                        for clip, number in zip(pair, numbers, strict=True)
                    ]
                )
            bench.log(name, seed, np.round(rows[-1], 3).tolist())
        found[name] = table = np.array(rows)  # seed, scene, setting, measure
        for k, scene in enumerate(("learned from", "not learned from")):
            px, share = np.moveaxis(table[:, k].mean(axis=0), -1, 0)
            nearer = f"{int((table[:, k, 2, 0] < table[:, k, 0, 0]).sum())} of {len(rows)}"
            cells.append([name, scene, *(f"{v:.3f}" for v in (*px, *share)), nearer])
    head = ["begins at", "scene", "corners, px: shipped", "start", "tuned", "F: shipped", "start", "tuned"]
    return bench.format_table([*head, "nearer than shipped"], cells, words=2), found


def corner_error(clip: Clip, seed: int, settings: Settings) -> float:
    """Mean error of the registrations over the corners, px."""
    maps = [view.image_from_ground for view in clips.flight(seed, FRAMES, SIZE, clips.RATE_HZ)]
    true = [later @ np.linalg.inv(earlier) for earlier, later in pairwise(maps)]
    engine = load_engine("onboard", settings)
    views = [engine.prepare(frame.image) for frame in open_clip(clip)]
    ours = [engine.register([pair])[0].later_from_earlier for pair in pairwise(views)]
    return float(np.mean([corner_distance(a, b, *SIZE) for a, b in zip(ours, true, strict=True)]))


def measure_default(options: bench.Options) -> tuple[str, Any]:
    """F of the shipped parameters of the difference beside those before they were tuned on real clips."""
    shipped, rows = load_config(), []
    for seed in range(100, 100 + options.seeds):  # far from the seeds of other studies
        with tempfile.TemporaryDirectory() as place:
            clip = film_clip(Path(place), seed, (640, 480))
            rows.append([measure_f(clip, settings) for settings in (with_parameters(shipped, BEFORE), shipped)])
    before, after = np.array(rows).T
    cells = [len(rows), f"{before.mean():.3f}", f"{after.mean():.3f}", bench.format_gain(after - before, 3)]
    head = ["simulated scenes", "F before", "F shipped", "gain, 95 % of draws of the scenes", "scenes in which F rises"]
    return bench.format_table(head, [[*cells, int((after > before).sum())]], words=0), rows


def film_clip(place: Path, seed: int, size: tuple[int, int]) -> Clip:
    """A synthetic scene on disk, as a clip of a data set."""
    clips.film_into(place / f"scene-{seed}", seed, FRAMES, size)
    (clip,) = folder.read(place, {}, lambda name: name == f"scene-{seed}").clips
    return clip


def scaled(settings: Settings, factors: Mapping[str, float]) -> Settings:
    """Parameters multiplied by factors, within their ranges."""
    values = {name: TUNABLE[name].rounded(value_of(settings, name) * factor) for name, factor in factors.items()}
    return with_parameters(settings, values)


def value_of(settings: Settings, name: str) -> float:
    """The value of a parameter, such as difference.threshold."""
    group, parameter = name.split(".")
    return float(getattr(getattr(settings, group), parameter))


def measure_f(clip: Clip, settings: Settings) -> float:
    """F of pixels of the hard pipeline."""
    total = segmentation.Pixels()
    for scene in detect_motion(open_clip(clip), settings, "onboard"):
        total = total.plus(segmentation.count(scene.mask, labels_of(clip.truth, scene.frame.number)))
    return float(np.nan_to_num(segmentation.measures(total)["f"]))


def measure_folds(options: bench.Options) -> tuple[str, Any]:
    """F of each clip with masks: as it was, tuned on the others, tuned on all.

    Clips in which nothing moves are learned from in every fold. Of a clip about --frames labelled frames are learned
    from; every labelled frame is judged.
    """
    torch.set_num_threads(1)
    spec = replace(read_spec(options.data), overrides=tuple(options.set), tasks=("motion",))
    spec = replace(spec, config=options.config) if options.config else spec
    base, settings, names = options.data.parent, load_config(spec.config, spec.overrides), chosen(options.parameters)

    def measure(values: Mapping[str, float]) -> dict[str, float]:
        changed = tuple(f"{name}={value}" for name, value in values.items())
        cases = run_study(replace(spec, overrides=(*spec.overrides, *changed)), base, options.jobs).cases
        scored = {case.clip.name: measures([case.scored]) for case in cases if case.scored is not None}
        return {name: float(found["pixels"]["f"]) for name, found in scored.items() if "pixels" in found}

    every = {job.clip.name: job.clip for job in plan_study(spec, base, []).jobs}
    learned = {name: Masks().examples([thin(clip, options.frames)], settings) for name, clip in every.items()}
    before, after = measure({}), {}
    for held in [*before, None]:
        examples = [example for name, mine in learned.items() if name != held for example in mine]
        plan = Plan(options.steps, 8, options.rate, watched=0.0)
        tuned = descend(Masks(), Parameters(settings, names), examples, plan).settings
        values = {name: value_of(tuned, name) for name in names}
        after[held] = measure(values)
        bench.log(held, values)
    rows = [[name, f"{before[name]:.3f}", f"{after[name][name]:.3f}", f"{after[None][name]:.3f}"] for name in before]
    means = [list(before.values()), [after[name][name] for name in before], list(after[None].values())]
    rows.append(["mean", *(f"{np.mean(part):.3f}" for part in means)])
    return bench.format_table(["clip", "as it was", "tuned on the others", "tuned on all"], rows), rows


def thin(clip: Clip, frames: int) -> Clip:
    """The clip with about so many of its labelled frames."""
    if clip.truth is None or len(clip.truth.masks) <= frames:
        return clip
    numbers = sorted(clip.truth.masks)[:: len(clip.truth.masks) // frames]
    return replace(clip, truth=replace(clip.truth, masks={number: clip.truth.masks[number] for number in numbers}))


# -- identities ------------------------------------------------------------------------------------------------------

TRACKING = tuple(
    f"track.{name}"
    for name in (
        "speed",
        "agility",
        "tail",
        "upright",
        "rest_drift",
        "rest_price",
        "missed",
        "births",
        "border",
        "left",
    )
)
PAPER = tuple(f"paper.{name}" for name in ("threshold", "lowest_dispersion", "location_cut", "appearance_cut"))


def measure_identities(options: bench.Options) -> tuple[str, Any]:
    """IDF1 of the tracker on each sequence, with parameters tuned by the likelihood of true links on all others.

    On true boxes without identities, or with --detections on public ones; without pictures.
    """
    task: Task = "tracking" if options.detections else "association"
    found = clips.identified_clips(options.data, ("motchallenge", "cvml", "sdd"))
    found = [replace(c, pictures=()) for c in found if c.given is not None or not options.detections]
    plan = Plan(options.steps, 4, 0.2, look_every=8, pull=0.1)
    return leave_out(options, Identities().at(options.interval, task), Settings(), TRACKING, found, task, plan)


def measure_affinities(options: bench.Options) -> tuple[str, Any]:
    """IDF1 of the source's association (two frames at once) with thresholds and cuts tuned on other sequences."""
    shipped = with_parameters(load_config("paper"), {"paper.window": 2, "paper.rule": "dispersion"})
    found = clips.identified_clips(options.data, ("motchallenge", "cvml"))
    plan = Plan(options.steps, 8, 0.4, look_every=5, most_watched=16)
    return leave_out(options, Affinities(interval=options.interval), shipped, PAPER, found, "association", plan)


def leave_out(
    options: bench.Options, family: Any, shipped: Settings, names: Sequence[str], found: Sequence[Clip], task: Task,
    plan: Plan,
) -> tuple[str, Any]:  # fmt: skip
    """IDF1 of each clip with the shipped parameters and with those tuned on all others."""
    torch.set_num_threads(1)
    wanted = [clip for clip in found if not options.only or clip.name in options.only]
    examples = {clip.name: family.examples([clip], shipped) for clip in wanted}
    rows = []
    for clip in wanted:
        others = [example for name, mine in examples.items() if name != clip.name for example in mine]
        tuned = descend(family, Parameters(shipped, names), others, plan).settings
        rows.append([100 * clips.measure_idf1(clip, task, s, options.interval) for s in (shipped, tuned)])
        bench.log(clip.name, np.round(rows[-1], 1), {name: value_of(tuned, name) for name in names})
    cells = [[clip.name, *(f"{value:.1f}" for value in row)] for clip, row in zip(wanted, rows, strict=True)]
    gains = [after - before for before, after in rows]
    cells.append(["mean gain, and 95 % of draws of the sequences", "", bench.format_gain(gains)])
    return bench.format_table(["sequence", "shipped", "tuned"], cells), rows


# -- colours ---------------------------------------------------------------------------------------------------------

TEAM, SUNS_DEG = 4, (12.0, 35.0, 75.0)
CHANGED = 20
"""A pixel belongs to a plate where covering the plate changes the picture by more than so many grey levels."""


@dataclass(frozen=True)
class Labelled:
    """image: (H, W, 3) uint8 BGR. labels: (H, W), 0, or which plate, from 1."""

    image: np.ndarray
    labels: np.ndarray


def measure_colours(options: bench.Options) -> tuple[str, Any]:
    """Share of landmarks' pixels found, false pixels a picture and colour, and F of all pixels, by ranges of colours.

    Scenes seen from 30 m, of four vehicles with plates, in the light of a low, a middle and a high sun. Ranges come
    from `dddas colours` (without labels), from tuning on labelled pictures, and from the simulator (the true paint).
    """
    rows: dict[str, list[Any]] = {}
    names, _, own = marker_plates(TEAM)
    for repeat in range(options.repeats):
        learned, other = (
            [one for k, sun in enumerate(SUNS_DEG) for one in film_plates(100 * repeat + 10 * part + k, sun)]
            for part in (0, 1)
        )
        pictures, labels = [one.image for one in learned], [one.labels for one in learned]
        ways = {"tuned": fit_colours(pictures, labels, names, options.steps), "the simulator's own": own}
        if (unlabelled := find_unlabelled(pictures, own)) is not None:
            ways = {"as `dddas colours` does": unlabelled} | ways
        for name, colours in ways.items():
            rows.setdefault(name, []).append([judge_colours(colours, part) for part in (learned, other)])
            bench.log(repeat, name, np.round(rows[name][-1], 3).tolist())
    cells = []
    for name, found in rows.items():
        for k, part in enumerate(("learned from", "not learned from")):
            share, false, f = np.array(found)[:, k].mean(axis=0)
            least = np.array(found)[:, k, 2].min()
            cells.append([name, part, f"{100 * share:.1f} %", f"{false:.1f}", f"{f:.3f}", f"{least:.3f}"])
    return bench.format_table(["ranges", "scenes", "found", "false pixels", "F", "least F"], cells, words=2), rows


def find_unlabelled(pictures: Sequence[np.ndarray], own: Colours) -> Colours | None:
    """What `dddas colours --count 4` finds, in the order of the team; None where a colour does not stand out."""
    hsv, least = [to_hsv(picture) for picture in pictures], load_config().landmarks.least_area_px
    groups = pool_samples([find_samples(one, least, k) for k, one in enumerate(hsv)], TEAM)
    middle = own.low[:, 0] + 7
    order = [min(range(len(groups)), key=lambda k: abs(hue_difference(groups[k][0].hue, hue))) for hue in middle]
    if len(set(order)) < TEAM:
        return None
    low, high, _ = build_ranges([groups[k] for k in order], hsv, least)
    return Colours(own.names, low, high)


def judge_colours(colours: Colours, pictures: Sequence[Labelled]) -> tuple[float, float, float]:
    """Share of the plates' pixels found, false pixels a picture and colour, F; over all pictures and colours."""
    hit = found = true = 0
    for one in pictures:
        masks = OpenCVColourFinder().masks(one.image, colours.low, colours.high) > 0
        right = np.stack([one.labels == k + 1 for k in range(TEAM)])
        hit, found, true = hit + int((masks & right).sum()), found + int(masks.sum()), true + int(right.sum())
    return hit / max(true, 1), (found - hit) / (TEAM * len(pictures)), 2 * hit / max(found + true, 1)


def film_plates(seed: int, sun_deg: float) -> list[Labelled]:
    """A few pictures of a scene; the same scene with covered plates tells which pixels are plates."""
    found = []
    for a, b in zip(*(shoot_plates(seed, sun_deg, covered) for covered in (False, True)), strict=True):
        image = a.frame.image
        changed = np.abs(image.astype(int) - b.frame.image).max(axis=2) > CHANGED
        labels = np.zeros(changed.shape, np.int64)
        for k, number in enumerate(a.truth.bodies.target[a.truth.bodies.kind == "ugv"].tolist(), 1):
            labels[changed & (a.truth.mask == number)] = k
        coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 75])[1]
        found.append(Labelled(cv2.imdecode(coded, cv2.IMREAD_COLOR), labels))
    return found


def shoot_plates(seed: int, sun_deg: float, covered: bool) -> list[Shot]:
    """The scene's pictures, without compression."""
    faults = [Fault(what="landmark_hidden", vehicle=k + 1, time_s=0.0, seconds=1e3) for k in range(TEAM)]
    tables = {
        "world": {"side_m": 120.0, "buildings": 0, "sun_height_deg": sun_deg},
        "team": {"ugvs": TEAM, "ring_m": 10.0},
        "uav": {"altitude_m": 30.0},
        "camera": {"width_px": 480, "height_px": 360, "drift": 0.2, "quality": 100},
        "clip": {"seconds": 4.0, "rate_hz": 1.0},
        "crowd": (CrowdPlan(people=8), CrowdPlan(people=6, start_m=(5.0, 6.0))),
        "car": (CarPlan(start_m=(-6.0, -6.0), speed_m_s=2.0), CarPlan(start_m=(8.0, -4.0), speed_m_s=1.0)),
        "fault": tuple(faults) if covered else (),
    }
    return list(iter(Simulator(Scenario.model_validate({"seed": seed, **tables})).next, None))


# -- ellipses --------------------------------------------------------------------------------------------------------

NOISE = (
    *(f"aerial.{name}" for name in ("tilt_sigma_deg", "heading_sigma_deg", "altitude_sigma", "position_sigma_m")),
    "aerial.focal_sigma", "aerial.target_sigma_px", "landmarks.sigma_m", "landmarks.pixel_sigma",
)  # fmt: skip


def measure_ellipses(options: bench.Options) -> tuple[str, Any]:
    """Share of places within 95 % ellipses before and after noise levels were tuned on other scenes.

    Each noise parameter begins off by a factor of up to 3. They are tuned on one half of the scenes by the negative
    log-likelihood of the places, in two turns of fits, and judged on the other half by the hard georeferencer.
    """
    torch.set_num_threads(1)
    rows = []
    for seed in range(options.seeds):
        kinds = list(product((50.0, 200.0), (4, 6), ("ring", "disc"), (0.0, 45.0)))
        inputs = []
        for k, (height, n, layout, tilt) in enumerate(kinds):
            case = Case(altitude_m=height, landmarks=n, layout=layout, tilt_deg=tilt)
            batch = scenes(case, -(-options.scenes // len(kinds)), 8, 1000 * seed + k)
            pairs = geo_error.georeferencer_inputs(batch)
            inputs += [(*pair, batch.targets_px[s], batch.true_targets[s]) for s, pair in enumerate(pairs)]
        learned, held = inputs[::2], inputs[1::2]
        factors = np.exp(np.random.default_rng([seed, 77]).uniform(-np.log(3), np.log(3), len(NOISE)))
        start = tuned = scaled(Settings(), dict(zip(NOISE, factors.tolist(), strict=True)))
        for turn in range(2):
            plan = Plan(options.steps, 256, 0.1 / (1 + 2 * turn), seed, look_every=10, patience=1000, most_watched=1000)
            tuned = descend(places_family(), Parameters(tuned, NOISE), place_examples(learned, tuned), plan).settings
        rows.append([judge_places(held, settings) for settings in (start, tuned, Settings())])
        bench.log(seed, rows[-1])
    cells = [[k, *(f"{100 * inside:.1f} %, {error:.3f} m" for inside, error in row)] for k, row in enumerate(rows)]
    within = sum(0.94 <= row[1][0] <= 0.96 for row in rows)
    head = ["seed", "before: inside, mean error", "after", "true noise"]
    return f"{bench.format_table(head, cells)}\n\nWithin 94 to 96 %: {within} of {len(rows)} seeds.", rows


def as_settings_say(one: Any, settings: Settings) -> Any:
    """Telemetry and landmarks with the standard deviations of the settings."""
    flight, landmarks, targets_px, true_m = one
    n = len(landmarks)
    sigma_m, sigma_px = np.full(n, settings.landmarks.sigma_m), np.full(n, settings.landmarks.pixel_sigma)
    marks = replace(landmarks, sigma_m=sigma_m, pixel_sigma=sigma_px)
    return replace(flight, hfov_rad=float(np.radians(70.0))), marks, targets_px, true_m


def place_examples(inputs: Sequence[Any], settings: Settings) -> list[Example]:
    """What is learned from, in random order."""
    found = []
    for k in np.random.default_rng(0).permutation(len(inputs)).tolist():
        flight, marks, targets_px, true_m = as_settings_say(inputs[k], settings)
        own = np.ones(len(marks), bool)
        fit = kept(Seen(look_at(CAMERA, flight, marks, targets_px, true_m, settings, own), settings))
        if fit is not None:
            found.append(Example("scenes", len(found), fit))
    return found


def judge_places(inputs: Sequence[Any], settings: Settings) -> tuple[float, float]:
    """Share of places within their ellipses, and mean error in metres; frame by frame."""
    settings, far, inside = with_parameters(settings, {"aerial.correlation_s": 0.0}), [], []
    for one in inputs:
        flight, marks, targets_px, true_m = as_settings_say(one, settings)
        fix = Georeferencer(CAMERA, settings, load_solver("onboard")).update(1, 0.0, flight, marks)
        off, held = geo_error.judge(fix, targets_px, true_m, settings.aerial.target_sigma_px)
        far.append(np.linalg.norm(off, axis=1))
        inside.append(held)
    return float(np.nanmean(inside)), float(np.nanmean(far))


if __name__ == "__main__":
    seeds = {"--seeds": 20, "--steps": 40}
    left_out = {"data": Path, "--interval": 5, "--steps": 24, "--only": []}
    folds = {"data": Path, "--parameters": ["difference.threshold", "difference.gradient_share"], "--config": None}
    folds |= {"--set": [], "--frames": 12, "--steps": 30, "--rate": 0.05, "--jobs": 1}
    studies = {
        "recovery": (measure_recovery, seeds),
        "registration": (measure_registration, seeds | {"--seeds": 8}),
        "default": (measure_default, {"--seeds": 20}),
        "folds": (measure_folds, folds),
        "identities": (measure_identities, left_out | {"--detections": False}),
        "affinities": (measure_affinities, left_out),
        "colours": (measure_colours, {"--repeats": 4, "--steps": 120}),
        "ellipses": (measure_ellipses, {"--seeds": 10, "--scenes": 6000, "--steps": 120}),
    }
    bench.main(__doc__, studies)
