"""Lockstep: a batch holds frames of one number, whatever the clips' lengths and gaps."""

from pathlib import Path

import pytest

from tests.sources.clips import write_images, write_video
from torchvision_dddas.errors import InputError
from torchvision_dddas.sources import open_source
from torchvision_dddas.sources.lockstep import lockstep


def test_clips_of_different_lengths_advance_together_until_the_longest_ends(tmp_path: Path) -> None:
    clips = [open_source(write_images(tmp_path / f"{n}", range(1, n + 1))) for n in (2, 4)]
    numbers = [[frame and frame.number for frame in batch] for batch in lockstep(clips)]
    assert numbers == [[1, 1], [2, 2], [None, 3], [None, 4]]


def test_a_lost_frame_leaves_its_own_place_empty(tmp_path: Path) -> None:
    clips = [open_source(write_images(tmp_path / name, range(1, 5))) for name in "ab"]
    for name, frame in [("a", 2), ("a", 3), ("b", 3)]:
        (tmp_path / name / f"frame{frame}.png").write_bytes(b"")
    numbers = [[frame and frame.number for frame in batch] for batch in lockstep(clips)]
    assert numbers == [[1, 1], [None, 2], [None, None], [4, 4]]


def test_clips_of_different_sizes_are_refused_by_name(tmp_path: Path) -> None:
    write_images(tmp_path / "a")
    write_video(tmp_path / "b.avi", "MJPG", frames=2, size=(32, 24))
    with pytest.raises(InputError, match=r"a is 64x48 but .*b\.avi is 32x24"):
        lockstep([open_source(tmp_path / "a"), open_source(tmp_path / "b.avi")])
    with pytest.raises(InputError, match="no clips"):
        lockstep([])
