"""A long live run at a high pace: does its memory stay flat, and is every line of its results whole?

usage: python eval/soak.py [--minutes 30] [--pace 20] [--size 320x240] [--rate 10] [--people] [--json FILE]

The video is the project's own scene, run forwards and backwards for so many minutes of clip time. `dddas run --live`
plays it at so many times its own speed, its results go to the session's file and to a second one; at pace 0 each
picture waits for the run, so that all are looked at. /proc tells every second what the process holds (VmRSS). A library
that is loaded when it is first needed (SciPy's, where targets come close) is a step of megabytes within a second or
two: steps are told apart. Exit code 1 where the rest grows by more than --growth-mb from the second quarter of the run
to the last, where there are more than three steps, or where a line is not whole.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from synthetic import render

PERIOD = 40
ROWS = 12
STEP_MB, STEP_SAMPLES = 5.0, 3
MOST_STEPS = 3


def write_clip(path: Path, frames: int, size: tuple[int, int], rate_hz: float) -> None:
    """The scene, forwards and backwards."""
    images = render(0, PERIOD, size).images
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), rate_hz, size)
    for k in range(frames):
        place = k % (2 * PERIOD - 2)
        writer.write(images[min(place, 2 * PERIOD - 2 - place)])
    writer.release()


def held_mb(process: "subprocess.Popen[bytes]") -> tuple[float, int] | None:
    """What a process holds now, and its threads; None where it has ended."""
    try:
        lines = dict(line.split(":", 1) for line in Path(f"/proc/{process.pid}/status").read_text("ascii").splitlines())
        return int(lines["VmRSS"].split()[0]) / 1024, int(lines["Threads"])
    except (OSError, KeyError):
        return None


def without_steps(held: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """(N,) what was held, less the steps before; and the steps, in MB."""
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


def last_frame(results: Path, read: int) -> tuple[int, int]:
    """Number of the last whole line's frame, and where the file ended."""
    if not results.exists():
        return 0, 0
    with results.open("rb") as file:
        file.seek(max(read - 1, 0))
        lines = file.read().split(b"\n")
        return (json.loads(lines[-2])["frame"] if len(lines) > 2 else 0), file.tell()


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--minutes", type=float, default=30.0, help="of clip time")
    options.add_argument("--pace", type=float, default=20.0, help="times the clip's own speed; 0: every picture waits")
    options.add_argument("--size", default="320x240")
    options.add_argument("--rate", type=float, default=10.0, help="pictures a second of clip time")
    options.add_argument("--people", action="store_true", help="recognize people too")
    options.add_argument("--config", default="fast")
    options.add_argument("--growth-mb", type=float, default=4.0)
    options.add_argument("--json", type=Path)
    asked = options.parse_args()
    size = tuple(int(side) for side in asked.size.split("x"))
    frames = round(60 * asked.minutes * asked.rate)
    with tempfile.TemporaryDirectory() as folder:
        clip, out, second = Path(folder) / "clip.avi", Path(folder) / "out", Path(folder) / "second.jsonl"
        write_clip(clip, frames, size, asked.rate)
        call = [sys.executable, "-c", "from torchvision_dddas.cli import main; main()", "run", str(clip), "--live"]
        call += ["--out", str(out), "--config", asked.config, "--set", f"live.pace={asked.pace:g}", "--quiet"]
        call += ["--emit", f"json:{second}", *(["--people"] if asked.people else [])]
        # A machine that is busy with other things is no hung run.
        call += ["--set", "live.watchdog_s=0"]
        began, samples, read, clip_s = time.monotonic(), [], 0, 0.0
        with subprocess.Popen(call) as run:
            while run.poll() is None:
                time.sleep(1.0)
                number, read = last_frame(second, read)
                clip_s = (number - 1) / asked.rate if number else clip_s
                if (held := held_mb(run)) is not None and number:
                    samples.append((time.monotonic() - began, clip_s, *held))
        (session,) = out.iterdir()
        record = json.loads((session / "run.json").read_text())
        numbers = [json.loads(line)["frame"] for line in (session / "results.jsonl").read_text().splitlines()]
        same = [json.loads(line)["frame"] for line in second.read_text().splitlines()] == numbers
    table = np.array(samples)
    print(f"{'clock':>8s} {'clip':>9s} {'RSS':>9s} {'threads':>8s}")
    for k in np.unique(np.linspace(0, len(table) - 1, ROWS).astype(int)):
        clock_s, at_s, mb, threads = table[k]
        print(f"{clock_s:6.0f} s {at_s / 60:5.1f} min {mb:6.1f} MB {threads:8.0f}")
    level, steps = without_steps(table[:, 2])
    quarters = np.array_split(level, 4)
    growth_mb = float(np.median(quarters[3]) - np.median(quarters[1]))
    counts = {name: record["counts"].get(name, 0) for name in ("captured", "dropped", "looked_at", "results", "late")}
    whole = run.returncode == 0 and record["state"] == "complete" and numbers == sorted(set(numbers)) and same
    minutes = (frames - 1) / asked.rate / 60
    print(
        f"{minutes:.1f} minutes of clip time at {asked.size}, pace {asked.pace:g}, in {table[-1, 0]:.0f} s; "
        + ", ".join(f"{value} {name}" for name, value in counts.items())
    )
    loaded = ", ".join(f"{step:.1f}" for step in steps) or "none"
    print(
        f"RSS from the second quarter to the last: {growth_mb:+.1f} MB, and steps of {loaded} MB; "
        f"most {table[:, 2].max():.1f} MB; {len(numbers)} lines, "
        + ("all whole and in order" if whole else "NOT whole and in order")
    )
    if asked.json is not None:
        content = {
            "samples": samples,
            "growth_mb": growth_mb,
            "steps_mb": steps,
            "counts": counts,
            "whole": whole,
            "asked": vars(asked),
        }
        asked.json.write_text(json.dumps(content, indent=1, default=str) + "\n", encoding="utf-8")
    sys.exit(not whole or growth_mb > asked.growth_mb or len(steps) > MOST_STEPS)


if __name__ == "__main__":
    main()
