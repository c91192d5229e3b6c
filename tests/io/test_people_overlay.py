"""What the user sees: bodies, feet, those whom the border cuts, where it was searched."""

import cv2
import numpy as np
import pytest

from torchvision_dddas.io.overlay import OverlayPicture, draw_people
from torchvision_dddas.io.overlay.layers import CUT, PERSON, SEARCHED, UNLIKELY
from torchvision_dddas.types import Frame, People, PeopleFrame


def recognized(boxes=((60, 60, 40, 100),), cut=(), regions=None, grey=False, cause="", score=0.9):
    box_px = np.array(boxes, float).reshape(-1, 4)
    n = len(box_px)
    people = People(
        box_px,
        np.broadcast_to(score, n).astype(float),
        np.ones(n),
        np.array([i in cut for i in range(n)], bool),
        box_px,
    )
    image = np.full((240, 320) if grey else (240, 320, 3), 90, np.uint8)
    return PeopleFrame(Frame(3, 0.2, image), people, regions, 0.25, cause)


def shows(picture, colour):
    return bool((picture == np.array(colour)).all(axis=-1).any())


@pytest.mark.parametrize("grey", [False, True])
def test_a_body_has_its_box_and_a_point_at_its_feet(grey):
    made = draw_people(recognized(grey=grey))
    assert made.shape == (240, 320, 3)
    assert (made[70:150, 60] == PERSON).all() and (made[60, 60:100] == PERSON).any()
    assert (made[160, 80] == PERSON).all()


def test_one_whom_the_border_cuts_has_another_colour():
    made = draw_people(recognized([(60, 60, 40, 100), (-20, 60, 60, 140)], cut=(1,)))
    assert shows(made, PERSON) and shows(made, CUT)
    assert not shows(draw_people(recognized()), CUT)


def test_one_who_is_less_likely_than_not_is_grey_without_a_number_and_below_the_others():
    alone = draw_people(recognized(score=0.4))
    assert (alone[70:150, 60] == UNLIKELY).all() and not shows(alone, PERSON) and not shows(alone, CUT)
    assert not shows(draw_people(recognized(cut=(0,), score=0.4)), CUT)
    both = draw_people(recognized([(60, 60, 40, 100), (60, 60, 40, 100)], score=(0.6, 0.4)))
    assert (both[70:150, 60] == PERSON).all()


def test_of_labels_that_overlap_the_best_is_read():
    pair = [(60, 60, 40, 100), (70, 60, 40, 100)]
    best_first, best_last = (draw_people(recognized(boxes, score=score)) for boxes, score in (
        (pair, (0.99, 0.6)), (pair[::-1], (0.6, 0.99))
    ))  # fmt: skip
    np.testing.assert_array_equal(best_first, best_last)
    alone = draw_people(recognized(pair[:1], score=0.99))
    np.testing.assert_array_equal(best_first[40:58, 62:85], alone[40:58, 62:85])


def test_regions_are_drawn_where_there_are_some():
    made = draw_people(recognized(regions=np.array([[40, 30, 100, 150.0]])))
    assert (made[100, 40] == SEARCHED).all()
    assert not shows(draw_people(recognized(regions=np.zeros((0, 4)))), SEARCHED)


def test_the_caption_says_how_much_was_searched_and_why_nothing_is_known():
    everywhere, some, unread = (
        draw_people(r)[-40:]
        for r in (recognized(), recognized(regions=np.zeros((0, 4))), recognized(cause="the frame could not be read"))
    )
    assert (everywhere != some).any() and (everywhere != unread).any()


@pytest.mark.parametrize("box", [(-500, -500, 20, 20), (1e9, 1e9, 1e9, 1e9), (3, 3, 1e-3, 1e-3)])
def test_boxes_anywhere_can_be_drawn(box):
    assert draw_people(recognized([box], regions=np.array([box]))).shape == (240, 320, 3)


def test_the_input_is_not_drawn_on():
    one = recognized()
    draw_people(one)
    assert (one.frame.image == 90).all()


def test_a_single_picture_is_saved_whole_or_not_at_all(tmp_path):
    kept, dropped = OverlayPicture(tmp_path, draw_people), OverlayPicture(tmp_path / "no", draw_people)
    (tmp_path / "no").mkdir()
    for still in (kept, dropped):
        still.write(recognized())
    assert not (tmp_path / "overlay.png").exists()
    kept.close(complete=True)
    dropped.discard()
    made = cv2.imread(str(tmp_path / "overlay.png"))
    assert made is not None and np.array_equal(made, draw_people(recognized()))
    assert not list((tmp_path / "no").iterdir())
    assert [p.name for p in tmp_path.iterdir() if p.is_file()] == ["overlay.png"]


def test_a_run_without_frames_has_no_picture(tmp_path):
    OverlayPicture(tmp_path, draw_people).close(complete=True)
    assert not list(tmp_path.iterdir())
