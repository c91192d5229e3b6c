"""The family of people: its parts are those of the hard detector, and parameters that drew the truth are found."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.tuning.worlds import Spots, spotted
from torchvision_dddas.config import PeopleParameters, Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.metrics.boxes import iou
from torchvision_dddas.evaluation.metrics.truth import Truth
from torchvision_dddas.people.suppression import body_boxes, probability
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.tuning.parameters import TUNABLE, Parameters, with_tensors
from torchvision_dddas.tuning.people import PeopleFamily, ScoredPicture, picture_loss, score_picture, soft_f1

NAMES = [name for name, one in TUNABLE.items() if one.family == "people"]


def picture(seed: int, true: PeopleParameters) -> ScoredPicture:
    """Detections drawn by the parameters that are true: probabilities and the shares of body_boxes_soft."""
    rng = np.random.default_rng(seed)
    margin = np.sort(rng.uniform(-0.9, 2.5, 40))[::-1].copy()
    odds = true.probability_slope * (margin - true.probability_even)
    right = rng.uniform(0, 1, 40) < 1 / (1 + np.exp(-odds))
    sure = int((margin >= 0).sum())
    hits = int(right[:sure].sum())
    window = np.column_stack([rng.uniform(0, 300, (hits, 2)), rng.uniform([60, 120], [70, 140], (hits, 2))])
    columns = margin, right, window, body_boxes(window, true) + rng.normal(0, 1, (hits, 4))
    margin_, right_, window_, body_ = (torch.as_tensor(np.asarray(column, float)) for column in columns)
    return ScoredPicture(margin_, right_, sure, window_, body_, int(right.sum()) + 1)


@pytest.mark.slow
def test_parameters_that_drew_the_truth_are_found_again():
    shares: dict[str, Any] = {"height_share": 0.8, "width_share": 0.42, "feet_share": 0.9}
    true = PeopleParameters(**shares, probability_slope=4.0, probability_even=0.5)
    batch = [Example("drawn", seed, picture(seed, true)) for seed in range(20)]
    plan = Plan(steps=60, batch=10, rate=0.1, look_every=20, watched=0)
    found = descend(PeopleFamily(), Parameters(Settings(), NAMES), batch, plan).settings.people
    for name, value in shares.items():
        assert getattr(found, name) == pytest.approx(value, abs=0.02)
    assert found.probability_even == pytest.approx(0.5, abs=0.15)
    assert found.probability_slope == pytest.approx(4.0, rel=0.3)
    # Where a detection is more likely wrong than right it does not pay, up to F / 2.
    assert 0.1 < found.threshold < 0.7


def test_the_loss_is_f1_doubt_and_misfit_of_the_hard_detector() -> None:
    parameters = PeopleParameters(threshold=0.5)
    content = picture(0, parameters)
    margin, right = content.margin.numpy(), content.right.numpy() > 0
    above = margin > 0.5
    f1 = 2 * (right & above).sum() / (above.sum() + content.people)
    p = probability(margin[: content.shown], parameters)
    doubt = -np.log(np.where(right[: content.shown], p, 1 - p)).mean()
    misfit = 1 - np.diag(iou(body_boxes(content.window_px.numpy(), parameters), content.true_px.numpy())).mean()
    assert float(picture_loss(content, parameters, 0.0)) == pytest.approx(1 - f1 + doubt + misfit)


def test_all_gradients_are_right() -> None:
    content = picture(1, PeopleParameters())

    def lost(*values: torch.Tensor) -> torch.Tensor:
        named = dict(zip(NAMES, values, strict=True))
        return picture_loss(content, with_tensors(PeopleParameters(), "people", named), 0.3)

    assert torch.autograd.gradcheck(lost, tuple(Parameters(Settings(), NAMES).values().values()))


def test_soft_f_tends_to_hard_as_softness_vanishes():
    margin, right = torch.tensor([2.0, 1.2, 0.7, 0.2, -0.4]), torch.tensor([1.0, 1.0, 0.0, 1.0, 0.0])
    hard, *soft = (float(soft_f1(margin, right, 4, torch.tensor(0.5), s)) for s in (0.0, 0.2, 0.1, 0.05, 0.02))
    assert hard == pytest.approx(2 * 2 / (3 + 4))
    away = [abs(one - hard) for one in soft]
    assert away == sorted(away, reverse=True) and away[-1] < 1e-3
    without_people = [float(soft_f1(margin[:n], 0 * right[:n], 0, torch.tensor(0.0), 0.0)) for n in (0, 1, 2)]
    assert without_people == pytest.approx([1, 1 / 2, 1 / 3])


def test_detections_below_the_threshold_are_kept_without_a_probability() -> None:
    image, true = spotted()
    found = score_picture(image, Truth("boxes", Path("spots"), {}, {1: true}), 1, PeopleParameters(), Spots())
    assert found.margin.tolist() == pytest.approx([1.5, 0.5, -0.5])
    assert found.right.tolist() == [1, 0, 0] and (found.shown, found.people) == (2, 1)
    np.testing.assert_allclose(found.true_px.numpy(), true)
    np.testing.assert_allclose(found.window_px.numpy(), [[8, 16, 64, 128]])
    with pytest.raises(InputError, match="set it to nms"):
        PeopleFamily().examples([], with_parameters(Settings(), {"people.suppression": "opencv"}))
