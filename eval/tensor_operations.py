"""The batched operations of `functional`, beside OpenCV's and Kornia's operations for the same work."""

from collections.abc import Callable
from typing import Any

import cv2
import kornia
import numpy as np
import torch
from clips import Size

import torchvision_dddas.functional as F
from torchvision_dddas.detection.torch_blobs import label_components
from torchvision_dddas.lab.benchmark.torch_operations import (
    MATRIX,
    Call,
    brightest,
    kornia_pairs,
    random_pictures,
    to_grey,
)
from torchvision_dddas.tracking import rgb_histograms

_POINTS, _WRONG, _HYPOTHESES, _TOLERANCE_PX = 300, 0.3, 128, 2.0
_BOXES, _BOX_PX = 10, (40, 90)


def operations(size: Size, batch: int, device: str = "cpu") -> dict[str, dict[str, Call | None]]:
    """Return {operation: {"OpenCV", "ours", "Kornia": call on a batch}}; None if Kornia lacks the operation.

    device: torch device of our and Kornia's calls. OpenCV computes on the CPU.
    """
    made = _of_pictures(size, batch, device) | _of_points(batch, device)
    return {row: dict(zip(("OpenCV", "ours", "Kornia"), calls, strict=True)) for row, calls in made.items()}


def _of_pictures(size: Size, batch: int, device: str) -> dict[str, tuple[Call, Call, Call | None]]:
    width, height = size
    coloured = random_pictures(size, batch)
    grey, random = to_grey(coloured), np.random.default_rng(1)
    is_set = brightest(grey)
    rgb = torch.from_numpy(coloured).to(device).permute(0, 3, 1, 2).float().div(255).flip(1).contiguous()
    masks = torch.from_numpy(is_set)[:, None].to(device)
    smaller = (height * 2 // 3, width * 2 // 3)
    corner = random.integers(0, (width - _BOX_PX[0], height - _BOX_PX[1]), (batch, _BOXES, 2))
    box_px = np.concatenate([corner, np.broadcast_to(_BOX_PX, corner.shape)], axis=2).astype(float)
    boxes, valid = (
        torch.from_numpy(box_px).float().to(device),
        torch.ones(batch, _BOXES, dtype=torch.bool, device=device),
    )

    def each(call: Callable[[np.ndarray], object], pictures: np.ndarray = grey) -> Call:
        return lambda: [call(picture) for picture in pictures]

    def kornia_histograms() -> object:
        crops = [
            picture[None, :, y : y + h, x : x + w]
            for picture, some in zip(rgb * 255, box_px.astype(int).tolist(), strict=True)
            for x, y, w, h in some
        ]
        count = kornia.enhance.image_histogram2d
        return [count(crop, 0.0, 255.0, 256, 1.0, torch.arange(256.0, device=device)) for crop in crops]

    def morphology(side: int, how: int) -> Call:
        kernel = F.structuring_element("ellipse", side).numpy()
        return each(lambda picture: cv2.morphologyEx(picture, how, kernel), is_set)

    components = each(lambda picture: cv2.connectedComponentsWithStats(picture, ltype=cv2.CV_32S), is_set)
    labelled = components if device == "cpu" else lambda: label_components(masks > 0, masks)
    opencv = {
        "warp (ours: Kornia's remap)": each(lambda picture: cv2.warpPerspective(picture, MATRIX, size)),
        "resize to two thirds": each(
            lambda picture: cv2.resize(picture, smaller[::-1], interpolation=cv2.INTER_LINEAR_EXACT)
        ),
        "Gaussian 7, floats (ours: Kornia's)": each(
            lambda picture: cv2.GaussianBlur(picture, (7, 7), 0), grey.astype(np.float32)
        ),
        "Gaussian 7, bytes (ours: Kornia's and conversions)": each(
            lambda picture: cv2.GaussianBlur(picture, (7, 7), 0)
        ),
        "gradient, box mean 5": each(
            lambda p: cv2.blur(cv2.magnitude(cv2.Sobel(p, 5, 1, 0), cv2.Sobel(p, 5, 0, 1)), (5, 5))
        ),
        "smaller eigenvalue 5": each(lambda picture: cv2.cornerMinEigenVal(picture, 5)),
        "pyramid of 4": each(lambda picture: cv2.buildOpticalFlowPyramid(picture, (21, 21), 3, withDerivatives=False)),
        "erosion 3": morphology(3, cv2.MORPH_ERODE),
        "closing 15": morphology(15, cv2.MORPH_CLOSE),
        "RGB to HSV": each(lambda picture: cv2.cvtColor(picture, cv2.COLOR_BGR2HSV), coloured),
    }
    shared = {name: (opencv[name], *calls) for name, calls in kornia_pairs(coloured, device).items()}
    return shared | {
        "components (ours: OpenCV's)" if device == "cpu" else "components": (
            components,
            labelled,
            lambda: kornia.contrib.connected_components_union_find(masks.float()),
        ),
        f"histograms of {_BOXES} boxes": (
            lambda: [rgb_histograms(picture, some) for picture, some in zip(coloured, box_px, strict=True)],
            lambda: F.rgb_histogram(rgb, boxes, valid, largest=_BOX_PX[::-1]),
            kornia_histograms,
        ),
    }


def _of_points(batch: int, device: str) -> dict[str, tuple[Call, Call, Call | None]]:
    generator = torch.Generator().manual_seed(0)
    matrix = torch.from_numpy(MATRIX).float().expand(batch, 3, 3)
    points = 400 * torch.rand(batch, _POINTS, 2, generator=generator)
    seen = F.transform_points(matrix, points) + 0.3 * torch.randn(batch, _POINTS, 2, generator=generator)
    wrong = seen.clone()
    wrong[:, : round(_WRONG * _POINTS)] += 60 * torch.randn(batch, round(_WRONG * _POINTS), 2, generator=generator)
    weights = 0.5 + torch.rand(batch, _POINTS, generator=generator)
    there = torch.ones(batch, _POINTS, dtype=torch.bool)
    samples = F.draw_samples(generator, 1, _HYPOTHESES, _POINTS).expand(batch, -1, -1)
    homography, host = matrix[0].double().numpy(), (points, seen, wrong)
    matrix, points, seen, wrong, weights, there, samples = (
        given.to(device) for given in (matrix, points, seen, wrong, weights, there, samples)
    )
    many = points.repeat(1, 100, 1)
    many_on_host = many.cpu().numpy()
    kornias = kornia.geometry.RANSAC("homography", inl_th=_TOLERANCE_PX, seed=0)

    def each(call: Callable[[Any, Any], object], other: torch.Tensor) -> Call:
        pairs = [(p.numpy(), q.numpy()) for p, q in zip(host[0], other, strict=True)]
        return lambda: [call(p, q) for p, q in pairs]

    return {
        f"homography of {_POINTS}, weighted (OpenCV: not)": (
            each(lambda p, q: cv2.findHomography(p, q, 0), host[1]),
            lambda: F.find_homography(points, seen, weights),
            lambda: kornia.geometry.find_homography_dlt(points, seen, weights),
        ),
        f"RANSAC of {_POINTS}, {_WRONG:.0%} wrong": (
            each(lambda p, q: cv2.findHomography(p, q, cv2.RANSAC, _TOLERANCE_PX), host[2]),
            lambda: F.ransac(points, wrong, there, samples, tolerance_px=_TOLERANCE_PX),
            lambda: [kornias(p, q) for p, q in zip(points, wrong, strict=True)],
        ),
        f"{many.shape[1]} points transformed (ours: Kornia's)": (
            lambda: [cv2.perspectiveTransform(some[:, None], homography) for some in many_on_host],
            lambda: F.transform_points(matrix, many),
            lambda: kornia.geometry.transform_points(matrix, many),
        ),
    }
