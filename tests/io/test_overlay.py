"""Overlays of detections, and the writers of videos."""

import importlib.util
import sys
import threading

import cv2
import numpy as np
import pytest

from torchvision_dddas.io.overlay import OverlayVideo, draw_scene
from torchvision_dddas.io.overlay.video import ThreadedWriter

ENGINES = [
    "mp4v",
    pytest.param("h264", marks=pytest.mark.skipif(not importlib.util.find_spec("av"), reason="needs av")),
]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("size", "grey"), [((64, 48), False), ((65, 49), True)])
def test_film_has_every_frame_and_even_sizes(tmp_path, scene, monkeypatch, engine, size, grey):
    if engine == "mp4v":
        monkeypatch.setitem(sys.modules, "av", None)
    film = OverlayVideo(tmp_path, 12.5, draw_scene)
    for number in range(1, 8):
        film.write(scene(number, targets=3, size=size, grey=grey))
    assert not (tmp_path / "overlay.mp4").exists()
    film.close(complete=False)
    assert [p.name for p in tmp_path.iterdir()] == ["overlay.mp4"]
    video = cv2.VideoCapture(str(tmp_path / "overlay.mp4"))
    shapes = []
    while (read := video.read())[0]:
        shapes.append(read[1].shape)
    assert shapes == [(-(-size[1] // 2) * 2, -(-size[0] // 2) * 2, 3)] * 7
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(12.5)


def test_the_frame_itself_is_not_drawn_on(scene):
    made = scene(1, targets=2)
    before = made.frame.image.copy()
    assert not np.array_equal(draw_scene(made), before)
    assert np.array_equal(made.frame.image, before)


def test_a_warning_is_visible_and_fits_a_narrow_picture(scene):
    sound, doubtful = (
        scene(1, size=(120, 90)),
        scene(1, size=(120, 90), reliable=False, cause="9 of 200 inliers − a cut"),
    )
    assert (draw_scene(doubtful) != draw_scene(sound)).any()
    assert draw_scene(doubtful).shape == (90, 120, 3)


def test_the_smallest_pictures_can_be_drawn(scene):
    assert draw_scene(scene(1, targets=0, size=(3, 2), reliable=False, cause="x")).shape == (2, 3, 3)


def test_discard_leaves_nothing(tmp_path, scene):
    film = OverlayVideo(tmp_path, 10, draw_scene)
    film.write(scene(1))
    film.discard()
    assert not list(tmp_path.iterdir())


def test_a_film_that_cannot_be_opened_again_is_no_film(tmp_path, scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    film = OverlayVideo(tmp_path, 10, draw_scene)
    film.write(scene(1))
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: type("Broken", (), {"isOpened": lambda _: False})())
    with pytest.raises(OSError, match=r"overlay\.mp4 could not be finished"):
        film.close(complete=True)
    film.discard()
    assert not list(tmp_path.iterdir())


class Film:
    """Keeps what it is given, once it may; refuses the pictures whose level is in `bad`."""

    def __init__(self, bad=()):
        self.levels, self.bad, self.closed, self.may = [], bad, False, threading.Event()
        self.may.set()

    def write(self, picture):
        self.may.wait(10)
        if int(picture[0, 0]) in self.bad:
            raise OSError("the disk is full")
        self.levels.append(int(picture[0, 0]))

    def close(self):
        self.closed = True


def level(value):
    return np.full((2, 2), value, np.uint8)


def test_every_picture_is_in_the_film_in_order_once_it_is_closed():
    film = Film()
    film.may.clear()
    beside = ThreadedWriter(film, waiting=30)
    for value in range(20):
        beside.write(level(value))
    assert film.levels == []  # giving does not wait for the work
    film.may.set()
    beside.close()
    assert (film.levels, film.closed) == (list(range(20)), True)


def test_an_error_is_raised_by_the_next_call_or_at_the_latest_at_the_end():
    beside = ThreadedWriter(Film(bad=(0,)))
    with pytest.raises(OSError, match="full"):
        list(map(beside.write, [level(0)] * 100))
    film = Film(bad=(1,))
    beside = ThreadedWriter(film, waiting=5)
    for value in (0, 1):
        beside.write(level(value))
    with pytest.raises(OSError, match="full"):
        beside.close()
    assert film.closed
