"""Tables of boxes read fast and with care, and sizes of pictures from the heads of their files."""

from pathlib import Path

import numpy as np
import pytest

from tests.lab.evaluation.datasets.layouts import pictures, text
from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.evaluation.datasets.files import size_of
from torchvision_dddas.lab.evaluation.metrics import text_rows
from torchvision_dddas.lab.evaluation.metrics.text_rows import read_columns

COLUMNS = ("frame", "identity", "x", "kind")
WHOLE = '1 2 3.5 "Person_sitting" 9\n\n2 2 -1e2 Car\n'


@pytest.mark.parametrize("content", [WHOLE, WHOLE.replace(" ", ","), WHOLE.replace(" ", " , ")])
def test_the_fast_and_the_careful_way_read_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str
) -> None:
    path = text(tmp_path / "a.txt", content)
    fast = read_columns(path, COLUMNS, "kind")
    monkeypatch.setattr(text_rows, "_read_fast", lambda *_: None)
    slow = read_columns(path, COLUMNS, "kind")
    assert all(np.array_equal(fast[name], slow[name]) for name in COLUMNS)
    assert fast["kind"].tolist() == slow["kind"].tolist() == ["Person_sitting", "Car"]
    assert fast.line.tolist() == slow.line.tolist() == [1, 3]


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".ppm", ".pgm", ".webp", ".tif"])
def test_the_size_is_that_of_the_picture_and_the_head_of_the_file_is_enough(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    pictures(tmp_path, [path.name], size=(137, 121))
    assert size_of(path) == (137, 121)
    if suffix not in (".webp", ".tif"):
        path.write_bytes(path.read_bytes()[:300])
        assert size_of(path) == (137, 121)


@pytest.mark.parametrize("content", [b"", b"\xff\xd8", b"\x89PNG\r\n\x1a\n", b"BM", b"P6 3 ", b"no picture at all"])
def test_a_file_that_is_no_picture_is_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.png is not a readable picture"):
        size_of(tmp_path / "a.png")
