"""Descent on bowls: it gets to the bottom, repeats, resumes, stops in time, and names a loss that is no number."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.lab.tuning.toys import Bowl, pieces
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.tuning.descent import (
    Descended,
    DescentStep,
    Plan,
    clip_shares,
    descend,
    draw_batch,
    split_examples,
)
from torchvision_dddas.lab.tuning.family import Example
from torchvision_dddas.lab.tuning.parameters import Parameters

THRESHOLD, NOISE, ERODE = "difference.threshold", "difference.noise_levels", "morphology.erode_px"
QUICK = Plan(steps=12, batch=4, rate=0.1, look_every=3)


class Ruled(Bowl):
    """A bowl whose loss is changed by a rule."""

    def __init__(self, rule: Callable[[Mapping[str, Tensor], Sequence[Example], Callable[[], Tensor]], Tensor]) -> None:
        super().__init__()
        self.rule = rule

    def loss(self, parameters: Mapping[str, Tensor], batch: Sequence[Example], softness: float) -> Tensor:
        """What the rule makes of the bowl's loss."""
        return self.rule(parameters, batch, partial(super().loss, parameters, batch, softness))


def parameters(threshold: float = 12.0, names: Sequence[str] = (THRESHOLD, NOISE)) -> Parameters:
    return Parameters(with_parameters(Settings(), {THRESHOLD: threshold}), names)


def same(one: Descended, other: Descended) -> bool:
    states = [found.parameters.state_dict() for found in (one, other)]
    histories = [
        [replace(step, loss=0.0 if math.isnan(step.loss) else step.loss) for step in f.history] for f in (one, other)
    ]
    return histories[0] == histories[1] and all(torch.equal(states[0][name], states[1][name]) for name in states[0])


def sides(found: Descended) -> list[float]:
    return [step.parameters[ERODE] for step in found.history]


def test_steps_repeat_with_the_seed_and_softness_goes_down_evenly_in_its_logarithm() -> None:
    first, again = (descend(Bowl(), parameters(), pieces(), QUICK) for _ in range(2))
    other = descend(Bowl(), parameters(), pieces(), replace(QUICK, seed=1))
    assert same(first, again)
    assert first.history[-1].parameters != other.history[-1].parameters
    assert [step.softness for step in first.history[1:]] == pytest.approx([0.1 ** (k / 11) for k in range(12)])


@pytest.mark.parametrize("stop", [0, 5, 6, 12])
def test_a_descent_that_was_broken_off_resumes_with_the_same_steps(tmp_path: Path, stop: int) -> None:
    class Stopped(Exception):
        pass

    def interrupt(step: DescentStep) -> None:
        if step.step == stop:
            raise Stopped

    whole = descend(Bowl(), parameters(), pieces(), QUICK)
    place = tmp_path / "here" / "checkpoint.pt"
    with pytest.raises(Stopped):
        descend(Bowl(), parameters(), pieces(), QUICK, tell=interrupt, place=place)
    steps = list[DescentStep]()
    resumed = descend(Bowl(), parameters(), pieces(), QUICK, tell=steps.append, place=place, resume=True)
    assert same(whole, resumed) and resumed.best == whole.best and resumed.ended == whole.ended
    assert [step.step for step in steps] == list(range(13))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"plan": replace(QUICK, steps=13)}, "other steps, 12 instead of 13"),
        ({"examples": pieces(("one",))}, "other examples"),
        ({"parameters": Parameters(Settings(), [THRESHOLD])}, "other knobs"),
        ({"parameters": parameters(13.0)}, "other settings"),
        ({"family": Bowl(task="tracking")}, "other task, motion instead of tracking"),
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
    with pytest.raises(InputError, match="is not a checkpoint, or is damaged"):
        descend(Bowl(), parameters(), pieces(), QUICK, place=place, resume=True)


def test_it_stops_where_the_watched_examples_gain_no_more_and_keeps_their_best_state() -> None:
    # What is learned from lies far above what is watched: every step beyond the watched ones' place is a loss.
    examples = [replace(one, content=one.content + 2.0 * (one.frame <= 6)) for one in pieces(spread=0.0)]
    plan = Plan(steps=200, rate=0.1, look_every=2, patience=3)
    found = descend(Bowl(), parameters(names=[THRESHOLD]), examples, plan)
    assert "no gain" in found.ended and found.history[-1].step == found.best + 6 < 200
    assert found.settings.difference.threshold == pytest.approx(math.exp(3), rel=0.2)
    assert found.history[-1].parameters[THRESHOLD] > found.settings.difference.threshold * 1.2


@pytest.mark.parametrize(
    ("bowl", "look_every", "words"),
    [
        (Bowl(place=4.0, wrong=("two", 3), wrong_above=20.0), 1, ["two, frame 3", f"{THRESHOLD} = 2"]),
        (Bowl(place=4.0, wrong=("one", 8), wrong_above=20.0), 5, ["one, frame 8", "at step"]),
        (Bowl(steep=("one", 2)), 3, [f"gradient of the loss in {THRESHOLD}", "one, frame 2"]),
    ],
    ids=["learned", "watched", "slope"],
)
def test_what_is_no_number_names_clip_frame_and_parameter_and_the_last_good_state_is_kept(bowl, look_every, words):
    batch = 99 if bowl.steep[0] else 4
    plan = Plan(steps=60, batch=batch, rate=0.1, look_every=look_every)
    found = descend(bowl, parameters(), pieces(spread=0.0), plan)
    assert all(word in found.failed for word in words) and NOISE not in found.failed
    assert 12 <= found.settings.difference.threshold + 1e-9 < 26
    assert all(math.isfinite(value) for step in found.history for value in step.parameters.values())


@pytest.mark.slow
def test_a_pull_keeps_parameters_near_their_start_and_the_stronger_the_nearer() -> None:
    plan = Plan(steps=80, rate=0.1)
    ends = [
        descend(Bowl(), parameters(), pieces(spread=0.0), replace(plan, pull=pull)).settings.difference.threshold
        for pull in (0.0, 0.3, 3.0)
    ]
    assert 12.0 < ends[2] < ends[1] < ends[0] - 0.1


@pytest.mark.parametrize("wrong", [{"steps": 0}, {"rate": 0.0}, {"watched": 1.0}, {"pull": -1.0}])
def test_an_impossible_plan_is_refused(wrong: dict) -> None:
    with pytest.raises(InputError, match="must be"):
        replace(QUICK, **wrong)


@pytest.mark.parametrize(
    ("examples", "line"),
    [
        ([], "no clip has an example to tune motion on"),
        (pieces(), "two, frame 8, for any parameters, before the first step"),
    ],
)
def test_examples_without_a_loss_are_refused(examples, line) -> None:
    with pytest.raises(InputError, match=line):
        descend(Bowl(wrong=("two", 8)), parameters(), examples, QUICK)


def test_states_are_watched_as_the_settings_round_them() -> None:
    def between(parameters, batch, _):
        """Best half way between whole sizes, which no setting can have."""
        return ((2 * torch.pi * parameters[ERODE]).cos() + 0.1 * parameters[ERODE]).expand(len(batch))

    found = descend(Ruled(between), Parameters(Settings(), [ERODE]), pieces(), Plan(steps=20, look_every=1))
    assert any(abs(side - round(side)) > 0.3 for side in sides(found))
    assert [step.watched for step in found.history] == pytest.approx([1 + 0.1 * round(side) for side in sides(found)])


@pytest.mark.parametrize("pull", [0.0, 0.1])
def test_in_the_second_half_sizes_stay_and_the_rest_follows(pull: float) -> None:
    sized = Ruled(lambda parameters, _, bowl: bowl() - 0.1 * parameters[ERODE])
    plan = Plan(steps=20, watched=0, pull=pull)
    found = descend(sized, parameters(9.0, [ERODE, THRESHOLD]), pieces(), plan)
    assert len(set(sides(found)[:11])) > 5 and len(set(sides(found)[10:])) == 1
    assert sides(found)[10] != sides(found)[0]
    assert len({step.parameters[THRESHOLD] for step in found.history[10:]}) > 5


def test_a_parameter_without_effect_is_named_and_sizes_go_on_where_nothing_else_has_one() -> None:
    of_size = Ruled(lambda parameters, batch, _: (parameters[ERODE].log() - 2).square().expand(len(batch)))
    found = descend(of_size, Parameters(Settings(), [ERODE, NOISE]), pieces(), Plan(steps=20, watched=0))
    assert found.idle == (NOISE,)
    assert found.settings.difference.noise_levels == Settings().difference.noise_levels
    assert len(set(sides(found))) == 21


@pytest.mark.parametrize("pull", [0.0, 0.1])
def test_where_no_parameter_has_an_effect_it_is_refused(pull: float) -> None:
    deaf = Ruled(lambda _, batch, bowl: torch.ones(len(batch), dtype=torch.float64))
    with pytest.raises(InputError, match=f"the loss of motion does not depend on {NOISE}"):
        descend(deaf, Parameters(Settings(), [NOISE]), pieces(), replace(QUICK, pull=pull))


def test_examples_on_which_no_parameter_has_an_effect_stop_nothing() -> None:
    hush = Ruled(lambda _, batch, bowl: bowl().detach() if batch[0].clip == "two" else bowl())
    found = descend(hush, parameters(), pieces(), replace(QUICK, batch=1))
    assert found.failed == "" and found.history[-1].step == 12 and found.idle == ()


def test_it_gets_to_the_bottom_of_the_loss() -> None:
    found = descend(Bowl(), parameters(), pieces(spread=0.0), Plan(steps=100, rate=0.15))
    assert found.settings.difference.threshold == pytest.approx(math.exp(3.0), rel=0.02)
    assert found.settings.difference.noise_levels == pytest.approx(1, rel=0.05)
    assert found.failed == "" and found.idle == ()


@pytest.mark.parametrize(("most_s", "last"), [(0.0, 0), (4.0, 3)])
def test_when_its_time_is_over_the_last_state_is_measured(monkeypatch, most_s: float, last: int) -> None:
    clock = iter(range(1000))
    monkeypatch.setattr("torchvision_dddas.lab.tuning.descent.time.perf_counter", lambda: float(next(clock)))
    plan = Plan(steps=99, rate=0.1, look_every=50, most_s=most_s)
    found = descend(Bowl(), parameters(), pieces(spread=0.0), plan)
    assert found.ended == f"the limit of {most_s:.0f} s was reached" and found.best == found.history[-1].step == last
    watched = [found.history[k].watched for k in (0, -1)]
    assert watched[0] is not None and watched[1] is not None and (last == 0 or watched[1] < watched[0])


def test_the_last_part_of_each_clip_is_watched_and_never_learned_from() -> None:
    learned, watched = split_examples(pieces(("one", "two"), 8), 0.25, 99)
    assert [(one.clip, one.frame) for one in watched] == [("one", 7), ("one", 8), ("two", 7), ("two", 8)]
    assert not {(one.clip, one.frame) for one in learned} & {(one.clip, one.frame) for one in watched}
    assert len(learned) == 12
    _, watched = split_examples(pieces(("one", "two"), 40), 0.5, 8)
    assert len(watched) == 8 and {one.clip for one in watched} == {"one", "two"}


@pytest.mark.parametrize("frames", [2, 3, 5])
def test_of_a_short_clip_something_is_learned_whatever_share_is_watched(frames: int) -> None:
    learned, watched = split_examples(pieces(("one", "two"), frames), 0.9, 99)
    assert {one.clip for one in learned} == {one.clip for one in watched} == {"one", "two"}
    assert (learned == watched) == (frames == 2)


def test_every_example_has_its_turn_before_any_has_another() -> None:
    taken = [i for step in range(5) for i in draw_batch(step, ["one"] * 10, 4, seed=3)]
    assert sorted(taken[:10]) == sorted(taken[10:]) == list(range(10))
    assert taken[:10] != taken[10:]


def test_a_clip_with_few_labelled_frames_has_the_weight_of_one_with_many() -> None:
    clips = ["long"] * 9 + ["short"] * 2
    taken = [i for step in range(9) for i in draw_batch(step, clips, 2, seed=0)][:18]
    assert sorted(taken)[:9] == list(range(9)) and {taken.count(9), taken.count(10)} == {4, 5}
    assert [round(share, 3) for share in clip_shares(clips)] == [0.056] * 9 + [0.25] * 2
