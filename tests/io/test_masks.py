import cv2
import numpy as np
import pytest

from torchvision_dddas.io.images import Masks


@pytest.mark.parametrize(("targets", "kind"), [(0, np.uint8), (255, np.uint8), (256, np.uint16)])
def test_masks_hold_every_target_number_in_the_smallest_type(tmp_path, scene, targets, kind):
    made = scene(3, targets=targets, size=(99, 61))
    Masks(tmp_path).write(made)
    read = cv2.imread(str(tmp_path / "masks/000003.png"), cv2.IMREAD_UNCHANGED)
    assert read is not None
    assert read.dtype == kind
    assert np.array_equal(read, made.mask)


def test_masks_of_a_longer_earlier_clip_go_at_the_end_and_foreign_files_stay(tmp_path, scene):
    first, second = Masks(tmp_path), Masks(tmp_path)
    for number in (1, 2, 3):
        first.write(scene(number))
    for name in ("notes.png", "0003.png", "000003.txt"):
        (tmp_path / "masks" / name).write_text("mine")
    second.write(scene(1))
    assert (tmp_path / "masks/000003.png").exists()
    second.close(complete=True)
    assert sorted(p.name for p in (tmp_path / "masks").iterdir()) == [
        "000001.png",
        "000003.txt",
        "0003.png",
        "notes.png",
    ]
