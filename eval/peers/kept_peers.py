"""What the peers got on tables of detections, kept in a file so that they need not run again.

By table and peer: the run at its defaults, and for each set of sequences the best run of all settings, and the best of
those that do not know the times of looks, if that is another. Scores are text to keep the file short: IDF1/switches/ms
of each sequence.
"""

import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bench
import numpy as np
from detectors import Looks
from jobs import Settings
from row_scores import Score


@dataclass(frozen=True)
class Run:
    """A tracker with its settings on one table of each sequence: scores by name."""

    settings: Settings
    scores: Mapping[str, Score]

    def idf1(self, names: Sequence[str]) -> np.ndarray:
        """(names,) in percent."""
        return np.array([self.scores[name].idf1 for name in names])

    def switches(self, names: Sequence[str]) -> int:
        """Their sum."""
        return sum(self.scores[name].switches for name in names)

    @property
    def median_ms(self) -> float:
        """Of a look, over all sequences."""
        return float(np.median([score.ms for score in self.scores.values()]))


def checksum(looks: Iterable[Looks], settings: Sequence[Settings]) -> int:
    """Differs where the tables or the settings that are tried do."""
    key = zlib.crc32(json.dumps(settings, sort_keys=True).encode())
    for given in looks:
        for part in (given.table.frame, given.table.box_px.round(4), given.score.round(6), np.array([given.length])):
            key = zlib.crc32(np.ascontiguousarray(part).tobytes(), key)
    return key


class KeptPeers:
    """Runs of peers by condition, interval and peer, for these sets of sequences; written after every addition."""

    def __init__(self, path: str | Path | None, sets: Mapping[str, Sequence[str]]) -> None:
        self.path, self.sets = Path(path) if path else None, dict(sets)
        self.names = [name for names in sets.values() for name in names]
        self.found: dict[str, dict[str, Any]] = {}
        if self.path and self.path.exists():
            figures = json.loads(self.path.read_text(encoding="utf-8"))["figures"]
            self.found = figures["tables"] if figures["sets"] == self.sets else {}

    def has(self, condition: str, interval: int, peer: str, key: int) -> bool:
        """Whether these very runs are kept."""
        return self.found.get(table_name(condition, interval), {}).get(peer, {}).get("checksum") == key

    def add(self, condition: str, interval: int, peer: str, key: int, runs: Sequence[Run]) -> None:
        """Keep the best of the runs of one peer, the first of which is at its defaults."""
        entry: dict[str, Any] = {"checksum": key, "defaults": _packed(runs[0], self.names), "tuned": {}, "untimed": {}}
        untimed = [run for run in runs if "times" not in run.settings]
        for of, names in self.sets.items():
            best, second = (max(choice, key=lambda run, n=names: run.idf1(n).mean()) for choice in (runs, untimed))
            entry["tuned"][of] = _packed(best, names)
            if second is not best:
                entry["untimed"][of] = _packed(second, names)
        self.found.setdefault(table_name(condition, interval), {})[peer] = entry
        if self.path:
            bench.write_result(self.path, "", {"sets": self.sets, "tables": self.found})

    def defaults(self, condition: str, interval: int, peer: str) -> Run:
        """The run at the peer's defaults on all sequences."""
        return _unpacked(self.found[table_name(condition, interval)][peer]["defaults"], self.names)

    def tuned(self, condition: str, interval: int, peer: str, of: str, times: bool) -> Run:
        """The best run on a set, among those that know the times of looks or among the others alone."""
        entry = self.found[table_name(condition, interval)][peer]
        return _unpacked((not times and entry["untimed"].get(of)) or entry["tuned"][of], self.sets[of])


def table_name(condition: str, interval: int) -> str:
    """How the file names a table."""
    return f"{condition}, every {interval}"


def _packed(run: Run, names: Sequence[str]) -> dict[str, Any]:
    scores = (run.scores[name] for name in names)
    return {"settings": run.settings, "scores": " ".join(f"{s.idf1:.2f}/{s.switches}/{s.ms:.2f}" for s in scores)}


def _unpacked(packed: Mapping[str, Any], names: Sequence[str]) -> Run:
    cells = [cell.split("/") for cell in packed["scores"].split()]
    scores = [Score(float(idf1), int(switches), float(ms)) for idf1, switches, ms in cells]
    return Run(packed["settings"], dict(zip(names, scores, strict=True)))
