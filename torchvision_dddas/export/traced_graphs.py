"""Graphs traced from `functional`: plane homographies from landmarks, and motion segmentation for one picture size.

    homography.onnx      ground (B, n, 2), image (B, n, 2), weight (B, n) -> matrix (B, 3, 3), valid (B,); float64
    homography_raw.onnx  ground, image -> matrix, valid: `fit_raw`, the source's system as printed
    warp_difference      difference and mask of a picture and two neighbours of known motion
    step                 the whole step from a picture and its two neighbours to motions, difference and mask

The last two do what the chain does with `difference.kind = "to_reference"` and one pair of neighbours, as
configs/fast.toml has it, but for the correction of exposures. What the controller moves is an input; sizes and budgets
are baked in.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from torchvision_dddas.config import DifferenceParameters, MorphologyParameters, RegistrationParameters, Settings
from torchvision_dddas.detection import absolute_difference, cell_side, find_seen_by_both
from torchvision_dddas.errors import InputError
from torchvision_dddas.export.graph_files import Check, ExportedGraph
from torchvision_dddas.export.tracing import open_session, trace_graph
from torchvision_dddas.functional import affine, consensus, filters, flow, homography, keypoints, morphology, warp

TOLERANCE_PX = 1e-6
HYPOTHESES = 128
# Keypoints that search the whole pyramid; the others start where these say, in the full resolution alone. 200 of them
# all searching would take three times the nodes' work. With 64 scouts, or 3 steps, a motion in some dozens is lost.
SCOUTS, STEPS, REACH_PX = 96, 6, 3
REFITS = 1.0, 0.5  # of the tolerance of RANSAC
LEVEL = 255.0
# Ties between keypoints and hypotheses fall differently in torch and in the runtime: places agree, not numbers.
CORNER_PX, MASK_OFF, LEVELS_OFF = 0.1, 0.02, 1e-3
LEAST_KEYPOINTS = 48
EXAMPLES = 2
ABOUT = {
    "warp_difference": "difference and mask of a picture and two neighbours of known motion",
    "step": "motions, difference and mask of a picture and its two neighbours: the whole step from pictures to mask",
}
OUTPUTS = {
    "warp_difference": ("difference", "mask"),
    "step": ("neighbour_from_reference", "inliers", "tracked", "difference", "mask"),
}


def export_homographies() -> dict[str, ExportedGraph]:
    """homography.onnx and homography_raw.onnx, compared with torch."""
    files, given = {}, example_landmarks(6, 3, 0)
    for name, (_, module, inputs) in PLANES.items():
        tensors = {key: torch.from_numpy(given[key]) for key in inputs}
        axes = {key: {0: "B", 1: "n"} for key in inputs} | {key: {0: "B"} for key in ("matrix", "valid")}
        files[name] = trace_graph(module, name.removesuffix(".onnx"), tensors, ("matrix", "valid"), axes)
    check, source = Check("px", homography_difference_px(files), TOLERANCE_PX), "functional.homography"
    return {name: ExportedGraph(files[name], PLANES[name][0], source, {}, (check,)) for name in files}


class PlaneHomography(nn.Module):
    """`functional.homography.fit`."""

    def forward(self, ground: Tensor, image: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Matrix (B, 3, 3), valid (B,) of ground and image (B, n, 2), weight (B, n)."""
        return homography.fit(ground, image, weight)


class RawPlaneHomography(nn.Module):
    """`functional.homography.fit_raw`, which solves four landmarks in another way than more."""

    def forward(self, ground: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
        """Matrix (B, 3, 3), valid (B,) of ground and image (B, n, 2). A trace has no branches: both ways are taken."""
        four = homography.SAMPLE_SIZE
        exact, exact_valid = homography.fit_raw(ground[:, :four], image[:, :four])
        least, least_valid = homography.fit_raw(ground, image)
        is_exact = torch.ones_like(ground[:1, :, 0]).sum(1) == four
        matrix = torch.where(is_exact[:, None, None], exact, least)
        return matrix, (is_exact & exact_valid) | (~is_exact & least_valid)  # the runtime has no `where` of Booleans


PLANES: dict[str, tuple[str, nn.Module, tuple[str, ...]]] = {
    "homography.onnx": (
        "weighted least-squares homographies of sets of landmarks", PlaneHomography(), ("ground", "image", "weight"),
    ),
    "homography_raw.onnx": (
        "the same as the source prints it: no weights, no normalisation", RawPlaneHomography(), ("ground", "image"),
    ),
}  # fmt: skip


def export_segmentation(name: str, settings: Settings, size: tuple[int, int]) -> dict[str, ExportedGraph]:
    """The file of one graph for one size (width, height), compared with torch.

    Raises InputError where the settings ask for what the graph does not hold, or the size for too few keypoints.
    """
    graph = build_module(name, settings, size)
    given = example_pictures(name, settings, size, 0)
    content = trace_graph(graph, name, given, OUTPUTS[name])
    checks = compare(content, graph, name, [example_pictures(name, settings, size, seed) for seed in range(EXAMPLES)])
    file = f"{name}_{size[0]}x{size[1]}.onnx"
    return {file: ExportedGraph(content, ABOUT[name], "functional", _baked_parameters(name, settings), checks)}


def build_module(name: str, settings: Settings, size: tuple[int, int]) -> nn.Module:
    """What is traced. Raises InputError as `export_segmentation` does."""
    kind, pairs = settings.difference.kind, settings.difference.near_frames
    if kind != "to_reference" or len(pairs) != 1:
        raise InputError(
            f"the graph {name} holds difference.kind = to_reference with one pair of neighbours; got {kind} with "
            f"{len(pairs)}. Give --config fast, or change both"
        )
    if name == "warp_difference":
        return WarpDifference(settings.difference, settings.morphology).eval()
    step = Step(size, settings).eval()
    if step.register.count < LEAST_KEYPOINTS:
        raise InputError(
            f"the graph step has room for {step.register.count} keypoints at {size[0]}x{size[1]}; wanted "
            f"{LEAST_KEYPOINTS}. Give a larger --size, or a smaller registration.cell_px"
        )
    return step


def _baked_parameters(name: str, settings: Settings) -> dict[str, Any]:
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


def compare(content: bytes, graph: nn.Module, name: str, examples: list[dict[str, Tensor]]) -> tuple[Check, ...]:
    """The largest differences between the runtime's results and torch's."""
    session = open_session(content)
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


class WarpDifference(nn.Module):
    """Where three pictures differ after two of them were brought onto the first."""

    def __init__(self, difference: DifferenceParameters, morphology: MorphologyParameters) -> None:
        super().__init__()
        self.difference, self.morphology = difference, morphology

    def forward(
        self, reference: Tensor, neighbours: Tensor, neighbour_from_reference: Tensor, threshold: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Difference and mask (255 where something moves), both uint8 (H, W).

        reference: uint8 (H, W). neighbours: uint8 (2, H, W). neighbour_from_reference: float64 (2, 3, 3), px.
        threshold: uint8 (), grey levels; a larger difference is foreground.
        """
        height, width = reference.shape
        grey, levels = reference[None, None], neighbours[:, None].float()
        warped = (warp.sample(levels, neighbour_from_reference, (height, width)) + 0.5).floor().to(torch.uint8)
        first, last = warp.seen_columns(
            neighbour_from_reference, (height, width), (height, width), self.difference.border_px
        )
        seen = find_seen_by_both((first[:1], last[:1]), (first[1:], last[1:]), width)
        least = torch.minimum(absolute_difference(grey, warped[:1]), absolute_difference(grey, warped[1:]))
        found = filters.gaussian_levels(least, self.difference.blur_px) * seen
        core = (found > threshold).to(torch.uint8) * 255
        core = morphology.erode(core, self.morphology.erode_px, "ellipse")
        return found[0, 0], morphology.closing(core, self.morphology.close_px, "ellipse")[0, 0]


class Register(nn.Module):
    """The background's motion from a picture to each of its neighbours."""

    def __init__(self, size: tuple[int, int], parameters: RegistrationParameters) -> None:
        """size: (width, height) in px."""
        super().__init__()
        self.settings, self.cell = parameters, cell_side(*size, parameters)
        self.count = (size[0] // self.cell) * (size[1] // self.cell)
        self.levels = 1
        while self.levels <= parameters.levels and min(size) / 2**self.levels > parameters.window_px:
            self.levels += 1
        self.model = affine if parameters.model == "affine" else homography

    def forward(
        self, reference: Tensor, neighbours: Tensor, samples: Tensor, tolerance_px: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """neighbour_from_reference float64 (2, 3, 3), the inliers it has and the keypoints followed, int64 (2,).

        samples: int64 (S, 4), numbers of keypoints from which the hypotheses are drawn. tolerance_px: float64 ().
        Where nothing agrees: the identity, with 0 inliers.
        """
        parameters, pairs = self.settings, len(neighbours)
        levels = reference[None, None].float()
        points, _, valid = keypoints.grid_features(
            levels, self.cell, parameters.quality, parameters.block_px, least=1e-7 * LEVEL**2
        )
        points, valid = points.expand(pairs, -1, -1), valid.expand(pairs, -1)
        earlier = [level.expand(pairs, -1, -1, -1) for level in flow.pyramid(levels, self.levels)]
        later = flow.pyramid(neighbours[:, None].float(), self.levels)
        samples = samples.expand(pairs, -1, -1)

        scouts = consensus.spread(valid, SCOUTS)
        start = points.gather(1, scouts[..., None].expand(-1, -1, 2))
        ahead, found = self._track(start, earlier, later, None)
        found = found & valid.gather(1, scouts)
        places = samples * SCOUTS // self.count
        motion = self._ransac(start, ahead, found, places, tolerance_px, (1.0,))[0]

        guess = consensus.transfer(motion.float(), points)
        end, tracked = self._track(points, earlier[:1], later[:1], guess)
        tracked = tracked & valid
        matrix, inliers, agreed = self._ransac(points, end, tracked, samples, tolerance_px, REFITS)
        return matrix, (inliers & agreed[:, None]).sum(1), tracked.sum(1)

    def _track(
        self, points: Tensor, earlier: list[Tensor], later: list[Tensor], guess: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        parameters = self.settings
        settings = {
            "window_px": parameters.window_px,
            "iterations": min(parameters.iterations, STEPS),
            "epsilon_px": parameters.epsilon_px,
            "min_eigen": 1e-4 * LEVEL**2,
        } | ({} if guess is None else {"reach_px": REACH_PX})
        return flow.track(points, earlier, later, guess, **settings)  # type: ignore[arg-type]

    def _ransac(
        self, start: Tensor, end: Tensor, tracked: Tensor, samples: Tensor, gate_px: Tensor, shares: Sequence[float]
    ) -> tuple[Tensor, Tensor, Tensor]:
        gates, samples = tuple(share * gate_px for share in shares), samples[..., : self.model.SAMPLE_SIZE]
        pairs = start.double(), end.double(), tracked
        found: tuple[Tensor, Tensor, Tensor] = self.model.ransac(*pairs, samples, gate_px, gates)
        return found


class Step(nn.Module):
    """Registration and difference in one."""

    def __init__(self, size: tuple[int, int], settings: Settings) -> None:
        super().__init__()
        self.register = Register(size, settings.registration)
        self.compare = WarpDifference(settings.difference, settings.morphology)

    def forward(
        self, reference: Tensor, neighbours: Tensor, samples: Tensor, tolerance_px: Tensor, threshold: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """What `Register` gives, then what `WarpDifference` does."""
        matrix, inliers, tracked = self.register(reference, neighbours, samples, tolerance_px)
        return matrix, inliers, tracked, *self.compare(reference, neighbours, matrix, threshold)


def example_landmarks(count: int, sets: int, seed: int, noise_px: float = 1.0) -> dict[str, np.ndarray]:
    """Landmarks about places some km from the origin, as cameras 50 to 200 m away see them, tilted up to 50 degrees."""
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
    """Between the places in the picture by the graphs and by torch, over sets of landmarks of all sizes, in px."""
    sessions = [open_session(files[name]) for name in PLANES]
    worst = 0.0
    for count in range(4, 17):
        given = example_landmarks(count, 50, count)
        # The source's own system is compared where it has digits to compare: about the origin, in units of 10 m.
        near = {"ground": (given["ground"] - given["ground"][:, :1]) / 10, "image": given["image"] / 500 - 1}
        fit, fit_raw = ([torch.from_numpy(array) for array in held.values()] for held in (given, near))
        results = homography.fit(*fit), homography.fit_raw(*fit_raw)
        for session, held, (wanted, valid), unit in zip(sessions, (given, near), results, (1, 500), strict=True):
            matrix, found_valid = session.run(None, held)
            if not (found_valid.all() and valid.all()):
                return float("inf")
            points = torch.from_numpy(held["ground"])
            there = consensus.transfer(torch.from_numpy(matrix), points) - consensus.transfer(wanted, points)
            worst = max(worst, unit * there.abs().max().item())
    return worst


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


def example_pictures(name: str, settings: Settings, size: tuple[int, int], seed: int) -> dict[str, Tensor]:
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
        "samples": draw_samples(Register(size, settings.registration).count, seed),
        "tolerance_px": torch.tensor(settings.registration.ransac_px, dtype=torch.float64),
        "threshold": threshold,
    }


def draw_samples(count: int, seed: int = 0) -> Tensor:
    """(S, 4) int64: of `count` keypoints the four of every hypothesis."""
    return consensus.draw_samples(torch.Generator().manual_seed(seed), 1, HYPOTHESES, count)[0]
