from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchvision_dddas.config import PeopleParameters, Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics.truth import Truth
from torchvision_dddas.people.suppression import body_boxes
from torchvision_dddas.tuning import people
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.family import Example
from torchvision_dddas.tuning.parameters import Parameters
from torchvision_dddas.tuning.people import PeopleFamily, ScoredPicture, score_picture

NAMES = [f"people.{name}" for name in people.PARAMETERS]


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
    return ScoredPicture(margin_, right_, sure, window_, body_, int(right.sum()) + 1, PeopleParameters())


def test_knobs_that_drew_the_truth_are_found_again():
    true = PeopleParameters(
        height_share=0.8, width_share=0.42, feet_share=0.9, probability_slope=4.0, probability_even=0.5
    )
    batch = [Example("drawn", seed, picture(seed, true)) for seed in range(20)]
    parameters = Parameters(Settings(), NAMES)
    with torch.no_grad():
        before = float(PeopleFamily().loss(parameters.values(), batch, 0.05).mean())
    found = descend(
        PeopleFamily(), parameters, batch, Plan(steps=60, batch=10, rate=0.1, look_every=20, watched=0)
    ).settings.people
    with torch.no_grad():
        assert float(PeopleFamily().loss(parameters.values(), batch, 0.05).mean()) < before
    for name, within in (("height_share", 0.02), ("width_share", 0.02), ("feet_share", 0.02)):
        assert getattr(found, name) == pytest.approx(getattr(true, name), abs=within)
    assert found.probability_even == pytest.approx(0.5, abs=0.15)
    assert found.probability_slope == pytest.approx(4.0, rel=0.3)
    # Where a detection is more likely wrong than right it does not pay, up to F / 2.
    assert 0.1 < found.threshold < 0.7


def test_each_parameter_moves_its_own_part_alone():
    batch = [Example("drawn", 0, picture(0, PeopleParameters()))]
    parameters = Parameters(Settings(), ["people.threshold"])
    PeopleFamily().loss(parameters.values(), batch, 0.2).sum().backward()
    assert float(parameters.free[0].grad or 0) != 0
    alone = PeopleFamily().loss({}, batch, 0.0) - PeopleFamily().loss(
        {"people.threshold": torch.tensor(0.5)}, batch, 0.0
    )
    content = batch[0].content
    right = content.right * (content.margin > 0)
    f = 2 * right.sum() / ((content.margin > 0).sum() + content.people)
    above = content.margin > 0.5
    more = 2 * (content.right * above).sum() / (above.sum() + content.people)
    assert float(alone) == pytest.approx(float(more - f))


class Spots:
    """A recognizer for which the window about a white spot is a person, the more the whiter."""

    name = "stub"

    def scores(self, images, parts):
        return [[self._map(image, part) for part in wanted] for image, wanted in zip(images, parts, strict=True)]

    def _map(self, image, part):
        level = cv2.resize(image, part.level).astype(np.float32)
        rows, columns = ((side - length) // 8 + 1 for side, length in ((part.height, 128), (part.width, 64)))
        found = np.full((rows, columns), -5.0, np.float32)
        for j in range(rows):
            for i in range(columns):
                v, u = part.y + 8 * j + 64, part.x + 8 * i + 32
                inside = 0 <= v < level.shape[0] and 0 <= u < level.shape[1]
                if part.level == (image.shape[1], image.shape[0]) and inside and level[v, u] > 0:
                    found[j, i] = level[v, u] / 100 - 1
        return found


def spotted() -> tuple[np.ndarray, np.ndarray]:
    """A picture of 256 x 160 with spots of which windows score 1.5, 0.5 and -0.5, and the first one's body."""
    image = np.zeros((160, 256), np.uint8)
    for u, level in ((40, 250), (136, 150), (216, 50)):
        image[80 - 3 : 80 + 4, u - 3 : u + 4] = level
    return image, body_boxes(np.array([[8.0, 16.0, 64.0, 128.0]]), PeopleParameters())


def test_detections_below_the_threshold_are_kept_without_a_probability():
    image, true = spotted()
    found = score_picture(image, true, PeopleParameters(), Spots())
    assert found.margin.tolist() == pytest.approx([1.5, 0.5, -0.5])
    assert found.right.tolist() == [1, 0, 0]
    assert (found.shown, found.people) == (2, 1)
    np.testing.assert_allclose(found.true_px.numpy(), true)
    np.testing.assert_allclose(found.window_px.numpy(), [[8, 16, 64, 128]])


def test_what_does_not_count_is_left_out():
    image, true = spotted()
    found = score_picture(image, true, PeopleParameters(), Spots(), lambda box_px: box_px[:, 0] < 100)
    assert found.margin.tolist() == pytest.approx([1.5])


def test_a_clip_gives_its_labelled_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    image, true = spotted()
    files = []
    for number in (1, 2, 3):
        files.append(tmp_path / f"{number}.png")
        cv2.imwrite(str(files[-1]), image)
    truth = Truth("boxes", tmp_path, {}, {1: true, 3: np.zeros((0, 4))})
    monkeypatch.setattr("torchvision_dddas.tuning.people.load_scorer", lambda parameters: Spots())
    clip = Clip("spots", tmp_path, tuple(files), truth=truth, shows=("people",))
    found = PeopleFamily().examples([clip], Settings())
    assert [(one.frame, one.content.people, one.content.right.sum()) for one in found] == [(1, 1, 1), (3, 0, 0)]
    with pytest.raises(InputError, match="spots has no boxes of people"):
        PeopleFamily().examples([replace(clip, truth=None)], Settings())


def test_other_suppressions_than_nms_are_refused():
    with pytest.raises(InputError, match="set it to nms"):
        PeopleFamily().examples([], with_parameters(Settings(), {"people.suppression": "opencv"}))
