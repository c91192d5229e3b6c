"""Landmarks in the picture: tracked by their colours and by what moves, and cut out of blobs."""

from itertools import permutations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.config import LandmarkParameters
from torchvision_dddas.geo.landmark_tracking import LandmarkTracker, separate
from torchvision_dddas.geo.landmark_watch import cut_out_landmarks
from torchvision_dddas.types import Detections

EXACT = LandmarkParameters(reach_px=10.0)
GREEDY = LandmarkParameters(reach_px=10.0, differentiation="greedy")
SIZE = (300, 400)


@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(0, 4))
def test_exact_takes_as_many_pairs_as_there_can_be_and_then_the_least_distance(seed, n, m):
    rng = np.random.default_rng(seed)
    colour, blob = rng.uniform(0, 25, (n, 2)), rng.uniform(0, 25, (m, 2))
    distance = np.linalg.norm(colour[:, None] - blob[None], axis=2)
    best = (0, 0.0)
    for order in permutations([*range(m), *[-1] * n], n):
        pairs = [(i, j) for i, j in enumerate(order) if j >= 0 and distance[i, j] <= EXACT.reach_px]
        best = min(best, (-len(pairs), sum(distance[i, j] for i, j in pairs)))
    found = [(i, j) for i, j in enumerate(separate(colour, blob, EXACT)) if j >= 0]
    assert len({j for _, j in found}) == len(found)
    assert (-len(found), sum(distance[i, j] for i, j in found)) == pytest.approx(best)


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


class Tracker:
    """A tracker of one landmark a letter, given blobs that fill their boxes and nothing else that is known."""

    def __init__(self, names="a", **parameters):
        self.count = len(names)
        self.tracker = LandmarkTracker(self.count, LandmarkParameters(reach_px=30.0, **parameters))

    def update(self, frame, masks, *boxes, expected_px=None, length_px=None):
        box, foreground = np.array(boxes, float).reshape(-1, 4), np.zeros(SIZE, np.uint16)
        for row, (x, y, width, height) in enumerate(boxes, 1):
            foreground[y : y + height, x : x + width] = row
        found = Detections(box, np.ones(len(box)), box[:, 2:].prod(axis=1), *np.full((2, len(box)), np.nan))
        expected = np.full((self.count, 2), np.nan) if expected_px is None else expected_px
        length = np.full(self.count, np.nan) if length_px is None else length_px
        return self.tracker.update(frame, masks, found, foreground, None, expected, length)


def test_a_landmark_with_a_blob_is_at_the_blobs_centre_or_by_choice_at_its_colours_and_the_blob_is_no_target():
    masks, blob = plates((100, 50, 10, 10)), (96, 48, 30, 14)
    found = Tracker().update(1, masks, blob, (300, 200, 20, 20))
    assert found.image_px.tolist() == [[110.5, 54.5]] and found.by == ("motion",)
    assert found.colour_px.tolist() == [[104.5, 54.5]]
    assert (found.blob.tolist(), found.rows.tolist()) == ([0], [True, False])
    chosen, alone = Tracker(centre="colour").update(1, masks, blob), Tracker().update(1, masks)
    for found in (chosen, alone):
        assert found.image_px.tolist() == [[104.5, 54.5]] and found.by == ("colour",)
    assert chosen.rows.tolist() == [True]


def test_a_landmark_that_is_not_seen_or_cut_by_the_border_has_no_place_and_what_is_expected_there_is_no_target():
    found = Tracker("ab").update(1, plates((0, 50, 10, 10), []), (0, 48, 14, 14))
    assert np.isnan(found.image_px).all() and found.by == ("", "") and found.rows.tolist() == [True]
    at, boxes = np.array([[4.0, 50.0]]), ((0, 44, 12, 14), (60, 44, 12, 14))
    found = Tracker().update(1, plates([]), *boxes, expected_px=at, length_px=np.array([20.0]))
    assert found.rows.tolist() == [True, False] and np.isnan(found.image_px).all()


def test_a_blob_much_larger_than_usual_holds_somebody_else_too_and_its_centre_is_not_taken():
    one = Tracker()
    for frame in range(1, 6):
        assert one.update(frame, plates((100 + frame, 50, 10, 10)), (98 + frame, 48, 14, 14)).by == ("motion",)
    both = one.update(6, plates((106, 50, 10, 10)), (104, 48, 40, 14))
    assert both.by == ("colour",) and both.image_px.tolist() == [[110.5, 54.5]]
    assert (both.rows.tolist(), both.shared.tolist()) == ([False], [True])


def test_two_landmarks_in_one_blob_are_at_their_colours_and_the_blob_is_no_target():
    one, masks = Tracker("ab"), plates((100, 50, 10, 10), (116, 50, 10, 10))
    for frame in range(1, 6):
        apart = one.update(frame, masks, (98, 48, 14, 14), (114, 48, 14, 14))
        assert apart.by == ("motion", "motion") and apart.blob.tolist() == [0, 1]
    found = one.update(6, masks, (98, 48, 30, 14))
    assert found.by == ("colour", "colour")
    assert (found.rows.tolist(), found.shared.tolist()) == ([True], [False])


def test_a_vehicle_is_recognised_beside_a_larger_roof_of_its_colour_by_its_travel_and_has_no_place_until_then():
    one, seen = Tracker(), []
    for frame in range(1, 15):
        found = one.update(frame, plates([(100 + 3 * frame, 50, 10, 10), (200, 200, 24, 24)]))
        seen.append(found.by[0])
        if found.by[0]:
            assert found.image_px[0] == pytest.approx([104.5 + 3 * frame, 54.5])
    assert seen[0] == "" and seen[-8:] == ["colour"] * 8


def test_a_landmark_comes_back_after_it_was_hidden():
    one = Tracker()
    for frame in range(1, 40):
        hidden = 10 <= frame < 20
        found = one.update(frame, plates([] if hidden else (100 + 2 * frame, 50, 10, 10)))
        assert found.by == (("",) if hidden else ("colour",))
    assert found.image_px[0] == pytest.approx([104.5 + 2 * 39, 54.5])


def cut(middles, radius, least_px, vehicles=(1,), beside=0):
    """Cut a vehicle at the end of a crowd of 40 x 20 px and a lone one, a target far away; before and after."""
    mask = np.zeros((100, 160), np.uint16)
    mask[40:60, 20:60], mask[10:22, 100 : 112 + beside], mask[80:90, 130:140] = 1, 2, 3
    boxes = np.array([cv2.boundingRect((mask == value).astype(np.uint8)) for value in (1, 2, 3)], float)
    area = boxes[:, 2:].prod(axis=1)
    found = Detections(boxes, np.array([0.5, 0.6, 0.7]), area, np.full(3, np.nan), np.arange(3.0))
    own = np.isin(np.arange(3), vehicles)
    return found, mask, *cut_out_landmarks(found, mask.copy(), own, np.array(middles), np.array(radius), least_px)


def test_the_rest_of_a_crowd_stays_a_target_and_what_no_disc_touches_is_as_it_was():
    found, _, left, numbered = cut([[25.0, 50.0], [105.5, 15.5]], [12.0, 12.0], 20.0)
    assert left.score.tolist() == [0.5, 0.7] and left.speed_px.tolist() == [0.0, 2.0]
    x, _, width, _ = left.box_px[0]
    assert 31 <= x <= 38 and x + width == 60
    assert left.area_px[0] == (numbered == 1).sum() < found.area_px[0]
    assert left.box_px[1].tolist() == found.box_px[2].tolist()
    assert not numbered[50, 25] and sorted(np.unique(numbered)) == [0, 1, 2]


@pytest.mark.parametrize(("vehicles", "left"), [((1,), [0.5, 0.7]), ((), [0.5, 0.6, 0.7])])
def test_what_a_vehicles_own_blob_leaves_must_be_larger_than_a_rest_of_a_crowd(vehicles, left):
    assert cut([[105.5, 15.5]], [9.0], 30.0, vehicles, beside=8)[2].score.tolist() == left


def test_of_a_vehicle_whose_middle_is_not_known_nothing_stays_and_of_others_all_does():
    _, mask, left, numbered = cut([[np.nan, np.nan]], [np.nan], np.inf)
    assert left.score.tolist() == [0.5, 0.7]
    assert (numbered > 0).sum() == ((mask == 1) | (mask == 3)).sum()
