import pytest
import torch

from torchvision_dddas.functional.soft.regions import gates, of_pixels

LABELS = torch.zeros(2, 1, 6, 8, dtype=torch.int64)
LABELS[0, 0, 1:3, 1:5] = 1  # 8 pixels
LABELS[0, 0, 4, 6] = 2  # 1 pixel
LABELS[1, 0, 0, :3] = 1
MASK = (LABELS > 0).double()
EVIDENCE = torch.zeros(2, 1, 6, 8, dtype=torch.float64)
EVIDENCE[0, 0, 2, 2], EVIDENCE[0, 0, 4, 6], EVIDENCE[1, 0, 0, 1] = 7.0, 9.0, 6.9


@pytest.mark.parametrize(
    ("min_area_px", "peak", "wanted"),
    [
        (1, 0.0, [[1, 1], [1, 0]]),
        (8, 0.0, [[1, 0], [0, 0]]),
        (9, 0.0, [[0, 0], [0, 0]]),
        (1, 7.0, [[1, 1], [0, 0]]),
        (1, 7.01, [[0, 1], [0, 0]]),
    ],
)
def test_a_region_of_just_the_area_and_just_the_peak_passes(
    min_area_px: float, peak: float, wanted: list[list[int]]
) -> None:
    assert gates(MASK, EVIDENCE, LABELS, 2, min_area_px, peak).tolist() == wanted


def test_soft_gates_tend_to_hard_ones() -> None:
    hard = gates(MASK, EVIDENCE, LABELS, 2, 2.5, 6.95)
    misses = [float((gates(MASK, EVIDENCE, LABELS, 2, 2.5, 6.95, s) - hard).abs().max()) for s in (0.5, 0.05, 5e-4)]
    assert misses[0] > misses[1] > misses[2] and misses[2] < 1e-6


def test_gates_have_the_right_gradient_in_mask_evidence_and_bounds() -> None:
    mask = (MASK * 0.8).requires_grad_()
    evidence = EVIDENCE + torch.rand(EVIDENCE.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    area, peak = (torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (3.0, 6.0))
    assert torch.autograd.gradcheck(
        lambda m, e, a, p: gates(m, e, LABELS, 2, a, p, 0.3), (mask, evidence.requires_grad_(), area, peak)
    )


def test_each_pixel_has_the_gate_of_its_region_and_none_has_none() -> None:
    picture = of_pixels(torch.tensor([[0.5, 0.25], [1.0, 0.0]]), LABELS)
    assert float(picture[0, 0, 1, 1]) == 0.5 and float(picture[0, 0, 4, 6]) == 0.25 and float(picture[0, 0, 0, 0]) == 0
    assert float(picture[1].sum()) == 3.0


def test_no_regions_give_no_gates() -> None:
    none = gates(MASK, EVIDENCE, torch.zeros_like(LABELS), 0, 300, 7.0)
    assert none.shape == (2, 0)
    assert not of_pixels(none, torch.zeros_like(LABELS)).any()
