"""The size of a picture from its head is that of the decoded picture."""

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from tests.evaluation.datasets.layouts import pictures
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.files import size_of


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".ppm", ".pgm", ".webp", ".tif"])
def test_every_kind_of_picture_tells_its_size(tmp_path: Path, suffix: str) -> None:
    pictures(tmp_path, [f"a{suffix}"], size=(37, 21))
    assert size_of(tmp_path / f"a{suffix}") == (37, 21)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".ppm"])
def test_the_head_of_a_file_is_enough(tmp_path: Path, suffix: str) -> None:
    pictures(tmp_path, [f"a{suffix}"], size=(137, 121))
    path = tmp_path / f"a{suffix}"
    path.write_bytes(path.read_bytes()[:300])
    assert size_of(path) == (137, 121)


@pytest.mark.parametrize("content", [b"", b"\xff\xd8", b"\x89PNG\r\n\x1a\n", b"BM", b"P6 3 ", b"no picture at all"])
def test_what_is_no_picture_is_told(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.png is no picture that can be read"):
        size_of(tmp_path / "a.png")


@pytest.mark.parametrize("start", [b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"BM", b"P5 "])
def test_a_damaged_file_ends_in_a_size_or_a_line(tmp_path: Path, start: bytes) -> None:
    random = np.random.default_rng(1)
    for _ in range(30):
        (tmp_path / "a").write_bytes(start + random.bytes(60))
        with suppress(InputError):
            assert min(size_of(tmp_path / "a")) > 0
