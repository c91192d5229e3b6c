"""The soft association of the source beside the hard one: the same links, and parameters that are found again."""

import re
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchvision_dddas.config import PaperParameters, load_config, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.geometry import best_pairs
from torchvision_dddas.tracking.source_tracker import Features, associate
from torchvision_dddas.tuning import source_association
from torchvision_dddas.tuning.examples import stack_padded
from torchvision_dddas.tuning.parameters import Parameters
from torchvision_dddas.tuning.source_association import (
    SourceFamily,
    Windows,
    build_window,
    link_gains,
    links_nll,
    location_weight,
    wrong_links,
)

PAPER = with_parameters(load_config("paper"), {"paper.window": 2})


def views_of(
    count: int, seed: int, pictured: bool = True, leaving: int = 1, hues: int = 256, walk: float = 6.0
) -> tuple[tuple[Features, Features], tuple[np.ndarray, np.ndarray]]:
    """Two frames, newer first: people who walk a little, of whom some leave and as many of whom come; identities."""
    draw = np.random.default_rng(seed)
    place = draw.uniform(60, 600, (count + leaving, 2))
    level = draw.integers(0, hues, count + leaving)
    found = []
    for first, moved in ((leaving, walk), (0, 0.0)):
        who = draw.permutation(np.arange(first, first + count))
        centre = place[who] + draw.normal(0, 1, (count, 2)) * moved
        counts = draw.poisson(2.0, (count, 3, 256)).astype(float)
        counts[np.arange(count), :, level[who]] += 300
        box = np.column_stack([centre - (10, 20), np.tile((20.0, 40.0), (count, 1))])
        found.append((Features(box, partial(counts.reshape, count, 768) if pictured else None), who))
    (now, who_now), (before, who_before) = found
    return (now, before), (who_now, who_before)


def windows(parameters: PaperParameters, count: int = 6, many: int = 6, **kinds: Any) -> Windows:
    return stack_padded(Windows, [build_window(*views_of(count, seed, **kinds), parameters) for seed in range(many)])


def paper(**values: Any) -> PaperParameters:
    return PaperParameters.model_construct(**(dict(PaperParameters(window=2)) | values))


def linked(gain: Tensor) -> set[tuple[int, int]]:
    return {(int(i), int(j)) for i, j in best_pairs(gain.detach().numpy())}


@pytest.mark.parametrize("values", [{}, {"rule": "fixed", "weight": 0.6}, {"threshold": 0.05}, {"location_cut": 0.1}])
@pytest.mark.parametrize("pictured", [True, False])
def test_without_softness_the_links_and_the_weight_are_those_of_the_source(values, pictured):
    parameters = PaperParameters.model_validate({"window": 2} | values)
    for seed in range(5):
        views, identities = views_of(7, seed, pictured, hues=3)
        one = stack_padded(Windows, [build_window(views, identities, parameters)])
        hard = associate(list(views), parameters)
        assert location_weight(parameters, one).item() == pytest.approx(hard.weight)
        assert linked(link_gains(parameters, one)[0]) == {(i - 1, j - 1) for i, j in hard.rows.tolist() if i and j}


def test_as_softness_vanishes_the_loss_is_the_number_of_wrong_links():
    parameters = paper(threshold=0.04)
    many = windows(parameters, count=8, pictured=False)
    wanted = []
    for gain, true in zip(link_gains(parameters, many), many.true, strict=True):
        chosen, right = linked(gain), {(int(i), int(j)) for i, j in true.nonzero()}
        wanted.append(len(right - chosen) + len({i for i, _ in chosen} - {i for i, _ in right}))
    assert sum(wanted) > 0
    off = [(wrong_links(parameters, many, s) - torch.tensor(wanted)).abs().sum().item() for s in (0.3, 0.1, 0.003)]
    assert off[0] > off[1] > off[2] and off[2] < 0.1


@pytest.mark.parametrize(
    ("start", "fixed"),
    [
        ({"threshold": 0.1, "lowest_dispersion": 0.6, "location_cut": 0.3, "appearance_cut": 0.3}, {}),
        ({"weight": 0.5}, {"rule": "fixed"}),
    ],
)
def test_slopes_are_those_of_small_changes_and_none_is_missing(start, fixed, monkeypatch):
    many = windows(paper(), count=5, many=3, hues=3)

    def lost(*values: Tensor) -> Tensor:
        parameters = paper(**fixed, **dict(zip(start, values, strict=True)))
        return torch.cat([wrong_links(parameters, many, 0.1), links_nll(parameters, many, 0.1)])

    values = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in start.values()]
    # Ten rounds of messages are not their fixed point, at which alone the slope is exact; nor quite are sixty.
    monkeypatch.setattr(source_association, "_ROUNDS", 60)
    assert torch.autograd.gradcheck(lost, values, eps=1e-5, atol=2e-2, rtol=2e-2)
    assert all(slope != 0 for slope in torch.autograd.grad(lost(*values).sum(), values))


def test_nobody_and_targets_that_fill_up_change_nothing_and_all_is_finite():
    threshold: Any = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    parameters, sizes = paper(threshold=threshold), ((0, 0), (1, 1), (6, 2))
    parts = [build_window(*views_of(count, 3, leaving=leaving), parameters) for count, leaving in sizes]
    together = stack_padded(Windows, parts)
    both = wrong_links(parameters, together, 0.05)
    alone = torch.cat([wrong_links(parameters, stack_padded(Windows, [part]), 0.05) for part in parts])
    torch.testing.assert_close(both, alone, rtol=0, atol=1e-3)
    assert both[0] == 0
    (slope,) = torch.autograd.grad(both.sum() + links_nll(parameters, together, 0.05).sum(), threshold)
    assert torch.isfinite(slope)


def test_a_link_that_no_parameter_can_save_counts_no_more_than_once():
    many = windows(paper(), count=4, many=2, pictured=False)
    exchanged = replace(many, true=many.true.flip(2))
    wrong = wrong_links(paper(), exchanged, 0.001)
    assert (wrong <= 4 + 1e-6).all()
    assert (links_nll(paper(), exchanged, 0.001) > 10).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "start", "world"),
    [
        ("threshold", {"threshold": 0.8, "weight": 1.0}, {"count": 3, "many": 12, "pictured": False, "leaving": 2}),
        ("weight", {"weight": 0.95}, {"count": 20, "many": 4, "leaving": 0, "walk": 60.0}),
    ],
)
def test_a_wrong_parameter_is_brought_back_by_descending(name, start, world):
    """Of people who come and go, a gate that is never shut links the wrong ones; of a crowd, places alone do."""
    settings = with_parameters(PAPER, {"paper.rule": "fixed"} | {f"paper.{k}": v for k, v in start.items()})
    many, parameters = windows(settings.paper, **world), Parameters(settings, [f"paper.{name}"])
    adam = torch.optim.Adam(parameters.parameters(), lr=0.3)

    def wrong(softness: float) -> Tensor:
        values = dict(settings.paper) | {name: parameters.values()[f"paper.{name}"]}
        return wrong_links(paper(**values), many, softness).sum()

    before = wrong(0.001).item()
    for softness in np.geomspace(0.1, 0.02, 30):
        adam.zero_grad()
        wrong(float(softness)).backward()
        adam.step()
    assert before >= 4
    assert wrong(0.001).item() < before / 2


@pytest.mark.parametrize(
    ("name", "values", "line"),
    [
        ("paper.threshold", {"track.mode": "default"}, "no effect under track.mode=default; use --config paper"),
        ("paper.weight", {}, "paper.weight: no effect under paper.rule=dispersion; add --set paper.rule=fixed"),
        ("paper.location_cut", {"paper.rule": "fixed"}, "no effect under paper.rule=fixed"),
        ("paper.threshold", {"paper.gate": "off"}, "no effect under paper.gate=off"),
        ("paper.threshold", {"paper.window": 3}, "add --set paper.window=2"),
        ("paper.threshold", {"paper.gated": "affinity"}, "add --set paper.gated=features"),
    ],
)
def test_a_parameter_that_would_be_tuned_for_nothing_is_refused_with_what_to_set(name, values, line):
    with pytest.raises(InputError, match=re.escape(line)) as raised:
        SourceFamily().check([name], with_parameters(PAPER, values))
    assert "\n" not in str(raised.value)
