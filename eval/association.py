"""Measure the source's association of targets, and our tracker, on true boxes without identities.

python eval/association.py ratio DATA        accuracy ratio of whole tracks over all windows: the source's, ours, plain
python eval/association.py clusters DATA     the clusters of the frame with the most targets (appendix C, Fig. 2)
python eval/association.py examples DATA     windows like those of Fig. 3, 4b and 5: dispersions, AR_3 by weight
python eval/association.py weight DATA       AR_K against the weight of location (Fig. 4a)
python eval/association.py threshold DATA    AR_2 against threshold × weight (Fig. 6)
python eval/association.py dispersion DATA   the dispersions of all windows and the resulting weight
python eval/association.py scale DATA        AR_2 and AR_3 by the scale of the histograms' dissimilarity
python eval/association.py readings DATA     AR_3 by the meaning of the dummy: the rule, fixed weights, the dispersions
python eval/association.py cuts DATA         AR_2 by the dispersions, with lower and higher cuts of the clusters

DATA holds sequences: folders with gt/gt.txt (MOTChallenge text) and a video. `ratio` and `clusters` use whole tracks
and frames. The other studies associate targets in single windows of two or three frames, `--interval` frames apart.
Their figures are mean / standard deviation over the windows in percent.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bench
import clips
import cv2
import numpy as np
from association_windows import (
    Sequence,
    Windows,
    build_windows,
    choose_weights,
    considered_dispersions,
    mean_sd,
    measure_dispersions,
    open_sequences,
    select_windows,
    window_ratios,
)
from scipy.cluster import hierarchy

from torchvision_dddas.config import PaperParameters, Settings, load_config
from torchvision_dddas.detection import load_engine
from torchvision_dddas.geometry import cheapest
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.lab.evaluation.metrics import tracking
from torchvision_dddas.lab.evaluation.metrics.matching import pair
from torchvision_dddas.lab.evaluation.metrics.pixels import add_counts
from torchvision_dddas.lab.evaluation.metrics.truth import TrackTable
from torchvision_dddas.tracking import CameraMotion, FrameTracker
from torchvision_dddas.tracking.source_tracker import (
    centres,
    histogram_cut,
    normalized_entropy,
    similarity,
)
from torchvision_dddas.types import Detections, TrackedFrame, Tracks

SAME_IOU = 0.9
PAPER = ("track.mode=paper",)
PLAIN = "plain, nearest centres"
TRACKERS: dict[str, tuple[bool, tuple[str, ...]]] = {
    "default, with the clip": (True, ()),
    "default, boxes alone": (False, ()),
    "default, with the clip, appearance always": (True, ("track.appearance=always",)),
    "default, with the clip, no look-ahead": (True, ("track.look_ahead=false",)),
    "paper, K = 2": (True, (*PAPER, "paper.window=2")),
    "paper, K = 2, weight 0.7": (True, (*PAPER, "paper.window=2", "paper.rule=fixed")),
    "paper, K = 3": (True, PAPER),
    "paper, K = 3, weight 0.7": (True, (*PAPER, "paper.rule=fixed")),
    "as printed, dummies by real pairs": (
        True,
        (*PAPER, "paper.dummy=real_pair", "paper.histogram_scale=1", "paper.appearance_cut=0.25"),
    ),
}
"""Whether the tracker gets the clip's pictures, and its settings."""
WEIGHTS = [round(0.1 * n, 1) for n in range(11)]
LOCATION_CUTS, APPEARANCE_CUTS = (0.05, 0.1, 0.15, 0.25), (0.125, 0.17, 0.25, 0.296, 0.375)
"""Values around the shipped `paper.location_cut` and `paper.appearance_cut`."""
SCALES = (1.0, 0.75, 0.57, 0.5, 0.4, 0.33)
"""Values of `paper.histogram_scale`; 1 is the source's formula as printed."""
READINGS = (("formula", 0.4, 0.296), ("formula", 1.0, 0.25), ("real_pair", 1.0, 0.25), ("real_pair", 0.4, 0.296))
"""`paper.dummy`, `paper.histogram_scale` and `paper.appearance_cut` of each reading; the first is shipped."""
SMOOTHED = 4
"""Looks over which a dispersion is smoothed."""
SHOWN = (0.0, 0.3, 0.5, 0.7, 1.0)
"""The weights in the table of examples."""
WORST = 9
"""Number of windows of TUD-Stadtmitte in the source's Fig. 4b."""


@dataclass(frozen=True)
class Quoted:
    """The source's figures of a window in Fig. 5, oldest frame first; NaN without a value."""

    figure: str
    sequence: str
    targets: tuple[int, int, int]
    location: float
    appearance: float
    weight: float


QUOTED = (
    Quoted("5a", "a UAV's video, not published", (4, 5, 5), 0.31, np.nan, 0.0),
    Quoted("5b", "PETS09-S2L1", (7, 7, 7), 0.52, 0.90, 0.0),
    Quoted("5c", "TUD-Stadtmitte", (6, 7, 7), np.nan, 0.59, 0.5),
    Quoted("5d", "PETS09-S2L2", (15, 15, 16), 0.78, np.nan, 1.0),
)
"""Appendix C, section IV, paragraph on Fig. 5 and its caption: targets, dispersions and the resulting weight."""


# -- whole tracks ----------------------------------------------------------------------------------------------------


def measure_ratio(options: bench.Options) -> tuple[str, Any]:
    """Measure AR_2 and AR_3 of whole tracks over all windows of all phases of an interval.

    An interval of D has D phases: frames 1, 1 + D, ...; 2, 2 + D, ... Each phase is tracked separately. Switches and
    IDF1 (in percent, matched at an IoU of 0.9) are the mean and the worst value over the phases. plain: boxes continue
    boxes of the last look by the least sum of distances of centres; no distance exceeds the height of the box.
    """
    cv2.setNumThreads(1)
    head = [f"interval {options.interval}", "tracker", "windows of 3", "AR_2", "AR_3", "switches", "IDF1"]
    rows = []
    for place in clips.sequences(options.data):
        film = clips.film_of(place)
        if film is None or options.only not in place.name:
            continue
        truth = clips.truth_of(place).tracks
        if PLAIN.startswith(options.tracker):
            rows.append(
                [place.name, PLAIN, *score_phases(truth, track_nearest(truth, options.interval), options.interval)]
            )
            bench.log(*rows[-1])
        for name, (has_clip, overrides) in TRACKERS.items():
            if name.startswith(options.tracker):
                settings = load_config(overrides=overrides)
                tracks = track_phases(truth, film if has_clip else None, options.interval, settings)
                rows.append([place.name, name, *score_phases(truth, tracks, options.interval)])
                bench.log(*rows[-1])
    return bench.format_table(head, rows, words=2), rows


def score_phases(truth: TrackTable, tracks: list[TrackTable], interval: int) -> list[str]:
    """Return the table cells of scores over all phases."""
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
    """Track all phases in one run through the clip and return their tracks. Rows are shuffled within a frame."""
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


def track_nearest(truth: TrackTable, interval: int) -> list[TrackTable]:
    """Return the tracks of each phase by nearest centres in successive looks."""
    found = []
    for phase in range(interval):
        of_phase, before, following = [], (np.zeros((0, 4)), np.zeros(0, np.int64)), 1
        for number in range(phase + 1, int(truth.frame.max()) + 1, interval):
            box = true_detections(truth, number).box_px
            apart = np.linalg.norm(centres(box)[:, None] - centres(before[0])[None], axis=2)
            most = box[:, 3:]
            rows, columns = cheapest(np.where(apart <= most, apart, 1e6))
            identity = np.zeros(len(box), np.int64)
            linked = (apart <= most)[rows, columns]
            identity[rows[linked]] = before[1][columns[linked]]
            new = np.flatnonzero(identity == 0)
            identity[new], following = following + np.arange(len(new)), following + len(new)
            of_phase.append(Tracks(number, identity, box, np.ones(len(box)), np.arange(len(box))))
            before = box, identity
        found.append(join_tracks(of_phase))
    return found


def true_detections(truth: TrackTable, frame: int) -> Detections:
    """Return the true boxes of a frame with probability 1."""
    box_px = truth.box_px[slice(*np.searchsorted(truth.frame, [frame, frame + 1]))]
    unknown = np.full(len(box_px), np.nan)
    return Detections(box_px, np.ones(len(box_px)), box_px[:, 2] * box_px[:, 3], unknown, unknown, kind="given")


def join_tracks(frames: Iterable[Tracks]) -> TrackTable:
    """Join the tracks of all frames into one table."""
    frames = list(frames)
    number = np.concatenate([np.full(len(t), t.frame) for t in frames])
    return TrackTable(number, np.concatenate([t.identity for t in frames]), np.concatenate([t.box_px for t in frames]))


# -- windows --------------------------------------------------------------------------------------------------------


def measure_weight(options: bench.Options) -> tuple[str, Any]:
    """Measure AR_K against the weight of location, with and without a gate, and by the source's rule."""
    rows, found, panels = [], {}, []
    for name, sequence in open_sequences(options):
        lines = {}
        for count in (2, 3):
            windows = build_windows(sequence, count, options.interval, options.every if count == 3 else 1)
            for gate in ("one_dummy", "off"):
                parameters = PaperParameters.model_validate({"window": count, "gate": gate})
                values = [window_ratios(windows, parameters, weight) for weight in [*WEIGHTS, None]]
                rows.append([name, count, gate, len(windows.frames), *map(mean_sd, values)])
                means = [100 * float(v.mean()) for v in values]
                found[f"{name}, K = {count}, {gate}"] = means
                lines[f"K = {count}, gate {gate}"] = {"x": WEIGHTS, "y": means[:-1]}
        panels.append({"title": name, "xlabel": "weight of location", "ylabel": "AR, %", "lines": lines})
    bench.draw(options.plot, panels)
    head = ["sequence", "K", "gate", "windows", *(f"w = {w:g}" for w in WEIGHTS), "by the dispersions"]
    return bench.format_table(head, rows, words=3), found


def measure_threshold(options: bench.Options) -> tuple[str, Any]:
    """Measure mean AR_2 in percent against threshold (rows) × weight of location (columns)."""
    parts, found, panels = [], {}, []
    for name, sequence in open_sequences(options):
        windows, rows = build_windows(sequence, 2, options.interval), []
        for threshold in WEIGHTS:
            parameters = PaperParameters.model_validate({"window": 2, "threshold": threshold})
            rows.append([100 * float(window_ratios(windows, parameters, w).mean()) for w in WEIGHTS])
        found[name] = rows
        head = [f"{name}: threshold", *(f"w = {w:g}" for w in WEIGHTS)]
        cells = [[f"{t:g}", *(f"{v:.1f}" for v in row)] for t, row in zip(WEIGHTS, rows, strict=True)]
        parts.append(bench.format_table(head, cells))
        lines = {f"w = {w:g}": {"x": WEIGHTS, "y": [row[n] for row in rows]} for n, w in enumerate(WEIGHTS)}
        panels.append({"title": name, "xlabel": "threshold", "ylabel": "AR_2, %", "lines": lines})
    bench.draw(options.plot, panels)
    return "\n\n".join(parts), found


def measure_examples(options: bench.Options) -> tuple[str, Any]:
    """Show windows of three frames like those in the source: dispersions, weight, AR_3 by weight.

    3a, 3b: among windows of four targets, the window with the least and the greatest dispersion of locations. Ties go
    to the histograms that are furthest apart (3a) and nearest (3b). 4b: the windows with the lowest mean AR_3 over the
    weights, if AR_3 depends on the weight. 5: among windows with as many targets as in the source, the window nearest
    to the quoted dispersions, with the range over all these windows. The study uses the shipped scale of the
    histograms' dissimilarity and the printed scale 1. If a window's frames have the same number of targets, its
    dispersions are those of the newest frame.
    """
    rows, quoted, panels, figures = [], [], [], []
    sequences = dict(open_sequences(options))
    for name, sequence in sequences.items():
        windows = build_windows(sequence, 3, options.interval)
        for scale in (PaperParameters().histogram_scale, 1.0):
            parameters = PaperParameters.model_validate({"histogram_scale": scale})
            spread = measure_dispersions(sequence, windows.frames, parameters.location_cut, histogram_cut(parameters))
            scaled, lines = replace(windows, dispersions=spread), {}
            known = np.array([considered_dispersions(scaled, row, parameters) for row in range(len(scaled.frames))])
            for figure, row in choose_examples(name, scaled, known, parameters):
                one = select_windows(scaled, [row])
                ratios = [100 * float(window_ratios(one, parameters, weight)[0]) for weight in WEIGHTS]
                weight = float(choose_weights(one, parameters)[0])
                frames = ", ".join(map(str, one.frames[0, ::-1]))
                targets = ", ".join(str(len(of)) for of in one.identities[0][::-1])
                cells = [_two(known[row, 0]), _two(known[row, 1]), f"{weight:g}"]
                shown = [f"{ratios[WEIGHTS.index(w)]:.0f}" for w in SHOWN]
                rows.append([figure, f"{scale:g}", name, frames, targets, *cells, *shown])
                figures.append([*rows[-1][:8], ratios])
                lines[figure] = {"x": WEIGHTS, "y": ratios}
            of = [one for one in QUOTED if one.sequence == name]
            quoted += [_quote(one, f"{scale:g}", known[_as_many(scaled, one.targets)]) for one in of]
            title, label = f"{name}, scale {scale:g}", "weight of location"
            panels.append({"title": title, "xlabel": label, "ylabel": "AR_3, %", "lines": lines})
    quoted += [_quote(one, "–", np.zeros((0, 2))) for one in QUOTED if one.sequence not in sequences]
    bench.draw(options.plot, panels, columns=2)
    head = ["Fig.", "scale", "sequence", "frames", "targets", "Ndm of locations", "of histograms", "weight by the rule"]
    text = bench.format_table([*head, *(f"AR_3 at {w:g}" for w in SHOWN)], rows, words=5)
    head = ["Fig.", "sequence", "targets", "quoted: locations", "histograms", "weight", "scale", "windows here"]
    table = bench.format_table([*head, "locations", "histograms"], quoted, words=3)
    return f"{text}\n\nQuoted by the source, and the range over the windows with as many targets here:\n\n{table}", {
        "examples": figures,
        "quoted": quoted,
    }


def choose_examples(
    name: str, windows: Windows, known: np.ndarray, parameters: PaperParameters
) -> list[tuple[str, int]]:
    """Return figure and row of each window to show. known: (W, 2) dispersions that the rule uses."""
    chosen = []
    four = _as_many(windows, (4, 4, 4))
    if len(four):
        location, appearance = known[four].T
        chosen.append(("3a", int(four[np.lexsort([-appearance, location])[0]])))
        chosen.append(("3b", int(four[np.lexsort([appearance, -location])[0]])))
    for one in QUOTED:
        same = _as_many(windows, one.targets)
        if one.sequence == name and len(same):
            off = np.nansum((known[same] - (one.location, one.appearance)) ** 2, axis=1)
            chosen.append((one.figure, int(same[off.argmin()])))
    if name == "TUD-Stadtmitte":
        by_weight = np.array([window_ratios(windows, parameters, weight) for weight in WEIGHTS])
        varied = np.flatnonzero(np.ptp(by_weight, axis=0) > 0)
        worst = varied[by_weight.mean(axis=0)[varied].argsort(kind="stable")[:WORST]]
        chosen += [(f"4b, {k}", row) for k, row in enumerate(sorted(worst.tolist()), 1)]
    return chosen


def _as_many(windows: Windows, targets: tuple[int, ...]) -> np.ndarray:
    """Return the windows with these numbers of targets, oldest frame first."""
    counts = np.array([[len(known) for known in of] for of in windows.identities])
    return np.flatnonzero((counts == targets[::-1]).all(axis=1))


def _quote(one: Quoted, scale: str, here: np.ndarray) -> list[str]:
    values = [_two(one.location), _two(one.appearance), f"{one.weight:g}", scale, str(len(here))]
    ranges = [f"{v.min():.2f} to {v.max():.2f}" for v in here.T] if len(here) else ["–", "–"]
    return [one.figure, one.sequence, ", ".join(map(str, one.targets)), *values, *ranges]


def _two(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.2f}"


def measure_clusters(options: bench.Options) -> tuple[str, Any]:
    """Show the clusters of targets by location and by histogram, in the frame of a sequence with the most targets.

    Clustering is average linkage on the dissimilarity. `paper.histogram_scale` scales that of histograms. The trees
    end at the cuts. --plot draws the trees.
    """
    parameters, rows, trees = PaperParameters(), [], []
    for name, sequence in open_sequences(options):
        seen = np.array(sorted(sequence.seen))
        frame = int(seen[np.argmax([len(sequence.rows(int(number))) for number in seen])])
        here = sequence.rows(frame)
        identity = sequence.identity[here]
        features = {
            "locations": (centres(sequence.box_px)[here], 1.0, parameters.location_cut),
            "histograms": (sequence.histogram[here], parameters.histogram_scale, parameters.appearance_cut),
        }
        for feature, (values, scale, cut) in features.items():
            apart = scale * (1 - similarity(values, values))
            tree = hierarchy.linkage(apart[np.triu_indices(len(apart), 1)], "average")
            cluster = hierarchy.fcluster(tree, cut, "distance")
            members = [sorted(identity[cluster == k].tolist()) for k in np.unique(cluster)]
            words = " ".join("{" + ", ".join(map(str, one)) + "}" for one in sorted(members, key=len, reverse=True))
            entropy = normalized_entropy(cluster)
            rows.append(
                [name, feature, str(frame), str(len(here)), f"{cut:g}", str(len(members)), f"{entropy:.2f}", words]
            )
            trees.append((f"{name}, frame {frame}: {feature}", tree, cut, identity))
    if options.plot:
        draw_trees(options.plot, trees)
    head = ["sequence", "feature", "frame", "targets", "cut", "clusters", "Ndm", "identities in each"]
    return bench.format_table(head, rows, words=2), rows


def draw_trees(path: str, trees: list[tuple[str, np.ndarray, float, np.ndarray]]) -> None:
    """Draw dendrograms with their cuts into a PNG."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    count = -(-len(trees) // 2)
    figure, axes = plt.subplots(count, 2, figsize=(11, 4 * count), squeeze=False, layout="constrained")
    for axis, (title, tree, cut, identity) in zip(axes.ravel(), trees, strict=False):
        hierarchy.dendrogram(
            tree, ax=axis, labels=identity.tolist(), color_threshold=cut, above_threshold_color="#888888"
        )
        axis.axhline(cut, color="#d9730d", linestyle="--")
        axis.set(title=title, xlabel="target", ylabel="dissimilarity")
    figure.savefig(path, dpi=110)
    bench.log(f"{path}: drawn")


def measure_scale(options: bench.Options) -> tuple[str, Any]:
    """Measure AR_2 and AR_3 by the rule and by the best fixed weight, for each scale of the histograms' dissimilarity.

    A further column gives the share of true links that are more dissimilar than the threshold. The last row of a
    sequence holds its figures at the scale that is best by the rule on the other sequences.
    """
    found: dict[str, dict[float, list[float]]] = {}
    cells: dict[str, dict[float, list[str]]] = {}
    for name, sequence in open_sequences(options):
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


def measure_readings(options: bench.Options) -> tuple[str, Any]:
    """Measure AR_3 for each reading of a dummy's entry, by the rule and by fixed weights, with the dispersions.

    formula: the gate raises an entry with one dummy if no real alternative passes. real_pair: only if its two real
    targets are similar enough. The study uses the shipped scale and cut of the histograms, and the printed ones (scale
    1, cut 0.25). smoothed: the rule uses the mean of a frame's dispersions and those of the three looks before it.
    """
    rows, quoted, found = [], [], {}
    for name, sequence in open_sequences(options):
        for dummy, scale, cut in READINGS:
            parameters = PaperParameters.model_validate(
                {"dummy": dummy, "histogram_scale": scale, "appearance_cut": cut}
            )
            windows = build_windows(sequence, 3, options.interval, options.every, parameters)
            fixed = {weight: window_ratios(windows, parameters, weight) for weight in SHOWN}
            for looks in (1, SMOOTHED) if (dummy, scale) == ("real_pair", 1) else (1,):
                words = f"{dummy}{f', smoothed over {looks} looks' * (looks > 1)}"
                spread = smooth_dispersions(sequence, windows.frames, options.interval, looks, parameters)
                smoothed = replace(windows, dispersions=spread)
                known = np.array([considered_dispersions(smoothed, row, parameters) for row in range(len(spread))])
                chosen = choose_weights(smoothed, parameters)
                ruled = np.array([fixed[weight][row] for row, weight in enumerate(chosen.tolist())])
                ranges = [f"{v.mean():.2f} ({v.min():.2f} to {v.max():.2f})" for v in known.T]
                shares = " / ".join(f"{100 * (chosen == w).mean():.0f}" for w in (1.0, 0.5, 0.0))
                cells = [f"{100 * v.mean():.1f}" for v in fixed.values()] if looks == 1 else ["–"] * len(SHOWN)
                rows.append([name, words, f"{scale:g}, {cut:g}", *ranges, shares, f"{100 * ruled.mean():.1f}", *cells])
                means = [float(ruled.mean()), *(float(v.mean()) for v in fixed.values())]
                found[f"{name}, {words}, scale {scale:g}"] = means
                bench.log(*rows[-1])
                of = [one for one in QUOTED if one.sequence == name and dummy == "real_pair" and scale == 1]
                quoted += [_quote(one, f"{looks}", known[_as_many(smoothed, one.targets)]) for one in of]
    head = ["sequence", "dummy", "scale, cut", "Ndm of locations", "of histograms", "windows at w = 1 / 0.5 / 0, %"]
    text = bench.format_table([*head, "AR_3 by the rule", *(f"w = {w:g}" for w in SHOWN)], rows, words=3)
    head = ["Fig.", "sequence", "targets", "quoted: locations", "histograms", "weight", "looks", "windows here"]
    table = bench.format_table([*head, "locations", "histograms"], quoted, words=3)
    return f"{text}\n\nQuoted by the source, and as printed here:\n\n{table}", found


def smooth_dispersions(
    sequence: Sequence, frames: np.ndarray, interval: int, looks: int, parameters: PaperParameters
) -> np.ndarray:
    """Return (W, K, 2) means of the dispersions of each frame of the windows and of the available looks before it."""
    before = np.maximum(frames[:, :, None] - interval * np.arange(looks), (frames - 1)[:, :, None] % interval + 1)
    flat = before.reshape(len(frames), -1)
    spread = measure_dispersions(sequence, flat, parameters.location_cut, histogram_cut(parameters))
    return spread.reshape(*before.shape, 2).mean(axis=2)


def _cut_links(windows: Windows, scale: float) -> float:
    """Return the share of true links whose histograms are more dissimilar than the threshold."""
    threshold, apart = PaperParameters().threshold, []
    for affinity, (newer, older) in zip(windows.appearance, windows.identities, strict=True):
        apart.append(scale * (1 - affinity[1:, 1:][newer[:, None] == older[None]]))
    return float((np.concatenate(apart) > threshold).mean())


def measure_dispersion(options: bench.Options) -> tuple[str, Any]:
    """Measure the dispersions of windows of two frames, the resulting weight, and AR_2 by it and by fixed weights."""
    rows, panels = [], []
    parameters = PaperParameters.model_validate({"window": 2})
    for name, sequence in open_sequences(options):
        windows = build_windows(sequence, 2, options.interval)
        chosen, ruled = choose_weights(windows, parameters), window_ratios(windows, parameters, None)
        fixed = np.stack([window_ratios(windows, parameters, weight) for weight in WEIGHTS])
        best = int(fixed.mean(axis=1).argmax())
        smallest = windows.dispersions.min(axis=1)
        spreads = [f"{v.mean():.2f} ({v.min():.2f} to {v.max():.2f})" for v in smallest.T]
        shares = " / ".join(f"{100 * (chosen == w).mean():.0f}" for w in (1.0, 0.5, 0.0))
        best_fixed = f"{mean_sd(fixed[best])} (w = {WEIGHTS[best]:g})"
        rows.append([name, *spreads, shares, mean_sd(ruled), best_fixed, mean_sd(fixed.max(axis=0))])
        frames = windows.frames[:, 0].tolist()
        lines = {"locations": smallest[:, 0], "histograms": smallest[:, 1], "weight": chosen}
        drawn = {label: {"x": frames, "y": values.tolist(), "style": "-"} for label, values in lines.items()}
        panels.append({"title": name, "xlabel": "frame", "ylabel": "dispersion; weight", "lines": drawn})
    bench.draw(options.plot, panels)
    head = ["sequence", "dispersion of locations", "of histograms", "windows at w = 1 / 0.5 / 0, %", "AR_2 by the rule"]
    return bench.format_table([*head, "best fixed weight", "each window's best weight"], rows), rows


def measure_cuts(options: bench.Options) -> tuple[str, Any]:
    """Measure AR_2 by the rule for cuts of the clusters of locations (rows) and histograms (columns)."""
    parts = []
    parameters = PaperParameters.model_validate({"window": 2})
    for name, sequence in open_sequences(options):
        windows, rows = build_windows(sequence, 2, options.interval), []
        for location_cut in LOCATION_CUTS:
            cuts = [cut / parameters.histogram_scale for cut in APPEARANCE_CUTS]
            spreads = [measure_dispersions(sequence, windows.frames, location_cut, cut) for cut in cuts]
            found = [window_ratios(replace(windows, dispersions=at), parameters, None) for at in spreads]
            rows.append([f"{location_cut:g}", *map(mean_sd, found)])
        head = [f"{name}: cut of locations", *(f"of histograms {cut:g}" for cut in APPEARANCE_CUTS)]
        parts.append(bench.format_table(head, rows))
    return "\n\n".join(parts), None


if __name__ == "__main__":
    common = {"data": Path, "--interval": 5, "--only": ""}
    studies = {
        "ratio": (measure_ratio, common | {"--tracker": ""}),
        "clusters": (measure_clusters, common | {"--plot": None}),
        "examples": (measure_examples, common | {"--plot": None}),
        "weight": (measure_weight, common | {"--every": 1, "--plot": None}),
        "threshold": (measure_threshold, common | {"--plot": None}),
        "dispersion": (measure_dispersion, common | {"--plot": None}),
        "scale": (measure_scale, common | {"--every": 1}),
        "readings": (measure_readings, common | {"--every": 1}),
        "cuts": (measure_cuts, common),
    }
    bench.main(__doc__, studies)
