"""Trace graphs from `nn`: plane homographies from landmarks, and motion segmentation for one picture size.

homography.onnx      ground (B, n, 2), image (B, n, 2), weight (B, n) -> matrix (B, 3, 3), valid (B,); float64
homography_raw.onnx  ground, image -> matrix, valid: the source's system as printed
warp_difference      difference and mask of a picture and two neighbours with known motion
step                 the whole step from a picture and its two neighbours to motions, difference and mask
"""

import cv2
import numpy as np
import torch
from torch import Tensor, nn

import torchvision_dddas.functional as F
from torchvision_dddas.chain import Window
from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.export.graph_files import Check, ExportedGraph, open_session, trace_graph
from torchvision_dddas.nn import GRAPH_EFFORT, FrameRegistration, MotionSegmenter, PlaneHomography


class RawPlaneHomography(nn.Module):
    """`functional.find_homography_raw`, which solves four landmarks in another way than more landmarks."""

    def forward(self, ground: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return matrix (B, 3, 3), valid (B,) of ground and image (B, n, 2). A trace has no branches, so solve both."""
        exact, exact_valid = F.find_homography_raw(ground[:, :4], image[:, :4])
        least, least_valid = F.find_homography_raw(ground, image)
        is_exact = torch.ones_like(ground[:1, :, 0]).sum(1) == 4
        matrix = torch.where(is_exact[:, None, None], exact, least)
        return matrix, (is_exact & exact_valid) | (~is_exact & least_valid)  # the runtime has no `where` of Booleans


class WarpDifference(nn.Module):
    """The detection chain on a picture and two neighbours. The threshold is an input. The picture size is fixed."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        self.segmenter = MotionSegmenter(settings, tuned=())

    def forward(
        self, reference: Tensor, neighbours: Tensor, neighbour_from_reference: Tensor, threshold: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the difference and the mask (255 where something moves), both uint8 (H, W).

        reference: uint8 (H, W). neighbours: uint8 (2, H, W). neighbour_from_reference: float64 (2, 3, 3), px.
        threshold: uint8 (), grey levels. Larger differences are foreground.
        """
        pictures = neighbours.float()[:, None, None].unbind(0)
        window = Window(reference.float()[None, None], pictures, neighbour_from_reference[None], (-1, 1), ((0, 1),))
        found = self.segmenter.chain({"difference.threshold": threshold}).find_foreground(window)
        return found.evidence[0, 0], found.core[0, 0]


class SegmentationStep(nn.Module):
    """`nn.FrameRegistration` without branches, and `WarpDifference`."""

    def __init__(self, size: tuple[int, int], settings: Settings) -> None:
        super().__init__()
        self.register = FrameRegistration(settings.registration, effort=GRAPH_EFFORT)
        self.compare = WarpDifference(settings)
        cell = settings.registration.cell_side(*size)
        self.count = (size[0] // cell) * (size[1] // cell)

    def forward(
        self, reference: Tensor, neighbours: Tensor, samples: Tensor, tolerance_px: Tensor, threshold: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return neighbour_from_reference float64 (2, 3, 3), inliers and tracked int64 (2,), difference and mask.

        samples: int64 (S, 4), keypoint numbers of the hypotheses. tolerance_px: float64 (). If no keypoints agree,
        neighbour_from_reference is the identity with 0 inliers.
        """
        levels, pairs = reference[None, None].float(), len(neighbours)
        points, valid = (
            found.expand(pairs, *found.shape[1:]) for found in self.register.keypoints(levels, halved=False)
        )
        earlier = [level.expand(pairs, -1, -1, -1) for level in self.register.pyramid(levels)]
        later = self.register.pyramid(neighbours[:, None].float())
        drawn = samples.expand(pairs, -1, -1)
        motion = self.register.match(points, valid, earlier, later, samples=drawn, ransac_px=tolerance_px)
        difference, mask = self.compare(reference, neighbours, motion.later_from_earlier, threshold)
        return motion.later_from_earlier, motion.inliers.sum(1), motion.tracked.sum(1), difference, mask


TOLERANCE_PX = 1e-6
HYPOTHESES = 128
# Torch and ONNX Runtime break ties between keypoints and hypotheses differently: compare positions, not matrices.
CORNER_PX, MASK_OFF, LEVELS_OFF = 0.1, 0.02, 1e-3
LEAST_KEYPOINTS = 48
EXAMPLES = 2
PLANES: dict[str, tuple[str, nn.Module]] = {
    "homography.onnx": ("weighted least-squares homographies of sets of landmarks", PlaneHomography()),
    "homography_raw.onnx": ("the same as the source prints it: no weights, no normalisation", RawPlaneHomography()),
}
# All parameters of the chain except the threshold, which is an input.
_CHAIN = tuple(
    f"{group}.{name}"
    for group in ("difference", "morphology")
    for name in type(getattr(Settings(), group)).model_fields
    if name != "threshold"
)
_REGISTRATION = ("model", "keypoints", "cell_px", "quality", "block_px", "window_px", "levels", "epsilon_px")
# Purpose of a graph, its outputs, and the parameters that are built in.
SEGMENTATION: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "warp_difference": (
        "difference and mask of a picture and two neighbours of known motion",
        ("difference", "mask"),
        _CHAIN,
    ),
    "step": (
        "motions, difference and mask of a picture and its two neighbours: the whole step from pictures to mask",
        ("neighbour_from_reference", "inliers", "tracked", "difference", "mask"),
        (*_CHAIN, *(f"registration.{name}" for name in _REGISTRATION)),
    ),
}


def export_homographies() -> dict[str, ExportedGraph]:
    """Return homography.onnx and homography_raw.onnx, compared with torch."""
    files, given = {}, example_landmarks(6, 3, 0)
    for name, (_, module) in PLANES.items():
        inputs = ("ground", "image", "weight")[: 3 if isinstance(module, PlaneHomography) else 2]
        axes = {key: {0: "B", 1: "n"} for key in inputs} | {key: {0: "B"} for key in ("matrix", "valid")}
        tensors = {key: torch.from_numpy(given[key]) for key in inputs}
        files[name] = trace_graph(module, name.removesuffix(".onnx"), tensors, ("matrix", "valid"), axes)
    check = Check("px", homography_difference_px(files), TOLERANCE_PX)
    source = "functional.plane_maps"
    return {name: ExportedGraph(files[name], about, source, {}, (check,)) for name, (about, _) in PLANES.items()}


def export_segmentation(name: str, settings: Settings, size: tuple[int, int]) -> dict[str, ExportedGraph]:
    """Return the file of a graph for a size (width, height), compared with torch.

    Raises InputError if the graph does not support the settings, or if the size has room for too few keypoints.
    """
    about, outputs, baked = SEGMENTATION[name]
    graph = build_module(name, settings, size)
    content = trace_graph(graph, name, example_pictures(name, settings, size, 0), outputs)
    checks = compare(content, graph, name, [example_pictures(name, settings, size, seed) for seed in range(EXAMPLES)])
    dumped = settings.model_dump()
    parameters = {full: dumped[full.partition(".")[0]][full.partition(".")[2]] for full in baked}
    return {f"{name}_{size[0]}x{size[1]}.onnx": ExportedGraph(content, about, "functional", parameters, checks)}


def build_module(name: str, settings: Settings, size: tuple[int, int]) -> nn.Module:
    """Return the module to trace. Raises InputError as `export_segmentation` does."""
    kind, pairs = settings.difference.kind, settings.difference.near_frames
    if kind != "to_reference" or len(pairs) != 1:
        raise InputError(
            f"the graph {name} needs difference.kind = to_reference with one pair of neighbours, got {kind} with "
            f"{len(pairs)}; give --config fast, or change both settings"
        )
    if name == "warp_difference":
        return WarpDifference(settings).eval()
    if settings.registration.corners != "cells":
        raise InputError("the graph step needs registration.corners = cells, got frame; change the setting")
    step = SegmentationStep(size, settings).eval()
    if step.count < LEAST_KEYPOINTS:
        raise InputError(
            f"the graph step has room for {step.count} keypoints at {size[0]}x{size[1]}; wanted at least "
            f"{LEAST_KEYPOINTS}. Give a larger --size, or a smaller registration.cell_px"
        )
    return step


def compare(content: bytes, graph: nn.Module, name: str, examples: list[dict[str, Tensor]]) -> tuple[Check, ...]:
    """Return the largest differences between the runtime's results and torch's."""
    session, outputs = open_session(content), SEGMENTATION[name][1]
    corner = mask = levels = 0.0
    for given in examples:
        found = dict(zip(outputs, session.run(None, {n: v.numpy() for n, v in given.items()}), strict=True))
        with torch.inference_mode():
            wanted = dict(zip(outputs, (v.numpy() for v in graph(*given.values())), strict=True))
        mask = max(mask, 1 - overlap(found["mask"], wanted["mask"]))
        apart = cv2.absdiff(found["difference"], wanted["difference"])
        levels = max(levels, float((apart > 1).mean()))
        if name == "step":
            pairs = (found["neighbour_from_reference"], wanted["neighbour_from_reference"])
            corner = max(corner, corner_error(*pairs, wanted["mask"].shape))
            if not wanted["inliers"].all():  # the identity cannot be compared
                corner = float("inf")
    if name == "warp_difference":
        return Check("of pixels, difference", levels, LEVELS_OFF), Check("1 - IoU, mask", mask, LEVELS_OFF)
    return Check("px, corners", corner, CORNER_PX), Check("1 - IoU, mask", mask, MASK_OFF)


def example_landmarks(count: int, sets: int, seed: int, noise_px: float = 1.0) -> dict[str, np.ndarray]:
    """Return landmarks some km from the origin, seen by cameras 50 to 200 m away and tilted by up to 50 degrees."""
    rng = np.random.default_rng(seed)
    turn, tilt = rng.uniform(0, 2 * np.pi, sets), rng.uniform(0, np.radians(50), sets)
    sin, cos = np.sin(turn), np.cos(turn)
    forward = np.stack([np.sin(tilt) * sin, np.sin(tilt) * cos, -np.cos(tilt)], 1)
    right = np.stack([cos, -sin, np.zeros(sets)], 1)
    axes = np.stack([right, np.cross(forward, right), forward], 1)
    around = np.linspace(0, 2 * np.pi, count, endpoint=False) + rng.uniform(-0.3, 0.3, (sets, count))
    spread = rng.uniform(9, 13, (sets, count, 1)) * np.stack([np.sin(around), np.cos(around)], 2)
    away = rng.uniform(50, 200, (sets, 1, 1)) * forward[:, None]
    seen = (np.pad(spread, ((0, 0), (0, 0), (0, 1))) + away) @ axes.swapaxes(1, 2)
    image = 1370 * seen[..., :2] / seen[..., 2:] + (959.5, 539.5) + noise_px * rng.normal(size=(sets, count, 2))
    weight = rng.uniform(0.1, 1, (sets, count))
    weight[:, 4:] *= rng.random((sets, max(0, count - 4))) > 0.2
    return {"ground": spread + rng.uniform(-3000, 3000, (sets, 1, 2)), "image": image, "weight": weight}


def homography_difference_px(files: dict[str, bytes]) -> float:
    """Return the largest distance, px, between places by the graphs and by torch, over sets of 4 to 16 landmarks."""
    sessions = [open_session(files[name]) for name in PLANES]
    worst = 0.0
    for count in range(4, 17):
        given = example_landmarks(count, 50, count)
        # Compare the source's system near the origin in units of 10 m, where it is accurate.
        near = {"ground": (given["ground"] - given["ground"][:, :1]) / 10, "image": given["image"] / 500 - 1}
        fit, fit_raw = ([torch.from_numpy(array) for array in held.values()] for held in (given, near))
        results = F.find_homography(*fit), F.find_homography_raw(*fit_raw)
        for session, held, (wanted, valid), unit in zip(sessions, (given, near), results, (1, 500), strict=True):
            matrix, found_valid = session.run(None, held)
            if not (found_valid.all() and valid.all()):
                return float("inf")
            points = torch.from_numpy(held["ground"])
            there = F.transform_points(torch.from_numpy(matrix), points) - F.transform_points(wanted, points)
            worst = max(worst, unit * there.abs().max().item())
    return worst


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Return the intersection over union of two masks, or 1 if both are empty."""
    either = np.count_nonzero(one | other)
    return np.count_nonzero(one & other) / either if either else 1.0


def corner_error(found: np.ndarray, wanted: np.ndarray, shape: tuple[int, ...]) -> float:
    """Return the largest distance between a picture's corners mapped by found and by wanted matrices (K, 3, 3)."""
    bottom, right = shape[0] - 1.0, shape[1] - 1.0
    corners = torch.tensor([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]], dtype=torch.float64)
    one, other = (
        F.transform_points(torch.from_numpy(matrix), corners.expand(len(matrix), 4, 2)) for matrix in (found, wanted)
    )
    return float((one - other).norm(dim=-1).max())


def example_pictures(name: str, settings: Settings, size: tuple[int, int], seed: int) -> dict[str, Tensor]:
    """Draw three pictures of a textured plane with two moving squares, from three places. Return a graph's inputs."""
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
    cell = settings.registration.cell_side(*size)
    generator, count = torch.Generator().manual_seed(seed), (width // cell) * (height // cell)
    return {
        **seen,
        "samples": F.draw_samples(generator, 1, HYPOTHESES, count)[0],
        "tolerance_px": torch.tensor(settings.registration.ransac_px, dtype=torch.float64),
        "threshold": threshold,
    }
