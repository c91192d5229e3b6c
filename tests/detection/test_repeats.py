"""Repeated pictures are noticed and cost nothing; still scenes and slow movers are no repeats."""

import cv2
import numpy as np
import pytest

from tests.detection.test_detector import Film, detect, same
from tests.synthetic_clip import render
from torchvision_dddas.config import load_config
from torchvision_dddas.detection import MotionDetector, detect_motion
from torchvision_dddas.detection.repeats import RepeatRule
from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Frame

SIZE = (320, 240)
# How often each picture is stored: 30 a second at 60, 24 at 30, 24 at 60 (3:2), 15 at 60, and a pattern without rule.
PATTERNS = {"30 at 60": [2], "24 at 30": [1, 1, 1, 2], "24 at 60": [2, 3], "15 at 60": [4], "any": [1, 3, 2, 1, 1, 4]}


@pytest.fixture(scope="module")
def film():
    return render(seed=0, frames=16, size=SIZE).images


def stored(count, pattern):
    """The place of the shown picture, for each stored one."""
    return [k for k in range(count) for _ in range(pattern[k % len(pattern)])]


def coded_again(image, quality):
    """The picture as a copy of it comes out of a codec."""
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)


@pytest.mark.slow
@pytest.mark.parametrize("pattern", PATTERNS.values(), ids=PATTERNS.keys())
@pytest.mark.parametrize("config", [None, "fast", "half", "paper"])
def test_repeats_cost_nothing_in_any_configuration(film, config, pattern):
    settings, places = load_config(config, ["interval.rule=false"]), stored(len(film), pattern)
    once, scenes = detect(film, settings), detect([film[k] for k in places], settings)
    assert [scene.frame.number for scene in scenes] == list(range(1, len(places) + 1))
    for number, (place, scene) in enumerate(zip(places, scenes, strict=True), 1):
        assert np.array_equal(scene.detections.box_px, once[place].detections.box_px)
        assert np.array_equal(scene.mask, once[place].mask)
        assert scene.repeats == (0 if number == 1 + places.index(place) else 1 + places.index(place))
    assert sum(len(scene.detections) for scene in once) > 5


def test_the_speed_is_that_of_a_stored_frame(film):
    settings = load_config(None, ["interval.rule=false"])  # the rule sees other steps in the first frames
    once, twice = (detect([film[k] for k in stored(len(film), [n])], settings) for n in (1, 2))
    for slow, fast in zip(twice[::2], once, strict=True):
        np.testing.assert_allclose(slow.detections.speed_px[2:], fast.detections.speed_px[2:] / 2)


@pytest.mark.parametrize("quality", [95, 80])
def test_repeats_that_were_coded_again_are_noticed_and_other_pictures_are_not(film, quality):
    rule, shots = RepeatRule(), [shot for image in film for shot in (image, coded_again(image, quality))]
    found = [rule.is_repeat(cv2.cvtColor(shot, cv2.COLOR_BGR2GRAY)) for shot in shots]
    assert found[2:] == [False, True] * (len(film) - 1)


def test_a_standing_camera_before_a_still_scene_repeats_nothing_though_its_pictures_differ_by_noise_alone():
    rng, rule = np.random.default_rng(0), RepeatRule()
    scene = rng.integers(40, 200, (120, 160)).astype(float)
    shots = [np.clip(scene + rng.normal(0, sigma, scene.shape), 0, 255).astype(np.uint8) for sigma in [1.5] * 20]
    assert not any(rule.is_repeat(shot) for shot in shots)


def test_a_slow_mover_before_a_standing_camera_is_seen_at_least_each_time_that_it_has_moved_by_a_pixel():
    rule, ground, kept = RepeatRule(), np.full((120, 160), 90, np.uint8), []
    for k in range(40):
        shot = ground.copy()
        shot[50:62, 20 + k // 4 : 32 + k // 4] = 130
        if not rule.is_repeat(shot):
            kept.append(k // 4)
    assert kept == list(range(10))


def test_a_clip_in_which_nothing_changes_has_a_reliable_scene_for_each_frame():
    image = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (*SIZE[::-1], 3)).astype(np.uint8), (0, 0), 2)
    scenes = detect([image] * 12, load_config("fast"))
    assert [scene.frame.number for scene in scenes] == list(range(1, 13))
    assert all(scene.reliable and not len(scene.detections) for scene in scenes)


def test_results_that_are_waited_for_do_not_wait_for_a_frozen_picture_to_change(film):
    detector, late = MotionDetector(load_config("fast")), []
    for number in range(1, 60):
        image = film[min(number, 8)]
        detector.update(Frame(number, number / 10, image, 0, number / 10))
        late.append(number - detector._returned.number)
    assert max(late) == max(late[-20:]) <= 12


def test_frames_that_are_lost_between_repeats_are_empty_scenes(film):
    numbers = [1, 2, 4, 5, 8, 9, 10, 11, 12, 13]
    source = Film([])
    source.frames = [Frame(number, number / 10, film[number // 2]) for number in numbers]
    scenes = list(detect_motion(source, load_config("fast")))
    assert [scene.frame.number for scene in scenes] == list(range(1, 14))
    assert [s.frame.number for s in scenes if s.cause == "the frame could not be read"] == [3, 6, 7]
    assert [s.frame.time_s for s in scenes] == pytest.approx(np.arange(1, 14) / 10)


@pytest.mark.parametrize("config", [None, "fast"])
@pytest.mark.parametrize("size", [(300, 240), (320, 200), (640, 480)])
def test_a_frame_of_another_size_is_refused_in_one_line(film, config, size):
    detector = MotionDetector(load_config(config))
    for image in film[:8]:
        detector.update(image)
    with pytest.raises(InputError, match=f"{size[0]}x{size[1]} follows frame 8 of 320x240"):
        detector.update(cv2.resize(film[8], size))
    assert len(detector.flush()) > 0  # what was taken before is not lost


@pytest.mark.slow
def test_scenes_do_not_depend_on_the_batch_where_pictures_repeat(film):
    images = [film[k] for k in stored(len(film), [2, 1])]
    one, eight = (detect(images, load_config(), batch) for batch in (1, 8))
    assert all(same(a, b) for a, b in zip(one, eight, strict=True))
