"""What the recognizer's calibration by gradient is worth on pictures not tuned on: `python eval/tune_people.py DATA`.

DATA holds association/PETS09-S2L1, association/TUD-Stadtmitte and people/INRIA-96x160-pos; what is not there is left
out. Each set in turn is held out: threshold, probabilities and shares of the body are tuned on the others, with and
without the crops, and judged on it by the hard recognizer's own boxes and scores, before and after. Crops of INRIA show
one person each, 96 px high, whose width nobody labelled: it is taken for 0.41 of that.

F1 at an IoU of 0.5 over all detections at or above people.threshold; IoU: the mean of boxes that are right. Of the
detections at or above the default threshold, before and after, doubt: mean negative log-likelihood of their being right
by their probability, in nats; off: the mean distance of probabilities from the share that is right, in tenths of the
probability, weighed by how many detections each holds (expected calibration error). An interval of a difference is that
of 95 % over pictures drawn anew. The default values were calibrated on PETS09-S2L1 and TUD-Stadtmitte themselves
(people_miss_rate.py --calibrate), which flatters `before` there.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import report

from torchvision_dddas.config import PeopleParameters, Settings
from torchvision_dddas.evaluation.datasets import inria, motchallenge
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.boxes import iou, judged
from torchvision_dddas.evaluation.studies.stages import open_clip
from torchvision_dddas.people import pyramid
from torchvision_dddas.people.detector import detect_people, load_scorer
from torchvision_dddas.people.suppression import people_from_windows
from torchvision_dddas.tuning import people
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.tuning.parameters import Parameters
from torchvision_dddas.types import People

CROPS = "INRIA crops"
NAMES = tuple(f"people.{name}" for name in people.KNOBS)
MEASURES = ("f1", "precision", "recall", "iou", "doubt", "off")


@dataclass(frozen=True)
class Picture:
    """What the recognizer scores in a picture, once. truth_px: (M, 4)."""

    clip: str
    window_px: np.ndarray
    margin: np.ndarray
    size: tuple[int, int]
    truth_px: np.ndarray

    def people(self, parameters: PeopleParameters) -> People:
        """Those whom these parameters find in it."""
        above = self.margin >= parameters.threshold
        return people_from_windows(self.window_px[above], self.margin[above], self.size, parameters)


def clips(data: Path) -> dict[str, list[Clip]]:
    """The sets that are there."""
    found: dict[str, list[Clip]] = {}
    if (data / "association").is_dir():
        names = ("PETS09-S2L1", "TUD-Stadtmitte")
        read = motchallenge.read(data / "association", {}, lambda name: name in names)
        found |= {clip.name: [clip] for clip in read.clips if clip.pictures}
    crops = data / "people" / "INRIA-96x160-pos"
    if crops.is_dir():
        found[CROPS] = list(inria.read(crops, {}, lambda name: True).clips)
    return found


def scored(group: str, some: Sequence[Clip], most: int) -> tuple[list[Picture], list[Example]]:
    """At most so many pictures of a set, evenly over it; as what is judged and as what is learned from."""
    parameters = Settings().people
    recognizer = load_scorer(parameters, "onboard")
    low = parameters.model_copy(update={"threshold": parameters.threshold - people.BELOW})
    pictures: list[Picture] = []
    examples: list[Example] = []
    for clip in some:
        assert clip.truth is not None
        numbers = sorted(clip.truth.boxes)
        share = max(1, most // len(some))
        wanted = {numbers[i * len(numbers) // share] for i in range(share)} if len(numbers) > share else set(numbers)
        for frame in open_clip(clip):
            if frame.number not in wanted:
                continue
            size = (frame.image.shape[1], frame.image.shape[0])
            parts = pyramid.everywhere(size, parameters)
            (maps,) = recognizer.scores([frame.image], [parts])
            truth_px = np.asarray(clip.truth.boxes[frame.number], float).reshape(-1, 4)
            pictures.append(Picture(group, *pyramid.windows(parts, maps, size, low), size, truth_px))
            held = _Held(maps)
            one = people.scored(frame.image, truth_px, parameters, held)
            examples.append(Example(group, len(examples) + 1, one))
            print(f"\r{group}: {len(pictures)} pictures", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    first = pictures[0]
    for frame in open_clip(some[0]):  # what is held is what the recognizer itself finds
        if frame.number in some[0].truth.boxes:  # type: ignore[union-attr]
            (whole,) = detect_people([frame.image], recognizer, parameters)
            assert np.allclose(whole.box_px, first.people(parameters).box_px), "the kept windows give other people"
        break
    return pictures, examples


@dataclass(frozen=True)
class _Held:
    """A recognizer that has scored its one picture already."""

    maps: Sequence[np.ndarray]
    name: str = "held"

    def scores(self, images: Sequence[np.ndarray], parts: Sequence[Any]) -> list[list[np.ndarray]]:
        """What it has."""
        return [list(self.maps)]


def judge(pictures: Sequence[Picture], parameters: PeopleParameters) -> list[dict[str, np.ndarray]]:
    """Of each picture: right (N,), iou (R,) of those right, people; of the default threshold, sure (M,), score (M,).

    sure: right or not. Probabilities are judged on as many detections before and after.
    """
    found, low = [], parameters.model_copy(update={"threshold": Settings().people.threshold})
    for picture in pictures:
        people, more = picture.people(parameters), picture.people(low)
        right, sure = (judged(some.box_px, some.margin, picture.truth_px) for some in (people, more))
        best = iou(people.box_px, picture.truth_px).max(axis=1, initial=0.0)[right > 0]
        true = np.array([len(picture.truth_px)])
        found.append({"right": right, "iou": best, "people": true, "sure": sure, "score": more.score})
    return found


def figures(found: Sequence[dict[str, np.ndarray]]) -> dict[str, float]:
    """MEASURES of some pictures together."""
    names = ("right", "iou", "people", "sure", "score")
    right, fits, people, sure, score = (np.concatenate([one[name] for one in found]) for name in names)
    hits, told, true = right.sum(), len(right), people.sum()
    safe = score.clip(1e-9, 1 - 1e-9)
    tenth = np.minimum((score * 10).astype(int), 9)
    off = sum(abs((score - sure)[tenth == k].sum()) for k in np.unique(tenth))
    return {
        "f1": 2 * hits / (told + true),
        "precision": hits / max(told, 1),
        "recall": hits / max(true, 1),
        "iou": float(fits.mean()) if len(fits) else float("nan"),
        "doubt": float(-(sure * np.log(safe) + (1 - sure) * np.log(1 - safe)).mean()) if len(sure) else float("nan"),
        "off": off / max(len(sure), 1),
    }


def compared(before: list[dict[str, np.ndarray]], after: list[dict[str, np.ndarray]], draws: int = 500) -> dict:
    """Measures before and after, and the interval of the difference over pictures."""
    rng = np.random.default_rng(0)
    differences = []
    for _ in range(draws):
        rows = rng.integers(0, len(before), len(before))
        a, b = (figures([side[k] for k in rows]) for side in (before, after))
        differences.append([b[name] - a[name] for name in MEASURES])
    low, high = np.nanquantile(np.array(differences), (0.025, 0.975), axis=0)
    sides = figures(before), figures(after)
    return {name: (sides[0][name], sides[1][name], float(low[k]), float(high[k])) for k, name in enumerate(MEASURES)}


def splits(names: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Each set held out, and what is tuned on: all others, and those of streets alone."""
    found = []
    for name in names:
        others = [other for other in names if other != name]
        found.append((name, others))
        streets = [other for other in others if other != CROPS]
        if streets and streets != others:
            found.append((name, streets))
    return found


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--pictures", type=int, default=60, help="of each set at most")
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--knobs", nargs="*", default=list(NAMES), help="those that are tuned")
    parser.add_argument("--write", type=Path, help="a text file with the tune_people marks, such as README.md")
    options = parser.parse_args()
    sets = {name: scored(name, some, options.pictures) for name, some in clips(options.data).items()}
    if len(sets) < 2:
        sys.exit(f"{options.data} holds {len(sets)} of the sets, two are needed: one to tune on, one to hold out")
    lines = [
        "| held out | tuned on | pictures, people | F1 | precision, recall | IoU | doubt | off |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    words = []
    for name, learned in splits(list(sets)):
        pictures, batch = sets[name][0], [one for other in learned for one in sets[other][1]]
        plan = Plan(steps=options.steps, batch=16, rate=0.05, look_every=10, patience=1000, most_watched=48)
        done = descend(people.family(), Parameters(Settings(), options.parameters), batch, plan)
        tuned = done.settings.people
        told = compared(judge(pictures, Settings().people), judge(pictures, tuned))
        cells = {key: f"{a:.3f} → {b:.3f} ({low:+.3f} to {high:+.3f})" for key, (a, b, low, high) in told.items()}
        both = " → ".join(f"{told['precision'][k]:.2f}, {told['recall'][k]:.2f}" for k in range(2))
        count = f"{len(pictures)}, {sum(len(p.truth_px) for p in pictures)}"
        on = ", ".join(learned)
        lines.append(
            f"| {name} | {on} | {count} | {cells['f1']} | {both} | {cells['iou']} | {cells['doubt']} | {cells['off']} |"
        )
        values = (
            f"{parameter.partition('.')[2]} {getattr(tuned, parameter.partition('.')[2]):g}"
            for parameter in options.parameters
        )
        words.append(f"- on {on}, {done.best} of {options.steps} steps, {done.seconds:.0f} s: {', '.join(values)}")
        print(lines[-1], words[-1], sep="\n", file=sys.stderr, flush=True)
    text = "\n".join([*lines, "", "Tuned values:", "", *words])
    print(text)
    if options.write:
        report.put(options.write, "tune_people", text)


if __name__ == "__main__":
    main()
