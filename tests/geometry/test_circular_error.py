"""The 90 % circular error of an ellipse, and its category."""

import numpy as np
import pytest

from torchvision_dddas.geometry import circular_error_90, error_category


@pytest.mark.parametrize("shorter", [0.0, 0.1, 0.5, 1.0])
def test_nine_tenths_of_normal_errors_lie_in_the_circle(shorter):
    off = np.random.default_rng(0).normal(0, 3, (400_000, 2)) * [1, shorter]
    radius = circular_error_90(np.array([[3.0, 3.0 * shorter]]))
    assert (np.linalg.norm(off, axis=1) < radius).mean() == pytest.approx(0.9, abs=0.002)


def test_categories_end_at_20_50_100_300_and_1000_feet():
    feet = np.array([0, 20, 21, 50, 51, 100, 101, 300, 301, 1000, 1001, np.nan])
    numbers = ["I", "I", "II", "II", "III", "III", "IV", "IV", "V", "V", "VI"]
    assert error_category(feet * 0.3048).tolist() == [*(f"CAT {number}" for number in numbers), ""]


def test_an_unknown_ellipse_has_no_error():
    assert np.isnan(circular_error_90(np.full((1, 2), np.nan))).all()
