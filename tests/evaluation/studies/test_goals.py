"""What can be asked to be best: names of measures, told wrong before anything is computed."""

from dataclasses import replace

import pytest

from tests.evaluation.studies.scored_clips import masked, targeted, tracked
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.registry import HEADLINES, groups_of_task, is_lower_better, measure_names
from torchvision_dddas.evaluation.studies.scoring import score
from torchvision_dddas.evaluation.studies.summary import check_possible, measures, parse_goal, possible_groups


@pytest.mark.parametrize(
    ("make", "task"), [(masked, "motion"), (targeted, "motion"), (tracked, "tracking"), (tracked, "association")]
)
def test_the_names_of_measures_are_those_that_scored_clips_have(tmp_path, make, task) -> None:
    clip, found = make(tmp_path / "clip", 0)
    having = measures([score(clip, task, found)])
    assert set(having) == set(possible_groups(clip, task)) <= set(groups_of_task(task))
    for group, told in having.items():
        assert set(measure_names(group)) == {
            name for name in told if not name.startswith("n_") or is_lower_better(name)
        }


def test_every_task_has_a_group_and_every_group_a_measure() -> None:
    for task in HEADLINES:
        groups = groups_of_task(task)
        for group in groups:
            assert measure_names(group)
            assert parse_goal(f"{task}.{group}.{measure_names(group)[0]}").group == group


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("motion.pixels.iou", "'iou' is no measure of motion.pixels; wanted accuracy, "),
        ("location.metres.mean", "'mean' is no measure of location.metres; wanted median_m, "),
        ("people.ranking.map", "no measure of people.ranking; wanted ap, "),
        ("tracking.pixels.f", "no group of measures of tracking; wanted tracks, target_track"),
    ],
)
def test_a_measure_that_no_clip_can_have_is_refused_by_its_name(asked, said) -> None:
    with pytest.raises(InputError, match=said):
        parse_goal(asked)


def test_a_measure_that_the_truth_of_these_clips_does_not_allow_is_told(tmp_path) -> None:
    clip, _ = masked(tmp_path / "clip", 0)
    check_possible(parse_goal("motion.pixels.f"), [clip])
    with pytest.raises(InputError, match=r"no clip has truth for motion\.target\.hit; .* motion\.pixels"):
        check_possible(parse_goal("motion.target.hit"), [clip])
    still = replace(clip, still=True)
    check_possible(parse_goal("motion.still.alarmed"), [clip, still])
    with pytest.raises(InputError, match=r"there is truth for motion\.still$"):
        check_possible(parse_goal("motion.pixels.f"), [still])
