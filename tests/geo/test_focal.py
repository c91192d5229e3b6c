"""The focal length from people of known height."""

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.camera_calibration import calibrate_focal_length


def test_eq_13_gives_the_focal_length_of_one_measurement():
    found = calibrate_focal_length(np.array([9.0]), np.array([200.0]), 1.8)
    assert found.focal_px == pytest.approx(1000)
    assert np.isnan(found.spread_px) and found.sigma_px == pytest.approx(30)


def test_an_outlier_is_said_and_not_used():
    height = np.array([180.0, 181.0, 179.0, 120.0, 180.0])
    found = calibrate_focal_length(np.full(5, 10.0), height, 1.8)
    assert found.outlier.tolist() == [False, False, False, True, False]
    assert found.focal_px == pytest.approx(1000)
    assert found.spread_px == pytest.approx(1000 * np.std([180, 181, 179, 180], ddof=1) / 180)


def test_more_measurements_are_surer_but_never_surer_than_a_hundredth():
    rng = np.random.default_rng(0)
    sigma = [calibrate_focal_length(np.full(n, 10.0), rng.normal(180, 9, n), 1.8).sigma_px for n in (4, 16, 1000)]
    assert sigma[0] > sigma[1] > sigma[2]
    assert sigma[2] == pytest.approx(10, rel=0.01)


@pytest.mark.parametrize(
    ("distance", "height", "body", "words"),
    [
        ([], [], 1.8, "no measurement to calibrate by"),
        ([0.0], [100.0], 1.8, "a distance of 0 will not do"),
        ([5.0], [np.nan], 1.8, "a height in pixels of nan will not do"),
        ([5.0], [100.0], -1.8, r"a body height of -1\.8 will not do"),
    ],
)
def test_what_cannot_calibrate_is_named(distance, height, body, words):
    with pytest.raises(InputError, match=words):
        calibrate_focal_length(np.array(distance), np.array(height), body)
