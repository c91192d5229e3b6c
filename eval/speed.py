"""Measure time and memory beside a reference in the same turns. Ratios are medians over turns, with quartiles.

python eval/speed.py detection [DATA]   time per frame by stage and resolution, beside plain OpenCV; onboard, torch
python eval/speed.py memory             peak memory of one chain alone, of `dddas detect` and of `dddas people`
python eval/speed.py people             the person detector beside cv2.HOGDescriptor on the same pyramid
python eval/speed.py geo                homographies, poses and conversions beside NumPy's and OpenCV's solvers
python eval/speed.py operations         the batched operations beside Kornia's and OpenCV's, per picture
python eval/speed.py batches            the torch engine with more or fewer pictures in work at once
python eval/speed.py gpu                frame rate and the operations' forms on an accelerator; see `make gpu`
python eval/speed.py association SEQ    the source's association of a MOTChallenge sequence, onboard and torch

Processor time is summed over threads. The ratio of two times in the same turn is least sensitive to other programs.
Without DATA, detection is timed on the tests' synthetic scene.
"""

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import bench
import cv2
import numpy as np
from clips import Size, clips_in, film_of, frames_of, read_frames, resize, scene, there_and_back, truth_of, write_video

from torchvision_dddas.config import PeopleParameters, Settings, load_config
from torchvision_dddas.detection import Engine, Foreground, MotionDetector, View, Window, load_engine
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.lab.benchmark import plain_chain
from torchvision_dddas.tracking import Tracker, source_tracker
from torchvision_dddas.types import Frame, Registration, Tracks, is_sampled

TURN_FRAMES, WARM_UP = 8, 3
STAGES = ("prepare", "register", "foreground", "targets")
"""Grey pictures; camera motion; difference to mask; mask to targets with everything outside of other stages."""
CHAINS = (
    "onboard fast", "onboard half", "onboard default", "torch fast b1", "torch fast b8", "torch default b1",
    "torch default b8",
)  # fmt: skip
"""Engine, configuration and batch size."""


# -- chains ----------------------------------------------------------------------------------------------------------


class Stopwatch:
    """Clock and processor seconds, summed for each stage."""

    def __init__(self) -> None:
        self.spent: dict[str, np.ndarray] = {}
        self._last = bench.now()

    def start(self) -> None:
        """Start the stage that the next lap names."""
        self._last = bench.now()

    def lap(self, stage: str) -> None:
        """End a stage and start another."""
        now = bench.now()
        self.spent[stage] = self.spent.get(stage, 0) + now - self._last
        self._last = now


class TimedEngine:
    """An engine that times its stages."""

    def __init__(self, engine: Engine, watch: Stopwatch) -> None:
        self._engine, self._watch, self.name = engine, watch, engine.name

    def __getattr__(self, name: str) -> Any:
        return getattr(self._engine, name)

    def prepare(self, image: np.ndarray) -> View:
        """Prepare an image with the engine, and time it."""
        return self._timed("prepare", self._engine.prepare, image)

    def register(self, pairs: Sequence[tuple[View, View]]) -> list[Registration]:
        """Register pairs with the engine, and time it."""
        return self._timed("register", self._engine.register, pairs)

    def foreground(self, windows: Sequence[Window]) -> list[Foreground]:
        """Find the foreground of windows with the engine, and time it."""
        return self._timed("foreground", self._engine.foreground, windows)

    def _timed(self, stage: str, call: Callable[[Any], Any], argument: Any) -> Any:
        self._watch.start()
        result = call(argument)
        self._watch.lap(stage)
        return result


class Chain:
    """A detection chain on a clip: "plain", or engine, configuration and batch size as in CHAINS.

    stages: seconds of the stages in each turn. targets: numbers of found targets.
    """

    def __init__(self, name: str, frames: Sequence[np.ndarray]) -> None:
        self.frames, self.targets = frames, list[int]()
        self.stages: list[dict[str, np.ndarray]] = []
        self._watch = Stopwatch()
        self._detector: MotionDetector | None = None
        if name != "plain":
            engine, config, *batch = name.split()
            settings = load_config(None if config == "default" else config)
            timed: Any = TimedEngine(load_engine(engine, settings), self._watch)
            self._detector = MotionDetector(
                settings, backend=timed, rate_hz=10.0, batch=int(batch[0][1:]) if batch else 1
            )

    def __call__(self, turn: int) -> None:
        """Process the frames of a turn and record their times."""
        self._watch.spent = {}
        for i in range(turn * TURN_FRAMES, (turn + 1) * TURN_FRAMES):
            self.process(i)
        self.stages.append(self._watch.spent)

    def process(self, i: int) -> None:
        """Process one frame."""
        if self._detector is None:
            self._watch.start()
            _, boxes = plain_chain.plain_window(*self.frames[i : i + 3], self._watch.lap)
            self.targets.append(len(boxes))
            return
        for found in self._detector.update(Frame(i + 1, i / 10.0, self.frames[i])):
            self.targets.append(len(found.detections.box_px))


def available_chains(wanted: Iterable[str]) -> list[str]:
    """Return the chains that can run here. Torch chains need torch."""
    has_torch = find_spec("torch") is not None and find_spec("kornia") is not None
    return [name for name in wanted if has_torch or not name.startswith("torch")]


def time_chains(clips: Mapping[str, Sequence[np.ndarray]], names: Sequence[str], rounds: int) -> dict[str, Any]:
    """Time all chains on all clips in turns of TURN_FRAMES frames. Return {clip: {chain: figures}}."""
    count = (rounds + WARM_UP) * TURN_FRAMES + 2
    chains = {
        (clip, name): Chain(name, there_and_back(frames, count))
        for clip, frames in clips.items()
        for name in ("plain", *names)
    }
    labels = {f"{clip}|{name}": chain for (clip, name), chain in chains.items()}
    spent = bench.time_in_turns(labels, rounds, WARM_UP)
    found: dict[str, Any] = {clip: {} for clip in clips}
    for (clip, name), chain in chains.items():
        own, plain = (spent[f"{clip}|{one}"] / TURN_FRAMES for one in (name, "plain"))
        found[clip][name] = bench.compare_turns(own, plain) | {
            "stages_ms": stage_times(chain.stages[WARM_UP:], own),
        }
    return found


def stage_times(turns: Sequence[Mapping[str, np.ndarray]], whole_s: np.ndarray) -> dict[str, float]:
    """Return median processor ms per frame of each stage. The targets' stage includes the rest of the whole."""
    times = {
        stage: np.array([turn.get(stage, np.zeros(2))[1] for turn in turns]) / TURN_FRAMES for stage in STAGES[:-1]
    }
    times["targets"] = whole_s[:, 1] - sum(times.values())
    return {stage: 1e3 * float(np.median(values)) for stage, values in times.items()}


# -- studies ---------------------------------------------------------------------------------------------------------


def measure_detection(options: bench.Options) -> tuple[str, Any]:
    """Measure the time per frame by stage at several resolutions, beside the plain chain."""
    chains, load = available_chains(options.chains), bench.OtherLoad()
    clips: dict[str, Sequence[np.ndarray]] = {}
    sizes = [bench.parse_size(size) for size in options.sizes]
    for name, frames in _films(options.data, sizes[0]):
        for size in sizes:
            if frames is None or (frames[0].shape[1] >= size[0] and frames[0].shape[0] >= size[1]):
                shown = scene(size, 24) if frames is None else [resize(frame, size) for frame in frames]
                clips[f"{name} {size[0]}×{size[1]}"] = shown
    found = {}
    for clip, frames in clips.items():
        found |= time_chains({clip: frames}, chains, options.rounds)
        bench.log(clip, {name: round(row["processor_ratio"], 2) for name, row in found[clip].items()})
    rows, stages = [], []
    for name in ("plain", *chains):
        parts = [by[name] for by in found.values()]
        rows.append([name, *(f"{p['clock_ms']:.1f}, {p['processor_ms']:.1f} / {bench.format_ratio(p)}" for p in parts)])
    for clip, by in found.items():
        for name, row in by.items():
            stages.append([clip, name, *(f"{row['stages_ms'][stage]:.2f}" for stage in STAGES)])
    text = (
        f"{bench.machine_words()}; {load.words()}. Milliseconds a frame by the clock, processor milliseconds over all "
        f"threads / their ratio to the plain chain's in the same turn (quartiles); medians of {options.rounds} turns "
        f"of {TURN_FRAMES} frames:\n\n{bench.format_table(['chain', *found], rows)}\n\n"
        "Processor milliseconds a frame by stage:\n\n"
        f"{bench.format_table(['clip', 'chain', *STAGES], stages, words=2)}"
    )
    sides = {clip: frames[0].shape[0] * frames[0].shape[1] / 1e6 for clip, frames in clips.items()}
    lines = {
        name: {"x": list(sides.values()), "y": [found[clip][name]["processor_ratio"] for clip in sides]}
        for name in chains
    }
    panel = {"title": "beside the plain chain", "xlabel": "megapixels", "ylabel": "processor time, ratio"}
    bench.draw(options.plot, [panel | {"lines": lines}])
    return text, found


def _films(data: Path | None, size: Size) -> Iterable[tuple[str, list[np.ndarray] | None]]:
    if data is None:
        yield "scene", None
        return
    for place in clips_in(data):
        yield place.name, read_frames(place / "frames", 40)


def measure_memory(options: bench.Options) -> tuple[str, Any]:
    """Measure the peak memory of a process that runs a chain on a video. "nothing" only reads the video.

    `dddas detect` and `dddas people` run on videos of two lengths, to show whether memory grows with length.
    """
    width, height = bench.parse_size(options.size)
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for frames in options.frames:
            video = Path(folder) / f"{frames}.mp4"
            write_video(video, scene((width, height), 24), frames)
            commands = {
                name: [sys.executable, __file__, "chain", str(video), "--name", name]
                for name in ("nothing", "plain", *available_chains(options.chains))
            }
            dddas = [sys.executable, "-c", "from torchvision_dddas.cli import main; main()"]
            words = [str(video), "--quiet", "--save", "none", "--out"]
            for config in ("default", "fast"):
                place = f"{folder}/{config}-{frames}"
                commands[f"dddas detect, {config}"] = [
                    *[*dddas, "detect", *words, place, "--backend", "onboard"],
                    *(["--config", config] if config == "fast" else []),
                ]
            commands["dddas people"] = [*dddas, "people", *words, f"{folder}/people-{frames}"]
            for name, command in commands.items():
                found.setdefault(name, {})[frames] = bench.measure_memory(command)
                bench.log(name, frames, found[name][frames])
    rows = [[name, *(f"{by[n]['peak_mb']:.0f}" for n in options.frames)] for name, by in found.items()]
    head = [f"peak MB at {options.size}", *(f"{n} frames" for n in options.frames)]
    return bench.format_table(head, rows), found


def run_chain(options: bench.Options) -> tuple[str, Any]:
    """Run a chain on a video and end (used by `memory`)."""
    frames: list[np.ndarray] = []
    chain = None if options.name == "nothing" else Chain(options.name, frames)
    for frame in open_source(options.data):
        if chain is None:
            continue
        frames.append(frame.image)
        ready = len(frames) - (3 if options.name == "plain" else 1)
        if ready >= 0:
            chain.process(ready)
            frames[ready] = frames[ready][:0]  # free the picture but keep the indices
    return "", None


def measure_people(options: bench.Options) -> tuple[str, Any]:
    """Measure the person detector beside detectMultiScale with steps of 8 px and 1.05, without padding.

    There are three regions of 192×256 px. "regions" scores windows whose body lies inside. "regions, blobs" scores
    windows for bodies of 1/3 to 1.3 times a blob of 150 px.
    """
    from torchvision_dddas.people import pyramid
    from torchvision_dddas.people.classifiers import read_classifier
    from torchvision_dddas.people.detector import load_scorer

    parameters = PeopleParameters(window_stride_px=8, padding_px=0, scale_step=1.05, enlarge=1, threshold=0)
    svm, size = read_classifier("opencv", 3780), bench.parse_size(options.size)
    images = [resize(image, size) for image in read_frames(options.data, 20)] if options.data else scene(size, 4)
    opencv = cv2.HOGDescriptor()
    opencv.setSVMDetector(np.append(svm.weights, svm.bias).astype(np.float32))
    corners = np.array([(0.06, 0.2), (0.39, 0.3), (0.67, 0.12)]) * size
    regions_px = np.concatenate([corners, np.tile((192, 256), (3, 1))], axis=1)
    parts = {
        "everywhere": pyramid.everywhere(size, parameters),
        "regions": pyramid.within(regions_px, np.full((3, 2), np.nan), size, parameters),
        "regions, blobs": pyramid.within(regions_px, np.tile((50.0, 195.0), (3, 1)), size, parameters),
    }
    calls: dict[str, Callable[[int], object]] = {
        "cv2.HOGDescriptor": lambda turn: opencv.detectMultiScale(
            images[turn % len(images)], winStride=(8, 8), padding=(0, 0), scale=1.05
        )
    }
    for engine in available_chains(("onboard", "torch")):
        scorer = load_scorer(parameters, engine, svm)
        for name, part in parts.items() if engine == "onboard" else [("everywhere", parts["everywhere"])]:
            calls[f"{engine}, {name}"] = lambda turn, s=scorer, p=part: s.scores([images[turn % len(images)]], [p])
    return _beside_first(calls, options.rounds, f"People, {options.size}")


def measure_geo(options: bench.Options) -> tuple[str, Any]:
    """Measure homographies of landmarks, poses with all checks, and conversions of degrees."""
    from geo_error import georeferencer_inputs, settings_for
    from geo_scene import CAMERA, Case, scenes

    from torchvision_dddas.geo.georeferencer import Georeferencer
    from torchvision_dddas.geo.plane_homography import load_solver
    from torchvision_dddas.geometry import east_north, lonlat

    solvers = {name: load_solver(name) for name in available_chains(("onboard", "torch"))}
    calls: dict[str, Callable[[int], object]] = {}

    def repeat(times: int, call: Callable[[], object]) -> Callable[[int], object]:
        return lambda turn: [call() for _ in range(times)]

    for n, sets, times in ((4, 1, 50), (6, 1, 50), (16, 1, 50), (6, 10_000, 1)):
        ground, image = _landmark_sets(n, sets)
        weight, label = np.ones((sets, n)), f"{50 * (sets == 1) or sets} sets of {n}"
        calls[f"cv2.findHomography, {label}"] = repeat(
            times, lambda g=ground, i=image: [cv2.findHomography(a, b, 0) for a, b in zip(g, i, strict=True)]
        )
        for name, solver in solvers.items():
            calls[f"{name}, {label}"] = repeat(times, lambda s=solver, g=ground, i=image, w=weight: s.solve(g, i, w))
    for n in (4, 6, 8):
        inputs = georeferencer_inputs(scenes(Case(landmarks=n), 50))

        def locate(turn: int, inputs: Any = inputs) -> None:
            georeferencer = Georeferencer(CAMERA, settings_for("pose"), solvers["onboard"])
            for number, (flight, landmarks) in enumerate(inputs, 1):
                georeferencer.update(number, number / 10, flight, landmarks)

        calls[f"pose of 50 frames, {n} landmarks"] = locate
    metres = np.random.default_rng(0).uniform(-2000, 2000, (1_000_000, 2))
    origin = (-110.95, 32.23)
    degrees = lonlat(metres, origin)
    calls["a million points to degrees"] = lambda turn: lonlat(metres, origin)
    calls["a million points to metres"] = lambda turn: east_north(degrees, origin)
    return _beside_first(calls, options.rounds, "Geo-localization")


def _landmark_sets(n: int, sets: int) -> tuple[np.ndarray, np.ndarray]:
    """Return places and pixels, (sets, n, 2) each, seen from 50 m with a small tilt and 1 px of noise."""
    rng = np.random.default_rng(n)
    ground = rng.uniform(-12.5, 12.5, (sets, n, 2))
    flat = ground * (27.4, -27.4) / (1 + ground @ (1e-3, 2e-3))[..., None]
    return ground, rng.normal(np.array([959.5, 539.5]) + flat, 1)


def measure_operations(options: bench.Options) -> tuple[str, Any]:
    """Measure processor time of `functional` beside Kornia and OpenCV, on batches of pictures or of point pairs."""
    import torch
    from tensor_operations import operations

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    batch, load = options.batch, bench.OtherLoad()
    rows = operations(bench.parse_size(options.size), batch)
    calls = {
        f"{row}, {name}": lambda turn, call=call: call()
        for row, made in rows.items()
        for name, call in made.items()
        if call is not None
    }
    with torch.inference_mode():
        spent = bench.time_in_turns(calls, options.rounds)
    table, figures = [], {}
    for row, made in rows.items():
        found: dict[str, Any] = {}
        for name, call in made.items():
            found[name] = None if call is None else 1e3 * float(np.median(spent[f"{row}, {name}"][:, 1])) / batch
        ratios = {}
        for name, other, reference in (("by_opencv", "ours", "OpenCV"), ("kornia_by_ours", "Kornia", "ours")):
            if made[other] is not None:
                compared = bench.compare_turns(spent[f"{row}, {other}"], spent[f"{row}, {reference}"])
                ratios[name] = bench.format_ratio(compared)
                found[name] = compared["processor_ratio"]
        millis = ["–" if found[name] is None else f"{found[name]:.3f}" for name in made]
        table.append([row, *millis, ratios["by_opencv"], ratios.get("kornia_by_ours", "–")])
        figures[row] = found
    head = ["operation", "OpenCV, ms", "ours, ms", "Kornia, ms", "ours by OpenCV (quartiles)", "Kornia by ours"]
    about = f"{bench.machine_words()}; {load.words()}; {options.size}, batch {batch}, one thread, processor time:"
    return f"{about}\n\n{bench.format_table(head, table)}", figures


def measure_batches(options: bench.Options) -> tuple[str, Any]:
    """Measure the torch engine with different megabytes of pictures in work at once, batch 8."""
    from torchvision_dddas.detection.torch_engine import TorchEngine

    frames, found, text = scene(bench.parse_size(options.size), 24), {}, []
    for config in ("fast", "default"):
        settings = load_config(None if config == "default" else config)

        def run(turn: int, batch_mb: float, settings: Settings = settings) -> None:
            detector = MotionDetector(settings, backend=TorchEngine(settings, "cpu", batch_mb=batch_mb), batch=8)
            for frame in frames:
                detector.update(frame)
            detector.flush()

        calls = {f"{batch_mb:g} MB": partial(run, batch_mb=batch_mb) for batch_mb in options.batch_mb}
        words, found[config] = _beside_first(calls, options.rounds, f"{config}, {options.size}, 24 frames")
        text.append(words)
    return "\n\n".join(text), found


def measure_gpu(options: bench.Options) -> tuple[str, Any]:
    """See `gpu_speed.measure_gpu`, which needs torch."""
    from gpu_speed import measure_gpu as measure

    return measure(options)


def measure_association(options: bench.Options) -> tuple[str, Any]:
    """Measure the source's association of a sequence's true boxes, onboard and torch in turns, in processor time.

    "association" is everything except reading and registering. "solver" is the assignment, which both share.
    "dddas track" is a new process of the command, including reading and registering.
    """
    place, interval = options.data, options.interval
    film = film_of(place)
    if film is None:
        sys.exit(f"{place} has no video; nothing was measured")
    settings, truth = load_config("paper"), truth_of(place).tracks
    frames = [(number, image) for number, image in frames_of(place, "video") if is_sampled(number, interval)]
    watch = Stopwatch()
    solve = source_tracker.assign

    def timed_assign(*given: Any) -> Any:
        watch.start()
        rows = solve(*given)
        watch.lap("solver")
        return rows

    def associate(backend: str) -> list[Tracks]:
        tracker, found = Tracker(settings, interval=interval, backend=backend), []
        for number, image in frames:
            box_px = truth.box_px[slice(*np.searchsorted(truth.frame, [number, number + 1]))]
            found += tracker.update(box_px, image=image, frame=number)
        return found + tracker.flush()

    def run_command(backend: str) -> np.ndarray:
        words = ["track", str(film), "--detections", str(place / "gt/gt.txt"), "--interval", str(interval)]
        words += ["--config", "paper", "--backend", backend, "--save", "none", "--quiet", "--out", folder]
        start = bench.children_s()
        done = subprocess.run([sys.executable, "-c", "from torchvision_dddas.cli import main; main()", *words])
        if done.returncode:
            sys.exit(f"dddas track ended with {done.returncode}")
        return bench.children_s() - start

    load, backends = bench.OtherLoad(), ("onboard", "torch")
    parts: dict[str, dict[str, list[float]]] = {}
    identities: dict[str, list[list[int]]] = {}
    source_tracker.assign = timed_assign
    try:
        with tempfile.TemporaryDirectory() as folder:
            for turn in range(options.rounds + 1):
                for backend in backends:
                    watch.spent, start = {}, bench.now()
                    tracks = associate(backend)
                    whole, solver = bench.now() - start, watch.spent["solver"]
                    identities[backend] = [each.identity.tolist() for each in tracks]
                    figures = {"association": whole, "of it solver": solver, "features and affinities": whole - solver}
                    if turn:  # the first turn warms up
                        figures["dddas track"] = run_command(backend)
                        for name, spent in figures.items():
                            parts.setdefault(name, {}).setdefault(backend, []).append(float(spent[1]))
                bench.log(f"turn {turn} of {options.rounds}")
    finally:
        source_tracker.assign = solve
    rows = []
    for name, by in parts.items():
        ratio = np.array(by["torch"]) / np.array(by["onboard"])
        low, middle, high = np.percentile(ratio, [25, 50, 75])
        times = [f"{1e3 * float(np.median(by[backend])) / len(frames):.2f}" for backend in backends]
        rows.append([name, *times, f"{middle:.2f} ({low:.2f}–{high:.2f})"])
    same = "the same" if identities["onboard"] == identities["torch"] else "not the same"
    head = ["processor ms a frame", *backends, "torch by onboard (quartiles)"]
    about = (
        f"{place.name}, {len(frames)} frames, every {interval}; {bench.machine_words()}; {load.words()}; "
        f"medians of {options.rounds} turns; identities are {same}:"
    )
    return f"{about}\n\n{bench.format_table(head, rows)}", parts


def _beside_first(calls: Mapping[str, Callable[[int], object]], rounds: int, title: str) -> tuple[str, Any]:
    """Time calls beside the first call and format a table."""
    load = bench.OtherLoad()
    spent = bench.time_in_turns(calls, rounds)
    reference = next(iter(spent.values()))
    found = {name: bench.compare_turns(values, reference) for name, values in spent.items()}
    rows = []
    for name, r in found.items():
        clock = f"{r['clock_ms']:.2f} ({r['clock_ms_25']:.2f}–{r['clock_ms_75']:.2f})"
        ratios = bench.format_ratio(r, "clock"), bench.format_ratio(r)
        rows.append([name, clock, f"{r['processor_ms']:.2f}", *ratios])
    head = ["call", "ms (quartiles)", "processor ms", "ratio to the first (quartiles)", "processor ratio"]
    about = f"{title}; {bench.machine_words()}; {load.words()}; medians of {rounds} turns:"
    return f"{about}\n\n{bench.format_table(head, rows)}", found


if __name__ == "__main__":
    sizes = ["640x480", "1280x720", "1920x1080"]
    studies = {
        "detection": (
            measure_detection,
            {"data": None, "--chains": CHAINS, "--sizes": sizes, "--rounds": 12, "--plot": None},
        ),
        "memory": (measure_memory, {"--chains": CHAINS[:4], "--size": "1280x720", "--frames": [60, 240]}),
        "people": (measure_people, {"data": None, "--size": "640x480", "--rounds": 15}),
        "geo": (measure_geo, {"--rounds": 15}),
        "operations": (measure_operations, {"--size": "640x480", "--batch": 8, "--rounds": 9}),
        "batches": (measure_batches, {"--size": "640x480", "--batch_mb": [6.0, 24.0, 80.0], "--rounds": 5}),
        "gpu": (
            measure_gpu,
            {
                "--sizes": sizes[1:],
                "--size": "1280x720",
                "--batch": 8,
                "--batches": [1, 8, 32],
                "--rounds": 5,
                "--device": "cuda",
            },
        ),
        "association": (measure_association, {"data": Path, "--interval": 5, "--rounds": 3}),
        "chain": (run_chain, {"data": Path, "--name": "plain"}),
    }
    bench.main(__doc__, studies)
