"""Digests hold all that a result depends on: the content of files, and the code that a stage really imports."""

import os
import time
from typing import Any

import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.studies import cache
from torchvision_dddas.evaluation.studies.cache import PACKAGE, code_digest, files_digest
from torchvision_dddas.evaluation.studies.scoring import score
from torchvision_dddas.evaluation.studies.stages import STAGES


def old(path, text: str):
    path.write_text(text)
    os.utime(path, (1e9, 1e9))
    return path


def test_files_count_by_their_content_and_order_not_by_name_or_time(tmp_path) -> None:
    one, same, other = (old(tmp_path / name, text) for name, text in (("a", "one"), ("b", "one"), ("c", "two")))
    files = files_digest
    assert files([one]) == files([same]) != files([other])
    assert files([one, other]) != files([other, one])


def test_a_file_is_read_again_only_once_it_was_touched(tmp_path, monkeypatch) -> None:
    path, memory = old(tmp_path / "a", "one"), tmp_path / "memory"
    first = files_digest([path], memory)
    with monkeypatch.context() as blind:
        blind.setattr(cache, "_file_digest", lambda path: pytest.fail("it was read again"))
        assert files_digest([path], memory) == first
    time.sleep(0.05)
    old(path, "two")  # of the same size and with its old time
    assert files_digest([path], memory) != first


def test_a_file_written_just_now_is_not_remembered(tmp_path) -> None:
    """It may be written again within one tick of its time stamp."""
    (tmp_path / "a").write_text("one")
    files_digest([tmp_path / "a"], tmp_path / "memory")
    assert not (tmp_path / "memory").exists()


def test_a_file_that_is_gone_is_named(tmp_path) -> None:
    with pytest.raises(InputError, match=r"gone\.png cannot be read"):
        files_digest([tmp_path / "gone.png"])


def changed_by(monkeypatch, *paths: str) -> dict[str, bool]:
    """Whose digest of code another content of some files changes."""
    functions: dict[str, Any] = dict[str, Any](STAGES.items()) | {"score": score}
    before = {name: code_digest.__wrapped__(function) for name, function in functions.items()}
    real = cache._file_digest
    other = {PACKAGE / path for path in paths}
    assert all(path.is_file() for path in other)
    monkeypatch.setattr(cache, "_file_digest", lambda path: "other" if path in other else real(path))
    return {name: code_digest.__wrapped__(function) != before[name] for name, function in functions.items()}


@pytest.mark.parametrize(
    ("path", "changes", "leaves"),
    [
        ("detection/detector.py", {"motion", "location"}, {"people", "score"}),
        ("tracking/__init__.py", {"tracking", "association", "location"}, {"people", "score"}),
        ("evaluation/metrics/boxes.py", {"score"}, set(STAGES)),
        ("people/detector.py", {"people"}, {"motion", "tracking", "association", "score"}),
        ("evaluation/studies/stages.py", set(STAGES), {"score"}),
        ("graphs/manifest.json", {*STAGES, "score"}, set()),
        ("cli/evaluate.py", set(), {*STAGES, "score"}),
        ("evaluation/report/__init__.py", set(), {*STAGES, "score"}),
    ],
)
def test_changed_code_changes_the_digests_of_what_imports_it_and_no_others(monkeypatch, path, changes, leaves) -> None:
    changed = {name for name, differs in changed_by(monkeypatch, path).items() if differs}
    assert changed >= changes and not changed & leaves
