"""Measure the latency of live runs, and test whether memory stays constant over a long run.

python eval/live.py latency [--sizes 640x480 1280x720] [--rates 25] [--cores 1 2] [--seconds 20] [--rounds 3] [--now]
python eval/live.py soak [--minutes 30] [--pace 20]

The video is the tests' synthetic scene, played forwards and backwards. Measure latency on a quiet machine. The text
beside the table gives the load by other programs.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from functools import partial
from pathlib import Path
from typing import Any

import bench
import numpy as np
from clips import scene, write_video

PROGRAM = [sys.executable, "-c", "from torchvision_dddas.cli import main; main()", "run"]
PERCENTILES = ("p50", "p95", "p99")
SETTLED_S, PATIENCE_S = 1.0, 120.0
STEP_MB, STEP_SAMPLES, MOST_STEPS = 5.0, 3, 3
FIGURES = (
    *(f"{name}_{p}_ms" for name in ("latency", "age", "provisional") for p in PERCENTILES),
    "growth_ms_a_minute", "processor_ms", "first_result_s", "peak_mb",
    "dropped", "late", "captured", "looked_at", "results",
)  # fmt: skip


def measure_latency(options: bench.Options) -> tuple[str, Any]:
    """Measure latency, age, drops and cost of `dddas run --live`. Each run is a process with a number of cores.

    latency: time from the capture of the newest picture to the results that it completes. age: time from the capture of
    a picture to its own results. growth: growth of the age in a minute, by a line through the ages. processed: the
    share of pictures that were processed; a run under load processes one of several. processor: for each of these.
    --now: with `--latency now`; `provisional` is the time from the capture of a picture to its provisional tracks.
    Settings take turns over the rounds. Figures are medians over the rounds (99 %: lowest to highest).
    """
    load, cores = bench.OtherLoad(), [n for n in options.cores if n <= len(os.sched_getaffinity(0))]
    cases = [
        (config, size, rate, count)
        for config in options.configs
        for size in options.sizes
        for rate in options.rates
        for count in cores
    ]
    runs: dict[Any, list[dict[str, float]]] = {case: [] for case in cases}
    with tempfile.TemporaryDirectory() as folder:
        for size, rate in {(size, rate) for _, size, rate, _ in cases}:
            pictures = scene(bench.parse_size(size), 24)
            write_video(Path(folder) / f"{size}-{rate:g}.mp4", pictures, round(options.seconds * rate), rate)
        for _ in range(options.rounds):
            for case in cases:
                config, size, rate, count = case
                video = Path(folder) / f"{size}-{rate:g}.mp4"
                runs[case].append(run_live(video, config, count, options.seconds, options.people, options.now))
                bench.log(*case, runs[case][-1])
    head = ["configuration", "size", "frames/s", "cores", "latency 50 / 95 / 99 %, ms", "age 50 / 99 %, ms"]
    head += ["provisional 50 / 99 %, ms"] * options.now
    head += ["growth, ms a minute", "processed, %", "dropped", "processor ms", "first result, s", "MB"]
    rows, found = [], []
    for (config, size, rate, count), done in runs.items():
        values = {name: np.array([run[name] for run in done]) for name in FIGURES}
        known = {name: value for name, value in values.items() if np.isfinite(value).any()}
        f = dict.fromkeys(FIGURES, math.nan) | {name: float(np.nanmedian(value)) for name, value in known.items()}
        worst = values["latency_p99_ms"]
        latency = " / ".join(f"{f[f'latency_{p}_ms']:.0f}" for p in PERCENTILES)
        latency += f" ({np.nanmin(worst):.0f}–{np.nanmax(worst):.0f})"
        age = f"{f['age_p50_ms']:.0f} / {f['age_p99_ms']:.0f}"
        cells = [latency, age]
        cells += [f"{f['provisional_p50_ms']:.0f} / {f['provisional_p99_ms']:.0f}"] * options.now
        cells += [f"{f['growth_ms_a_minute']:+.0f}", f"{100 * f['looked_at'] / f['captured']:.0f}"]
        cells += [
            f"{f['dropped']:.0f} of {f['captured']:.0f}",
            f"{f['processor_ms']:.1f}",
            f"{f['first_result_s']:.2f}",
            f"{f['peak_mb']:.0f}",
        ]
        rows.append([config, size, f"{rate:g}", count, *cells])
        found.append({"config": config, "size": size, "rate_hz": rate, "cores": count, "runs": done})
    command = f"`dddas run --live{' --latency now' * options.now}`"
    about = f"{command}, {bench.machine_words()}; {load.words()}; {options.seconds:g} s each, "
    return f"{about}medians over {options.rounds} rounds:\n\n{bench.format_table(head, rows)}", found


def run_live(video: Path, config: str, cores: int, seconds: float, people: bool, now: bool) -> dict[str, float]:
    """Return the figures of a run."""
    with tempfile.TemporaryDirectory() as out, (Path(out) / "errors.txt").open("w+") as errors:
        command = [*PROGRAM, str(video), "--live", "--emit", "json:-", "--out", out, "--quiet", "--backend", "onboard"]
        command += ([] if config == "default" else ["--config", config]) + ["--people"] * people
        command += ["--latency", "now"] * now
        began = time.time()
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=errors, text=True, preexec_fn=partial(_restrict_cores, cores)
        )
        assert process.stdout is not None
        timer = threading.Timer(seconds + PATIENCE_S, process.kill)
        timer.start()
        first_s, start_s, spent_s, peak_mb, rows = math.nan, 0.0, 0.0, math.nan, []
        for line in process.stdout:
            spent_s = _processor_s(process.pid)
            if memory := bench.read_memory(process.pid):
                peak_mb = memory[1]
            if line.startswith("{"):
                if not rows:
                    first_s, start_s = time.time() - began, spent_s
                if "provisional" not in (row := json.loads(line)):
                    rows.append(row)
        code = process.wait()
        timer.cancel()
        if code or not rows:
            errors.seek(0)
            raise SystemExit(f"{' '.join(command)} ended with {code}: {errors.read().strip()[-500:]}")
        record = json.loads(next(Path(out).glob("*/run.json")).read_text(encoding="utf-8"))
    counts, taken = record["counts"], record["seconds"]
    return {
        **{
            f"{name}_{p}_ms": 1e3 * taken.get(name, {}).get(p, math.nan)
            for name in ("latency", "provisional")
            for p in PERCENTILES
        },
        **measure_ages(rows),
        "processor_ms": 1e3 * (spent_s - start_s) / max(counts.get("looked_at", 0), 1),
        "first_result_s": first_s,
        "peak_mb": peak_mb,
        **{name: float(counts.get(name, 0)) for name in ("captured", "looked_at", "dropped", "late", "results")},
    }


def _restrict_cores(cores: int) -> None:
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-cores:])


def _processor_s(pid: int) -> float:
    try:
        cells = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:  # the process has ended
        return math.nan
    return (int(cells[11]) + int(cells[12])) / os.sysconf("SC_CLK_TCK")


def measure_ages(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Return ages and their growth from lines of results, without the first and last second; NaN for too few ages."""
    known = np.array([(row["time_s"], row["age_s"]) for row in rows if row.get("age_s") is not None]).reshape(-1, 2)
    times, ages = known.T
    settled = (times > times.min(initial=math.inf) + SETTLED_S) & (times < times.max(initial=0) - SETTLED_S)
    if np.count_nonzero(settled) < 3:
        return {f"age_{p}_ms": math.nan for p in PERCENTILES} | {"growth_ms_a_minute": math.nan}
    times, ages = times[settled], 1e3 * ages[settled]
    slope = float(np.polyfit(times - times.mean(), ages, 1)[0])
    percentiles = dict(zip(PERCENTILES, np.percentile(ages, [50, 95, 99]).tolist(), strict=True))
    return {f"age_{p}_ms": value for p, value in percentiles.items()} | {"growth_ms_a_minute": 60 * slope}


# -- soak ------------------------------------------------------------------------------------------------------------


def measure_soak(options: bench.Options) -> tuple[str, Any]:
    """Measure the memory of a long run at a high pace, and check that every line of its results is complete.

    The exit code is 1 if memory grows by more than --growth-mb from the second quarter of the run to the last (without
    up to three steps by libraries that are loaded at first use), or if a line is incomplete. At pace 0 each picture
    waits for the run.
    """
    frames = round(60 * options.minutes * options.rate)
    with tempfile.TemporaryDirectory() as folder:
        clip, out, second = Path(folder) / "clip.avi", Path(folder) / "out", Path(folder) / "second.jsonl"
        write_video(clip, scene(bench.parse_size(options.size), 40), frames, options.rate)
        command = [*PROGRAM, str(clip), "--live", "--out", str(out), "--config", options.config, "--quiet"]
        command += ["--set", f"live.pace={options.pace:g}", "--emit", f"json:{second}"] + ["--people"] * options.people
        command += ["--set", "live.watchdog_s=0"]  # a busy machine does not mean a hung run
        began, samples = time.monotonic(), []
        with subprocess.Popen(command) as process:
            while process.poll() is None:
                time.sleep(1.0)
                if second.exists() and second.stat().st_size and (memory := bench.read_memory(process.pid)):
                    samples.append((time.monotonic() - began, memory[0]))
        (session,) = out.iterdir()
        record = json.loads((session / "run.json").read_text())
        numbers, copied = (
            [json.loads(line)["frame"] for line in path.read_text().splitlines()]
            for path in (session / "results.jsonl", second)
        )
    held = np.array(samples)[:, 1]
    level, steps = remove_steps(held)
    quarters = np.array_split(level, 4)
    growth_mb = float(np.median(quarters[3]) - np.median(quarters[1]))
    is_whole = record["state"] == "complete" and numbers == sorted(set(numbers)) == copied and not process.returncode
    counts = {name: record["counts"].get(name, 0) for name in ("captured", "dropped", "results", "late")}
    text = (
        f"{options.minutes:g} minutes of clip at {options.size}, pace {options.pace:g}, in {samples[-1][0]:.0f} s; "
        f"{', '.join(f'{value} {name}' for name, value in counts.items())}. Memory from the second quarter to the last "
        f"{growth_mb:+.1f} MB, steps of {', '.join(f'{step:.1f}' for step in steps) or 'no'} MB, most "
        f"{held.max():.1f} MB; {len(numbers)} lines, {'all' if is_whole else 'NOT'} whole and in order."
    )
    if not is_whole or growth_mb > options.growth_mb or len(steps) > MOST_STEPS:
        sys.exit(text)
    return text, {"samples": samples, "growth_mb": growth_mb, "steps_mb": steps, "counts": counts}


def remove_steps(held: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """Return the memory (N,) minus earlier steps, and the steps in MB."""
    left, steps, k = held.copy(), [], 1
    while k < len(left):
        ahead = min(k + STEP_SAMPLES - 1, len(left) - 1)
        if (step := float(left[ahead] - left[k - 1])) > STEP_MB:
            steps.append(step)
            left[ahead:] -= step
            left[k:ahead] = left[k - 1]
            k = ahead
        k += 1
    return left, steps


if __name__ == "__main__":
    latency = {"--rates": [25.0], "--cores": [1, 2], "--configs": ["fast"], "--sizes": ["640x480", "1280x720"]}
    latency |= {"--people": False, "--now": False, "--seconds": 20.0, "--rounds": 3}
    soak = {"--minutes": 30.0, "--pace": 20.0, "--size": "320x240", "--rate": 10.0, "--people": False}
    soak |= {"--config": "fast", "--growth-mb": 4.0}
    bench.main(__doc__, {"latency": (measure_latency, latency), "soak": (measure_soak, soak)})
