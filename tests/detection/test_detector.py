"""The detector on small films, good and bad."""

import weakref
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tests.overflight import Overflight, pictures
from tests.synthetic_clip import render
from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.detection import MotionDetector, detect_motion
from torchvision_dddas.detection.interval import look_ahead, settling_delay
from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Frame, Scene, Telemetry

SIZE = (240, 180)
CONFIGS = (None, "source", "fast")
RATE_HZ = 10.0


def frames_of(images: Sequence[np.ndarray]) -> list[Frame]:
    return [Frame(i + 1, i / RATE_HZ, image) for i, image in enumerate(images)]


def detect(frames: Sequence[Frame | np.ndarray], settings: Settings, batch: int = 1) -> list[Scene]:
    detector = MotionDetector(settings, backend="onboard", rate_hz=RATE_HZ, batch=batch)
    return [scene for frame in frames for scene in detector.update(frame)] + detector.flush()


def is_empty(scene: Scene) -> bool:
    return not scene.reliable and bool(scene.cause) and not scene.mask.any() and len(scene.detections) == 0


class Film:
    """A source of frames in memory."""

    rate_hz = RATE_HZ

    def __init__(self, images: Sequence[np.ndarray], count: int | None = None) -> None:
        self.frames, self.count, self.last = frames_of(images), count, 0

    def __iter__(self):
        return iter(self.frames)


def same(a: Scene, b: Scene) -> bool:
    return (
        np.array_equal(a.mask, b.mask)
        and np.array_equal(a.detections.box_px, b.detections.box_px)
        and np.array_equal(a.detections.speed_px, b.detections.speed_px, equal_nan=True)
        and (a.interval_frames, a.reliable, a.cause) == (b.interval_frames, b.reliable, b.cause)
    )


@pytest.fixture(scope="module")
def film():
    return render(seed=0, frames=16, size=SIZE)


@pytest.fixture(scope="module")
def noise() -> np.ndarray:
    """A big texture to pan over."""
    coarse = np.random.default_rng(5).integers(0, 256, (90, 120, 3)).astype(np.uint8)
    return cv2.resize(coarse, (480, 360), interpolation=cv2.INTER_CUBIC)


def pan(ground: np.ndarray, frames: int, size=SIZE, car: float | None = None) -> list[np.ndarray]:
    """A camera that pans by 2 px a frame over a picture; a painted car drives at `car` px a frame over the ground."""
    paint = cv2.resize(np.random.default_rng(9).integers(0, 2, (4, 7, 3)).astype(np.uint8) * 200 + 30, (72, 36))
    images = []
    for k in range(frames):
        picture = ground.copy()
        if car is not None:
            x = round(20 + car * k)
            picture[80 : 80 + 36, x : x + 72] = paint
        images.append(np.ascontiguousarray(picture[10 : 10 + size[1], 10 + 2 * k : 10 + 2 * k + size[0]]))
    return images


@pytest.mark.parametrize("config", CONFIGS)
def test_every_frame_has_one_scene_in_order_and_missing_frames_an_empty_one(config, film):
    frames = [frame for frame in frames_of(film.images) if frame.number not in (1, 6, 7)]
    found = detect(frames, load_config(config))
    assert [s.frame.number for s in found] == list(range(1, 17))
    for scene in found:
        missing = scene.frame.number in (1, 6, 7)
        assert is_empty(scene) == missing == (scene.cause == "the frame could not be read")
        assert scene.mask.shape == (SIZE[1], SIZE[0]) and scene.mask.dtype == np.uint16
        assert scene.mask.max() <= len(scene.detections)
        for i, (x, y, width, height) in enumerate(scene.detections.box_px):
            rows, columns = np.nonzero(scene.mask == i + 1)
            assert x <= columns.min() and columns.max() < x + width
            assert y <= rows.min() and rows.max() < y + height


@pytest.mark.parametrize("config", [*CONFIGS, "two_frames"])
@pytest.mark.parametrize("interval", [1, 3, 5])
@pytest.mark.parametrize("batch", [1, 4])
def test_a_scene_is_late_by_as_many_frames_as_the_detector_says(config, interval, batch, noise):
    settings = with_parameters(load_config(config), {"interval.rule": False, "interval.frames": interval})
    detector, delays = MotionDetector(settings, backend="onboard", batch=batch), []
    for image in pan(noise[:100, :140], 26, size=(64, 64)):
        delays += [detector._last.number - scene.frame.number for scene in detector.update(image)]
    assert max(delays[batch:]) == detector.delay_frames
    assert batch > 1 or set(delays[2:]) == {detector.delay_frames}


@pytest.mark.parametrize("config", CONFIGS)
def test_a_car_under_a_panning_camera_is_detected_with_its_heading_and_speed(config, noise):
    settings, hits = load_config(config), []
    for k, scene in enumerate(detect(frames_of(pan(noise, 14, car=5.0)), settings)):
        assert scene.reliable
        boxes = scene.detections
        left, top, width, height = boxes.box_px.T
        u, v = 20 + 5 * k - 10 - 2 * k + 36, 88
        on_car = (left <= u) & (u <= left + width) & (top <= v) & (v <= top + height)
        hits += list(zip(boxes.heading_rad[on_car], boxes.speed_px[on_car], strict=True))[:1]
    assert len(hits) >= 11
    headings, speeds = np.transpose(hits)
    if settings.history.on:
        assert abs(np.degrees(np.nanmedian(headings))) < 20
        assert np.nanmedian(speeds) == pytest.approx(5.0, rel=0.4)
    else:  # the quick chain has none, rather than a guess
        assert np.isnan(headings).all() and np.isnan(speeds).all()


@pytest.mark.parametrize("config", CONFIGS)
def test_the_batch_size_does_not_change_the_result(config, film):
    settings = load_config(config)
    one = detect(frames_of(film.images), settings)
    for batch in (3, 50):
        assert all(same(a, b) for a, b in zip(one, detect(frames_of(film.images), settings, batch), strict=True))


@pytest.mark.parametrize("config", CONFIGS)
def test_frames_more_than_two_intervals_ahead_do_not_change_a_scene(config, film):
    settings = load_config(config)
    whole = detect(frames_of(film.images), settings)
    for kept in (8, 11):
        blank = [np.zeros_like(film.images[0])] * (len(film.images) - kept)
        other = detect(frames_of([*film.images[:kept], *blank]), settings)
        for t, (a, b) in enumerate(zip(whole, other, strict=True)):
            if t + 2 * max(a.interval_frames, b.interval_frames) < kept:
                assert same(a, b), f"frame {t + 1} of {kept} kept"


@pytest.mark.parametrize("config", CONFIGS)
def test_each_side_of_a_cut_is_detected_on_its_own(config, noise):
    one, two = pan(noise, 8, car=5.0), pan(255 - noise[::-1, ::-1], 8, car=5.0)
    settings = load_config(config)
    found = detect(frames_of(one + two), settings)
    assert max((s.mask > 0).mean() for s in found) < 0.25
    assert [s.frame.number for s in found if not s.reliable] == [9]
    alone = detect(frames_of(one), settings)
    assert all(np.array_equal(a.mask, b.mask) for a, b in zip(found[:8], alone, strict=True))
    first_after, first_alone = found[8], detect(frames_of(two), settings)[0]
    assert np.array_equal(first_after.mask, first_alone.mask) and len(first_alone.detections)


@pytest.mark.parametrize(("config", "level"), [(None, 0), ("source", 128), ("fast", 255), ("fast", 0)])
def test_blank_frames_in_the_middle_are_unreliable_and_empty(config, level, noise):
    images = pan(noise, 15, car=5.0)
    images[6] = images[7] = np.full_like(images[6], level)
    found = detect(frames_of(images), load_config(config))
    assert is_empty(found[6]) and is_empty(found[7])
    assert all(s.reliable for s in found[:5] + found[9:])
    assert max((s.mask > 0).mean() for s in found) < 0.25


def flight(time_s, altitude_m=60.0) -> Telemetry:
    time = np.asarray(time_s, float)
    return Telemetry(time, np.broadcast_to(altitude_m, time.shape), np.full(time.shape, 5.0))


@pytest.mark.parametrize(("count", "from_s", "to_s"), [(16, 50.0, 60.0), (None, 50.0, 60.0), (16, -60.0, -50.0)])
def test_telemetry_of_another_time_is_refused_with_both_spans(count, from_s, to_s, film):
    scenes = detect_motion(Film(film.images, count), load_config("fast"), "onboard", flight([from_s, to_s]))
    with pytest.raises(InputError, match=f"{from_s} to {to_s} s, the clip 0.0 to 1.5 s"):
        list(scenes)


def test_the_interval_adapts_to_the_telemetry_and_the_change_is_recorded(film):
    changed = {"interval.frames": 3, "interval.minimum_frames": 3, "interval.maximum_frames": 6}
    altitude = np.where(np.arange(16) < 8, 60.0, 100.0)
    telemetry = flight(np.arange(16) / 10, altitude)
    scenes = list(detect_motion(Film(film.images), with_parameters(load_config(), changed), "onboard", telemetry))
    assert [s.interval_frames for s in scenes] == [3] * 8 + [5] * 8
    (moved,) = [a for s in scenes for a in s.adjustments if a.parameter == "interval.frames"]
    assert (moved.frame, moved.old, moved.new) == (9, 3, 5)
    assert "altitude 100.0 m" in moved.cause
    assert [a.frame for s in scenes for a in s.adjustments if a.parameter == "gates.max_size_px"] == [1, 9]


def test_an_interval_that_changes_for_dropped_frames_says_how_many_were_dropped(film):
    changed = {"interval.frames": 6, "interval.minimum_frames": 1, "interval.maximum_frames": 6}
    detector = MotionDetector(
        with_parameters(load_config(), changed), backend="onboard", telemetry=flight([0, 2], 100.0)
    )
    frames = [replace(frame, skipped=2 * (k > 0)) for k, frame in enumerate(frames_of(film.images))]
    scenes = [scene for frame in frames for scene in detector.update(frame)] + list(detector.flush())
    (cause, *_) = [a.cause for s in scenes for a in s.adjustments if a.parameter == "interval.frames" and a.frame > 1]
    assert "altitude 100.0 m" in cause and cause.endswith(", 2 frames before it dropped or skipped")


@pytest.mark.parametrize("config", [None, "fast", "half", "source", "two_frames"])
def test_the_interval_decides_what_is_found(config, film):
    found = []
    for frames in (1, 8):
        changed = {"interval.rule": False, "interval.frames": frames, "gates.min_area_px": 20}
        found.append(detect(frames_of(film.images), with_parameters(load_config(config), changed)))
    assert any(scene.mask.any() for scene in found[0]) and any(scene.mask.any() for scene in found[1])
    assert not all(np.array_equal(one.mask, other.mask) for one, other in zip(*found, strict=True))


@pytest.mark.parametrize(("cost", "interval"), [(1.0, 5), (2.0, 10), (0.0, 10)])
def test_looks_that_take_long_lengthen_the_interval_if_their_cost_is_measured(cost, interval, film, monkeypatch):
    """By a clock on which a look takes 0.2 s: two frames at the reference rate."""
    # The begin and the end of its six stages.
    readings = chain.from_iterable((second, second + 0.2 / 6) for second in range(1000))
    clock = SimpleNamespace(perf_counter=lambda: next(readings))
    monkeypatch.setattr("torchvision_dddas.detection.detector.time", clock)
    # The search for small targets compares frames as far apart as the interval allows: its change has an effect.
    changed = {"interval.cost": cost, "interval.maximum_frames": 20, "small.gap_frames": 10}
    settings = with_parameters(load_config(), changed)
    telemetry = flight(np.arange(64) / 10, 100.0)
    scenes = list(detect_motion(Film(film.images * 4), settings, "onboard", telemetry))
    assert scenes[-1].interval_frames == interval
    causes = [a.cause for s in scenes for a in s.adjustments if a.parameter == "interval.frames"]
    assert ("a look takes 200 ms" in causes[-1]) == (cost == 0)


@pytest.mark.slow
def test_slow_small_targets_seen_aslant_from_low_are_found_with_telemetry_as_without():
    """From 40 m at 45 degrees; by the altitude alone the search for them is off, and a fifth is found."""
    flown = Overflight(
        frames=30, size=(960, 540), focal_px=1000.0, height_m=40.0, heading_rad=0.1, pace=0.35, pitch_deg=45
    )
    images = list(pictures(flown))
    log = replace(flight(np.arange(31) / 10, 40.0), speed_m_s=np.full(31, 1.5))
    aslant = replace(log, pitch_rad=np.full(31, np.radians(45.0)))
    alone = load_config(None, ["tracklets.on=false"])  # tracklets find some of them in any case
    found = [
        sum(len(scene.detections) for scene in detect_motion(Film(images), alone, "onboard", telemetry))
        for telemetry in (None, aslant, log)
    ]
    assert found[1] > 0.9 * found[0] and found[2] < 0.5 * found[0]


def test_targets_outside_the_gates_of_the_altitude_are_left_out(noise):
    images = pan(noise, 12, car=5.0)
    base = {"gates.focal_px": 1000.0, "gates.min_size_m": 0.2, "gates.max_size_m": 25.0, "gates.max_speed_m_s": 60.0}

    def count(**parameters: float) -> int:
        settings = with_parameters(load_config("fast"), base | {f"gates.{k}": v for k, v in parameters.items()})
        scenes = detect_motion(Film(images), settings, "onboard", flight([0, 1.1], altitude_m=100.0))
        return sum(len(s.detections) for s in scenes)

    everything = count()
    assert everything >= 8
    assert count(max_size_m=5.0) < 0.4 * everything  # the car is 72 px: 7.2 m at 100 m
    assert count(min_size_m=20.0) == 0


@pytest.mark.parametrize("altitude_m", [0.0, -20.0, np.nan])
def test_an_altitude_that_is_none_above_ground_counts_for_nothing(altitude_m, film):
    settings = load_config("fast")
    wanted = list(detect_motion(Film(film.images), settings, "onboard"))
    found = list(detect_motion(Film(film.images), settings, "onboard", flight([0, 1.6], altitude_m)))
    assert [s.detections.box_px.tolist() for s in found] == [s.detections.box_px.tolist() for s in wanted]
    assert not [a for s in found for a in s.adjustments if a.parameter.startswith("gates.")]


@pytest.mark.parametrize(("hfov_deg", "set_px"), [(60.0, None), (60.0, 900.0), (60.0, 1000.0), (np.nan, None)])
def test_the_gates_take_the_focal_length_that_the_log_says_unless_one_is_set(hfov_deg, set_px, noise):
    images, log = pan(noise, 6, car=5.0), flight([0, 0.6], altitude_m=100.0)
    log = replace(log, hfov_rad=np.full(2, np.radians(hfov_deg)))
    settings = with_parameters(load_config("fast"), {} if set_px is None else {"gates.focal_px": set_px})
    scenes = list(detect_motion(Film(images), settings, "onboard", log))
    most_px = next(a.new for s in scenes for a in s.adjustments if a.parameter == "gates.max_size_px")
    by_log = set_px is None and np.isfinite(hfov_deg)
    focal_px = SIZE[0] / 2 / np.tan(np.radians(30.0)) if by_log else set_px or 1000.0
    assert most_px == pytest.approx(25.0 / 100.0 * focal_px)


@pytest.mark.parametrize("config", [None, "fast"])
def test_no_more_pictures_are_held_than_a_window_spans(config, film):
    settings = with_parameters(load_config(config), {"interval.rule": False})
    detector, pictures, held = MotionDetector(settings, backend="onboard", rate_hz=RATE_HZ), [], []
    for k in range(64):
        image = film.images[min(k % 32, 31 - k % 32)].copy()
        pictures.append(weakref.ref(image))
        detector.update(image)
        del image
        held.append(sum(picture() is not None for picture in pictures))
    frames = settings.interval.frames
    ahead = look_ahead(frames, settings) + settling_delay(frames, settings)
    assert max(held) == max(held[-10:]) <= settings.difference.wide_frames + ahead + 1


def test_images_frames_and_the_generator_give_the_same_scenes(film):
    settings = load_config("fast")
    wanted = detect(frames_of(film.images), settings)
    for found in (detect(film.images, settings), list(detect_motion(Film(film.images), settings, "onboard"))):
        assert [(s.frame.number, s.frame.time_s) for s in found] == [(s.frame.number, s.frame.time_s) for s in wanted]
        assert all(same(a, b) for a, b in zip(found, wanted, strict=True))


@pytest.mark.parametrize(
    ("image", "says"),
    [
        (np.zeros((4, 5, 3)), r"uint8 of shape \(H, W\) or \(H, W, 3\), got float64 of shape \(4, 5, 3\)"),
        (np.zeros((4, 5, 4), np.uint8), r"got uint8 of shape \(4, 5, 4\)"),
        (np.zeros((0, 5), np.uint8), r"got uint8 of shape \(0, 5\)"),
        ([[1, 2], [3, 4]], "a Frame or a NumPy image, got list"),
    ],
)
def test_anything_but_an_image_is_refused(image, says):
    with pytest.raises(InputError, match=says):
        MotionDetector(backend="onboard").update(image)


@pytest.mark.parametrize("config", CONFIGS)
def test_three_frames_are_enough_and_fewer_are_refused(config, noise):
    images = pan(noise, 3, car=5.0)
    assert [s.reliable for s in detect(images, load_config(config))] == [True] * 3
    for count, says in enumerate(("no frame", "1 frame ", "2 frames")):
        with pytest.raises(InputError, match=f"{says}.* needs at least 3"):
            detect(images[:count], load_config(config))
