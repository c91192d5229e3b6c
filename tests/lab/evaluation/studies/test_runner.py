"""A whole study: what its file may say, what it plans, that it resumes, and what becomes of bad input."""

import json
from pathlib import Path

import pytest

from tests.lab.evaluation.studies import world
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.datasets.record import DatasetSource
from torchvision_dddas.lab.evaluation.studies.cache import Cache
from torchvision_dddas.lab.evaluation.studies.jobs import Workers
from torchvision_dddas.lab.evaluation.studies.records import Spec
from torchvision_dddas.lab.evaluation.studies.runner import plan_study, read_spec, run_jobs, run_study
from torchvision_dddas.lab.evaluation.studies.summary import summarize

SET = '[[dataset]]\nkind = "bms"\nfolder = "data"\n'


def spec(tmp_path: Path, content: str) -> Spec:
    (tmp_path / "study.toml").write_text(content, encoding="utf-8")
    return read_spec(tmp_path / "study.toml")


def test_a_file_says_everything_or_only_its_data_set(tmp_path: Path) -> None:
    content = f"""
        name = "all of it"
        tasks = ["tracking", "motion"]
        config = "fast"
        set = ["track.history=4", "motion.blur_px=3"]
        backend = "onboard"
        interval = 5
        {SET}
        clips = ["cars*", "people1"]
        rate_hz = 25
        [[dataset]]
        kind = "folder"
        folder = "/elsewhere"
        still = ["roof"]
    """
    sources = (
        DatasetSource("bms", Path("data"), ("cars*", "people1"), {"rate_hz": 25}),
        DatasetSource("folder", Path("/elsewhere"), ("*",), {"still": ["roof"]}),
    )
    overrides = ("track.history=4", "motion.blur_px=3")
    whole = Spec("all of it", sources, ("motion", "tracking"), "fast", overrides, "onboard", 5)
    assert spec(tmp_path, content) == whole
    assert spec(tmp_path, SET) == Spec("study", (DatasetSource("bms", Path("data")),))


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("[dataset]\nkind = 'bms'\nfolder = 'x'", "names no data set; wanted [[dataset]] with kind and folder"),
        ("task = ['motion']\n" + SET, "has no key 'task'; wanted name, tasks, config, set, backend, interval, dataset"),
        ("tasks = ['flying']\n" + SET, "tasks must be some of motion, tracking, association, people"),
        ("set = [1]\n" + SET, "set must be a list of texts, got [1]"),
        ("backend = 'gpu'\n" + SET, "backend must be one of auto, torch, onboard, got 'gpu'"),
        ("interval = true\n" + SET, "interval must be a whole number of frames from 1 to 1000, got True"),
        ("name = '../up'\n" + SET, "name must consist of letters, digits, blanks"),
        (SET + "[[dataset]]\nkind = 'bms'", "data set 2 has no folder; wanted kind = one of folder, bms"),
        (
            SET + "[[dataset]]\nkind = 'imagenet'\nfolder = 'x'",
            "data set 2: 'imagenet' is not a kind of data set; wanted",
        ),
        ("[[dataset]]\nkind = 'bms'\nfolder = 3", "data set 1: folder must be a text, got 3"),
        (SET + "clips = []", "data set 1: clips is empty; wanted patterns of names"),
    ],
)
def test_a_bad_file_is_one_line_that_names_it(tmp_path: Path, content: str, line: str) -> None:
    with pytest.raises(InputError) as caught:
        spec(tmp_path, content)
    assert line in str(caught.value) and str(tmp_path / "study.toml") in str(caught.value)


@pytest.fixture
def study(tmp_path):
    return read_spec(world.three(tmp_path / "clips"))


@pytest.mark.slow
def test_a_repeated_study_starts_no_worker_and_gives_the_same_bytes(study, tmp_path, monkeypatch) -> None:
    pytest.importorskip("distributed")
    left = tmp_path / "cache/ab/.abc.0123456789abcdef.part.npz"  # by a worker that was killed
    left.parent.mkdir(parents=True)
    left.touch()
    first = run_study(study, tmp_path, cache=tmp_path / "cache")
    assert not left.exists()
    with monkeypatch.context() as alone:
        alone.setattr(
            "torchvision_dddas.lab.evaluation.studies.cluster.start_local",
            lambda *given: pytest.fail("a worker was started"),
        )
        with Workers(2) as two:
            again = run_study(study, tmp_path, two, cache=tmp_path / "cache")
    assert again.facts["computed"] == 0 < first.facts["computed"]
    assert (first.facts["kept"], again.facts["kept"]) == (0, len(again.cases))
    for path in (tmp_path / "cache").glob("??/*.npz"):
        path.write_bytes(path.read_bytes()[:-3])
    damaged = run_study(study, tmp_path, cache=tmp_path / "cache")
    assert damaged.facts["computed"] == first.facts["computed"] and "damaged" in str(damaged.facts["notes"])
    assert json.dumps(summarize(damaged)) == json.dumps(summarize(again)) == json.dumps(summarize(first))


def test_bad_input_of_a_clip_is_left_out_and_the_others_go_on(study, tmp_path) -> None:
    (tmp_path / "clips" / "tracks" / "frames" / "000001.png").write_bytes(b"no picture")
    world.filmed(tmp_path / "clips", "bare", masks=False)
    results = run_study(study, tmp_path, cache=tmp_path / "cache")
    causes = {(case.clip.name, case.task): case.cause for case in results.cases}
    assert causes["masks", "motion"] == causes["table", "tracking"] == ""
    lines = [line for line in results.left_out if "tracks" in line]
    assert lines and all("\n" not in line for line in lines)
    assert any(line.startswith("bare: ") and "no truth" in line for line in results.left_out)


def test_clips_are_picked_by_patterns_and_done_the_longest_first(study, tmp_path) -> None:
    planned = plan_study(study, tmp_path, ["ta*", "masks"]).jobs
    assert [job.clip.name for job in planned] == ["masks", "table"]
    with pytest.raises(InputError, match="by study: nobody fits none; there are masks, table, tracks"):
        plan_study(study, tmp_path, ["nobody"])
    ended: list[str] = []
    store = Cache(tmp_path / "cache")
    run_jobs(planned, Workers(1), store, lambda event: ended.append(event.job.clip.name) if event.done else None)
    assert ended == ["table", "masks"]
