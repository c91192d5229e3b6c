"""How quick the recognizers are beside cv2.HOGDescriptor on the same pyramid, at 640x480, and on regions of it.

usage: python eval/people_speed.py [PICTURE or FOLDER] [--size 640x480] [--rounds 15] [--chains NAME...] [--json FILE]

The reference is detectMultiScale with steps of 8 px and 1.05, no padding, on OpenCV's threads; all chains go through
the same pictures (by default one of the project's own scene), in turns, so that whatever else the machine does meets
them all. A ratio is the median over the turns of a chain's time through the reference's in the same turn; the
processor's time, over all threads, is told as well. Regions are three of 192x256 px, as a pass for moving targets
might give: `rectangles` has windows inside them at every level, `regions` windows whose body lies inside, `regions
blobs` these for bodies of a third to 1.3 times a blob of 150 px, `regions tracked` for bodies of 150 px up to a factor
of 1.3. `whole graph` is people.onnx on levels that threads share, without what the onboard back end does besides.
"""

import argparse
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle torch threads must not spin through the others' turns

import cv2
import numpy as np
import onnxruntime
from synthetic import render

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.people import pyramid
from torchvision_dddas.people.classifiers import read_classifier
from torchvision_dddas.people.detector import load_scorer
from torchvision_dddas.people.onnx_scorer import OnnxScorer, open_people_graph
from torchvision_dddas.runtime import SHIPPED
from torchvision_dddas.types import Part

KNOBS = PeopleParameters(window_stride_px=8, padding_px=0, scale_step=1.05, enlarge=1, threshold=0)
SVM = read_classifier("opencv", 3780)
REGIONS_PX = np.array([(0.06, 0.2), (0.39, 0.3), (0.67, 0.12)])  # of three regions the corner, in picture sizes
REGION_PX, BLOB_PX = (192, 256), 150


def pictures(source: str | None, size: tuple[int, int], most: int = 20) -> list[np.ndarray]:
    """Up to so many of a picture, folder or clip, or one of the project's own scene, at the size wanted."""
    found = []
    for frame in [] if source is None else open_source(source):
        found.append(frame.image if frame.image.ndim == 3 else cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR))
        if len(found) == most:
            break
    found = found or [render(seed=0, frames=1, size=size).images[0]]
    return [image if image.shape[1::-1] == size else cv2.resize(image, size) for image in found]


def rectangles(regions_px: np.ndarray, size: tuple[int, int]) -> list[Part]:
    """The regions at every level where they hold a window."""
    parts = []
    for level in pyramid.levels(size, KNOBS):
        for x, y, width, height in regions_px / level.scale:
            left, top = (8 * round(value / 8) for value in (x, y))
            part = Part(
                level.size, left, top, min(round(width), level.size[0] - left), min(round(height), level.size[1] - top)
            )
            if part.width >= 64 and part.height >= 128:
                parts.append(part)
    return parts


def chains(size: tuple[int, int]) -> dict[str, Callable[[np.ndarray], object]]:
    """What is compared, the reference first."""
    opencv = cv2.HOGDescriptor()
    opencv.setSVMDetector(np.append(SVM.weights, SVM.bias).astype(np.float32))
    regions_px = np.concatenate([REGIONS_PX * size, np.tile(REGION_PX, (3, 1))], axis=1)
    blob, tracked = ((low * BLOB_PX, high * BLOB_PX) for low, high in ((1 / 3, 1.3), (1 / 1.3, 1.3)))
    parts = {
        "everywhere": pyramid.everywhere(size, KNOBS),
        "rectangles": rectangles(regions_px, size),
        "regions": pyramid.within(regions_px, np.full((3, 2), np.nan), size, KNOBS),
        "regions blobs": pyramid.within(regions_px, np.tile(blob, (3, 1)), size, KNOBS),
        "regions tracked": pyramid.within(regions_px, np.tile(tracked, (3, 1)), size, KNOBS),
    }
    whole = pyramid.cost(parts["everywhere"], KNOBS)
    for name, held in parts.items():
        pixels = sum(part.width * part.height for part in held) / 1e6
        print(
            f"{name:16} {len(held):3} parts, {pixels:.2f} Mpx, {pyramid.cost(held, KNOBS) / whole:4.0%} of the windows"
        )
    onboard = load_scorer(KNOBS, "onboard", SVM)
    found: dict[str, Callable[[np.ndarray], object]] = {
        "cv2": lambda image: opencv.detectMultiScale(image, winStride=(8, 8), padding=(0, 0), scale=1.05)
    }
    for name, held in parts.items():
        found[f"onboard {name}"] = lambda image, held=held: onboard.scores([image], [held])
    found["whole graph"] = whole_graph(parts["everywhere"])
    if find_spec("torch"):
        torch = load_scorer(KNOBS, "torch", SVM)
        found["torch everywhere"] = lambda image: torch.scores([image], [parts["everywhere"]])
    return found


def whole_graph(parts: list[Part]) -> Callable[[np.ndarray], object]:
    """people.onnx on every level, shared among as many threads as OpenCV takes."""
    session, svm = open_people_graph(SHIPPED, "people.onnx"), OnnxScorer(KNOBS, SVM).svm_feed
    threads = ThreadPoolExecutor(cv2.getNumThreads())

    def scored(image: np.ndarray, part: Part) -> np.ndarray:
        level = cv2.resize(image, part.level, interpolation=cv2.INTER_LINEAR_EXACT)
        edged = cv2.copyMakeBorder(level, 1, 1, 1, 1, cv2.BORDER_REFLECT_101)
        return session.run(None, {"image": edged, **svm})[0]

    return lambda image: list(threads.map(lambda part: scored(image, part), parts))


def main() -> None:
    """Measure, print a line a chain and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?")
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--chains", nargs="*")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if options.source and not Path(options.source).exists():
        sys.exit(f"no data at {options.source}: nothing measured")
    width, height = (int(side) for side in options.size.split("x"))
    images = pictures(options.source, (width, height))
    print(
        f"{platform.processor() or platform.machine()}, {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}; "
        f"OpenCV {cv2.__version__} on {cv2.getNumThreads()} threads, ONNX Runtime {onnxruntime.__version__}"
    )
    running = chains((width, height))
    if options.chains:
        running = {name: chain for name, chain in running.items() if name in ("cv2", *options.chains)}
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in running}
    for turn in range(-1, options.rounds):
        for name, chain in running.items():
            wall, processor = time.perf_counter(), time.process_time()
            chain(images[turn % len(images)])
            if turn >= 0:  # the first turn loads graphs
                times[name].append((time.perf_counter() - wall, time.process_time() - processor))
    rows = []
    for name, taken in times.items():
        ratios = [[own[k] / reference[k] for own, reference in zip(taken, times["cv2"], strict=True)] for k in (0, 1)]
        rows.append(
            {
                "chain": name,
                "ms": 1e3 * statistics.median(wall for wall, _ in taken),
                "processor_ms": 1e3 * statistics.median(processor for _, processor in taken),
                "ratio": statistics.median(ratios[0]),
                "processor_ratio": statistics.median(ratios[1]),
            }
        )
        line = "{chain:24} {ms:7.1f} ms, {ratio:5.2f} x; processor {processor_ms:7.1f} ms, {processor_ratio:5.2f} x"
        print(line.format(**rows[-1]))
    if options.json:
        options.json.write_text(json.dumps({"load": os.getloadavg(), "runs": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
