"""Recall of people against false positives an image: `python eval/people_miss_rate.py DATA [--plot FILE]`.

DATA holds PETS09-S2L1 and TUD-Stadtmitte as described in people_curves.py. The default settings stand beside OpenCV's
HOGDescriptor: its own defaults; the best of all its settings, chosen for each clip on some of the clip's own frames
(`--grid-frames`) by recall at one false positive an image, with the body's box fitted to that clip; and its rectangles
as they are. A detection is right at an IoU of 0.5, each true box once.

--calibrate prints what the parameters height_share, width_share, feet_share, probability_slope and probability_even
should be by these clips, and how far heights, foot rows and probabilities are right with those in force. Prints
Markdown.
"""

import argparse
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import people_opencv
import report
from people_curves import CLIPS, Clip, Curve, Found, curve, matched, plot, read
from people_opencv import Setting
from scipy.optimize import minimize

from torchvision_dddas.config import PeopleParameters, load_config
from torchvision_dddas.people.detector import detect_people, load_scorer
from torchvision_dddas.people.suppression import probability
from torchvision_dddas.types import People

DEFAULTS = Setting(1.0, 1.05, 8, 0, 2, 0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--every", type=int, default=2, help="of the frames that there are; 1: all")
    parser.add_argument(
        "--grid-frames", type=int, default=10, help="frames a clip on which OpenCV's settings are tried"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KNOB=VALUE", help="other settings than the default"
    )
    parser.add_argument("--no-opencv", action="store_true", help="ours alone")
    parser.add_argument("--calibrate", action="store_true")
    parser.add_argument("--plot", type=Path, help="a PNG with the curves")
    parser.add_argument("--write", type=Path, help="a text file with the people_miss_rate marks, such as README.md")
    options = parser.parse_args()
    places = [options.data / name for name in CLIPS if (options.data / name / "gt/gt.txt").is_file()]
    if not places:
        sys.exit(f"{options.data} holds neither {' nor '.join(CLIPS)}; nothing was measured")
    parameters = load_config(overrides=options.set).people
    clips = [read(place, options.every) for place in places]
    ours = [recognized(clip, parameters) for clip in clips]
    if options.calibrate:
        print("\n".join(calibration(clips, ours, parameters)))
        return
    curves: dict[str, dict[str, Curve]] = {}
    lines = ["| clip | detector | recall at 1 | at 0.1 | log-average miss rate |", "| --- | --- | ---: | ---: | ---: |"]
    for clip, people in zip(clips, ours, strict=True):
        found: dict[str, Curve] = {"ours": curve({n: (p.box_px, p.margin) for n, p in people.items()}, clip)}
        if not options.no_opencv:
            found |= opencv(clip, parameters, max(1, len(clip.frames) // options.grid_frames))
        curves[clip.name] = found
        for name, line in found.items():
            figures = f"{line.recall_at(1):.3f} | {line.recall_at(0.1):.3f} | {line.log_average_miss_rate:.3f}"
            lines.append(f"| {clip.name}, {len(clip.frames)} frames | {name} | {figures} |")
            print(lines[-1], file=sys.stderr, flush=True)
    print("\n".join(lines))
    if options.plot:
        plot(
            {name: {who: line for who, line in by.items() if "raw" not in who} for name, by in curves.items()},
            options.plot,
        )
    if options.write:
        report.put(options.write, "people_miss_rate", "\n".join(lines))


def recognized(clip: Clip, parameters: PeopleParameters) -> dict[int, People]:
    """The people of every frame, by the onboard back end."""
    recognizer = load_scorer(parameters, "onboard")
    found = {}
    for i, (number, image) in enumerate(clip.frames.items(), start=1):
        (found[number],) = detect_people([image], recognizer, parameters)
        print(f"\r{clip.name}: {i} of {len(clip.frames)} frames", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return found


def opencv(clip: Clip, parameters: PeopleParameters, every: int) -> dict[str, Curve]:
    """OpenCV's curves on all frames: at its defaults, at its best setting, and the raw rectangles of that."""
    first = next(iter(clip.frames.values()))
    if not people_opencv.check(first, DEFAULTS._replace(enlarge=1.5, groups=1)):
        sys.exit(f"{clip.name}: the rectangles are not those of detectMultiScale; nothing of OpenCV was measured")
    side = (1 - parameters.width_share) / 2
    body = np.array(
        [side, parameters.feet_share - parameters.height_share, parameters.width_share, parameters.height_share]
    )
    tried = list(people_opencv.grid(clip.every(every), body))
    best = max(tried, key=lambda pair: (pair[1].recall_at(1), -pair[1].log_average_miss_rate))[0]
    print(f"{clip.name}: best of {len(tried)} on {len(clip.every(every).frames)} frames: {best}", file=sys.stderr)

    def all_frames(setting: Setting) -> tuple[dict[int, Found], Curve]:
        scored = people_opencv.scored(clip, setting.enlarge, setting.scale, setting.stride)
        raw = {n: people_opencv.rectangles(rows, clip.size, setting) for n, rows in scored.items()}
        suited = people_opencv.fitted(raw, clip, body)
        return raw, curve({n: people_opencv.shrunk(here, suited) for n, here in raw.items()}, clip)

    raw, shrunk = all_frames(best)
    name = (
        f"OpenCV's best: picture x {best.enlarge:g}, scale {best.scale:g}, stride {best.stride}, "
        f"padding {best.padding}, groups {best.groups}, hits from {best.hit:g}"
    )
    return {
        "OpenCV's defaults": all_frames(DEFAULTS)[1],
        name: shrunk,
        "the same, raw rectangles": curve(raw, clip),
    }


def calibration(clips: list[Clip], found: list[dict[int, People]], parameters: PeopleParameters) -> list[str]:
    """What the clips say of shares and probabilities."""
    lines = [
        "| clip | pairs | height_share | width_share | feet_share | height error, bias and median | foot row |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    margins, right = [], []
    for clip, people in zip(clips, found, strict=True):
        window, box, true = [], [], []
        for number, here in people.items():
            which = matched((here.box_px, here.margin), clip.truth[number])
            margins.append(here.margin)
            right.append(which >= 0)
            sure = (which >= 0) & ~here.cut & (here.margin > 0.5)
            window.append(here.window_px[sure])
            box.append(here.box_px[sure])
            true.append(clip.truth[number][which[sure]])
        w, b, t = (np.concatenate(rows) for rows in (window, box, true))
        feet = t[:, 1] + t[:, 3]
        shares = np.median(np.stack([t[:, 3] / w[:, 3], t[:, 2] / w[:, 2], (feet - w[:, 1]) / w[:, 3]], axis=1), axis=0)
        height, row = b[:, 3] / t[:, 3] - 1, (b[:, 1] + b[:, 3] - feet) / t[:, 3]
        errors = " | ".join(f"{np.median(e):+.3f}, {np.median(np.abs(e)):.3f}" for e in (height, row))
        lines.append(f"| {clip.name} | {len(t)} | " + " | ".join(f"{s:.3f}" for s in shares) + f" | {errors} |")
    counts = [sum(len(p) for p in people.values()) for people in found]
    margin, hit = np.concatenate(margins), np.concatenate(right)
    weight = np.concatenate([np.full(count, 1 / max(count, 1)) for count in counts])  # each clip says as much
    slope, even = platt(margin, hit, weight)
    lines += ["", f"probability_slope {slope:.2f}, probability_even {even:.2f}", ""]
    lines += [
        "| probability | " + " | ".join(clip.name for clip in clips) + " |",
        "| --- " + "| ---: " * len(clips) + "|",
    ]
    edges = (0, 0.3, 0.5, 0.7, 0.85, 0.95, 1)
    ends = np.cumsum(counts)
    for low, high in pairwise(edges):
        cells = []
        for end, count in zip(ends, counts, strict=True):
            here = slice(end - count, end)
            said = probability(margin[here], parameters)
            inside = (said >= low) & (said < high)
            share = f"{hit[here][inside].mean():.2f} right, said {said[inside].mean():.2f}" if inside.any() else "-"
            cells.append(f"{share}, {inside.sum()}")
        lines.append(f"| {low:g} to {high:g} | " + " | ".join(cells) + " |")
    return lines


def platt(margin: np.ndarray, hit: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Slope and even score of the logistic curve that makes the hits likeliest."""

    def loss(at: np.ndarray) -> float:
        logit = at[0] * (margin - at[1])
        return float((weight * (np.logaddexp(0, logit) - hit * logit)).sum())

    slope, even = minimize(loss, [2.0, 0.5], method="Nelder-Mead").x
    return float(slope), float(even)


if __name__ == "__main__":
    main()
