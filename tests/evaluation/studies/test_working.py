"""What is kept is not computed again; a change computes again what depends on it, and nothing else."""

import os
from dataclasses import replace
from pathlib import Path

import pytest

from tests.evaluation.studies import world
from torchvision_dddas.config import load_config
from torchvision_dddas.evaluation.datasets.kinds import read
from torchvision_dddas.evaluation.studies import digests, working
from torchvision_dddas.evaluation.studies.cache import Cache
from torchvision_dddas.evaluation.studies.digests import Files
from torchvision_dddas.evaluation.studies.record import Source, Task
from torchvision_dddas.evaluation.studies.working import Job, kept, work

TASKS: tuple[Task, ...] = ("motion", "tracking", "association")
ALL = ["motion", "motion: score", "tracking", "tracking: score", "association", "association: score"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A cache in which all of a clip is kept, and the clip."""
    place = tmp_path_factory.mktemp("data")
    world.followed(place / "clips", "tracks", 2)
    assert computed(place, job_of(place)) == ALL
    return place


def job_of(place, *overrides, interval=1, backend="onboard"):
    (clip,) = read(Source("folder", place / "clips"), Path()).clips
    return Job(0, clip, TASKS, load_config(None, overrides), backend, interval)


def computed(place, job):
    done = work(job, Cache(place / "cache"), Files(None))
    assert [d.cause for d in done] == [""] * len(done)
    return [stage for d in done for stage in d.computed]


def test_what_is_kept_is_not_computed_again(folder) -> None:
    assert computed(folder, job_of(folder)) == []


@pytest.mark.parametrize(
    ("change", "again"),
    [
        ("difference.threshold=4.5", ALL[:4]),
        ("registration.keypoints=400", ALL),
        ("track.memory_frames=9", ALL[2:]),
        ("paper.window=2", ALL[2:]),
        ("people.search=regions", []),
        ("live.calm_s=9.0", []),
    ],
)
def test_a_changed_parameter_computes_again_what_depends_on_it_and_nothing_else(folder, change, again) -> None:
    assert computed(folder, job_of(folder, change)) == again


def test_a_changed_interval_leaves_what_moves(folder) -> None:
    """Motion is scored by the interval's key too, which costs nothing worth saving."""
    assert [stage for stage in computed(folder, job_of(folder, interval=2)) if "score" not in stage] == [
        "tracking",
        "association",
    ]


def test_the_same_clip_elsewhere_and_by_another_name_is_known(folder, tmp_path) -> None:
    world.followed(tmp_path / "clips", "renamed", 2)
    (clip,) = read(Source("folder", tmp_path / "clips"), Path()).clips
    assert computed(folder, replace(job_of(folder), clip=clip)) == []


def test_a_changed_picture_computes_all_again(folder, tmp_path) -> None:
    world.followed(tmp_path / "clips", "tracks", 2)
    pictures = sorted((tmp_path / "clips" / "tracks" / "frames").iterdir())
    pictures[1].write_bytes(pictures[2].read_bytes())
    (clip,) = read(Source("folder", tmp_path / "clips"), Path()).clips
    assert computed(folder, replace(job_of(folder), clip=clip)) == ALL


def test_a_changed_truth_scores_again_and_finds_again_only_what_was_made_of_it(folder) -> None:
    job = job_of(folder)
    tracks = job.clip.truth.tracks
    fewer = replace(job.clip.truth, tracks=tracks.at(tracks.frame != 2))
    again = computed(folder, replace(job, clip=replace(job.clip, truth=fewer)))
    assert again == ["motion: score", "tracking: score", "association", "association: score"]


def test_other_code_computes_all_again(folder, monkeypatch) -> None:
    monkeypatch.setattr(digests, "code", lambda which, backend="": f"another {len(which)}")
    assert computed(folder, job_of(folder)) == ALL


def test_a_damaged_entry_is_computed_again_and_the_rest_is_not(folder) -> None:
    job = job_of(folder)
    told: list[str] = []
    cache = Cache(folder / "cache", told.append)
    done = work(job, cache, Files(None))
    cache.place(done[1].found).write_bytes(b"damaged")
    again = work(job, cache, Files(None))
    assert [stage for d in again for stage in d.computed] == ["tracking"]
    assert len(told) == 1 and "computed again" in told[0]
    assert [d.found for d in again] == [d.found for d in done]


def test_bad_input_of_one_task_leaves_the_others(folder) -> None:
    job = job_of(folder)
    far = job.clip.truth.tracks._replace(frame=job.clip.truth.tracks.frame + 100)
    done = work(
        replace(job, clip=replace(job.clip, truth=replace(job.clip.truth, tracks=far))),
        Cache(folder / "cache"),
        Files(None),
    )
    assert done[0].cause == "" and "goes on to frame" in done[2].cause


def test_a_fault_of_the_program_is_a_cause_with_its_trace(folder, monkeypatch) -> None:
    def broken(*given, **more):
        raise KeyError("x")

    monkeypatch.setattr(working, "find", broken)
    monkeypatch.setattr(digests, "code", lambda which, backend="": "third")
    done = work(job_of(folder), Cache(folder / "cache"), Files(None))
    assert all("a fault of the program, KeyError: 'x'" in d.cause and "in broken" in d.trace for d in done)


def test_a_job_is_known_to_be_kept_without_reading_its_files(folder, tmp_path) -> None:
    for path in (folder / "clips").rglob("*"):
        if path.is_file():
            os.utime(path, (1e9, 1e9))
    cache, job = Cache(folder / "cache"), job_of(folder)
    assert kept(job, cache, Files(tmp_path / "memory", read=False)) is None
    done = work(job, cache, Files(tmp_path / "memory"))
    known = kept(job, cache, Files(tmp_path / "memory", read=False))
    assert known is not None and [d.scored for d in known] == [d.scored for d in done]
    cache.place(done[0].scored).unlink()
    assert kept(job, cache, Files(tmp_path / "memory", read=False)) is None
