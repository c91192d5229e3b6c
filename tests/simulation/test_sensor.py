"""The sensor: noise of the strength asked for, exposure that drifts within its bounds, the same for the same number."""

from typing import Any

import numpy as np
import pytest

from torchvision_dddas.simulation import CameraParameters
from torchvision_dddas.simulation.sensors import Sensor

SIZE = (320, 240)
CLEAR = {"sharpness_px": 0, "shot_noise": 0, "read_noise": 0, "drift": 0, "quality": 100}


def sensor(seed: int = 0, stream: int = 0, **parameters: Any) -> Sensor:
    return Sensor(CameraParameters.model_validate({**CLEAR, **parameters}), SIZE, seed, stream)


def grey(level: int) -> np.ndarray:
    return np.full((SIZE[1], SIZE[0], 3), level, np.uint8)


@pytest.mark.parametrize("level", [40, 160])
def test_the_variance_of_the_noise_grows_with_the_light(level):
    noisy = sensor(shot_noise=0.15, read_noise=2.0).expose(grey(level), 1, 0.0)
    assert noisy.astype(float).var() == pytest.approx(0.15 * level + 4 + 1 / 12, rel=0.03)
    assert noisy.mean() == pytest.approx(level, abs=0.1)


def test_the_noise_of_one_picture_says_nothing_of_the_next():
    camera = sensor(read_noise=3.0)
    pictures = [camera.expose(grey(100), number, 0.0).astype(float).ravel() for number in range(1, 9)]
    alike = np.corrcoef(pictures) - np.eye(8)
    assert np.abs(alike).max() < 0.02


def test_exposure_drifts_slowly_and_no_further_than_asked():
    camera = sensor(drift=0.1)
    gain = np.array([camera.gain(t) for t in np.arange(0, 300, 0.1)])
    assert gain.min() >= 0.9
    assert gain.max() <= 1.1
    assert np.ptp(gain) > 0.1
    assert np.abs(np.diff(gain)).max() < 0.01


def test_a_picture_depends_on_seed_stream_and_number_and_on_nothing_before_it():
    parameters: dict[str, Any] = {
        "shot_noise": 0.2,
        "read_noise": 1.0,
        "drift": 0.05,
        "quality": 90,
        "sharpness_px": 0.6,
    }
    first, second = sensor(3, **parameters), sensor(3, **parameters)
    first.expose(grey(90), 1, 0.1)
    assert np.array_equal(first.expose(grey(90), 2, 0.2), second.expose(grey(90), 2, 0.2))
    for other in (sensor(4, **parameters), sensor(3, stream=1, **parameters)):
        assert not np.array_equal(other.expose(grey(90), 2, 0.2), second.expose(grey(90), 2, 0.2))
    assert not np.array_equal(second.expose(grey(90), 3, 0.2), second.expose(grey(90), 2, 0.2))
