"""The public modules: what their functions compute, with parameters that learn, in the onboard engine's numbers."""

import cv2
import numpy as np
import pytest
import torch

import torchvision_dddas.functional as F
from tests.synthetic_clip import RATE_HZ, flight, render
from torchvision_dddas.config import PaperParameters, RegistrationParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.nn import FrameRegistration, HistogramAffinity, HOGDescriptor, PersonScorer, PlaneHomography
from torchvision_dddas.tracking import rgb_histograms, source_tracker

NONE = torch.zeros(1, 0, 2)
LAYOUT = F.Layout((32, 64), 4, 8, 4)


def picture(height: int = 90, width: int = 70) -> np.ndarray:
    """(H, W, 3) uint8 BGR."""
    noise = np.random.default_rng(0).integers(0, 256, (height // 4 + 1, width // 4 + 1, 3), np.uint8)
    return cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)


def rgb(*pictures: np.ndarray) -> torch.Tensor:
    """BGR bytes -> (B, 3, H, W) RGB in [0, 1]."""
    return torch.from_numpy(np.stack(pictures)[..., ::-1].copy()).permute(0, 3, 1, 2) / 255.0


@pytest.mark.parametrize("stride", [4, 6, 8])
def test_a_person_scorer_scores_windows_as_opencv_does_and_learns(stride):
    random = np.random.default_rng(1)
    weights, image = random.normal(0, 0.02, LAYOUT.features).astype(np.float32), picture()
    scorer = PersonScorer(torch.from_numpy(weights), -0.3, layout=LAYOUT, window_stride_px=stride)
    detector = cv2.HOGDescriptor(LAYOUT.window, (8, 8), (4, 4), (4, 4), 9, 1, -1, 0, 0.2, True)
    detector.setSVMDetector(np.append(weights, -0.3).astype(np.float32))
    places, wanted = (np.asarray(hit) for hit in detector.detect(image, -1e9, (stride, stride), (0, 0)))
    found = scorer(rgb(image, image))
    np.testing.assert_allclose(
        found[1].detach().numpy()[places[:, 1] // stride, places[:, 0] // stride], wanted.ravel(), atol=1e-4
    )
    found.sum().backward()
    assert scorer.weights.grad is not None and bool(scorer.weights.grad.any())
    assert scorer.bias.grad is not None and scorer.bias.grad.item() == found.numel()


def test_a_hog_descriptor_is_that_of_opencv():
    layout = F.Layout((64, 64))
    image = picture(64, 64)
    wanted = np.asarray(cv2.HOGDescriptor((64, 64), (16, 16), (8, 8), (8, 8), 9, 1, -1, 0, 0.2, True).compute(image))
    found = HOGDescriptor(layout)(rgb(image))
    # OpenCV goes through blocks, and a block's cells, column by column; the bins vary fastest.
    ordered = found[0].view(9, 2, 2, 7, 7).permute(4, 3, 2, 1, 0).flatten()
    np.testing.assert_allclose(ordered.numpy(), wanted.ravel(), atol=1e-4)


def test_a_registration_finds_the_motion_of_the_background_whatever_the_exposure():
    images, size = render(1, 4, (320, 240), [1.0, 1.2, 1.0, 0.8]).images, (320, 240)
    grey = torch.from_numpy(np.stack([cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images]))[:, None]
    motion = FrameRegistration(RegistrationParameters())(grey[:-1] / 255.0, grey[1:] / 255.0)
    corners = torch.tensor([[0.0, 0], [319, 0], [0, 239], [319, 239]], dtype=torch.float64).expand(3, 4, 2)
    ground = torch.from_numpy(np.stack([view.image_from_ground for view in flight(1, 4, size, RATE_HZ)]))
    true = ground[1:] @ torch.linalg.inv(ground[:-1])
    off = F.transform_points(motion.later_from_earlier, corners) - F.transform_points(true, corners)
    assert off.norm(dim=-1).max() < 0.5 and (motion.inliers.sum(1) > 0.8 * motion.tracked.sum(1)).all()


def test_affinities_of_all_windows_are_those_of_each_by_the_onboard_association():
    clip = [picture(), picture()[::-1].copy(), 255 - picture()]
    boxes = np.array([[3, 2, 20, 12], [30, 20, 25, 40], [5, 50, 9, 9]], float)
    valid = torch.tensor([[True, True, True], [True, True, False], [True, True, True]])
    parameters, model = PaperParameters(), HistogramAffinity(normalize=False)
    histograms = [rgb_histograms(image, boxes).astype(float)[known] for image, known in zip(clip, valid, strict=True)]
    for windows in (torch.tensor([[1, 0], [2, 1]]), torch.tensor([[2, 1, 0]])):
        found = model(rgb(*clip), torch.from_numpy(boxes).float().expand(3, 3, 4), valid, windows).numpy()
        for row, places in zip(found, windows.tolist(), strict=True):
            wanted = source_tracker.affinity([histograms[place] for place in places], parameters)
            there = np.ix_(*(np.flatnonzero(valid[place]) for place in places))
            np.testing.assert_allclose(row[there], wanted[(slice(1, None),) * len(places)], atol=2e-6)
            assert np.count_nonzero(row) == np.count_nonzero(row[there]), "a missing box resembles nothing"


def test_a_plane_homography_leaves_out_what_has_no_weight():
    generator = torch.Generator().manual_seed(0)
    ground = 10 * torch.rand(2, 7, 2, generator=generator, dtype=torch.float64)
    true = torch.tensor([[50.0, 3, 100], [-4, 60, 80], [0.01, 0.002, 1]], dtype=torch.float64).expand(2, 3, 3)
    image, weight = F.transform_points(true, ground), torch.ones(2, 7, dtype=torch.float64)
    image[:, 6] += 90
    weight[:, 6] = 0
    found, valid = PlaneHomography()(ground, image, weight)
    assert valid.all()
    torch.testing.assert_close(found, true, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: PersonScorer(torch.zeros(7), 0.0), r"weights must be 3780 numbers, got \(7,\)"),
        (
            lambda: HistogramAffinity().affinity(
                torch.ones(4, 2, 5), torch.ones(4, 2).bool(), torch.zeros(1, 4, dtype=torch.int64)
            ),
            r"windows must be \(W, 2\) or \(W, 3\) indices of frames, got \(1, 4\)",
        ),
        (
            lambda: F.ransac(NONE, NONE, torch.ones(1, 0).bool(), torch.zeros(1, 3, 4).long()),
            "RANSAC needs 4 pairs of points, got none",
        ),
    ],
)
def test_shapes_that_no_module_takes_are_refused_in_one_line(call, words):
    with pytest.raises(InputError, match=words):
        call()
