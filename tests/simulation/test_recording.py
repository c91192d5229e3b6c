"""Films of a scenario, and the demo that is made of one."""

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from torchvision_dddas.cli import app
from torchvision_dddas.simulation import film, film_clip, load_scenario


@pytest.mark.slow
def test_a_clip_on_disk_is_the_film_whose_masks_number_what_moves(tmp_path):
    made = list(film(load_scenario("demo"), 1, 2, (160, 120)))
    film_clip(tmp_path, 1, 2, (160, 120))
    assert len(made) == 2
    read = cv2.imread(str(tmp_path / "frames/000002.jpg"))
    assert read is not None and np.abs(read.astype(int) - made[1][0]).mean() < 3
    mask = cv2.imread(str(tmp_path / "masks/000002.png"), -1)
    assert mask is not None and np.array_equal(mask, made[1][1])
    parked = len(load_scenario("demo").crowd) + 3  # the third car stands
    assert made[0][1].any() and not (made[0][1] == parked).any()


@pytest.mark.slow
def test_the_demo_finds_most_movers_and_leaves_the_parked_car_alone(tmp_path, monkeypatch):
    def short(folder, tick):
        return film_clip(folder, frames=16, size_px=(480, 360))

    monkeypatch.setattr("torchvision_dddas.simulation.film_clip", short)
    result = CliRunner().invoke(app, ["demo", "--out", str(tmp_path / "demo")])
    assert result.exit_code == 0, result.output
    scores = json.loads((tmp_path / "demo/metrics.json").read_text())["clips"]["demo"]
    assert scores["pixels"]["f"] > 0.6
    assert scores["pixels"]["precision"] > 0.6
    video = cv2.VideoCapture(str(tmp_path / "demo/overlay.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 16
