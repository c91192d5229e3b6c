"""The shapes written in the signatures are the shapes that come and go."""

import inspect
import typing

import jaxtyping
import pytest
import torch

from torchvision_dddas.functional import (
    affine,
    blur,
    consensus,
    difference,
    flow,
    history,
    homography,
    hsv,
    keypoints,
    linear,
    morphology,
    threshold,
    warp,
)

BATCH, POINTS = 2, 9
GREY = torch.rand(BATCH, 1, 37, 53, generator=torch.Generator().manual_seed(0))
MASK = GREY > 0.5
P = torch.rand(BATCH, POINTS, 2, generator=torch.Generator().manual_seed(1)) * 30
ONES = torch.ones(BATCH, POINTS)
EYES = torch.eye(3).expand(BATCH, 3, 3)
CASES = {
    affine.fit: (P, P, ONES),
    affine.three_point: (P[:, :3], P[:, :3]),
    affine.ransac: (P, P, ONES.bool(), torch.tensor([[[0, 1, 2], [3, 4, 5]]]).expand(BATCH, -1, -1)),
    blur.gaussian: (GREY, 5),
    consensus.draw_samples: (torch.Generator(), BATCH, 7, 20),
    difference.exposure: (GREY, GREY, MASK),
    difference.pair: (GREY, GREY, GREY),
    difference.three_frame: (GREY, GREY),
    flow.track: (P, [GREY], [GREY]),
    flow.forward_backward: (P, [GREY], [GREY]),
    history.carry: (GREY, EYES),
    history.gradient: (GREY, 0.1, 0.5),
    history.region_orientation: (GREY, MASK, GREY, MASK.expand(-1, 4, -1, -1), 1.0, 1.0),
    history.update: (GREY, GREY, 2.0, 1.0),
    homography.compose: (EYES, EYES),
    homography.fit: (P, P, ONES),
    homography.fit_raw: (P, P),
    homography.four_point: (P[:, :4], P[:, :4]),
    homography.invert: (EYES,),
    homography.ransac: (P, P, ONES.bool(), torch.tensor([[[0, 1, 2, 3]]]).expand(BATCH, -1, -1)),
    homography.refine: (P, P, ONES, EYES),
    homography.transfer: (EYES, P),
    homography.transfer_error: (EYES, P, P),
    keypoints.good_features: (GREY,),
    keypoints.grid_features: (GREY, 16),
    keypoints.min_eigenvalue: (GREY,),
    hsv.from_bgr: (P[:, :3].reshape(BATCH, 3, 1, 2) / 30,),
    hsv.within: (P[:, :3].reshape(BATCH, 3, 1, 2), P[0, :5].repeat(1, 2)[:, :3], P[0, :5].repeat(1, 2)[:, :3]),
    linear.solve: (EYES, P[:, :3]),
    morphology.dilate: (MASK, 3),
    morphology.erode: (GREY, (3, 5), "ellipse"),
    morphology.opening: (MASK, 3),
    morphology.closing: (MASK, 3),
    threshold.step: (GREY, 0.1),
    warp.warp: (GREY, EYES),
}


def agrees(value: object, annotation: object) -> bool:
    """Whether a value is what a signature says, as far as shapes go; what carries no shape is not looked at."""
    if isinstance(value, tuple):
        return all(agrees(*pair) for pair in zip(value, typing.get_args(annotation), strict=True))
    if not isinstance(value, torch.Tensor):
        return True
    return any(isinstance(value, kind) for kind in typing.get_args(annotation) or (annotation,))


@pytest.mark.parametrize("function", CASES, ids=lambda f: f"{f.__module__.rpartition('.')[2]}.{f.__name__}")
def test_what_goes_in_and_comes_out_has_the_annotated_shapes(function):
    signature = inspect.signature(function)
    # Inside the context a name such as B means the same size in every annotation.
    with jaxtyping.jaxtyped("context"):
        given = signature.bind(*CASES[function]).arguments
        for name, value in given.items():
            assert agrees(value, signature.parameters[name].annotation), name
        assert agrees(function(*CASES[function]), signature.return_annotation)


def test_the_check_would_notice_a_wrong_shape():
    with jaxtyping.jaxtyped("context"):
        assert agrees(P, jaxtyping.Float[torch.Tensor, "B N 2"])
        assert not agrees(ONES[:1], jaxtyping.Float[torch.Tensor, "B N"])


@pytest.mark.parametrize("function", CASES, ids=lambda f: f"{f.__module__.rpartition('.')[2]}.{f.__name__}")
def test_double_precision_goes_through(function):
    def widened(value):
        if isinstance(value, list):
            return [widened(item) for item in value]
        return value.double() if isinstance(value, torch.Tensor) and value.is_floating_point() else value

    results = function(*map(widened, CASES[function]))
    for result in results if isinstance(results, tuple) else (results,):
        assert result.dtype in (torch.float64, torch.bool, torch.int64)
