"""Graphs traced from `ops` (tracing.py) for one size of picture, and compared with torch on pictures made here."""

from typing import Any

import cv2
import numpy as np
import onnxruntime
import torch
from torch import Tensor, nn

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.export.checked import Check, Made
from torchvision_dddas.export.step_module import HYPOTHESES, Register, Step, WarpDifference
from torchvision_dddas.export.tracing import traced
from torchvision_dddas.functional import consensus

# Ties between keypoints and hypotheses fall differently in torch and in the runtime: places agree, not numbers.
CORNER_PX, MASK_OFF, LEVELS_OFF = 0.1, 0.02, 1e-3
LEAST_KEYPOINTS = 48
EXAMPLES = 2
ABOUT = {
    "warp_difference": "difference and mask of a picture and two neighbours of known motion",
    "step": "motions, difference and mask of a picture and its two neighbours: the whole step from pictures to mask",
}
INPUTS = {
    "warp_difference": ("reference", "neighbours", "neighbour_from_reference", "threshold"),
    "step": ("reference", "neighbours", "samples", "tolerance_px", "threshold"),
}
OUTPUTS = {
    "warp_difference": ("difference", "mask"),
    "step": ("neighbour_from_reference", "inliers", "tracked", "difference", "mask"),
}


def made(name: str, settings: Settings, size: tuple[int, int]) -> dict[str, Made]:
    """The file of one graph for one size (width, height), compared with torch.

    Raises InputError where the settings ask for what the graph does not hold, or the size for too few keypoints.
    """
    graph = module(name, settings, size)
    given = example(name, settings, size, 0)
    content = traced(graph, name, tuple(given.values()), INPUTS[name], OUTPUTS[name])
    checks = compared(content, graph, name, [example(name, settings, size, seed) for seed in range(EXAMPLES)])
    file = f"{name}_{size[0]}x{size[1]}.onnx"
    return {file: Made(content, ABOUT[name], "ops", baked(name, settings), checks)}


def module(name: str, settings: Settings, size: tuple[int, int]) -> nn.Module:
    """What is traced. Raises InputError as `made` does."""
    kind, pairs = settings.difference.kind, settings.difference.near_frames
    if kind != "to_reference" or len(pairs) != 1:
        raise InputError(
            f"the graph {name} holds difference.kind = to_reference with one pair of neighbours; got {kind} with "
            f"{len(pairs)}. Give --config fast, or change both"
        )
    if name == "warp_difference":
        return WarpDifference(settings.difference, settings.morphology).eval()
    step = Step(size, settings.registration, settings.difference, settings.morphology).eval()
    if step.register.count < LEAST_KEYPOINTS:
        raise InputError(
            f"the graph step has room for {step.register.count} keypoints at {size[0]}x{size[1]}; wanted "
            f"{LEAST_KEYPOINTS}. Give a larger --size, or a smaller registration.cell_px"
        )
    return step


def baked(name: str, settings: Settings) -> dict[str, Any]:
    """The parameters that the graph holds."""
    difference, morphology = settings.difference, settings.morphology
    held: dict[str, Any] = {
        "difference.blur_px": difference.blur_px,
        "difference.border_px": difference.border_px,
        "morphology.erode_px": morphology.erode_px,
        "morphology.close_px": morphology.close_px,
    }
    if name == "step":
        names = "model", "keypoints", "cell_px", "quality", "block_px", "window_px", "levels", "epsilon_px"
        held |= {f"registration.{parameter}": getattr(settings.registration, parameter) for parameter in names}
    return held


def compared(content: bytes, graph: nn.Module, name: str, examples: list[dict[str, Tensor]]) -> tuple[Check, ...]:
    """The largest differences between the runtime's results and torch's."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    corner = mask = levels = 0.0
    for given in examples:
        found = dict(zip(OUTPUTS[name], session.run(None, {n: v.numpy() for n, v in given.items()}), strict=True))
        with torch.inference_mode():
            wanted = dict(zip(OUTPUTS[name], (v.numpy() for v in graph(*given.values())), strict=True))
        mask = max(mask, 1 - overlap(found["mask"], wanted["mask"]))
        apart = cv2.absdiff(found["difference"], wanted["difference"])
        levels = max(levels, float((apart > 1).mean()))
        if name == "step":
            pairs = (found["neighbour_from_reference"], wanted["neighbour_from_reference"])
            corner = max(corner, corner_error(*pairs, wanted["mask"].shape))
            if not wanted["inliers"].all():  # then there is nothing to compare
                corner = float("inf")
    if name == "warp_difference":
        return Check("of pixels, difference", levels, LEVELS_OFF), Check("1 - IoU, mask", mask, LEVELS_OFF)
    return Check("px, corners", corner, CORNER_PX), Check("1 - IoU, mask", mask, MASK_OFF)


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of two masks; 1 where both are empty."""
    either = np.count_nonzero(one | other)
    return np.count_nonzero(one & other) / either if either else 1.0


def corner_error(found: np.ndarray, wanted: np.ndarray, shape: tuple[int, ...]) -> float:
    """The largest distance, over matrices (K, 3, 3), between where the corners of a picture (height, width) go."""
    bottom, right = shape[0] - 1.0, shape[1] - 1.0
    corners = torch.tensor([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]], dtype=torch.float64)
    one, other = (consensus.transfer(torch.from_numpy(matrix), corners) for matrix in (found, wanted))
    return float((one - other).norm(dim=-1).max())


def example(name: str, settings: Settings, size: tuple[int, int], seed: int) -> dict[str, Tensor]:
    """A textured plane from three places, on which two squares move."""
    width, height = size
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (height // 4, width // 4)).astype(np.float32)
    wide: np.ndarray = cv2.resize(coarse, (2 * width, 2 * height))
    wide += cv2.GaussianBlur(rng.normal(0, 60, wide.shape).astype(np.float32), (5, 5), 0)
    plane = wide.clip(0, 255).astype(np.uint8)
    side = max(8, min(size) // 12)
    pictures, matrices = [], []
    for moment in (0, -1, 1):
        scene = plane.copy()
        for number, (x, y) in enumerate(((0.8, 0.8), (1.1, 1.2))):
            left, top = int(x * width + moment * (number + 1) * side / 3), int(y * height + moment * side / 4)
            scene[top : top + side, left : left + side] = 250 * number
        tilt = 1 + 0.004 * moment
        offset = (-width / 2 + 2.3 * moment * (seed + 1), -height / 2 - 1.4 * moment)
        matrix = np.array(
            [[tilt, 0.002 * moment, offset[0]], [-0.002 * moment, tilt, offset[1]], [2e-6 * moment, 0, 1]]
        )
        pictures.append(cv2.warpPerspective(scene, matrix, size))
        matrices.append(matrix)
    seen = {
        "reference": torch.from_numpy(pictures[0]),
        "neighbours": torch.from_numpy(np.stack(pictures[1:])),
    }
    threshold = torch.tensor(int(settings.difference.threshold), dtype=torch.uint8)
    if name == "warp_difference":
        between = np.stack([matrix @ np.linalg.inv(matrices[0]) for matrix in matrices[1:]])
        return {
            **seen,
            "neighbour_from_reference": torch.from_numpy(between / between[:, 2:, 2:]),
            "threshold": threshold,
        }
    return {
        **seen,
        "samples": samples(Register(size, settings.registration).count, seed),
        "tolerance_px": torch.tensor(settings.registration.ransac_px, dtype=torch.float64),
        "threshold": threshold,
    }


def samples(count: int, seed: int = 0) -> Tensor:
    """(S, 4) int64: of `count` keypoints the four of every hypothesis."""
    return consensus.draw_samples(torch.Generator().manual_seed(seed), 1, HYPOTHESES, count)[0]
