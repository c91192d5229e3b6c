import cv2
import numpy as np
import pytest

from torchvision_dddas.io.overlay import OverlayVideo, TrackPictures, identity_colour
from torchvision_dddas.types import Detections, Frame, TrackedFrame, Tracks

SIZE = (120, 90)


def followed(number, boxes, identities, grey=False, read=True, row=None, cause=""):
    shape = SIZE[::-1] if grey else (*SIZE[::-1], 3)
    boxes = np.array(boxes, float).reshape(-1, 4)
    given = Detections(boxes, np.ones(len(boxes)), np.zeros(0), np.zeros(0), np.zeros(0))
    shown = np.arange(len(identities)) if row is None else np.array(row)
    tracks = Tracks(number, np.array(identities, int), boxes[: len(shown)], np.ones(len(shown)), shown)
    frame = Frame(number, 0.1 * number, np.full(shape, 90, np.uint8)) if read else None
    return TrackedFrame(number, frame, given, tracks, cause=cause)


def shows(picture, colour):
    return bool((picture == np.array(colour)).all(axis=-1).any())


def test_each_identity_has_its_colour_in_every_frame():
    pictures = TrackPictures(SIZE)
    for number in (1, 2):
        made = pictures(followed(number, [[5, 20, 20, 30], [60, 20, 20, 30]], [3, 11]))
        assert made.shape == (90, 120, 3)
        assert (
            shows(made, identity_colour(3)) and shows(made, identity_colour(11)) and not shows(made, identity_colour(4))
        )
        assert (made[20:50, 5] == identity_colour(3)).all()


def test_the_first_hundred_colours_are_different_and_bright():
    colours = np.array([identity_colour(i) for i in range(1, 101)])
    assert len(np.unique(colours, axis=0)) > 90
    assert colours.max(axis=1).min() >= 190


def test_the_way_that_an_identity_came_is_drawn():
    pictures = TrackPictures(SIZE)
    pictures(followed(1, [[5, 5, 10, 10]], [2]))
    made = pictures(followed(2, [[65, 5, 10, 10]], [2]))
    assert np.abs(made[10, 40].astype(int) - identity_colour(2)).max() < 40  # the line is smoothed


def test_detections_without_identity_and_frames_without_picture_are_drawn():
    made = TrackPictures(SIZE)(
        followed(1, [[5, 20, 20, 30]], [], row=[], read=False, cause="the frame could not be read")
    )
    assert made.shape == (90, 120, 3)
    assert (made[20, 5:25] == 150).all()


@pytest.mark.parametrize(
    "box", [[-500, -500, 20, 20], [1e9, 1e9, 1e9, 1e9], [-1e9, -1e9, 3e9, 3e9], [3, 3, 1e-3, 1e-3]]
)
def test_boxes_outside_the_picture_and_of_any_size_can_be_drawn(box):
    assert TrackPictures(SIZE)(followed(1, [box], [1], grey=True)).shape == (90, 120, 3)


def test_the_input_is_not_drawn_on():
    one = followed(1, [[5, 20, 20, 30]], [1])
    TrackPictures(SIZE)(one)
    assert one.frame is not None
    assert (one.frame.image == 90).all()


def test_film_has_every_frame(tmp_path):
    film = OverlayVideo(tmp_path, 2, TrackPictures(SIZE))
    for number in range(1, 8):
        film.write(followed(number, [[5 + number, 20, 20, 30]], [1], read=number != 3))
    film.close(complete=True)
    assert cv2.VideoCapture(str(tmp_path / "overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 7
