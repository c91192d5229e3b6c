"""Spreading evidence along flat regions."""

import numpy as np
import pytest

from torchvision_dddas.detection.outlines import smooth_along_edges


def step_guide(height=31, width=41, at=20):
    guide = np.zeros((height, width, 3), np.uint8)
    guide[:, at:] = 200
    return guide


def test_constant_evidence_stays_constant():
    evidence = np.full((31, 41, 2), (0.3, 0.7), np.float32)
    np.testing.assert_allclose(smooth_along_edges(evidence, step_guide(), 30, 80), evidence, atol=1e-5)


def test_evidence_spreads_over_a_flat_region_and_stops_at_its_edge():
    evidence = np.zeros((31, 41, 1), np.float32)
    evidence[15, 10] = 1
    after = smooth_along_edges(evidence, step_guide(), 30, 80)[..., 0]
    assert after[15, 19] > 20 * after[15, 20]
    assert after[15, 19] > 0


def test_without_edges_it_reaches_as_far_to_either_side():
    evidence = np.zeros((81, 81, 1), np.float32)
    evidence[40, 40] = 1
    after = smooth_along_edges(evidence, np.zeros((81, 81), np.uint8), 10, 80)[..., 0]
    # The borders, which one sweep meets before the other, tilt it a little.
    np.testing.assert_allclose(after[40, 25:56], after[40, 55:24:-1], rtol=0.02)
    np.testing.assert_allclose(after[25:56, 40], after[55:24:-1, 40], rtol=0.02)
    assert after.argmax() == 40 * 81 + 40


def test_a_longer_reach_spreads_further():
    evidence = np.zeros((31, 41, 1), np.float32)
    evidence[15, 20] = 1
    flat = np.zeros((31, 41), np.uint8)
    near, far = (smooth_along_edges(evidence, flat, reach, 80)[15, :, 0] for reach in (3, 12))
    assert far[32] / far[20] > 5 * near[32] / near[20]


def test_channels_do_not_mix_and_the_input_is_left_alone():
    evidence = np.random.default_rng(0).random((13, 17, 2)).astype(np.float32)
    before = evidence.copy()
    guide = np.random.default_rng(1).integers(0, 256, (13, 17, 3)).astype(np.uint8)
    both = smooth_along_edges(evidence, guide, 10, 80)
    np.testing.assert_array_equal(evidence, before)
    for k in range(2):
        np.testing.assert_allclose(
            both[..., k], smooth_along_edges(evidence[..., k : k + 1], guide, 10, 80)[..., 0], atol=1e-6
        )


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (7, 1)])
def test_pictures_of_one_row_or_column_work(shape):
    after = smooth_along_edges(np.ones((*shape, 1), np.float32), np.zeros(shape, np.uint8), 10, 80)
    np.testing.assert_allclose(after, 1, atol=1e-6)


def test_a_grey_picture_stops_the_spread_like_the_same_picture_in_colour():
    grey = np.random.default_rng(1).integers(0, 256, (13, 17)).astype(np.uint8)
    evidence = np.random.default_rng(0).random((13, 17, 2)).astype(np.float32)
    in_colour = smooth_along_edges(evidence, np.dstack([grey] * 3), 10, 80)
    np.testing.assert_allclose(smooth_along_edges(evidence, grey, 10, 80), in_colour, atol=1e-6)
