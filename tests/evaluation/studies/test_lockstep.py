"""Clips of a study that go through torch together, before the jobs are shared: the same study, to the last digit."""

import pytest

from tests.evaluation.studies import world
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies import lockstep, working
from torchvision_dddas.evaluation.studies.cache import Cache
from torchvision_dddas.evaluation.studies.record import Source, Spec
from torchvision_dddas.evaluation.studies.running import plan, run_study
from torchvision_dddas.evaluation.studies.summary import summary

pytest.importorskip("torch")


@pytest.fixture(scope="module")
def spec(tmp_path_factory) -> Spec:
    folder = tmp_path_factory.mktemp("together")
    for seed, name in enumerate(("a", "b", "c")):
        world.filmed(folder, name, seed, frames=6 + seed)
    return Spec("study", (Source("folder", folder),), ("motion",), "fast", (), "torch")


def test_a_study_of_clips_taken_together_is_that_of_each_alone(spec, tmp_path, monkeypatch) -> None:
    alone = summary(run_study(spec, tmp_path, 0, cache=tmp_path / "alone"))

    def none(*_, **__):
        raise AssertionError("a clip was searched alone")

    monkeypatch.setattr(working, "find", none)
    for together in (2, 3):
        results = run_study(spec, tmp_path, 0, cache=tmp_path / str(together), together=together)
        assert not results.left_out and summary(results) == alone


def test_what_is_kept_is_not_found_again(spec, tmp_path) -> None:
    jobs, cache = plan(spec, tmp_path).jobs, Cache(tmp_path / "cache")
    assert lockstep.motion_ahead(jobs, cache, 2) == 3
    assert lockstep.motion_ahead(jobs, cache, 2) == 0


def test_a_group_that_fails_is_told_and_its_clips_are_taken_alone(spec, tmp_path, monkeypatch) -> None:
    def full(*_, **__):
        raise MemoryError("no room")

    monkeypatch.setattr(lockstep, "find_motion_together", full)
    results = run_study(spec, tmp_path, 0, cache=tmp_path / "cache", together=3)
    assert len(results.cases) == 3 and not results.left_out
    (note,) = results.facts["notes"]
    assert "could not be taken together (MemoryError: no room)" in note and "\n" not in note


def test_a_clip_that_cannot_be_read_is_left_to_its_own_job(spec, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(lockstep, "find_motion_together", lambda clips, *_: {c.name: InputError("bad") for c in clips})
    assert lockstep.motion_ahead(plan(spec, tmp_path).jobs, Cache(tmp_path / "cache"), 3) == 0
