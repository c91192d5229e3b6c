"""Identities along a clip, a clip with a table, and a table alone."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from tests.synthetic_clip import LEAST_PX, render
from torchvision_dddas.config import load_config
from torchvision_dddas.detection import detect_motion, load_engine
from torchvision_dddas.tracking.sequence import follow_clip, follow_scenes, follow_table
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


def test_a_table_alone_gives_each_walker_one_identity_and_keeps_every_row():
    rows = walkers(range(1, 31))
    followed = list(follow_table(table_of(rows), SETTINGS, 1))
    assert [f.number for f in followed] == list(range(1, 31))
    assert len(identities(followed, 60)) == len(identities(followed, 140)) == 1
    assert identities(followed, 60) != identities(followed, 140)
    assert [(f.number, tuple(box)) for f in followed for box in f.detections.box_px] == rows
    assert [line for f in followed for line in f.lines] == list(range(1, 61))


@pytest.mark.parametrize("interval", [1, 3, 7])
def test_only_the_frames_of_the_interval_are_looked_at(interval):
    wanted = list(range(1, 41, interval))
    table = table_of(walkers(range(1, 41)))
    clip = Clip()
    for followed in (
        list(follow_table(table, SETTINGS, interval)),
        list(follow_clip(clip, table, load_engine("onboard", SETTINGS), SETTINGS, interval)),
    ):
        assert [f.number for f in followed if len(f.detections)] == wanted
        assert len(identities(followed, 60)) == len(identities(followed, 140)) == 1
    assert clip.given == len(wanted)


def test_frames_without_rows_are_gone_through_as_empty_ones():
    """The first row is on frame 4, none is on 9 to 11: with interval 2 that is 5, 7, (9), (11), 13, ..."""
    rows = walkers([4, *range(5, 9), *range(12, 25)])
    followed = list(follow_table(table_of(rows), SETTINGS, 2))
    assert [f.number for f in followed] == list(range(5, 25, 2))
    assert [f.number for f in followed if len(f.detections) == 0] == [9, 11]
    assert len(identities(followed, 60)) == 1


def test_a_clip_goes_on_before_and_after_its_table():
    table = table_of(walkers(range(10, 20)))
    followed = list(follow_clip(Clip(30), table, load_engine("onboard", SETTINGS), SETTINGS, 1))
    assert [f.number for f in followed] == list(range(1, 31))
    assert all(f.frame is not None and f.frame.number == f.number for f in followed)
    assert sum(len(f.detections) for f in followed) == len(table)


@pytest.mark.parametrize("lost", [(1,), (2, 3), (7, 8, 9), (29, 30), tuple(range(1, 31))])
@pytest.mark.parametrize("interval", [1, 4])
def test_rows_on_frames_that_cannot_be_read_or_lie_after_the_end_are_tracked_all_the_same(lost, interval):
    table = table_of(walkers(range(1, 36)))
    clip = Clip(30, lost)
    followed = list(follow_clip(clip, table, load_engine("onboard", SETTINGS), SETTINGS, interval))
    assert [f.number for f in followed] == list(range(1, 36, interval))
    blind = [f.number for f in followed if f.frame is None]
    assert blind == [n for n in range(1, 36, interval) if n in lost or n > 30]
    assert all((f.cause == "the frame could not be read") == (f.frame is None) for f in followed)
    assert len(identities(followed, 60)) == len(identities(followed, 140)) == 1


def test_a_moving_camera_s_steps_reach_the_record(tmp_path):
    clip = Clip(12, lost=(5,), shake=3.0)
    followed = list(follow_clip(clip, table_of(walkers(range(1, 13))), load_engine("onboard", SETTINGS), SETTINGS, 1))
    shifts = {f.number: f.now_from_before[0, 2] for f in followed if f.now_from_before is not None}
    assert set(shifts) == {2, 3, 4, *range(6, 13)}
    # Frame 6 stands beside frame 4, the last picture before it.
    assert [round(shifts[n]) for n in (4, 6, 7)] == [-3, -6, -3]


def test_what_is_settled_while_a_clip_runs_is_what_the_whole_run_gives():
    table = table_of(walkers(range(1, 41), lanes=(60, 64, 140)))
    engine = load_engine("onboard", SETTINGS)
    whole = all_of(follow_clip(Clip(40), table, engine, SETTINGS, 1))
    for end in (3, 11, 25):
        clip = Clip(40)
        early: dict[int, dict] = {}
        for followed in follow_clip(clip, table, engine, SETTINGS, 1):
            if clip.given > end:
                break
            early |= all_of([followed])
        assert len(early) >= end - 8  # a handful of frames wait for the next ones
        assert early == {number: whole[number] for number in early}


def test_scores_that_are_no_probabilities_are_certain_to_the_tracker_and_written_as_given():
    followed = list(follow_table(table_of(walkers(range(1, 21)), score=-0.8), SETTINGS, 1))
    assert all(f.tracks.score.tolist() == [-0.8, -0.8] for f in followed)
    assert all(f.untracked == [] for f in followed)


def test_rows_of_too_low_a_score_stay_in_the_record_without_identity():
    followed = list(follow_table(table_of(walkers(range(1, 21)), score=0.1), SETTINGS, 1))
    assert all((len(f.tracks), f.untracked) == (0, [0, 1]) for f in followed)


ODD = {
    "zero targets in every frame": [],
    "zero targets in a frame": walkers([1, 2, 3, 5, 6, 7]),
    "one target in one frame": walkers([3], lanes=(60,)),
    "one target for ever": walkers(range(1, 400), lanes=(60,), speed=0.0),
    "two identical boxes": [(n, (20.0 + n, 60.0, 12.0, 40.0)) for n in range(1, 21) for _ in "ab"],
    "boxes outside the picture": [(n, (900.0 + n, -500.0, 12.0, 40.0)) for n in range(1, 21)],
    "huge and tiny boxes": [(n, box) for n in range(1, 21) for box in ((-1e6, -1e6, 2e6, 2e6), (5, 5, 1e-3, 1e-3))],
    "far away": [(n, (1e9, 1e9, 12.0, 40.0)) for n in range(1, 21)],
    "far apart in time": walkers([1, 2, 3, 600, 601, 602], speed=0.01),
}


@pytest.mark.parametrize("mode", ["default", "paper"])
@pytest.mark.parametrize("name", ODD)
def test_odd_tables_lose_no_row_and_give_no_identity_twice_in_a_frame(name, mode):
    table = table_of(ODD[name])
    settings = load_config(overrides=[f"track.mode={mode}"])
    clip = Clip(min(max(table.last, 3), 30))
    runs = [list(follow_table(table, settings, 1))]
    if len(table) < 200:
        runs.append(list(follow_clip(clip, table, load_engine("onboard", settings), settings, 1)))
    for followed in runs:
        assert sum(len(f.detections) for f in followed) == len(table)
        for f in followed:
            rows = f.tracks.row[f.tracks.row >= 0]
            assert len(set(f.tracks.identity.tolist())) == len(f.tracks)
            assert len(set(rows.tolist())) == len(rows)
            assert np.array_equal(f.tracks.box_px[f.tracks.row >= 0], f.detections.box_px[rows])
            assert (f.tracks.identity > 0).all()


def test_boxes_wholly_outside_the_picture_are_tracked_like_the_others():
    table = table_of(ODD["boxes outside the picture"])
    followed = list(follow_clip(Clip(20), table, load_engine("onboard", SETTINGS), SETTINGS, 1))
    assert [len(f.tracks) for f in followed] == [1] * 20
    assert len({i for f in followed for i in f.tracks.identity.tolist()}) == 1


def test_one_target_for_ever_is_one_identity_and_two_identical_boxes_are_two():
    assert len(identities(follow_table(table_of(ODD["one target for ever"]), SETTINGS, 1), 60)) == 1
    found = [set(f.tracks.identity.tolist()) for f in follow_table(table_of(ODD["two identical boxes"]), SETTINGS, 1)]
    assert found == [found[0]] * 20
    assert len(found[0]) == 2


# -- a clip's own detections ---------------------------------------------------------------------------------------


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


def test_own_boxes_that_lose_their_legs_or_grow_a_shadow_keep_their_identity():
    """What is seen to move of a walker: now all, now the trunk or the legs alone, now the shadow as well."""
    random, shown = np.random.default_rng(0), [(0, 0, 1, 1), (0, 0, 1, 0.65), (0, 0.35, 1, 0.65), (0, 0, 2, 1)]
    scenes = []
    for scene in scenes_of(60):
        parts = np.array([shown[k] for k in random.integers(0, 4, 2)])
        whole = scene.detections.box_px
        boxes = np.concatenate([whole[:, :2] + parts[:, :2] * whole[:, 2:], parts[:, 2:] * whole[:, 2:]], axis=1)
        scenes.append(replace(scene, detections=replace(scene.detections, box_px=boxes)))
    tracks = [f.tracks for f in follow_scenes(scenes, SETTINGS, 1, SIZE)]
    assert all(sorted(t.identity.tolist()) == [1, 2] for t in tracks)
    assert len({bool(t.box_px[t.identity == 1, 1] < 120) for t in tracks}) == 1


def test_own_detections_count_as_certain_whatever_their_contrast():
    followed = list(follow_scenes(scenes_of(20), SETTINGS, 1, SIZE))
    assert len(identities(followed, 60)) == len(identities(followed, 140)) == 1
    assert followed[0].tracks.score.tolist() == [0.55, 0.55]


def test_steps_times_and_adjustments_between_the_frames_looked_at_are_kept():
    class Step(np.ndarray):
        __bool__ = lambda self: True  # noqa: E731

    step = np.array([[1, 0, -2.0], [0, 1, 0.5], [0, 0, 1]]).view(Step)
    moved = Adjustment(1, "interval.frames", 3, 4, "flow")
    followed = list(follow_scenes(scenes_of(13, step, (moved,), bad=(6,)), SETTINGS, 4, SIZE))
    assert [f.number for f in followed] == [1, 5, 9, 13]
    moves = [None if f.now_from_before is None else f.now_from_before[:2, 2].tolist() for f in followed]
    assert moves == [None, [-8, 2], [-6, 1.5], [-8, 2]]  # the step that is not known counts as none
    assert [len(f.adjustments) for f in followed] == [1, 4, 4, 4]
    assert [f.seconds["foreground"] for f in followed] == [0.5, 2, 2, 2]


@pytest.fixture(scope="module")
def film():
    return render(0, 40, (480, 360))


class Film(Clip):
    """The simulator's clip in place of the wall."""

    def __init__(self, film):
        super().__init__(len(film.images))
        self.images, self.size = film.images, (480, 360)

    def every(self, interval):
        for number, image in enumerate(self.images, 1):
            self.last = number
            if (number - 1) % interval == 0:
                yield Frame(number, number / 10, image)


def movers_of(film):
    """Frame -> {mover: its true box}."""
    values = [np.unique(mask[mask > 0]) for mask in film.masks]
    seen = [[v for v in some if (mask == v).sum() >= LEAST_PX] for some, mask in zip(values, film.masks, strict=True)]
    pairs = zip(seen, film.boxes_px, strict=True)
    return {n: dict(zip(some, boxes, strict=True)) for n, (some, boxes) in enumerate(pairs, 1)}


def together(followed, movers, least_iou):
    """How often each mover and each identity were seen together: counts (movers, identities)."""
    counts: dict[tuple[int, int], int] = {}
    for f in followed:
        for identity, box in zip(f.tracks.identity.tolist(), f.tracks.box_px, strict=True):
            mover = max(movers[f.number], key=lambda m: iou(box, movers[f.number][m]))
            if iou(box, movers[f.number][mover]) >= least_iou:
                counts[mover, identity] = counts.get((mover, identity), 0) + 1
    table = np.zeros((max(m for m, _ in counts) + 1, max(i for _, i in counts) + 1), int)
    for place, count in counts.items():
        table[place] = count
    return table


def iou(a, b):
    width, height = np.minimum(a[:2] + a[2:], b[:2] + b[2:]) - np.maximum(a[:2], b[:2])
    both = max(width, 0) * max(height, 0)
    return both / (a[2] * a[3] + b[2] * b[3] - both)


@pytest.mark.parametrize("interval", [1, 5])
def test_the_true_boxes_of_the_simulated_clip_get_one_identity_a_mover(film, interval):
    movers = movers_of(film)
    table = table_of([(n, tuple(box)) for n, boxes in movers.items() for box in boxes.values()])
    followed = follow_clip(Film(film), table, load_engine("onboard", SETTINGS), SETTINGS, interval)
    counts = together(followed, movers, 0.99)
    assert counts.sum() == ((table.frame - 1) % interval == 0).sum()
    assert counts[linear_sum_assignment(-counts)].sum() > 0.97 * counts.sum()


@pytest.mark.parametrize("interval", [1, 3])
def test_the_simulated_clip_s_own_detections_are_followed_end_to_end(film, interval):
    """Walkers that cross become one blob and part again; nearly all boxes of a mover are of one identity even so."""
    settings = load_config(overrides=["gates.min_area_px=150"])
    scenes = detect_motion(Film(film), settings, "onboard")
    counts = together(follow_scenes(scenes, settings, interval, (480, 360)), movers_of(film), 0.3)
    assert (counts.max(axis=1) > 5).sum() >= 4
    assert counts[linear_sum_assignment(-counts)].sum() > 0.85 * counts.sum()


def test_doubtful_boxes_come_out_smoothed_and_certain_ones_to_the_digit():
    random = np.random.default_rng(0)
    rows = [(n, (100 + 5 * n + random.normal(0, 3), 200 + random.normal(0, 3), 40, 100)) for n in range(1, 31)]
    for score, moved in ((0.97, True), (1.0, False)):
        followed = list(follow_table(table_of(rows, score), SETTINGS, 1))
        apart = np.concatenate([f.tracks.box_px - f.detections.box_px[f.tracks.row] for f in followed if len(f.tracks)])
        assert len(apart) == 30
        assert (np.abs(apart).max() > 0.5) == moved
        assert np.concatenate([f.tracks.score for f in followed]).tolist() == [score] * 30


def test_without_pictures_the_identities_are_the_same_and_no_picture_is_held():
    followed = [list(follow_scenes(scenes_of(12), SETTINGS, 1, SIZE, pictures=kept)) for kept in (True, False)]
    for with_picture, without in zip(*followed, strict=True):
        assert with_picture.frame.image.any()
        assert without.frame.image.shape == with_picture.frame.image.shape
        assert without.frame.image.strides == (0, 0, 0) and without.frame.number == with_picture.frame.number
        np.testing.assert_array_equal(without.tracks.identity, with_picture.tracks.identity)
        np.testing.assert_array_equal(without.tracks.box_px, with_picture.tracks.box_px)
    assert any(len(f.tracks) for f in followed[1])
