"""The source's association of targets, and our tracker, on true boxes without identities.

python eval/association.py ratio DATA        accuracy ratio of whole tracks over all windows: ours and the source's
python eval/association.py weight DATA       AR_K against the weight of location (appendix C, Fig. 4a)
python eval/association.py threshold DATA    AR_2 against threshold × weight (Fig. 6)
python eval/association.py dispersion DATA   the dispersions and the weight that they choose (Fig. 3, 4b, 5)
python eval/association.py scale DATA        AR_2 and AR_3 by the scale of the histograms' dissimilarity
python eval/association.py cuts DATA         AR_2 by the dispersions, with clusters that end earlier or later (Fig. 2)

DATA holds sequences: folders with gt/gt.txt (MOTChallenge text) and a video. Except for `ratio`, identities are found
again in single windows of two or three frames, `--interval` frames apart; figures are mean / standard deviation over
the windows in percent.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bench
import clips
import cv2
import numpy as np
import torch

from torchvision_dddas.config import PaperParameters, Settings, load_config
from torchvision_dddas.detection import load_engine
from torchvision_dddas.evaluation.metrics import tracking
from torchvision_dddas.evaluation.metrics.matching import pair
from torchvision_dddas.evaluation.metrics.pixels import add_counts
from torchvision_dddas.evaluation.metrics.truth import TrackTable
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.nn import HistogramAffinity
from torchvision_dddas.tracking import CameraMotion, FrameTracker, rgb_histograms
from torchvision_dddas.tracking.source_tracker import (
    assign,
    centres,
    dispersion,
    frames_considered,
    histogram_cut,
    location_weight,
    normalize_channels,
)
from torchvision_dddas.types import Detections, TrackedFrame, Tracks

SAME_IOU = 0.9
PAPER = ("track.mode=paper",)
TRACKERS: dict[str, tuple[bool, tuple[str, ...]]] = {
    "default, with the clip": (True, ()),
    "default, boxes alone": (False, ()),
    "default, with the clip, appearance always": (True, ("track.appearance=always",)),
    "default, with the clip, no look-ahead": (True, ("track.look_ahead=false",)),
    "paper, K = 2": (True, (*PAPER, "paper.window=2")),
    "paper, K = 2, weight 0.7": (True, (*PAPER, "paper.window=2", "paper.rule=fixed")),
    "paper, K = 3": (True, PAPER),
    "paper, K = 3, weight 0.7": (True, (*PAPER, "paper.rule=fixed")),
}
"""Whether the tracker has the clip's pictures, and its settings."""
WEIGHTS = [round(0.1 * n, 1) for n in range(11)]
LOCATION_CUTS, APPEARANCE_CUTS = (0.05, 0.1, 0.15, 0.25), (0.125, 0.17, 0.25, 0.296, 0.375)
SCALES = (1.0, 0.75, 0.57, 0.5, 0.4, 0.33)


# -- whole tracks ----------------------------------------------------------------------------------------------------


def measure_ratio(options: bench.Options) -> tuple[str, Any]:
    """AR_2 and AR_3 of whole tracks over all windows of all phases of an interval.

    An interval of D has D phases: frames 1, 1 + D, ...; 2, 2 + D, ... Each is tracked by itself. Switches and IDF1 (in
    percent, matched at an IoU of 0.9) are the mean over the phases and the worst.
    """
    cv2.setNumThreads(1)
    head = [f"interval {options.interval}", "tracker", "windows of 3", "AR_2", "AR_3", "switches", "IDF1"]
    rows = []
    for place in clips.sequences(options.data):
        film = clips.film_of(place)
        if film is None or options.only not in place.name:
            continue
        truth = clips.truth_of(place).tracks
        for name, (has_clip, overrides) in TRACKERS.items():
            if name.startswith(options.tracker):
                settings = load_config(overrides=overrides)
                tracks = track_phases(truth, film if has_clip else None, options.interval, settings)
                rows.append([place.name, name, *score_phases(truth, tracks, options.interval)])
                bench.log(*rows[-1])
    return bench.format_table(head, rows, words=2), rows


def score_phases(truth: TrackTable, tracks: list[TrackTable], interval: int) -> list[str]:
    """The cells of a row."""
    links, switches, idf1 = [tracking.Windows(), tracking.Windows()], [], []
    for phase, found in enumerate(tracks):
        both = pair(truth.at((truth.frame - 1) % interval == phase), found)
        links = [
            add_counts(known, tracking.Windows.of(tracking.link_ratios(both, interval, size)))
            for known, size in zip(links, (2, 3), strict=True)
        ]
        switches.append(tracking.count_clear(both, SAME_IOU)[0].switches)
        idf1.append(100 * tracking.identity_measures(tracking.count_identity(both, SAME_IOU))["idf1"])
    ratios = [f"{100 * known.mean:.2f}" for known in links]
    spread = f"{np.mean(switches):.1f} ({max(switches)})", f"{np.mean(idf1):.1f} ({min(idf1):.1f})"
    return [str(links[1].windows), *ratios, *spread]


def track_phases(truth: TrackTable, film: Path | None, interval: int, settings: Settings) -> list[TrackTable]:
    """The tracks of each phase, all fed in one run through the clip; rows are shuffled within a frame."""
    order = np.random.default_rng(7).permutation(len(truth.frame))
    truth = truth.at(order[np.argsort(truth.frame[order], kind="stable")])
    last, source = int(truth.frame.max()), open_source(str(film)) if film else None
    size = source.size if source else tuple((truth.box_px[:, :2] + truth.box_px[:, 2:]).max(axis=0).tolist())
    trackers = [FrameTracker(settings, interval, size) for _ in range(interval)]
    cameras = [CameraMotion(load_engine("onboard", settings)) for _ in range(interval)] if source else []
    settled: list[list[Tracks]] = [[] for _ in range(interval)]
    for frame in source or range(1, last + 1):
        number = frame if isinstance(frame, int) else frame.number
        if number > last:
            break
        phase = (number - 1) % interval
        picture = None if isinstance(frame, int) else frame
        step = cameras[phase].update(picture.image)[0] if picture else None
        given = TrackedFrame(number, picture, true_detections(truth, number), Tracks(number), step)
        settled[phase] += [f.tracks for f in trackers[phase].update(given)]
    for phase, tracker in enumerate(trackers):
        settled[phase] += [f.tracks for f in tracker.flush()]
    return [join_tracks(tracks) for tracks in settled]


def true_detections(truth: TrackTable, frame: int) -> Detections:
    """The true boxes of a frame, each certain."""
    box_px = truth.box_px[slice(*np.searchsorted(truth.frame, [frame, frame + 1]))]
    unknown = np.full(len(box_px), np.nan)
    return Detections(box_px, np.ones(len(box_px)), box_px[:, 2] * box_px[:, 3], unknown, unknown, kind="given")


def join_tracks(frames: Iterable[Tracks]) -> TrackTable:
    """One table of the tracks of all frames."""
    frames = list(frames)
    number = np.concatenate([np.full(len(t), t.frame) for t in frames])
    return TrackTable(number, np.concatenate([t.identity for t in frames]), np.concatenate([t.box_px for t in frames]))


# -- windows ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sequence:
    """True boxes (pixels from 1) with identities and histograms (R, 768), a row a box, and the frames with pictures."""

    frame: np.ndarray
    identity: np.ndarray
    box_px: np.ndarray
    histogram: np.ndarray
    seen: frozenset[int]

    def rows(self, frame: int) -> np.ndarray:
        """Where the boxes of a frame are."""
        return np.flatnonzero(self.frame == frame)


@dataclass(frozen=True)
class Windows:
    """All windows of a sequence: frames (W, K), newest first, and per window what the association needs.

    location, appearance: affinities with a dummy at index 0. dispersions: (W, K, 2), of locations and histograms.
    """

    frames: np.ndarray
    identities: list[list[np.ndarray]]
    location: list[np.ndarray]
    appearance: list[np.ndarray]
    dispersions: np.ndarray


def read_sequence(place: Path) -> Sequence:
    """Read the true boxes of a sequence and their histograms, each channel's sum 1."""
    table = clips.truth_of(place).tracks
    histogram, seen = np.zeros((len(table.frame), 768)), set()
    for number, image in clips.frames_of(place, "video"):
        rows = np.flatnonzero(table.frame == number)
        histogram[rows] = rgb_histograms(image, table.box_px[rows] - (1, 1, 0, 0))
        seen.add(number)
    return Sequence(table.frame, table.identity, table.box_px, normalize_channels(histogram), frozenset(seen))


def build_windows(sequence: Sequence, count: int, interval: int, every: int = 1) -> Windows:
    """The windows of `count` frames, one ending at each frame that has its older ones; one window in `every`."""
    last = int(sequence.frame.max())
    rows = {number: sequence.rows(number) for number in range(1, last + 1)}
    ends = [[t - interval * n for n in range(count)] for t in range(1 + interval * (count - 1), last + 1)]
    whole = [f for f in ends if sequence.seen.issuperset(f) and any(len(rows[t]) for t in f)]
    if not whole:
        raise SystemExit(f"no {count} frames {interval} apart with boxes; give a shorter --interval")
    frames = np.array(whole[::every], int)
    most = max(len(r) for r in rows.values())
    valid = np.arange(most) < np.array([0, *(len(rows[t]) for t in range(1, last + 1))])[:, None]
    sizes, parts = [tuple(len(rows[t]) for t in f) for f in frames], []
    for feature in (centres(sequence.box_px), sequence.histogram):
        padded = np.zeros((last + 1, most, feature.shape[1]))
        for number, which in rows.items():
            padded[number, : len(which)] = feature[which]
        tables = [torch.from_numpy(table) for table in (padded, valid, frames)]
        found = HistogramAffinity().affinity(*tables).numpy()
        parts.append(
            [np.pad(one[tuple(map(slice, size))], ((1, 0),) * count) for one, size in zip(found, sizes, strict=True)]
        )
    identities = [[sequence.identity[rows[t]] for t in f] for f in frames]
    parameters = PaperParameters()
    spread = measure_dispersions(sequence, frames, parameters.location_cut, histogram_cut(parameters))
    return Windows(frames, identities, parts[0], parts[1], spread)


def measure_dispersions(
    sequence: Sequence, frames: np.ndarray, location_cut: float, histogram_cut: float
) -> np.ndarray:
    """(W, K, 2) of the locations and histograms of each frame of the windows, for clusters that end at these cuts.

    histogram_cut: of dissimilarities as printed.
    """
    centre, found = centres(sequence.box_px), {}
    for t in np.unique(frames).tolist():
        rows = sequence.rows(t)
        found[t] = dispersion(centre[rows], location_cut), dispersion(sequence.histogram[rows], histogram_cut)
    return np.array([[found[t] for t in f] for f in frames.tolist()]).reshape(*frames.shape, 2)


def window_ratios(windows: Windows, parameters: PaperParameters, weight: float | None) -> np.ndarray:
    """AR_K of every window; weight None: as the dispersions choose it."""
    chosen = choose_weights(windows, parameters) if weight is None else np.full(len(windows.frames), weight)
    parts = zip(windows.location, windows.appearance, windows.identities, chosen, strict=True)
    return np.array(
        [
            tracking.accuracy_ratio(assign(location, appearance, float(w), parameters), identities)
            for location, appearance, identities, w in parts
        ]
    )


def choose_weights(windows: Windows, parameters: PaperParameters) -> np.ndarray:
    """The weight of location that the source's rule gives each window."""
    found = []
    for of_frames, known in zip(windows.dispersions.tolist(), windows.identities, strict=True):
        counts = [len(k) for k in known]
        considered = of_frames[: frames_considered(counts, parameters)]
        location, appearance = (min(frame[n] for frame in considered) for n in (0, 1))
        found.append(location_weight(location, lambda a=appearance: a, parameters.lowest_dispersion)[0])
    return np.array(found)


def measure_weight(options: bench.Options) -> tuple[str, Any]:
    """AR_K against the weight of location, with a gate and without, and by the source's rule."""
    rows, found, panels = [], {}, []
    for name, sequence in _sequences(options):
        lines = {}
        for count in (2, 3):
            windows = build_windows(sequence, count, options.interval, options.every if count == 3 else 1)
            for gate in ("one_dummy", "off"):
                parameters = PaperParameters.model_validate({"window": count, "gate": gate})
                values = [window_ratios(windows, parameters, weight) for weight in [*WEIGHTS, None]]
                rows.append([name, count, gate, len(windows.frames), *map(_mean_sd, values)])
                means = [100 * float(v.mean()) for v in values]
                found[f"{name}, K = {count}, {gate}"] = means
                lines[f"K = {count}, gate {gate}"] = {"x": WEIGHTS, "y": means[:-1]}
        panels.append({"title": name, "xlabel": "weight of location", "ylabel": "AR, %", "lines": lines})
    bench.draw(options.plot, panels)
    head = ["sequence", "K", "gate", "windows", *(f"w = {w:g}" for w in WEIGHTS), "by the dispersions"]
    return bench.format_table(head, rows, words=3), found


def measure_threshold(options: bench.Options) -> tuple[str, Any]:
    """Mean AR_2 in percent against threshold (rows) × weight of location (columns)."""
    parts, found = [], {}
    for name, sequence in _sequences(options):
        windows, rows = build_windows(sequence, 2, options.interval), []
        for threshold in WEIGHTS:
            parameters = PaperParameters.model_validate({"window": 2, "threshold": threshold})
            rows.append([100 * float(window_ratios(windows, parameters, w).mean()) for w in WEIGHTS])
        found[name] = rows
        head = [f"{name}: threshold", *(f"w = {w:g}" for w in WEIGHTS)]
        cells = [[f"{t:g}", *(f"{v:.1f}" for v in row)] for t, row in zip(WEIGHTS, rows, strict=True)]
        parts.append(bench.format_table(head, cells))
    return "\n\n".join(parts), found


def measure_scale(options: bench.Options) -> tuple[str, Any]:
    """AR_2 and AR_3 by the rule and by the best fixed weight, for each scale of the histograms' dissimilarity.

    Of true links: how many are more dissimilar than the threshold. The last row of a sequence is its figures at the
    scale that is best by the rule on the other sequences.
    """
    found: dict[str, dict[float, list[float]]] = {}
    cells: dict[str, dict[float, list[str]]] = {}
    for name, sequence in _sequences(options):
        windows = {k: build_windows(sequence, k, options.interval, options.every if k == 3 else 1) for k in (2, 3)}
        found[name], cells[name] = {}, {}
        for scale in SCALES:
            cut_links, ruled = _cut_links(windows[2], scale), []
            row = [f"{100 * cut_links:.1f}"]
            for count, some in windows.items():
                parameters = PaperParameters.model_validate({"window": count, "histogram_scale": scale})
                spread = measure_dispersions(sequence, some.frames, parameters.location_cut, histogram_cut(parameters))
                some = replace(some, dispersions=spread)
                fixed = [float(window_ratios(some, parameters, w).mean()) for w in WEIGHTS]
                best = int(np.argmax(fixed))
                ruled.append(float(window_ratios(some, parameters, None).mean()))
                row += [f"{100 * ruled[-1]:.1f}", f"{100 * fixed[best]:.1f} (w = {WEIGHTS[best]:g})"]
            found[name][scale], cells[name][scale] = ruled, row
            bench.log(name, scale, *row)
    rows = []
    for name, by_scale in cells.items():
        rows += [[name, f"{scale:g}", *row] for scale, row in by_scale.items()]
        others = [of for other, of in found.items() if other != name]
        if others:
            chosen = max(SCALES, key=lambda scale: sum(sum(of[scale]) for of in others))
            rows.append([name, f"{chosen:g}, chosen on the others", *by_scale[chosen]])
    head = ["sequence", "scale", "true links cut, %", "AR_2 by the rule", "best fixed weight", "AR_3 by the rule"]
    return bench.format_table([*head, "best fixed weight"], rows, words=2), found


def _cut_links(windows: Windows, scale: float) -> float:
    """The share of true links whose histograms are more dissimilar than the threshold."""
    threshold, apart = PaperParameters().threshold, []
    for affinity, (newer, older) in zip(windows.appearance, windows.identities, strict=True):
        apart.append(scale * (1 - affinity[1:, 1:][newer[:, None] == older[None]]))
    return float((np.concatenate(apart) > threshold).mean())


def measure_dispersion(options: bench.Options) -> tuple[str, Any]:
    """The dispersions of windows of two frames, the weight that follows, and AR_2 by that and by fixed weights."""
    rows, panels = [], []
    parameters = PaperParameters.model_validate({"window": 2})
    for name, sequence in _sequences(options):
        windows = build_windows(sequence, 2, options.interval)
        chosen, ruled = choose_weights(windows, parameters), window_ratios(windows, parameters, None)
        fixed = np.stack([window_ratios(windows, parameters, weight) for weight in WEIGHTS])
        best = int(fixed.mean(axis=1).argmax())
        smallest = windows.dispersions.min(axis=1)
        spreads = [f"{v.mean():.2f} ({v.min():.2f} to {v.max():.2f})" for v in smallest.T]
        shares = " / ".join(f"{100 * (chosen == w).mean():.0f}" for w in (1.0, 0.5, 0.0))
        best_fixed = f"{_mean_sd(fixed[best])} (w = {WEIGHTS[best]:g})"
        rows.append([name, *spreads, shares, _mean_sd(ruled), best_fixed, _mean_sd(fixed.max(axis=0))])
        frames = windows.frames[:, 0].tolist()
        lines = {"locations": smallest[:, 0], "histograms": smallest[:, 1], "weight": chosen}
        drawn = {label: {"x": frames, "y": values.tolist(), "style": "-"} for label, values in lines.items()}
        panels.append({"title": name, "xlabel": "frame", "ylabel": "dispersion; weight", "lines": drawn})
    bench.draw(options.plot, panels)
    head = ["sequence", "dispersion of locations", "of histograms", "windows at w = 1 / 0.5 / 0, %", "AR_2 by the rule"]
    return bench.format_table([*head, "best fixed weight", "each window's best weight"], rows), rows


def measure_cuts(options: bench.Options) -> tuple[str, Any]:
    """AR_2 by the rule for cuts of the clusters of locations (rows) and of histograms (columns)."""
    parts = []
    parameters = PaperParameters.model_validate({"window": 2})
    for name, sequence in _sequences(options):
        windows, rows = build_windows(sequence, 2, options.interval), []
        for location_cut in LOCATION_CUTS:
            cuts = [cut / parameters.histogram_scale for cut in APPEARANCE_CUTS]
            spreads = [measure_dispersions(sequence, windows.frames, location_cut, cut) for cut in cuts]
            found = [window_ratios(replace(windows, dispersions=at), parameters, None) for at in spreads]
            rows.append([f"{location_cut:g}", *map(_mean_sd, found)])
        head = [f"{name}: cut of locations", *(f"of histograms {cut:g}" for cut in APPEARANCE_CUTS)]
        parts.append(bench.format_table(head, rows))
    return "\n\n".join(parts), None


def _sequences(options: bench.Options) -> Iterable[tuple[str, Sequence]]:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    for place in clips.sequences(options.data):
        if options.only in place.name and clips.has_pictures(place, "video"):
            yield place.name, read_sequence(place)


def _mean_sd(values: np.ndarray) -> str:
    return f"{100 * values.mean():.1f}/{100 * values.std(ddof=1):.1f}"


if __name__ == "__main__":
    common = {"data": Path, "--interval": 5, "--only": ""}
    studies = {
        "ratio": (measure_ratio, common | {"--tracker": ""}),
        "weight": (measure_weight, common | {"--every": 1, "--plot": None}),
        "threshold": (measure_threshold, common),
        "dispersion": (measure_dispersion, common | {"--plot": None}),
        "scale": (measure_scale, common | {"--every": 1}),
        "cuts": (measure_cuts, common),
    }
    bench.main(__doc__, studies)
