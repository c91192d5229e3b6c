"""Looks of clips: what a flight over landmarks leaves on disk is taken up as it was flown."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.overflight import ORIGIN, Overflight
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.metrics import truth as truths
from torchvision_dddas.evaluation.metrics.truth import Positions
from torchvision_dddas.geometry import lonlat
from torchvision_dddas.tuning.aerial_location import AerialView
from torchvision_dddas.tuning.location import LocationFamily


def flown(folder: Path, flight: Overflight, sigma: bool = True) -> Clip:
    """The clip of a flight, by tables alone. sigma: whether landmarks say how well they are known."""
    table = flight.landmarks_csv()
    if not sigma:
        table = "\n".join(line.rpartition(",")[0] for line in table.splitlines()) + "\n"
    for name, text in (
        ("landmarks.csv", table),
        ("telemetry.csv", flight.telemetry_csv()),
        ("camera.toml", flight.camera_toml()),
        ("gt.txt", flight.tracks_txt()),
        ("det.txt", flight.tracks_txt(identities=False)),
    ):
        (folder / name).write_text(text)
    where = np.concatenate([flight.targets(frame) for frame in flight.numbers()])
    frames, who = np.repeat(list(flight.numbers()), 4), np.tile(np.arange(1, 5), flight.frames)
    places = Positions(frames, who, where, lonlat(where, ORIGIN) if flight.geographic else None)
    truth = replace(truths.load_truth(folder / "gt.txt"), positions=places)
    return Clip(
        "flown",
        folder,
        rate_hz=10.0,
        truth=truth,
        given=folder / "det.txt",
        telemetry=folder / "telemetry.csv",
        landmarks=folder / "landmarks.csv",
        camera=folder / "camera.toml",
    )


def looks(clip: Clip, settings: Settings | None = None) -> list[AerialView]:
    return [example.content.view for example in LocationFamily().examples([clip], settings or Settings())]


@pytest.mark.parametrize("geographic", [False, True])
def test_looks_of_an_exact_flight_have_no_errors(tmp_path, geographic):
    clip = flown(tmp_path, Overflight(frames=3, geographic=geographic))
    examples = LocationFamily().examples([clip], Settings())
    assert [example.frame for example in examples] == [1, 2, 3]
    assert [len(example.content.view.true_m) for example in examples] == [4, 4, 4]
    wide = LocationFamily().loss({"aerial.target_sigma_px": torch.tensor(1.0)}, examples, 1.0)
    fine = LocationFamily().loss({"aerial.target_sigma_px": torch.tensor(0.05)}, examples, 1.0)
    assert (fine < wide - 1).all()  # no errors: the smaller the ellipses the better


def test_landmarks_that_say_how_well_they_are_known_are_not_tuned(tmp_path):
    flight = Overflight(frames=1, gps_m=0.5)
    (said,) = looks(flown(tmp_path, flight))
    assert said.places.gain["landmarks.sigma_m"].tolist() == [0] * 4
    assert said.places.base.tolist() == pytest.approx([0.25] * 4)
    (unsaid,) = looks(flown(tmp_path, flight, sigma=False))
    assert unsaid.places.gain["landmarks.sigma_m"].tolist() == pytest.approx([1] * 4)
    assert unsaid.places.base.tolist() == pytest.approx([0] * 4, abs=1e-9)


def test_what_is_said_of_reports_changes_no_share_of_them(tmp_path):
    clip = flown(tmp_path, Overflight(frames=1, gps_m=0.5), sigma=False)
    (look,) = looks(clip, with_parameters(Settings(), {"landmarks.sigma_m": 0.0}))
    assert look.places.gain["landmarks.sigma_m"].tolist() == pytest.approx([1] * 4)


def test_a_frame_whose_landmarks_are_swapped_is_left_out(tmp_path):
    clip = flown(tmp_path, Overflight(frames=3))
    lines = [line.split(",") for line in (tmp_path / "landmarks.csv").read_text().splitlines()]
    one, other = (next(cells for cells in lines if cells[:2] == ["2", name]) for name in ("ugv0", "ugv1"))
    one[2:4], other[2:4] = other[2:4], one[2:4]
    (tmp_path / "landmarks.csv").write_text("\n".join(",".join(cells) for cells in lines) + "\n")
    assert [example.frame for example in LocationFamily().examples([clip], Settings())] == [1, 3]


def test_a_clip_without_true_places_is_refused(tmp_path):
    clip = flown(tmp_path, Overflight(frames=1))
    assert clip.truth is not None
    with pytest.raises(InputError, match="flown has no true positions"):
        LocationFamily().examples([replace(clip, truth=replace(clip.truth, positions=None))], Settings())


def test_places_in_metres_beside_landmarks_in_degrees_are_refused(tmp_path):
    clip = flown(tmp_path, Overflight(frames=1))
    assert clip.truth is not None
    assert clip.truth.positions is not None
    places = replace(clip.truth.positions, lonlat_deg=None)
    with pytest.raises(InputError, match="give both in one unit"):
        LocationFamily().examples([replace(clip, truth=replace(clip.truth, positions=places))], Settings())
