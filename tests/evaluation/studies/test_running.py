"""A whole study: interrupted or not, with whatever workers, its measures are the same to the last byte."""

import json
import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.evaluation.studies import world
from tests.evaluation.studies.test_jobs import linux, workers_of
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies.running import cache_folder, order, plan, run_study
from torchvision_dddas.evaluation.studies.spec import read_spec
from torchvision_dddas.evaluation.studies.summary import summary

DDDAS = [sys.executable, "-c", "from torchvision_dddas.cli import main; main()"]


def command(study: Path, out: Path, cache: Path, *more: str) -> list[str]:
    return [*DDDAS, "evaluate", "--dataset", str(study), "--out", str(out), "--cache", str(cache), *more]


def killed_after(line: str, words: list[str]) -> list[str]:
    """Run a command and kill it once a line of stderr holds some words; the lines until then."""
    told: list[str] = []
    with subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as run:
        assert run.stderr is not None
        for text in run.stderr:
            told.append(text)
            if line in text:
                break
        ends = [os.pidfd_open(pid) for pid in workers_of(run.pid)]
        run.send_signal(signal.SIGKILL)
        run.wait()
        assert run.returncode == -signal.SIGKILL
    for end in ends:  # nobody is left to compute for nobody
        assert select.select([end], [], [], 60.0)[0]
        os.close(end)
    return told


@linux
def test_a_study_killed_twice_and_resumed_gives_the_same_bytes(tmp_path) -> None:
    study = world.three(tmp_path / "clips")
    for path in (tmp_path / "clips").rglob("*.*"):
        os.utime(path, (1e9, 1e9))
    whole, out = tmp_path / "whole", tmp_path / "out"
    subprocess.run(command(study, whole, tmp_path / "other", "--jobs", "2", "--quiet"), check=True)
    words = command(study, out, tmp_path / "cache", "--jobs", "1")
    killed_after("1 of 3", words)
    assert json.loads((out / "run.json").read_text())["state"] == "running"
    assert not (out / "metrics.json").exists()
    told = killed_after("2 of 3", words)
    assert any("kept" in line for line in told)
    last = subprocess.run(words, check=True, capture_output=True, text=True)
    assert last.stderr.count("kept") > 0
    assert (out / "metrics.json").read_bytes() == (whole / "metrics.json").read_bytes()
    assert json.loads((out / "run.json").read_text())["state"] == "complete"


def test_no_worker_is_started_where_all_is_kept(tmp_path, monkeypatch) -> None:
    from torchvision_dddas.evaluation.studies import running

    spec = read_spec(world.three(tmp_path / "clips"))
    for path in (tmp_path / "clips").rglob("*.*"):
        os.utime(path, (1e9, 1e9))
    first = run_study(spec, tmp_path, jobs=0, cache=tmp_path / "cache")
    shared: list[str] = []

    def share(jobs, *more):
        shared.extend(job.clip.name for job in jobs)
        yield from ()

    monkeypatch.setattr(running, "share", share)
    again = run_study(spec, tmp_path, jobs=2, cache=tmp_path / "cache")
    assert shared == []
    assert again.facts["computed"] == 0 < first.facts["computed"]
    assert json.dumps(summary(again)) == json.dumps(summary(first))


def test_a_clip_s_bad_input_is_told_and_the_others_go_on(tmp_path) -> None:
    study = world.three(tmp_path / "clips")
    (tmp_path / "clips" / "tracks" / "frames" / "000001.png").write_bytes(b"no picture")
    results = run_study(read_spec(study), tmp_path, jobs=0, cache=tmp_path / "cache")
    causes = {(case.clip.name, case.task): case.cause for case in results.cases}
    assert causes["masks", "motion"] == causes["table", "tracking"] == ""
    told = [line for line in results.left_out if "tracks" in line]
    assert told and all("\n" not in line for line in told)


def test_a_damaged_entry_is_told_and_computed_again(tmp_path) -> None:
    spec = read_spec(world.three(tmp_path / "clips"))
    first = run_study(spec, tmp_path, jobs=0, cache=tmp_path / "cache")
    for path in (tmp_path / "cache").glob("??/*.npz"):
        path.write_bytes(path.read_bytes()[:-3])
    again = run_study(spec, tmp_path, jobs=0, cache=tmp_path / "cache")
    assert json.dumps(summary(again)) == json.dumps(summary(first))
    assert again.facts["computed"] == first.facts["computed"] and again.facts["notes"]


def test_clips_are_picked_by_patterns(tmp_path) -> None:
    spec = read_spec(world.three(tmp_path / "clips"))
    assert [job.clip.name for job in plan(spec, tmp_path, ["ta*", "masks"]).jobs] == ["masks", "table"]
    with pytest.raises(InputError, match="by study: nobody fits none; there are masks, table, tracks"):
        plan(spec, tmp_path, ["nobody"])


def test_a_clip_without_truth_is_left_out_by_name(tmp_path) -> None:
    study = world.three(tmp_path / "clips")
    world.filmed(tmp_path / "clips", "bare", masks=False)
    planned = plan(read_spec(study), tmp_path)
    assert "bare" not in [job.clip.name for job in planned.jobs]
    assert [line for line in planned.left_out if line.startswith("bare: ") and "no truth" in line]


def test_the_longest_clips_are_done_first(tmp_path) -> None:
    jobs = plan(read_spec(world.three(tmp_path / "clips")), tmp_path).jobs
    assert [job.clip.name for job in order(jobs)] == ["tracks", "table", "masks"]


def test_results_are_kept_in_the_user_s_cache_folder(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "torchvision_dddas" / "studies"
