"""Shared parts of the studies: options, results as JSON, tables, timing in turns, the machine and its load.

A study is a function that takes its options and returns Markdown text and figures. `main` runs a study from the command
line and prints the text. With `--write eval/results/NAME.json` it stores text and figures with the command, the date,
the revision and the machine. `eval/figures.py` puts the text between the marks NAME of the documents.
"""

import argparse
import gc
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import date
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle torch threads must not spin during others' turns

import numpy as np

from torchvision_dddas.lab.benchmark import describe_machine
from torchvision_dddas.lab.benchmark import format_table as format_table
from torchvision_dddas.lab.benchmark import machine_words as machine_words

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "eval" / "results"

Options = argparse.Namespace
Study = Callable[[Options], tuple[str, Any]]

# -- command line ----------------------------------------------------------------------------------------------------


def main(description: str | None, studies: Mapping[str, tuple[Study, Mapping[str, Any]]]) -> None:
    """Run the study that the command line names, print its text and write its result.

    studies: {sub-command: (function, options)}. A single study under "" needs no sub-command. An option is a flag (or
    the name of a positional folder) with its default: None for an optional text, a list for several values, False for
    a switch, `Path` for a required path, else a value that sets the type.
    """
    parser = _parser(description)
    if "" in studies:
        _add_options(parser, studies[""][1])
    else:
        commands = parser.add_subparsers(dest="study", required=True, metavar="STUDY")
        for name, (study, options) in studies.items():
            lines = (study.__doc__ or "").strip().splitlines()
            command = commands.add_parser(
                name, help=lines[0].replace("%", "%%"), description=study.__doc__, formatter_class=_Formatter
            )
            _add_options(command, options)
    options = parser.parse_args()
    study = studies[getattr(options, "study", "")][0]
    text, figures = study(options)
    print(text)
    if options.write:
        write_result(options.write, text, figures)


class _Formatter(argparse.RawDescriptionHelpFormatter, argparse.ArgumentDefaultsHelpFormatter):
    pass


def _parser(description: str | None) -> argparse.ArgumentParser:
    return argparse.ArgumentParser(description=description, formatter_class=_Formatter)


def _add_options(parser: argparse.ArgumentParser, options: Mapping[str, Any]) -> None:
    for flag, default in options.items():
        if not flag.startswith("-"):
            parser.add_argument(flag, type=Path, nargs="?" if default is None else None)
        elif default is False:
            parser.add_argument(flag, action="store_true")
        elif default is None or default is Path:
            parser.add_argument(flag, type=Path if default is Path else str, required=default is Path)
        elif isinstance(default, list | tuple):
            parser.add_argument(flag, nargs="*", type=type(default[0]) if default else str, default=list(default))
        else:
            parser.add_argument(flag, type=type(default), default=default)
    parser.add_argument("--write", type=Path, help="keep text and figures in this JSON, usually eval/results/NAME.json")


def parse_size(text: str) -> tuple[int, int]:
    """Parse text such as 640x480 to width and height in pixels."""
    width, height = (int(side) for side in text.split("x"))
    return width, height


def log(*words: object) -> None:
    """Print progress to standard error."""
    print(*words, file=sys.stderr, flush=True)


# -- results ---------------------------------------------------------------------------------------------------------


def write_result(path: Path, text: str, figures: Any) -> None:
    """Write a result: Markdown blocks, figures, and the conditions of the measurement."""
    content = {
        "command": command_line(),
        "date": date.today().isoformat(),
        "revision": revision(),
        "machine": describe_machine(),
        "blocks": split_blocks(text),
        "figures": figures,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False, default=_plain) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


def read_result(name: str) -> dict[str, Any]:
    """Read eval/results/NAME.json."""
    content: dict[str, Any] = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return content


def result_text(result: Mapping[str, Any]) -> str:
    """Return the Markdown of a result's blocks."""
    return "\n\n".join(block if isinstance(block, str) else _join_table(block) for block in result["blocks"])


def split_blocks(text: str) -> list[str | dict[str, Any]]:
    """Split Markdown into paragraphs, and tables of head, alignment and rows. `result_text` is the inverse."""
    return [_split_block(part) for part in text.strip().split("\n\n")]


def _split_block(part: str) -> str | dict[str, Any]:
    lines = part.split("\n")
    if len(lines) < 2 or not all(line.startswith("|") for line in lines):
        return part
    head, align, *rows = ([cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines)
    block = {"head": head, "align": align, "rows": rows}
    return block if _join_table(block) == part else part


def _join_table(block: Mapping[str, Any]) -> str:
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (block["head"], block["align"], *block["rows"]))


def command_line() -> str:
    """Return this program's command line, with DATA for data folders and without paths outside the project."""
    script = Path(sys.argv[0]).resolve()
    program = script.relative_to(ROOT).as_posix() if script.is_relative_to(ROOT) else script.name
    return " ".join(["python", program, *(_anonymous(word) for word in sys.argv[1:])])


def _anonymous(word: str) -> str:
    path = Path(word)
    if path.is_absolute() and path.is_relative_to(ROOT):
        return path.relative_to(ROOT).as_posix()
    if not path.exists() or path.resolve().is_relative_to(ROOT):
        return path.name if path.is_absolute() else word
    return "DATA" if path.is_dir() else path.name


def revision() -> str:
    """Return the checkout's git revision, with + if files differ from it, or an empty text without git."""
    try:
        short, dirty = (
            subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True).stdout.strip()
            for words in (("rev-parse", "--short", "HEAD"), ("status", "--porcelain", "--untracked-files=no"))
        )
    except (OSError, subprocess.CalledProcessError):
        return ""
    return short + "+" * bool(dirty)


# -- statistics ------------------------------------------------------------------------------------------------------


class Spread:
    """A figure over seeds: mean ± standard error (range). Values that are None or not finite are left out."""

    def __init__(self, values: Iterable[float | None]) -> None:
        self.values = np.array([v for v in values if v is not None and np.isfinite(v)], float)
        self.mean = float(self.values.mean()) if len(self.values) else float("nan")
        few = len(self.values) < 2
        self.error = float("nan") if few else float(self.values.std(ddof=1) / np.sqrt(len(self.values)))

    def text(self, digits: int = 2, factor: float = 1.0, spread: bool = True) -> str:
        """Format the figure for a table cell, or a dash for a missing value."""
        if not len(self.values):
            return "–"
        mean, low, high = (f"{factor * v:.{digits}f}" for v in (self.mean, self.values.min(), self.values.max()))
        return f"{mean} ± {factor * self.error:.{digits}f} ({low}–{high})" if spread and len(self.values) > 1 else mean


def format_gain(gains: Sequence[float] | np.ndarray, digits: int = 2) -> str:
    """Format the mean gain with its 95 % interval by a bootstrap over its parts (sequences, scenes)."""
    drawn = np.random.default_rng(0).choice(gains, (10_000, len(gains))).mean(axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return f"{np.mean(gains):+.{digits}f} ({low:+.{digits}f} to {high:+.{digits}f})"


def run_cases(cases: Sequence[Any], work: Callable[[Any], Any], jobs: int = 1, cache: str | None = None) -> list[Any]:
    """Return the results of `work` for all cases in order, computed by `jobs` processes.

    cache: a file of finished cases (JSON lines), which is read first and extended.
    """
    keys = [json.dumps(case, sort_keys=True, default=str) for case in cases]
    found: dict[str, Any] = {}
    if cache and Path(cache).exists():
        found = dict(json.loads(line) for line in Path(cache).read_text(encoding="utf-8").splitlines())
    missing = [k for k, key in enumerate(keys) if key not in found]
    pool = ProcessPoolExecutor(jobs) if jobs > 1 and len(missing) > 1 else None
    results = (pool.map if pool else map)(work, [cases[k] for k in missing])
    for done, (k, result) in enumerate(zip(missing, results, strict=True), 1):
        found[keys[k]] = result
        log(f"{done} of {len(missing)} cases")
        if cache:
            with Path(cache).open("a", encoding="utf-8") as file:
                file.write(json.dumps([keys[k], result], default=_plain) + "\n")
    if pool:
        pool.shutdown()
    return [found[key] for key in keys]


# -- time and memory -------------------------------------------------------------------------------------------------


def now() -> np.ndarray:
    """Return (2,) seconds of the clock, and processor seconds over all threads."""
    return np.array([time.perf_counter(), time.process_time()])


def children_s() -> np.ndarray:
    """Return (2,) seconds of the clock, and processor seconds of all child programs that have ended."""
    use = resource.getrusage(resource.RUSAGE_CHILDREN)
    return np.array([time.perf_counter(), use.ru_utime + use.ru_stime])


def time_in_turns(calls: Mapping[str, Callable[[int], object]], rounds: int, warm_up: int = 1) -> dict[str, np.ndarray]:
    """Return seconds (rounds, 2) of clock and processor for each call. Each round runs all calls under similar load.

    A call gets the number of the round, counted from the warm-up. Garbage is collected between calls.
    """
    spent: dict[str, list[np.ndarray]] = {name: [] for name in calls}
    for turn in range(rounds + warm_up):
        for name, call in calls.items():
            gc.collect()
            start = now()
            call(turn)
            if turn >= warm_up:
                spent[name].append(now() - start)
    return {name: np.array(values) for name, values in spent.items()}


def quartiles(name: str, values: np.ndarray) -> dict[str, float]:
    """Return {name: median, name_25: lower quartile, name_75: upper quartile}."""
    low, middle, high = np.percentile(values, [25, 50, 75]).tolist()
    return {name: middle, f"{name}_25": low, f"{name}_75": high}


def compare_turns(spent_s: np.ndarray, reference_s: np.ndarray) -> dict[str, float]:
    """Return clock and processor milliseconds, and ratios to the reference in the same turn, from (rounds, 2) each."""
    found = {}
    for k, name in enumerate(("clock", "processor")):
        found |= quartiles(f"{name}_ms", 1e3 * spent_s[:, k])
        found |= quartiles(f"{name}_ratio", spent_s[:, k] / reference_s[:, k])
    return found


def format_ratio(row: Mapping[str, float], name: str = "processor") -> str:
    """Format the median ratio and its quartiles for a table cell."""
    return f"{row[f'{name}_ratio']:.2f} ({row[f'{name}_ratio_25']:.2f}–{row[f'{name}_ratio_75']:.2f})"


def measure_memory(command: Sequence[str]) -> dict[str, float]:
    """Measure a command's seconds, and the peak and late growth of its resident memory in MB, from /proc each 50 ms."""
    start, held, peak = time.perf_counter(), [0.0], [0.0]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    while process.poll() is None:
        if (memory := read_memory(process.pid)) is not None:
            held.append(memory[0])
            peak.append(memory[1])
        time.sleep(0.05)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with {process.returncode}")
    half = len(held) // 2
    growth = max(held[half:]) - max(held[: max(half, 1)])
    return {"peak_mb": max(peak), "second_half_mb": growth, "seconds": time.perf_counter() - start}


def read_memory(pid: int) -> tuple[float, float] | None:
    """Return a process's current and peak resident memory in MB, or None if it has ended."""
    try:
        lines = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
        return int(lines["VmRSS"].split()[0]) / 1024, int(lines["VmHWM"].split()[0]) / 1024
    except (OSError, KeyError):
        return None


# -- the machine -----------------------------------------------------------------------------------------------------


class OtherLoad:
    """Cores that other programs kept busy since creation: the machine's load minus this process's load."""

    def __init__(self) -> None:
        self._start = time.monotonic(), _busy_s(), _own_s()

    def cores(self) -> float:
        """Return the average number of cores, 0 on a quiet machine."""
        start, busy, own = self._start
        return max((_busy_s() - busy - _own_s() + own) / max(time.monotonic() - start, 1e-3), 0.0)

    def words(self) -> str:
        """Return a sentence for the text beside a table."""
        return f"other programs took {self.cores():.1f} of {len(os.sched_getaffinity(0))} cores meanwhile"


def _busy_s() -> float:
    try:
        user, nice, system, _, _, irq, soft, steal = map(int, Path("/proc/stat").read_text().split()[1:9])
    except OSError:
        return 0.0
    return (user + nice + system + irq + soft + steal) / os.sysconf("SC_CLK_TCK")


def _own_s() -> float:
    uses = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(use.ru_utime + use.ru_stime for use in uses)


# -- plots -----------------------------------------------------------------------------------------------------------


def draw(path: str | None, panels: Sequence[Mapping[str, Any]], columns: int = 0) -> None:
    """Draw panels of lines into a PNG. Do nothing if path is None.

    A panel has title, xlabel, ylabel, xscale, yscale as in matplotlib, and lines: {label: dict of x, y and optionally
    error (of y) and style (a format such as "o-")}.
    """
    if path is None:
        return
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    columns = columns or len(panels)
    rows = -(-len(panels) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(5 * columns, 4 * rows), squeeze=False, layout="constrained")
    for axis, panel in zip(axes.ravel(), panels, strict=False):
        for label, line in panel["lines"].items():
            axis.errorbar(line["x"], line["y"], line.get("error"), fmt=line.get("style", "o-"), ms=4, label=label)
        axis.set(**{key: value for key, value in panel.items() if key != "lines"})
        axis.grid(color="#e6e6e6")
        axis.legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=110)
    log(f"{path}: drawn")
