"""HOG blocks and scores by hand, and against cv2.HOGDescriptor."""

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

import torchvision_dddas.functional as F
from torchvision_dddas.errors import InputError
from torchvision_dddas.functional import Layout

LAYOUTS = {
    "default": Layout(),
    "signed": Layout(signed=True, bins=18),
    "small cells": Layout((32, 64), 4, 8, 4),
    "eight bins": Layout((32, 64), 4, 8, 4, bins=8),
    "wide window": Layout((96, 48)),
    "no gamma": Layout(gamma=False),
    "one cell a block": Layout(block=8),
    "three cells a block": Layout((60, 120), 5, 15, 5),
    "blocks apart": Layout((64, 112), stride=16, bins=7),
    "blocks every half cell": Layout((48, 96), stride=4),
}


def bordered(picture: np.ndarray) -> torch.Tensor:
    """uint8 picture -> (1, C, H + 2, W + 2) levels, reflected."""
    around = cv2.copyMakeBorder(picture, 1, 1, 1, 1, cv2.BORDER_REFLECT_101)
    return torch.from_numpy(np.atleast_3d(around)).permute(2, 0, 1)[None].float()


def opencv(layout: Layout, weights: np.ndarray | None = None, bias: float = 0.0) -> cv2.HOGDescriptor:
    block, stride, cell = ((side, side) for side in (layout.block, layout.stride, layout.cell))
    made = cv2.HOGDescriptor(
        layout.window, block, stride, cell, layout.bins, 1, -1, 0, layout.clip, layout.gamma, 64, layout.signed
    )
    if weights is not None:
        made.setSVMDetector(np.append(weights, bias).astype(np.float32))
    return made


def opencv_scores(picture: np.ndarray, layout: Layout, weights: np.ndarray, bias: float) -> np.ndarray:
    hits = opencv(layout, weights, bias).detect(picture, -1e9, (layout.stride, layout.stride), (0, 0))
    places, found = (np.asarray(hit) for hit in hits)
    down, across = (
        (have - need) // layout.stride + 1 for have, need in zip(picture.shape[:2], layout.window[::-1], strict=True)
    )
    wanted = np.full((down, across), np.nan)
    wanted[places[:, 1] // layout.stride, places[:, 0] // layout.stride] = found.ravel()
    assert not np.isnan(wanted).any()
    return wanted


def own_scores(picture: np.ndarray, layout: Layout, weights: np.ndarray, bias: float) -> np.ndarray:
    arranged = F.arrange_weights(torch.from_numpy(weights), layout)
    return F.svm_scores(F.hog(bordered(picture), layout), arranged, torch.tensor(bias))[0].numpy()


def random_svm(layout: Layout, seed: int = 0) -> tuple[np.ndarray, float]:
    """An SVM whose scores have a standard deviation of about one and lie around zero."""
    weights = np.random.default_rng(seed).normal(size=layout.features).astype(np.float32)
    return weights / np.float32(math.sqrt(layout.blocks[0] * layout.blocks[1])), -0.05


@pytest.fixture(scope="module")
def colour(texture) -> np.ndarray:
    return np.dstack([texture(seed, 150, 172) for seed in range(3)])


def test_a_vertical_edge_by_hand():
    layout = Layout((2, 2), cell=2, block=2, stride=2, clip=1.0, gamma=False)
    edge = torch.tensor([0.0, 0, 100, 100]).expand(1, 1, 4, 4)
    # The gradient is 100 at all four pixels, at 0 degrees: halfway between the last bin's centre and the first's. A
    # pixel counts by a Gaussian of sigma 0.5 around the second one, and by 0.75: it is a quarter cell off the centre.
    pooled = 50 * (0.75 * (math.exp(-2) + 1)) ** 2
    share = pooled / (math.sqrt(2) * pooled + 0.9)
    wanted = torch.zeros(9)
    wanted[0] = wanted[8] = share / (math.sqrt(2) * share + 1e-3)
    torch.testing.assert_close(F.hog(edge, layout).flatten(), wanted, atol=1e-5, rtol=0)


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
@pytest.mark.parametrize("channels", [1, 3])
def test_every_windows_score_is_opencvs(colour, layout, channels):
    picture, svm = colour if channels == 3 else colour[..., 0].copy(), random_svm(layout)
    wanted, found = opencv_scores(picture, layout, *svm), own_scores(picture, layout, *svm)
    assert found.shape == wanted.shape and wanted.std() > 0.1
    np.testing.assert_allclose(found, wanted, atol=3e-5, rtol=0)
    assert ((found > 0) == (wanted > 0)).all()


@settings(max_examples=40, deadline=None)
@given(
    cell=st.integers(2, 8),
    cells=st.integers(1, 3),
    every=st.integers(1, 10),
    blocks=st.tuples(st.integers(1, 4), st.integers(1, 4)),
    bins=st.integers(4, 20),
    signed=st.booleans(),
    gamma=st.booleans(),
    seed=st.integers(0, 1000),
)
@example(cell=4, cells=1, every=1, blocks=(1, 2), bins=20, signed=True, gamma=False, seed=147)  # hats as differences
def test_a_descriptor_of_any_layout_is_opencvs(cell, cells, every, blocks, bins, signed, gamma, seed):
    block = cell * cells
    window = block + (blocks[0] - 1) * every, block + (blocks[1] - 1) * every
    # OpenCV goes through four columns at a time, and in those left over another channel wins among equal ones.
    assume(window[0] % 4 == 0)
    layout = Layout(window, cell, block, every, bins, signed, gamma=gamma)
    picture = np.random.default_rng(seed).integers(0, 256, (window[1], window[0], 3), np.uint8)
    across, down = layout.blocks
    found = F.hog(bordered(picture), layout)[0].view(bins, cells, cells, down, across).permute(4, 3, 2, 1, 0)
    wanted = np.ravel(opencv(layout).compute(picture))
    np.testing.assert_allclose(found.flatten().numpy(), wanted, atol=3e-5, rtol=0)


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("channels", [1, 3])
def test_gradients_are_those_of_finite_differences(channels, signed):
    layout, generator = Layout((16, 24), 4, 8, 4, signed=signed), torch.Generator().manual_seed(0)
    levels = torch.rand(1, channels, 28, 22, generator=generator, dtype=torch.float64) * 250 + 2
    weights = F.arrange_weights(torch.randn(layout.features, generator=generator, dtype=torch.float64), layout)
    inputs = [given.requires_grad_() for given in (levels, weights.clone(), torch.zeros((), dtype=torch.float64))]
    assert torch.autograd.gradcheck(
        lambda levels, weights, bias: F.svm_scores(F.hog(levels, layout), weights, bias),
        inputs,
        fast_mode=True,
    )


COLUMN, ROW = torch.arange(22.0).expand(28, 22), torch.arange(28.0)[:, None].expand(28, 22)
PICTURES = {"black": 0 * ROW, "white": 255 + 0 * ROW, "edge": 255.0 * (COLUMN > 10), "diagonal": ROW + COLUMN}


@pytest.mark.parametrize("gamma", [False, True])
@pytest.mark.parametrize("shape", PICTURES)
def test_gradients_stay_finite_where_the_picture_is_flat_black_or_straight(shape, gamma):
    layout = Layout((16, 24), 4, 8, 4, gamma=gamma)
    picture = PICTURES[shape].expand(1, 3, 28, 22).clone().requires_grad_()
    weights = torch.randn(layout.features, generator=torch.Generator().manual_seed(0))
    scored = F.svm_scores(F.hog(picture, layout), F.arrange_weights(weights, layout), torch.tensor(0.0))
    (slope,) = torch.autograd.grad(scored.sum(), picture)
    assert slope.isfinite().all()
    assert bool((slope != 0).any()) == (shape in ("edge", "diagonal"))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"cell": 6}, "block of 16 px is not a multiple of a cell of 6 px"),
        ({"window": (60, 128)}, "do not fill a window width of 60 px"),
        ({"window": (64, 8)}, "do not fill a window height of 8 px; wanted 16"),
    ],
)
def test_what_does_not_fit_is_refused_or_has_no_score(texture, given, message):
    with pytest.raises(InputError, match=message):
        Layout(**given)
    assert own_scores(texture(6, 127, 63), Layout(), *random_svm(Layout())).size == 0
