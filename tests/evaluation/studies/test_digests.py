"""A result's key holds all that the result depends on, and nothing else."""

import json
import os
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest

from tests.evaluation.studies import world
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies import digests


def old(path, text: str) -> None:
    path.write_text(text)
    os.utime(path, (1e9, 1e9))


def test_a_file_counts_by_what_it_holds_not_by_its_name_or_time(tmp_path) -> None:
    old(tmp_path / "a", "one")
    (tmp_path / "b").write_text("one")
    files = digests.Files(None)
    assert files.digest([tmp_path / "a"]) == files.digest([tmp_path / "b"])
    (tmp_path / "b").write_text("two")
    assert files.digest([tmp_path / "a"]) != files.digest([tmp_path / "b"])


def test_a_file_that_was_not_touched_is_read_once(tmp_path) -> None:
    old(tmp_path / "a", "one")
    first = digests.Files(tmp_path / "memory").digest([tmp_path / "a"])
    assert digests.Files(tmp_path / "memory", read=False).digest([tmp_path / "a"]) == first
    old(tmp_path / "a", "three")
    with pytest.raises(digests.UnreadError):
        digests.Files(tmp_path / "memory", read=False).digest([tmp_path / "a"])


def test_a_file_of_the_same_size_and_with_its_old_time_is_read_again(tmp_path) -> None:
    old(tmp_path / "a", "one")
    memory = tmp_path / "memory"
    first = digests.Files(memory).digest([tmp_path / "a"])
    time.sleep(0.05)
    old(tmp_path / "a", "two")
    assert digests.Files(memory).digest([tmp_path / "a"]) != first


def test_a_file_written_just_now_is_not_remembered(tmp_path) -> None:
    """It may be written again without a new time."""
    (tmp_path / "a").write_text("one")
    digests.Files(tmp_path / "memory").digest([tmp_path / "a"])
    with pytest.raises(digests.UnreadError):
        digests.Files(tmp_path / "memory", read=False).digest([tmp_path / "a"])


def test_files_are_in_order(tmp_path) -> None:
    old(tmp_path / "a", "one")
    old(tmp_path / "b", "two")
    files = digests.Files(None)
    assert files.digest([tmp_path / "a", tmp_path / "b"]) != files.digest([tmp_path / "b", tmp_path / "a"])


def test_a_file_that_is_gone_is_named(tmp_path) -> None:
    with pytest.raises(InputError, match=r"gone\.png cannot be read"):
        digests.Files(None).digest([tmp_path / "gone.png"])


@pytest.mark.parametrize(
    ("one", "other"),
    [
        *((1, 1.0), ("1", 1), (("a", "bc"), ("ab", "c")), ((1, (2,)), ((1, 2),)), (None, "None"), (True, 1)),
        *((np.zeros(2), np.zeros((2, 1))), (np.zeros(2), np.zeros(2, int)), ({"a": 1}, {"a": 2})),
    ],
)
def test_what_differs_has_another_digest(one, other) -> None:
    assert digests.of(one) != digests.of(other)


def test_the_order_of_names_does_not_matter() -> None:
    assert digests.of({"a": 1, "b": 2}) == digests.of({"b": 2, "a": 1})


SCRIPT = """
    import json, sys
    from pathlib import Path
    from torchvision_dddas.evaluation.datasets.kinds import read
    from torchvision_dddas.config import load_config
    from torchvision_dddas.evaluation.studies.record import Source
    from torchvision_dddas.evaluation.studies.stages import find, upstream
    before = set(sys.modules)
    for clip in read(Source("folder", Path(sys.argv[1])), Path()).clips:
        for task in sys.argv[2:]:
            need = upstream(clip, task)
            found = find(clip, task, load_config(), before=None if need is None else find(clip, need, load_config()))
    for name in set(sys.modules):
        module = sys.modules[name]
        if name.startswith("torchvision_dddas.") and getattr(module, "__file__", None):
            print(module.__file__)
"""


def test_all_code_that_stages_load_is_in_the_digest_of_what_they_find(tmp_path) -> None:
    """But for what reads data sets and keeps results, which the files' digests and the tests of these answer for."""
    world.followed(tmp_path / "clips", "tracks")
    command = [sys.executable, "-c", textwrap.dedent(SCRIPT), str(tmp_path / "clips")]
    done = subprocess.run([*command, "motion", "tracking", "association"], capture_output=True, text=True, check=True)
    loaded = {os.path.relpath(path, digests.PACKAGE) for path in done.stdout.split()}
    kept = ("studies/memory.py", "studies/__init__.py", "studies/scored.py")
    covered = ("datasets", "metrics", "errors.py", "__init__.py", "shapes.py", "sinks", *kept)
    missing = [name for name in sorted(loaded) if not name.startswith((*digests.FINDS, *covered))]
    assert "following.py" in loaded and missing == []


def test_all_code_that_scores_is_in_the_digest_of_scores() -> None:
    script = """
        import json, sys
        from torchvision_dddas.evaluation.studies.scoring import score
        from torchvision_dddas.evaluation.studies.placing_score import score_places
        files = [getattr(m, "__file__", None) for n, m in sys.modules.items() if n.startswith("torchvision_dddas.")]
        print(json.dumps([f for f in files if f]))
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=True)
    loaded = {os.path.relpath(path, digests.PACKAGE) for path in json.loads(done.stdout)}
    covered = ("errors.py", "shapes.py", "sinks", "studies/__init__.py", "studies/digests.py", "studies/stored.py")
    missing = [name for name in sorted(loaded) if not name.startswith((*digests.SCORES, *covered))]
    assert "studies/scoring.py" in loaded and missing == []
