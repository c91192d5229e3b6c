"""Descent on bowls: it gets to the bottom, repeats, goes on where it was, stops in time, says what is no number."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.tuning.toys import Bowl, pieces
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.tuning.descent import Descended, Plan, Step, clip_shares, descend, draw_batch, split_examples
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.tuning.parameters import Parameters
from torchvision_dddas.tuning.time_cost import TimeCost

THRESHOLD, NOISE = "difference.threshold", "difference.noise_levels"


QUICK = Plan(steps=12, batch=4, rate=0.1, look_every=3)


def parameters(threshold: float = 12.0) -> Parameters:
    return Parameters(with_parameters(Settings(), {THRESHOLD: threshold}), [THRESHOLD, NOISE])


class Stopped(Exception):
    """The power is gone."""


def after(steps: int):
    """Something to tell a descent's steps to that stops it after some."""

    def tell(step: Step) -> None:
        if step.step == steps:
            raise Stopped

    return tell


def same(one: Descended, other: Descended) -> bool:
    states = [found.parameters.state_dict() for found in (one, other)]
    histories = [
        [replace(step, loss=0.0 if math.isnan(step.loss) else step.loss) for step in f.history] for f in (one, other)
    ]
    return histories[0] == histories[1] and all(torch.equal(states[0][name], states[1][name]) for name in states[0])


def test_the_same_arguments_give_the_same_steps_and_another_seed_gives_others() -> None:
    first, again = (descend(Bowl(), parameters(), pieces(), QUICK) for _ in range(2))
    other = descend(Bowl(), parameters(), pieces(), replace(QUICK, seed=1))
    assert same(first, again)
    assert first.history[-1].parameters != other.history[-1].parameters


@pytest.mark.parametrize("stop", [0, 5, 6, 12])
def test_a_descent_that_was_broken_off_goes_on_as_if_it_had_not_been(tmp_path: Path, stop: int) -> None:
    whole = descend(Bowl(), parameters(), pieces(), QUICK)
    place = tmp_path / "here" / "checkpoint.pt"
    with pytest.raises(Stopped):
        descend(Bowl(), parameters(), pieces(), QUICK, tell=after(stop), place=place)
    told = list[int]()
    resumed = descend(
        Bowl(), parameters(), pieces(), QUICK, tell=lambda s: told.append(s.step), place=place, resume=True
    )
    assert same(whole, resumed) and resumed.best == whole.best and resumed.ended == whole.ended
    assert told == list(range(13))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"plan": replace(QUICK, steps=13)}, "other steps, 12 and not 13"),
        ({"plan": replace(QUICK, seed=2)}, "other seed, 0 and not 2"),
        ({"examples": pieces(("one",))}, "other examples"),
        ({"parameters": Parameters(Settings(), [THRESHOLD])}, "other knobs"),
        ({"parameters": parameters(13.0)}, "other settings"),
        ({"family": Bowl(task="tracking")}, "other task, motion and not tracking"),
    ],
)
def test_a_checkpoint_of_another_descent_is_refused(tmp_path: Path, change: dict, words: str) -> None:
    place = tmp_path / "checkpoint.pt"
    descend(Bowl(), parameters(), pieces(), QUICK, place=place)
    asked = {"family": Bowl(), "parameters": parameters(), "examples": pieces(), "plan": QUICK} | change
    with pytest.raises(InputError, match=words):
        descend(place=place, resume=True, **asked)


@pytest.mark.parametrize("content", [b"", b"junk", b"PK\x03\x04 and then nothing"])
def test_a_damaged_checkpoint_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    place = tmp_path / "checkpoint.pt"
    place.write_bytes(content)
    with pytest.raises(InputError, match="is no checkpoint, or is damaged"):
        descend(Bowl(), parameters(), pieces(), QUICK, place=place, resume=True)


def test_softness_goes_down_evenly_in_its_logarithm() -> None:
    found = descend(Bowl(), parameters(), pieces(), QUICK)
    softness = [step.softness for step in found.history[1:]]
    assert softness[0] == pytest.approx(1) and softness[-1] == pytest.approx(0.1)
    ratios = [b / a for a, b in pairwise(softness)]
    assert max(ratios) == pytest.approx(min(ratios)) and max(ratios) < 1


def test_it_stops_where_the_watched_examples_gain_no_more_and_keeps_their_best_state() -> None:
    # What is learned from lies far above what is watched: every step beyond the watched ones' place is a loss.
    seen = [replace(one, content=one.content + (2.0 if one.frame <= 6 else 0.0)) for one in pieces(spread=0.0)]
    asked = Parameters(with_parameters(Settings(), {THRESHOLD: 12.0}), [THRESHOLD])
    found = descend(Bowl(), asked, seen, Plan(steps=200, rate=0.1, look_every=2, patience=3))
    assert "no gain" in found.ended and found.history[-1].step == found.best + 6 < 200
    assert found.settings.difference.threshold == pytest.approx(math.exp(3), rel=0.2)
    assert found.history[-1].parameters[THRESHOLD] > found.settings.difference.threshold * 1.2


def test_where_nothing_is_gained_the_settings_are_as_they_were() -> None:
    start = with_parameters(Settings(), {THRESHOLD: 10.0, NOISE: 2.0})
    away = [
        replace(one, content=one.content + (5.0 if one.frame <= 6 else math.log(10) - 3)) for one in pieces(spread=0.0)
    ]
    found = descend(Bowl(), Parameters(start, [THRESHOLD]), away, replace(QUICK, patience=2))
    assert found.best == 0 and found.settings == start


def test_a_loss_that_is_no_number_names_clip_frame_and_parameter_and_keeps_the_last_good_state() -> None:
    bowl = Bowl(place=4.0, wrong=("two", 3), wrong_above=20.0)
    found = descend(bowl, parameters(), pieces(spread=0.0), Plan(steps=60, batch=4, rate=0.1, look_every=1))
    assert "two, frame 3" in found.failed and f"{THRESHOLD} = 2" in found.failed and NOISE not in found.failed
    assert 12 < found.settings.difference.threshold < 26
    assert all(math.isfinite(value) for step in found.history for value in step.parameters.values())
    assert found.best == found.history[-1].step or found.best > 0


def test_a_watched_loss_that_is_no_number_stops_it_too() -> None:
    bowl = Bowl(place=4.0, wrong=("one", 8), wrong_above=20.0)
    found = descend(bowl, parameters(), pieces(spread=0.0), Plan(steps=60, batch=4, rate=0.1, look_every=5))
    assert "one, frame 8" in found.failed and "at step" in found.failed
    assert found.settings.difference.threshold < 20 and found.history[-1].watched is None


def test_a_slope_that_is_no_number_names_clip_frame_and_parameter() -> None:
    found = descend(Bowl(steep=("one", 2)), parameters(), pieces(), replace(QUICK, batch=99))
    assert f"gradient of the loss in {THRESHOLD}" in found.failed and "one, frame 2" in found.failed
    assert found.best == 0


def test_a_loss_that_is_no_number_from_the_start_is_bad_input() -> None:
    bowl = Bowl(wrong=("two", 8))
    with pytest.raises(InputError, match="two, frame 8, whatever the parameters, before the first step"):
        descend(bowl, parameters(), pieces(), QUICK)


def test_parameters_without_a_gradient_are_named() -> None:
    asked = Parameters(Settings(), [THRESHOLD, "gates.min_area_px"])
    found = descend(Bowl(), asked, pieces(), QUICK)
    assert found.idle == ("gates.min_area_px",)
    assert found.settings.gates.min_area_px == Settings().gates.min_area_px


def test_it_ends_when_its_time_is_over() -> None:
    found = descend(Bowl(), parameters(), pieces(), replace(QUICK, most_s=0.0))
    assert found.ended == "0 s are over" and len(found.history) == 1 and found.best == 0


@pytest.mark.slow
def test_a_pull_keeps_parameters_near_their_start_and_the_stronger_the_nearer() -> None:
    plan = Plan(steps=80, rate=0.1)
    ends = [
        descend(Bowl(), parameters(), pieces(spread=0.0), replace(plan, pull=pull)).settings.difference.threshold
        for pull in (0.0, 0.3, 3.0)
    ]
    assert 12.0 < ends[2] < ends[1] < ends[0] - 0.1


def test_without_examples_there_is_one_line() -> None:
    with pytest.raises(InputError, match="nothing to tune motion on"):
        descend(Bowl(), parameters(), [], QUICK)


@pytest.mark.parametrize(
    "wrong", [{"steps": 0}, {"batch": 0}, {"rate": 0.0}, {"watched": 1.0}, {"patience": 0}, {"pull": -1.0}]
)
def test_a_plan_that_will_not_do_is_refused(wrong: dict) -> None:
    with pytest.raises(InputError, match="must be"):
        replace(QUICK, **wrong)


class _Between(Bowl):
    """Best half way between whole sizes, which no setting can have."""

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        side = parameters["morphology.erode_px"]
        return ((2 * torch.pi * side).cos() + 0.1 * side).expand(len(batch))


def test_states_are_looked_at_as_the_settings_round_them() -> None:
    found = descend(_Between(), Parameters(Settings(), ["morphology.erode_px"]), pieces(), Plan(steps=20, look_every=1))
    sides = [step.parameters["morphology.erode_px"] for step in found.history]
    watched = [step.watched for step in found.history]
    assert any(abs(side - round(side)) > 0.3 for side in sides)
    assert watched == pytest.approx([1 + 0.1 * round(side) for side in sides])


class _Sized(Bowl):
    """A bowl that is deeper where the erosion is wider."""

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        return super().loss(parameters, batch, softness) - 0.1 * parameters["morphology.erode_px"]


def test_in_the_second_half_sizes_stay_and_the_rest_follows() -> None:
    names = ["morphology.erode_px", THRESHOLD]
    start, plan = with_parameters(Settings(), {THRESHOLD: 9.0}), Plan(steps=20, watched=0)
    found = descend(_Sized(), Parameters(start, names), pieces(), plan)
    sides = [step.parameters["morphology.erode_px"] for step in found.history]
    assert len(set(sides[:11])) == 11 and len(set(sides[10:])) == 1
    assert len({step.parameters[THRESHOLD] for step in found.history[10:]}) > 5


def test_sizes_that_stay_are_not_pulled_back() -> None:
    start, plan = with_parameters(Settings(), {THRESHOLD: 9.0}), Plan(steps=20, watched=0, pull=0.1)
    found = descend(_Sized(), Parameters(start, ["morphology.erode_px", THRESHOLD]), pieces(), plan)
    sides = [step.parameters["morphology.erode_px"] for step in found.history]
    assert sides[10] != sides[0] and len(set(sides[10:])) == 1


class _Idle(Bowl):
    """A bowl in the erosion alone."""

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        return (parameters["morphology.erode_px"].log() - 2).square().expand(len(batch))


def test_sizes_go_on_where_nothing_else_has_an_effect() -> None:
    found = descend(
        _Idle(), Parameters(Settings(), ["morphology.erode_px", NOISE]), pieces(), Plan(steps=20, watched=0)
    )
    assert found.idle == (NOISE,)
    assert len({step.parameters["morphology.erode_px"] for step in found.history}) == 21


@pytest.mark.parametrize("pull", [0.0, 0.1])
def test_a_parameter_without_effect_is_refused_and_not_pulled(pull: float) -> None:
    class Deaf(Bowl):
        def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
            return torch.ones(len(batch), dtype=torch.float64)

    with pytest.raises(InputError, match=f"the loss of motion does not depend on {NOISE}"):
        descend(Deaf(), Parameters(Settings(), [NOISE]), pieces(), replace(QUICK, pull=pull))


def test_examples_on_which_no_parameter_has_an_effect_stop_nothing() -> None:
    class Hush(Bowl):
        def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
            lost = super().loss(parameters, batch, softness)
            return lost.detach() if batch[0].clip == "two" else lost

    found = descend(Hush(), parameters(), pieces(), replace(QUICK, batch=1))
    assert found.failed == "" and found.history[-1].step == 12 and found.idle == ()


class Dear(TimeCost):
    """A threshold that costs time."""

    def term(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """The more the dearer."""
        return parameters[THRESHOLD].log()


@pytest.mark.parametrize(("cost", "least"), [(None, 3.0), (Dear(1.0, 1.0, ()), 2.5)])
def test_it_gets_to_the_bottom_of_the_loss_and_the_cost(cost: TimeCost | None, least: float) -> None:
    """Of (x - 3)² + x the bottom is at 2.5."""
    found = descend(Bowl(), parameters(), pieces(spread=0.0), Plan(steps=100, rate=0.15), cost)
    assert found.settings.difference.threshold == pytest.approx(math.exp(least), rel=0.02)
    assert found.settings.difference.noise_levels == pytest.approx(1, rel=0.05)
    assert found.failed == "" and found.idle == ()


def test_when_its_time_is_over_the_last_state_is_measured(monkeypatch) -> None:
    clock = iter(range(1000))
    monkeypatch.setattr("torchvision_dddas.tuning.descent.time.perf_counter", lambda: float(next(clock)))
    found = descend(Bowl(), parameters(), pieces(spread=0.0), Plan(steps=99, rate=0.1, look_every=50, most_s=4.0))
    assert "are over" in found.ended and found.best == found.history[-1].step == 3
    first, last = found.history[0].watched, found.history[-1].watched
    assert first is not None and last is not None and last < first


def test_the_last_part_of_each_clip_is_watched_and_never_learned_from() -> None:
    learned, watched = split_examples(pieces(("one", "two"), 8), 0.25, 99)
    assert [(one.clip, one.frame) for one in watched] == [("one", 7), ("one", 8), ("two", 7), ("two", 8)]
    assert not {(one.clip, one.frame) for one in learned} & {(one.clip, one.frame) for one in watched}
    assert len(learned) == 12


def test_where_clips_are_too_short_all_are_learned_from_and_watched() -> None:
    learned, watched = split_examples(pieces(("one", "two"), 2), 0.25, 99)
    assert learned == watched and len(learned) == 4


@pytest.mark.parametrize("frames", [3, 4, 5])
def test_of_a_short_clip_something_is_learned_whatever_share_is_watched(frames: int) -> None:
    learned, watched = split_examples(pieces(("one", "two"), frames), 0.9, 99)
    assert {one.clip for one in learned} == {one.clip for one in watched} == {"one", "two"}


def test_of_many_some_are_watched_from_all_over() -> None:
    _, watched = split_examples(pieces(("one", "two"), 40), 0.5, 8)
    assert len(watched) == 8 and {one.clip for one in watched} == {"one", "two"}


def test_every_example_has_its_turn_before_any_has_another() -> None:
    taken = [i for step in range(5) for i in draw_batch(step, ["one"] * 10, 4, seed=3)]
    assert sorted(taken[:10]) == sorted(taken[10:]) == list(range(10))
    assert taken[:10] != taken[10:]


def test_a_clip_with_few_labelled_frames_has_the_weight_of_one_with_many() -> None:
    clips = ["long"] * 9 + ["short"] * 2
    taken = [i for step in range(9) for i in draw_batch(step, clips, 2, seed=0)]
    assert sorted(taken[:18]) == [*range(9), *[9] * 4, *[10] * 5] or sorted(taken[:18]) == [
        *range(9),
        *[9] * 5,
        *[10] * 4,
    ]
    assert [round(share, 3) for share in clip_shares(clips)] == [0.056] * 9 + [0.25] * 2
