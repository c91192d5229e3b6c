"""Identities that views share, without known pairs."""

from typing import Any

import numpy as np
import pytest

from tests.two_views import boxes, camera, metres, walk
from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import transfer
from torchvision_dddas.tracking import MultiViewTracker
from torchvision_dddas.tracking.view_registration import ViewTargets, fit_map
from torchvision_dddas.types import Tracks


def share(pairs, **options):
    tracker = MultiViewTracker(**options)
    return [frame for pair in pairs for frame in tracker.update(pair)] + tracker.flush()


def wrong_and_right(frame, first=(1, 101)):
    """How many pairs of shared identities are of two targets, and how many of one; numbers begin at `first`."""
    i, j = np.nonzero(frame.shared[0][:, None] == frame.shared[1][None])
    right = frame.own[0][i] - first[0] == frame.own[1][j] - first[1]
    return int((~right).sum()), int(right.sum())


@pytest.fixture(scope="module")
def opposite():
    """Two cameras that look at each other, of which one turns."""
    places, views = walk(), []
    for k, here in enumerate(places):
        views.append((boxes(here, camera(20), 1, k + 1), boxes(here, camera(190 + 0.2 * k, 3, 2), 101, k + 1)))
    return places, views


def test_views_share_identities_without_known_pairs(opposite):
    frames = share(opposite[1])
    counts = np.array([wrong_and_right(frame) for frame in frames])
    both = sum(len(np.intersect1d(a.identity, b.identity - 100)) for a, b in opposite[1])
    assert len(frames) == len(opposite[1]) and counts[:, 0].sum() <= 0.02 * both and counts[:, 1].sum() > 0.9 * both


@pytest.mark.slow
def test_the_map_takes_feet_to_feet(opposite):
    frame, (a, b) = share(opposite[1])[-1], opposite[1][-1]
    _, i, j = np.intersect1d(a.identity, b.identity - 100, return_indices=True)
    off = np.linalg.norm(transfer(frame.maps[0, 1].b_from_a, a.foot_px[i]) - b.foot_px[j], axis=1)
    assert np.median(off) < 0.5 * np.median(b.box_px[:, 2]) and frame.maps[0, 1].quality > 0.8


@pytest.mark.slow
@pytest.mark.parametrize("every", [2, 3])
def test_a_view_of_a_lower_rate_is_registered_and_shares_all_it_shows(opposite, every):
    none = Tracks(0, np.zeros(0, np.int64), np.zeros((0, 4)))
    frames = share([(a, b if k % every == 0 else none) for k, (a, b) in enumerate(opposite[1])])
    assert sum(frame.maps[0, 1].b_from_a is not None for frame in frames) > 0.7 * len(frames)
    counts = np.array([wrong_and_right(frame) for frame in frames])
    both = sum(len(np.intersect1d(a.identity, b.identity - 100)) for a, b in opposite[1][::every])
    assert counts[:, 0].sum() <= 0.02 * both and counts[:, 1].sum() > 0.9 * both


def test_a_view_has_an_identity_once(opposite):
    assert all(len(set(ids.tolist())) == len(ids) for frame in share(opposite[1]) for ids in frame.shared)


@pytest.mark.slow
def test_views_without_overlap_share_nothing():
    pairs = [
        (boxes(one, camera(0), 1, k + 1), boxes(other, camera(90), 101, k + 1))
        for k, (one, other) in enumerate(zip(walk(30, seed=1), walk(30, seed=2), strict=True))
    ]
    for frame in share(pairs):
        assert frame.maps[0, 1].b_from_a is None and not np.intersect1d(*frame.shared).size


@pytest.mark.slow
def test_a_lost_registration_is_found_again():
    places, jump = walk(150), 60
    views = []
    for k, here in enumerate(places):
        turned = camera(0) if k < jump else camera(150, -2, 3)
        views.append((boxes(here, turned, 1 if k < jump else 501, k + 1), boxes(here, camera(40), 101, k + 1)))
    frames = share(views, delay_frames=20)
    assert wrong_and_right(frames[jump - 10])[0] == 0 and wrong_and_right(frames[jump - 10])[1] > 10
    assert wrong_and_right(frames[-1], (501, 101))[0] == 0 and wrong_and_right(frames[-1], (501, 101))[1] > 10


def test_a_target_keeps_its_identity_where_it_leaves_a_view_and_comes_back_under_another_number(opposite):
    views = []
    for k, (a, b) in enumerate(opposite[1]):
        is_away, number = (a.identity == 3) & (40 <= k < 55), np.where((a.identity == 3) & (k >= 55), 77, a.identity)
        views.append((Tracks(a.frame, number[~is_away], a.box_px[~is_away]), b))
    names = [dict(zip(frame.own[0].tolist(), frame.shared[0].tolist(), strict=True)) for frame in share(views)]
    assert names[39][3] == names[70][77]


def test_places_in_metres_need_no_homography_and_show_the_common_shift():
    places = walk(60, 15)
    pairs = [(metres(p, 1, k + 1), metres(p, 101, k + 1, shift=(4, -3))) for k, p in enumerate(places)]
    frames = share(pairs)
    assert frames[-1].maps[0, 1].b_from_a[:2, 2] == pytest.approx([4, -3], abs=0.3)
    counts = np.array([wrong_and_right(frame) for frame in frames])
    assert counts[:, 0].sum() <= 0.02 * counts.sum() and counts[:, 1].sum() > 0.9 * 60 * 15


def test_bad_input_is_refused():
    other: Any = None
    box, place = Tracks(1, np.array([1]), np.ones((1, 4))), metres(np.zeros((1, 2)), 1, 1)
    with pytest.raises(InputError, match="2 or more views"):
        MultiViewTracker(1)
    for views, words in (
        ([box], "has 2 views"),
        ([box, place], "give one kind"),
        ([other, other], "must be Tracks"),
        ([box, Tracks(1, np.array([1, 1]), np.ones((2, 4)))], "view 2 has an identity twice"),
    ):
        with pytest.raises(InputError, match=words):
            MultiViewTracker().update(views)


def test_a_motion_of_the_camera_may_be_unknown_but_not_of_another_shape(opposite):
    tracker = MultiViewTracker()
    tracker.update(opposite[1][0], [np.full((3, 3), np.nan), None])
    for motions, words in (
        ([np.eye(3)], "1 entries for 2"),
        ([np.eye(2)] * 2, "homography"),
        ([np.eye(3) * 0] * 2, "inv"),
    ):
        with pytest.raises(InputError, match=words):
            tracker.update(opposite[1][1], motions)


def test_a_start_with_targets_on_the_horizon_is_kept():
    a = ViewTargets(*_flat(np.array([[0.0, 0.0], [19, 0], [19, 19]])))
    start = np.array([[1.0, 0, 0], [0, 1, 0], [0.1, 0, -1]])  # depth 0 at u = 10, the middle of them
    assert fit_map(start, a, a, np.array([[0, 0], [1, 1]]), 0.3) is start


def _flat(place):
    size = np.full(len(place), 2.0)
    return (
        np.arange(len(place)),
        place,
        np.tile(np.eye(2), (3, 1, 1)),
        size,
        place * np.nan,
        np.array([-50, -50, 50, 50.0]),
    )
