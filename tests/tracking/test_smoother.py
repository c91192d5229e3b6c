"""The fixed-lag smoother: confirmation, gaps, identities and smoothed boxes."""

from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from torchvision_dddas.tracking.kalman import transform_boxes
from torchvision_dddas.tracking.smoother import FILLED, FixedLagSmoother, smooth_box
from torchvision_dddas.types import Tracks

PAN = np.array([[1.0, 0, 7], [0, 1, -3], [0, 0, 1]])
ZOOM = np.array([[1.2, 0, -30], [0, 1.2, -20], [0, 0, 1]])


def box(number: int, look: int) -> list[float]:
    """Each track walks to the right on a line of its own."""
    return [10.0 * look, 100.0 * number, 20, 40]


def written(
    looks: Sequence[Mapping[int, float]], hits: int = 3, smooth: bool = False, seen: Sequence | None = None
) -> list[list[Tracks]]:
    """What each look settled, and the end. looks: {number of track: score}; frames are 1, 6, 11, ..."""
    smoother, settled = FixedLagSmoother(hits, smooth), []
    for look, tracks in enumerate(looks):
        boxes = np.array([box(number, look) for number in tracks]).reshape(-1, 4)
        numbers, score = np.array(list(tracks), np.int64), np.array(list(tracks.values()), float)
        step = None if seen is None or look == 0 else seen[look - 1]
        smoother.add(1 + 5 * look, numbers, boxes, score, np.arange(len(numbers)), step)
        settled.append(smoother.settle())
    return [*settled, smoother.settle(everything=True)]


def pages(looks: Sequence[Mapping[int, float]], **options: object) -> list[Tracks]:
    return [page for settled in written(looks, **options) for page in settled]  # type: ignore[arg-type]


def names(found: Sequence[Tracks]) -> list[list[int]]:
    return [tracks.identity.tolist() for tracks in found]


@pytest.mark.parametrize("hits", [1, 3, 5])
def test_each_frame_is_settled_once_in_order_as_soon_as_no_later_look_can_tell(hits):
    settled = written([{0: 0.9}] * 12, hits)
    assert [page.frame for at_once in settled for page in at_once] == [1 + 5 * look for look in range(12)]
    waits = hits - 1 + FILLED
    assert [len(at_once) for at_once in settled] == [0] * waits + [1] * (12 - waits) + [waits]


@pytest.mark.parametrize("gap", [1, 2, 3, 4])
def test_gaps_of_two_looks_are_filled_and_longer_ones_are_not_but_the_identity_lives_on(gap):
    found = pages([{0: 1.0}, {0: 1.0}, *[{}] * gap, {0: 1.0}, {0: 1.0}])
    filled = gap <= FILLED == 2
    assert names(found) == [[1], [1], *[[1] if filled else []] * gap, [1], [1]]
    for look, page in enumerate(found):
        assert page.row.tolist() == ([] if not len(page) else [-1] if 2 <= look < 2 + gap else [0])
        np.testing.assert_allclose(page.box_px, [box(0, look)] if len(page) else np.zeros((0, 4)))


@pytest.mark.parametrize("score", [1.0, 0.8])
def test_the_camera_is_taken_out_of_filled_boxes(score):
    """The target stands still in the scene: each box is the first one, seen from where the camera then was."""
    first, steps = np.array([[100.0, 50, 20, 40]]), [PAN, ZOOM, PAN, ZOOM @ PAN, PAN]
    smoother = FixedLagSmoother(3, True)
    here, truth = first, [first]
    smoother.add(1, np.zeros(1, int), first, np.full(1, score), np.zeros(1, int), None)
    for look, step in enumerate(steps, 2):
        here = transform_boxes(here, step)
        truth.append(here)
        seen = 0 if look in (3, 4) else 1
        smoother.add(look, np.zeros(seen, int), here[:seen], np.full(seen, score), np.zeros(seen, int), step)
    found = smoother.settle(everything=True)
    assert [page.row.tolist() for page in found] == [[0], [0], [-1], [-1], [0], [0]]
    for page, expected in zip(found, truth, strict=True):
        np.testing.assert_allclose(page.box_px, expected, rtol=1e-6)


def noisy(looks: int = 30, score: float = 0.8, missing: Sequence[int] = (), **options: bool) -> tuple[float, float]:
    """Mean distances, of the boxes out and of those in, from a straight walk."""
    random, smoother = np.random.default_rng(5), FixedLagSmoother(3, options.get("smooth", True))
    given, found = {}, []
    for look in range(looks):
        seen = 0 if look in missing else 1
        given[look + 1] = np.array(box(0, look)) + random.normal(0, 4, 4)
        smoother.add(
            look + 1, np.zeros(seen, int), given[look + 1][None][:seen], np.full(seen, score), np.zeros(seen, int), None
        )
        found += smoother.settle()
    found += smoother.settle(everything=True)
    detected = [page for page in found if page.row.tolist() == [0]]
    truth = [np.array(box(0, page.frame - 1)) for page in detected]
    out = np.mean([np.abs(page.box_px[0] - true) for page, true in zip(detected, truth, strict=True)])
    return float(out), float(np.mean([np.abs(given[p.frame] - t) for p, t in zip(detected, truth, strict=True)]))


def test_doubtful_boxes_come_nearer_to_the_truth():
    out, given = noisy()
    assert out < 0.75 * given
    out, given = noisy(missing=(5, 11, 12, 20))
    assert out < 0.75 * given


def test_boxes_stay_as_given_where_they_are_certain_or_smoothing_is_off():
    assert np.subtract(*noisy(score=1.0)) == 0
    assert np.subtract(*noisy(smooth=False)) == 0
    out, given = noisy(score=0.99)
    assert out != given


def test_what_is_kept_does_not_grow_with_the_length_of_a_run():
    """Sightings, pages and steps are dropped once nothing can ask for them."""
    smoother = FixedLagSmoother(3, True)
    sizes = []
    for look in range(400):
        numbers = np.array([0, 1 + look // 4])
        boxes = np.array([box(0, look), box(1, look)])
        smoother.add(look + 1, numbers, boxes, np.full(2, 0.9), np.arange(2), PAN)
        smoother.settle()
        if look in (199, 399):
            observed = [len(past) for past in smoother.observations.values()]
            sizes.append((observed, len(smoother.pending), len(smoother.steps)))
    assert sorted(sizes[0][0]) == sorted(sizes[1][0]) and sizes[0][1:] == sizes[1][1:]


def walk(looks: ArrayLike, growth: float = 0.0) -> np.ndarray:
    """(N, 4) boxes on a straight line whose sides grow by a factor a look."""
    looks = np.asarray(looks, float)
    height = 80 * np.exp(growth * looks)
    centre = np.stack([100 + 9 * looks, 200 - 4 * looks], axis=1)
    size = np.stack([0.4 * height, height], axis=1)
    return np.concatenate([centre - size / 2, size], axis=1)


@settings(max_examples=40, deadline=None)
@given(st.sets(st.integers(0, 9), min_size=2), st.floats(-3, 12), st.floats(-0.1, 0.1))
def test_a_straight_walk_is_hardly_changed_whichever_looks_are_missing(seen, at, growth):
    """Not at all but for the faint pull to no slope, which matters where the looks are few and all on one side."""
    looks = np.array(sorted(seen), float)
    near = np.clip(at, looks[0], looks[-1])
    np.testing.assert_allclose(smooth_box(walk(looks, growth), looks, near), walk([near], growth)[0], atol=0.6)
