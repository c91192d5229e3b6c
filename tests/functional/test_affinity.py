"""Jaccard affinities of padded batches, and their twin without torch."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import torchvision_dddas.functional as F
from torchvision_dddas.config import PaperParameters
from torchvision_dddas.tracking import source_tracker

Features = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def features(seed: int = 0, size: int = 5, dtype: torch.dtype = torch.float64) -> Features:
    """Three frames of 4, 3 and 5 targets, two windows."""
    generator = torch.Generator().manual_seed(seed)
    a, b, c = (torch.rand(2, n, size, dtype=dtype, generator=generator) for n in (4, 3, 5))
    return a, b, c


def masks(*tables: torch.Tensor) -> list[torch.Tensor]:
    return [torch.ones(t.shape[:2], dtype=torch.bool) for t in tables]


def test_a_triplet_by_hand():
    frames = [torch.tensor([[row]]) for row in ([4.0, 1.0], [2.0, 3.0], [1.0, 5.0])]
    found = F.triplet_affinity(frames[0], frames[1], frames[2], *masks(*frames))
    torch.testing.assert_close(found, torch.full((1, 1, 1, 1), (2 + 1 + 1 + 3) / (4 + 3 + 2 + 5)))


@pytest.mark.parametrize("size", [2, 768])
def test_the_torch_free_twin_agrees(size):
    a, b, c = features(size=size, dtype=torch.float32)
    pairs, triplets = F.pair_affinity(a, b, *masks(a, b)), F.triplet_affinity(a, b, c, *masks(a, b, c))
    for w in range(2):
        frames = [t[w].double().numpy() for t in (a, b, c)]
        of_two, of_three = (source_tracker.affinity(frames[:count], PaperParameters()) for count in (2, 3))
        np.testing.assert_allclose(of_two[1:, 1:], pairs[w], atol=2e-6)
        np.testing.assert_allclose(of_three[1:, 1:, 1:], triplets[w], atol=2e-6)


def test_padding_changes_no_affinity_and_has_none():
    a, b, c = features()
    known = masks(a, b, c)
    known[1][0, 2] = False
    without = F.triplet_affinity(a[:1], b[:1, :2], c[:1], *masks(a[:1], b[:1, :2], c[:1]))
    b[0, 2] = 1e6
    padded = F.triplet_affinity(a, b, c, *known)
    torch.testing.assert_close(padded[:1, :, :2], without)
    assert not padded[0, :, 2].any() and not F.pair_affinity(a, b, known[0], known[1])[0, :, 2].any()


def test_no_gradient_is_nan_where_vectors_are_zero_or_equal():
    a = torch.zeros(1, 2, 4, requires_grad=True)
    F.pair_affinity(a, a, *masks(a, a)).sum().backward()
    assert a.grad is not None
    assert a.grad.isfinite().all()


vectors = st.lists(st.lists(st.floats(0, 1e3), min_size=3, max_size=3), min_size=1, max_size=4)


@given(vectors, vectors)
@settings(max_examples=60, deadline=None)
def test_similarity_is_symmetric_between_0_and_1_and_1_with_itself(first, second):
    a, b = np.array(first), np.array(second)
    found = source_tracker.similarity(a, b)
    assert ((found >= 0) & (found <= 1)).all()
    np.testing.assert_allclose(found, source_tracker.similarity(b, a).T)
    np.testing.assert_allclose(np.diag(source_tracker.similarity(a, a)), (a.sum(axis=1) > 0).astype(float))
