"""The camera's step from the boxes alone."""

import numpy as np
import pytest

from torchvision_dddas.config import Settings
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.box_motion import candidate_shifts, likelier_shift, medians
from torchvision_dddas.tracking.kalman import HEIGHT, X, Y
from torchvision_dddas.tracking.scene import SceneState
from torchvision_dddas.tracking.scores import BoxLook, association_scores, newborn_scores

KNOBS = Settings().track
SCENE = SceneState(time=1, step=0.1, density=1e-5, missing=0.1, turnover=0.02)


def boxes(centre: np.ndarray, height: float = 80.0) -> np.ndarray:
    size = np.broadcast_to(height * np.array([0.4, 1.0]), centre.shape)
    return np.concatenate([centre - size / 2, size], axis=1)


def crowd(seed: int, count: int = 9) -> np.ndarray:
    return np.random.default_rng(seed).uniform((0, 0), (1200, 800), (count, 2))


def found(before: np.ndarray, now: np.ndarray, newborn: bool = False) -> np.ndarray | None:
    """The shift between centres of people 80 px high. newborn: seen once before; else their velocity is known."""
    state = kalman.start(boxes(before), -1, KNOBS.scatter, SCENE.step)
    if not newborn:
        state = kalman.update(kalman.predict(state, 0, KNOBS.wander * SCENE.step), boxes(before), 0, KNOBS.scatter)
    at_rest = np.zeros((1, len(state), 2))

    def scores(shift: np.ndarray) -> np.ndarray:
        moved = state.copy()
        moved[:, : Y + 1] += shift
        look = BoxLook.of(moved, np.zeros(len(moved)), boxes(now), SCENE, KNOBS)
        return newborn_scores(look, KNOBS, at_rest) if newborn else association_scores(look, KNOBS)

    shifts = candidate_shifts(state[:, [X, Y]], state[:, HEIGHT], now, np.full(len(now), 80.0))
    chosen = likelier_shift(scores(np.zeros(2)), [scores(shift) for shift in shifts], newborn) if shifts else None
    return None if chosen is None else shifts[chosen]


@pytest.mark.parametrize("newborn", [False, True])
@pytest.mark.parametrize("pan", [(100, -40), (-200, 150)])
@pytest.mark.parametrize("seed", range(3))
def test_a_pan_is_found_though_targets_walk_come_and_go(seed, pan, newborn):
    random, before = np.random.default_rng(seed), crowd(seed)
    now = np.concatenate([before[1:] + pan + random.normal(0, 3, (8, 2)), crowd(seed + 100, 2)])
    shift = found(before, random.permutation(now), newborn)
    assert shift is not None
    np.testing.assert_allclose(shift, pan, atol=8)


@pytest.mark.parametrize("newborn", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_no_shift_is_seen_where_targets_stand_or_walk_about(seed, newborn):
    random, before = np.random.default_rng(seed), crowd(seed)
    assert found(before, before + random.normal(0, 3, before.shape), newborn) is None
    assert found(before, before + random.normal(0, 12, before.shape), newborn) is None
    assert found(crowd(seed, 30), crowd(seed + 100, 30), newborn) is None  # a cut: nothing is in common


@pytest.mark.parametrize("newborn", [False, True])
def test_a_row_of_equally_spaced_vehicles_that_moves_on_is_not_shifted_to_the_next_one(newborn):
    row = np.stack([120.0 * np.arange(8), np.full(8, 300.0)], axis=1)
    for step in (0, 10):
        shift = found(row, row + np.array([step, 0]), newborn)
        assert shift is None or np.abs(shift).max() < 20


def test_too_few_targets_show_no_shift():
    few = crowd(0, 2)
    assert found(few, few + 100) is None and found(few[:0], few) is None and found(crowd(0), few[:0]) is None


@pytest.mark.parametrize("shape", [(1, 2), (2, 2), (7, 2), (8,)])
def test_medians_are_numpys(shape):
    values = np.random.default_rng(len(shape)).normal(0, 5, shape)
    np.testing.assert_array_equal(medians(values), np.median(values, axis=0))
