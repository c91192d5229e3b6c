"""The fixed-lag smoother: confirmation, gaps, identities and smoothed boxes."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from torchvision_dddas.tracking.kalman import transform_boxes
from torchvision_dddas.tracking.smoother import FILLED, FixedLagSmoother, smooth_boxes
from torchvision_dddas.types import Tracks

PAN = np.array([[1.0, 0, 7], [0, 1, -3], [0, 0, 1]])
ZOOM = np.array([[1.2, 0, -30], [0, 1.2, -20], [0, 0, 1]])


def box(number: int, step: int) -> list[float]:
    """Each track walks to the right on a line of its own."""
    return [10.0 * step, 100.0 * number, 20, 40]


def settled(frames, hits: int = 3) -> list[list[Tracks]]:
    """What each of frames 1, 6, 11, ... settled, and the end. frames: the score of track 0, or None."""
    smoother, out = FixedLagSmoother(hits, False), []
    for k, score in enumerate(frames):
        n = 0 if score is None else 1
        boxes, scores = np.array([box(0, k)] * n).reshape(-1, 4), np.array([score] * n, float)
        smoother.add(1 + 5 * k, np.zeros(n, int), boxes, scores, np.arange(n), None)
        out.append(smoother.settle())
    return [*out, smoother.settle(everything=True)]


@pytest.mark.parametrize("hits", [1, 3, 5])
def test_each_frame_is_settled_once_in_order_as_soon_as_no_later_frame_can_change_it(hits):
    out = settled([0.9] * 12, hits)
    assert [page.frame for at_once in out for page in at_once] == [1 + 5 * k for k in range(12)]
    waits = hits - 1 + FILLED
    assert [len(at_once) for at_once in out] == [0] * waits + [1] * (12 - waits) + [waits]


@pytest.mark.parametrize("gap", [1, 2, 3, 4])
def test_gaps_of_two_frames_are_filled_and_the_identity_survives_longer_ones(gap):
    found = [page for at_once in settled([1.0, 1.0, *[None] * gap, 1.0, 1.0]) for page in at_once]
    middle = [([1], [-1])] if gap <= FILLED == 2 else [([], [])]
    wanted = [([1], [0])] * 2 + middle * gap + [([1], [0])] * 2
    assert [(page.identity.tolist(), page.row.tolist()) for page in found] == wanted
    for k, page in enumerate(found):
        np.testing.assert_allclose(page.box_px, [box(0, k)] * len(page.row) if len(page) else np.zeros((0, 4)))


def test_confidence_of_links_stays_with_its_box_and_filled_boxes_have_none():
    smoother, given = FixedLagSmoother(2, True), [[np.nan, np.nan], [0.9, 0.5], [0.625], [0.25, 0.75], None]
    for k, link in enumerate(given):
        numbers = np.arange(2 if link is None else len(link))
        boxes, scores = np.array([box(number, k) for number in numbers.tolist()]), np.full(len(numbers), 0.8)
        smoother.add(k + 1, numbers, boxes, scores, numbers, None, None if link is None else np.array(link))
    found = [dict(zip(page.identity.tolist(), page.link.tolist(), strict=True)) for page in smoother.settle(True)]
    wanted = [(np.nan, np.nan), (0.9, 0.5), (0.625, np.nan), (0.25, 0.75), (np.nan, np.nan)]
    np.testing.assert_array_equal([(page[1], page[2]) for page in found], wanted)


@pytest.mark.parametrize("score", [1.0, 0.8])
def test_filled_boxes_account_for_the_camera(score):
    """The target stands still in the scene: each box is the first one, seen from where the camera then was."""
    smoother, truth = FixedLagSmoother(3, True), [np.array([[100.0, 50, 20, 40]])]
    for number, step in enumerate([None, PAN, ZOOM, PAN, ZOOM @ PAN, PAN], 1):
        if step is not None:
            truth.append(transform_boxes(truth[-1], step))
        n = 0 if number in (3, 4) else 1
        smoother.add(number, np.zeros(n, int), truth[-1][:n], np.full(n, score), np.zeros(n, int), step)
    found = smoother.settle(everything=True)
    assert [page.row.tolist() for page in found] == [[0], [0], [-1], [-1], [0], [0]]
    for page, expected in zip(found, truth, strict=True):
        np.testing.assert_allclose(page.box_px, expected, rtol=1e-6)


def smoothing(score: float = 0.8, missing: Sequence[int] = (), smooth: bool = True) -> tuple[float, float]:
    """Mean distances, of the boxes out and of those in, from a straight walk."""
    random, smoother, given, found = np.random.default_rng(5), FixedLagSmoother(3, smooth), {}, []
    for k in range(30):
        n = 0 if k in missing else 1
        given[k + 1] = np.array(box(0, k)) + random.normal(0, 4, 4)
        smoother.add(k + 1, np.zeros(n, int), given[k + 1][None][:n], np.full(n, score), np.zeros(n, int), None)
        found += smoother.settle()
    pages = [page for page in found + smoother.settle(everything=True) if page.row.tolist() == [0]]
    truth = np.array([box(0, page.frame - 1) for page in pages])
    out, into = (np.array(boxes) - truth for boxes in ([p.box_px[0] for p in pages], [given[p.frame] for p in pages]))
    return float(np.abs(out).mean()), float(np.abs(into).mean())


@pytest.mark.parametrize(
    ("options", "low", "high"),
    [
        ({}, 0.1, 0.75),
        ({"missing": (5, 11, 12, 20)}, 0.1, 0.75),
        ({"score": 0.99}, 0.1, 0.9999),
        ({"score": 1.0}, 1, 1),  # a certain box stays
        ({"smooth": False}, 1, 1),
    ],
)
def test_smoothing_brings_uncertain_boxes_nearer_to_the_truth(options, low, high):
    out, given = smoothing(**options)
    assert low <= out / given <= high


def test_memory_does_not_grow_with_the_length_of_a_run():
    smoother, sizes = FixedLagSmoother(3, True), []
    for k in range(400):
        boxes, numbers = np.array([box(0, k), box(1, k)]), np.array([0, 1 + k // 4])
        smoother.add(k + 1, numbers, boxes, np.full(2, 0.9), np.arange(2), PAN)
        smoother.settle()
        observed = sorted(len(past) for past in smoother.observations.values())
        sizes.append((observed, len(smoother.pending), len(smoother.steps)))
    assert sizes[199] == sizes[399]


def walk(steps: ArrayLike, growth: float = 0.0) -> np.ndarray:
    """(N, 4) boxes on a straight line whose sides grow by a factor a step."""
    steps = np.asarray(steps, float)
    centre = np.stack([100 + 9 * steps, 200 - 4 * steps], axis=1)
    size = 80 * np.exp(growth * steps)[:, None] * [0.4, 1]
    return np.concatenate([centre - size / 2, size], axis=1)


@settings(max_examples=40, deadline=None)
@given(st.sets(st.integers(0, 9), min_size=2), st.floats(-3, 12), st.floats(-0.1, 0.1))
def test_a_straight_walk_is_hardly_changed_whatever_is_missing(seen, at, growth):
    steps = np.array(sorted(seen), float)
    near = np.clip(at, steps[0], steps[-1])
    # The tolerance is for the faint pull to no slope, which moves two steps alone most where they are far apart.
    found = smooth_boxes(walk(steps, growth), steps - near, np.array([0]))
    np.testing.assert_allclose(found, walk([near], growth), atol=0.4 if len(steps) > 2 else 1.5)
