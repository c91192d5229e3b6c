"""The size of a change beside its spread over the clips, and how many clips would show it."""

import math

import numpy as np
import pytest
from scipy import stats

from torchvision_dddas.lab.evaluation.metrics.effect_size import count_needed, paired_effect_size


def test_the_effect_has_the_sign_of_the_change_and_no_unit():
    changes = np.array([0.1, 0.3, 0.2])
    ends = np.stack([np.zeros(3), changes], axis=1)
    assert paired_effect_size(ends) == pytest.approx(2)
    assert paired_effect_size(-100 * ends) == pytest.approx(-2)
    assert paired_effect_size(np.r_[ends, [[0.5, np.nan]]]) == pytest.approx(2)


@pytest.mark.parametrize("ends", [np.zeros((0, 2)), [[0, 1], [0, 2]], [[0, 1], [1, 2], [2, 3]]])
def test_few_clips_and_equal_changes_have_no_effect_size(ends):
    assert math.isnan(paired_effect_size(np.array(ends, float)))


# Cohen's d_z at a two-sided level of 0.05 and a power of 0.8, as G*Power 3.1 gives them.
@pytest.mark.parametrize(("effect", "count"), [(0.2, 199), (0.5, 34), (-0.8, 15)])
def test_the_number_of_clips_is_that_of_published_tables(effect, count):
    assert count_needed(effect) == count


def test_a_paired_t_test_of_so_many_clips_has_the_power():
    rng, count = np.random.default_rng(0), count_needed(0.9, 0.01)
    assert count is not None
    p = np.asarray(stats.ttest_1samp(rng.normal(0.9, 1, (4000, count)), 0, axis=1).pvalue)
    assert np.mean(p < 0.01) == pytest.approx(0.8, abs=0.04)


def test_no_effect_and_a_tiny_one_need_no_number():
    assert count_needed(math.nan) is None and count_needed(1e-5) is None
