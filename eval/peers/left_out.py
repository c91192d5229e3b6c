"""What constants of ours get on sequences that had no part in choosing them: `python eval/peers/left_out.py DATA`.

SETTINGS moves one constant of the default tracker at a time. For each sequence that setting is chosen which has the
best mean IDF1 on all the others, over true and noisy boxes together; sets count the same, however many sequences they
have. The figure that counts is that of the sequence left out. --cache FILE keeps finished cases.
"""

import functools
import itertools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import bench
from detectors import FALSE
from identities import group, read
from row_scores import score_rows

from torchvision_dddas.config import load_config
from torchvision_dddas.tracking import track_table
from torchvision_dddas.types import DetectionTable

TABLES = [("true", 1), ("true", 5), ("true", 15), ("true", 30), ("noisy", 1), ("noisy", 5), ("noisy", 15)]
MOVED: dict[str, tuple[float, ...]] = {
    "doubt": (4.0, 16.0),
    "wander": (0.2, 0.45),
    "scatter": (0.04, 0.09),
    "size_scatter": (0.07, 0.15),
    "crossing": (0.1, 0.4),
    "hiding": (0.6, 0.85),
}
SETTINGS: list[dict[str, float]] = [{}, *({name: value} for name, values in MOVED.items() for value in values)]


def score_of(case: Sequence) -> float:
    """IDF1 in percent of ours. case: the data's folder, sequence, condition, interval, setting and most rows."""
    data, name, condition, interval, setting, most = case
    given = _read(data)[name].look(condition, interval)
    frame = given.table.frame
    rows = len(frame) if len(frame) <= most else int(np.searchsorted(frame, frame[most]))
    table = DetectionTable(name, frame[:rows], given.table.box_px[:rows], given.score[:rows], np.arange(rows))
    settings = load_config(overrides=[f"track.{key}={value}" for key, value in setting.items()])
    identity = np.zeros(rows, int)
    for looked in track_table(table, settings, given.interval):
        own = looked.tracks.row >= 0
        identity[int(np.searchsorted(frame, looked.number)) + looked.tracks.row[own]] = looked.tracks.identity[own]
    true = given.table.identity[:rows]
    return score_rows(true, identity)[0] if (true != FALSE).any() else float("nan")


@functools.cache
def _read(data: str) -> Mapping[str, Any]:
    return read(Path(data))


def leave_out(options: bench.Options) -> tuple[str, Any]:
    """Choose the constants with each sequence left out in turn."""
    names = list(read(options.data))
    cases = [
        [str(options.data), name, *table, setting, options.most_rows]
        for setting, table, name in itertools.product(SETTINGS, TABLES, names)
    ]
    found = np.array(bench.run_cases(cases, score_of, options.jobs, options.cache), float)
    score = found.reshape(len(SETTINGS), len(TABLES), len(names))
    sets = group(names)
    weight = np.array([next(1 / len(of) for of in sets.values() if name in of) for name in names])
    chosen = choose_without_each(score.mean(axis=1), weight)
    left_out = score[chosen, :, np.arange(len(names))].T  # (tables, names)
    in_hindsight = int((score.mean(axis=1) @ weight).argmax())
    rows, figures = [], []
    for of, members in sets.items():
        at = [names.index(name) for name in members]
        for k, (condition, interval) in enumerate(TABLES):
            three = [score[0, k, at].mean(), left_out[k, at].mean(), score[in_hindsight, k, at].mean()]
            rows.append([of, condition, str(interval), *(f"{value:.1f}" for value in three)])
            keys = ("defaults", "left_out", "hindsight")
            figures.append(
                {"set": of, "detections": condition, "every": interval} | dict(zip(keys, three, strict=True))
            )
    head = ["set", "detections", "every", "defaults", "chosen without the sequence", "best in hindsight"]
    picked = {words(SETTINGS[k]): int((chosen == k).sum()) for k in np.unique(chosen)}
    text = f"Mean IDF1, the first {options.most_rows} boxes of a sequence:\n\n{bench.format_table(head, rows)}\n\n"
    text += "Chosen: " + ", ".join(f"{name} ({times} of {len(names)})" for name, times in picked.items())
    text += f". In hindsight: {words(SETTINGS[in_hindsight])}."
    return text, {"rows": figures, "chosen": picked, "hindsight": words(SETTINGS[in_hindsight])}


def choose_without_each(score: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(N,) for each sequence the setting of the best weighted mean on all others, from scores (settings, N)."""
    weighted = score * weight
    return (weighted.sum(axis=1, keepdims=True) - weighted).argmax(axis=0)


def words(setting: Mapping[str, float]) -> str:
    return ", ".join(f"{key} {value}" for key, value in setting.items()) or "the defaults"


if __name__ == "__main__":
    bench.main(__doc__, {"": (leave_out, {"data": Path, "--most-rows": 5000, "--jobs": 1, "--cache": None})})
