"""Tables of boxes: the quick way and the careful way read the same, and errors name the line."""

from pathlib import Path

import numpy as np
import pytest

from tests.evaluation.datasets.layouts import text
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets import annotations
from torchvision_dddas.evaluation.datasets.annotations import read_rows

COLUMNS = ("frame", "identity", "x", "kind")
WHOLE = '1 2 3.5 "Person_sitting" 9\n\n2 2 -1e2 Car\n'


@pytest.mark.parametrize("content", [WHOLE, WHOLE.replace(" ", ","), WHOLE.replace(" ", " , "), ""])
def test_both_ways_read_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str) -> None:
    path = text(tmp_path / "a.txt", content)
    quick = read_rows(path, COLUMNS, "kind")
    monkeypatch.setattr(annotations, "_read_fast", lambda *_: None)
    slow = read_rows(path, COLUMNS, "kind") if content else quick
    assert all(np.array_equal(quick[name], slow[name]) for name in COLUMNS)
    assert quick["kind"].tolist() == slow["kind"].tolist() == (["Person_sitting", "Car"] if content else [])
    assert quick.line.tolist() == slow.line.tolist() == ([1, 3] if content else [])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("1 2 3 Car\n\n1 2 3\n", "line 3: 3 columns; wanted frame,identity,x,kind"),
        ("1 2 nan Car\n", "line 1: x is 'nan'; wanted a number"),
        ("1 2 1_0 Car\n", "line 1: x is '1_0'; wanted a number"),
        ("1 2.5 1 Car\n", "line 1: identity is '2.5'; wanted a whole number"),
        ("9999999 2 1 Car\n", "line 1: frame is '9999999'; wanted a whole number, 1 to 1e"),
    ],
)
def test_an_error_names_the_line(tmp_path: Path, content: str, said: str) -> None:
    with pytest.raises(InputError, match=said.replace("+", r"\+")):
        read_rows(text(tmp_path / "a.txt", content), COLUMNS, "kind")
