"""Identities along a clip, a clip with a table, a table alone, and in the public class."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from torchvision_dddas.config import load_config
from torchvision_dddas.detection import load_engine
from torchvision_dddas.errors import InputError
from torchvision_dddas.tracking import Tracker, track_clip, track_scenes, track_table
from torchvision_dddas.tracking.score_tracker import ScoreTracker
from torchvision_dddas.tracking.source_tracker import SourceTracker
from torchvision_dddas.types import Adjustment, Detections, DetectionTable, Frame, Registration, Scene

SETTINGS = load_config()
SIZE = (320, 240)


def walkers(frames, lanes=(60, 140)):
    """(frame, box) rows: one walker a lane, who walks to the right; in odd frames the other way round."""
    rows = []
    for frame in frames:
        boxes = [(18 + 2.0 * frame, y, 12.0, 40.0) for y in lanes]
        rows += [(frame, box) for box in boxes[:: -1 if frame % 2 else 1]]
    return rows


def table_of(frames, boxes, score=1.0, own=False):
    n = len(frames)
    boxes = np.array(boxes, float).reshape(-1, 4)
    return DetectionTable("det.txt", np.array(frames, int), boxes, np.full(n, score), np.arange(n) + 1, own)


def walkers_table(count):
    return table_of(*zip(*walkers(range(1, count + 1)), strict=True))


class Clip:
    """Pictures of walkers before a textured wall; counts what it gave. lost: frames that cannot be read."""

    def __init__(self, count=40, lost=()):
        self.name, self.count, self.exact, self.rate_hz, self.size = "wall", count, True, 10.0, SIZE
        self.last, self.problems, self.lost, self.given = 0, [], lost, 0
        wall = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
        self.wall = cv2.resize(wall, SIZE, interpolation=cv2.INTER_CUBIC)

    def __iter__(self):
        return self.every(1)

    def every(self, interval):
        for number in range(1, self.count + 1):
            self.last = number
            if (number - 1) % interval or number in self.lost:
                continue
            image = self.wall.copy()
            for _, (x, y, w, h) in walkers([number]):
                image[int(y) : int(y + h), int(x) : int(x + w)] = (40, 40, 200) if y == 60 else (200, 60, 40)
            self.given += 1
            yield Frame(number, number / 10, image)


def assert_one_identity_a_lane(frames):
    for lane in (60, 140):
        assert len({int(i) for f in frames for i in f.tracks.identity[f.tracks.box_px[:, 1] == lane]}) == 1


@pytest.mark.parametrize("interval", [1, 3, 7])
def test_only_the_frames_of_the_interval_are_processed(interval):
    wanted, table, clip = list(range(1, 41, interval)), walkers_table(40), Clip()
    in_clip = list(track_clip(clip, table, load_engine("onboard", SETTINGS), SETTINGS, interval))
    for frames in (list(track_table(table, SETTINGS, interval)), in_clip):
        assert [f.number for f in frames if len(f.detections)] == wanted
        assert_one_identity_a_lane(frames)
    assert clip.given == len(wanted)


@pytest.mark.parametrize(("interval", "lost"), [(1, (1,)), (1, (7, 8, 9)), (4, (29, 30)), (4, tuple(range(1, 31)))])
def test_rows_on_unreadable_frames_or_after_the_end_of_the_clip_are_tracked(lost, interval):
    engine, numbers = load_engine("onboard", SETTINGS), list(range(1, 36, interval))
    frames = list(track_clip(Clip(30, lost), walkers_table(35), engine, SETTINGS, interval))
    assert [f.number for f in frames] == numbers
    assert [f.number for f in frames if f.frame is None] == [n for n in numbers if n in lost or n > 30]
    assert all((f.cause == "the frame could not be read") == (f.frame is None) for f in frames)
    assert_one_identity_a_lane(frames)


def scene_of(frame, detections, **more):
    return Scene(frame, np.zeros(SIZE[::-1], np.uint16), detections, 3, **more)


def test_steps_times_and_adjustments_of_the_frames_between_are_kept():
    step = np.array([[1, 0, -2.0], [0, 1, 0.5], [0, 0, 1]])
    scenes = []
    for n in range(1, 14):
        frame = Frame(n, n / 10, np.full((240, 320, 3), 90, np.uint8))
        known = None if n == 1 else Registration(step, 100, 90, 0.1, 3.0, n != 6)
        moved = (Adjustment(1, "interval.frames", 3, 4, "flow"),)
        scenes.append(scene_of(frame, Detections(), adjustments=moved, seconds={"foreground": 0.5}, step=known))
    frames = list(track_scenes(scenes, SETTINGS, 4, SIZE, pictures=False))
    assert [f.number for f in frames] == [1, 5, 9, 13]
    moves = [None if f.now_from_before is None else f.now_from_before[:2, 2].tolist() for f in frames]
    assert moves == [None, [-8, 2], [-6, 1.5], [-8, 2]]  # an unknown step counts as none
    assert [len(f.adjustments) for f in frames] == [1, 4, 4, 4]
    assert [f.seconds["foreground"] for f in frames] == [0.5, 2, 2, 2]
    assert all(f.frame and f.frame.image.strides == (0, 0, 0) for f in frames)  # no picture is held


def crowd_table(frames, score=1.0, people=4):
    """People who walk about, each visible in nine of ten of these frames, and now and then a false alarm."""
    random = np.random.default_rng(0)
    start, velocity = random.uniform(40, 200, (people, 2)), random.normal(0, 1, (people, 2))
    rows = []
    for k, frame in enumerate(frames):
        visible = np.flatnonzero(random.random(people) < 0.9)
        rows += [(frame, *(start[at] + velocity[at] * k + random.normal(0, 0.5, 2)), 12, 40) for at in visible]
        if random.random() < 0.1:
            rows.append((frame, *random.uniform(0, 300, 2), 12, 40))
    table = np.array(rows)
    return table_of(table[:, 0], table[:, 1:], score)


def found(tracks):
    """Frame -> (identity, box, row) of those that have any."""
    rows = {t.frame: (t.identity.tolist(), t.box_px.tolist(), t.row.tolist()) for t in tracks if len(t)}
    return {frame: list(zip(*columns, strict=True)) for frame, columns in rows.items()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("interval", "mode", "score", "memory", "hits"),
    [(1, "default", 1.0, 1, 1), (4, "default", 0.97, 9, 3), (1, "default", 0.97, 20, 6), (4, "paper", 1.0, 9, 3)],
)
def test_skipping_a_long_stretch_without_rows_changes_no_track(interval, mode, score, memory, hits):
    parameters = {"memory_frames": memory, "hits": hits, "mode": mode, "look_ahead": "true" if hits > 1 else "false"}
    settings = load_config(overrides=[f"track.{name}={value}" for name, value in parameters.items()])
    table = crowd_table([*range(1, 60), *range(200, 260), *range(262, 280), *range(400, 440)], score)
    tracker = (SourceTracker if mode == "paper" else ScoreTracker)(settings, interval, table.extent)
    numbers = range(1, table.last + 1, interval)
    whole = [t for n in numbers for t in tracker.feed(n, table.at(n))] + tracker.end()
    frames = list(track_table(table, settings, interval))
    assert found(f.tracks for f in frames) == found(whole)
    fed = [f.number for f in frames]
    rows = {n for n in table.frame.tolist() if (n - 1) % interval == 0}
    assert rows <= set(fed) <= set(numbers) and fed == sorted(set(fed))
    # Of two stretches, of 140 and 120 frames, little more than the memory is processed.
    assert len(numbers) - len(fed) >= (260 - 2 * (memory + (hits + 5) * interval)) // interval > 20


def own_detections(frames=40):
    """Targets of faint contrast: the whole, the trunk or the legs alone, or the shadow as well."""
    shown = np.array([(0, 0, 1, 1), (0, 0, 1, 0.65), (0, 0.35, 1, 0.65), (0, 0, 2, 1)])
    numbers = np.repeat(np.arange(frames) + 1, 2)
    whole = np.array([[18 + 2 * n, y, 12, 40] for n, y in zip(numbers, [60, 140.0] * frames, strict=True)])
    parts = shown[np.random.default_rng(0).integers(0, 4, 2 * frames)]
    boxes = np.concatenate([whole[:, :2] + parts[:, :2] * whole[:, 2:], parts[:, 2:] * whole[:, 2:]], axis=1)
    return table_of(numbers, boxes, 0.55, own=True)


def test_a_table_of_own_detections_is_tracked_like_the_detections_with_and_without_the_clip():
    table = own_detections()
    blank = [Frame(n, n / 10, np.full((240, 320, 3), 90, np.uint8)) for n in range(1, 41)]
    here = [table.at(frame.number) for frame in blank]
    scenes = [scene_of(f, Detections(h.box_px, h.score)) for f, h in zip(blank, here, strict=True)]
    wanted = found(f.tracks for f in track_scenes(scenes, SETTINGS, 1, SIZE))
    clip: Any = SimpleNamespace(size=SIZE, last=40, every=lambda interval: iter(blank))
    assert found(f.tracks for f in track_clip(clip, table, load_engine("onboard", SETTINGS), SETTINGS, 1)) == wanted
    alone = list(track_table(table, SETTINGS, 1))
    assert all(sorted(f.tracks.identity.tolist()) == [1, 2] for f in alone)
    assert all(f.tracks.score.tolist() == [0.55, 0.55] for f in alone)


@pytest.mark.parametrize("score", [0.8, 0.3, 0.0])
def test_detections_that_all_have_the_same_score_get_identities_whatever_it_is(score):
    table = replace(walkers_table(30), score=np.full(60, score))
    frames = list(track_table(table, SETTINGS, 1))
    assert_one_identity_a_lane(frames)
    assert all(sorted(f.tracks.identity.tolist()) == [1, 2] and set(f.tracks.score) == {score} for f in frames)


def test_the_public_tracker_equals_the_tracks_of_the_same_table():
    table = walkers_table(30)
    tracker, tracks = Tracker(size=table.extent), []
    for number in range(1, 31):
        boxes = np.array([box for _, box in walkers([number])])
        tracks += tracker.update((boxes, np.ones(len(boxes))))
    assert found(tracks + tracker.flush()) == found(f.tracks for f in track_table(table, SETTINGS, 1))


@pytest.mark.parametrize("mode", ["default", "paper"])
def test_both_modes_track_a_walker_in_pictures_and_settle_every_frame_once(mode):
    tracker, tracks = Tracker(load_config(overrides=[f"track.mode={mode}"]), interval=2, size=SIZE), []
    for frame in Clip(11).every(2):
        boxes = np.array([box for _, box in walkers([frame.number], lanes=(60,))])
        tracks += tracker.update(boxes, np.eye(3), image=frame.image, frame=frame.number)
    tracks += tracker.flush()
    assert [t.frame for t in tracks] == [1, 3, 5, 7, 9, 11]
    assert {int(i) for t in tracks for i in t.identity} == {1}


@pytest.mark.parametrize(("mode", "knob"), [("default", "appearance.looked"), ("paper", "paper.weight")])
def test_every_change_of_whether_appearance_is_looked_at_is_an_adjustment_with_its_cause(mode, knob):
    """Two walkers meet: apart, no link is in doubt and locations are dispersed."""
    settings = load_config(overrides=[f"track.mode={mode}"])
    scenes = []
    for frame in Clip(30):
        x = abs(frame.number - 15) * 8.0
        boxes, unknown = (
            np.array([(20, 20, 12, 40), (160 - x, 140, 12, 40), (164 + x, 141, 12, 40.0)]),
            np.full(3, np.nan),
        )
        given = Detections(boxes, np.ones(3), np.full(3, 480.0), unknown, unknown)
        scenes.append(scene_of(frame, given))
    frames = list(track_scenes(scenes, settings, 1, SIZE))
    uses = {f.number: f.tracks.appearance for f in frames if f.tracks.appearance is not None}
    assert set(uses) == set(range(2, 31))
    looked = [number for number, use in uses.items() if use.looked]
    assert 15 in looked and 30 not in looked and all(use.cause for use in uses.values())
    moved = [a for f in frames for a in f.adjustments]
    assert {a.parameter for a in moved} == {knob}
    value = {"default": lambda use: float(use.looked), "paper": lambda use: use.weight}[mode]
    now, told = {"default": 0.0, "paper": 1.0}[mode], {a.frame: a for a in moved}
    for number, use in uses.items():  # the changes tell the state at each frame
        if number in told:
            assert (told[number].old, told[number].cause) == (now, use.cause) and told[number].new != now
            now = told[number].new
        assert value(use) == now


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"detections": np.zeros((2, 3))}, r"boxes must be \(N, 4\)"),
        ({"detections": (np.ones((2, 4)), np.ones(3))}, r"one score for each box, \(2,\); got \(3,\)"),
        ({"detections": np.full((1, 4), np.nan)}, "finite"),
        ({"detections": np.array([[0, 0, 0, 5.0]])}, "above 0 px, got 0 x 5 in box 0"),
        ({"detections": "boxes"}, "Detections record"),
        ({"detections": walkers_table(4)}, r"DetectionTable of 8 rows; .* give table.at\(n\) for frame n"),
        ({"detections": np.ones((1, 4)), "camera_motion": np.eye(2)}, r"\(3, 3\) homography"),
        ({"detections": np.ones((1, 4)), "image": np.zeros((4, 4))}, "image must be uint8"),
        ({"detections": np.ones((1, 4)), "frame": 3}, "frame 3 follows frame 3"),
    ],
)
def test_bad_input_of_the_public_tracker_is_refused(given, message):
    tracker = Tracker()
    tracker.update(np.zeros((0, 4)), frame=3)
    with pytest.raises(InputError, match=message):
        tracker.update(**given)
    with pytest.raises(InputError, match="interval must"):
        Tracker(interval=0)
    with pytest.raises(InputError, match="size must"):
        Tracker(size=(3, -1))


def test_without_pictures_the_identities_are_the_same_and_no_picture_is_held():
    scenes = []
    for number in range(1, 13):
        frame = Frame(number, number / 10, np.full((*SIZE[::-1], 3), 90, np.uint8))
        boxes, unknown = np.array([box for _, box in walkers([number])]), np.full(2, np.nan)
        scenes.append(scene_of(frame, Detections(boxes, np.full(2, 0.55), np.full(2, 480.0), unknown, unknown)))
    tracked = [list(track_scenes(iter(scenes), SETTINGS, 1, SIZE, pictures=kept)) for kept in (True, False)]
    for with_picture, without in zip(*tracked, strict=True):
        assert with_picture.frame.image.any()
        assert without.frame.image.shape == with_picture.frame.image.shape
        assert without.frame.image.strides == (0, 0, 0) and without.frame.number == with_picture.frame.number
        np.testing.assert_array_equal(without.tracks.identity, with_picture.tracks.identity)
        np.testing.assert_array_equal(without.tracks.box_px, with_picture.tracks.box_px)
    assert any(len(f.tracks) for f in tracked[1])


def test_classes_stay_with_their_identities_also_where_a_detection_is_missing():
    tracker, settled = Tracker(size=(640, 480)), []
    for k in range(12):
        box = np.array([[50.0 + 4 * k, 60, 30, 60], [400 - 5 * k, 200, 60, 30]])[: 1 if k in (5, 6) else 2]
        classes: Any = {"label": np.array(["person", "car"], object), "class_id": np.array([0, 2])}
        rows = {name: values[: len(box)] for name, values in classes.items()}
        settled += tracker.update(Detections(box, np.full(len(box), 0.9), kind="given", **rows), frame=k + 1)
    settled += tracker.flush()
    assert any((tracks.row < 0).any() for tracks in settled)
    for tracks in settled:
        for identity, label, number in zip(tracks.identity, tracks.label, tracks.class_id, strict=True):
            assert (label, number) == (("person", 0), ("car", 2))[identity - 1]


@pytest.mark.parametrize(
    ("boxes", "scores", "words"),
    [
        ([[0.2, 0.3, 0.1, 0.2]], [0.9], "multiply them by its width and height"),
        ([[10, 20, 30, 40]], [87.0], "divide percent by 100, or take Tracker"),
        ([[500, 300, 560, 420]], [0.9], "look like xyxy; wanted x, y, width, height"),
        ([[10 * k, 20 + 7 * k, 10 * k + 31, 71 + 7 * k] for k in range(1, 6)], [0.9] * 5, "look like xyxy"),
    ],
)
def test_arrays_of_boxes_that_would_be_misread_are_refused(boxes, scores, words):
    with pytest.raises(InputError, match=words):
        Tracker(size=(640, 480)).update((np.array(boxes, float), np.array(scores)))


# Time stamps, repeated pictures, damaged pictures.


def car_at(time_s, speed=60.0):
    """The box of a car, 60 px a second."""
    return np.array([[20.0 + speed * time_s, 100.0, 30.0, 20.0]])


@pytest.mark.parametrize("gap_s", [0.0, 1.0, 3.0])
def test_targets_are_predicted_over_the_true_time_between_two_frames(gap_s):
    """Frames 21 and on come later than their numbers say. Beside the car another one waits where the car was."""
    times = np.arange(40) / 20 + gap_s * (np.arange(40) >= 20)
    tracker, found = Tracker(motion=True, rate_hz=20.0, size=(1000, 400)), []
    for number, time_s in enumerate(times, 1):
        boxes = car_at(time_s)
        if number > 20:
            boxes = np.concatenate([boxes, car_at(times[19] + 1 / 20) + np.array([0, 30, 0, 0])])
        found += tracker.update(boxes, frame=number, time_s=time_s)
    found += tracker.flush()
    car = [tracks.identity[tracks.row == 0].tolist() for tracks in found]
    assert car == [[1]] * 40


def test_time_stamps_that_are_rounded_change_nothing():
    rows = [walkers([number]) for number in range(1, 40)]
    for places in (9, 3):
        tracker, found = Tracker(motion=True, rate_hz=30.0), []
        for number, given in enumerate(rows, 1):
            boxes = np.array([box for _, box in given])
            found += tracker.update(boxes, frame=number, time_s=round((number - 1) / 30, places))
        found += tracker.flush()
        if places == 9:
            kept = found
    plain = Tracker(motion=True)
    bare = [t for given in rows for t in plain.update(np.array([box for _, box in given]))] + plain.flush()
    for one, other, third in zip(kept, found, bare, strict=True):
        assert one.identity.tolist() == other.identity.tolist() == third.identity.tolist()
        assert np.array_equal(one.box_px, other.box_px) and np.array_equal(one.box_px, third.box_px)


def scenes_of(numbers, repeats=None, damaged=()):
    """Scenes of a walker. repeats: number of a frame -> the one that it repeats."""
    still = Registration(np.eye(3), 9, 9, 0.1, 0.0)
    for number in numbers:
        shown = (repeats or {}).get(number, number)
        boxes = np.array([box for _, box in walkers([shown])])
        unknown = np.full(len(boxes), np.nan)
        found = Detections(boxes, np.ones(len(boxes)), unknown, unknown, unknown)
        frame = Frame(number, number / 10, np.zeros((240, 320), np.uint8), damaged=number in damaged)
        yield Scene(frame, np.zeros((0, 0), np.uint16), found, 1, step=still, repeats=0 if shown == number else shown)


@pytest.mark.parametrize("mode", ["scores", "paper"])
@pytest.mark.parametrize("interval", [1, 2, 3])
def test_a_frame_that_repeats_another_has_its_tracks(mode, interval):
    settings = load_config("paper" if mode == "paper" else None)
    repeats = {number: number - 1 for number in range(2, 41, 2)}
    frames = list(track_scenes(scenes_of(range(1, 41), repeats), settings, interval, SIZE))
    assert [frame.number for frame in frames] == list(range(1, 41, interval))
    assert [frame.tracks.frame for frame in frames] == [frame.number for frame in frames]
    for before, frame in pairwise(frames):
        if frame.repeats == before.number:
            assert np.array_equal(frame.tracks.box_px, before.tracks.box_px)
            assert frame.tracks.identity.tolist() == before.tracks.identity.tolist()
    assert {n for frame in frames for n in frame.tracks.identity.tolist()} == {1, 2}


def test_damage_that_looks_like_targets_for_a_few_frames_begins_no_identities():
    rng = np.random.default_rng(0)
    for damaged, most in ((True, 0), (False, 40)):
        tracker, found = Tracker(motion=True, size=(640, 480)), []
        for number in range(1, 80):
            boxes = car_at(number / 20)
            if number % 5 < 3 and number > 10:  # what lasts for three frames
                blocks = np.random.default_rng(number // 5).uniform(0, 440, (4, 2))
                boxes = np.concatenate([boxes, np.c_[blocks + rng.normal(0, 1, (4, 2)), np.full((4, 2), 24.0)]])
            found += tracker.update(boxes, frame=number, damaged=damaged and number > 10)
        found += tracker.flush()
        identities = {n for tracks in found for n in tracks.identity.tolist()}
        assert 1 in identities and (len(identities) == 1 if damaged else len(identities) > most)


@pytest.mark.parametrize(
    ("interval", "lasts", "is_tracked"), [(1, 2, False), (1, 3, True), (2, 2, False), (3, 3, True)]
)
def test_own_detections_confirm_a_track_after_as_many_frames_as_hits(interval, lasts, is_tracked):
    tracker, found = Tracker(motion=True, interval=interval, size=(640, 480)), []
    for number in range(1, 40, interval):
        there = 10 <= number < 10 + lasts
        found += tracker.update(car_at(0.5) if there else np.zeros((0, 4)), frame=number)
    assert any(len(tracks) for tracks in found + tracker.flush()) == is_tracked


def test_a_part_beside_the_part_that_continues_a_track_begins_none():
    tracker, found = Tracker(motion=True, size=(640, 480)), []
    for number in range(1, 60):
        x, y, width, height = np.array([100 + 3 * number, 200, 90, 40])
        is_split = number > 6 and number % 4 == 3
        parts = [[x, y, 25, height], [x + 60, y, 30, height]] if is_split else [[x, y, width, height]]
        found += tracker.update(np.array(parts, float), frame=number)
    assert {n for tracks in found + tracker.flush() for n in tracks.identity.tolist()} == {1}


def test_a_target_that_comes_in_a_damaged_stretch_gets_its_identity_after_five_looks():
    tracker, found = Tracker(motion=True), []
    for number in range(1, 30):
        boxes = np.zeros((0, 4)) if number < 10 else car_at(number / 20)
        found += tracker.update(boxes, frame=number, damaged=True)
    found += tracker.flush()
    assert [len(tracks) for tracks in found][13:] == [1] * 16
