import torch

from torchvision_dddas.nn import Core
from torchvision_dddas.tuning.motion import label_regions


def core(*boxes: tuple[int, int, int, int, float]) -> Core:
    """Margins of -4, and of the boxes (left, top, right, bottom, margin)."""
    margin = torch.full((1, 1, 40, 60), -4.0)
    for left, top, right, bottom, value in boxes:
        margin[..., top:bottom, left:right] = value
    return Core((margin > 0).float(), margin, margin + 4)


def test_regions_are_numbered_and_their_hulls_filled() -> None:
    found = label_regions(core((5, 5, 15, 8, 1.0), (5, 5, 8, 15, 1.0), (40, 20, 50, 30, 2.0)), hull=True)
    assert found.count == 2
    assert len({int(found.near[0, 0, 6, 10]), int(found.near[0, 0, 25, 45]), 0}) == 3
    assert int(found.near[0, 0, 10, 10]) == 0, "the bend of the L is no part of it"
    assert int(found.filled[0, 0, 9, 9]) == int(found.near[0, 0, 6, 6]), "but of its hull"
    plain = label_regions(core((5, 5, 15, 8, 1.0), (5, 5, 8, 15, 1.0)), hull=False)
    assert torch.equal(plain.filled, plain.near)


def test_a_speck_within_a_large_hull_keeps_its_own_number_and_lies_in_the_hull() -> None:
    sides = (5, 5, 30, 7, 1.0), (5, 5, 7, 30, 1.0), (5, 28, 30, 30, 1.0), (28, 5, 30, 30, 1.0)
    found = label_regions(core(*sides, (17, 17, 19, 19, 1.0)), hull=True)
    assert found.count == 2
    assert int(found.near[0, 0, 18, 18]) != int(found.near[0, 0, 5, 5])
    assert int(found.filled[0, 0, 18, 18]) == int(found.near[0, 0, 5, 5])


def test_what_just_misses_the_threshold_goes_to_the_nearest_region_or_makes_its_own() -> None:
    found = label_regions(core((5, 5, 25, 15, -0.5), (5, 5, 10, 15, 1.0), (40, 20, 50, 30, -0.5)), hull=True, reach=1.0)
    assert found.count == 2
    assert int(found.near[0, 0, 10, 20]) == int(found.near[0, 0, 10, 7])
    assert int(found.near[0, 0, 25, 45]) not in (0, int(found.near[0, 0, 10, 7]))
    assert not found.filled[0, 0, 20:30, 40:50].any(), "it is not there yet"
    assert int(found.near[0, 0, 35, 5]) == 0


def test_a_mask_of_nothing_has_no_regions() -> None:
    found = label_regions(core(), hull=True, reach=1.0)
    assert found.count == 0 and not found.near.any() and not found.filled.any()
