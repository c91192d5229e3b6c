"""The peak memory of `dddas detect --backend onboard` on videos of two lengths: is it small, and is it flat?

usage: python eval/memory.py [--frames 100 400] [--size 1280x720] [--config NAME...] [--json FILE]

The video is the project's own scene, run forwards and backwards. Each run is a process of its own; /proc tells every
50 ms what it holds (VmRSS) and the most that it ever held (VmHWM).
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from films import scene, write_video


def measured(command: list[str]) -> dict[str, float]:
    """Peak and late growth of a command's resident memory in MB, and its seconds."""
    start, held, peak = time.perf_counter(), [], []
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    status = Path(f"/proc/{process.pid}/status")
    while process.poll() is None:
        lines = status.read_text().splitlines() if status.exists() else []
        held += [int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS")]
        peak += [int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM")]
        time.sleep(0.05)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with {process.returncode}")
    half = len(held) // 2
    growth = max(held[half:]) - max(held[: max(half, 1)])
    return {"peak_mb": max(peak), "second_half_mb": growth, "seconds": time.perf_counter() - start}


def main() -> None:
    """Measure, print a line a run and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="*", default=[100, 400])
    parser.add_argument("--size", default="1280x720")
    parser.add_argument("--config", nargs="*", default=["default", "fast"])
    parser.add_argument("--save", nargs="*", default=["none", "masks", "all"])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    width, height = (int(v) for v in options.size.split("x"))
    images, rows = scene((width, height), 30), []
    with tempfile.TemporaryDirectory() as folder:
        for count in options.frames:
            write_video(Path(folder) / f"{count}.mp4", images, count)
        for config in options.config:
            for save in options.save:
                for count in options.frames:
                    out = str(Path(folder) / f"{config}-{save}-{count}")
                    command = [str(Path(sys.executable).with_name("dddas")), "detect", f"{folder}/{count}.mp4"]
                    command += ["--out", out, "--backend", "onboard", "--save", save, "--quiet"]
                    command += [] if config == "default" else ["--config", config]
                    rows.append({"config": config, "save": save, "frames": count, **measured(command)})
                    print(
                        "{config:8} save {save:6} {frames:5} frames: peak {peak_mb:6.1f} MB, ".format(**rows[-1]),
                        end="",
                    )
                    print("second half {second_half_mb:+5.1f} MB, {seconds:.1f} s".format(**rows[-1]), flush=True)
    if options.json:
        options.json.write_text(json.dumps({"runs": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
