import threading

import numpy as np
import pytest

from torchvision_dddas.io.overlay.video import ThreadedWriter


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
