"""Detections of real detectors, ours beside SORT, ByteTrack, OC-SORT and norfair: `python eval/peers/table.py DATA`.

DATA holds MOTChallenge 2015 sequences: NAME/gt/gt.txt and NAME/det/det.txt. Detections at interval 1: HOTA, MOTA, IDF1
and switches, all sequences pooled. Each peer runs at its defaults and with thresholds tuned for that very study over
DETECTIONS below, on the sequences that the figures are of: the peers get every advantage; ours runs as it is. Boxes
made from the truth, and more peers, are in identities.py.
"""

import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import bench
from clips import sequences
from jobs import Table, check_environments, grid, job, run_jobs, run_peer

from torchvision_dddas.lab.evaluation.datasets import motchallenge
from torchvision_dddas.lab.evaluation.metrics import tracking, truth
from torchvision_dddas.lab.evaluation.metrics.matching import pair
from torchvision_dddas.lab.evaluation.metrics.pixels import add_counts
from torchvision_dddas.lab.evaluation.metrics.tracking import TrackCounts
from torchvision_dddas.lab.evaluation.metrics.truth import TrackTable

# Around each tracker's defaults and towards looser gates, shorter confirmation and longer memory.
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
    """A sequence of DATA. detections: a file with scores in [0, 1], if it has one."""

    name: str
    truth: truth.ClipTruth
    length: int
    detections: Path | None


def compare(options: bench.Options) -> tuple[str, Any]:
    """Run the studies asked for and print the tables."""
    check_environments()
    sequences = read(options.data)
    studies = {"detections": on_detections, "speed": on_speed}
    figures = {study: studies[study](sequences, options.peers) for study in options.studies}
    return markdown(figures), figures


def read(data: Path) -> list[Sequence]:
    """The sequences, as long as seqinfo.ini says, or as their truth where there is none."""
    found = []
    for clip in map(motchallenge.sequence, sequences(data)):
        scores = truth.read_rows(clip.given, "detections").mark if clip.given else np.full(1, np.nan)
        probable = bool(((scores >= 0) & (scores <= 1)).all())
        assert clip.truth is not None
        found.append(Sequence(clip.name, clip.truth, clip.frames, clip.given if probable else None))
    return found


# -- detections --------------------------------------------------------------------------------------------------------


def on_detections(sequences: list[Sequence], peers: list[str]) -> dict:
    """{tracker: {"settings": ..., HOTA and the other measures of all sequences pooled, "clips": {name: ...}}}."""
    chosen = [s for s in sequences if s.detections]
    tables = [Table(s.detections, 1, s.length) for s in chosen if s.detections]
    given = [np.loadtxt(table.file, delimiter=",") for table in tables]
    rows = {}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for peer in peers:
            choices = [{}, *grid(DETECTIONS[peer])]
            tried = []
            for settings, found in zip(choices, run_peer(peer, choices, tables, folder), strict=True):
                tracks = [named(boxes, identity) for boxes, identity in zip(given, found, strict=True)]
                tried.append({"settings": settings, **pooled(chosen, tracks)})
            rows[f"{peer}, defaults"], rows[f"{peer}, tuned"] = tried[0], max(tried, key=lambda row: row["hota"])
            for name in (f"{peer}, defaults", f"{peer}, tuned"):
                bench.log(name, f"HOTA {rows[name]['hota']:.4f}", rows[name]["settings"])
        rows["ours"] = {"settings": {}, **pooled(chosen, [run_ours(table.file, folder) for table in tables])}
    return rows


def named(boxes: np.ndarray, identity: np.ndarray) -> TrackTable:
    """The tracks of the rows that have an identity."""
    return TrackTable.of(boxes[:, 0], identity, boxes[:, 2:6]).at(identity > 0)


def run_ours(boxes: Path, folder: Path) -> TrackTable:
    """Tracks that `dddas track` makes of a file of boxes."""
    words = ["-c", "from torchvision_dddas.cli import main; main()", "track", "--detections", str(boxes)]
    subprocess.run([sys.executable, *words, "--interval", "1", "--out", str(folder / "ours"), "--quiet"], check=True)
    return truth.read_rows(folder / "ours/tracks.txt", "tracks").table


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
    """Frames a processor second on PETS09-S2L1 at interval 1, without reading and writing: medians over turns."""
    sequence = next(s for s in sequences if s.detections and "S2L1" in s.name)
    assert sequence.detections is not None
    table = Table(sequence.detections, 1, sequence.length)
    seconds: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as place:
        for _ in range(turns):
            for peer in peers:
                seconds.setdefault(peer, []).extend(run_jobs(peer, [job(peer, {}, table, None)], Path(place)))
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
        "begun = time.process_time()\n"
        "for f, detections in enumerate(given, 1): tracker.update(detections)\n"
        "tracker.flush()\n"
        "print(time.process_time() - begun)"
    )
    words = [sys.executable, "-c", program, str(sequence.detections), str(sequence.length)]
    return float(subprocess.run(words, check=True, capture_output=True, text=True).stdout)


# -- words -------------------------------------------------------------------------------------------------------------


def markdown(figures: dict) -> str:
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
        lines += [f"Frames a processor second on the detections of PETS09-S2L1, medians: {speeds}.", ""]
    return "\n".join(lines)


if __name__ == "__main__":
    options = {"data": Path, "--studies": ["detections", "speed"], "--peers": list(DETECTIONS)}
    bench.main(__doc__, {"": (compare, options)})
