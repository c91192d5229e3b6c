"""What every function keeps to: the annotated shapes, double precision, and a batch that equals its members."""

import inspect
import typing
from collections.abc import Callable

import jaxtyping
import pytest
import torch

from torchvision_dddas.functional import (
    affine,
    affinity,
    color,
    consensus,
    difference,
    filters,
    flow,
    hog,
    homography,
    keypoints,
    morphology,
    soft,
    warp,
)

BATCH, POINTS = 2, 9


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


GREY, COLOUR = random(BATCH, 1, 37, 53), random(BATCH, 3, 37, 53)
MASK = GREY > 0.5
P = random(BATCH, POINTS, 2, seed=1) * 30
Q = 1.1 * P + 3 + 0.1 * random(BATCH, POINTS, 2, seed=2)
ONES = torch.ones(BATCH, POINTS)
EYES = torch.eye(3).expand(BATCH, 3, 3)
HSV = P[:, :3].reshape(BATCH, 3, 1, 2)
RANGES = P[0, :5].repeat(1, 2)[:, :3]
BOXES = torch.tensor([[3.0, 2, 10, 12], [8, 5, 20, 9]]).expand(BATCH, 2, 4)
LAYOUT = hog.Layout((16, 24), 4, 8, 4)
CASES: dict[Callable[..., typing.Any], tuple[typing.Any, ...]] = {
    affine.fit: (P, Q, ONES),
    affine.three_point: (P[:, :3], Q[:, :3]),
    affine.ransac: (P, Q, ONES.bool(), torch.tensor([[[0, 1, 2], [3, 4, 5]]]).expand(BATCH, -1, -1)),
    affinity.pairs: (P, Q[:, :4], ONES.bool(), ONES[:, :4].bool()),
    affinity.triplets: (P, Q[:, :4], P[:, :3], ONES.bool(), ONES[:, :4].bool(), ONES[:, :3].bool()),
    color.bgr_to_hsv: (HSV / 30,),
    color.within_ranges: (HSV, RANGES, RANGES),
    color.rgb_histogram: (COLOUR, BOXES, torch.ones(BATCH, 2, dtype=torch.bool), 1.0),
    consensus.transfer: (EYES, P),
    consensus.transfer_error: (EYES, P, Q),
    difference.exposure: (GREY, GREY * 0.9 + 0.01, MASK),
    difference.gradient: ((GREY * 255).round(),),
    filters.gaussian: (COLOUR, 5),
    filters.box_sum: (GREY, 5),
    flow.track: (P, [GREY], [GREY.roll(1, -1)]),
    flow.forward_backward: (P, [GREY], [GREY.roll(1, -1)]),
    homography.fit: (P, Q, ONES),
    homography.fit_raw: (P, Q),
    homography.four_point: (P[:, :4], Q[:, :4]),
    homography.ransac: (P, Q, ONES.bool(), torch.tensor([[[0, 1, 2, 3]]]).expand(BATCH, -1, -1)),
    homography.solve_linear: (EYES, P[:, :3]),
    keypoints.grid_features: (GREY, 16),
    keypoints.min_eigenvalue: (GREY,),
    morphology.dilate: (MASK, 3),
    morphology.erode: (GREY, (3, 5), "ellipse"),
    morphology.opening: (MASK, 3),
    morphology.closing: (GREY, 5, "ellipse", 0.1),
    soft.step: (GREY, 0.1),
    warp.resize: (COLOUR * 255, (20, 57)),
    warp.sample: (GREY, EYES),
}
NO_SHAPES = {hog.blocks: (COLOUR * 255, LAYOUT)}


def label(function: Callable[..., object]) -> str:
    return f"{function.__module__.rpartition('.')[2]}.{function.__name__}"


def agrees(value: object, annotation: object) -> bool:
    """Whether a value is what a signature says, as far as shapes go; what carries no shape is not looked at."""
    if isinstance(value, tuple):
        return all(agrees(*pair) for pair in zip(value, typing.get_args(annotation), strict=True))
    if not isinstance(value, torch.Tensor):
        return True
    return any(isinstance(value, kind) for kind in typing.get_args(annotation) or (annotation,))


@pytest.mark.parametrize("function", CASES, ids=label)
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


@pytest.mark.parametrize("function", CASES, ids=label)
def test_double_precision_goes_through(function):
    def widened(value):
        if isinstance(value, list):
            return [widened(item) for item in value]
        return value.double() if isinstance(value, torch.Tensor) and value.is_floating_point() else value

    results = function(*map(widened, CASES[function]))
    for result in results if isinstance(results, tuple) else (results,):
        assert result.dtype in (torch.float64, torch.bool, torch.int64)


def row(value: typing.Any, at: int) -> typing.Any:
    """One member of a batch; what is no batch stays."""
    if isinstance(value, list | tuple):
        return type(value)(row(item, at) for item in value)
    return value[at : at + 1] if isinstance(value, torch.Tensor) and len(value) == BATCH else value


@pytest.mark.parametrize("function", [*CASES, *NO_SHAPES], ids=label)
def test_a_batch_is_the_same_as_its_members_one_by_one(function):
    given = (CASES | NO_SHAPES)[function]
    together = function(*given)
    for at in range(BATCH):
        # BLAS takes other paths for other batch sizes: the last digits may differ.
        torch.testing.assert_close(
            row(together, at), function(*(row(value, at) for value in given)), atol=1e-4, rtol=1e-4
        )
