"""What a tracker learns of its scene, from walks of known step, count and misses."""

import numpy as np
import pytest

from torchvision_dddas.tracking.scene import SceneStatistics

SIZE = (3000.0, 800.0)
HEIGHT = 80.0


def crowd(look: int, step: float, noise: float = 0.0, count: int = 12) -> np.ndarray:
    """(N, 4) people 80 px high, far apart, who walk so many heights a look. noise: sd of places, half of sizes'."""
    random = np.random.default_rng(look)
    angle = np.arange(count)
    middle = np.stack([240.0 * (angle % 12), 150.0 + 300.0 * (angle // 12)], axis=1)
    middle = middle + HEIGHT * step * look * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    middle = middle + random.normal(0, noise * HEIGHT, middle.shape)
    size = HEIGHT * np.exp(random.normal(0, 2 * noise, count))[:, None] * [0.4, 1]
    return np.concatenate([middle - size / 2, size], axis=1)


def learned(step: float, noise: float = 0.0, looks: int = 20, gap: int = 1) -> SceneStatistics:
    scene = SceneStatistics(SIZE)
    for look in range(0, looks * gap, gap):
        before = crowd(look - gap, step, noise) if look else None
        scene.add_look(before, crowd(look, step, noise), gap)
    return scene


@pytest.mark.parametrize("step", [0.05, 0.2, 0.6])
@pytest.mark.parametrize("gap", [1, 2])
def test_the_step_of_walkers_is_found_at_any_gap_and_with_strangers_about(step, gap):
    assert step / 1.6 < learned(step, gap=gap).step < 1.6 * step
    scene = SceneStatistics(SIZE)
    for look in range(1, 20):  # every other look has people whom its neighbours have not
        stranger = np.array([[50.0 * look, 700.0, 32, 80]])
        before, now = crowd(look - 1, step), crowd(look, step)
        with_stranger = [np.concatenate([boxes, stranger]) for boxes in (before, now)]
        scene.add_look(*((with_stranger[0], now) if look % 2 else (before, with_stranger[1])), 1)
    assert step / 1.6 < scene.step < 1.6 * step


def test_noise_of_boxes_hardly_counts_as_a_step():
    still, walking = learned(0.0, noise=0.04).step, learned(0.3, noise=0.04).step
    assert still < 0.1 < 0.2 < walking < 0.45
    assert learned(0.0).step > 0  # nobody moves: no score may divide by zero


def test_the_missing_share_and_the_turnover_follow_the_decisions():
    random, scene, before = np.random.default_rng(0), SceneStatistics(SIZE), SceneStatistics(SIZE).state(0)
    for look in range(300):
        scene.add_look(None, crowd(look, 0.1)[:10], 1)
        scene.add_links(random.geometric(0.7, 10) - 1, births=look % 2)
    after = scene.state(300)
    assert 0.2 < after.missing < 0.35 and 0.04 < after.turnover < 0.06
    assert 0 < before.missing < 1 and before.turnover > 0
    hidden = SceneStatistics(SIZE)
    hidden.add_links(np.full(50, 40), births=0)
    assert hidden.state(0).missing <= before.missing  # long gaps are no misses of the detector


@pytest.mark.parametrize("size", [SIZE, None])
def test_the_density_is_the_count_over_the_picture_or_over_where_targets_were_seen(size):
    few, many = SceneStatistics(size), SceneStatistics(size)
    for look in range(40):
        boxes = crowd(look, 0)
        few.add_look(None, boxes, 1)
        many.add_look(None, np.concatenate([boxes, boxes]), 1)
    assert many.state(40).density == pytest.approx(2 * few.state(40).density)
    in_picture = 12 / (SIZE[0] * SIZE[1])
    assert few.state(40).density == pytest.approx(in_picture) if size else few.state(40).density > in_picture


def test_a_scene_without_targets_has_a_usable_state():
    for size in (SIZE, None):
        scene = SceneStatistics(size)
        scene.add_look(None, np.zeros((0, 4)), 1.0)
        scene.add_look(np.zeros((0, 4)), np.zeros((0, 4)), 1.0)
        scene.add_links(np.zeros(0), 0)
        state = scene.state(2)
        assert min(state.step, state.density, state.missing, state.turnover) > 0
