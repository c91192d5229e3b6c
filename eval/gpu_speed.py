"""Time the detection chain and tensor operations on an accelerator, beside the OpenCV engine on the same machine."""

from collections.abc import Callable, Sequence
from typing import Any

import bench
import cv2
import numpy as np
import torch
from clips import scene, there_and_back
from tensor_operations import operations

from torchvision_dddas.config import load_config
from torchvision_dddas.detection import MotionDetector, load_engine
from torchvision_dddas.nn import MotionSegmenter
from torchvision_dddas.types import Frame

# Frames per turn, a multiple of each batch size.
_TURN_FRAMES = 32


def measure_gpu(options: bench.Options) -> tuple[str, Any]:
    """Measure frames per second, the model eager and as a CUDA graph, and the forms of operations, by wall clock."""
    device, load = options.device, bench.OtherLoad()
    name = torch.cuda.get_device_name() if device == "cuda" else device
    figures: dict[str, Any] = {"device": name, "chains": {}, "model": {}}
    figures["operations"] = _time_operations(options)
    texts = []
    for text in options.sizes:
        size = bench.parse_size(text)
        frames = scene(size, 24)
        figures["chains"][text] = _time_detectors(frames, options)
        figures["model"][text] = _time_model(frames, options)
        bench.log(text, figures["model"][text])
    rows = [[chain, *(f"{by[chain]:.1f}" for by in figures["chains"].values())] for chain in figures["chains"][text]]
    texts.append("Frames a second of `MotionDetector`:\n\n" + bench.format_table(["chain", *options.sizes], rows))
    rows = [[form, *(by[form] for by in figures["model"].values())] for form in figures["model"][text]]
    texts.append(
        f"Milliseconds a frame of `MotionSegmenter` with given motion, {options.batch} frames at once:\n\n"
        + bench.format_table(["form", *options.sizes], rows)
    )
    rows = [[row, *times.values()] for row, times in figures["operations"].items()]
    head = ["operation", "OpenCV on the CPU, ms", "ours, ms", "Kornia, ms", "Kornia by ours"]
    texts.append(
        f"Milliseconds a picture of {options.size}, batch {options.batch}:\n\n{bench.format_table(head, rows)}"
    )
    about = f"{name}; {bench.machine_words()}; {load.words()}; medians of {options.rounds} turns:"
    return "\n\n".join([about, *texts]), figures


def _time_detectors(frames: Sequence[np.ndarray], options: bench.Options) -> dict[str, float]:
    """Return frames per second by engine, configuration and batch size, in turns of _TURN_FRAMES frames."""
    shown = there_and_back(frames, (options.rounds + 1) * _TURN_FRAMES)

    def make(engine: str, config: str | None, batch: int) -> Callable[[int], object]:
        settings = load_config(config)
        chosen: Any = load_engine(engine, settings) if engine == "onboard" else _torch_engine(settings, options.device)
        detector = MotionDetector(settings, backend=chosen, rate_hz=10.0, batch=batch)

        def run(turn: int) -> None:
            for i in range(turn * _TURN_FRAMES, (turn + 1) * _TURN_FRAMES):
                for _ in detector.update(Frame(i + 1, i / 10.0, shown[i])):
                    pass

        return run

    calls = {}
    for config in ("fast", None):
        calls[f"onboard {config or 'default'}"] = make("onboard", config, 1)
        for batch in options.batches:
            calls[f"torch {config or 'default'}, batch {batch}"] = make("torch", config, batch)
    bench.log(f"{len(calls)} chains, {options.rounds + 1} turns of {_TURN_FRAMES} frames each")
    spent = bench.time_in_turns(calls, options.rounds)
    found = {name: _TURN_FRAMES / float(np.median(values[:, 0])) for name, values in spent.items()}
    bench.log(found)
    return found


def _torch_engine(settings: Any, device: str) -> Any:
    from torchvision_dddas.detection.torch_engine import TorchEngine

    return TorchEngine(settings, device)


def _time_model(frames: Sequence[np.ndarray], options: bench.Options) -> dict[str, str]:
    """Return milliseconds per frame of the eager model, and of its replay as a CUDA graph.

    torch.compile is left out, because it took more than three minutes on an H200.
    """
    clip = torch.from_numpy(np.stack(frames[: options.batch])[..., ::-1].copy()).to(options.device)
    clip = clip.permute(0, 3, 1, 2)[None].float().div(255).contiguous()
    found = {}
    for config in ("fast", None):
        model = MotionSegmenter(load_config(config)).to(options.device).eval()
        with torch.inference_mode():
            motion = model(clip).later_from_earlier
        for form, prepare in _FORMS.items():
            label = f"{config or 'default'}, {form}"
            try:
                with torch.no_grad():
                    call = prepare(model, clip, motion)
                    spent = bench.time_in_turns({"": lambda turn, call=call: _finish(call(), options.device)}, 15, 3)
                found[label] = f"{1e3 * float(np.median(spent[''][:, 0])) / options.batch:.2f}"
            except Exception as error:  # a form that does not work is a row of the table
                found[label] = f"fails: {type(error).__name__}"
                bench.log(label, str(error)[:2000])
    return found


def _eager(model: Any, clip: torch.Tensor, motion: torch.Tensor) -> Callable[[], object]:
    return lambda: model(clip, motion)


def _graph(model: Any, clip: torch.Tensor, motion: torch.Tensor) -> Callable[[], object]:
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):
            model(clip, motion)
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        model(clip, motion)
    return graph.replay


_FORMS = {"eager": _eager, "CUDA graph": _graph}


def _finish(result: object, device: str) -> object:
    """Wait until the device has finished."""
    if device == "cuda":
        torch.cuda.synchronize()
    return result


def _time_operations(options: bench.Options) -> dict[str, dict[str, str]]:
    """Return milliseconds per picture of each operation in its three forms."""
    cv2.setNumThreads(1)
    table = {}
    for row, made in operations(bench.parse_size(options.size), options.batch, options.device).items():
        times: dict[str, float] = {}
        for name, call in made.items():
            if call is None:
                continue
            try:
                with torch.inference_mode():
                    spent = bench.time_in_turns(
                        {"": lambda turn, call=call: _finish(call(), options.device)}, options.rounds, 3
                    )
                times[name] = 1e3 * float(np.median(spent[""][:, 0])) / options.batch
            except Exception as error:  # a form that does not work is a row of the table
                bench.log(row, name, str(error)[:2000])
        ratio = times["Kornia"] / times["ours"] if {"Kornia", "ours"} <= set(times) else None
        table[row] = {name: f"{times[name]:.4f}" if name in times else "–" for name in made}
        table[row]["Kornia by ours"] = "–" if ratio is None else f"{ratio:.2f}"
        bench.log(row, table[row])
    return table
