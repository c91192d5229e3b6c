"""Identities on detections of known errors, ours beside other trackers: `python eval/peers/identities.py DATA`.

DATA holds sequences with true identities (MOTChallenge, Stanford Drone Dataset, CVML). Of every D-th frame
detections.py makes tables: true boxes, or with missing, moved and false ones; at an unknown rate the frames that are
looked at are numbered 1, 2, 3, ... Trackers get boxes and scores alone. What counts is the identity of each given row,
see row_scores.py; boxes that a tracker fills in or moves do not.

Ours runs at its defaults. Each peer runs at its own, and tuned: with that one of SETTINGS that has the best mean IDF1
on that very table over the very sequences that the figure is of. A setting with `times` tells the peer the true time of
each look; it is left out where the rate is unknown. Few switches say little beside a low IDF1: boxes without identity
cannot switch. Brackets hold 95 % of means over sequences drawn again.

Three or more sequences whose names agree up to the first "-" are a set; the others are one more. --keep-peers FILE
keeps what the peers got and reads it again as long as tables and settings are the same: after a change of our tracker
only ours runs. --write NAME.json writes a short table to NAME-short.json as well.
"""

import functools
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import bench
import clips
from detectors import DETECTORS, Looks, look
from jobs import Settings, Table, check_environments, run_timed, write_table
from kept_peers import KeptPeers, Run, checksum
from row_scores import Score, bounds_of_mean, score_rows

from torchvision_dddas.config import load_config
from torchvision_dddas.lab.evaluation.metrics.truth import TrackTable
from torchvision_dddas.tracking import track_table
from torchvision_dddas.types import DetectionTable

KINDS = ("motchallenge", "sdd", "cvml")
INTERVALS = (1, 5, 15, 30)
SHORT = ("true", "noisy")
OTHERS = "others"
AT_EVERY_FRAME = 2
"""So many of a peer's settings, the defaults first, are tried at interval 1, where looks are many; ARC-SORT's first."""

QUICK = {"minimum_consecutive_frames": 1}
EAGER = {"track_activation_threshold": 0.3, "high_conf_det_threshold": 0.3}
TIMES = {"times": True, "lost_track_buffer": 60}
WIDE = {"iou": ["BIoU", 0.5]}
GATE, TIGHTER = ({"minimum_iou_threshold": iou} for iou in (0.01, 0.1))
CASCADE = {"minimum_iou_threshold_first_assoc": 0.01, "minimum_iou_threshold_second_assoc": 0.1}


def around(gate: Settings, eager: Settings, wide: Settings, first: Settings) -> list[Settings]:
    """Quick confirmation with a looser gate; longer and shorter memory; low activation; wider boxes; true times."""
    loose = QUICK | gate
    choices: list[Settings] = [first, {"lost_track_buffer": 120}, {"lost_track_buffer": 3}, eager]
    choices += [wide | {"lost_track_buffer": 3}, TIMES, wide | TIMES]
    return [{}, *(loose | choice for choice in choices)]


SETTINGS: dict[str, list[Settings]] = {
    "SORT": around(GATE, {"track_activation_threshold": 0.6, "lost_track_buffer": 3}, WIDE, TIGHTER),
    "ByteTrack": around(GATE, EAGER, WIDE, TIGHTER),
    "OC-SORT": around(GATE, {"high_conf_det_threshold": 0.3}, WIDE, TIGHTER),
    "C-BIoU": around(CASCADE, EAGER, {"buffer_ratio_first": 0.5, "buffer_ratio_second": 0.7}, {}),
    "BoT-SORT": around(CASCADE, EAGER, WIDE, {}),
    "norfair": [
        {},
        {"distance_threshold": 0.99, "initialization_delay": 0},
        {"distance_threshold": 0.99, "initialization_delay": 1, "hit_counter_max": 60},
        {"distance_threshold": 0.99, "initialization_delay": 0, "hit_counter_max": 3},
        {"distance_threshold": 0.99, "initialization_delay": 1, "hit_counter_max": 3},
        {"distance_threshold": 0.99, "initialization_delay": 0, "hit_counter_max": 3, "least_score": 0.5},
        {"distance_threshold": 0.99, "initialization_delay": 1, "hit_counter_max": 60, "times": True},
    ],
    "ARC-SORT": [
        {},
        {"min_hits": 1, "match_thresh": 0.05, "byte_match_thresh": 0.1, "track_buffer": 3},
        {"min_hits": 1, "match_thresh": 0.01, "byte_match_thresh": 0.01, "track_buffer": 3}
        | {"eiou": {"adaptive_scale": 3.0, "max_expansion": 3.0}},
    ],
}


@dataclass(frozen=True)
class Clip:
    """A sequence's truth, the number of its last frame, and width and height of what its boxes cover."""

    name: str
    truth: TrackTable
    length: int
    size: tuple[float, float]

    def look(self, condition: str, interval: int) -> Looks:
        """The table of a made-up detector."""
        return look(self.name, self.truth, self.length, self.size, interval, DETECTORS[condition])


@functools.cache
def read(data: Path) -> dict[str, Clip]:
    """The sequences by name."""
    found = {}
    for clip in clips.identified_clips(data, KINDS):
        assert clip.truth is not None and clip.truth.tracks is not None
        table = clip.truth.tracks
        width, height = (table.box_px[:, :2] + table.box_px[:, 2:]).max(axis=0).tolist()
        found[clip.name] = Clip(clip.name, table, clip.frames or int(table.frame.max()), (width, height))
    return dict(sorted(found.items())) or sys.exit(f"{data} holds no sequences with identities; nothing was measured")


def group(names: Sequence[str]) -> dict[str, list[str]]:
    """The names of each set, the largest set first."""
    by_word: dict[str, list[str]] = {}
    for name in names:
        by_word.setdefault(name.partition("-")[0], []).append(name)
    sets = {word: found for word, found in by_word.items() if len(found) >= 3}
    if others := [name for name in names if not any(name in found for found in sets.values())]:
        sets[OTHERS] = others
    return dict(sorted(sets.items(), key=lambda item: -len(item[1])))


# -- running -----------------------------------------------------------------------------------------------------------


def run_peers(
    sequences: Mapping[str, Clip], condition: str, interval: int, peers: Sequence[str], kept: KeptPeers
) -> None:
    """Have the peers track a table of all sequences, those that have not yet."""
    looks = [sequence.look(condition, interval) for sequence in sequences.values()]
    tables: list[Table] = []
    with tempfile.TemporaryDirectory() as place:
        for peer in peers:
            settings = settings_of(peer, interval)
            key = checksum(looks, settings)
            if kept.has(condition, interval, peer, key):
                continue
            if not tables:
                tables = [Table(Path(place, f"boxes-{n}.txt"), g.interval, g.length) for n, g in enumerate(looks)]
                for table, given in zip(tables, looks, strict=True):
                    write_table(table.file, given.table, given.score)
            runs = []
            for tried, found in zip(settings, run_timed(peer, settings, tables, Path(place)), strict=True):
                scores = [scored(given, *result) for given, result in zip(looks, found, strict=True)]
                runs.append(Run(tried, dict(zip(sequences, scores, strict=True))))
            kept.add(condition, interval, peer, key, runs)
            bench.log(condition, interval, peer, *(f"{np.mean([s.idf1 for s in r.scores.values()]):.1f}" for r in runs))


def settings_of(peer: str, interval: int) -> list[Settings]:
    """What is tried at an interval, the defaults first."""
    few = 1 if peer == "ARC-SORT" else AT_EVERY_FRAME
    return SETTINGS[peer][: few if interval == 1 else None]


def scored(given: Looks, identity: np.ndarray, seconds: float) -> Score:
    idf1, switches = score_rows(given.table.identity, identity)
    return Score(idf1, switches, 1e3 * seconds / len(range(1, given.length + 1, given.interval)))


def run_ours(case: Sequence) -> tuple[float, int, float]:
    """Score of our tracker at its defaults. case: the data's folder, the sequence's name, condition and interval."""
    data, name, condition, interval = case
    given = read(Path(data))[name].look(condition, interval)
    count = len(given.score)
    table = DetectionTable(name, given.table.frame, given.table.box_px, given.score, np.arange(count))
    identity = np.zeros(count, int)
    begun = time.process_time()
    for frame in track_table(table, load_config(), given.interval):
        tracks = frame.tracks
        own = tracks.row >= 0  # the others are filled in
        first = int(np.searchsorted(given.table.frame, frame.number))
        identity[first + tracks.row[own]] = tracks.identity[own]
    found = scored(given, identity, time.process_time() - begun)
    return found.idf1, found.switches, found.ms


# -- the study ---------------------------------------------------------------------------------------------------------


def compare(options: bench.Options) -> tuple[str, Any]:
    """Run peers and ours on all tables."""
    check_environments()
    sequences = read(options.data)
    sets = group(list(sequences))
    kept = KeptPeers(options.keep_peers, sets)
    known_rate = list(dict.fromkeys(at_known_rate(condition) for condition in options.conditions))
    for interval in sorted(options.intervals, reverse=True):
        for condition in known_rate:
            run_peers(sequences, condition, interval, options.peers, kept)
    tables = [
        (condition, interval)
        for condition in options.conditions
        for interval in options.intervals
        if interval > 1 or not DETECTORS[condition].renumbered
    ]
    cases = [[str(options.data), name, *table] for table in tables for name in sequences]
    found = iter(bench.run_cases(cases, run_ours, options.jobs))
    ours = {table: Run({}, {name: Score(*next(found)) for name in sequences}) for table in tables}
    rows = {
        of: [row_of(kept, options.peers, table, ours[table], names, of) for table in tables]
        for of, names in sets.items()
    }
    if options.write:
        short = [row for row in next(iter(rows.values())) if row["detections"] in SHORT]
        text = f"IDF1 in percent and switches, {sentence(*next(iter(sets.items())))}\n\n{format_rows(short)}"
        bench.write_result(options.write.with_stem(options.write.stem + "-short"), text, None)
    parts = [f"{sentence(of, names)}\n\n{format_rows(rows[of])}" for of, names in sets.items()]
    parts += [format_each(kept, options.peers, ours, *next(iter(sets.items())), condition) for condition in SHORT]
    parts += [format_speed(kept, options.peers, ours)]
    return "\n\n".join(part for part in parts if part), rows


def at_known_rate(condition: str) -> str:
    """The condition of the same boxes with the true numbers of their frames, which is all that peers differ by."""
    wanted = replace(DETECTORS[condition], renumbered=False)
    return next(name for name, detector in DETECTORS.items() if detector == wanted)


def row_of(
    kept: KeptPeers, peers: Sequence[str], table: tuple[str, int], ours: Run, names: Sequence[str], of: str
) -> dict[str, Any]:
    """Means and switches over a set, with their intervals."""
    condition, every = table
    known, mine = at_known_rate(condition), ours.idf1(names)
    plain = {peer: kept.defaults(known, every, peer) for peer in peers}
    tuned = {peer: kept.tuned(known, every, peer, of, times=condition == known) for peer in peers}
    row: dict[str, Any] = {"detections": condition, "every": every, "ours": float(mine.mean())}
    row |= {"switches": ours.switches(names), "bounds": bounds_of_mean(mine)}
    for label, runs in (("defaults", plain), ("tuned", tuned)):
        best = max(runs, key=lambda peer: float(runs[peer].idf1(names).mean()))
        theirs = runs[best].idf1(names)
        row[label] = {"peer": best, "idf1": float(theirs.mean()), "switches": runs[best].switches(names)}
        row[label] |= {"gain": float((mine - theirs).mean()), "bounds": bounds_of_mean(mine - theirs)}
    return row


# -- words -------------------------------------------------------------------------------------------------------------


def sentence(of: str, names: Sequence[str]) -> str:
    """What a set is."""
    return f"{of}, {len(names)} sequences" + (f" ({', '.join(names)}):" if of == OTHERS else ":")


def format_rows(rows: Sequence[dict[str, Any]]) -> str:
    """The table of a set."""
    head = ["detections", "every", "ours", "best peer, defaults", "best peer, tuned", "ours − tuned"]
    cells = []
    for row in rows:
        low, high = row["bounds"]
        line = [row["detections"], str(row["every"]), f"{row['ours']:.1f} ({row['switches']}) [{low:.1f}, {high:.1f}]"]
        line += [f"{b['idf1']:.1f} ({b['switches']}) {b['peer']}" for b in (row["defaults"], row["tuned"])]
        gain, (low, high) = row["tuned"]["gain"], row["tuned"]["bounds"]
        lost = ", **lost**" if gain < 0 else ""
        cells.append([*line, f"{gain:+.1f} [{low:+.1f}, {high:+.1f}]{lost}"])
    return bench.format_table(head, cells)


def format_each(
    kept: KeptPeers, peers: Sequence[str], ours: Mapping[tuple, Run], of: str, names: Sequence[str], condition: str
) -> str:
    """IDF1 of every tracker in one condition on one set."""
    intervals = [every for known, every in ours if known == condition]
    if not intervals:
        return ""
    cells = []
    for peer in peers:
        runs = [(kept.defaults(condition, n, peer), kept.tuned(condition, n, peer, of, times=True)) for n in intervals]
        cells.append([peer, *(" / ".join(f"{run.idf1(names).mean():.1f}" for run in pair) for pair in runs)])
    cells.append(["ours", *(f"{ours[condition, n].idf1(names).mean():.1f}" for n in intervals)])
    table = bench.format_table(["tracker", *(f"every {n}" for n in intervals)], cells)
    return f"All trackers, {of}, {condition}: IDF1 at the defaults / tuned.\n\n{table}"


def format_speed(kept: KeptPeers, peers: Sequence[str], ours: Mapping[tuple, Run]) -> str:
    """Processor time of a look at the defaults."""
    condition = next(iter(ours))[0]
    condition = SHORT[-1] if any(known == SHORT[-1] for known, _ in ours) else condition
    intervals = [every for known, every in ours if known == condition]
    runs = {peer: [kept.defaults(condition, n, peer) for n in intervals] for peer in peers}
    runs["ours"] = [ours[condition, n] for n in intervals]
    cells = [[name, *(f"{run.median_ms:.2f}" for run in of)] for name, of in runs.items()]
    table = bench.format_table(["tracker", *(f"every {n}" for n in intervals)], cells)
    return f"Processor milliseconds a look at the defaults, {condition}, median over all sequences.\n\n{table}"


if __name__ == "__main__":
    options = {"data": Path, "--conditions": list(DETECTORS), "--intervals": list(INTERVALS), "--peers": list(SETTINGS)}
    bench.main(__doc__, {"": (compare, options | {"--keep-peers": None, "--jobs": 1})})
