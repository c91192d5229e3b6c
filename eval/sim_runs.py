"""Runs of a simulated study, one for each seed and setting: in processes, kept in a file as they come, and summed up.

A study that is stopped goes on where it was, with the same --cache: a run that stands in the file is not run again.
"""

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np

Case = dict[str, Any]
"""What tells a run from the others: numbers and words, as JSON has them."""


def options(about: str | None, seeds: int, seconds: float) -> argparse.ArgumentParser:
    """What every study is asked."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=seeds, help=f"worlds; {seeds}")
    parser.add_argument("--seconds", type=float, default=seconds, help=f"length of each run; {seconds:g}")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time; 1")
    parser.add_argument("--cache", type=Path, help="a file of finished runs, added to, so that a study can go on")
    parser.add_argument("--json", type=Path, help="a file for all figures")
    parser.add_argument("--plot", type=Path, help="a PNG")
    parser.add_argument("--write", type=Path, help="a text file with the study's marks, such as eval/README.md")
    return parser


def run_all(cases: Sequence[Case], work: Callable[[Case], Case], cache: Path | None, jobs: int) -> list[Case]:
    """What `work` makes of each case, in their order, a dict that JSON has. Those in the cache are taken from there."""
    done = dict(_read(cache))
    todo = [case for case in cases if _key(case) not in done]
    start = time.perf_counter()
    for count, (case, result) in enumerate(_worked(todo, work, jobs), 1):
        done[_key(case)] = result
        if cache is not None:
            with cache.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"case": case, "result": result}) + "\n")
        spent = time.perf_counter() - start
        left = spent / count * (len(todo) - count)
        print(f"{count} of {len(todo)} runs, {spent:.0f} s, {left:.0f} s left: {_words(case)}", file=sys.stderr)
    return [done[_key(case)] for case in cases]


def _worked(todo: Sequence[Case], work: Callable[[Case], Case], jobs: int) -> Iterable[tuple[Case, Case]]:
    if jobs <= 1:
        yield from ((case, work(case)) for case in todo)
        return
    with ProcessPoolExecutor(jobs, initializer=_alone) as pool:
        running = {pool.submit(work, case): case for case in todo}
        for future in as_completed(running):
            yield running[future], future.result()


def _alone() -> None:
    """One thread for each process: they would wait for each other."""
    import cv2

    cv2.setNumThreads(1)


def _read(cache: Path | None) -> Iterable[tuple[str, Case]]:
    if cache is None or not cache.is_file():
        return
    for line in cache.read_text(encoding="utf-8").splitlines():
        try:
            entry = json.loads(line)
            yield _key(entry["case"]), entry["result"]
        except (ValueError, KeyError, TypeError):
            print(f"{cache}: a line is no finished run; it is run again", file=sys.stderr)


def _key(case: Case) -> str:
    return json.dumps(case, sort_keys=True)


def _words(case: Case) -> str:
    return ", ".join(f"{name} {value}" for name, value in case.items())


class Over:
    """Figures over seeds: their mean, its standard error, and their range; None and NaN are left out."""

    def __init__(self, values: Iterable[float | None]) -> None:
        self.values = np.array([v for v in values if v is not None and math.isfinite(v)], float)
        count = len(self.values)
        self.mean = float(self.values.mean()) if count else math.nan
        self.error = float(self.values.std(ddof=1) / math.sqrt(count)) if count > 1 else math.nan

    def text(self, digits: int = 2, scale: float = 1.0, spread: bool = True) -> str:
        """Mean ± standard error (lowest to highest)."""
        if not len(self.values):
            return "–"
        told = f"{scale * self.mean:.{digits}f}"
        if not spread or not math.isfinite(self.error):
            return told
        low, high = scale * self.values.min(), scale * self.values.max()
        return f"{told} ± {scale * self.error:.{digits}f} ({low:.{digits}f}–{high:.{digits}f})"

    def as_json(self) -> Case:
        """For a file."""
        low, high = (float(self.values.min()), float(self.values.max())) if len(self.values) else (None, None)
        plain = {"mean": self.mean, "standard_error": self.error}
        return {
            "seeds": len(self.values),
            **{name: value if math.isfinite(value) else None for name, value in plain.items()},
            "lowest": low,
            "highest": high,
        }


def table(head: Sequence[str], rows: Iterable[Sequence[str]], words: int = 1) -> str:
    """Markdown; the first so many columns hold words, the others numbers."""
    lines = [f"| {' | '.join(head)} |", "|" + " --- |" * words + " ---: |" * (len(head) - words)]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def finish(asked: argparse.Namespace, name: str, text: str, figures: Case, draw: Callable[[Path], None]) -> None:
    """Print the tables, and write what was asked for."""
    import report

    print(text)
    if asked.json:
        machine = f"{os.cpu_count()} cores"
        content = {"study": name, "seeds": asked.seeds, "seconds": asked.seconds, "machine": machine, **figures}
        asked.json.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    if asked.plot:
        asked.plot.parent.mkdir(parents=True, exist_ok=True)
        draw(asked.plot)
    if asked.write:
        report.put(asked.write, name, text)


def pyplot() -> Any:
    """matplotlib's, dressed as the other plots are. Ends the program with one line where there is none."""
    try:
        import matplotlib as mpl
    except ModuleNotFoundError:
        raise SystemExit("no plot: it needs matplotlib, the extra `dev`") from None
    mpl.use("Agg")
    from matplotlib import pyplot as plt

    mpl.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
                         "grid.color": "#e6e6e6", "axes.edgecolor": "#888888", "axes.axisbelow": True})  # fmt: skip
    return plt
