"""Check whether a board keeps up: latency of the onboard chain and the graphs, and peak memory. Needs no torch.

usage: python export/check_latency.py [CLIP] [--size 640x480] [--config fast] [--rate 25] [--frames 100] [--people]

Run it where the package is installed. CLIP is a video or a folder of pictures. Without CLIP, the project's own scene
is rendered at --size. The script prints milliseconds per frame (median, 95th and 99th percentile, maximum) beside the
time that --rate leaves, the time of one set of landmarks through the homography graph, and the peak memory.
The exit code is 0 if the 99th percentile fits the rate, else 1.
"""

import argparse
import os
import platform
import resource
import sys
import time
from collections.abc import Callable, Iterator
from itertools import islice

import numpy as np

from torchvision_dddas.config import load_config
from torchvision_dddas.detection import MotionDetector
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.plane_homography import load_solver
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.lab.simulation import film, load_scenario
from torchvision_dddas.people.detector import load_scorer
from torchvision_dddas.types import Frame

WARM_UP = 10


def pictures(clip: str | None, size: tuple[int, int], count: int) -> Iterator[np.ndarray]:
    """Yield `count` decoded frames. The clip is played forwards and backwards until there are enough."""
    if clip is None:
        held = [image for image, _ in film(load_scenario("demo"), 0, 20, size)]
    else:
        held = [frame.image for frame in islice(open_source(clip), 40)]
    period = max(2 * len(held) - 2, 1)
    return (held[min(i % period, period - i % period)] for i in range(count))


def spent_ms(work: Callable[[], object]) -> float:
    """Return the wall-clock time of a call, milliseconds."""
    start = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - start)


def told(name: str, ms: list[float]) -> str:
    """Return the line to print about the times of a stage."""
    middle, most, nearly, worst = np.percentile(ms, [50, 95, 99, 100])
    return f"{name:24s} {middle:8.2f} {most:8.2f} {nearly:8.2f} {worst:8.2f}"


def homography_ms() -> list[float]:
    """Return the times of repeated homographies from six landmarks."""
    solver, weight = load_solver("onboard"), np.ones((1, 6))
    ground = np.array([[[0.0, 0], [10, 0], [10, 8], [0, 9], [4, 5], [7, 3]]])
    image = 40 * ground + [100.0, 50.0]
    return [spent_ms(lambda: solver.solve(ground, image, weight)) for _ in range(500)][100:]


def people_ms(images: list[np.ndarray]) -> list[float]:
    """Return the times of the most expensive search: all windows of all levels of whole pictures."""
    from torchvision_dddas.people.classifiers import read_classifier
    from torchvision_dddas.people.pyramid import everywhere

    parameters = load_config(None, []).people
    recognizer = load_scorer(parameters, "onboard", read_classifier(parameters.classifier, parameters.features))
    parts = everywhere(images[0].shape[1::-1], parameters)
    return [spent_ms(lambda image=image: recognizer.scores([image], [parts])) for image in images][1:]  # type: ignore[misc]


def checked(options: argparse.Namespace) -> bool:
    """Measure and print. Return whether the chain keeps the rate."""
    width, _, height = options.size.partition("x")
    settings = load_config(options.config, [])
    loop = MotionDetector(settings, backend="onboard", rate_hz=options.rate)
    ms: list[float] = []
    last = None
    for i, image in enumerate(pictures(options.clip, (int(width), int(height)), options.frames + WARM_UP)):
        frame = Frame(i + 1, i / options.rate, image)
        ms.append(spent_ms(lambda frame=frame: loop.update(frame)))  # type: ignore[misc]
        last = image
    assert last is not None
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    print(f"{platform.machine()}, {cores} core(s), {last.shape[1]}x{last.shape[0]}, {options.config}, load", end=" ")
    print(f"{os.getloadavg()[0]:.1f}; {1e3 / options.rate:.1f} ms a frame at {options.rate:g} frames/s")
    print(f"{'ms':24s} {'middle':>8s} {'95 %':>8s} {'99 %':>8s} {'worst':>8s}")
    print(told("a frame", ms[WARM_UP:]))
    print(told("a set of 6 landmarks", homography_ms()))
    if options.people:
        print(told("people, everywhere", people_ms([last] * 6)))
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 1024)
    print(f"peak memory {peak_mb:.0f} MB, the clip and what rendered it included")
    kept = bool(np.percentile(ms[WARM_UP:], 99) <= 1e3 / options.rate)
    print("keeps up" if kept else "does not keep up: a smaller size, a quicker configuration or a lower --rate may")
    return kept


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", nargs="?")
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--config", default="fast")
    parser.add_argument("--rate", type=float, default=25.0)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--people", action="store_true")
    try:
        kept = checked(parser.parse_args())
    except InputError as error:
        print(f"check_latency: {error}", file=sys.stderr)
        sys.exit(2)
    sys.exit(0 if kept else 1)


if __name__ == "__main__":
    main()
