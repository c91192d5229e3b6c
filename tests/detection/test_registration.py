"""A gain that jumps does not disturb the registration."""

from itertools import pairwise

import cv2
import numpy as np
import pytest

from tests.synthetic_clip import render
from torchvision_dddas import config as parameters
from torchvision_dddas.chain import fit_exposure, match_exposure
from torchvision_dddas.detection import View, Window, load_engine
from torchvision_dddas.detection.engine import judge_points
from torchvision_dddas.detection.opencv_engine import detect_keypoints
from torchvision_dddas.geometry import corner_error

SIZE = (320, 240)
GAIN = [1.0, 1.15, 0.85, 0.85, 1.0, 1.15]


def lit(grey: np.ndarray, gain: float, offset: float = 0.0) -> np.ndarray:
    return np.clip(np.round(grey * gain + offset), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def greys() -> list[np.ndarray]:
    onboard = load_engine("onboard", parameters.load_config())
    return [onboard.prepare(image).grey for image in render(3, 6, SIZE).images]


@pytest.mark.parametrize(("gain", "offset"), [(1.15, 0), (0.85, 0), (1.35, 0), (0.74, 0), (1.0, 12), (0.9, 15)])
def test_the_darker_frame_is_matched_to_the_exposure_of_the_brighter(greys, gain, offset) -> None:
    same, moved = greys[0].astype(int), greys[1]
    earlier, later = match_exposure(View(greys[0], greys[0]), View(lit(moved, gain, offset), lit(moved, gain, offset)))
    changed = later if gain * 128 + offset < 128 else earlier
    wanted = moved if gain * 128 + offset < 128 else lit(same, gain, offset)
    unclipped = (wanted > 5) & (wanted < 250)
    assert np.median(np.abs(changed.astype(int) - wanted)[unclipped]) <= 2
    for a, b in [*pairwise(greys), (greys[0], greys[5])]:  # of one exposure: returned as they are
        kept = match_exposure(View(a, a), View(b, b))
        assert kept[0] is a and kept[1] is b


def test_exposure_is_fitted_only_to_a_gain_and_an_offset() -> None:
    wanted = np.linspace(40, 200, 33)
    assert fit_exposure(wanted, wanted / 1.1 - 3) == pytest.approx((1.1, 3.3))
    assert fit_exposure(wanted, wanted + 8 * np.sin(np.linspace(0, 12, 33))) == (1.0, 0.0)
    # A bright thing that came in moves the upper levels only.
    assert fit_exposure(wanted, wanted + 30 * (wanted > 160)) == (1.0, 0.0)
    gain, offset = fit_exposure(wanted, wanted / 1.1 + 30 * (wanted > 160))
    assert gain * 100 / 1.1 + offset == pytest.approx(100, abs=2)


@pytest.mark.parametrize("config", [None, "fast"])
@pytest.mark.parametrize("backend", ["onboard", "torch"])
def test_a_jumping_gain_does_not_move_the_registration(backend, config) -> None:
    if backend == "torch":
        pytest.importorskip("torch")
    steps = []
    for gain in (None, GAIN):
        engine = load_engine(backend, parameters.load_config(config))
        views = [engine.prepare(image) for image in render(3, 6, SIZE, gain).images]
        # One pair a call, as in a stream: what is carried from step to step must bear the jump too.
        steps.append([engine.register([pair])[0] for pair in pairwise(views)])
    for as_it_is, jumping in zip(*steps, strict=True):
        assert jumping.reliable
        assert corner_error(as_it_is.later_from_earlier, jumping.later_from_earlier, SIZE) < 0.2


@pytest.mark.parametrize("backend", ["onboard", "torch"])
def test_clipped_white_in_both_neighbours_is_no_motion(backend) -> None:
    if backend == "torch":
        pytest.importorskip("torch")
    pattern = np.random.default_rng(0).integers(40, 200, (240, 320)).astype(np.float32)
    still = cv2.GaussianBlur(pattern, (0, 0), 3) - 90 + np.linspace(0, 150, 320)
    still[80:160, 100:220] = np.linspace(205, 250, 120)
    engine = load_engine(backend, parameters.load_config())
    views = [engine.prepare(lit(still, gain)) for gain in (1.2, 1.0, 1.2)]
    assert (views[0].grey == 255).mean() > 0.05
    asked = Window(views[1], (views[0], views[2]), np.stack([np.eye(3)] * 2), (-1, 1), ((0, 1),))
    (found,) = engine.foreground([asked])
    assert not found.core.any()


@pytest.mark.parametrize("size", [SIZE, (251, 187)], ids=["even", "odd"])
def test_corners_found_at_half_resolution_are_on_even_pixels_the_same_in_both_engines_and_fit_the_ground(size) -> None:
    torch = pytest.importorskip("torch")
    from torchvision_dddas.nn import FrameRegistration

    settings = parameters.load_config(None, ["registration.halved_corners=true"])
    clip = render(3, 2, size)
    engine = load_engine("torch", settings)
    views = [engine.prepare(image) for image in clip.images]
    levels = torch.from_numpy(views[0].grey)[None, None].float()
    points, valid = FrameRegistration(settings.registration).keypoints(levels)
    found = {tuple(point) for point in points[0][valid[0]].tolist()}
    wanted = {tuple(point) for point in detect_keypoints(views[0].grey, settings.registration, halved=True).tolist()}
    assert all(u % 2 == v % 2 == 0 for u, v in found)
    assert len(found & wanted) > 0.9 * len(wanted) > 20
    whole = {tuple(point) for point in detect_keypoints(views[0].grey, settings.registration).tolist()}
    assert len(found & whole) < 0.5 * len(found)
    (step,) = engine.register([(views[0], views[1])])
    other = load_engine("onboard", settings)
    (onboard,) = other.register([(other.prepare(clip.images[0]), other.prepare(clip.images[1]))])
    assert step.reliable and corner_error(step.later_from_earlier, onboard.later_from_earlier, size) <= 0.5


@pytest.mark.parametrize(("agree", "is_reliable"), [(120, True), (30, True), (19, False), (7, False)])
def test_one_background_motion_may_hold_for_a_quarter_of_the_keypoints_as_over_water(agree, is_reliable) -> None:
    """Of pictures that show different scenes, at most seven keypoints agree."""
    rng = np.random.default_rng(0)
    start = rng.uniform(0, 600, (120, 2))
    end = start + np.array([5, -3])
    end[agree:] += rng.uniform(10, 40, (120 - agree, 2))
    step = np.array([[1, 0, 5], [0, 1, -3], [0, 0, 1.0]])
    record, inliers = judge_points(step, start, end, (640, 640), parameters.Settings().registration)
    assert record.reliable == is_reliable and inliers.sum() == agree
