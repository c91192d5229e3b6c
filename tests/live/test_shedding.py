"""Looks that take too long are made cheaper or fewer, the settings between frames with them."""

from typing import Any

import numpy as np
import pytest

from tests.live.streams import FakeClock
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.live import Health, LoadShedding
from torchvision_dddas.types import Adjustment, Frame

BASE = with_parameters(
    Settings(),
    {"registration.keypoints": 400, "live.least_keypoints": 100, "live.maximum_every": 4, "live.load": 0.8},
)


class Source(Any):
    """A live source whose looks take what a test says."""

    def __init__(self) -> None:
        self.apart_s, self.busy_s, self.every = 0.04, 0.0, 1

    def look_at(self, every: int) -> None:
        self.every = every


def fed(shedding: LoadShedding, source: Source, costs_s: list[float], clock: FakeClock) -> list[Adjustment]:
    moved: list[Adjustment] = []
    for number, cost_s in enumerate(costs_s, start=1):
        _, some = shedding(Frame(number, 0.0, np.zeros((2, 2), np.uint8)))
        moved += some
        source.busy_s = cost_s
        clock.now_s += source.apart_s * source.every
    return moved


def test_a_single_long_look_sheds_nothing() -> None:
    source, clock = Source(), FakeClock()
    shedding = LoadShedding(source, BASE, clock=clock)
    assert fed(shedding, source, [0.02] * 20 + [2.0] + [0.02] * 20, clock) == []
    assert shedding.settings is BASE


def test_long_looks_change_settings_and_the_source_and_are_told() -> None:
    source, clock, health = Source(), FakeClock(), Health()
    shedding = LoadShedding(source, BASE, health, clock=clock)
    moved = fed(shedding, source, [0.1] * 7, clock)
    assert {(a.parameter, a.new) for a in moved} == {("registration.keypoints", 100), ("sampling.every", 4)}
    assert shedding.settings.registration.keypoints == 100
    assert shedding.settings == with_parameters(BASE, {"registration.keypoints": 100})
    assert source.every == 4
    told = health.snapshot()
    assert (told.gauges["every"], told.gauges["keypoints"]) == (4, 100)
    assert [event.kind for event in told.events] == ["load"]
    assert "keypoints 400 -> 100" in told.events[0].text
    assert "100 ms" in told.events[0].text


def test_what_was_measured_before_a_change_does_not_count_after_it() -> None:
    source, clock = Source(), FakeClock()
    shedding = LoadShedding(source, BASE, clock=clock)
    moved = fed(shedding, source, [0.036] * 6 + [0.02] * 30, clock)
    assert [(a.parameter, a.new) for a in moved] == [("registration.keypoints", 200)]


def test_a_burst_is_over_and_all_is_as_it_was() -> None:
    source, clock = Source(), FakeClock()
    shedding = LoadShedding(source, BASE, clock=clock)
    fed(shedding, source, [0.1] * 10, clock)
    assert source.every == 4
    fed(shedding, source, [0.01] * 800, clock)
    assert source.every == 1
    assert shedding.settings.registration.keypoints == 400


def test_people_are_searched_for_less_widely_before_pictures_are_left_out() -> None:
    settings = with_parameters(BASE, {"people.search": "regions"})
    source, clock = Source(), FakeClock()
    shedding = LoadShedding(source, settings, people=True, clock=clock)
    moved = fed(shedding, source, [0.036] * 22, clock)
    assert [(a.parameter, a.new) for a in moved if a.parameter.startswith("people")][:1] == [("people.look_share", 0.5)]
    assert source.every == 1
    assert shedding.settings.people.look_share < settings.people.look_share


@pytest.mark.parametrize("keypoints", [60, 150])
def test_other_settings_between_frames_are_what_the_next_frames_are_seen_with(keypoints: int) -> None:
    rng = np.random.default_rng(3)
    ground = rng.integers(0, 255, (140, 200), np.uint8).repeat(2, 0).repeat(2, 1)
    frames = [Frame(k + 1, k / 10, np.ascontiguousarray(ground[:240, k : 320 + k])) for k in range(14)]
    later = with_parameters(BASE, {"registration.keypoints": keypoints})
    record = Adjustment(8, "registration.keypoints", 400, keypoints, "a test")

    def retune(frame: Frame) -> tuple[Settings, tuple[Adjustment, ...]]:
        return (BASE, ()) if frame.number < 8 else (later, (record,) if frame.number == 8 else ())

    class Clip(list):
        rate_hz = 10.0

    scenes = list(detect_motion(Clip(frames), BASE, "onboard", retune=retune))
    assert [scene.frame.number for scene in scenes] == list(range(1, 15))
    assert [record in scene.adjustments for scene in scenes] == [n == 8 for n in range(1, 15)]
    assert all(scene.reliable for scene in scenes)
    tracked = [scene.step.tracked for scene in scenes[1:] if scene.step is not None]
    assert min(tracked[:6]) > keypoints
    assert max(tracked[6:]) <= keypoints
