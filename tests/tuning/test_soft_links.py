"""The loss on true links: the tracker's own scores, whose parameters it can find again."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchvision_dddas.config import Settings, TrackParameters
from torchvision_dddas.tracking import kalman
from torchvision_dddas.tracking.scores import SceneState, association_scores
from torchvision_dddas.tuning.parameters import TUNABLE, Parameters
from torchvision_dddas.tuning.tracking import Stretches, link_nll

NAMES = [
    "track.speed",
    "track.agility",
    "track.scatter",
    "track.size_scatter",
    "track.births",
    "track.prior",
    "track.tail",
    "track.upright",
    "track.rest_drift",
    "track.rest_price",
    "track.missed",
    "track.border",
    "track.left",
]


def walkers(count: int = 6, looks: int = 10, scatter: float = 0.06, hide: bool = True, seed: int = 0) -> Stretches:
    """Stretches of people who walk about and are now and then not seen; one pair of walks each of two scenes."""
    draw = np.random.default_rng(seed)
    frame = np.tile(1.0 + 5 * np.arange(looks), (2, 1))
    place = draw.uniform(100, 400, (2, 1, count, 2))
    velocity = np.cumsum(draw.normal(0, 0.6, (2, looks, count, 2)), axis=1) + draw.normal(0, 2, (2, 1, count, 2))
    height = 50 * np.exp(draw.normal(0, 0.1, (2, looks, count)))
    centre = place + np.cumsum(velocity * 5, axis=1) + scatter * 50 * draw.normal(size=(2, looks, count, 2))
    size = np.stack([0.4 * height, height], -1)
    there = draw.uniform(size=(2, looks, count)) > (0.2 if hide else 0.0)
    parts = {
        "frame": frame,
        "interval": np.full(2, 5.0),
        "size": np.full((2, 2), 500.0),
        "usual": np.full((2, looks), 0.06),
        "known": np.full((2, looks), 30.0),
        "births": np.full((2, looks), 0.01),
        "doubt": np.full((2, looks), 0.1),
        "box_px": np.concatenate([centre - size / 2, size], -1),
        "there": there,
        "certain": there,
        "begins": there,
        "step": np.tile(np.eye(3), (2, looks, 1, 1)),
        "likeness": np.full((2, looks, count, count), np.nan),
        "visible": np.ones((2, looks, count)),
        "own": np.zeros(2, bool),
    }
    return Stretches(**{name: torch.as_tensor(value) for name, value in parts.items()})


def track(values: dict[str, Tensor]) -> TrackParameters:
    mine = {name.removeprefix("track."): value for name, value in values.items()}
    return TrackParameters.model_construct(**(dict(Settings().track) | mine))


def test_tensors_are_scored_as_arrays_are():
    parameters, looks = Settings().track, walkers()
    box = looks.box_px[0].numpy()
    state = kalman.start(box[0], 1, parameters.scatter, 0.07)
    state = kalman.update(kalman.predict(state, 6, 0.009), box[1], 6, parameters.scatter)
    state[::2, kalman.SEEN] = 1
    left, sight = np.arange(6) % 3 == 0, SceneState(11, 5, 0.07, 0.02, 0.1, (500.0, 500.0))
    wanted = association_scores(state, left, box[2], sight, parameters)
    there: Any = torch.as_tensor(state)
    at_border: Any = torch.as_tensor(left)
    last: Any = looks.box_px[0, 2]
    births: Any = torch.tensor(0.02, dtype=torch.float64)
    found: Any = association_scores(there, at_border, last, replace(sight, birth_rate=births), parameters)
    np.testing.assert_allclose(found.numpy(), wanted, rtol=0, atol=1e-9)


def test_every_parameter_has_a_slope_and_all_are_finite():
    values = Parameters(Settings(), NAMES).values()
    slopes = torch.autograd.grad(link_nll(track(values), walkers(), 1.0).sum(), list(values.values()))
    assert all(torch.isfinite(slope) for slope in slopes)
    assert [name for name, slope in zip(values, slopes, strict=True) if slope == 0] == []


def test_slopes_are_those_of_small_changes():
    looks = walkers(3, 5)

    def lost(*values: Tensor) -> Tensor:
        return link_nll(track(dict(zip(NAMES, values, strict=True))), looks, 1.0)

    start = [value.detach() for value in Parameters(Settings(), NAMES).values().values()]
    for place in range(len(NAMES)):
        ends = []
        for sign in (1, -1):
            moved = [value.clone() for value in start]
            moved[place] *= 1 + sign * 1e-4
            ends.append(lost(*moved).detach().sum().item())
        parameter = start[place].clone().requires_grad_()
        (slope,) = torch.autograd.grad(lost(*start[:place], parameter, *start[place + 1 :]).sum(), parameter)
        assert slope.item() == pytest.approx((ends[0] - ends[1]) / (2e-4 * start[place].item()), rel=0.05, abs=2e-4)


def test_true_links_are_likelier_than_exchanged_ones():
    looks = walkers(4, 6, hide=False)
    exchanged = looks.box_px.clone()
    exchanged[:, 3:] = exchanged[:, 3:].flip(2)
    right, wrong = (link_nll(Settings().track, replace(looks, box_px=box), 1.0) for box in (looks.box_px, exchanged))
    assert (right < wrong - 0.5).all()


def test_margins_cost_most_where_links_are_in_doubt():
    """Sure links stay all but free, those that could be exchanged cost more; without margins nothing changes."""
    sure, vague = walkers(2, 6, hide=False), walkers(12, 6, hide=False, scatter=0.4)
    of = [[link_nll(Settings().track, looks, 1.0, m, m).mean() for m in (0.0, 1.0)] for looks in (sure, vague)]
    assert of[0][1] > of[0][0]
    assert of[1][1] - of[1][0] > 2 * (of[0][1] - of[0][0])
    torch.testing.assert_close(link_nll(Settings().track, sure, 1.0, 0.0, 0.0).mean(), of[0][0])


def test_cold_margins_are_a_hinge_that_is_zero_where_the_true_links_are_best_by_far():
    looks = walkers(2, 6, hide=False, scatter=0.01)
    assert link_nll(Settings().track, looks, 0.01, 1.0, 1.0).abs().max() < 0.02


def test_neither_the_order_of_targets_nor_empty_places_matter():
    looks = walkers()
    wanted = link_nll(Settings().track, looks, 1.0)
    order = torch.tensor([3, 1, 5, 0, 2, 4])
    of_targets = ("box_px", "there", "certain", "begins", "visible")
    mixed = {name: getattr(looks, name)[:, :, order] for name in of_targets}
    torch.testing.assert_close(link_nll(Settings().track, replace(looks, **mixed), 1.0), wanted)
    wider = {name: torch.cat([getattr(looks, name)] * 2, 2) for name in of_targets}
    for name in ("there", "certain", "begins"):
        wider[name][:, :, 6:] = False
    wider["likeness"] = torch.full((2, 10, 12, 12), torch.nan, dtype=torch.float64)
    torch.testing.assert_close(link_nll(Settings().track, replace(looks, **wider), 1.0), wanted)


def test_a_stretch_has_the_same_loss_in_any_company():
    looks = walkers()
    alone = Stretches(**{field.name: getattr(looks, field.name)[:1] for field in fields(Stretches)})
    both = link_nll(Settings().track, looks, 1.0)
    torch.testing.assert_close(link_nll(Settings().track, alone, 1.0)[0], both[0], rtol=0, atol=1e-3)


def test_a_pan_that_is_known_costs_nothing():
    looks = walkers(4, 6, hide=False)
    pan = torch.eye(3, dtype=torch.float64).repeat(2, 6, 1, 1)
    pan[:, 1:, 0, 2] = 150.0
    moved = looks.box_px.clone()
    moved[..., 0] += 150.0 * torch.arange(6)[None, :, None]
    size = torch.full((2, 2), 1e6, dtype=torch.float64)
    still, unknown, known = (
        link_nll(Settings().track, replace(looks, size=size, **changed), 1.0)
        for changed in ({}, {"box_px": moved}, {"box_px": moved, "step": pan})
    )
    torch.testing.assert_close(known, still)
    assert (unknown > known + 0.3).all()


def test_own_targets_are_scored_with_their_own_scatter():
    looks = walkers()
    own = replace(looks, own=torch.ones(2, dtype=torch.bool))
    shipped = Settings().track
    as_own = shipped.model_copy(
        update={"scatter": shipped.own_scatter, "size_scatter": shipped.own_size_scatter, "births": shipped.own_births}
    )
    torch.testing.assert_close(link_nll(shipped, own, 1.0), link_nll(as_own, looks, 1.0))


def test_a_wrong_scatter_is_brought_back_by_a_few_steps():
    looks = walkers(8, 12, scatter=0.02, hide=False)
    parameters = Parameters(
        Settings().model_copy(update={"track": TrackParameters(scatter=0.3, tail=30.0)}), ["track.scatter"]
    )
    adam = torch.optim.Adam(parameters.parameters(), lr=0.3)
    losses = []
    for _ in range(12):
        loss = link_nll(
            TrackParameters.model_construct(**(dict(parameters.base.track) | track_of(parameters))), looks, 1.0
        ).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]
    assert parameters.settings().track.scatter < 0.15


def track_of(parameters: Parameters) -> dict[str, Tensor]:
    return {name.removeprefix("track."): value for name, value in parameters.values().items()}


def test_all_the_links_weights_are_tunable():
    assert set(NAMES) <= set(TUNABLE)
