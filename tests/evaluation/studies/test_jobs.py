"""What is kept is not computed again; a change computes again what depends on it, and nothing else."""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.evaluation.studies import world
from torchvision_dddas.config import load_config
from torchvision_dddas.evaluation.datasets.kinds import read
from torchvision_dddas.evaluation.datasets.record import Source
from torchvision_dddas.evaluation.studies import jobs
from torchvision_dddas.evaluation.studies.cache import Cache
from torchvision_dddas.evaluation.studies.jobs import Job, do_job, find_cached, make_keys
from torchvision_dddas.evaluation.studies.records import Task

TASKS: tuple[Task, ...] = ("motion", "tracking", "association")
ALL = ["motion", "motion: score", "tracking", "tracking: score", "association", "association: score"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A cache in which all of a clip is kept, and the clip."""
    place = tmp_path_factory.mktemp("data")
    world.followed(place / "clips", "tracks", 2)
    assert computed(place, job_of(place)) == ALL
    return place


def job_of(place, *overrides, interval=1):
    (clip,) = read(Source("folder", place / "clips"), Path()).clips
    return Job(0, clip, TASKS, load_config(None, overrides), "onboard", interval)


def do(place, job, cache=None):
    return do_job(job, make_keys(job, None), cache or Cache(place / "cache"))


def computed(place, job):
    done = do(place, job)
    assert [d.cause for d in done] == [""] * len(done)
    return [stage for d in done for stage in d.computed]


@pytest.mark.parametrize(
    ("change", "again"),
    [
        ("difference.threshold=4.5", ALL[:4]),
        ("track.memory_frames=9", ALL[2:]),
        pytest.param("registration.keypoints=400", ALL, marks=pytest.mark.slow),
        pytest.param("paper.window=2", ALL[2:], marks=pytest.mark.slow),
        ("people.search=regions", []),
        ("live.calm_s=9.0", []),
    ],
)
def test_a_changed_parameter_computes_again_what_depends_on_it_and_nothing_else(folder, change, again) -> None:
    assert computed(folder, job_of(folder, change)) == again


def test_a_changed_interval_leaves_what_moves(folder) -> None:
    """Motion is scored by the interval's key too, which costs nothing worth saving."""
    stages = computed(folder, job_of(folder, interval=2))
    assert [stage for stage in stages if "score" not in stage] == ["tracking", "association"]


def test_a_clip_is_known_by_its_content_not_by_its_place_or_name(folder, tmp_path) -> None:
    world.followed(tmp_path / "clips", "renamed", 2)
    (clip,) = read(Source("folder", tmp_path / "clips"), Path()).clips
    assert computed(folder, replace(job_of(folder), clip=clip)) == []
    pictures = sorted((tmp_path / "clips" / "renamed" / "frames").iterdir())
    pictures[1].write_bytes(pictures[2].read_bytes())
    assert computed(folder, replace(job_of(folder), clip=clip)) == ALL


def test_a_changed_truth_scores_again_and_finds_again_only_what_was_made_of_it(folder) -> None:
    job = job_of(folder)
    tracks = job.clip.truth.tracks
    fewer = replace(job.clip.truth, tracks=tracks.at(tracks.frame != 2))
    again = computed(folder, replace(job, clip=replace(job.clip, truth=fewer)))
    assert again == ["motion: score", "tracking: score", "association", "association: score"]


def test_other_code_is_another_key(folder, monkeypatch) -> None:
    job, files = job_of(folder), None
    before = make_keys(job, files)
    monkeypatch.setattr(jobs, "code_digest", lambda function, engine="": "another")
    after = make_keys(job, files)
    for task in TASKS:
        assert before.found[task] != after.found[task] and before.scored[task] != after.scored[task]


def test_a_job_is_kept_only_if_all_of_it_is_whole(folder) -> None:
    cache, job = Cache(folder / "cache"), job_of(folder)
    keys = make_keys(job, None)
    assert find_cached(job, keys, cache) == do(folder, job)
    cache.path(keys.found["tracking"]).write_bytes(b"damaged")
    assert find_cached(job, keys, cache) is None
    assert [stage for d in do(folder, job, cache) for stage in d.computed] == ["tracking"]
    assert len(cache.notes) == 1 and "computed again" in cache.notes[0]


def test_bad_input_of_one_task_leaves_the_others(folder) -> None:
    job = job_of(folder)
    far = job.clip.truth.tracks._replace(frame=job.clip.truth.tracks.frame + 100)
    done = do(folder, replace(job, clip=replace(job.clip, truth=replace(job.clip.truth, tracks=far))))
    assert done[0].cause == "" and "goes on to frame" in done[2].cause


def test_a_file_that_is_gone_is_the_cause_of_every_task_that_reads_it(folder, tmp_path) -> None:
    world.followed(tmp_path / "clips", "tracks", 2)
    job = job_of(tmp_path)
    job.clip.pictures[3].unlink()
    assert all("cannot be read" in d.cause for d in do(folder, job))


def test_a_fault_of_the_program_is_a_cause_with_its_trace(folder, tmp_path, monkeypatch) -> None:
    def broken(*given, **more):
        raise KeyError("x")

    monkeypatch.setattr(jobs, "find", broken)
    done = do(tmp_path, job_of(folder))
    assert all("a fault of the program, KeyError: 'x'" in d.cause and "in broken" in d.trace for d in done)
