"""Identities along a clip, a clip with a table, a table alone, and through the public class."""

from dataclasses import replace
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
"""Of the clip that is made here; a walker in it is 12 by 40."""


def walkers(frames, lanes=(60, 140), speed=2.0):
    """(frame, box) rows: one walker a lane, who walks to the right; in odd frames the other way round."""
    rows = []
    for frame in frames:
        boxes = [(20 + speed * (frame - 1), y, 12.0, 40.0) for y in lanes]
        rows += [(frame, box) for box in boxes[:: -1 if frame % 2 else 1]]
    return rows


def table_of(rows, score=1.0):
    frames = np.array([frame for frame, _ in rows], int)
    boxes = np.array([box for _, box in rows], float).reshape(-1, 4)
    return DetectionTable("det.txt", frames, boxes, np.full(len(rows), score), np.arange(len(rows)) + 1)


class Clip:
    """Pictures of walkers before a textured wall; counts what it has given. lost: frames that cannot be read."""

    def __init__(self, count=40, lost=(), shake=0.0):
        self.name, self.count, self.exact, self.rate_hz, self.size = "wall", count, True, 10.0, SIZE
        self.last, self.problems, self.lost, self.given, self.shake = 0, [], lost, 0, shake
        wall = np.random.default_rng(0).integers(0, 255, (35, 50, 3), np.uint8)
        self.wall = cv2.resize(wall, (500, 350), interpolation=cv2.INTER_CUBIC)

    def __iter__(self):
        return self.every(1)

    def every(self, interval):
        for number in range(1, self.count + 1):
            self.last = number
            if (number - 1) % interval or number in self.lost:
                continue
            left = round(40 + self.shake * number)
            image = self.wall[50:290, left : left + 320].copy()
            for _, (x, y, w, h) in walkers([number]):
                image[int(y) : int(y + h), int(x) : int(x + w)] = (40, 40, 200) if y == 60 else (200, 60, 40)
            self.given += 1
            yield Frame(number, number / 10, image)


def all_of(followed):
    """What a run came to: frame -> {box: identity}."""
    return {
        f.number: dict(zip(map(tuple, f.tracks.box_px.tolist()), f.tracks.identity.tolist(), strict=True))
        for f in followed
    }


def identities(followed, lane):
    return {i for found in all_of(followed).values() for box, i in found.items() if box[1] == lane}


@pytest.mark.parametrize("interval", [1, 3, 7])
def test_only_the_frames_of_the_interval_are_looked_at(interval):
    wanted = list(range(1, 41, interval))
    table = table_of(walkers(range(1, 41)))
    clip = Clip()
    in_clip = track_clip(clip, table, load_engine("onboard", SETTINGS), SETTINGS, interval)
    for followed in (list(track_table(table, SETTINGS, interval)), list(in_clip)):
        assert [f.number for f in followed if len(f.detections)] == wanted
        assert len(identities(followed, 60)) == len(identities(followed, 140)) == 1
    assert clip.given == len(wanted)


@pytest.mark.parametrize("lost", [(1,), (2, 3), (7, 8, 9), (29, 30), tuple(range(1, 31))])
@pytest.mark.parametrize("interval", [1, 4])
def test_rows_on_frames_that_cannot_be_read_or_lie_after_the_end_are_tracked_all_the_same(lost, interval):
    table = table_of(walkers(range(1, 36)))
    clip = Clip(30, lost)
    followed = list(track_clip(clip, table, load_engine("onboard", SETTINGS), SETTINGS, interval))
    assert [f.number for f in followed] == list(range(1, 36, interval))
    blind = [f.number for f in followed if f.frame is None]
    assert blind == [n for n in range(1, 36, interval) if n in lost or n > 30]
    assert all((f.cause == "the frame could not be read") == (f.frame is None) for f in followed)
    assert len(identities(followed, 60)) == len(identities(followed, 140)) == 1


def scenes_of(count, step=None, adjustments=None, bad=()):
    for number in range(1, count + 1):
        boxes = np.array([box for _, box in walkers([number])])
        n = len(boxes)
        found = Detections(boxes, np.full(n, 0.55), np.full(n, 480.0), np.full(n, np.nan), np.full(n, np.nan))
        frame = Frame(number, number / 10, np.full((240, 320, 3), 90, np.uint8))
        registration = step and Registration(step, 100, 90, 0.1, 3.0, number not in bad)
        yield Scene(
            *(frame, np.zeros((240, 320), np.uint16), found, 3),
            adjustments=adjustments or (),
            seconds={"foreground": 0.5},
            step=None if number == 1 else registration,
        )


def test_steps_times_and_adjustments_between_the_frames_looked_at_are_kept():
    class Step(np.ndarray):
        __bool__ = lambda self: True  # noqa: E731

    step = np.array([[1, 0, -2.0], [0, 1, 0.5], [0, 0, 1]]).view(Step)
    moved = Adjustment(1, "interval.frames", 3, 4, "flow")
    followed = list(track_scenes(scenes_of(13, step, (moved,), bad=(6,)), SETTINGS, 4, SIZE))
    assert [f.number for f in followed] == [1, 5, 9, 13]
    moves = [None if f.now_from_before is None else f.now_from_before[:2, 2].tolist() for f in followed]
    assert moves == [None, [-8, 2], [-6, 1.5], [-8, 2]]  # the step that is not known counts as none
    assert [len(f.adjustments) for f in followed] == [1, 4, 4, 4]
    assert [f.seconds["foreground"] for f in followed] == [0.5, 2, 2, 2]


def crowd_table(frames, seed=0, score=1.0, people=4):
    """People who walk about, each seen in nine of ten of these frames, and now and then a false alarm."""
    random = np.random.default_rng(seed)
    start, velocity = random.uniform(40, 200, (people, 2)), random.normal(0, 1, (people, 2))
    rows = []
    for k, frame in enumerate(frames):
        seen = np.flatnonzero(random.random(people) < 0.9)
        rows += [(frame, *(start[at] + velocity[at] * k + random.normal(0, 0.5, 2)), 12, 40) for at in seen]
        if random.random() < 0.1:
            rows.append((frame, *random.uniform(0, 300, 2), 12, 40))
    table = np.array(rows)
    n = len(table)
    return DetectionTable("det.txt", table[:, 0].astype(int), table[:, 1:], np.full(n, score), np.arange(n) + 1)


def found(tracks):
    """Frame -> (identity, box, row) of those that have any."""
    return {
        t.frame: list(zip(t.identity.tolist(), map(tuple, t.box_px.tolist()), t.row.tolist(), strict=True))
        for t in tracks
        if len(t)
    }


@pytest.mark.parametrize(
    ("interval", "mode", "score", "memory", "hits"),
    [(1, "default", 1.0, 1, 1), (4, "default", 0.97, 9, 3), (1, "default", 0.97, 20, 6), (4, "paper", 1.0, 9, 3)],
)
def test_a_long_stretch_without_rows_is_left_out_and_changes_no_track(interval, mode, score, memory, hits):
    parameters = {"memory_frames": memory, "hits": hits, "mode": mode, "look_ahead": "true" if hits > 1 else "false"}
    settings = load_config(overrides=[f"track.{name}={value}" for name, value in parameters.items()])
    table = crowd_table(
        [*range(1, 60), *range(200, 260), *range(262, 280), *range(400, 440), *range(450, 460)], score=score
    )
    tracker = (SourceTracker if mode == "paper" else ScoreTracker)(settings, interval, table.extent)
    numbers = range(1, table.last + 1, interval)
    whole = [t for n in numbers for t in tracker.feed(n, table.at(n))] + tracker.end()
    followed = list(track_table(table, settings, interval))
    assert found(f.tracks for f in followed) == found(whole)
    fed = [f.number for f in followed]
    rows = sorted({n for n in table.frame.tolist() if (n - 1) % interval == 0})
    assert set(rows) <= set(fed) <= set(numbers) and fed == sorted(set(fed))
    assert {n - interval for n in rows[1:]} <= set(fed)
    assert {n for n in numbers if 0 < n - max((r for r in rows if r <= n), default=n) <= memory} <= set(fed)
    # Two stretches, of 140 and 120 frames, of which little more than the memory is looked at.
    assert len(numbers) - len(fed) >= (260 - 2 * (memory + (hits + 5) * interval)) // interval > 20


def own(frames=40):
    """Targets of faint contrast of whom now all is seen, now the trunk or the legs alone, now the shadow as well."""
    random, shown = np.random.default_rng(0), [(0, 0, 1, 1), (0, 0, 1, 0.65), (0, 0.35, 1, 0.65), (0, 0, 2, 1)]
    boxes = []
    for n in range(frames):
        whole = np.array([[20 + 2 * n, 60, 12, 40], [20 + 2 * n, 140, 12, 40.0]])
        parts = np.array([shown[k] for k in random.integers(0, 4, 2)])
        boxes.append(np.concatenate([whole[:, :2] + parts[:, :2] * whole[:, 2:], parts[:, 2:] * whole[:, 2:]], axis=1))
    n = 2 * frames
    return DetectionTable(
        *("detections.csv", np.repeat(np.arange(frames) + 1, 2), np.concatenate(boxes), np.full(n, 0.55)),
        *(np.arange(n) + 2, True),
    )


def test_the_table_of_a_clip_s_own_detections_is_followed_as_these_are_with_and_without_the_clip():
    table = own()
    scenes, blank = [], [Frame(n, n / 10, np.full((240, 320, 3), 90, np.uint8)) for n in range(1, 41)]
    for frame in blank:
        here = table.at(frame.number)
        detections = Detections(here.box_px, here.score, here.area_px, here.heading_rad, here.speed_px)
        scenes.append(Scene(frame, np.zeros((240, 320), np.uint16), detections, 3))
    wanted = found(f.tracks for f in track_scenes(scenes, SETTINGS, 1, SIZE))
    engine = load_engine("onboard", SETTINGS)
    clip: Any = SimpleNamespace(size=SIZE, last=40, every=lambda interval: iter(blank))
    assert found(f.tracks for f in track_clip(clip, table, engine, SETTINGS, 1)) == wanted
    alone = list(track_table(table, SETTINGS, 1))
    assert all(sorted(f.tracks.identity.tolist()) == [1, 2] for f in alone)
    assert all(f.tracks.score.tolist() == [0.55, 0.55] for f in alone)
    assert not found(f.tracks for f in track_table(replace(table, own=False), SETTINGS, 1))


def test_the_public_tracker_gives_boxes_and_scores_the_identities_of_the_same_table():
    rows = walkers(range(1, 31))
    wanted = [f.tracks for f in track_table(table_of(rows), SETTINGS, 1)]
    tracker = Tracker(size=table_of(rows).extent)
    found = []
    for number in range(1, 31):
        boxes = np.array([box for frame, box in rows if frame == number])
        found += tracker.update((boxes, np.ones(len(boxes))))
    found += tracker.flush()
    assert [(t.frame, t.identity.tolist()) for t in found] == [(t.frame, t.identity.tolist()) for t in wanted]
    assert all(np.array_equal(one.box_px, other.box_px) for one, other in zip(found, wanted, strict=True))


@pytest.mark.parametrize("mode", ["default", "paper"])
def test_both_modes_follow_a_walker_with_pictures_and_settle_every_frame_once(mode):
    settings = load_config(overrides=[f"track.mode={mode}"])
    tracker, found = Tracker(settings, interval=2, size=SIZE), []
    for frame in Clip(11).every(2):
        boxes = np.array([box for _, box in walkers([frame.number], lanes=(60,))])
        found += tracker.update(boxes, np.eye(3), frame.image, frame.number)
    found += tracker.flush()
    assert [t.frame for t in found] == [1, 3, 5, 7, 9, 11]
    assert {int(i) for t in found for i in t.identity} == {1}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"detections": np.zeros((2, 3))}, r"boxes must be \(N, 4\)"),
        ({"detections": (np.ones((2, 4)), np.ones(3))}, r"one a box, \(2,\); got \(3,\)"),
        ({"detections": np.full((1, 4), np.nan)}, "finite"),
        ({"detections": np.array([[0, 0, 0, 5.0]])}, "above 0 px, got 0 x 5 in box 0"),
        ({"detections": "boxes"}, "Detections record"),
        ({"detections": np.ones((1, 4)), "camera_motion": np.eye(2)}, r"\(3, 3\) homography"),
        ({"detections": np.ones((1, 4)), "image": np.zeros((4, 4))}, "uint8, got"),
        ({"detections": np.ones((1, 4)), "frame": 3}, "frame 3 follows frame 3"),
    ],
)
def test_bad_input_of_the_public_tracker_is_refused_in_one_line(given, message):
    tracker = Tracker()
    tracker.update(np.zeros((0, 4)), frame=3)
    with pytest.raises(InputError, match=message):
        tracker.update(**given)
    with pytest.raises(InputError, match="interval must"):
        Tracker(interval=0)
    with pytest.raises(InputError, match="size must"):
        Tracker(size=(3, -1))


def test_without_pictures_the_identities_are_the_same_and_no_picture_is_held():
    followed = [list(track_scenes(scenes_of(12), SETTINGS, 1, SIZE, pictures=kept)) for kept in (True, False)]
    for with_picture, without in zip(*followed, strict=True):
        assert with_picture.frame.image.any()
        assert without.frame.image.shape == with_picture.frame.image.shape
        assert without.frame.image.strides == (0, 0, 0) and without.frame.number == with_picture.frame.number
        np.testing.assert_array_equal(without.tracks.identity, with_picture.tracks.identity)
        np.testing.assert_array_equal(without.tracks.box_px, with_picture.tracks.box_px)
    assert any(len(f.tracks) for f in followed[1])
