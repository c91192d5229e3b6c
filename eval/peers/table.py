"""Our tracker beside SORT, ByteTrack, OC-SORT and norfair: `python eval/peers/table.py DATA`, after `make peers`.

DATA holds MOTChallenge 2015 sequences: NAME/gt/gt.txt, NAME/det/det.txt, an optional NAME/*.mp4. Two studies:
true boxes at an interval (identities stripped, rows shuffled within a frame; switches and IDF1, matched at an IoU of
0.9, which only the box itself reaches), and detections at interval 1 (HOTA, MOTA, IDF1, switches, all sequences
pooled). Each peer runs at its defaults and with thresholds tuned for that very study over BOXES or DETECTIONS below, on
the sequences that the figures are of: the peers get every advantage; ours runs as it is. Few switches say little beside
a low IDF1: a tracker that confirms late or loses its targets leaves boxes without identity, and those cannot switch.
"""

import itertools
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import bench
from clips import sequences

from torchvision_dddas.evaluation.datasets import motchallenge
from torchvision_dddas.evaluation.metrics import tracking, truth
from torchvision_dddas.evaluation.metrics import truth as truths
from torchvision_dddas.evaluation.metrics.matching import pair
from torchvision_dddas.evaluation.metrics.pixels import add_counts
from torchvision_dddas.evaluation.metrics.tracking import TrackCounts
from torchvision_dddas.evaluation.metrics.truth import TrackTable

ROOT = Path(__file__).resolve().parents[2]
TRACKERS, NORFAIR = ROOT / ".venv-peers/bin/python", ROOT / ".venv-norfair/bin/python"
SAME = 0.9

Settings = dict[str, Any]

# Around each tracker's defaults and towards looser gates, shorter confirmation and longer memory.
GATES = {"minimum_iou_threshold": [0.01, 0.1, 0.3]}
BOXES: dict[str, dict[str, list]] = {
    "SORT": GATES | {"lost_track_buffer": [3, 30], "minimum_consecutive_frames": [1, 3]},
    "ByteTrack": GATES | {"lost_track_buffer": [3, 30], "minimum_consecutive_frames": [1, 2]},
    "OC-SORT": GATES | {"minimum_consecutive_frames": [1, 3], "direction_consistency_weight": [0.0, 0.2]},
    "norfair": {"distance_threshold": [0.7, 0.9, 0.99], "hit_counter_max": [3, 15], "initialization_delay": [0, 1]},
}
DETECTIONS: dict[str, dict[str, list]] = {
    "SORT": {"least_score": [0.0, 0.7, 0.8, 0.9], "track_activation_threshold": [0.25, 0.9]}
    | {"minimum_iou_threshold": [0.2, 0.3], "minimum_consecutive_frames": [2, 3]},
    "ByteTrack": {"least_score": [0.0, 0.7, 0.8], "track_activation_threshold": [0.7, 0.9]}
    | {"high_conf_det_threshold": [0.6, 0.8], "minimum_iou_threshold": [0.1, 0.2]},
    "OC-SORT": {"high_conf_det_threshold": [0.6, 0.7, 0.8, 0.9], "minimum_iou_threshold": [0.1, 0.3]}
    | {"lost_track_buffer": [30, 60]},
    "norfair": {"least_score": [0.0, 0.7, 0.8, 0.9], "distance_threshold": [0.7, 0.9]}
    | {"hit_counter_max": [8, 15], "initialization_delay": [1, 3]},
}


@dataclass(frozen=True)
class Sequence:
    """A sequence of DATA. clip: its video, if it has one. detections: a file with scores in [0, 1], if it has one."""

    name: str
    truth: truths.Truth
    length: int
    clip: Path | None
    detections: Path | None


def compare(options: bench.Options) -> tuple[str, Any]:
    """Run the studies asked for and print the tables."""
    sequences = read(options.data)
    for python in (TRACKERS, NORFAIR):
        if not python.exists():
            sys.exit(f"{python} is missing; run make peers first")
    studies = {"boxes": on_boxes, "detections": on_detections, "speed": on_speed}
    figures = {study: studies[study](sequences, options.peers) for study in options.studies}
    return markdown(figures), figures


def read(data: Path) -> list[Sequence]:
    """The sequences, as long as seqinfo.ini says, or as their truth where there is none."""
    found = []
    for clip in map(motchallenge.sequence, sequences(data)):
        scores = truth.read_rows(clip.given, "detections").mark if clip.given else np.full(1, np.nan)
        probable = bool(((scores >= 0) & (scores <= 1)).all())
        film = clip.pictures[0] if len(clip.pictures) == 1 else None
        assert clip.truth is not None
        found.append(Sequence(clip.name, clip.truth, clip.frames, film, clip.given if probable else None))
    return found


# -- running -----------------------------------------------------------------------------------------------------------


def run_peer(
    peer: str, tried: list[Settings], files: list[tuple[Path, int]], interval: int, folder: Path
) -> list[list[TrackTable]]:
    """Tracks that a peer makes under each of its settings of each file of boxes, (file, frames of its clip)."""
    jobs = [
        {"tracker": peer, "settings": settings, "boxes": str(file), "interval": interval, "length": length}
        | {"out": str(folder / f"{k}-{i}.txt")}
        for k, settings in enumerate(tried)
        for i, (file, length) in enumerate(files)
    ]
    seconds_of(peer, jobs, folder)
    return [
        [truth.read_rows(folder / f"{k}-{i}.txt", "tracks").table for i in range(len(files))] for k in range(len(tried))
    ]


def seconds_of(peer: str, jobs: list[dict], folder: Path) -> list[float]:
    (folder / "jobs.json").write_text(json.dumps(jobs))
    python, script = (NORFAIR, "run_norfair.py") if peer == "norfair" else (TRACKERS, "run_trackers.py")
    words = [str(python), str(Path(__file__).with_name(script)), str(folder / "jobs.json")]
    return json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout)


def run_ours(boxes: Path, interval: int, folder: Path, clip: Path | None = None) -> TrackTable:
    """Tracks that `dddas track` makes of a file of boxes, with the clip or without."""
    words = ["-c", "from torchvision_dddas.cli import main; main()", "track", *([str(clip)] if clip else [])]
    words += ["--detections", str(boxes), "--interval", str(interval), "--out", str(folder / "ours"), "--quiet"]
    subprocess.run([sys.executable, *words, *(["--save", "none"] if clip else [])], check=True)
    return truth.read_rows(folder / "ours/tracks.txt", "tracks").table


def grid(choices: dict[str, list]) -> Iterable[Settings]:
    for values in itertools.product(*choices.values()):
        yield dict(zip(choices, values, strict=True))


# -- true boxes --------------------------------------------------------------------------------------------------------


def on_boxes(sequences: list[Sequence], peers: list[str]) -> dict:
    """{interval: {tracker: {"settings": ..., "clips": {name: [switches, IDF1]}}}}: IDF1 in percent."""
    figures: dict = {}
    for interval in (1, 5, 10, 15):
        chosen = sequences if interval < 10 else [s for s in sequences if s.clip]
        rows: dict = {}
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            files = [(stripped(s, interval, folder), s.length) for s in chosen]
            for peer in peers:
                choices = [{}, *grid(BOXES[peer])]
                tried = [
                    {"settings": settings, "clips": by_clip(chosen, tracks, interval)}
                    for settings, tracks in zip(choices, run_peer(peer, choices, files, interval, folder), strict=True)
                ]
                rows[f"{peer}, defaults"] = tried[0]
                rows[f"{peer}, tuned"] = max(tried, key=mean_idf1)
                say(interval, peer, rows)
            tracks = [run_ours(file, interval, folder) for file, _ in files]
            rows["ours"] = {"settings": {}, "clips": by_clip(chosen, tracks, interval)}
            filmed = [(s, f) for s, (f, _) in zip(chosen, files, strict=True) if s.clip]
            tracks = [run_ours(file, interval, folder, s.clip) for s, file in filmed]
            rows["ours, with the clip"] = {"settings": {}, "clips": by_clip([s for s, _ in filmed], tracks, interval)}
            say(interval, "ours", rows)
        figures[str(interval)] = rows
    return figures


def stripped(sequence: Sequence, interval: int, folder: Path) -> Path:
    """The true boxes of every interval-th frame without identities, shuffled within a frame."""
    assert sequence.truth.tracks is not None
    table = sequence.truth.tracks.every(interval)
    order = np.random.default_rng(7).permutation(len(table.frame))
    table = table.at(order[np.argsort(table.frame[order], kind="stable")])
    blank = -np.ones(len(order))
    path = folder / f"{sequence.name}-boxes.txt"
    np.savetxt(path, np.c_[table.frame, blank, table.box_px, -blank, blank, blank, blank], delimiter=",", fmt="%.10g")
    return path


def by_clip(sequences: list[Sequence], tracks: list[TrackTable], interval: int) -> dict[str, list[float]]:
    """Switches, and IDF1 in percent, of each sequence."""
    scores = {}
    for sequence, found in zip(sequences, tracks, strict=True):
        assert sequence.truth.tracks is not None
        clip = pair(sequence.truth.tracks.every(interval), found)
        idf1 = tracking.identity_measures(tracking.count_identity(clip, SAME))["idf1"]
        scores[sequence.name] = [tracking.count_clear(clip, SAME)[0].switches, 100 * idf1]
    return scores


def mean_idf1(row: dict) -> float:
    return float(np.mean([idf1 for _, idf1 in row["clips"].values()]))


def say(interval: int, peer: str, rows: dict) -> None:
    for name, row in rows.items():
        if name.startswith(peer):
            print(f"D={interval} {name}: {mean_idf1(row):.1f} {row['settings']}", file=sys.stderr, flush=True)


# -- detections --------------------------------------------------------------------------------------------------------


def on_detections(sequences: list[Sequence], peers: list[str]) -> dict:
    """{tracker: {"settings": ..., HOTA and the other measures of all sequences pooled, "clips": {name: ...}}}."""
    chosen = [s for s in sequences if s.detections]
    files = [(s.detections, s.length) for s in chosen if s.detections]
    rows = {}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for peer in peers:
            choices = [{}, *grid(DETECTIONS[peer])]
            tried = [
                {"settings": settings, **pooled(chosen, tracks)}
                for settings, tracks in zip(choices, run_peer(peer, choices, files, 1, folder), strict=True)
            ]
            rows[f"{peer}, defaults"], rows[f"{peer}, tuned"] = tried[0], max(tried, key=lambda row: row["hota"])
            for name in (f"{peer}, defaults", f"{peer}, tuned"):
                print(name, f"HOTA {rows[name]['hota']:.4f}", rows[name]["settings"], file=sys.stderr, flush=True)
        rows["ours"] = {"settings": {}, **pooled(chosen, [run_ours(file, 1, folder) for file, _ in files])}
    return rows


def pooled(sequences: list[Sequence], tracks: list[TrackTable]) -> dict:
    clips, total = {}, TrackCounts()
    for sequence, found in zip(sequences, tracks, strict=True):
        assert sequence.truth.tracks is not None
        clip = pair(sequence.truth.tracks, found)
        counts = TrackCounts(tracking.count_clear(clip)[0], tracking.count_identity(clip), tracking.count_hota(clip))
        clips[sequence.name] = figures_of(counts)
        total = add_counts(total, counts)
    return {**figures_of(total), "clips": clips}


def figures_of(counts: TrackCounts) -> dict[str, float]:
    kept = ("hota", "deta", "assa", "mota", "idf1")
    return {k: v for k, v in tracking.measures(counts).items() if k in kept} | {"switches": counts.clear.switches}


# -- speed -------------------------------------------------------------------------------------------------------------


def on_speed(sequences: list[Sequence], peers: list[str], turns: int = 5) -> dict[str, float]:
    """Frames a second on PETS09-S2L1's detections at interval 1, reading and writing left out: medians over turns."""
    sequence = next(s for s in sequences if s.detections and "S2L1" in s.name)
    seconds: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as place:
        job = {"settings": {}, "boxes": str(sequence.detections), "interval": 1, "length": sequence.length, "out": None}
        for _ in range(turns):
            for peer in peers:
                seconds.setdefault(peer, []).append(seconds_of(peer, [job | {"tracker": peer}], Path(place))[0])
            seconds.setdefault("ours", []).append(our_seconds(sequence))
    return {name: sequence.length / float(np.median(s)) for name, s in seconds.items()}


def our_seconds(sequence: Sequence) -> float:
    """Time of our tracker in a fresh process, as the peers have it."""
    program = (
        "import sys, time\n"
        "from torchvision_dddas.config import load_config\n"
        "from torchvision_dddas.io.detection_tables import read_detections\n"
        "from torchvision_dddas.tracking import Tracker\n"
        "table, tracker = read_detections(sys.argv[1]), Tracker(load_config())\n"
        "given = [table.at(f) for f in range(1, int(sys.argv[2]) + 1)]\n"
        "begun = time.perf_counter()\n"
        "for f, detections in enumerate(given, 1): tracker.update(detections)\n"
        "tracker.flush()\n"
        "print(time.perf_counter() - begun)"
    )
    words = [sys.executable, "-c", program, str(sequence.detections), str(sequence.length)]
    return float(subprocess.run(words, check=True, capture_output=True, text=True).stdout)


# -- words -------------------------------------------------------------------------------------------------------------


def markdown(figures: dict) -> str:
    lines: list[str] = []
    for interval, rows in figures.get("boxes", {}).items():
        clips = first(rows)
        lines += [f"True boxes at an interval of {interval}: switches / IDF1 in percent.", ""]
        lines += ["| tracker | sum / mean | " + " | ".join(clips) + " |", "| --- |" + " ---: |" * (len(clips) + 1)]
        for name, row in rows.items():
            total = sum(switches for switches, _ in row["clips"].values())
            cells = [f"{row['clips'][c][0]} / {row['clips'][c][1]:.1f}" if c in row["clips"] else "–" for c in clips]
            mean = f"{total} / {mean_idf1(row):.1f}" if len(row["clips"]) == len(clips) else "–"
            lines.append(f"| {name} | {mean} | " + " | ".join(cells) + " |")
        lines.append("")
    lines += others(figures)
    if tuned := settings_of(figures):
        lines += ["Tuned settings:", "", *tuned]
    return "\n".join(lines)


def first(rows: dict) -> dict:
    """The clips of a study: those of its first row."""
    return next(iter(rows.values()))["clips"]


def others(figures: dict) -> list[str]:
    """Detections and speed."""
    lines: list[str] = []
    if rows := figures.get("detections", {}):
        cells = [
            [name, *(f"{100 * row[k]:.1f}" for k in ("hota", "deta", "assa", "mota", "idf1")), row["switches"]]
            for name, row in rows.items()
        ]
        lines += [f"Detections of {len(rows['ours']['clips'])} sequences at interval 1, pooled; in percent.", ""]
        lines += [bench.format_table(["tracker", "HOTA", "DetA", "AssA", "MOTA", "IDF1", "switches"], cells), ""]
    if figures.get("speed"):
        speeds = ", ".join(f"{name} {round(s, -1):.0f}" for name, s in figures["speed"].items())
        lines += [f"Frames a second on the detections of PETS09-S2L1, one process each, medians: {speeds}.", ""]
    return lines


def settings_of(figures: dict) -> list[str]:
    studies = {f"true boxes at {i}": rows for i, rows in figures.get("boxes", {}).items()}
    studies |= {"detections": figures["detections"]} if figures.get("detections") else {}
    lines = []
    for study, rows in studies.items():
        for name, row in rows.items():
            if name.endswith(", tuned"):
                words = ", ".join(f"{k} {v}" for k, v in row["settings"].items()) or "the defaults"
                lines.append(f"- {study}, {name.removesuffix(', tuned')}: {words}")
    return lines


if __name__ == "__main__":
    options = {"data": Path, "--studies": ["boxes", "detections", "speed"], "--peers": list(BOXES)}
    bench.main(__doc__, {"": (compare, options)})
