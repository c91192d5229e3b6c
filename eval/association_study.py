"""The source's studies of its association: `python eval/association_study.py DATA [--study ...] [--out DIR]`.

DATA holds sequences: folders with gt/gt.txt and a video. Boxes are the true ones, identities are to be found again in
windows of two and three frames, `--interval` frames apart. Studies, all by default:

reference   AR_2 against five weights, gated and not, beside the project's reference table
weight      AR_K against the weight of location, K = 2 and 3 (appendix C, Fig. 4a), and where the dispersions choose it
threshold   AR_2 against threshold × weight (Fig. 6)
dispersion  the dispersions and the chosen weight over time (Fig. 4b and 5)
cuts        AR_2 by the dispersions, with clusters that end earlier or later
readings    AR_K in every reading of the gate, of the dummy and of the histograms

Prints Markdown: mean / standard deviation over the windows, in percent. `--out` gets the plots (extra `dev`) and
figures.json. Gated windows of three frames take up to a second each: `--every 10` takes one in ten of them.
"""

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
import association_data as data
import association_plots as plots
import footage

from torchvision_dddas.config import PaperParameters
from torchvision_dddas.evaluation.metrics.accuracy_ratio import accuracy_ratio
from torchvision_dddas.tracking import source_affinity
from torchvision_dddas.tracking.source_affinity import frames_considered, location_weight
from torchvision_dddas.tracking.source_tracker import assign

# An earlier measurement at an interval of 5; None is the weight by the dispersions. Its pictures of PETS09-S2L1 cannot
# have been those of the strongly compressed video: of the figures that use them, those of single pictures come close.
REFERENCE: dict[str, dict[str, dict[float | None, str]]] = {
    "PETS09-S2L1": {
        "one_dummy": {
            0.0: "73.3/20.6",
            0.5: "98.2/7.8",
            0.7: "98.4/7.4",
            0.8: "98.3/7.5",
            1.0: "96.9/9.9",
            None: "77.5",
        },
        "off": {0.0: "96.9", 0.5: "98.3", 1.0: "96.8"},
    },
    "TUD-Stadtmitte": {
        "one_dummy": {
            0.0: "89.9/13.6",
            0.5: "96.1/10.1",
            0.7: "97.9/8.0",
            0.8: "98.5/6.5",
            1.0: "98.3/6.9",
            None: "89.9",
        },
        "off": {0.0: "93.3", 0.5: "96.6", 1.0: "98.3"},
    },
}
WEIGHTS = [round(0.1 * n, 1) for n in range(11)]
LOCATION_CUTS, APPEARANCE_CUTS = (0.05, 0.1, 0.15, 0.25), (0.25, 0.34, 0.5, 0.6, 0.75)
STUDIES = ("reference", "weight", "threshold", "dispersion", "cuts", "readings")
Figures = dict[str, Any]


def main() -> None:
    """Run the chosen studies on the sequences that have what they need."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--study", default=",".join(STUDIES))
    parser.add_argument("--only", default="", help="sequences whose name contains this")
    parser.add_argument("--interval", type=int, default=5)
    parser.add_argument("--every", type=int, default=1, help="take one in so many of the windows of three frames")
    parser.add_argument("--out", type=Path, help="a folder for plots and figures.json")
    options = parser.parse_args()
    if unknown := set(options.study.split(",")) - set(STUDIES):
        sys.exit(f"no such study: {', '.join(sorted(unknown))}; give one or more of {', '.join(STUDIES)}")
    places = [place for place in footage.sequences(options.folder) if options.only in place.name]
    places = [place for place in places if footage.has_pictures(place, "video")]
    if not places:
        sys.exit(f"{options.folder} holds no sequences with gt/gt.txt and a video; nothing was measured")
    found: Figures = {}
    for study in options.study.split(","):
        print(f"\n## {study}\n", flush=True)
        run: Callable[[Path, int, int], Figures] = globals()[f"by_{study}"]
        found[study] = {}
        for place in places:
            found[study][place.name] = run(place, options.interval, options.every)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "figures.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        plots.draw(found, options.out)


def ratios(windows: data.Windows, parameters: PaperParameters, weight: float | None) -> np.ndarray:
    """AR_K of every window; weight None: as the dispersions choose it."""
    chosen = weights(windows, parameters) if weight is None else np.full(len(windows.frames), weight)
    return np.array(
        [
            accuracy_ratio(assign(location, appearance, float(w), parameters), identities)
            for location, appearance, identities, w in zip(
                windows.location, windows.appearance, windows.identities, chosen, strict=True
            )
        ]
    )


def weights(windows: data.Windows, parameters: PaperParameters) -> np.ndarray:
    """The weight of location that the source's rule gives each window."""
    found = []
    for of_frames, known in zip(windows.dispersions.tolist(), windows.identities, strict=True):
        counts = [len(k) for k in known]
        location, appearance = (
            min([frame[n] for frame in of_frames][: frames_considered(counts, parameters)]) for n in (0, 1)
        )
        found.append(location_weight(location, lambda a=appearance: a, parameters.lowest_dispersion)[0])
    return np.array(found)


def _windows(
    place: Path, count: int, interval: int, pictures: str = "video", every: int = 1, **how: Any
) -> data.Windows:
    parameters = PaperParameters()
    truth = data.read(place, pictures, **how)
    found = data.windows(truth, count, interval, (parameters.location_cut, parameters.appearance_cut), every)
    if not len(found.frames) and pictures == "video":
        sys.exit(f"{place} has no {count} frames {interval} apart with boxes; give a shorter --interval")
    return found


def _words(values: np.ndarray) -> str:
    return f"{100 * values.mean():.1f}/{100 * values.std(ddof=1):.1f}"


def _parameters(**values: object) -> PaperParameters:
    return PaperParameters.model_validate(values)


# -- the studies: a sequence -> figures, printed as they come --------------------------------------------------------


def by_reference(place: Path, interval: int, _: int) -> Figures:
    """AR_2 of the video, and of single pictures where there are some, beside the reference."""
    known = REFERENCE.get(place.name, {}) if interval == 5 else {}
    gated: list[tuple[str, float | None]] = [("one_dummy", w) for w in (0.0, 0.5, 0.7, 0.8, 1.0, None)]
    columns = [*gated, ("off", 0.0), ("off", 0.5), ("off", 1.0)]
    heads = [f"{'no gate, ' * (g == 'off')}{'by the dispersions' if w is None else f'w = {w:g}'}" for g, w in columns]
    print(f"\n{place.name}, K = 2\n\n| | windows | {' | '.join(heads)} |")
    print("| --- | ---: " + "| ---: " * len(columns) + "|")
    if known:
        print("| reference | | " + " | ".join(known[g].get(w, "") for g, w in columns) + " |")
    found: Figures = {}

    def row(name: str, windows: data.Windows, which: np.ndarray) -> None:
        words = [_words(ratios(windows, _parameters(window=2, gate=g), w)[which]) for g, w in columns]
        print(f"| {name} | {len(which)} | " + " | ".join(words) + " |", flush=True)
        found[name] = dict(zip(heads, words, strict=True))

    video = _windows(place, 2, interval)
    row("video", video, np.arange(len(video.frames)))
    ignored = _windows(place, 2, interval, ignored=True)
    row("video, ignored boxes too", ignored, np.arange(len(ignored.frames)))
    if footage.has_pictures(place, "images"):
        single = _windows(place, 2, interval, "images")
        if len(single.frames):
            row("single pictures", single, np.arange(len(single.frames)))
            row("video, the same windows", video, np.flatnonzero(np.isin(video.frames[:, 0], single.frames[:, 0])))
    return found


def by_weight(place: Path, interval: int, every: int) -> Figures:
    """AR_K against the weight, gated and not, and by the rule."""
    print(f"\n{place.name}\n")
    print("| K | windows | gate | " + " | ".join(f"w = {w:g}" for w in WEIGHTS) + " | by the dispersions |")
    print("| --- | ---: | --- " + "| ---: " * (len(WEIGHTS) + 1) + "|")
    found: Figures = {}
    for count in (2, 3):
        windows = _windows(place, count, interval, every=every if count == 3 else 1)
        for gate in ("one_dummy", "off"):
            parameters = _parameters(window=count, gate=gate)
            values = [ratios(windows, parameters, weight) for weight in [*WEIGHTS, None]]
            print(f"| {count} | {len(windows.frames)} | {gate} | " + " | ".join(map(_words, values)) + " |", flush=True)
            found[f"{count} {gate}"] = {"mean": [v.mean() for v in values], "sd": [v.std(ddof=1) for v in values]}
    return found


def by_threshold(place: Path, interval: int, _: int) -> Figures:
    """Mean AR_2 against threshold (rows) × weight (columns)."""
    windows = _windows(place, 2, interval)
    print(f"\n{place.name}, K = 2, mean AR in %\n")
    print("| thresh | " + " | ".join(f"w = {w:g}" for w in WEIGHTS) + " |")
    print("| --- " + "| ---: " * len(WEIGHTS) + "|")
    table = []
    for threshold in WEIGHTS:
        table.append([ratios(windows, _parameters(window=2, threshold=threshold), w).mean() for w in WEIGHTS])
        print(f"| {threshold:g} | " + " | ".join(f"{100 * mean:.1f}" for mean in table[-1]) + " |", flush=True)
    return {"mean": table}


def by_dispersion(place: Path, interval: int, _: int) -> Figures:
    """The dispersions of a window and the weight over time, with AR_2 by that weight and by fixed ones."""
    windows, parameters = _windows(place, 2, interval), _parameters(window=2)
    chosen = weights(windows, parameters)
    fixed = np.stack([ratios(windows, parameters, weight) for weight in WEIGHTS])
    ruled = ratios(windows, parameters, None)
    best = int(fixed.mean(axis=1).argmax())
    smallest = windows.dispersions.min(axis=1)
    rows = [
        ("Ndm of locations, mean (least to most)", _spread(smallest[:, 0])),
        ("Ndm of histograms, mean (least to most)", _spread(smallest[:, 1])),
        ("windows at w = 1 / 0.5 / 0, %", " / ".join(f"{100 * (chosen == w).mean():.0f}" for w in (1.0, 0.5, 0.0))),
        ("AR_2 by the rule", _words(ruled)),
        (f"AR_2 by the best fixed weight, {WEIGHTS[best]:g}", _words(fixed[best])),
        ("AR_2 by each window's own best weight", _words(fixed.max(axis=0))),
        ("windows where the rule beats / loses to it, %", _against(ruled, fixed[best])),
    ]
    print(f"\n{place.name}\n\n| | |\n| --- | --- |")
    for name, words in rows:
        print(f"| {name} | {words} |")
    return {
        "frame": windows.frames[:, 0].tolist(),
        "location": smallest[:, 0].tolist(),
        "appearance": smallest[:, 1].tolist(),
        "weight": chosen.tolist(),
        "ruled": ruled.tolist(),
        "fixed": fixed[best].tolist(),
        "best": WEIGHTS[best],
        "lowest": parameters.lowest_dispersion,
    }


def by_cuts(place: Path, interval: int, _: int) -> Figures:
    """AR_2 by the rule for cuts of the clusters of locations and of histograms, beside the best fixed weight."""
    windows, truth = _windows(place, 2, interval), data.read(place, "video")
    found: Figures = {}
    for gate in ("one_dummy", "off"):
        parameters = _parameters(window=2, gate=gate)
        fixed = {weight: ratios(windows, parameters, weight) for weight in WEIGHTS}
        best = max(fixed, key=lambda weight: fixed[weight].mean())
        print(f"\n{place.name}, K = 2, gate {gate}: best fixed weight {best:g}, {_words(fixed[best])}\n")
        print("| G of locations | " + " | ".join(f"G of histograms {cut:g}" for cut in APPEARANCE_CUTS) + " |")
        print("| --- " + "| ---: " * len(APPEARANCE_CUTS) + "|")
        for location_cut in LOCATION_CUTS:
            words = []
            for appearance_cut in APPEARANCE_CUTS:
                at = data.dispersions(truth, windows.frames, (location_cut, appearance_cut))
                chosen = weights(replace(windows, dispersions=at), parameters)
                words.append(
                    _words(np.select([chosen == w for w in (0.0, 0.5, 1.0)], [fixed[w] for w in (0.0, 0.5, 1.0)]))
                )
            print(f"| {location_cut:g} | " + " | ".join(words) + " |", flush=True)
            found[f"{gate} {location_cut:g}"] = words
    return found


def by_readings(place: Path, interval: int, every: int) -> Figures:
    """AR_K in each reading of the gate, of an entry with a dummy and of the histograms."""
    shares = _windows(place, 3, interval, every=every)
    tables = {
        "2, zero, channel": _windows(place, 2, interval),
        "2, zero, count": _windows(place, 2, interval, histograms="count"),
        "3, zero, channel": shares,
        "3, zero, count": _windows(place, 3, interval, every=every, histograms="count"),
        "3, formula, channel": _by_formula(place, shares),
    }
    gates = [("one_dummy", "features"), ("one_dummy", "affinity"), ("every_dummy", "features"), ("off", "features")]
    print(f"\n{place.name}\n")
    print("| K, dummy, histogram | windows | gate | gated | w = 0 | w = 0.5 | w = 0.7 | w = 1 |")
    print("| --- | ---: | --- | --- " + "| ---: " * 4 + "|")
    found: Figures = {}
    for name, table in tables.items():
        for gate, gated in gates if "3" in name else [pair for pair in gates if pair[0] != "every_dummy"]:
            parameters = _parameters(window=int(name[0]), gate=gate, gated=gated)
            words = [_words(ratios(table, parameters, weight)) for weight in (0.0, 0.5, 0.7, 1.0)]
            print(f"| {name} | {len(table.frames)} | {gate} | {gated} | " + " | ".join(words) + " |", flush=True)
            found[f"{name}, {gate}, {gated}"] = words
    return found


def _by_formula(place: Path, windows: data.Windows) -> data.Windows:
    """The same windows with eq. 4 and 5 on a dummy of zeros."""
    truth = data.read(place, "video")
    centre, shares = source_affinity.centres(truth.box_px), truth.histogram
    location, appearance = (
        [
            affinity.triplet_affinity(*(feature[truth.rows(t)] for t in f), dummy="formula")
            for f in windows.frames.tolist()
        ]
        for feature in (centre, shares)
    )
    return data.Windows(windows.frames, windows.identities, location, appearance, windows.dispersions)


def _spread(values: np.ndarray) -> str:
    return f"{values.mean():.2f} ({values.min():.2f} to {values.max():.2f})"


def _against(ruled: np.ndarray, fixed: np.ndarray) -> str:
    return f"{100 * (ruled > fixed + 1e-9).mean():.1f} / {100 * (ruled < fixed - 1e-9).mean():.1f}"


if __name__ == "__main__":
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    main()
