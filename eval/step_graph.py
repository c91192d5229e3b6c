"""The `step` graph of `dddas export` as a chain among the others, and how far it is from torch's.

usage: python eval/step_graph.py GRAPHS/step_640x480.onnx [CLIP...] [--rounds 8] [--json FILE]

Windows of three frames, of the project's own scene and of CLIPs (videos, folders of pictures, folders of clips) brought
to the graph's size. For each clip: how far the corners go apart under the motions that the graph and torch find, and
how their masks overlap; how far its motions are from a careful registration (registration_error.py), median and most,
and how far the plain chain's; processor time of a frame beside the plain chain's, in turns. Then the most memory that a
process holds which takes the graph through a video.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from plain_chain import LEAST_AREA_PX

from torchvision_dddas.config import load_config
from torchvision_dddas.detection import cell_side
from torchvision_dddas.runtime import opened

NAME = "graph step"
Size = tuple[int, int]
WINDOWS = 12  # of a clip that are compared


def file_of(size: Size) -> str:
    """The graph's name for a size of picture."""
    return f"step_{size[0]}x{size[1]}.onnx"


class StepGraph:
    """Each frame against the two after it, as the plain chain does. One thread of ONNX Runtime."""

    def __init__(self, folder: Path, size: Size) -> None:
        self.session = opened(folder, file_of(size), enable_cpu_mem_arena=False)
        parameters = load_config("fast")
        cell = cell_side(*size, parameters.registration)
        count = (size[0] // cell) * (size[1] // cell)
        hypotheses = next(i.shape[0] for i in self.session.get_inputs() if i.name == "samples")
        rng = np.random.default_rng(0)
        self.given = {
            "samples": np.stack([rng.choice(count, 4, replace=False) for _ in range(hypotheses)]).astype(np.int64),
            "tolerance_px": np.array(parameters.registration.ransac_px, np.float64),
            "threshold": np.array(int(parameters.difference.threshold), np.uint8),
        }
        self.greys: list[np.ndarray] = []

    def mask(self, greys: list[np.ndarray]) -> np.ndarray:
        """(H, W) uint8 of what moves in the first of three grey pictures."""
        return self.found(greys, "mask")[0]

    def found(self, greys: list[np.ndarray], *names: str) -> list[np.ndarray]:
        """These of the graph's outputs."""
        pictures = {"reference": greys[0], "neighbours": np.stack(greys[1:])}
        results: list[np.ndarray] = self.session.run(list(names), {**pictures, **self.given})
        return results

    def grey(self, image: np.ndarray) -> list[np.ndarray]:
        """Take a frame; the latest three, once there are so many."""
        self.greys = [*self.greys[-2:], cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)]
        return self.greys


def boxes(mask: np.ndarray) -> np.ndarray:
    """(N, 4) of the blobs that are large enough."""
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask)
    return stats[1:, :4][stats[1:, cv2.CC_STAT_AREA] >= LEAST_AREA_PX].astype(float)


def parity(frames: list[np.ndarray], graph: StepGraph, size: Size) -> dict[str, Any]:
    """What graph and torch find in windows spread over a clip of BGR frames of the graph's size."""
    import registration_error
    import torch

    from torchvision_dddas.export import traced_graphs as traced

    module = traced.build_module("step", load_config("fast"), size)
    given = [torch.from_numpy(value) for value in graph.given.values()]
    greys = [cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) for frame in frames]
    corners, overlaps, ours, plain = [], [], [], []
    for i in np.linspace(0, len(greys) - 3, min(WINDOWS, len(greys) - 2)).astype(int):
        window = greys[i : i + 3]
        matrices, mask = graph.found(window, "neighbour_from_reference", "mask")
        with torch.inference_mode():
            wanted = module(torch.from_numpy(window[0]), torch.from_numpy(np.stack(window[1:])), *given)
        corners.append(traced.corner_error(matrices, wanted[0].numpy(), mask.shape))
        overlaps.append(traced.overlap(mask, wanted[-1].numpy()))
        for later, matrix in zip(window[1:], matrices, strict=True):
            careful = registration_error.carefully(window[0], later)
            if careful is not None:
                ours.append(registration_error.distance(matrix, careful, *size))
                other = np.linalg.inv(registration_error.plain(window[0], later))
                plain.append(registration_error.distance(other, careful, *size))
    return {
        "windows": len(corners),
        "corner_px": max(corners),
        "overlap": min(overlaps),
        "error_px": _summary(ours),
        "plain_error_px": _summary(plain),
    }


def speed(frames: list[np.ndarray], folder: Path, rounds: int) -> dict[str, float]:
    """Processor time a frame, and through the plain chain's in the same turns."""
    from chains import lanes_of, row, timed

    *_, found = timed(lanes_of(frames, [NAME], rounds), rounds, folder)
    return {**row(found[NAME].whole, found["plain"].whole), "boxes": found[NAME].boxes}


def peak_mb(frames: list[np.ndarray], folder: Path) -> float:
    """Of a process that takes the graph through a video of its own."""
    from films import write_video
    from memory import measured

    with tempfile.TemporaryDirectory() as place:
        video = Path(place) / "scene.mp4"
        write_video(video, frames, 40)
        command = [sys.executable, str(Path(__file__).with_name("chains.py")), NAME, str(video), str(folder)]
        return measured(command)["peak_mb"]


def _summary(errors: list[float]) -> list[float]:
    """Median and maximum."""
    return [float(np.median(errors)), float(np.max(errors))] if errors else [float("nan")] * 2


def _films(arguments: list[str], size: Size) -> Iterator[tuple[str, list[np.ndarray]]]:
    from films import clips, resized

    yield from clips([], [size])
    for argument in arguments:
        for name, frames in clips([argument], [size]):
            yield name, [resized(frame, size) for frame in frames]


def main() -> None:
    """Measure, print a line a clip and write JSON."""
    import machine
    from films import scene, size_of

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("graph", type=Path)
    parser.add_argument("clips", nargs="*")
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    folder, size = options.graph.parent, size_of(options.graph.stem.removeprefix("step_"))
    graph, others, found = StepGraph(folder, size), machine.Others(), {}
    for name, frames in _films(options.clips, size):
        if len(frames) < 3:
            print(f"{name}: {len(frames)} frames; wanted three or more: left out")
            continue
        held = found[name] = {**parity(frames, graph, size), **speed(frames, folder, options.rounds)}
        (ours, most), (plain, plain_most) = held["error_px"], held["plain_error_px"]
        print(
            f"{name:22} {held['windows']:2} windows: corners {held['corner_px']:.1e} px from torch's at most, IoU "
            f"{held['overlap']:.4f} at least; error {ours:.2f} px, at most {most:.2f}, plain's {plain:.2f}, "
            f"{plain_most:.2f}; {held['processor_ms']:.0f} ms, {held['processor_ratio']:.2f} of plain",
            flush=True,
        )
    peak = peak_mb(scene(size, 20), folder)
    print(f"peak {peak:.0f} MB; {machine.load_in_words(others.cores())}")
    if options.json:
        options.json.write_text(json.dumps({"clips": found, "peak_mb": peak, "machine": machine.about()}, indent=1))


if __name__ == "__main__":
    main()
