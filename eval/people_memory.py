"""The peak memory of a process that recognizes people onboard, and whether it is flat.

usage: python eval/people_memory.py [--size 640x480] [--frames 30] [--threads 2] [--set KNOB=VALUE ...]

A process of its own, with all that it imports, searches pictures of noise everywhere: once with OpenCV's pyramid, once
with the settings as they are. /proc tells the most that it ever held (VmHWM) after each frame.
"""

import argparse
import json
import subprocess
import sys

CHILD = """
import json, sys
from pathlib import Path
import cv2
import numpy as np
from torchvision_dddas.config import load_config
from torchvision_dddas.people.detector import load_scorer
from torchvision_dddas.targets import scan

def held_mb():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))

width, height, frames, threads, *chosen = sys.argv[1:]
size, parameters = (int(width), int(height)), load_config(None, chosen).people
cv2.setNumThreads(int(threads))
held = [held_mb()]
recognizer = load_scorer(parameters, "onboard")
for frame in range(int(frames)):
    image = np.random.default_rng(frame).integers(0, 256, (size[1], size[0], 3), np.uint8)
    recognizer.scores([image], [scan.everywhere(size, parameters)])
    held.append(held_mb())
print(json.dumps({"held": held, "torch": "torch" in sys.modules}))
"""
OPENCV = ["people.enlarge=1", "people.padding_px=0", "people.scale_step=1.05"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--set", nargs="*", default=[], dest="overrides")
    options = parser.parse_args()
    numbers = [*options.size.split("x"), str(options.frames), str(options.threads)]
    for name, chosen in (("OpenCV's pyramid", OPENCV), ("as settings are", [])):
        command = [sys.executable, "-c", CHILD, *numbers, *chosen, *options.overrides]
        found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        held = found["held"]
        print(f"{name:18} {options.size}, {options.threads} threads: imports {held[0]:.1f} MB, ", end="")
        print(f"first frame {held[1]:.1f} MB, peak {held[-1]:.1f} MB, ", end="")
        print(f"{held[-1] - held[len(held) // 2]:+.1f} MB in the second half; ", end="")
        print(f"torch {'was' if found['torch'] else 'not'} imported")


if __name__ == "__main__":
    main()
