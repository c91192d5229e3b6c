"""Overlays of detections, tracks and people, and the writers of pictures and videos."""

import importlib.util
import sys
import threading
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io import overlay
from torchvision_dddas.io.drawing import draw
from torchvision_dddas.io.overlay import (
    CUT,
    PERSON,
    SEARCHED,
    TARGET,
    UNLIKELY,
    UNTRACKED,
    RunPictures,
    draw_people,
    draw_scene,
    identity_colour,
)
from torchvision_dddas.io.overlay_video import OverlayPicture, OverlayVideo, ThreadedWriter
from torchvision_dddas.types import (
    AerialLocations,
    Detections,
    Fix,
    Frame,
    FrameResult,
    LandmarkObservations,
    People,
    PeopleFrame,
    Positions,
    Scene,
    TrackedFrame,
    Tracks,
)

SIZE = (120, 90)


def image(grey=False, size=SIZE):
    return np.full(size[::-1] if grey else (*size[::-1], 3), 90, np.uint8)


def scene_of(boxes=((5, 20, 20, 30),), grey=False, size=SIZE, cause=""):
    boxes = np.array(boxes, float).reshape(-1, 4)
    heading = np.full(len(boxes), 0.5)
    found = Detections(boxes, np.ones(len(boxes)), heading, heading, heading)
    mask = np.zeros(size[::-1], np.uint16)
    return Scene(Frame(1, 0.1, image(grey, size)), mask, found, 1, reliable=not cause, cause=cause)


def tracked(boxes=((5, 20, 20, 30),), identities=(1,), grey=False, number=1, read=True, cause="", size=SIZE):
    boxes = np.array(boxes, float).reshape(-1, 4)
    given = Detections(boxes, np.ones(len(boxes)), np.zeros(0), np.zeros(0), np.zeros(0))
    n = len(identities)
    tracks = Tracks(number, np.array(identities, int), boxes[:n], np.ones(n), np.arange(n))
    frame = Frame(number, 0.1 * number, image(grey, size)) if read else None
    return FrameResult(TrackedFrame(number, frame, given, tracks, cause=cause))


def people(boxes=((60, 60, 40, 100),), cut=(), regions=None, grey=False, cause="", score=0.9, size=(320, 240)):
    box_px = np.array(boxes, float).reshape(-1, 4)
    n = len(box_px)
    is_cut = np.array([i in cut for i in range(n)], bool)
    found = People(box_px, np.broadcast_to(score, n).astype(float), np.ones(n), is_cut, box_px)
    return PeopleFrame(Frame(3, 0.2, image(grey, size)), found, regions, 0.25, cause)


DRAWERS: dict[str, Any] = {
    "scene": (scene_of, draw_scene),
    "tracks": (tracked, lambda item: RunPictures(item.frame.image.shape[1::-1])(item)),
    "people": (people, draw_people),
}


def shows(picture, colour):
    return bool((picture == np.array(colour)).all(axis=-1).any())


@pytest.mark.parametrize("grey", [False, True])
@pytest.mark.parametrize("kind", DRAWERS)
def test_boxes_anywhere_and_of_any_size_are_drawn_on_a_copy_in_colour(kind, grey):
    make, draw = DRAWERS[kind]
    far = [(-500, -500, 20, 20), (1e9, 1e9, 1e9, 1e9), (-1e9, -1e9, 3e9, 3e9), (3, 3, 1e-3, 1e-3)]
    for item in (make(grey=grey), *(make([box], grey=grey) for box in far)):
        drawn = draw(item)
        assert drawn.shape == (*item.frame.image.shape[:2], 3)
        assert (item.frame.image == 90).all()
    assert (draw(make(grey=grey)) != 90).any()


@pytest.mark.parametrize("kind", DRAWERS)
def test_a_cause_is_a_caption_that_fits_pictures_of_any_size(kind):
    make, draw = DRAWERS[kind]
    for size in ((3, 2), (120, 90)):
        sound, doubtful = draw(make(size=size)), draw(make(size=size, cause="9 of 200 inliers − a cut"))
        assert sound.shape == doubtful.shape == (*size[::-1], 3)
    assert (sound != doubtful).any()


def test_each_identity_has_its_colour_in_every_frame_and_a_trail():
    pictures = RunPictures(SIZE)
    for number in (1, 2):
        drawn = pictures(tracked([[5, 20, 20, 30], [60, 20, 20, 30]], [3, 11], number=number))
        assert [shows(drawn, identity_colour(identity)) for identity in (3, 11, 4)] == [True, True, False]
        assert (drawn[20:50, 5] == identity_colour(3)).all()
    drawn = pictures(tracked([[95, 20, 20, 30]], [3], number=3))
    assert np.abs(drawn[35, 55].astype(int) - identity_colour(3)).max() < 40  # the line is smoothed
    colours = np.array([identity_colour(i) for i in range(1, 101)])
    assert len(np.unique(colours, axis=0)) > 90 and colours.max(axis=1).min() >= 190


def test_detections_without_identity_and_frames_without_picture_are_drawn():
    drawn = RunPictures(SIZE)(tracked(identities=[], read=False, cause="the frame could not be read"))
    assert drawn.shape == (90, 120, 3) and (drawn[20, 5:25] == UNTRACKED).all()


PAIR = [(60, 60, 40, 100), (70, 60, 40, 100)]


def test_people_have_boxes_and_feet_in_the_colour_of_their_kind():
    drawn = draw_people(people())
    assert (drawn[70:150, 60] == PERSON).all() and (drawn[160, 80] == PERSON).all() and not shows(drawn, CUT)
    both = draw_people(people([PAIR[0], (-20, 60, 60, 140)], cut=(1,)))
    assert shows(both, PERSON) and shows(both, CUT)
    alone = draw_people(people(score=0.4, cut=(0,)))
    assert (alone[70:150, 60] == UNLIKELY).all() and not shows(alone, PERSON) and not shows(alone, CUT)


def test_of_boxes_and_labels_that_overlap_the_best_is_on_top():
    same = draw_people(people([PAIR[0], PAIR[0]], score=(0.6, 0.4)))
    assert (same[70:150, 60] == PERSON).all()
    best_first = draw_people(people(PAIR, score=(0.99, 0.6)))
    np.testing.assert_array_equal(best_first, draw_people(people(PAIR[::-1], score=(0.6, 0.99))))
    alone = draw_people(people(PAIR[:1], score=0.99))
    np.testing.assert_array_equal(best_first[40:58, 62:85], alone[40:58, 62:85])


def test_searched_regions_are_drawn_and_the_caption_says_how_much_was_searched():
    drawn = draw_people(people(regions=np.array([[40, 30, 100, 150.0]])))
    assert (drawn[100, 40] == SEARCHED).all()
    nowhere = draw_people(people(regions=np.zeros((0, 4))))
    assert not shows(nowhere, SEARCHED) and (nowhere[-40:] != draw_people(people())[-40:]).any()


# Files.

NEEDS_AV = pytest.mark.skipif(not importlib.util.find_spec("av"), reason="needs av")


@pytest.mark.parametrize("engine", ["mp4v", pytest.param("h264", marks=NEEDS_AV)])
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


@pytest.mark.parametrize("is_video", [True, False])
def test_an_overlay_is_written_whole_or_not_at_all(tmp_path, is_video):
    def written(name, pictures, end):
        folder = tmp_path / name
        folder.mkdir()
        overlay: Any = OverlayVideo(folder, 10, draw_people) if is_video else OverlayPicture(folder, draw_people)
        for picture in pictures:
            overlay.write(picture)
        assert not list(folder.glob("overlay*"))
        end(overlay)
        return list(folder.iterdir())

    (kept,) = written("kept", [people()], lambda overlay: overlay.close(complete=True))
    assert written("dropped", [people()], lambda overlay: overlay.discard()) == []
    assert written("empty", [], lambda overlay: overlay.close(complete=True)) == []
    read = cv2.imread(str(kept))
    assert is_video or (read is not None and np.array_equal(read, draw_people(people())))


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
    first.may.set()
    with pytest.raises(OSError, match="full"):
        list(map(first.write, [level(0)] * 100))
    last.write(level(0))
    last.write(level(1))
    last.may.set()
    with pytest.raises(OSError, match="full"):
        last.close()
    assert last.closed


@pytest.mark.parametrize(("states", "said"), [((), ""), (("used", "excluded"), "1 of 2 landmarks, ")])
def test_the_caption_of_a_located_frame_counts_landmarks_only_where_there_are_any(monkeypatch, states, said):
    written = list[str]()
    monkeypatch.setattr(overlay, "_caption", lambda picture, *lines: written.extend(text for text, _ in lines))
    fix = Fix(1, "telemetry", landmark=np.arange(len(states)), state=states)
    located = AerialLocations(
        1, 0.0, Positions(), np.zeros(0, int), np.zeros((0, 2, 2)), np.zeros((0, 2)), np.zeros((0, 4)), fix,
        LandmarkObservations(),
    )  # fmt: skip
    frame = Frame(1, 0.0, image())
    tracked = TrackedFrame(1, frame, Detections(), Tracks(1))
    RunPictures(SIZE)(FrameResult(tracked, located))
    assert f"located by telemetry, {said}0 targets" in written


def test_draw_shows_what_overlays_of_runs_show_of_tracks():
    results = [tracked([[5 + 9 * k, 20, 20, 30]], [3], number=k + 1) for k in range(3)]
    pictures = RunPictures(SIZE)
    shown = [pictures(result) for result in results][-1]
    drawn = draw(results[-1].frame, results)
    above, below = slice(0, 19), slice(51, 60)
    assert (drawn[24:50] == shown[24:50]).all() and (drawn[below] == 90).all()
    assert (drawn[above] != shown[above]).any()  # the label has a speed too


@pytest.mark.parametrize("kind", ["result", "tracks", "detections", "scene"])
def test_draw_takes_each_result_of_a_frame_and_leaves_the_frame_alone(kind):
    found = Detections(np.array([[5.0, 20, 20, 30]]), np.array([0.9]), label=np.array(["car"], object))
    scene = Scene(Frame(1, 0.0, image()), np.zeros(SIZE[::-1]), found, 1)
    result = {"result": tracked(), "tracks": tracked().tracks, "detections": found, "scene": scene}[kind]
    frame = image(grey=True)
    drawn = draw(frame, result)
    assert drawn.shape == (*SIZE[::-1], 3) and (frame == 90).all()
    assert shows(drawn, identity_colour(1) if kind in ("result", "tracks") else TARGET)


def test_draw_refuses_what_is_no_result_of_one_frame():
    bad: list[Any] = [[1], 3, Tracks.concat([tracked().tracks] * 2)]
    for given in bad:
        with pytest.raises(InputError, match="draw got"):
            draw(image(), given)


def test_labels_have_the_class_and_the_speed_in_metres_where_targets_are_located(monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(overlay, "label", lambda picture, box, text, colour: said.append(text))
    one = tracked()
    tracks = replace(one.tracks, label=np.array(["car"], object))
    places = Positions(np.array([1]), np.array([1]), np.zeros((1, 2)), np.zeros((1, 2, 2)), np.ones(1))
    velocity, none = np.array([[3.0, 4.0]]), np.zeros(0, int)
    located = AerialLocations(1, 0.0, places, none, none, velocity, none, Fix(1, "telemetry"), LandmarkObservations())
    draw(image(), tracks)
    draw(image(), replace(one, tracked=replace(one.tracked, tracks=tracks), locations=located))
    assert said == ["1 car", "1 car 5.0 m/s"]


def test_a_label_at_the_right_edge_is_as_wide_as_one_in_the_middle():
    widths = []
    for x in (20.0, 190.0):
        picture = np.zeros((60, 200, 3), np.uint8)
        overlay.label(picture, np.array([x, 30.0, 8.0, 8.0]), "7 car", (255, 255, 255))
        widths.append(int((picture == 255).all(axis=2).any(axis=0).sum()))
    assert widths[0] == widths[1] > 20
