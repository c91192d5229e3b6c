"""Where a sweep looks: values and ranges of parameters, checked before anything is measured."""

import pytest

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies.axes import Choice, Range, in_ranges, on_grid, points, possible

NOW = Settings()


def test_values_are_as_the_settings_hold_them_and_none_is_there_twice() -> None:
    axes = on_grid(["difference.threshold=10, 9,9.0", "refine.on=true,false", "difference.near_frames=[1],[1,2]"], NOW)
    assert axes == [
        Choice("difference.threshold", (10.0, 9.0)),
        Choice("refine.on", (True, False)),
        Choice("difference.near_frames", ((1,), (1, 2))),
    ]


def test_words_need_no_quotes() -> None:
    assert on_grid(["difference.kind=normalized,to_reference"], NOW)[0].values == ("normalized", "to_reference")


def test_the_grid_is_every_combination_in_order() -> None:
    axes = on_grid(["difference.threshold=10,20", "morphology.erode_px=1,3"], NOW)
    assert [tuple(point.values()) for point in points(axes)] == [(10.0, 1), (10.0, 3), (20.0, 1), (20.0, 3)]


def test_a_range_is_of_whole_odd_or_any_numbers_as_its_parameter_is() -> None:
    axes = in_ranges(["difference.threshold=8:30", "difference.blur_px=3:9", "small.gap_frames=2:20:log"], NOW)
    assert axes == [
        Range("difference.threshold", 8.0, 30.0),
        Range("difference.blur_px", 3, 9, step=2),
        Range("small.gap_frames", 2, 20, step=1, log=True),
    ]


def test_what_may_be_drawn_may_also_be_named() -> None:
    assert in_ranges(["refine.on=true,false"], NOW) == [Choice("refine.on", (True, False))]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("difference.threshold", "is no axis of a sweep"),
        ("difference.threshold=", "is no axis of a sweep"),
        ("difference.threshold=,", "has no values"),
        ("difference.treshold=10", "did you mean difference.threshold"),
        ("difference.threshold=10,-1", "0.1 to 255"),
        ("difference.threshold=low", "0.1 to 255"),
        ("difference.kind=normalised", "normalized or to_reference"),
    ],
)
def test_a_bad_axis_is_told_in_one_line(text, told) -> None:
    with pytest.raises(InputError, match=told) as caught:
        on_grid([text], NOW)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("difference.threshold=30:8", "the lower end first"),
        ("difference.threshold=8:8", "the lower end first"),
        ("difference.threshold=8:many", "many is no number"),
        ("difference.threshold=8:300", "0.1 to 255"),
        ("difference.threshold=8:30:linear", "low:high:log"),
        ("track.speed_weight=0:2:log", "unknown parameter"),
        ("difference.peak=0:2:log", "above 0"),
        ("difference.blur_px=4:9", "odd"),
        ("difference.blur_px=3:9:log", "leave out :log"),
        ("morphology.erode_px=1.5:9", "whole numbers"),
        ("difference.kind=1:2", "no number"),
    ],
)
def test_a_bad_range_is_told_in_one_line(text, told) -> None:
    with pytest.raises(InputError, match=told) as caught:
        in_ranges([text], NOW)
    assert "\n" not in str(caught.value)


def test_a_parameter_has_one_axis() -> None:
    with pytest.raises(InputError, match="given twice"):
        on_grid(["refine.on=true", "refine.on=false"], NOW)


def test_a_grid_of_more_points_than_anyone_waits_for_is_refused() -> None:
    many = ",".join(str(k) for k in range(50, 250))
    with pytest.raises(InputError, match="40000 points"):
        list(points(on_grid([f"registration.keypoints={many}", f"registration.hypotheses={many}"], NOW)))


def test_values_that_each_may_be_but_not_together_are_no_bad_axes() -> None:
    axes = on_grid(["interval.minimum_frames=1,7", "interval.maximum_frames=5,9"], NOW)
    told = {tuple(point.values()): possible(NOW, point) for point in points(axes)}
    assert "above" in told[7, 5] and not any(told[pair] for pair in ((1, 5), (1, 9), (7, 9)))
