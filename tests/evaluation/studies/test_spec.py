"""A study's file: what it may say, and one line for what it may not."""

from pathlib import Path

import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Source
from torchvision_dddas.evaluation.studies.records import Spec
from torchvision_dddas.evaluation.studies.runner import read_spec

SET = '[[dataset]]\nkind = "bms"\nfolder = "data"\n'


def spec(tmp_path: Path, content: str) -> Spec:
    path = tmp_path / "study.toml"
    path.write_text(content, encoding="utf-8")
    return read_spec(path)


def test_a_data_set_is_enough(tmp_path: Path) -> None:
    assert spec(tmp_path, SET) == Spec("study", (Source("bms", Path("data")),))


def test_everything_said(tmp_path: Path) -> None:
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
    assert spec(tmp_path, content) == Spec(
        "all of it",
        (
            Source("bms", Path("data"), ("cars*", "people1"), {"rate_hz": 25}),
            Source("folder", Path("/elsewhere"), ("*",), {"still": ["roof"]}),
        ),
        ("motion", "tracking"),
        "fast",
        ("track.history=4", "motion.blur_px=3"),
        "onboard",
        5,
    )


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("", "names no data set; wanted [[dataset]] with kind and folder, once or more"),
        ("dataset = 3", "names no data set"),
        ("[dataset]\nkind = 'bms'\nfolder = 'x'", "names no data set; wanted [[dataset]]"),
        ("name = 'a", "is not valid TOML"),
        ("task = ['motion']\n" + SET, "has no key 'task'; wanted name, tasks, config, set, backend, interval, dataset"),
        ("tasks = ['flying']\n" + SET, "tasks must be some of motion, tracking, association, people"),
        ("tasks = 'motion'\n" + SET, "tasks must be a list of texts, got 'motion'"),
        ("set = [1]\n" + SET, "set must be a list of texts, got [1]"),
        ("backend = 'gpu'\n" + SET, "backend must be one of auto, torch, onboard, got 'gpu'"),
        ("interval = 0\n" + SET, "interval must be a whole number of frames from 1 to 1000, got 0"),
        ("interval = true\n" + SET, "1000, got True"),
        ("interval = 1.5\n" + SET, "1000, got 1.5"),
        ("name = 3\n" + SET, "name must be a text, got 3"),
        ("name = '../up'\n" + SET, "name must consist of letters, digits, blanks"),
        ("[[dataset]]\nfolder = 'x'", "data set 1 has no kind; wanted kind = one of folder, bms"),
        (SET + "[[dataset]]\nkind = 'bms'", "data set 2 has no folder; wanted kind = one of folder, bms"),
        (SET + "[[dataset]]\nkind = 'imagenet'\nfolder = 'x'", "data set 2: 'imagenet' is no kind of data set; wanted"),
        ("[[dataset]]\nkind = 'bms'\nfolder = ''", "data set 1 has no folder"),
        ("[[dataset]]\nkind = 'bms'\nfolder = 3", "data set 1: folder must be a text, got 3"),
        (SET + "clips = []", "data set 1: clips is empty; wanted patterns of names"),
        (SET + "clips = 'cars*'", "data set 1: clips must be a list of texts, got 'cars*'"),
    ],
)
def test_what_will_not_do_is_one_line_that_names_the_file(tmp_path: Path, content: str, line: str) -> None:
    with pytest.raises(InputError) as caught:
        spec(tmp_path, content)
    assert line in str(caught.value)
    assert str(tmp_path / "study.toml") in str(caught.value)


def test_a_file_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"study .*absent\.toml cannot be read: No such file"):
        read_spec(tmp_path / "absent.toml")
