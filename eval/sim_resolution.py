"""Time of a frame against the resolution, from 320x240 to 1920x1080: the source's figure 9 of appendix B.

    python eval/sim_resolution.py --write eval/README.md --plot docs/sim_resolution.png

Each world is drawn once at the largest size and made smaller by areas; all sizes and configurations go through the
frames in turns of TURN, forwards and backwards, so that whatever else the machine does meets them all. A figure of a
world is the median over its turns, the first ones left out. --jobs is not used: processes would slow each other.
"""

import os
import platform
import sys
import time
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import cv2
import numpy as np
from films import resized
from sim_runs import Case, Over, finish, options, pyplot, run_all, table
from sim_scenes import Kept, walking

from torchvision_dddas.config import load_config, with_parameters
from torchvision_dddas.detection import MotionDetector
from torchvision_dddas.simulation import SimulatorSource
from torchvision_dddas.types import Frame

SIZES = ((320, 240), (640, 480), (800, 600), (960, 720), (1280, 720), (1920, 1080))
CONFIGS = ("patrol", "fast", "source")
TURN, WARM_UP = 8, 3
SOURCE_S = 0.2
"""The source's bound up to 960x720, on a quad-core board at 1.7 GHz."""


def work(case: Case) -> Case:
    """The median time of a frame at each size with each configuration, seconds."""
    largest = (1920, 1440)
    scenario = walking(
        case["seed"], case["seconds"],
        uav={"altitude_m": 50.0},
        camera={"width_px": largest[0], "height_px": largest[1]},
        world={"side_m": 200.0, "texel_m": 0.05},
    )  # fmt: skip
    source = SimulatorSource(scenario)
    kept = Kept(source)
    loops, frames = {}, {}
    for size in SIZES:
        frames[size] = [resized(frame.image, size) for frame in kept.frames]
        focal = source.camera.focal_px[0] * size[0] / largest[0]
        for config in CONFIGS:
            settings = with_parameters(load_config(config), {"gates.focal_px": focal})
            loops[size, config] = MotionDetector(settings, "onboard", kept.rate_hz, kept.log)
    times: dict[tuple[tuple[int, int], str], list[float]] = {key: [] for key in loops}
    order = list(range(len(kept.frames)))
    order += order[-2:0:-1]
    for turn in range(WARM_UP + case["turns"]):
        for (size, config), loop in loops.items():
            start = time.perf_counter()
            for step in range(TURN):
                number = turn * TURN + step
                image = frames[size][order[number % len(order)]]
                for _ in loop.update(Frame(number + 1, number / kept.rate_hz, image)):
                    pass
            if turn >= WARM_UP:
                times[size, config].append((time.perf_counter() - start) / TURN)
    return {key(size, config): float(np.median(spent)) for (size, config), spent in times.items()}


def key(size: tuple[int, int], config: str) -> str:
    """Of a figure."""
    return f"{size[0]}x{size[1]}, {config}"


def tables(results: list[Case]) -> str:
    """A row a size."""
    return table(
        ["resolution", *(f"{config}: ms a frame" for config in CONFIGS)],
        [
            [
                f"{size[0]}×{size[1]}",
                *(Over(result[key(size, config)] for result in results).text(1, 1000) for config in CONFIGS),
            ]
            for size in SIZES
        ],
    )


def draw(results: list[Case], path: Path) -> None:
    """Time against pixels."""
    plt = pyplot()
    figure, axis = plt.subplots(figsize=(6.8, 4.2), constrained_layout=True)
    pixels = [size[0] * size[1] / 1e6 for size in SIZES]
    for config, colour in zip(CONFIGS, ("#0b6e99", "#448361", "#d9730d"), strict=True):
        overs = [Over(result[key(size, config)] for result in results) for size in SIZES]
        axis.errorbar(pixels, [1000 * o.mean for o in overs], [1000 * np.nan_to_num(o.error) for o in overs],
                      fmt="o-", color=colour, ms=5, capsize=3, label=config)  # fmt: skip
    bound = [p for p in pixels if p <= 0.7]
    axis.plot([0, max(bound)], [1000 * SOURCE_S] * 2, "--", color="#888888", label="source, an upper bound")
    axis.set(xlim=(0, None), ylim=(0, None), ylabel="time of a frame, ms")
    axis.set_xticks(pixels, [f"{w}×{h}" for w, h in SIZES], rotation=40, ha="right", fontsize=8)
    axis.legend(frameon=False)
    axis.set_title("Detection against the resolution", fontsize=12, weight="bold")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run what is missing, print the tables, and write what was asked for."""
    parser = options(__doc__, seeds=20, seconds=2.4)
    parser.add_argument("--turns", type=int, default=6, help="that count, of each size, in each world; 6")
    asked = parser.parse_args()
    cases = [{"seed": seed, "seconds": asked.seconds, "turns": asked.turns} for seed in range(asked.seeds)]
    results = run_all(cases, work, asked.cache, 1)
    machine = f"{platform.machine()}, {os.cpu_count()} cores, OpenCV {cv2.__version__}"
    turns = f"medians of {asked.turns} turns of {TURN} frames"
    note = f"{asked.seeds} worlds, {turns}: mean ± standard error (range over worlds); {machine}."
    runs = [{**case, "seconds": result} for case, result in zip(cases, results, strict=True)]
    finish(asked, "sim-resolution", tables(results) + "\n\n" + note, {"runs": runs}, partial(draw, results))


if __name__ == "__main__":
    main()
