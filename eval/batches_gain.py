"""What it gains to take clips through torch together: `python eval/batches_gain.py [DATA] [--frames 12] [--rounds 3]`.

Four clips of one size, of DATA (folders with frames/) or rendered, in turns: one after the other with one window at
once, one after the other with eight, and together with eight over all of them. Processor seconds a frame and by the
clock, as ratios to the first way in the same turn; the results are compared to the last digit. Prints Markdown.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import results

from torchvision_dddas.config import Settings, load_config
from torchvision_dddas.detection.detector import Clip, run
from torchvision_dddas.detection.engine import load_engine
from torchvision_dddas.evaluation.studies.batches import scenes_together
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.simulation.scene import render
from torchvision_dddas.types import Frame, Scene

Way = Callable[[dict[str, Clip], Settings, str], dict[str, list[bytes]]]


class First:
    """The first frames of a clip, read before anything is clocked."""

    rate_hz = 10.0

    def __init__(self, frames: list[Frame]) -> None:
        self.frames = frames

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?")
    parser.add_argument("--clips", type=int, default=4)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--configs", default="fast,default")
    parser.add_argument("--backend", default="torch")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    hold(options.threads)
    width, height = (int(side) for side in options.size.split("x"))
    clips = read(options.data, options.clips, options.frames, (width, height))
    count = sum(len(clip.frames) for clip in clips.values())
    print(f"{len(clips)} clips, {count} frames, {options.size}, {options.threads} threads, {options.backend}; ", end="")
    print(f"`{results.command()}`; medians of {options.rounds} turns (lowest–highest):\n")
    print("| configuration | way | processor ms a frame | processor, ratio | clock, ratio |")
    print("| --- | --- | ---: | ---: | ---: |")
    for config in options.configs.split(","):
        rows(
            clips, load_config(None if config == "default" else config), config, options.backend, options.rounds, count
        )


def hold(threads: int) -> None:
    """So many threads for all libraries."""
    import cv2
    import torch

    cv2.setNumThreads(threads)
    torch.set_num_threads(threads)


def read(data: Path | None, clips: int, frames: int, size: tuple[int, int]) -> dict[str, First]:
    """Clips of that size. Ends the program where there are none."""
    if data is None:
        films = {f"film {seed}": render(seed=seed, frames=frames, size=size).images for seed in range(clips)}
        return {name: First([Frame(i + 1, i / 10, im) for i, im in enumerate(f)]) for name, f in films.items()}
    found = {}
    for place in sorted(path for path in data.iterdir() if (path / "frames").is_dir()):
        source = open_source(place / "frames")
        if source.size == size and len(found) < clips:
            found[place.name] = First(list(islice(source, frames)))
    if not found:
        sys.exit(f"{data} holds no clips of {size[0]}x{size[1]}: wanted folders with frames/; nothing was measured")
    return found


def rows(clips: dict[str, First], settings: Settings, config: str, backend: str, rounds: int, count: int) -> None:
    """Measure the ways in turns."""
    ways: dict[str, Way] = {"alone, 1 window": alone(1), "alone, 8 windows": alone(8), "together, 8 windows": together}
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
    kept: dict[str, dict[str, list[bytes]]] = {}
    for turn in range(rounds + 1):  # the first warms up
        for name, way in ways.items():
            clock, processor = time.perf_counter(), time.process_time()
            kept[name] = way(dict(clips), settings, backend)
            if turn:
                spent[name].append((time.process_time() - processor, time.perf_counter() - clock))
    first = next(iter(ways))
    if any(found != kept[first] for found in kept.values()):
        sys.exit(f"{config}: the ways do not give the same")
    base = np.array(spent[first])
    for name, times in spent.items():
        ratio = np.array(times) / base
        low, middle, high = ratio.min(axis=0), np.median(ratio, axis=0), ratio.max(axis=0)
        told = " | ".join(f"{middle[k]:.2f} ({low[k]:.2f}–{high[k]:.2f})" for k in range(2))
        print(f"| {config} | {name} | {1000 * np.median(np.array(times)[:, 0]) / count:.1f} | {told} |", flush=True)


def alone(batch: int) -> Way:
    """One clip after the other."""

    def way(clips: dict[str, Clip], settings: Settings, backend: str) -> dict[str, list[bytes]]:
        engine = load_engine(backend, settings)
        return {name: [digits(s) for s in run(clip, engine, settings, batch=batch)] for name, clip in clips.items()}

    return way


def together(clips: dict[str, Clip], settings: Settings, backend: str) -> dict[str, list[bytes]]:
    """All at once."""
    found: dict[str, list[bytes]] = {name: [] for name in clips}
    for name, scene in scenes_together(clips, load_engine(backend, settings), settings):
        if isinstance(scene, Scene):
            found[name].append(digits(scene))
    return found


def digits(scene: Scene) -> bytes:
    """What a scene holds, to the last digit."""
    step = b"" if scene.step is None else scene.step.later_from_earlier.tobytes()
    return scene.mask.tobytes() + scene.detections.box_px.tobytes() + scene.detections.speed_px.tobytes() + step


if __name__ == "__main__":
    main()
