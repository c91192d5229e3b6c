"""Noise of which the ground is made: of the spread and width asked for, and the same however it is cut."""

import numpy as np
import pytest

from torchvision_dddas.simulation.soil import enlarge_rows, fractal_noise, noise_band, noise_bumps, noise_sparks


@pytest.mark.parametrize("width_px", [1, 3, 8])
def test_rows_are_the_same_in_whatever_bands_they_are_made(width_px):
    whole = noise_band((4, 1), (-30, 200), 90, width_px)
    parts = [noise_band((4, 1), rows, 90, width_px) for rows in ((-30, -7), (-7, 64), (64, 129), (129, 200))]
    assert np.concatenate(parts) == pytest.approx(whole, abs=1e-5)
    assert np.array_equal(
        np.concatenate([noise_sparks((4, 2), rows, 90, 0.1) for rows in ((-30, 11), (11, 200))]),
        noise_sparks((4, 2), (-30, 200), 90, 0.1),
    )


def test_another_seed_gives_other_rows():
    assert not np.array_equal(noise_band((4, 1), (0, 20), 30, 2), noise_band((4, 2), (0, 20), 30, 2))


@pytest.mark.parametrize("width_px", [1, 2, 4, 8])
def test_noise_has_a_spread_near_one_and_bumps_of_the_width(width_px):
    noise = noise_band((1, 1), (0, 400), 400, width_px)
    assert noise.std() == pytest.approx(1, abs=0.2)
    assert noise.mean() == pytest.approx(0, abs=0.08)
    alike = np.corrcoef(noise[:, width_px * 2 :].ravel(), noise[:, : -width_px * 2].ravel())[0, 1]
    assert abs(alike) < 0.15
    if width_px > 1:
        assert np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1] > 0.5


@pytest.mark.parametrize("widest_px", [1.0, 7.3, 40.0])
def test_patches_have_the_shape_and_spread_asked_for(widest_px):
    rng = np.random.default_rng(0)
    assert noise_bumps(rng, (50, 70), widest_px).shape == (50, 70)
    made = fractal_noise(rng, (500, 300), widest_px, 1)
    assert made.shape == (500, 300)
    assert made.std() == pytest.approx(1, abs=0.25)


def test_as_many_sparks_as_asked_for():
    drawn = noise_sparks((3,), (0, 500), 500, 0.02)
    assert np.mean(drawn > 0) == pytest.approx(0.02, rel=0.1)
    assert drawn[drawn > 0].min() >= 0.29
    assert drawn.max() <= 1


@pytest.mark.parametrize("smooth", [False, True])
def test_an_enlarged_slope_stays_a_slope_at_the_middles_of_pixels(smooth):
    coarse = np.tile(np.arange(12, dtype=np.float32)[:, None], (1, 9))
    whole = enlarge_rows(coarse, (0, 96), 8, smooth)
    assert whole.shape == (96, 72)
    assert whole[20:70, 30] == pytest.approx((np.arange(20, 70) + 0.5) / 8 - 0.5, abs=0.06 if smooth else 1e-4)
    assert np.array_equal(enlarge_rows(coarse, (37, 61), 8, smooth), whole[37:61])
