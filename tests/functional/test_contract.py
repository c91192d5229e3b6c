"""What every function keeps to: annotated shapes, double precision, a batch equal to its members, and gradients."""

import inspect
import typing
from collections.abc import Callable
from functools import partial
from itertools import pairwise

import jaxtyping
import pytest
import torch

import torchvision_dddas.functional as F
from torchvision_dddas.functional import plane_maps

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
LAYOUT = F.Layout((16, 24), 4, 8, 4)
CASES: dict[Callable[..., typing.Any], tuple[typing.Any, ...]] = {
    F.find_affine: (P, Q, ONES),
    plane_maps.three_point: (P[:, :3], Q[:, :3]),
    F.pair_affinity: (P, Q[:, :4], ONES.bool(), ONES[:, :4].bool()),
    F.triplet_affinity: (P, Q[:, :4], P[:, :3], ONES.bool(), ONES[:, :4].bool(), ONES[:, :3].bool()),
    F.bgr_to_hsv: (HSV / 30,),
    F.within_ranges: (HSV, RANGES, RANGES),
    partial(F.rgb_histogram, softness=1.0): (COLOUR, BOXES, torch.ones(BATCH, 2, dtype=torch.bool)),
    F.log_partition: (P[:, :4, :], 1.0),
    F.fit_exposure: (GREY, GREY * 0.9 + 0.01, MASK),
    F.mean_gradient: ((GREY * 255).round(),),
    F.gaussian_blur2d: (COLOUR, 5),
    F.box_sum: (GREY, 5),
    F.lucas_kanade: (P, [GREY], [GREY.roll(1, -1)]),
    F.forward_backward: (P, [GREY], [GREY.roll(1, -1)]),
    F.find_homography: (P, Q, ONES),
    F.find_homography_raw: (P, Q),
    plane_maps.four_point: (P[:, :4], Q[:, :4]),
    F.ransac: (P, Q, ONES.bool(), torch.tensor([[[0, 1, 2, 3]]]).expand(BATCH, -1, -1)),
    F.solve_linear: (EYES, P[:, :3]),
    F.grid_features: (GREY, 16),
    F.frame_features: (GREY, 20),
    F.corner_min_eigenvalue: (GREY,),
    F.dilation: (MASK, torch.ones(3, 3)),
    F.erosion: (GREY, F.structuring_element("ellipse", (3, 5))),
    F.opening: (MASK, torch.ones(3, 3)),
    F.closing: (GREY, F.structuring_element("ellipse", 5)),
    partial(F.step, softness=0.1): (GREY,),
    F.resize: (COLOUR * 255, (20, 57)),
    F.warp_perspective: (GREY, EYES, (37, 53)),
}
NO_SHAPES = {F.hog: (COLOUR * 255, LAYOUT)}


def label(function: typing.Any) -> str:
    function = getattr(function, "func", function)
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
        for name, value in signature.bind(*CASES[function]).arguments.items():
            assert agrees(value, signature.parameters[name].annotation), name
        assert agrees(function(*CASES[function]), signature.return_annotation)


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
        alone = function(*(row(value, at) for value in given))
        # BLAS takes other paths for other batch sizes: the last digits may differ.
        torch.testing.assert_close(row(together, at), alone, atol=1e-4, rtol=1e-4)


def double(*shape: int, seed: int = 0) -> torch.Tensor:
    return random(*shape, seed=seed).double()


def number(value: float) -> torch.Tensor:
    return torch.tensor(value).double()


FIVE, THERE = 500 * double(1, 5, 2), 500 * double(1, 5, 2) + 3 * double(1, 5, 2, seed=1)
SIX, SEEN = 500 * double(1, 6, 2), 480 * double(1, 6, 2) + 9 * double(1, 6, 2, seed=1)
FIVE_WEIGHTS, SIX_WEIGHTS = (torch.linspace(0.5, 1, count).double()[None] for count in (5, 6))
QUAD = torch.tensor([[[0.0, 0], [90, 10], [100, 80], [5, 70]]]).double()
KNOWN = [torch.ones(2, count, dtype=torch.bool) for count in (4, 3, 5)]
KNOWN[2][1, 4] = False
LABELS = torch.tensor([[[[0, 1, 1, 0], [0, 1, 0, 2], [0, 0, 0, 2]]]])
INSIDE = torch.ones(1, 1, 4, 5, dtype=torch.bool)
BOX, THERE_ARE = torch.tensor([[[0.0, 1, 3, 3], [2, 0, 9, 2]]]).double(), torch.tensor([[True, True]])
LOW, HIGH = torch.tensor([[10.0, 80, 60], [170, 100, 0]]).double(), torch.tensor([[25.0, 255, 255], [8, 255, 255]])
# Smooth functions of the tensors at which their gradient is compared with finite differences.
GRADIENTS: dict[str, tuple[Callable[..., torch.Tensor], tuple[torch.Tensor, ...]]] = {
    "F.find_affine": (lambda p, q: F.find_affine(p, q, FIVE_WEIGHTS)[0], (FIVE, THERE)),
    "F.pair_affinity": (lambda a, b: F.pair_affinity(a, b, *KNOWN[:2]), (double(2, 4, 3), double(2, 3, 3, seed=1))),
    "F.triplet_affinity": (
        lambda a, b, c: F.triplet_affinity(a, b, c, *KNOWN),
        (double(2, 4, 3), double(2, 3, 3, seed=1), double(2, 5, 3, seed=2)),
    ),
    "F.within_ranges": (
        lambda picture, low, high: F.within_ranges(F.bgr_to_hsv(picture), low, high, softness=20.0),
        (0.1 + 0.8 * double(1, 3, 2, 3, seed=1), LOW, HIGH.double()),
    ),
    **{
        f"F.rgb_histogram {softness}": (
            lambda x, softness=softness: F.rgb_histogram(x, BOX, THERE_ARE, softness=softness)[0] @ double(768, seed=3),
            (0.9 * double(1, 3, 4, 5, seed=2),),
        )
        for softness in (1.0, 0.5)
    },
    # A floor above all errors: trimming, which has no gradient, does not take part.
    "F.fit_exposure": (
        lambda a, b: torch.stack(F.fit_exposure(a, b, INSIDE, floor=9.0)),
        (double(1, 1, 4, 5), double(1, 1, 4, 5, seed=1)),
    ),
    "F.log_partition": (lambda x: F.log_partition(x, 1.0), (2 * double(4, 5) - 1,)),
    "F.gaussian_blur2d": (lambda x: F.gaussian_blur2d(x, 3), (double(1, 1, 5, 6),)),
    "F.solve_linear": (
        lambda a, b: F.solve_linear(a, b)[0],
        (double(2, 4, 4) - 0.5, double(2, 4, 2, seed=1)),
    ),
    "plane_maps.four_point": (
        lambda p, q: plane_maps.four_point(p, q)[0],
        (QUAD, QUAD + 5 * double(1, 4, 2)),
    ),
    "F.find_homography": (lambda *x: F.find_homography(*x)[0], (SIX, SEEN, SIX_WEIGHTS)),
    **{
        f"F.find_homography_raw {n}": (lambda *x: F.find_homography_raw(*x)[0], (SIX[:, :n] / 300, SEEN[:, :n] / 300))
        for n in (4, 6)
    },
    "F.corner_min_eigenvalue": (F.corner_min_eigenvalue, (double(1, 1, 6, 7),)),
    **{
        f"morphology.{operation.__name__}": (
            lambda x, operation=operation: operation(x, F.structuring_element("ellipse", (3, 4)), softness=0.3),
            (double(1, 1, 6, 7),),
        )
        for operation in (F.dilation, F.erosion)
    },
    "F.step": (lambda x: F.step(x, softness=0.2), (torch.linspace(-1, 1, 7).double(),)),
    "F.gate_regions": (
        lambda m, e, a, p: F.gate_regions(m, e, LABELS, 2, a, p, softness=0.3),
        (0.8 * (LABELS > 0).double(), 8 * double(1, 1, 3, 4), number(1.5), number(6.0)),
    ),
    "F.resize": (lambda x: F.resize(x, (9, 4)), (255 * double(1, 2, 6, 7),)),
}


@pytest.mark.parametrize("name", GRADIENTS)
def test_gradients_are_those_of_finite_differences(name):
    function, inputs = GRADIENTS[name]
    asked = tuple(value.clone().requires_grad_() for value in inputs)
    assert torch.autograd.gradcheck(function, asked, eps=1e-7 if "histogram" in name else 1e-6)


TWO, SPOTS = torch.ones(BATCH, 2, dtype=torch.bool), (LABELS > 0).float()
SOFT: dict[str, Callable[[float], torch.Tensor]] = {
    "F.step": lambda s: F.step(torch.tensor([-0.3, -0.01, 0.01, 0.3]), softness=s),
    "F.gate_regions": lambda s: F.gate_regions(SPOTS, 8 * GREY[:1, :, :3, :4], LABELS, 2, 2.5, 4.0, softness=s),
    "F.within_ranges": lambda s: F.within_ranges(F.bgr_to_hsv(COLOUR), LOW.float(), HIGH.float(), softness=s),
    "F.rgb_histogram": lambda s: F.rgb_histogram(COLOUR, BOXES, TWO, softness=s, normalize=False)[0],
    **{
        f"morphology.{operation.__name__} {size} {shape}": partial(
            lambda s, operation, size, shape: operation(4 * GREY - 2, F.structuring_element(shape, size), softness=s),
            operation=operation,
            size=size,
            shape=shape,
        )
        for operation in (F.dilation, F.erosion, F.closing, F.opening)
        for size, shape in (((1, 1), "ellipse"), ((4, 7), "rectangle"), ((25, 25), "ellipse"))
    },
}


@pytest.mark.parametrize("name", SOFT)
def test_soft_results_tend_to_the_hard_one_as_softness_vanishes(name):
    hard, *softened = (SOFT[name](softness) for softness in (0.0, 0.5, 0.1, 0.02, 0.001))
    misses = [float((one - hard).abs().mean()) for one in softened]
    assert all(later <= sooner + 1e-6 for sooner, later in pairwise(misses))
    assert misses[-1] < 0.02 and (misses[0] > 0.001 or "(1, 1)" in name)
