"""Overlays of detections, tracks and people, and the writers of pictures and videos."""

import importlib.util
import sys
import threading
from typing import Any

import cv2
import numpy as np
import pytest

from torchvision_dddas.io.overlay import (
    CUT,
    PERSON,
    SEARCHED,
    UNLIKELY,
    UNTRACKED,
    TrackPictures,
    draw_people,
    draw_scene,
    identity_colour,
)
from torchvision_dddas.io.overlay_video import OverlayPicture, OverlayVideo, ThreadedWriter
from torchvision_dddas.types import Detections, Frame, People, PeopleFrame, Scene, TrackedFrame, Tracks

SIZE = (120, 90)


def image(grey=False, size=SIZE):
    return np.full(size[::-1] if grey else (*size[::-1], 3), 90, np.uint8)


def scene_of(boxes=((5, 20, 20, 30),), grey=False, size=SIZE, cause=""):
    boxes = np.array(boxes, float).reshape(-1, 4)
    unknown = np.full(len(boxes), np.nan)
    found = Detections(boxes, np.ones(len(boxes)), unknown, unknown, unknown)
    mask = np.zeros(size[::-1], np.uint16)
    return Scene(Frame(1, 0.1, image(grey, size)), mask, found, 1, reliable=not cause, cause=cause)


def tracked(boxes=((5, 20, 20, 30),), identities=(1,), grey=False, number=1, read=True, row=None, cause="", size=SIZE):
    boxes = np.array(boxes, float).reshape(-1, 4)
    given = Detections(boxes, np.ones(len(boxes)), np.zeros(0), np.zeros(0), np.zeros(0))
    shown = np.arange(len(identities)) if row is None else np.array(row)
    tracks = Tracks(number, np.array(identities, int), boxes[: len(shown)], np.ones(len(shown)), shown)
    frame = Frame(number, 0.1 * number, image(grey, size)) if read else None
    return TrackedFrame(number, frame, given, tracks, cause=cause)


def people(boxes=((60, 60, 40, 100),), cut=(), regions=None, grey=False, cause="", score=0.9, size=(320, 240)):
    box_px = np.array(boxes, float).reshape(-1, 4)
    n = len(box_px)
    is_cut = np.array([i in cut for i in range(n)], bool)
    found = People(box_px, np.broadcast_to(score, n).astype(float), np.ones(n), is_cut, box_px)
    return PeopleFrame(Frame(3, 0.2, image(grey, size)), found, regions, 0.25, cause)


def draw_tracked(item):
    height, width = item.frame.image.shape[:2]
    return TrackPictures((width, height))(item)


DRAWERS: dict[str, Any] = {
    "scene": (scene_of, draw_scene),
    "tracks": (tracked, draw_tracked),
    "people": (people, draw_people),
}
BOXES = [(-500, -500, 20, 20), (1e9, 1e9, 1e9, 1e9), (-1e9, -1e9, 3e9, 3e9), (3, 3, 1e-3, 1e-3)]


def shows(picture, colour):
    return bool((picture == np.array(colour)).all(axis=-1).any())


@pytest.mark.parametrize("grey", [False, True])
@pytest.mark.parametrize("kind", DRAWERS)
def test_a_picture_is_drawn_on_a_copy_in_colour(kind, grey):
    make, draw = DRAWERS[kind]
    item = make(grey=grey)
    drawn = draw(item)
    assert drawn.shape == (*item.frame.image.shape[:2], 3) and (drawn != 90).any()
    assert (item.frame.image == 90).all()


@pytest.mark.parametrize("box", BOXES)
@pytest.mark.parametrize("kind", DRAWERS)
def test_boxes_anywhere_and_of_any_size_can_be_drawn(kind, box):
    make, draw = DRAWERS[kind]
    item = make([box], grey=True)
    assert draw(item).shape == (*item.frame.image.shape[:2], 3)


@pytest.mark.parametrize("kind", DRAWERS)
def test_a_cause_is_a_caption_that_fits_pictures_of_any_size(kind):
    make, draw = DRAWERS[kind]
    for size in ((3, 2), (120, 90)):
        sound, doubtful = draw(make(size=size)), draw(make(size=size, cause="9 of 200 inliers − a cut"))
        assert sound.shape == doubtful.shape == (*size[::-1], 3)
    assert (sound != doubtful).any()


def test_each_identity_has_its_colour_in_every_frame():
    pictures = TrackPictures(SIZE)
    for number in (1, 2):
        drawn = pictures(tracked([[5, 20, 20, 30], [60, 20, 20, 30]], [3, 11], number=number))
        assert [shows(drawn, identity_colour(identity)) for identity in (3, 11, 4)] == [True, True, False]
        assert (drawn[20:50, 5] == identity_colour(3)).all()


def test_the_first_hundred_colours_are_different_and_bright():
    colours = np.array([identity_colour(i) for i in range(1, 101)])
    assert len(np.unique(colours, axis=0)) > 90
    assert colours.max(axis=1).min() >= 190


def test_the_trail_of_an_identity_is_drawn():
    pictures = TrackPictures(SIZE)
    pictures(tracked([[5, 5, 10, 10]], [2]))
    drawn = pictures(tracked([[65, 5, 10, 10]], [2], number=2))
    assert np.abs(drawn[10, 40].astype(int) - identity_colour(2)).max() < 40  # the line is smoothed


def test_detections_without_identity_and_frames_without_picture_are_drawn():
    drawn = TrackPictures(SIZE)(tracked(identities=[], row=[], read=False, cause="the frame could not be read"))
    assert drawn.shape == (90, 120, 3)
    assert (drawn[20, 5:25] == UNTRACKED).all()


def test_a_person_has_a_box_and_a_point_at_the_feet_and_one_cut_by_the_border_another_colour():
    drawn = draw_people(people())
    assert (drawn[70:150, 60] == PERSON).all() and (drawn[60, 60:100] == PERSON).any()
    assert (drawn[160, 80] == PERSON).all() and not shows(drawn, CUT)
    both = draw_people(people([(60, 60, 40, 100), (-20, 60, 60, 140)], cut=(1,)))
    assert shows(both, PERSON) and shows(both, CUT)


def test_an_unlikely_person_is_grey_without_a_number_and_below_the_others():
    alone = draw_people(people(score=0.4))
    assert (alone[70:150, 60] == UNLIKELY).all() and not shows(alone, PERSON) and not shows(alone, CUT)
    assert not shows(draw_people(people(cut=(0,), score=0.4)), CUT)
    both = draw_people(people([(60, 60, 40, 100), (60, 60, 40, 100)], score=(0.6, 0.4)))
    assert (both[70:150, 60] == PERSON).all()


def test_of_labels_that_overlap_the_best_is_on_top():
    pair = [(60, 60, 40, 100), (70, 60, 40, 100)]
    best_first, best_last = (
        draw_people(people(pair, score=(0.99, 0.6))),
        draw_people(people(pair[::-1], score=(0.6, 0.99))),
    )
    np.testing.assert_array_equal(best_first, best_last)
    alone = draw_people(people(pair[:1], score=0.99))
    np.testing.assert_array_equal(best_first[40:58, 62:85], alone[40:58, 62:85])


def test_searched_regions_are_drawn_and_the_caption_says_how_much_was_searched():
    drawn = draw_people(people(regions=np.array([[40, 30, 100, 150.0]])))
    assert (drawn[100, 40] == SEARCHED).all()
    nowhere = draw_people(people(regions=np.zeros((0, 4))))
    assert not shows(nowhere, SEARCHED)
    assert (nowhere[-40:] != draw_people(people())[-40:]).any()


# --------------------------------------------------------------------------------------------------------------------
# Files.


ENGINES = [
    "mp4v",
    pytest.param("h264", marks=pytest.mark.skipif(not importlib.util.find_spec("av"), reason="needs av")),
]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("size", "grey"), [((64, 48), False), ((65, 49), True)])
def test_a_video_has_every_frame_and_even_sizes(tmp_path, scene, monkeypatch, engine, size, grey):
    if engine == "mp4v":
        monkeypatch.setitem(sys.modules, "av", None)
    video = OverlayVideo(tmp_path, 12.5, draw_scene)
    for number in range(1, 8):
        video.write(scene(number, targets=3, size=size, grey=grey))
    assert not (tmp_path / "overlay.mp4").exists()
    video.close(complete=False)
    assert [p.name for p in tmp_path.iterdir()] == ["overlay.mp4"]
    written = cv2.VideoCapture(str(tmp_path / "overlay.mp4"))
    shapes = []
    while (read := written.read())[0]:
        shapes.append(read[1].shape)
    assert shapes == [(-(-size[1] // 2) * 2, -(-size[0] // 2) * 2, 3)] * 7
    assert written.get(cv2.CAP_PROP_FPS) == pytest.approx(12.5)


def test_a_video_that_cannot_be_opened_again_is_none(tmp_path, scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    video = OverlayVideo(tmp_path, 10, draw_scene)
    video.write(scene(1))
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: type("Broken", (), {"isOpened": lambda _: False})())
    with pytest.raises(OSError, match=r"overlay\.mp4 could not be finished"):
        video.close(complete=True)
    video.discard()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "make", [lambda folder: OverlayVideo(folder, 10, draw_people), lambda folder: OverlayPicture(folder, draw_people)]
)
def test_an_overlay_is_written_whole_or_not_at_all(tmp_path, make):
    kept, dropped, empty = (make(tmp_path / name) for name in ("kept", "dropped", "empty"))
    for name in ("kept", "dropped", "empty"):
        (tmp_path / name).mkdir()
    for overlay in (kept, dropped):
        overlay.write(people())
    assert not [path for path in (tmp_path / "kept").iterdir() if not path.name.startswith(".")]
    kept.close(complete=True)
    dropped.discard()
    empty.close(complete=True)
    counts = [len(list((tmp_path / name).iterdir())) for name in ("kept", "dropped", "empty")]
    assert counts == [1, 0, 0]
    read = cv2.imread(str(tmp_path / "kept/overlay.png"))
    assert read is None or np.array_equal(read, draw_people(people()))


class Writer(ThreadedWriter):
    """Keeps the levels of pictures once it may; refuses those in `bad`."""

    def __init__(self, waiting=5, bad=()):
        self.levels, self.bad, self.closed, self.may = [], bad, False, threading.Event()
        super().__init__(waiting)

    def encode(self, picture):
        self.may.wait(10)
        if int(picture[0, 0]) in self.bad:
            raise OSError("the disk is full")
        self.levels.append(int(picture[0, 0]))

    def finish(self):
        self.closed = True


def level(value):
    return np.full((2, 2), value, np.uint8)


def test_every_picture_is_written_in_order_once_the_writer_is_closed():
    writer = Writer(waiting=30)
    for value in range(20):
        writer.write(level(value))
    assert writer.levels == []  # giving does not wait for the work
    writer.may.set()
    writer.close()
    assert (writer.levels, writer.closed) == (list(range(20)), True)


def test_an_error_is_raised_by_the_next_call_or_at_the_latest_at_the_end():
    first, last = Writer(bad=(0,)), Writer(bad=(1,))
    for writer in (first, last):
        writer.may.set()
    with pytest.raises(OSError, match="full"):
        list(map(first.write, [level(0)] * 100))
    for value in (0, 1):
        last.write(level(value))
    with pytest.raises(OSError, match="full"):
        last.close()
    assert last.closed
