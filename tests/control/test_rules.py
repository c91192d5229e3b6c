"""The feedback rules, by hand."""

import numpy as np
import pytest

from torchvision_dddas.config import LiveParameters, Settings, SteeringParameters, with_parameters
from torchvision_dddas.control.rules import SAMPLING, Load, every_wanted, rungs, sampled, shed
from torchvision_dddas.types import Adjustment

EVERY = SteeringParameters(sampling_share=0.5, maximum_every=6)


def test_between_two_looks_no_target_moves_by_more_than_half_its_size_nor_a_walker_by_1_m_while_none_is_found():
    """4 m at 10 m/s and 10 Hz: 2 m in two frames, and a slow one does not matter; half of 1 m at 1.4 m/s: 3.6."""
    none = np.zeros(0)
    assert every_wanted(8.0, 10, none, none, EVERY) == (3.0, "; no target is known yet")
    assert every_wanted(8.0, 10, np.array([np.nan]), np.array([2.0]), EVERY)[0] == 3.0
    assert every_wanted(4.0, 10, none, none, EVERY) == (2.0, "")
    wanted, why = every_wanted(8.0, 10, np.array([0.5, 10.0]), np.array([2.0, 4.0]), EVERY)
    assert wanted == 2.0 and why == "; a target of 4.0 m moves at 10.0 m/s"
    assert every_wanted(8.0, 10, np.array([1e9]), np.array([1.0]), EVERY)[0] == 1.0


@pytest.mark.parametrize(("wanted", "every"), [(0.0, 1), (3.2, 3), (1e30, 6)])
def test_the_sampling_is_rounded_and_bounded_and_its_change_recorded(wanted, every):
    record = (Adjustment(5, SAMPLING, 1, every, "altitude 50 m"),)
    assert sampled(5, 1, wanted, "altitude 50 m", EVERY) == (every, record if every > 1 else ())


LIVE = with_parameters(
    Settings(live=LiveParameters(least_keypoints=100, maximum_every=4, load=0.8, calm_s=5.0, deadline_ms=1000)),
    {"registration.keypoints": 400, "people.search": "regions"},
)
APART_S = 0.04


def driven(cost_ms, looks, now=None, start_s=0.0):
    """The rule at every look from start_s on, where a look at everything takes cost_ms and half the keypoints 80 %."""
    moved: list[Adjustment] = []
    now, time_s = now or Load(), start_s
    for k in range(looks):
        rung = rungs(LIVE)[now.rung]
        cheaper = 0.8 ** np.log2(400 / rung["registration.keypoints"])
        now, some = shed(k + 1, now, cost_ms / 1000 * cheaper, APART_S, time_s, LIVE)
        moved += some
        time_s += rung[SAMPLING] * APART_S
    return now, moved, time_s


def test_keypoints_are_halved_to_the_least_then_the_search_narrows_then_pictures_are_left_out():
    names = ("registration.keypoints", "people.look_share", SAMPLING)
    shares = [(400, 1, 1), (200, 1, 1), (100, 1, 1), (100, 0.5, 1), (100, 0.25, 1), (100, 0.125, 1)]
    wanted = [*shares, (100, 0.125, 2), (100, 0.125, 3), (100, 0.125, 4)]
    assert [tuple(rung[name] for name in names) for rung in rungs(LIVE, people=True)] == wanted


def test_too_long_a_look_is_shed_until_it_fits_and_more_is_looked_at_again_after_calm_s_with_time_to_spare():
    busy, moved, _ = driven(36, 200)
    assert [(a.parameter, a.old, a.new) for a in moved] == [("registration.keypoints", 400, 200)]
    assert "36 ms" in moved[0].cause and "90%" in moved[0].cause and busy.rung == 1
    busy, _, end_s = driven(36, 20)
    early, moved, _ = driven(15, 124, busy, end_s)
    assert early.rung == busy.rung and not moved
    calm, moved, _ = driven(15, 130, busy, end_s)
    assert calm.rung == 0
    assert [(a.parameter, a.old, a.new) for a in moved] == [("registration.keypoints", 200, 400)]


def test_each_try_that_did_not_last_makes_the_next_one_wait_twice_as_long():
    """Half the keypoints take a third here: more than the rule expects of them, so that it falls for it."""
    now, tries = Load(), []
    for k in range(3000):
        cost_s = 0.036 if now.rung == 0 else 0.012
        now, moved = shed(k + 1, now, cost_s, APART_S, k * APART_S, LIVE)
        tries += [k * APART_S for a in moved if a.new > a.old]
    waits = np.diff(tries)
    assert np.all(waits[:3] > 1.9 * np.array([5.0, *waits[:2]]))


@pytest.mark.parametrize(("apart_s", "on"), [(0.0, True), (APART_S, False)])
def test_nothing_is_shed_where_pictures_wait_or_it_is_turned_off(apart_s, on):
    settings = with_parameters(LIVE, {"live.shed": on})
    assert shed(1, Load(), 10.0, apart_s, 0.0, settings) == (Load(), ())


def test_far_too_long_a_look_is_shed_at_once_and_pictures_left_out_come_back_as_many_as_there_is_time_for():
    few, moved = shed(1, Load(), 0.1, APART_S, 0.0, LIVE)
    assert few.rung == len(rungs(LIVE)) - 1
    assert [(a.parameter, a.new) for a in moved] == [("registration.keypoints", 100), (SAMPLING, 4)]
    now, moved, _ = driven(25, 140, few)
    assert rungs(LIVE)[now.rung][SAMPLING] == 1
    assert [(a.parameter, a.old, a.new) for a in moved] == [(SAMPLING, 4, 1)]
