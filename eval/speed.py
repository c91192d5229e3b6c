"""How quick the chains are beside the plain OpenCV chain, all in one run, and how well they register.

usage: python eval/speed.py [CLIP...] [--sizes 640x480 1280x720] [--rounds 12] [--chains NAME...] [--json FILE]

A clip is a video, a folder of pictures, or a folder that holds clips. With none the project's own scene is rendered at
each of --sizes. All chains go through the same decoded frames, forwards and backwards, in turns of eight frames, so
that whatever else the machine does meets them all; the first turns are left out. A ratio is the median over the turns
of a chain's time through the plain chain's in the same turn. Garbage is collected between the turns. The processor's
time, over all threads, is told as well: it says what a chain costs where other programs want the second core.
"""

import argparse
import gc
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle torch threads must not spin through the others' turns

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import plain_chain
import registration_error

from torchvision_dddas.run import Loop
from torchvision_dddas.settings import load
from torchvision_dddas.sources import open_source
from torchvision_dddas.types import Frame
from torchvision_dddas.vision import load as load_vision

TURN, WARM_UP = 8, 3
CHAINS = ("onboard fast", "onboard default", "torch fast b1", "torch fast b8", "torch default b1", "torch default b8")


def clips(arguments: list[str], sizes: list[tuple[int, int]]) -> Iterator[tuple[str, list[np.ndarray]]]:
    """(name, frames as BGR) of the clips named, or of the project's own scene."""
    if not arguments:
        from torchvision_dddas.simulation.scene import render

        for size in sizes:
            yield f"scene {size[0]}x{size[1]}", render(seed=0, frames=40, size=size).images
    for argument in arguments:
        folder = Path(argument)
        held = [p for p in sorted(folder.iterdir()) if p.is_dir() and p.name != "masks"] if folder.is_dir() else []
        if (folder / "frames").is_dir():
            yield folder.name, pictures(folder / "frames")
        elif held:
            yield from clips([str(p) for p in held], sizes)
        else:
            yield folder.stem, pictures(folder)


def pictures(path: Path, most: int = 100) -> list[np.ndarray]:
    """Up to `most` decoded BGR frames."""
    found = []
    for frame in open_source(str(path)):
        image = frame.image
        found.append(image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        if len(found) == most:
            break
    return found


def there_and_back(frames: list[np.ndarray], count: int) -> list[np.ndarray]:
    """The clip forwards and backwards until there are `count` frames: no cuts."""
    period = max(2 * len(frames) - 2, 1)
    return [frames[min(i % period, period - i % period)] for i in range(count)]


def plain_turns(frames: list[np.ndarray]) -> Callable[[int], None]:
    """The plain chain on the frames from an index on."""

    def turn(start: int) -> None:
        for i in range(start, start + TURN):
            plain_chain.plain_window(frames[i], frames[i + 1], frames[i + 2])

    return turn


def our_turns(frames: list[np.ndarray], backend: str, config: str, batch: int) -> Callable[[int], None]:
    """The whole loop, frames in, scenes out."""
    settings = load(None if config == "default" else config)
    loop = Loop(load_vision(backend, settings), settings, 10.0, batch=batch)

    def turn(start: int) -> None:
        for i in range(start, start + TURN):
            for _ in loop.feed(Frame(i + 1, i / 10.0, frames[i])):
                pass

    return turn


def timed(frames: list[np.ndarray], chains: list[str], rounds: int) -> dict[str, np.ndarray]:
    """Milliseconds a frame, (rounds, 2) for each chain: by the clock, and of the processor over all threads."""
    frames = there_and_back(frames, (rounds + WARM_UP) * TURN + 2)
    turns = {"plain": plain_turns(frames)}
    for name in chains:
        backend, config, *batch = name.split()
        turns[name] = our_turns(frames, backend, config, int(batch[0][1:]) if batch else 1)
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in turns}
    for k in range(rounds + WARM_UP):
        for name, turn in turns.items():
            gc.collect()
            start, processor = time.perf_counter(), time.process_time()
            turn(k * TURN)
            ms = 1e3 / TURN
            spent[name].append(((time.perf_counter() - start) * ms, (time.process_time() - processor) * ms))
    return {name: np.array(values[WARM_UP:]) for name, values in spent.items()}


def row(spent: np.ndarray, plain: np.ndarray) -> dict[str, float]:
    """The figures of one chain on one clip."""
    (spent, busy), (plain, plain_busy) = spent.T, plain.T
    ratio = spent / plain
    low, middle, high = np.percentile(ratio, [25, 50, 75])
    return {
        "median_ms": float(np.median(spent)),
        "mean_ms": float(spent.mean()),
        "ratio": float(middle),
        "ratio_25": float(low),
        "ratio_75": float(high),
        "ratio_of_means": float(spent.mean() / plain.mean()),
        "processor_ms": float(np.median(busy)),
        "processor_ratio": float(np.median(busy / plain_busy)),
    }


def main() -> None:
    """Measure, print a table a clip and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", nargs="*")
    parser.add_argument("--sizes", nargs="*", default=["640x480", "1280x720"])
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--chains", nargs="*", default=None, help=f"of: {', '.join(CHAINS)}")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    chains = options.chains
    if chains is None:
        chains = [c for c in CHAINS if not c.startswith("torch") or (find_spec("torch") and find_spec("kornia"))]
    sizes = [(int(w), int(h)) for w, h in (size.split("x") for size in options.sizes)]
    report: dict[str, dict] = {"machine": {"cores": os.cpu_count(), "opencv": cv2.__version__}, "clips": {}}
    for name, frames in clips(options.clips, sizes):
        if len(frames) < 10:
            print(f"{name}: {len(frames)} frames are too few", file=sys.stderr)
            continue
        spent = timed(frames, chains, options.rounds)
        rows = {chain: row(values, spent["plain"]) for chain, values in spent.items()}
        errors = registration_error.errors(frames)
        height, width = frames[0].shape[:2]
        report["clips"][name] = {"size": [width, height], "chains": rows, "registration_px": errors}
        print(f"\n{name}, {width}x{height}: ms a frame, and the ratio to plain (quartiles; of means)")
        for chain, r in rows.items():
            spread = f"{r['ratio']:5.2f} ({r['ratio_25']:.2f} to {r['ratio_75']:.2f}; {r['ratio_of_means']:.2f})"
            busy = f"processor {r['processor_ms']:6.1f} ratio {r['processor_ratio']:.2f}"
            print(f"  {chain:18} median {r['median_ms']:6.1f}  mean {r['mean_ms']:6.1f}  ratio {spread}  {busy}")
        for chain, e in errors.items():
            print(
                f"  registration, {chain:10} median {e['median']:.3f} px  p90 {e['p90']:.3f} px  ({e['pairs']} pairs)"
            )
    if options.json:
        options.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
