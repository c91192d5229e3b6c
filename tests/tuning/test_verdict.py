"""What tuning was worth: figures of the study itself, on both sets of clips, with a clip that fails told beside."""

from functools import partial
from pathlib import Path

import pytest

from tests.evaluation.studies.world import filmed, study
from torchvision_dddas.config import load_config, with_parameters
from torchvision_dddas.evaluation.metrics import bootstrap
from torchvision_dddas.evaluation.studies.runner import read_spec, run_study
from torchvision_dddas.evaluation.studies.summary import goal_value, parse_goal
from torchvision_dddas.tuning import verdict as judging
from torchvision_dddas.tuning.verdict import Verdict, judge

GOAL = parse_goal("motion.pixels.f")
KNOBS = {"difference.threshold": 40.0}


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> Path:
    """A study of three small clips."""
    place = tmp_path_factory.mktemp("verdict") / "clips"
    for seed, name in enumerate(("one", "two", "held")):
        filmed(place, name, seed, frames=7)
    return study(place, 'config = "fast"')


@pytest.fixture(scope="module")
def found(clips) -> Verdict:
    with pytest.MonkeyPatch.context() as here:
        here.setattr(bootstrap, "effects", partial(bootstrap.effects, resamples=40, most=200))
        spec = read_spec(clips)
        return judge(spec, clips.parent, GOAL, KNOBS, ("one", "two"), ("held",), 1, clips.parent / "cache")


def test_the_figures_are_those_of_the_study_before_and_after(clips, found) -> None:
    spec = read_spec(clips)
    overrides = ("difference.threshold=40.0",)
    for when, more in enumerate(((), overrides)):
        one = read_spec(clips).__class__(**{**vars(spec), "overrides": more, "tasks": ("motion",)})
        cases = run_study(one, clips.parent, cache=clips.parent / "cache").cases
        of = {names: [case for case in cases if case.clip.name in names] for names in (("one", "two"), ("held",))}
        assert found.tuned.pooled[when] == goal_value(GOAL, of["one", "two"])[0]
        assert found.held is not None and found.held.pooled[when] == goal_value(GOAL, of["held",])[0]


def test_a_change_for_the_worse_is_called_so_and_never_better(found) -> None:
    assert found.tuned.pooled[0] > found.tuned.pooled[1]
    assert found.tuned.mean[0] > found.tuned.mean[1]
    assert "better" not in found.tuned.says
    told = found.told()
    assert told["held_out"]["clips"] == ("held",) and told["better"] == "more"
    assert told["tuned"]["frame_ms"]["before"] > 0


def test_the_goal_is_judged_by_itself_and_less_may_be_better() -> None:
    way = {"p": 0.03, "p_holm": 0.4, "interval": [-0.3, -0.1], "enough": True}
    entry = {"change": -0.2, "over_clips": None, "over_frames": way}
    changes = {"tasks": {"motion": {"pooled": {"pixels": {"f": entry}, "target": {"other_blobs_per_frame": entry}}}}}
    assert judging._says(GOAL, changes) == "worse on these clips"
    assert judging._says(parse_goal("motion.target.other_blobs_per_frame"), changes) == "better on these clips"
    entry["over_clips"] = {**way, "p": 0.01}
    assert judging._says(GOAL, changes) == "worse"
    entry["over_clips"], entry["over_frames"] = None, {**way, "p": 0.2}
    assert judging._says(GOAL, changes) == "within noise"
    assert judging._says(GOAL, None) == ""


def test_knobs_that_did_not_move_change_nothing(clips) -> None:
    same = {"difference.threshold": load_config("fast").difference.threshold}
    assert with_parameters(load_config("fast"), same) == load_config("fast")
    spec = read_spec(clips)
    told = judge(spec, clips.parent, GOAL, same, ("held",), (), 1, clips.parent / "cache")
    assert told.tuned.says == "the same" and told.held is None
    assert told.tuned.changes is not None and told.tuned.changes["tasks"]["motion"]["same"] == ["held"]
