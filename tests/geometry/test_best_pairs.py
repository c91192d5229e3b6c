"""Two-frame assignment: one-to-one pairs of the largest sum of scores."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import best_pairs


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 3), st.integers(0, 3), st.data())
def test_pairs_are_one_to_one_and_score_the_most(rows, columns, data):
    entry = st.integers(-4, 9) | st.just(-np.inf)
    score = np.array(data.draw(st.lists(entry, min_size=rows * columns, max_size=rows * columns)), float)
    score = score.reshape(rows, columns)
    found = best_pairs(score)
    padded = np.hstack([score, np.zeros((rows, rows))])
    choices = itertools.permutations(range(columns + rows), rows)
    most = max(sum(padded[i, c] for i, c in enumerate(to)) for to in choices)
    assert len(set(found[:, 0])) == len(set(found[:, 1])) == len(found)
    assert (score[tuple(found.T)] > 0).all() and score[tuple(found.T)].sum() == most


def test_pairs_score_more_than_zero_and_more_than_the_least():
    assert best_pairs(np.array([[2.0, 0.0], [0.0, 5.0]]), least=2.0).tolist() == [[1, 1]]
    assert best_pairs(np.array([[-1.0]]), least=-2.0).shape == (0, 2)


@pytest.mark.parametrize("score", [np.zeros(3), [[np.nan]], [[np.inf]]])
def test_bad_scores_are_refused(score):
    with pytest.raises(InputError, match="best_pairs needs"):
        best_pairs(np.array(score))
