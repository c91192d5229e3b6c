"""Landmarks in the picture: told from targets, and followed by their colours and by what moves."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.config import LandmarkParameters
from torchvision_dddas.geo.landmark_tracking import LandmarkTracker, separate
from torchvision_dddas.types import Detections

EXACT = LandmarkParameters(reach_px=10.0)
GREEDY = LandmarkParameters(reach_px=10.0, differentiation="greedy")
SIZE = (300, 400)


def best_by_hand(distance, reach):
    """(pairs, least distance) over all ways to give blobs to landmarks."""
    n, m = distance.shape
    best = (0, 0.0)
    for order in permutations([*range(m), *[-1] * n], n):
        pairs = [(i, j) for i, j in enumerate(order) if j >= 0 and distance[i, j] <= reach]
        best = min(best, (-len(pairs), sum(distance[i, j] for i, j in pairs)))
    return best


@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(0, 4))
def test_exact_takes_as_many_pairs_as_there_can_be_and_then_the_least_distance(seed, n, m):
    rng = np.random.default_rng(seed)
    colour, blob = rng.uniform(0, 25, (n, 2)), rng.uniform(0, 25, (m, 2))
    match = separate(colour, blob, EXACT)
    distance = np.linalg.norm(colour[:, None] - blob[None], axis=2)
    found = [(i, j) for i, j in enumerate(match) if j >= 0]
    assert len({j for _, j in found}) == len(found)
    assert (-len(found), sum(distance[i, j] for i, j in found)) == pytest.approx(best_by_hand(distance, 10.0))


def test_greedy_goes_row_by_row_and_so_may_leave_a_landmark_without_a_blob():
    colour, blob = np.array([[0, 0], [-9, 0.0]]), np.array([[-1, 0], [8, 0.0]])
    assert separate(colour, blob, GREEDY).tolist() == [0, -1]
    assert separate(colour, blob, EXACT).tolist() == [1, 0]


def plates(*boxes):
    """(K, H, W) masks; a box or a list of boxes x, y, width, height for each colour."""
    masks = np.zeros((len(boxes), *SIZE), np.uint8)
    for mask, of in zip(masks, boxes, strict=True):
        for x, y, width, height in of if isinstance(of, list) else [of]:
            mask[y : y + height, x : x + width] = 255
    return masks


def blobs(*boxes):
    box = np.array(boxes, float).reshape(-1, 4)
    n, unknown = len(box), np.full(len(box), np.nan)
    return Detections(box, np.ones(n), box[:, 2:].prod(axis=1), unknown, unknown)


class follower:
    """A tracker of one landmark a letter, given blobs that fill their boxes and nothing else that is known."""

    def __init__(self, names="a", **parameters):
        self.count = len(names)
        self.tracker = LandmarkTracker(self.count, LandmarkParameters(reach_px=30.0, **parameters))

    def update(self, frame, masks, found, expected_px=None, length_px=None):
        foreground = np.zeros(SIZE, np.uint16)
        for row, (x, y, width, height) in enumerate(found.box_px.astype(int), 1):
            foreground[y : y + height, x : x + width] = row
        expected = np.full((self.count, 2), np.nan) if expected_px is None else expected_px
        length = np.full(self.count, np.nan) if length_px is None else length_px
        return self.tracker.update(frame, masks, found, foreground, None, expected, length)


def test_a_landmark_with_a_blob_is_at_the_blobs_centre_and_the_blob_is_no_target():
    found = follower().update(1, plates((100, 50, 10, 10)), blobs((96, 48, 30, 14), (300, 200, 20, 20)))
    assert found.image_px.tolist() == [[110.5, 54.5]] and found.by == ("motion",)
    assert found.colour_px.tolist() == [[104.5, 54.5]]
    assert (found.blob.tolist(), found.rows.tolist()) == ([0], [True, False])


def test_by_choice_it_is_at_its_colours_centre_and_so_it_is_without_a_blob():
    masks = plates((100, 50, 10, 10))
    chosen = follower(centre="colour").update(1, masks, blobs((96, 48, 30, 14)))
    alone = follower().update(1, masks, blobs())
    for found in (chosen, alone):
        assert found.image_px.tolist() == [[104.5, 54.5]] and found.by == ("colour",)
    assert chosen.rows.tolist() == [True]


def test_nothing_is_said_of_a_landmark_that_is_not_seen_or_cut_by_the_border():
    found = follower("ab").update(1, plates((0, 50, 10, 10), []), blobs((0, 48, 14, 14)))
    assert np.isnan(found.image_px).all() and found.by == ("", "")
    assert found.rows.tolist() == [True]


def test_a_blob_much_larger_than_usual_holds_somebody_else_too_and_its_centre_is_not_taken():
    one = follower()
    for frame in range(1, 6):
        usual = one.update(frame, plates((100 + frame, 50, 10, 10)), blobs((98 + frame, 48, 14, 14)))
        assert usual.by == ("motion",)
    both = one.update(6, plates((106, 50, 10, 10)), blobs((104, 48, 40, 14)))
    assert both.by == ("colour",) and both.image_px.tolist() == [[110.5, 54.5]]
    assert (both.rows.tolist(), both.shared.tolist()) == ([False], [True])


def test_a_vehicle_whose_colour_is_not_seen_is_kept_from_the_targets_where_it_is_expected():
    masks, at = plates([]), np.array([[4.0, 50.0]])
    seen = blobs((0, 44, 12, 14), (60, 44, 12, 14))
    found = follower().update(1, masks, seen, expected_px=at, length_px=np.array([20.0]))
    assert found.rows.tolist() == [True, False] and np.isnan(found.image_px).all()


def test_two_landmarks_in_one_blob_are_at_their_colours_and_the_blob_is_no_target():
    one, masks = follower("ab"), plates((100, 50, 10, 10), (116, 50, 10, 10))
    for frame in range(1, 6):
        apart = one.update(frame, masks, blobs((98, 48, 14, 14), (114, 48, 14, 14)))
        assert apart.by == ("motion", "motion") and apart.blob.tolist() == [0, 1]
    found = one.update(6, masks, blobs((98, 48, 30, 14)))
    assert found.by == ("colour", "colour")
    assert (found.rows.tolist(), found.shared.tolist()) == ([True], [False])


def test_a_vehicle_is_told_from_a_larger_roof_of_its_colour_by_its_travel_and_until_then_nothing_is_said():
    one, roof, seen = follower(), (200, 200, 24, 24), []
    for frame in range(1, 15):
        plate = (100 + 3 * frame, 50, 10, 10)
        found = one.update(frame, plates([plate, roof]), blobs())
        seen.append(found.by[0])
        if found.by[0]:
            assert found.image_px[0] == pytest.approx([104.5 + 3 * frame, 54.5])
    assert seen[0] == "" and seen[-8:] == ["colour"] * 8


def test_a_landmark_comes_back_after_it_was_hidden():
    one = follower()
    for frame in range(1, 40):
        hidden = 10 <= frame < 20
        plate = (100 + 2 * frame, 50, 10, 10)
        found = one.update(frame, plates([] if hidden else plate), blobs())
        assert found.by == (("",) if hidden else ("colour",))
    assert found.image_px[0] == pytest.approx([104.5 + 2 * 39, 54.5])
