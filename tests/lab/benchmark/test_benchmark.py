"""The benchmark measures what fits into its time, and says what did not."""

import math
from itertools import pairwise

import numpy as np
import pytest

from torchvision_dddas.config import load_config
from torchvision_dddas.detection import detect_motion
from torchvision_dddas.lab.benchmark import (
    STAGES,
    ChainFigures,
    draw_frame,
    format_chains,
    format_operations,
    measure_chains,
)

SMALL = (160, 120)


def test_a_chain_is_measured_beside_the_plain_one() -> None:
    told: list[str] = []
    (found,) = measure_chains(["onboard fast"], [SMALL], 60, told.append)
    assert (found.chain, found.size, len(told)) == ("onboard fast", SMALL, 1)
    assert found.rate_hz > 0 and found.plain_hz > 0 and found.ratio > 0
    assert len(found.stages_ms) == len(STAGES) and min(found.stages_ms) >= 0


def test_what_the_time_does_not_allow_is_left_out_and_shown_as_a_dash() -> None:
    assert list(measure_chains(["onboard fast"], [SMALL], 0)) == []
    table = format_chains([], ["onboard fast"], [SMALL])
    assert "| onboard fast | – |" in table


def test_the_tables_have_a_column_for_each_size_in_order() -> None:
    figures = [ChainFigures("onboard fast", size, 20.0, 10.0, 0.5, math.nan, (1.0,) * 4) for size in ((64, 48), SMALL)]
    first, *_, row = format_chains(figures, ["onboard fast"], [SMALL, (64, 48)]).split("\n\n")[0].splitlines()
    assert first.endswith("| 64x48 | 160x120 |")
    assert row == "| onboard fast | 20.0 (0.50) | 20.0 (0.50) |"
    assert "| blur | 2.00 | 4.00 | 2.00 |" in format_operations({"blur": (2.0, 4.0)}, SMALL, 4)


def test_the_camera_turns_back_so_that_frames_never_repeat_at_once() -> None:
    frames = [draw_frame(SMALL, k) for k in (0, 1, 59, 60, 61, 120)]
    assert all((a != b).any() for a, b in pairwise(frames))
    np.testing.assert_array_equal(frames[0], frames[5])


def test_the_bodies_are_found_so_that_every_stage_has_work() -> None:
    scenes = list(detect_motion([draw_frame((640, 480), k) for k in range(10)], load_config("fast"), "onboard"))
    assert all(scene.reliable for scene in scenes)
    assert np.median([len(scene.detections) for scene in scenes]) >= 3


def test_operations_are_timed_beside_those_of_kornia() -> None:
    pytest.importorskip("kornia")
    from torchvision_dddas.lab.benchmark.torch_operations import kornia_pairs, measure_operations, random_pictures

    found = measure_operations((32, 24), 2, 0.0, "cpu")
    assert len(found) == 10 and min(min(times) for times in found.values()) > 0
    for name, (ours, kornias) in kornia_pairs(random_pictures((32, 24), 2), "cpu").items():
        one, other = ours(), kornias()
        assert getattr(one, "shape", None) == getattr(other, "shape", None) or name == "RGB to HSV", name
