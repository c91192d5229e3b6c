"""How late results of `dddas run --live` are, at 10, 25 and 30 pictures a second, on one core and on two.

usage: python eval/live_latency.py [DATA...] [--rates 10 25 30] [--cores 1 2] [--sizes 640x480] [--configs fast]
       [--seconds 30] [--rounds 3] [--realtime] [--json FILE]

Each run is a process of its own, held to so many cores (sched_setaffinity), which plays a video at its own rate as a
camera would give it, decoding included; its lines of JSON are read from its standard output. Settings take turns over
the rounds; a figure is the median over the rounds, with the lowest and highest. Told are

- latency: from the capture of the newest picture read to the results that it settles (50, 95, 99 %), by the run itself;
- age: from the capture of a picture to its own results, the pictures that it waits for included;
- growth: how much later results come after a minute than before it, by a line through the ages but for those of the
  first and the last second; where less is looked at in the course of a run, pictures wait longer for the next ones;
- dropped, left out on purpose, and late pictures (over live.deadline_ms); what was looked at when it ended;
- processor time a picture, start to first result, peak memory (VmHWM);
- waited: the share of the time in which the thread that looks at pictures could have worked that another one had the
  core, the capture's too. How much of all cores others took meanwhile is told at the end: where that is much, and
  nothing was done about it, the latencies are those of a busy machine.

The video is the project's own scene; with DATA (videos, folders of pictures) these too. --realtime (root) puts the
runs before all others that want their cores, and is told.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
import machine
import numpy as np
from films import Size, clips, resized, scene, size_of, write_video

GOAL_MS, SETTLED_S, PATIENCE_S = 80.0, 1.0, 120.0
FIGURES = (
    "latency_p50_ms",
    "latency_p95_ms",
    "latency_p99_ms",
    "age_p50_ms",
    "age_p95_ms",
    "age_p99_ms",
    "growth_ms_a_minute",
    "processor_ms",
    "first_result_s",
    "peak_mb",
    "waited",
    "dropped",
    "late",
    "every",
    "keypoints",
    "captured",
    "results",
)


class Watched:
    """What /proc tells of a process while it lives: its peak memory, and how long each thread ran and waited."""

    def __init__(self, pid: int) -> None:
        self.pid, self.peak_mb, self.threads = pid, math.nan, dict[str, tuple[int, int]]()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def look(self) -> None:
        """Once more."""
        try:
            lines = Path(f"/proc/{self.pid}/status").read_text().splitlines()
            held = [int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")]
            self.peak_mb = held[0] if held else self.peak_mb
            self.threads |= machine.ran_and_waited_ns(self.pid)
        except OSError:  # it is over
            return

    def spent_s(self) -> np.ndarray:
        """Seconds so far that all threads ran, that the main one ran, and that it had no core."""
        main = self.threads.get(str(self.pid), (0, 0))
        return np.array([sum(ran for ran, _ in self.threads.values()), *main]) / 1e9

    def end(self) -> None:
        """The process is about to be over."""
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(0.1):
            self.look()


def one_run(video: Path, case: dict[str, Any], realtime: bool) -> dict[str, float]:
    """The figures of a run."""
    with tempfile.TemporaryDirectory() as out:
        command = [str(Path(sys.executable).with_name("dddas")), "run", str(video), "--live", "--emit", "json:-"]
        command += ["--out", out, "--quiet", "--backend", "onboard"]
        command += [] if case["config"] == "default" else ["--config", case["config"]]
        command += ["--people"] if case["people"] else []
        began = time.time()
        errors = (Path(out) / "errors.txt").open("w+")
        run = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=errors,
            preexec_fn=partial(_hold, case["cores"], realtime),
            text=True,
        )
        watched = Watched(run.pid)
        assert run.stdout is not None
        first_s, start, rows = math.nan, np.zeros(3), []
        giving_up = threading.Timer(case["seconds"] + PATIENCE_S, run.kill)
        giving_up.start()
        for row in _rows(run.stdout):
            if not rows:
                first_s = time.time() - began
                watched.look()
                start = watched.spent_s()
            rows.append(row)
        watched.look()
        end = watched.spent_s()
        watched.end()
        code = run.wait()
        giving_up.cancel()
        errors.seek(0)
        if code or not rows:
            raise SystemExit(f"{' '.join(command)} ended with {code}: {errors.read().strip()[-500:]}")
        record = json.loads(next(Path(out).glob("*/run.json")).read_text(encoding="utf-8"))
    in_all, ran, waited = end - start
    counts, gauges = record["counts"], record["gauges"]
    seconds = {name: record["seconds"].get(name, {}) for name in ("latency", "age")}
    return {
        **{f"{name}_{p}_ms": 1e3 * values.get(p, math.nan) for name, values in seconds.items() for p in _PERCENTILES},
        **from_rows(rows),
        "processor_ms": 1e3 * float(in_all) / max(counts.get("captured", 0), 1),
        "first_result_s": first_s,
        "peak_mb": watched.peak_mb,
        "waited": float(waited / max(ran + waited, 1e-9)),
        **{name: float(counts.get(name, 0)) for name in ("captured", "dropped", "late", "results")},
        **{name: float(gauges.get(name, math.nan)) for name in ("every", "keypoints")},
    }


_PERCENTILES = ("p50", "p95", "p99")


def _hold(cores: int, realtime: bool) -> None:
    """In the new process: only so many cores, the last ones; whoever asks for figures keeps the first where he can."""
    allowed = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, allowed[-cores:])
    if realtime:
        machine.first_in_line()


def _rows(lines: Iterable[str]) -> Iterator[dict[str, Any]]:
    for line in lines:
        if line.startswith("{"):
            yield json.loads(line)


def from_rows(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Ages and their growth, of the lines of JSON; NaN where too few tell their age."""
    known = [(row["time_s"], row["age_s"]) for row in rows if row.get("age_s") is not None]
    times, ages = (np.array(values, float) for values in (zip(*known, strict=True) if known else ((), ())))
    # At the end nothing is waited for any more.
    settled = (times > times.min(initial=math.inf) + SETTLED_S) & (times < times.max(initial=0) - SETTLED_S)
    if np.count_nonzero(settled) < 3:
        return {f"age_{p}_ms": math.nan for p in _PERCENTILES} | {"growth_ms_a_minute": math.nan}
    times, ages = times[settled], ages[settled]
    slope = np.polyfit(times - times.mean(), ages, 1)[0]
    percentiles = np.percentile(ages, [50, 95, 99])
    return {
        **{f"age_{p}_ms": float(1e3 * value) for p, value in zip(_PERCENTILES, percentiles, strict=True)},
        "growth_ms_a_minute": float(1e3 * 60 * slope),
    }


def over_rounds(runs: list[dict[str, float]]) -> dict[str, dict[str, float | None]]:
    """Median, lowest and highest of each figure."""
    found = {}
    for name in FIGURES:
        values = [run[name] for run in runs if math.isfinite(run[name])]
        numbers = (float(np.median(values)), min(values), max(values)) if values else (None, None, None)
        found[name] = dict(zip(("median", "lowest", "highest"), numbers, strict=True))
    return found


def told(case: dict[str, Any], found: dict[str, dict[str, float | None]]) -> None:
    """Print a line."""
    numbers = {name: math.nan if v["median"] is None else v["median"] for name, v in found.items()}
    cores = f"{case['cores']} core" + "s" * (case["cores"] > 1)
    people = ", people" if case["people"] else ""
    print(f"{case['clip']:20} {case['config']}{people}, {case['rate_hz']:3g} frames/s, {cores:7} ", end="")
    print("latency {latency_p50_ms:.0f} / {latency_p95_ms:.0f} / {latency_p99_ms:.0f} ms, ".format(**numbers), end="")
    print(
        "age {age_p50_ms:.0f} / {age_p99_ms:.0f} ms, growth {growth_ms_a_minute:+.0f} ms/min, ".format(**numbers),
        end="",
    )
    print("dropped {dropped:.0f} of {captured:.0f}, late {late:.0f}, every {every:g}, ".format(**numbers), end="")
    print("processor {processor_ms:.1f} ms, first {first_result_s:.2f} s, ".format(**numbers), end="")
    print("{peak_mb:.0f} MB, waited {0:.0%}".format(numbers["waited"], **numbers), flush=True)


def main() -> None:
    """Measure, print and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="*")
    parser.add_argument("--rates", nargs="*", type=float, default=[10, 25, 30])
    parser.add_argument("--cores", nargs="*", type=int, default=[1, 2])
    parser.add_argument("--sizes", nargs="*", type=size_of, default=[(640, 480)])
    parser.add_argument("--configs", nargs="*", default=["fast"])
    parser.add_argument("--people", action="store_true", help="search for people too")
    parser.add_argument("--seconds", type=float, default=30, help="of each run; 30")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--realtime", action="store_true", help="before all others (SCHED_RR); root")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    there = len(os.sched_getaffinity(0))
    cores = [count for count in options.cores if count <= there]
    report = {"machine": machine.about(), "seconds": options.seconds, "realtime": options.realtime, "runs": []}
    print(f"{machine.in_words(report['machine'])}; runs of {options.seconds:g} s, {options.rounds} rounds", end="")
    print("; before all others" if options.realtime else "")
    others = machine.Others()
    with tempfile.TemporaryDirectory() as folder:
        videos = dict(filmed(options.data, options.sizes, options.rates, options.seconds, Path(folder)))
        cases = [
            {"clip": clip, "size": size, "rate_hz": rate, "cores": count, "config": config, "people": options.people,
             "seconds": options.seconds}
            for (clip, size, rate) in videos for config in options.configs for count in cores
        ]  # fmt: skip
        runs: dict[int, list[dict[str, float]]] = {k: [] for k in range(len(cases))}
        for turn in range(options.rounds):
            for k, case in enumerate(cases):
                video = videos[case["clip"], case["size"], case["rate_hz"]]
                runs[k].append(one_run(video, case, options.realtime))
                report["runs"] = [
                    {**cases[i], "rounds": len(done), **over_rounds(done)} for i, done in runs.items() if done
                ]
                report["others"] = others.cores()
                if options.json:
                    options.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
                if turn == options.rounds - 1:
                    told(case, over_rounds(runs[k]))
    print(machine.load_in_words(others.cores()))


def filmed(
    data: list[str], sizes: list[Size], rates: list[float], seconds: float, folder: Path
) -> Iterator[tuple[tuple[str, Size, float], Path]]:
    """((clip, size, rate), video file): the scene at each size, and the user's clips made as large."""
    for size in sizes:
        films = [("scene", scene(size, 24))]
        films += [(name, [resized(f, size) for f in frames]) for name, frames in (clips(data, []) if data else ())]
        for name, frames in films:
            for rate in rates:
                video = folder / f"{name}-{size[0]}x{size[1]}-{rate:g}.mp4"
                write_video(video, frames, round(seconds * rate), rate)
                yield (f"{name} {size[0]}x{size[1]}", size, rate), video


if __name__ == "__main__":
    main()
