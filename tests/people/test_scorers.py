"""Both scorers against OpenCV's HOG detector."""

from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import settings as effort
from hypothesis import strategies as st

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.people import pyramid
from torchvision_dddas.people.classifiers import read_classifier
from torchvision_dddas.people.detector import WindowScorer, load_scorer
from torchvision_dddas.people.torch_scorer import TorchScorer
from torchvision_dddas.types import LinearSvm, Part

BACK_ENDS = "torch", "onboard"
SVM = read_classifier("opencv", 3780)
# What OpenCV does unless told otherwise, whatever the project's defaults.


# The defaults of OpenCV, whatever the project's are.
PLAIN: dict[str, Any] = {"enlarge": 1.0, "padding_px": 0, "window_stride_px": 8, "scale_step": 1.05, "threshold": 0.0}


def scene(seed: int, height: int, width: int) -> np.ndarray:
    """Blurred noise in colour, with upright figures before it."""
    random = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(random.normal(size=(height, width, 3)), (0, 0), 2.5)
    picture = (128 + 35 * noise / noise.std()).clip(0, 255).astype(np.uint8)
    for x in random.integers(20, width - 20, 4).tolist():
        shade = random.integers(0, 256, 3).tolist()
        cv2.ellipse(picture, (x, 60), (14, 28), 0, 0, 360, shade, -1, cv2.LINE_AA)
        cv2.circle(picture, (x, 22), 9, shade, -1, cv2.LINE_AA)
        for side in (-1, 1):
            cv2.line(picture, (x + side * 4, 75), (x + side * 11, 130), shade, 9)
    return picture


def opencv_map(level: np.ndarray, parameters: PeopleParameters) -> np.ndarray:
    """The score of every window of a level; the layout is OpenCV's own."""
    stride, pad = parameters.window_stride_px, parameters.padding_px
    detector = cv2.HOGDescriptor()
    detector.setSVMDetector(np.append(SVM.weights, SVM.bias).astype(np.float32))
    places, found = (np.asarray(hit) for hit in detector.detect(level, -1e9, (stride, stride), (pad, pad)))
    columns, rows = ((places + pad) // stride).T
    wanted = np.full((rows.max() + 1, columns.max() + 1), np.nan)
    wanted[rows, columns] = found.ravel()
    assert not np.isnan(wanted).any()
    return wanted


KNOBS = {
    "as opencv": {},
    "padding": {"padding_px": 32},
    "half a block stride": {"window_stride_px": 4, "padding_px": 16},
    "no multiple of the block stride": {"window_stride_px": 12, "padding_px": 12},
    "enlarged": {"enlarge": 1.5, "scale_step": 1.2},
    "more padding than picture": {"padding_px": 256, "window_stride_px": 16, "scale_step": 1.25},
}


@pytest.mark.parametrize("backend", BACK_ENDS)
@pytest.mark.parametrize("given", KNOBS.values(), ids=KNOBS)
@pytest.mark.parametrize("grey", [False, True])
def test_every_window_of_every_level_scores_as_in_opencv(backend, given, grey):
    parameters = PeopleParameters(**PLAIN | {"scale_step": 1.1} | given)
    picture = scene(0, 171, 203)
    picture = picture[..., 1].copy() if grey else picture
    parts = pyramid.everywhere((203, 171), parameters)
    (maps,) = load_scorer(parameters, backend, SVM).scores([picture], [parts])
    assert len(maps) == len(parts) >= 2
    for part, found in zip(parts, maps, strict=True):
        level = cv2.resize(picture, part.level, interpolation=cv2.INTER_LINEAR_EXACT)
        wanted = opencv_map(level, parameters)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, wanted, atol=2e-5, rtol=0)
        assert ((found > 0) == (wanted > 0)).all()


@pytest.fixture(scope="module", params=BACK_ENDS)
def scorer(request) -> WindowScorer:
    return load_scorer(PeopleParameters(**PLAIN), request.param, SVM)


@effort(max_examples=25, deadline=None)
@given(st.data())
def test_a_part_scores_as_in_a_search_everywhere(scorer, data):
    parameters = PeopleParameters(**PLAIN | {"padding_px": 16, "scale_step": 1.1})
    whole = data.draw(st.sampled_from(pyramid.everywhere((190, 160), parameters)))
    column = data.draw(st.integers(0, (whole.width - 64) // 8))
    row = data.draw(st.integers(0, (whole.height - 128) // 8))
    width = data.draw(st.integers(64, whole.width - column * 8))
    height = data.draw(st.integers(128, whole.height - row * 8))
    part = Part(whole.level, whole.x + column * 8, whole.y + row * 8, width, height)
    ((everywhere, found),) = scorer.scores([scene(3, 160, 190)], [[whole, part]])
    wanted = everywhere[row : row + (height - 128) // 8 + 1, column : column + (width - 64) // 8 + 1]
    np.testing.assert_allclose(found, wanted, atol=2e-5, rtol=0)


def test_a_batch_of_pictures_and_parts_equals_each_alone(scorer):
    pictures = [scene(4, 150, 170), scene(5, 150, 170), scene(6, 150, 170)[..., 0].copy(), scene(7, 180, 140)]
    parameters = PeopleParameters(**PLAIN | {"scale_step": 1.1})
    parts = [pyramid.everywhere(picture.shape[1::-1], parameters) for picture in pictures]
    parts[1] = parts[1][::-2]
    together = scorer.scores(pictures, parts)
    assert [len(maps) for maps in together] == [len(wanted) for wanted in parts]
    for picture, wanted, maps in zip(pictures, parts, together, strict=True):
        for found, alone in zip(maps, scorer.scores([picture], [wanted])[0], strict=True):
            np.testing.assert_allclose(found, alone, atol=2e-6, rtol=0)


def test_gradients_reach_the_picture_and_the_weights():
    scorer = TorchScorer(PeopleParameters(), SVM, "cpu")
    noise = np.random.default_rng(11).integers(0, 256, (150, 90, 3), np.uint8)
    picture = torch.from_numpy(noise).permute(2, 0, 1)[None].float().requires_grad_()
    found = scorer.score(picture, Part((80, 134), 0, 0, 80, 134))
    assert found.shape == (1, 1, 3)
    levels, weights = torch.autograd.grad(found.sum(), [picture, scorer.model.weights])
    assert levels.isfinite().all() and (levels != 0).float().mean() > 0.5
    assert weights.isfinite().all() and (weights != 0).any(-1).all()


@pytest.mark.parametrize("backend", BACK_ENDS)
def test_read_only_and_strided_pictures_score_the_same_and_another_classifier_is_refused(backend, recwarn):
    picture, parts = scene(12, 150, 90), [Part((90, 150), 0, 0, 90, 150)]
    locked = picture.copy()
    locked.flags.writeable = False
    others = [locked, np.asfortranarray(picture), np.ascontiguousarray(picture[:, ::-1])[:, ::-1]]
    wanted, *found = load_scorer(PeopleParameters(), backend, SVM).scores([picture, *others], [parts] * 4)
    for scored in found:
        np.testing.assert_array_equal(scored[0], wanted[0])
    assert not recwarn.list
    with pytest.raises(InputError, match=r"file\.txt has 3000 weights.* has 3780"):
        load_scorer(PeopleParameters(), backend, LinearSvm(np.zeros(3000, np.float32), 0.0, "file.txt"))
