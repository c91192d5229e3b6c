"""A whole study: what it plans, that it resumes, and what becomes of bad input."""

import json
import os

import pytest

from tests.evaluation.studies import world
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies import jobs
from torchvision_dddas.evaluation.studies.cache import Cache, cache_folder
from torchvision_dddas.evaluation.studies.jobs import Workers
from torchvision_dddas.evaluation.studies.runner import plan_study, read_spec, run_jobs, run_study
from torchvision_dddas.evaluation.studies.summary import summarize


def test_no_worker_is_started_if_all_is_kept(tmp_path, monkeypatch) -> None:
    pytest.importorskip("distributed")
    spec = read_spec(world.three(tmp_path / "clips"))
    first = run_study(spec, tmp_path, cache=tmp_path / "cache")
    monkeypatch.setattr(jobs, "_start_local", lambda *given: pytest.fail("a worker was started"))
    with Workers(2) as two:
        again = run_study(spec, tmp_path, two, cache=tmp_path / "cache")
    assert again.facts["computed"] == 0 < first.facts["computed"]
    assert json.dumps(summarize(again)) == json.dumps(summarize(first))


def test_a_damaged_entry_is_noted_and_computed_again(tmp_path) -> None:
    spec = read_spec(world.three(tmp_path / "clips"))
    first = run_study(spec, tmp_path, cache=tmp_path / "cache")
    for path in (tmp_path / "cache").glob("??/*.npz"):
        path.write_bytes(path.read_bytes()[:-3])
    again = run_study(spec, tmp_path, cache=tmp_path / "cache")
    assert json.dumps(summarize(again)) == json.dumps(summarize(first))
    assert again.facts["computed"] == first.facts["computed"] and "damaged" in str(again.facts["notes"])


def test_a_clip_s_bad_input_is_told_and_the_others_go_on(tmp_path) -> None:
    study = world.three(tmp_path / "clips")
    (tmp_path / "clips" / "tracks" / "frames" / "000001.png").write_bytes(b"no picture")
    results = run_study(read_spec(study), tmp_path, cache=tmp_path / "cache")
    causes = {(case.clip.name, case.task): case.cause for case in results.cases}
    assert causes["masks", "motion"] == causes["table", "tracking"] == ""
    told = [line for line in results.left_out if "tracks" in line]
    assert told and all("\n" not in line for line in told)


def test_clips_are_picked_by_patterns_and_done_the_longest_first(tmp_path) -> None:
    spec = read_spec(world.three(tmp_path / "clips"))
    assert [job.clip.name for job in plan_study(spec, tmp_path, ["ta*", "masks"]).jobs] == ["masks", "table"]
    with pytest.raises(InputError, match="by study: nobody fits none; there are masks, table, tracks"):
        plan_study(spec, tmp_path, ["nobody"])
    ended: list[str] = []
    planned = plan_study(spec, tmp_path, ["ta*", "masks"]).jobs
    run_jobs(
        planned, Workers(1), Cache(tmp_path / "cache"), lambda e: ended.append(e.job.clip.name) if e.done else None
    )
    assert ended == ["table", "masks"]


def test_a_clip_without_truth_is_left_out_by_name(tmp_path) -> None:
    study = world.three(tmp_path / "clips")
    world.filmed(tmp_path / "clips", "bare", masks=False)
    planned = plan_study(read_spec(study), tmp_path)
    assert "bare" not in [job.clip.name for job in planned.jobs]
    assert [line for line in planned.left_out if line.startswith("bare: ") and "no truth" in line]


def test_results_are_kept_in_the_user_s_cache_folder(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", os.fspath(tmp_path))
    assert cache_folder() == tmp_path / "torchvision_dddas" / "studies"
