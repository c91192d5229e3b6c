"""Sweeps over a measure that is known in closed form, and what they search."""

import math

import pytest

from torchvision_dddas.config import Settings, is_set, load_config, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.studies import sweep
from torchvision_dddas.lab.evaluation.studies.sweep import ParameterAxis, Trial, best, parse_grid, parse_ranges

NOW = Settings()


def hill(parameters) -> tuple[float, str]:
    """The best threshold is 14; a blur of 9 has no value."""
    if parameters.get("difference.blur_px") == 9:
        return math.nan, "the clip broke off"
    return 1 - abs(parameters.get("difference.threshold", 100.0) - 14) / 100, ""


def on_grid(*texts, measure=hill, **how) -> list[Trial]:
    return list(sweep.search_grid(parse_grid(texts, NOW), NOW, measure, **how))


def proposed(*texts, count=12, seed=0, minimize=False) -> list[Trial]:
    pytest.importorskip("optuna")
    ranges = parse_ranges(texts or ("difference.threshold=5:40",), NOW)
    return list(sweep.search_ranges(ranges, NOW, hill, count, seed, minimize))


def test_axes_have_the_types_of_the_settings_and_no_value_twice() -> None:
    grid = ["difference.threshold=10, 9,9.0", "refine.on=true,false", "difference.near_frames=[1],[1,2]"]
    axes = parse_grid([*grid, "difference.kind=normalized,to_reference"], NOW)
    assert axes == [
        ParameterAxis("difference.threshold", (10.0, 9.0)),
        ParameterAxis("refine.on", (True, False)),
        ParameterAxis("difference.near_frames", ((1,), (1, 2))),
        ParameterAxis("difference.kind", ("normalized", "to_reference")),
    ]
    assert sweep.count_points(axes) == 16
    ranges = ["difference.threshold=8:30", "difference.blur_px=3:9", "small.gap_frames=2:20:log"]
    assert parse_ranges([*ranges, "refine.on=true,false"], NOW) == [
        ParameterAxis("difference.threshold", (), 8.0, 30.0),
        ParameterAxis("difference.blur_px", (), 3, 9, step=2),
        ParameterAxis("small.gap_frames", (), 2, 20, step=1, log=True),
        ParameterAxis("refine.on", (True, False)),
    ]


MANY = ",".join(str(k) for k in range(50, 250))


@pytest.mark.parametrize(
    ("parse", "texts", "message"),
    [
        (parse_grid, ["difference.threshold"], "is not an axis of a sweep"),
        (parse_grid, ["difference.threshold=,"], "has no values"),
        (parse_grid, ["difference.treshold=10"], "did you mean difference.threshold"),
        (parse_grid, ["difference.threshold=10,-1"], "between 0.1 and 255"),
        (parse_grid, [f"registration.keypoints={MANY}", f"registration.hypotheses={MANY}"], "got 40000"),
        (parse_grid, ["refine.on=true", "refine.on=false"], "given twice"),
        (parse_ranges, ["difference.threshold=30:8"], "the lower end must come first"),
        (parse_ranges, ["difference.threshold=8:many"], "must be numbers"),
        (parse_ranges, ["difference.threshold=8:300"], "between 0.1 and 255"),
        (parse_ranges, ["difference.threshold=8:30:linear"], "low:high:log"),
        (parse_ranges, ["difference.peak=0:2:log"], "above 0"),
        (parse_ranges, ["difference.blur_px=3:9:log"], "leave out :log"),
        (parse_ranges, ["morphology.erode_px=1.5:9"], "whole numbers, got 1.5"),
        (parse_ranges, ["difference.kind=1:2"], "not a number"),
    ],
)
def test_a_bad_axis_is_refused_in_one_line(parse, texts, message) -> None:
    with pytest.raises(InputError, match=message):
        parse(texts, NOW)


def test_a_grid_is_measured_in_order_after_the_settings_as_they_are() -> None:
    trials = on_grid("difference.threshold=10,15,20", "morphology.erode_px=3,1")
    assert [trial.number for trial in trials] == list(range(7))
    assert trials[0].parameters == {} and trials[0].value == pytest.approx(0.14)
    assert [tuple(trial.parameters.values()) for trial in trials[1:4]] == [(10.0, 3), (10.0, 1), (15.0, 3)]
    found = best(trials, minimize=False)
    assert found is not None and found.number == 3  # of equal points the first
    assert best(trials, minimize=True) == trials[0]


def test_a_point_without_a_value_is_never_the_best_and_a_grid_of_impossible_points_is_refused() -> None:
    trials = on_grid("difference.threshold=14", "difference.blur_px=7,9")
    assert sweep.ranked(trials, minimize=False)[-1].cause == "the clip broke off"
    assert best([Trial(0, {}, math.nan, "why")], minimize=False) is None
    trials = on_grid("interval.minimum_frames=1,7", "interval.maximum_frames=5,9")
    assert [bool(trial.cause) for trial in trials] == [False, False, False, True, False]
    with pytest.raises(InputError, match="no point of the grid is possible"):
        on_grid("interval.minimum_frames=7", "interval.maximum_frames=5")


def test_points_are_prepared_once_each_and_before_they_are_measured() -> None:
    ready: list = []
    values = [5.0 + k for k in range(2 * sweep.AHEAD + 1)]
    text = f"difference.threshold={','.join(map(str, values))}"
    trials = on_grid(text, measure=lambda parameters: (float(parameters in ready), ""), prepare=ready.extend)
    assert all(trial.value for trial in trials)
    assert ready[0] == {} and [point["difference.threshold"] for point in ready[1:]] == values


def test_proposals_repeat_with_the_seed_and_come_near_the_best() -> None:
    assert proposed(seed=3) == proposed(seed=3) != proposed(seed=4)
    for minimize, low, high in ((False, 12, 16), (True, 38, 40)):
        found = best(proposed(count=40, minimize=minimize)[1:], minimize)
        assert found is not None and low <= float(str(found.parameters["difference.threshold"])) <= high


def test_proposals_keep_to_whole_and_odd_numbers_and_named_values_and_survive_failures() -> None:
    trials = proposed("difference.blur_px=3:9", "difference.near_frames=[1],[1,2]", "morphology.erode_px=1:4", count=30)
    assert len(trials) == 31 and any(trial.cause for trial in trials)
    blurs, near, erosions = (set(values) for values in zip(*(t.parameters.values() for t in trials[1:]), strict=True))
    assert (blurs, near) == ({3, 5, 7, 9}, {(1,), (1, 2)}) and {type(value) for value in erosions} == {int}


def test_the_best_is_written_so_that_it_is_read_as_the_same_settings(tmp_path) -> None:
    parameters = {
        "difference.near_frames": (1, 3),
        "difference.threshold": 0.1 + 0.2,
        "refine.on": False,
        "small.on": True,
    }
    wanted = with_parameters(load_config("fast"), {**parameters, "people.graphs": "\U0001f600"})
    (tmp_path / "best.toml").write_text(sweep.settings_toml(wanted, ["a line", "another"]), encoding="utf-8")
    assert load_config(tmp_path / "best.toml") == wanted
    assert is_set(load_config(tmp_path / "best.toml"), "small.on"), "set to its default, which tracklets replace"
    words = [f"{name}={sweep.toml_value(value)}" for name, value in parameters.items()]
    assert load_config("fast", words) == with_parameters(load_config("fast"), parameters)


def test_parameters_that_mean_something_else_or_have_no_effect_are_named() -> None:
    fast = load_config("fast")
    axes = parse_grid(["difference.threshold=10,20", "refine.share=0.5", "morphology.erode_px=1"], fast)
    units, effect = sweep.parameter_notes(axes, fast)
    assert "difference.threshold is in grey levels with difference.kind = to_reference" in units
    assert effect == "refine.share has no effect: refine.on is false"
    assert sweep.parameter_notes(axes, NOW) == []
    (beside,) = sweep.parameter_notes(parse_grid(["history.duration_frames=4,6"], NOW), NOW)
    assert beside.startswith("history.duration_frames has no effect: tracklets replace the motion history")
    assert sweep.parameter_notes(parse_grid(["history.on=true,false", "tracklets.on=true,false"], NOW), NOW) == []
    mixed = parse_grid(["difference.peak=1", "difference.kind=normalized,to_next", "refine.on=true"], NOW)
    (units,) = sweep.parameter_notes(mixed, NOW)
    assert "with difference.kind = to_next, and" in units
