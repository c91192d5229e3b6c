"""Windows that score become people."""

import numpy as np
import pytest

from torchvision_dddas.config import load_config
from torchvision_dddas.people.boxes import body, people_of, probability
from torchvision_dddas.people.suppression import group

SIZE = (640, 480)


def parameters(**changed):
    return load_config(overrides=[f"people.{name}={value}" for name, value in changed.items()]).people


def around(box, k):
    """The window whose body a box is."""
    x, y, wide, tall = np.asarray(box, float).T
    width, height = wide / k.width_share, tall / k.height_share
    return np.stack([x - (width - wide) / 2, y + tall - k.feet_share * height, width, height], axis=-1)


def test_a_body_is_the_calibrated_share_of_its_window():
    k = parameters(height_share=0.75, width_share=0.5, feet_share=0.9)
    np.testing.assert_allclose(body(np.array([[100.0, 50, 64, 128]]), k), [[116, 50 + 0.15 * 128, 32, 96]])


def test_windows_around_one_person_are_one_between_them():
    window = np.array([[100.0, 50, 64, 128], [108, 50, 64, 128], [104, 46, 67.2, 134.4], [400, 100, 64, 128]])
    people = people_of(window, np.array([1.0, 1.0, 0.5, 0.3]), SIZE, parameters())
    assert len(people) == 2
    assert people.margin.tolist() == [1.0, 0.3]
    middle = people.box_px[0, 0] + people.box_px[0, 2] / 2
    assert 100 + 32 < middle < 108 + 32
    np.testing.assert_allclose(people.window_px[1], window[3])


def test_legs_are_no_second_person():
    k = parameters()
    whole = np.array([100.0, 50, 100, 200])
    x, y, wide, tall = body(whole[None], k)[0]
    legs = around(np.array([[x + 5, y + 0.5 * tall, wide / 2, tall / 2]]), k)[0]
    window, margin = np.stack([legs, whole]), np.array([1.0, 2.0])
    np.testing.assert_allclose(people_of(window, margin, SIZE, k).window_px, whole[None])
    assert len(people_of(window, margin, SIZE, parameters(contained=1.0))) == 2


def test_heights_come_out_between_two_scales_that_score_alike():
    window = np.array([[100.0, 50, 64, 128], [98.4, 46.8, 67.2, 134.4]])
    k = parameters()
    (box,) = people_of(window, np.array([2.0, 2.0]), SIZE, k).box_px
    assert box[3] == pytest.approx(k.height_share * 128 * np.sqrt(1.05))


def test_people_come_best_first_with_a_probability_that_rises_with_the_score():
    window = np.array([[0.0, 50, 64, 128], [200, 50, 64, 128], [400, 50, 64, 128]])
    for suppression in ("nms", "opencv", "none"):
        people = people_of(window, np.array([0.5, 2.0, 1.0]), SIZE, parameters(suppression=suppression, group=0))
        assert people.margin.tolist() == [2.0, 1.0, 0.5]
        assert (np.diff(people.score) < 0).all()


def test_the_probability_is_a_half_at_the_even_score_and_stays_within_bounds():
    k = parameters(probability_slope=3.0, probability_even=0.7)
    np.testing.assert_allclose(probability(np.array([0.7, 1e9, -1e9]), k), [0.5, 1, 0], atol=1e-9)
    assert probability(np.array([0.7 + np.log(3) / 3]), k)[0] == pytest.approx(0.75)


def test_opencv_suppression_gives_its_groups_and_none_keeps_all():
    rng = np.random.default_rng(0)
    window = np.rint(np.column_stack([rng.uniform(0, 60, (40, 2)), np.tile((64, 128), (40, 1))]))
    margin = rng.uniform(0.2, 3, 40)
    box, best = group(window, margin, 2)
    people = people_of(window, margin, SIZE, parameters(suppression="opencv"))
    order = np.argsort(-best)
    assert people.window_px.tolist() == box[order].tolist()
    assert people.margin.tolist() == best[order].tolist()
    assert len(people_of(window, margin, SIZE, parameters(suppression="none"))) == 40


@pytest.mark.parametrize(
    ("box", "cut"),
    [
        ((300, 200, 40, 100), False),
        ((300, -1, 40, 100), True),
        ((300, 381, 40, 100), True),
        ((300, 379, 40, 100), True),  # the feet end 1 px above the border: they may go on below it
        ((-10, 200, 40, 100), True),
        ((610, 200, 40, 100), True),
        ((300, 370, 40, 100), False),
    ],
)
def test_a_body_that_meets_the_border_is_flagged(box, cut):
    k = parameters()
    people = people_of(around(np.array([box], float), k), np.array([1.0]), SIZE, k)
    assert people.cut.tolist() == [cut]


def test_no_windows_show_nobody():
    for suppression in ("nms", "opencv", "none"):
        people = people_of(np.zeros((0, 4)), np.zeros(0), SIZE, parameters(suppression=suppression))
        assert len(people) == 0
        assert people.box_px.shape == people.window_px.shape == (0, 4)
        assert people.cut.dtype == bool
