"""From a study to what is tuned: the family of the parameters, clips apart, and what cannot be."""

from pathlib import Path

import pytest

from tests.lab.evaluation.studies.world import filmed, followed, study
from torchvision_dddas.lab.evaluation.studies.runner import read_spec
from torchvision_dddas.lab.tuning.family import prepare


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> Path:
    """A study of two clips with masks, and one without."""
    place = tmp_path_factory.mktemp("preparing") / "clips"
    filmed(place, "one", 0, frames=7)
    filmed(place, "held", 1, frames=7)
    followed(place, "boxes", 2, frames=7)
    return study(place, 'config = "fast"')


def test_examples_are_of_the_clips_that_are_not_held_out(clips) -> None:
    ready = prepare(read_spec(clips), clips.parent, ["difference.*"], ["held"], ["one", "held"])
    assert ready.tuned == ("one",) and ready.held == ("held",)
    assert {example.clip for example in ready.examples} == {"one"} and ready.examples
    frames = [example.frame for example in ready.examples]
    assert frames == sorted(frames)
    assert ready.spec.tasks == ("motion",) and ready.goal.name == "motion.pixels.f"
    assert set(ready.parameters.names) >= {"difference.threshold", "difference.noise_levels"}
