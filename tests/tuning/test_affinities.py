"""Examples of the source's association, and what is refused."""

import pytest
import torch

from tests.tuning.test_identities import walk
from torchvision_dddas.config import Settings, load_config, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.tuning.descent import Plan, descend
from torchvision_dddas.tuning.family import load_family
from torchvision_dddas.tuning.parameters import Parameters
from torchvision_dddas.tuning.source_association import WINDOWS, SourceFamily

PAPER = with_parameters(load_config("paper"), {"paper.window": 2})


def test_a_clip_becomes_stretches_of_windows_each_with_a_loss_that_no_company_changes():
    family, told = SourceFamily(interval=5), []
    examples = family.examples([walk(), walk("other", people=6, seed=1)], PAPER, lambda: told.append(1))
    assert [len(example.content.windows) for example in examples] == 2 * [WINDOWS, WINDOWS, 9]
    assert [example.frame for example in examples] == 2 * [6, 6 + 5 * WINDOWS, 6 + 10 * WINDOWS]
    assert len(told) == len(examples)
    values = Parameters(PAPER, ["paper.threshold"]).values()
    for loss in ("wrong", "likelihood"):
        chosen = family.with_loss(loss)
        found = chosen.loss(values, examples, 0.05)
        alone = torch.cat([chosen.loss(values, [example], 0.05) for example in examples])
        torch.testing.assert_close(found, alone, rtol=0, atol=1e-4)
        assert torch.isfinite(found).all()


def test_a_threshold_is_learned_where_people_come_and_go():
    settings = with_parameters(PAPER, {"paper.threshold": 0.6})
    clips = [walk(str(seed), people=5, seed=seed) for seed in range(3)]
    family = load_family("paper")
    examples = family.examples(clips, settings)
    found = descend(family, Parameters(settings, ["paper.threshold"]), examples, Plan(5, 8, 0.3, look_every=5))
    assert not found.failed
    assert found.idle == ()
    first, last = found.history[0].watched, found.history[-1].watched
    assert first is not None and last is not None and last < first
    assert found.settings.paper.threshold > 0.7


@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        ("paper.threshold", {"track.mode": "default"}, "no effect under track.mode=default; use --config paper"),
        ("paper.weight", {}, "paper.weight: no effect under paper.rule=dispersion; add --set paper.rule=fixed"),
        ("paper.location_cut", {"paper.rule": "fixed"}, "no effect under paper.rule=fixed"),
        ("paper.threshold", {"paper.gate": "off"}, "no effect under paper.gate=off"),
        ("paper.threshold", {"paper.window": 3}, "add --set paper.window=2"),
        ("paper.threshold", {"paper.gated": "affinity"}, "add --set paper.gated=features"),
    ],
)
def test_a_parameter_that_would_be_tuned_for_nothing_is_refused_with_what_to_set(name, values, said):
    settings = with_parameters(PAPER, values)
    with pytest.raises(InputError) as raised:
        SourceFamily().check([name], settings)
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_clip_without_identities_is_named():
    with pytest.raises(InputError, match="nobody has no true identities"):
        SourceFamily().examples([walk("nobody", true=False)], Settings())
