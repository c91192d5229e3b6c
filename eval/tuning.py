"""Measure the benefit of tuning by gradient, with hard decisions, on data without learning.

python eval/tuning.py recovery           perturbed parameters of motion, on simulated scenes
python eval/tuning.py default            the shipped parameters of the difference beside those before they were tuned
python eval/tuning.py identities DATA    the tracker's parameters, each sequence left out in turn

Gradient descent beside random search or Optuna at equal time: `dddas tune` and `dddas sweep --optuna` on one study.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import bench
import clips
import numpy as np
import torch

from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.lab.evaluation.datasets.kinds import read
from torchvision_dddas.lab.evaluation.datasets.record import Clip, DatasetSource
from torchvision_dddas.lab.evaluation.metrics import pixels as segmentation
from torchvision_dddas.lab.evaluation.metrics.pixels import add_counts
from torchvision_dddas.lab.evaluation.metrics.truth import labels_of
from torchvision_dddas.lab.evaluation.studies.records import Task
from torchvision_dddas.lab.evaluation.studies.stages import open_clip
from torchvision_dddas.lab.tuning.descent import Plan, descend
from torchvision_dddas.lab.tuning.motion import MotionFamily
from torchvision_dddas.lab.tuning.parameters import TUNABLE, Parameters
from torchvision_dddas.lab.tuning.tracking import TrackingFamily

MOTION = ("difference.noise_levels", "difference.gradient_share", "difference.threshold", "difference.peak")
SIZE, FRAMES, FACTOR, WITHIN = (320, 240), 16, 3.0, 0.9
BASE = {"gates.min_area_px": 60, "morphology.close_px": 9}
"""Settings for people about ten pixels tall, as at this size."""
BEFORE = {"difference.threshold": 4.0, "difference.gradient_share": 0.15, "refine.spatial_px": 60.0}


# -- what moves ------------------------------------------------------------------------------------------------------


def measure_recovery(options: bench.Options) -> tuple[str, Any]:
    """Tune parameters that start off by factors of 1/3 to 3, with the masks of one scene.

    The figures are F of pixels of the hard pipeline at the shipped, perturbed and tuned parameters, on that scene and
    on another. A seed has recovered if F on its scene is at least 0.9 of the F of the shipped parameters.
    """
    shipped, rows = with_parameters(load_config(), BASE), []
    for seed in range(options.seeds):
        with tempfile.TemporaryDirectory() as place:
            learned, other = (film_clip(Path(place), 2 * seed + k, SIZE) for k in (0, 1))
            factors = FACTOR ** np.random.default_rng([seed, 7]).uniform(-1, 1, len(MOTION))
            start = scaled(shipped, dict(zip(MOTION, factors.tolist(), strict=True)))
            tuned = start
            for after in (False, True):  # first roughly, then with the hard steps after the hulls
                family, plan = MotionFamily(with_later_steps=after), Plan(options.steps, 4, 0.15, seed, most_watched=4)
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


def measure_default(options: bench.Options) -> tuple[str, Any]:
    """Measure F of the shipped parameters of the difference, beside their values before tuning on real clips."""
    shipped, rows = load_config(), []
    for seed in range(100, 100 + options.seeds):  # other studies do not use these seeds
        with tempfile.TemporaryDirectory() as place:
            clip = film_clip(Path(place), seed, (640, 480))
            rows.append([measure_f(clip, settings) for settings in (with_parameters(shipped, BEFORE), shipped)])
    before, after = np.array(rows).T
    cells = [len(rows), f"{before.mean():.3f}", f"{after.mean():.3f}", bench.format_gain(after - before, 3)]
    head = ["simulated scenes", "F before", "F shipped", "gain, 95 % of draws of the scenes", "scenes in which F rises"]
    return bench.format_table(head, [[*cells, int((after > before).sum())]], words=0), rows


def film_clip(place: Path, seed: int, size: tuple[int, int]) -> Clip:
    """Write a synthetic scene to disk and return it as a clip of a data set."""
    clips.film_into(place / f"scene-{seed}", seed, FRAMES, size)
    (clip,) = read(DatasetSource("folder", place, (f"scene-{seed}",)), place).clips
    return clip


def scaled(settings: Settings, factors: Mapping[str, float]) -> Settings:
    """Return settings with some parameters multiplied by factors, within their ranges."""
    values = {name: TUNABLE[name].rounded(value_of(settings, name) * factor) for name, factor in factors.items()}
    return with_parameters(settings, values)


def value_of(settings: Settings, name: str) -> float:
    """Return the value of a parameter, such as difference.threshold."""
    group, parameter = name.split(".")
    return float(getattr(getattr(settings, group), parameter))


def measure_f(clip: Clip, settings: Settings) -> float:
    """Return F of pixels of the hard pipeline."""
    total = segmentation.Pixels()
    for scene in detect_motion(open_clip(clip), settings, "onboard"):
        total = add_counts(total, segmentation.count(scene.mask, labels_of(clip.truth, scene.frame.number)))
    return float(np.nan_to_num(segmentation.measures(total)["f"]))


# -- identities ------------------------------------------------------------------------------------------------------

TRACKING = tuple(
    f"track.{name}"
    for name in (
        "wander",
        "scatter",
        "size_scatter",
        "tail",
        "upright",
        "crossing",
        "hiding",
        "rest_drift",
        "rest_price",
    )
)


def measure_identities(options: bench.Options) -> tuple[str, Any]:
    """Measure IDF1 of the tracker on each sequence, with parameters tuned by the likelihood of links on all others.

    The tracker gets true boxes without identities, or public detections with --detections, and no pictures.
    """
    task: Task = "tracking" if options.detections else "association"
    found = clips.identified_clips(options.data, ("motchallenge", "cvml", "sdd"))
    found = [replace(c, pictures=()) for c in found if c.given is not None or not options.detections]
    plan = Plan(options.steps, 4, 0.2, look_every=8, pull=0.1)
    family, shipped = TrackingFamily().at(options.interval, task), Settings()
    torch.set_num_threads(1)
    wanted = [clip for clip in found if not options.only or clip.name in options.only]
    examples = {clip.name: family.examples([clip], shipped) for clip in wanted}
    rows = []
    for clip in wanted:
        others = [example for name, mine in examples.items() if name != clip.name for example in mine]
        tuned = descend(family, Parameters(shipped, TRACKING), others, plan).settings
        rows.append([100 * clips.measure_idf1(clip, task, s, options.interval) for s in (shipped, tuned)])
        bench.log(clip.name, np.round(rows[-1], 1), {name: value_of(tuned, name) for name in TRACKING})
    cells = [[clip.name, *(f"{value:.1f}" for value in row)] for clip, row in zip(wanted, rows, strict=True)]
    gains = [after - before for before, after in rows]
    cells.append(["mean gain, and 95 % of draws of the sequences", "", bench.format_gain(gains)])
    return bench.format_table(["sequence", "shipped", "tuned"], cells), rows


if __name__ == "__main__":
    seeds = {"--seeds": 20, "--steps": 40}
    left_out = {"data": Path, "--interval": 5, "--steps": 24, "--only": []}
    studies = {
        "recovery": (measure_recovery, seeds),
        "default": (measure_default, {"--seeds": 20}),
        "identities": (measure_identities, left_out | {"--detections": False}),
    }
    bench.main(__doc__, studies)
