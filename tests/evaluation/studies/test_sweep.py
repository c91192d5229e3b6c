"""Sweeps over a measure that is known in closed form."""

import math

import pytest

from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies.axes import in_ranges
from torchvision_dddas.evaluation.studies.axes import on_grid as grid_axes
from torchvision_dddas.evaluation.studies.sweep import AHEAD, Trial, as_toml, on_grid, proposed, ranked
from torchvision_dddas.evaluation.studies.sweep import best as best_of

NOW = Settings()


def hill(parameters) -> tuple[float, str]:
    """The best threshold is 14; a blur of 9 has no value."""
    if parameters.get("difference.blur_px") == 9:
        return math.nan, "the clip broke off"
    return 1 - abs(parameters.get("difference.threshold", 100.0) - 14) / 100, ""


def best(trials: list[Trial], least: bool) -> Trial:
    found = best_of(trials, least)
    assert found is not None
    return found


def threshold(trial: Trial) -> float:
    """NaN for the settings as they were."""
    value = trial.parameters.get("difference.threshold", math.nan)
    assert isinstance(value, float)
    return value


def on(texts, ahead=lambda points: None) -> list[Trial]:
    return list(on_grid(grid_axes(texts, NOW), NOW, hill, ahead))


def drawn(count: int = 12, seed: int = 0, least: bool = False, texts=("difference.threshold=5:40",)) -> list[Trial]:
    pytest.importorskip("optuna")
    return list(proposed(in_ranges(texts, NOW), NOW, hill, count, seed, least))


def test_the_settings_as_they_are_come_first_and_compete() -> None:
    trials = on(["difference.threshold=10,15,20"])
    assert trials[0].parameters == {} and trials[0].value == pytest.approx(0.14)
    assert best(trials, least=False).parameters == {"difference.threshold": 15.0}
    assert best(trials, least=True).number == 0


def test_a_point_without_a_value_is_last_and_never_the_best() -> None:
    trials = on(["difference.threshold=14", "difference.blur_px=7,9"])
    assert best(trials, least=False).number == 1
    assert ranked(trials, least=False)[-1].cause == "the clip broke off"


def test_where_nothing_has_a_value_there_is_no_best() -> None:
    assert best_of([Trial(0, {}, math.nan, "why")], least=False) is None


def test_of_equal_points_the_first_is_the_best() -> None:
    assert best(on(["difference.threshold=13,15"]), least=False).parameters == {"difference.threshold": 13.0}


def test_a_point_that_cannot_be_is_told_and_the_others_are_measured() -> None:
    trials = on(["interval.minimum_frames=1,7", "interval.maximum_frames=5,9"])
    assert [bool(trial.cause) for trial in trials] == [False, False, False, True, False]


def test_a_grid_on_which_nothing_is_possible_is_refused() -> None:
    with pytest.raises(InputError, match="no point of the grid is possible"):
        on(["interval.minimum_frames=7", "interval.maximum_frames=5"])


def test_points_are_told_ahead_each_once_and_before_they_are_measured() -> None:
    told: list = []
    values = [5.0 + k for k in range(2 * AHEAD + 1)]
    trials = on_grid(
        grid_axes([f"difference.threshold={','.join(map(str, values))}"], NOW),
        NOW,
        lambda parameters: (float(parameters in told), ""),
        told.extend,
    )
    assert all(trial.value for trial in trials)
    assert told[0] == {} and [point["difference.threshold"] for point in told[1:]] == values


def test_proposals_repeat_with_the_seed_and_differ_with_another() -> None:
    assert drawn(seed=3) == drawn(seed=3) != drawn(seed=4)


def test_proposals_come_near_the_best_of_a_hill() -> None:
    assert abs(threshold(best(drawn(40), least=False)) - 14) < 2
    lowest = min(drawn(40, least=True)[1:], key=lambda trial: trial.value)
    assert threshold(lowest) > 38


def test_proposals_keep_to_whole_and_odd_numbers_and_to_the_values_named() -> None:
    texts = ("difference.blur_px=3:9", "difference.near_frames=[1],[1,2]", "morphology.erode_px=1:4")
    trials = drawn(30, texts=texts)[1:]
    assert {trial.parameters["difference.blur_px"] for trial in trials} == {3, 5, 7, 9}
    assert {trial.parameters["difference.near_frames"] for trial in trials} == {(1,), (1, 2)}
    assert {type(trial.parameters["morphology.erode_px"]) for trial in trials} == {int}


def test_trials_without_a_value_do_not_end_a_search() -> None:
    trials = drawn(20, texts=("difference.blur_px=3:9", "difference.threshold=5:40"))
    assert len(trials) == 21 and any(trial.cause for trial in trials)


def test_what_is_written_of_the_best_is_read_as_the_same_settings(tmp_path) -> None:
    parameters = {"difference.near_frames": (1, 3), "difference.threshold": 0.1 + 0.2, "refine.on": False}
    wanted = with_parameters(load_config("fast"), parameters)
    (tmp_path / "best.toml").write_text(as_toml(wanted, ["a line", "another"]))
    assert load_config(tmp_path / "best.toml") == wanted
