"""Velocities of targets in metres."""

import numpy as np

from torchvision_dddas.geo.aerial_targets import TargetSpeeds

EXACT = 1e-4 * np.eye(2)[None]


def fed(places, times, covariance=EXACT, identity=1, movers=None):
    """The velocities, one a place."""
    movers = movers or TargetSpeeds()
    return np.array(
        [
            movers.update(t, np.array([identity]), np.array([p], float), covariance)[0]
            for t, p in zip(times, places, strict=True)
        ]
    )


def test_a_steady_target_has_its_own_velocity():
    times = np.arange(20) / 10
    found = fed(np.outer(times, [1.5, -0.5]), times)
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[-1], [1.5, -0.5], atol=0.01)


def test_noisy_places_give_a_calmer_velocity_than_their_differences():
    rng, times = np.random.default_rng(0), np.arange(100) / 10
    places = np.outer(times, [1.0, 0.0]) + rng.normal(0, 0.1, (100, 2))
    found = fed(places, times, 0.01 * np.eye(2)[None])[30:]
    differences = np.diff(places, axis=0) * 10
    assert np.abs(found - [1, 0]).mean() < 0.2 * np.abs(differences - [1, 0]).mean()


def test_a_target_that_comes_back_after_long_begins_anew():
    movers = TargetSpeeds()
    fed(np.outer(np.arange(10) / 10, [3.0, 0.0]), np.arange(10) / 10, movers=movers)
    assert np.isnan(fed([[500.0, 0.0]], [60.0], movers=movers)).all()
