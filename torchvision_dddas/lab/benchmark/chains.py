"""Measure frame rate, memory and stages of the detection chain by engine and configuration, beside plain OpenCV."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from torchvision_dddas.config import load_config
from torchvision_dddas.detection import MotionDetector
from torchvision_dddas.lab.benchmark.plain_chain import plain_window
from torchvision_dddas.memory import peak_memory_mb, reset_peak_memory
from torchvision_dddas.types import Frame, Scene

Size = tuple[int, int]
"""Width and height in pixels."""

CHAINS = ("onboard fast", "onboard half", "onboard patrol", "onboard default", "torch fast", "torch default")
"""Engine and configuration, roughly from fast to slow."""

STAGES = ("prepare", "register", "foreground", "targets")
_LEAST_FRAMES, _MOST_TURNS, _RATE_HZ = 4, 10, 10.0
_PERIOD = 60  # frames after which the camera turns back


@dataclass(frozen=True)
class ChainFigures:
    """Medians over turns. In each turn the chain and the plain chain process the same frames.

    rate_hz, plain_hz: frames per second. ratio: time of the chain divided by that of the plain chain in the same turn.
    peak_mb: memory of the whole process. stages_ms: milliseconds per frame, in the order of STAGES.
    """

    chain: str
    size: Size
    rate_hz: float
    plain_hz: float
    ratio: float
    peak_mb: float
    stages_ms: tuple[float, ...]


def measure_chains(
    chains: Sequence[str], sizes: Sequence[Size], seconds: float, tell: Callable[[str], None] = lambda text: None
) -> Iterator[ChainFigures]:
    """Yield the figures of each chain at each size until the time is over.

    A cell is a chain at a size. It gets a share of the remaining time by its pixels, but takes ten turns at most, so
    that fast cells leave time for others. tell: called with the name of each cell before its measurement.
    """
    cells = [(chain, size) for size in sorted(sizes) for chain in chains]
    cells.sort(key=lambda cell: cell[0].startswith("torch"))  # torch last: it raises the memory of later chains
    weights, deadline = [width * height for _, (width, height) in cells], time.perf_counter() + seconds
    for k, (chain, size) in enumerate(cells):
        if (left := deadline - time.perf_counter()) <= 0:
            return
        tell(f"{k + 1} of {len(cells)}: {chain} at {size[0]}x{size[1]}, {left:.0f} s left")
        share = time.perf_counter() + left * weights[k] / sum(weights[k:])
        figures = measure_chain(chain, size, share, deadline)
        if figures is not None:
            yield figures


def measure_chain(chain: str, size: Size, share: float, deadline: float) -> ChainFigures | None:
    """Measure a chain for at least one turn, until the clock shows `share`. Return None without a turn by `deadline`.

    The turns before the first scene warm up the chain.
    """
    engine, config = chain.split()
    reset_peak_memory()
    detector = MotionDetector(load_config(None if config == "default" else config), backend=engine, rate_hz=_RATE_HZ)
    count, first, is_warm = max(_LEAST_FRAMES, detector.batch), 0, False
    spent: list[tuple[float, float]] = []
    stages: list[list[float]] = []
    while len(spent) < _MOST_TURNS and time.perf_counter() < (share if spent else deadline):
        frames = [draw_frame(size, first + i) for i in range(count + 2)]
        start = time.perf_counter()
        scenes = [
            scene
            for i, image in enumerate(frames[:count], first)
            for scene in detector.update(Frame(i + 1, i / _RATE_HZ, image))
        ]
        middle = time.perf_counter()
        if is_warm:
            for i in range(count):
                plain_window(frames[i], frames[i + 1], frames[i + 2])
            spent.append((middle - start, time.perf_counter() - middle))
            stages += [_stages_ms(scene) for scene in scenes]
        is_warm, first = is_warm or bool(scenes), first + count
    if not spent or not stages:
        return None
    own, plain = np.array(spent).T
    rates = count / float(np.median(own)), count / float(np.median(plain))
    medians = tuple(np.median(stages, axis=0).tolist())
    return ChainFigures(chain, size, *rates, float(np.median(own / plain)), peak_memory_mb(), medians)


def _stages_ms(scene: Scene) -> list[float]:
    named = [scene.seconds.get(stage, 0.0) for stage in STAGES[:-1]]
    return [1e3 * seconds for seconds in (*named, sum(scene.seconds.values()) - sum(named))]


def draw_frame(size: Size, number: int) -> np.ndarray:
    """Draw a frame (H, W, 3) of a camera that drifts and rolls over textured ground with six moving bodies."""
    (width, height), scene = size, _ground(size).copy()
    step = abs(number % (2 * _PERIOD) - _PERIOD)
    for k in range(6):
        across = (0.15 + 0.05 * k if k % 2 else 0.95 - 0.05 * k) + (-1) ** (k + 1) * (0.006 + 0.001 * k) * step
        left, top = round(across * width), round((0.3 + 0.13 * k) * height)
        side = round(width / (12 if k < 3 else 24))
        cv2.rectangle(
            scene, (left, top), (left + side, top + side // 2), (240, 240, 240) if k % 2 else (15, 15, 15), -1
        )
    roll = cv2.getRotationMatrix2D((width * 0.625, height * 0.625), 0.02 * step, 1.0)
    roll[:, 2] -= np.array([width * (0.07 + 0.0009 * step), height * 0.1])
    return cv2.warpAffine(scene, roll, size, borderMode=cv2.BORDER_REFLECT)


@lru_cache(maxsize=1)
def _ground(size: Size) -> np.ndarray:
    """Return a ground of noise at five scales, a quarter larger than the pictures."""
    rng, (width, height) = np.random.default_rng(0), size
    full = np.full((height * 5 // 4, width * 5 // 4), 120.0, np.float32)
    for scale in (2, 6, 20, 60, 180):
        few = rng.normal(0, 14, (full.shape[0] // scale + 2, full.shape[1] // scale + 2)).astype(np.float32)
        full += cv2.resize(few, full.shape[::-1], interpolation=cv2.INTER_CUBIC)
    grey = full.clip(0, 255).astype(np.uint8)
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
