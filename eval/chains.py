"""The chains whose speed and memory are compared, timed in turns and stage by stage.

usage: python eval/chains.py CHAIN VIDEO [GRAPHS]: takes one chain through a video and ends; for a look at its memory
from outside. Nothing is imported but what the chain needs. GRAPHS: a folder by `dddas export --graph step`.
"""

import gc
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle torch threads must not spin through the others' turns

import numpy as np
import plain_chain
from films import Size, there_and_back

from torchvision_dddas.config import load_config
from torchvision_dddas.detection import Engine, Foreground, MotionDetector, View, Window, load_engine
from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Frame, Registration

TURN, WARM_UP = 8, 3
STAGES = ("prepare", "register", "foreground", "targets")
"""Grey pictures; the camera's motion; difference to mask; mask to targets, and all that belongs to no other stage."""
ONBOARD = ("onboard fast", "onboard half", "onboard default")
TORCH = tuple(f"torch {config} b{batch}" for config in ("fast", "default") for batch in (1, 8))
STEP = "graph step"
CHAINS = (*ONBOARD, *TORCH, STEP)
Lanes = Mapping[str, tuple[str, list[np.ndarray]]]
"""By a name, a chain and the frames that it goes through."""


class Stopwatch:
    """Seconds by the clock and of the processor over all threads, added up for each stage."""

    def __init__(self) -> None:
        self.spent: dict[str, np.ndarray] = {}
        self.last = _now()

    def start(self) -> None:
        """What comes next is of the stage that the next lap names."""
        self.last = _now()

    def lap(self, stage: str) -> None:
        """A stage is over; another begins."""
        now = _now()
        self.spent[stage] = self.spent.get(stage, 0) + now - self.last
        self.last = now


def _now() -> np.ndarray:
    return np.array([time.perf_counter(), time.process_time()])


class Clocked:
    """A back end whose stages are clocked: a `Engine` itself."""

    def __init__(self, engine: Engine, watch: Stopwatch) -> None:
        self.engine, self.watch, self.name = engine, watch, engine.name

    def __getattr__(self, name: str) -> Any:
        return getattr(self.engine, name)

    def prepare(self, image: np.ndarray) -> View:
        """As the back end's own, and so the next two."""
        return self._clocked("prepare", self.engine.prepare, image)

    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        """Motion of the camera."""
        return self._clocked("register", self.engine.register, pairs)

    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        """What differs."""
        return self._clocked("foreground", self.engine.foreground, windows)

    def _clocked(self, stage: str, call: Callable[[Any], Any], argument: Any) -> Any:
        self.watch.start()
        result = call(argument)
        self.watch.lap(stage)
        return result


class Chain:
    """One of those compared. boxes: how many were found in each frame of the turn; watch: its stages."""

    def __init__(self, name: str, size: Size, graphs: Path | None = None) -> None:
        """graphs: where the graph is, of `graph step`. Raises InputError where it is not, or not whole."""
        self.watch = Stopwatch()
        self.boxes: list[int] = []
        self.window = 3 if name == "plain" else 1
        if name == "plain":
            self._one = self._plain
            return
        if name == STEP:
            from step_graph import StepGraph

            self.graph = StepGraph(graphs or Path("dddas-graphs"), size)
            self._one = self._graph
            return
        backend, config, *batch = name.split()
        settings = load_config(None if config == "default" else config)
        engine = Clocked(load_engine(backend, settings), self.watch)
        self.loop = MotionDetector(settings, engine, 10.0, batch=int(batch[0][1:]) if batch else 1)
        self._one = self._ours

    def turn(self, frames: list[np.ndarray], start: int, count: int = TURN) -> None:
        """So many frames of a clip, from an index on."""
        for i in range(start, start + count):
            self._one(frames, i)

    def _plain(self, frames: list[np.ndarray], i: int) -> None:
        self.watch.start()
        _, boxes = plain_chain.plain_window(*frames[i : i + 3], self.watch.lap)
        self.boxes.append(len(boxes))

    def _graph(self, frames: list[np.ndarray], i: int) -> None:
        from step_graph import boxes

        self.watch.start()
        greys = self.graph.grey(frames[i])
        self.watch.lap("prepare")
        if len(greys) < 3:
            return
        mask = self.graph.mask(greys)
        self.watch.lap("foreground")  # registration is in it
        self.boxes.append(len(boxes(mask)))

    def _ours(self, frames: list[np.ndarray], i: int) -> None:
        for scene in self.loop.update(Frame(i + 1, i / 10.0, frames[i])):
            self.boxes.append(len(scene.detections.box_px))


def available(names: Sequence[str] = CHAINS, sizes: Sequence[Size] = (), graphs: Path | None = None) -> list[str]:
    """Those that can run here: torch is installed, the configuration is there, and graphs of all the sizes."""
    return [name for name in names if _can_run(name, sizes, graphs)]


def _can_run(name: str, sizes: Sequence[Size], graphs: Path | None) -> bool:
    backend, config = name.split()[:2]
    if name == STEP:
        return graphs is not None and all((graphs / f"step_{w}x{h}.onnx").exists() for w, h in sizes)
    if backend == "torch" and not (find_spec("torch") and find_spec("kornia")):
        return False
    try:
        load_config(None if config == "default" else config)
    except InputError:
        return False
    return True


class Timed:
    """A chain's turns: times by the clock, and of the processor over all threads; boxes: the median."""

    def __init__(self) -> None:
        self._whole: list[np.ndarray] = []
        self._stages: dict[str, list[np.ndarray]] = {stage: [] for stage in STAGES}
        self._boxes: list[int] = []

    def add(self, spent: np.ndarray, stages: dict[str, np.ndarray], boxes: Sequence[int]) -> None:
        """A turn: seconds in all and by stage."""
        ms = 1e3 / TURN
        rest = spent - sum((value for name, value in stages.items() if name != "targets"), np.zeros(2))
        for stage in STAGES[:-1]:
            self._stages[stage].append(ms * stages.get(stage, np.zeros(2)))
        self._stages["targets"].append(ms * rest)
        self._whole.append(ms * spent)
        self._boxes += boxes

    @property
    def whole(self) -> np.ndarray:
        """(turns, 2) ms a frame."""
        return np.array(self._whole)

    @property
    def stages(self) -> dict[str, np.ndarray]:
        """(turns, 2) ms a frame of each stage."""
        return {stage: np.array(turns) for stage, turns in self._stages.items()}

    @property
    def boxes(self) -> float:
        """Targets in a frame."""
        return float(np.median(self._boxes)) if self._boxes else 0.0


def lanes_of(frames: list[np.ndarray], chains: Sequence[str], rounds: int) -> Lanes:
    """The plain chain, and others, on the same clip: forwards and backwards as often as it takes."""
    frames = there_and_back(frames, (rounds + WARM_UP) * TURN + 2)
    return {name: (name, frames) for name in dict.fromkeys(("plain", *chains))}


def timed(lanes: Lanes, rounds: int, graphs: Path | None = None) -> Iterator[dict[str, Timed]]:
    """All lanes, a chain on a clip each, in turns of TURN frames. Yields what was added to after each turn that counts.

    Other programs meet all lanes alike. The first turns do not count.
    """
    running = {
        lane: Chain(name, (frames[0].shape[1], frames[0].shape[0]), graphs) for lane, (name, frames) in lanes.items()
    }
    found = {lane: Timed() for lane in lanes}
    for k in range(rounds + WARM_UP):
        for lane, chain in running.items():
            gc.collect()
            chain.watch.spent, chain.boxes = {}, []
            start = _now()
            chain.turn(lanes[lane][1], k * TURN)
            spent = _now() - start
            if k >= WARM_UP:
                found[lane].add(spent, chain.watch.spent, chain.boxes)
        if k >= WARM_UP:
            yield found


def row(spent: np.ndarray, plain: np.ndarray) -> dict[str, float]:
    """The figures of one chain on one clip, of its turns and of the plain chain's; (turns, 2) each."""
    (spent, busy), (plain, plain_busy) = spent.T, plain.T
    ratio, busy_ratio = spent / plain, busy / plain_busy
    return {
        "median_ms": float(np.median(spent)),
        "mean_ms": float(spent.mean()),
        **quartiles("ratio", ratio),
        "ratio_of_means": float(spent.mean() / plain.mean()),
        **quartiles("processor_ms", busy),
        **quartiles("processor_ratio", busy_ratio),
        "processor_ratio_of_means": float(busy.mean() / plain_busy.mean()),
    }


def quartiles(name: str, values: np.ndarray) -> dict[str, float]:
    """{name: median, name_25, name_75}."""
    low, middle, high = np.percentile(values, [25, 50, 75]).tolist()
    return {name: middle, f"{name}_25": low, f"{name}_75": high}


def alone(name: str, path: str, graphs: str = "") -> None:
    """One chain through a video, as a process that does nothing else. `nothing`: the video is only read."""
    from torchvision_dddas.io.sources import open_source

    source = open_source(path)
    chain = Chain(name, source.size, Path(graphs)) if name != "nothing" else None
    frames: list[np.ndarray] = []
    for frame in source:
        if chain is None:
            continue
        frames = [*frames[1 - chain.window :], frame.image] if chain.window > 1 else [frame.image]
        if len(frames) < chain.window:
            continue
        if name in ("plain", STEP):
            chain.turn(frames, 0, 1)
        else:
            for _ in chain.loop.update(frame):
                pass


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit(__doc__)
    alone(*sys.argv[1:])
