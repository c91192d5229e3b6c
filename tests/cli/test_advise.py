"""`dddas advise`: its sizes are those of the flight, and its options follow the rules of detection."""

from pathlib import Path
from typing import Any

import pytest

from tests.cli.conftest import bad
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.detection import settings_at
from torchvision_dddas.pipeline import Assembly
from torchvision_dddas.pipeline.advice import ClipSurvey, choose_options, describe_sizes
from torchvision_dddas.types import Flight

NO_ENGINE: Any = None


def look(rate_hz: float = 50.0, square_px: float = 20.0, count: int = 8) -> ClipSurvey:
    return ClipSurvey(10, [1.5 * square_px] * count, [square_px] * count, [1.0], delay_frames=3, rate_hz=rate_hz)


def choose(seen: ClipSurvey, height_m: float = 0.0, live: bool = False, quick_hz: float = 30.0, **parameters: float):
    settings = with_parameters(Settings(), {name.replace("__", "."): value for name, value in parameters.items()})
    distances = [settings_at(Flight(height_m), 25.0, settings)] if height_m else []
    ready = Assembly(settings, NO_ENGINE)
    found = choose_options(
        seen, ready, distances, rate_hz=25.0, live=live, look_with=lambda name: look(quick_hz * (1 + (name == "half")))
    )
    return *found, describe_sizes(seen, ready, distances)[0]


def test_the_default_needs_no_option_for_usual_targets_at_a_usual_speed() -> None:
    assert choose(look())[:2] == ({}, [])


def test_targets_that_are_tiny_without_a_log_ask_for_the_size_of_people() -> None:
    options, _, sizes = choose(look(square_px=4.0))
    assert list(options) == ["--set gates.person_px=4.0"]
    assert "unknown without --telemetry" in sizes


def test_a_log_tells_the_sizes_and_no_option_is_needed_for_them() -> None:
    options, _, sizes = choose(look(square_px=4.0), height_m=100.0, gates__focal_px=1000.0)
    assert options == {}
    assert "a person covers a square of 5 px, a vehicle of 4.5 m is 45 px long" in sizes


def test_a_slow_machine_takes_the_first_quicker_configuration_that_keeps_up_with_a_stream() -> None:
    assert list(choose(look(rate_hz=5), live=True)[0]) == ["--config fast"]
    assert list(choose(look(rate_hz=5), live=True, quick_hz=20)[0]) == ["--config half"]
    options, remarks, _ = choose(look(rate_hz=5))
    assert options == {} and "without --live, no picture is dropped" in remarks[0]
    assert "run --live with such a stream needs --config fast: the clip has 25 frames/s" in remarks[0]


def test_no_configuration_without_settings_for_tiny_people_is_advised_where_they_are_tiny() -> None:
    options, remarks, _ = choose(look(rate_hz=5, square_px=4.0), live=True)
    assert list(options) == ["--set gates.person_px=4.0"] and "no settings for tiny people" in remarks[0]


def test_nothing_that_moves_is_said_and_not_guessed_from() -> None:
    options, remarks, _ = choose(look(count=0))
    assert options == {} and "--config patrol" in remarks[0]


@pytest.mark.usefixtures("engine")
def test_the_command_to_run_is_the_last_line(clip: Path, dddas) -> None:
    done = dddas("advise", clip, "--rate", "25", "--set", "gates.min_area_px=30")
    assert done.exit_code == 0, done.output
    assert done.stdout.splitlines()[-1].startswith(f"dddas run {clip} --rate 25 --set gates.min_area_px=30")
    assert "unreliable: 1 of 5 frames; 1 because blank" in done.stdout


def test_a_log_without_places_is_not_said_to_need_nothing(clip: Path, dddas, tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("time_s,altitude_m,speed_m_s\n0,50,5\n9,50,5\n")
    lines = dddas("advise", str(clip), "--telemetry", str(log)).output.splitlines()
    assert any(line.startswith("note: 0 located, because") for line in lines)
    assert any(line.startswith("nothing is located without the data named above") for line in lines)


def test_a_simulated_clip_and_a_camera_without_a_log_are_refused(dddas) -> None:
    assert "dddas simulate" in bad(dddas("advise", "sim:four"))
    assert "--telemetry" in bad(dddas("advise", "clip.mp4", "--camera", "a.toml"))


def test_a_bad_size_of_the_benchmark_is_one_line(dddas) -> None:
    assert "WIDTHxHEIGHT" in bad(dddas("bench", "--size", "big"))
