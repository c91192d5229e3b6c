"""Jaccard affinities of padded batches, and their twin without torch."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchvision_dddas.functional import affinity
from torchvision_dddas.tracking import source_affinity

Features = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def features(seed: int = 0, size: int = 5, dtype: torch.dtype = torch.float64) -> Features:
    """Three frames of 4, 3 and 5 targets, two windows."""
    generator = torch.Generator().manual_seed(seed)
    a, b, c = (torch.rand(2, n, size, dtype=dtype, generator=generator) for n in (4, 3, 5))
    return a, b, c


def masks(*tables: torch.Tensor) -> list[torch.Tensor]:
    return [torch.ones(t.shape[:2], dtype=torch.bool) for t in tables]


def test_two_positions_by_hand():
    a, b = torch.tensor([[[400.0, 300.0]]]), torch.tensor([[[500.0, 300.0], [400.0, 200.0]]])
    found = affinity.pairs(a, b, *masks(a, b))
    torch.testing.assert_close(found, torch.tensor([[[700 / 800, 600 / 700]]]))


def test_a_triplet_by_hand():
    a, b, c = (torch.tensor([[row]]) for row in ([4.0, 1.0], [2.0, 3.0], [1.0, 5.0]))
    torch.testing.assert_close(
        affinity.triplets(a, b, c, *masks(a, b, c)), torch.full((1, 1, 1, 1), (2 + 1 + 1 + 3) / (4 + 3 + 2 + 5))
    )


def test_pairs_and_triplets_are_the_written_out_sums():
    a, b, c = features()
    low = torch.minimum(a[:, :, None], b[:, None]).sum(-1), torch.minimum(b[:, :, None], c[:, None]).sum(-1)
    high = torch.maximum(a[:, :, None], b[:, None]).sum(-1), torch.maximum(b[:, :, None], c[:, None]).sum(-1)
    torch.testing.assert_close(affinity.pairs(a, b, *masks(a, b)), low[0] / high[0])
    wanted = (low[0][..., None] + low[1][:, None]) / (high[0][..., None] + high[1][:, None])
    torch.testing.assert_close(affinity.triplets(a, b, c, *masks(a, b, c)), wanted)


@pytest.mark.parametrize("size", [2, 768])
def test_the_torch_free_twin_agrees(size):
    a, b, c = features(size=size, dtype=torch.float32)
    pairs, triplets = affinity.pairs(a, b, *masks(a, b)), affinity.triplets(a, b, c, *masks(a, b, c))
    for w in range(2):
        first, second, third = (t[w].double().numpy() for t in (a, b, c))
        np.testing.assert_allclose(source_affinity.pair_affinity(first, second)[1:, 1:], pairs[w], atol=2e-6)
        np.testing.assert_allclose(
            source_affinity.triplet_affinity(first, second, third)[1:, 1:, 1:], triplets[w], atol=2e-6
        )


def test_padding_changes_no_affinity_and_has_none():
    a, b, c = features()
    known = masks(a, b, c)
    known[1][0, 2] = False
    without = affinity.triplets(a[:1], b[:1, :2], c[:1], *masks(a[:1], b[:1, :2], c[:1]))
    b[0, 2] = 1e6
    padded = affinity.triplets(a, b, c, *known)
    torch.testing.assert_close(padded[:1, :, :2], without)
    assert not padded[0, :, 2].any()
    assert not affinity.pairs(a, b, known[0], known[1])[0, :, 2].any()


def test_two_empty_boxes_resemble_nothing():
    nothing = torch.zeros(1, 2, 768)
    assert not affinity.pairs(nothing, nothing, *masks(nothing, nothing)).any()
    assert not source_affinity.similarity(np.zeros((2, 768)), np.zeros((2, 768))).any()


def test_frames_without_targets_give_empty_tensors():
    a, b, c = features()
    assert affinity.pairs(a[:, :0], b, *masks(a[:, :0], b)).shape == (2, 0, 3)
    assert affinity.triplets(a, b[:, :0], c, *masks(a, b[:, :0], c)).shape == (2, 4, 0, 5)
    assert source_affinity.triplet_affinity(np.zeros((0, 2)), np.ones((3, 2)), np.zeros((0, 2))).shape == (1, 4, 1)


def test_gradients_are_those_of_finite_differences():
    a, b, c = (t.requires_grad_() for t in features(size=3))
    known = masks(a, b, c)
    known[2][1, 4] = False
    assert torch.autograd.gradcheck(lambda *t: affinity.triplets(*t, *known), (a, b, c))
    assert torch.autograd.gradcheck(lambda x, y: affinity.pairs(x, y, known[0], known[1]), (a, b))


def test_no_gradient_is_nan_where_vectors_are_zero_or_equal():
    a = torch.zeros(1, 2, 4, requires_grad=True)
    affinity.pairs(a, a, *masks(a, a)).sum().backward()
    assert a.grad is not None
    assert a.grad.isfinite().all()


def test_the_exported_graph_gives_the_same():
    class Triplets(torch.nn.Module):
        def forward(self, a, b, c, *known):
            return affinity.triplets(a, b, c, *known)

    rows = features(dtype=torch.float32)
    known = masks(*rows)
    known[1][0, 2] = False
    graph = torch.export.export(Triplets(), (*rows, *known))
    assert not any("cdist" in str(node.target) for node in graph.graph.nodes)  # which ONNX has not
    torch.testing.assert_close(graph.module()(*rows, *known), affinity.triplets(*rows, *known))


vectors = st.lists(st.lists(st.floats(0, 1e3), min_size=3, max_size=3), min_size=1, max_size=4)


@given(vectors, vectors)
@settings(max_examples=60, deadline=None)
def test_similarity_is_symmetric_between_0_and_1_and_1_with_itself(first, second):
    a, b = np.array(first), np.array(second)
    found = source_affinity.similarity(a, b)
    assert ((found >= 0) & (found <= 1)).all()
    np.testing.assert_allclose(found, source_affinity.similarity(b, a).T)
    np.testing.assert_allclose(np.diag(source_affinity.similarity(a, a)), (a.sum(axis=1) > 0).astype(float))


@given(vectors, vectors, st.floats(1e-2, 1e2))
@settings(max_examples=40, deadline=None)
def test_similarity_does_not_depend_on_the_unit(first, second, unit):
    a, b = np.array(first) + 1, np.array(second) + 1
    np.testing.assert_allclose(
        source_affinity.similarity(a * unit, b * unit), source_affinity.similarity(a, b), atol=1e-9
    )
