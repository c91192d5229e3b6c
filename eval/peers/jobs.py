"""The peers run in environments of their own; here are what they are given and what comes back.

A job is one tracker with its settings on one table of boxes, see run_trackers.py.
"""

import itertools
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.lab.evaluation.metrics.truth import TrackTable

HERE = Path(__file__).resolve().parent
PYTHON, NORFAIR_PYTHON = (HERE.parents[1] / f"{name}/bin/python" for name in (".venv-peers", ".venv-norfair"))

Settings = dict[str, Any]


@dataclass(frozen=True)
class Table:
    """A file of boxes as MOTChallenge has them: its interval, and the number of its last frame."""

    file: Path
    interval: int
    length: int


def check_environments() -> None:
    """End the program with one line where an environment is missing."""
    for python in (PYTHON, NORFAIR_PYTHON):
        if not python.exists():
            sys.exit(f"{python} is missing; run make peers first")


def write_table(file: Path, table: TrackTable, score: np.ndarray) -> None:
    """Write boxes without their identities."""
    blank = -np.ones((len(score), 3))
    rows = np.c_[table.frame, blank[:, 0], table.box_px, score, blank]
    np.savetxt(file, rows, delimiter=",", fmt="%.10g")


def run_peer(peer: str, tried: Sequence[Settings], tables: Sequence[Table], folder: Path) -> list[list[np.ndarray]]:
    """By settings and table: the identity of each row, 0 for none."""
    return [[identity for identity, _ in of] for of in run_timed(peer, tried, tables, folder)]


def run_timed(
    peer: str, tried: Sequence[Settings], tables: Sequence[Table], folder: Path
) -> list[list[tuple[np.ndarray, float]]]:
    """By settings and table: the identity of each row, 0 for none, and the processor seconds of all looks."""
    cases = list(itertools.product(range(len(tried)), range(len(tables))))
    jobs = [job(peer, tried[k], tables[n], folder / f"{k}-{n}.txt") for k, n in cases]
    seconds = dict(zip(cases, run_jobs(peer, jobs, folder), strict=True))
    return [
        [(np.loadtxt(folder / f"{k}-{n}.txt", int, ndmin=1), seconds[k, n]) for n in range(len(tables))]
        for k in range(len(tried))
    ]


def job(peer: str, settings: Settings, table: Table, out: Path | None) -> dict[str, Any]:
    """One job; without a file to write, only its time is known."""
    given = {"boxes": str(table.file), "interval": table.interval, "length": table.length}
    return {"tracker": peer, "settings": settings, **given, "out": str(out) if out else None}


def run_jobs(peer: str, jobs: Sequence[Mapping[str, Any]], folder: Path) -> list[float]:
    """Processor seconds of jobs, one after another in one process with one thread."""
    (folder / "jobs.json").write_text(json.dumps(jobs))
    python, script = (NORFAIR_PYTHON, "run_norfair.py") if peer == "norfair" else (PYTHON, "run_trackers.py")
    words = [str(python), str(HERE / script), str(folder / "jobs.json")]
    threads = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    return json.loads(subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True, env=threads).stdout)


def grid(choices: Mapping[str, Sequence]) -> Iterable[Settings]:
    """All combinations of values."""
    for values in itertools.product(*choices.values()):
        yield dict(zip(choices, values, strict=True))
