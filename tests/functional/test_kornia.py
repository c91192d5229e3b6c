"""Where an operation of ours stands beside Kornia's: the same numbers, or what differs by design."""

import inspect
from typing import Any, cast

import cv2
import kornia
import numpy as np
import pytest
import torch

import torchvision_dddas.functional as F
from torchvision_dddas.errors import InputError

MOTION = torch.tensor([[[1.05, 0.04, -3.0], [-0.02, 0.97, 2.0], [2e-4, -1e-4, 1.0]]], dtype=torch.float64)


@pytest.fixture(scope="module")
def picture(texture) -> torch.Tensor:
    """(2, 1, 48, 61) float64 in [0, 1], whole grey levels."""
    return torch.from_numpy(np.stack([texture(k, 48, 61) for k in range(2)]) / 255.0)[:, None]


NAMESAKES = {
    F.warp_perspective: kornia.geometry.warp_perspective,
    F.resize: kornia.geometry.resize,
    F.build_pyramid: kornia.geometry.build_pyramid,
    F.gaussian_blur2d: kornia.filters.gaussian_blur2d,
    **{getattr(F, name): getattr(kornia.morphology, name) for name in ("dilation", "erosion", "opening", "closing")},
}


@pytest.mark.parametrize("ours", NAMESAKES, ids=lambda function: function.__name__)
def test_arguments_by_place_are_kornias_in_its_order(ours):
    """What only ours has is given by name."""
    by_place = [p.name for p in inspect.signature(ours).parameters.values() if p.kind is not p.KEYWORD_ONLY]
    assert by_place == list(inspect.signature(NAMESAKES[ours]).parameters)[: len(by_place)]


def test_what_kornia_has_and_ours_would_repeat_is_kornias_own():
    assert F.transform_points is kornia.geometry.transform_points
    assert F.oneway_transfer_error is kornia.geometry.oneway_transfer_error


@pytest.mark.parametrize("padding_mode", ["zeros", "border"])
@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
def test_a_warp_is_kornias_and_so_are_its_gradients(picture, mode, padding_mode):
    asked = []
    for warp in (F.warp_perspective, kornia.geometry.warp_perspective):
        matrix, image = MOTION.repeat(2, 1, 1).requires_grad_(), picture.clone().requires_grad_()
        warped = warp(image, matrix, (40, 52), mode=mode, padding_mode=padding_mode)
        slopes = torch.autograd.grad(warped.square().sum(), (image, matrix), allow_unused=True)
        asked.append((warped, *slopes))
    ours, theirs = asked
    assert theirs[0].count_nonzero() > 1000
    torch.testing.assert_close(ours[:2], theirs[:2], atol=1e-9, rtol=1e-9)
    if mode == "bilinear":
        torch.testing.assert_close(ours[2], theirs[2], atol=1e-6, rtol=1e-6)


def test_a_blur_with_a_given_sigma_is_kornias_at_every_border(picture):
    for border in ("reflect", "replicate", "constant", "circular"):
        ours, theirs = (
            blur(picture, (5, 7), (1.5, 1.1), border) for blur in (F.gaussian_blur2d, kornia.filters.gaussian_blur2d)
        )
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("size", [3, 5, 7])
def test_a_blur_without_sigma_is_nearly_kornias_filter_of_opencvs_weights(picture, size):
    kernel = torch.from_numpy(cv2.getGaussianKernel(size, 0)).T
    wanted = kornia.filters.filter2d_separable(picture, kernel, kernel)  # at the border `reflect`
    torch.testing.assert_close(F.gaussian_blur2d(picture, size), wanted, rtol=0, atol=0.02)


@pytest.mark.parametrize("size", [(31, 40), (70, 90)])
def test_resizing_is_kornias_but_for_weights_in_256ths(picture, size):
    levels = picture.float() * 255
    apart = F.resize(levels, size) - kornia.geometry.resize(levels, size, align_corners=False)
    steps = max(float(levels.diff(dim=axis).abs().max()) for axis in (-1, -2))
    assert apart.abs().max() <= 2 * steps / 512 + 1e-3


def test_the_mean_gradient_is_kornias_sobel_and_box_blur_but_for_rounding(picture):
    levels = picture * 255
    # Kornia repeats the edge pixel, OpenCV mirrors: the rim differs.
    steep = kornia.filters.sobel(levels, normalized=False) / 2
    wanted = kornia.filters.box_blur(steep.clamp(max=255), 5)[..., 3:-3, 3:-3]
    assert (F.mean_gradient(levels)[..., 3:-3, 3:-3] - wanted).abs().max() <= 1.0


@pytest.mark.parametrize("block", [3, 5])
def test_corners_are_where_kornias_gradients_under_a_box_say(picture, block):
    du, dv = kornia.filters.spatial_gradient(picture, normalized=False).div(4).unbind(2)
    uu, vv, uv = (kornia.filters.box_blur(product, block) for product in (du * du, dv * dv, du * dv))
    wanted = torch.linalg.eigvalsh(torch.stack([uu, uv, uv, vv], -1).unflatten(-1, (2, 2)))[..., 0]
    torch.testing.assert_close(
        F.corner_min_eigenvalue(picture, block=block)[..., 4:-4, 4:-4], wanted[..., 4:-4, 4:-4], atol=1e-9, rtol=1e-6
    )


def test_a_pyramid_takes_every_other_pixel_of_kornias_smoothed_picture(picture):
    kernel = torch.tensor([1.0, 4, 6, 4, 1], dtype=torch.float64) / 16
    wanted = kornia.filters.filter2d_separable(picture, kernel[None], kernel[None])[..., ::2, ::2]
    whole, half = F.build_pyramid(picture, 2)
    assert whole is picture
    torch.testing.assert_close(half, wanted)
    by_opencv = np.stack([cv2.pyrDown(one[0].numpy()) for one in picture])[:, None]
    np.testing.assert_allclose(half.numpy(), by_opencv, atol=1e-12)


@pytest.mark.parametrize("operation", ["dilation", "erosion", "opening", "closing"])
def test_morphology_under_any_symmetric_kernel_is_kornias(picture, operation):
    ring = torch.ones(5, 7)
    ring[1:4, 2:5] = 0  # rows of two runs
    for kernel in (torch.ones(3, 5), F.structuring_element("ellipse", 7), ring):
        ours, theirs = (getattr(of, operation)(picture, kernel.to(picture)) for of in (F, kornia.morphology))
        torch.testing.assert_close(ours, theirs)


def test_a_histogram_shared_between_levels_is_kornias_triangular_one(picture):
    image = picture[:1].expand(-1, 3, -1, -1)
    whole = torch.tensor([[[0.0, 0.0, 61.0, 48.0]]], dtype=torch.float64)
    found, _ = F.rgb_histogram(0.97 * image, whole, torch.ones(1, 1, dtype=torch.bool), softness=1.0, normalize=False)
    wanted, _ = kornia.enhance.image_histogram2d(
        0.97 * 255 * image, min=0.0, max=255.0, n_bins=256, bandwidth=1.0, centers=torch.arange(256.0).double()
    )
    torch.testing.assert_close(found[0, 0].reshape(3, 256), wanted[0], atol=1e-6, rtol=1e-6)


def test_colours_are_kornias_in_opencvs_units(picture):
    image = torch.cat([picture, picture.flip(-1), picture.flip(-2)], 1)
    hue, saturation, value = kornia.color.rgb_to_hsv(image.flip(1)).unbind(1)
    wanted = torch.stack([hue * 90 / np.pi, saturation * 255, value * 255], 1)
    torch.testing.assert_close(F.bgr_to_hsv(image), wanted)


def test_ransac_finds_what_kornias_finds():
    generator = torch.Generator().manual_seed(0)
    points = 400 * torch.rand(1, 100, 2, generator=generator)
    seen = F.transform_points(MOTION.float(), points)
    seen[:, 60:] += 50 + 40 * torch.rand(1, 40, 2, generator=generator)
    samples = F.draw_samples(generator, 1, 128, 100)
    found, inliers, valid = F.ransac(points, seen, torch.ones(1, 100, dtype=torch.bool), samples, tolerance_px=2.0)
    theirs, their_inliers = kornia.geometry.RANSAC("homography", inl_th=2.0, seed=0)(points[0], seen[0])
    assert valid.all() and inliers[0].tolist() == their_inliers.tolist() == [True] * 60 + [False] * 40
    apart = F.transform_points(found, points) - F.transform_points(theirs[None], points)
    assert apart.abs().max() < 0.02


def test_a_homography_is_kornias_fit_of_the_pairs_that_have_a_weight():
    points = 400 * torch.rand(3, 20, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    seen = F.transform_points(MOTION.expand(3, 3, 3), points)
    weights = torch.ones(3, 20, dtype=torch.float64)
    seen[:, 15:] += 30
    weights[:, 15:] = 0
    found, valid = F.find_homography(points, seen, weights)
    assert valid.all()
    torch.testing.assert_close(found, kornia.geometry.find_homography_dlt(points, seen, weights), rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(found, MOTION.expand(3, 3, 3), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("name", "src", "M"),
    [
        ("M", torch.rand(1, 1, 8, 9), torch.eye(3)),
        ("M", torch.rand(1, 1, 8, 9), np.eye(3)),
        ("M", torch.rand(2, 1, 8, 9), torch.eye(3)[None]),
        ("M", torch.rand(1, 1, 8, 9), [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]),
        ("src", (200 * torch.rand(1, 1, 8, 9)).byte(), torch.eye(3)[None]),
        ("src", torch.rand(3, 8, 9), torch.eye(3)[None]),
        ("src", np.zeros((8, 9, 3), np.uint8), torch.eye(3)[None]),
        ("src", np.zeros((8, 9), np.float32), torch.eye(3)[None]),
    ],
)
def test_warping_what_is_no_batch_is_refused_with_the_code_that_makes_one(name, src, M):
    with pytest.raises(InputError, match=rf"^{name} (must be|has)") as error:
        F.warp_perspective(src, M, (8, 9))
    made = eval(str(error.value).rpartition(": ")[2], {"torch": torch, "src": src, "M": M})
    assert F.warp_perspective(**{"src": src, "M": M, name: made}, dsize=(8, 9)).shape[-2:] == (8, 9)


def test_an_affine_map_and_one_number_as_size_are_refused():
    src, M = torch.rand(1, 1, 8, 9), torch.eye(3)[None]
    with pytest.raises(InputError, match=r"M must have the shape \(B, 3, 3\), got \(1, 2, 3\); add the row 0, 0, 1"):
        F.warp_perspective(src, M[:, :2], (8, 9))
    with pytest.raises(InputError, match=r"dsize must be \(height, width\), got 60; "):
        F.warp_perspective(src, M, cast(Any, 60))
