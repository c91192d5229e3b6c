"""`dddas tune` on small clips with a family that is known: what it writes, that it goes on, and bad input."""

import json
import math
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.cli.conftest import bad, record
from tests.evaluation.studies.world import filmed, study
from tests.tuning.toys import Bowl
from torchvision_dddas.cli import app
from torchvision_dddas.config import load_config
from torchvision_dddas.evaluation.metrics import bootstrap
from torchvision_dddas.tuning import family, time_cost

THRESHOLD = "difference.threshold"
ASKED = ("--knobs", THRESHOLD, "--steps", "10", "--rate", "0.2", "--jobs", "1")


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> Path:
    """A study of three small clips."""
    place = tmp_path_factory.mktemp("tune") / "clips"
    for seed, name in enumerate(("one", "two", "held")):
        filmed(place, name, seed, frames=7)
    return study(place, 'config = "fast"')


def asked(clips: Path, *words: str, bowl: Bowl | None = None):
    """Run the command with a bowl as the family of motion."""
    with pytest.MonkeyPatch.context() as here:
        # Fewer samples than in earnest: what is tested here is no interval.
        here.setattr(bootstrap, "effects", partial(bootstrap.effects, resamples=40, most=40))
        here.setattr(family, "load_family", lambda name: bowl or Bowl(place=math.log(6)))
        return CliRunner().invoke(app, ["tune", str(clips), "--cache", str(clips.parent / "cache"), *words])


@pytest.fixture(scope="module")
def tuned(clips) -> tuple[Path, str]:
    """The folder of a run, and what it said."""
    out = clips.parent / "first"
    result = asked(clips, *ASKED, "--holdout", "h*", "--out", str(out))
    assert result.exit_code == 0, result.output
    return out, result.output


def test_the_tuned_settings_are_written_for_config_and_keep_what_was_not_tuned(tuned) -> None:
    settings, before = load_config(tuned[0] / "tuned.toml"), load_config("fast")
    assert settings.difference.threshold == pytest.approx(6, rel=0.4) != before.difference.threshold
    assert settings.registration == before.registration and settings.refine == before.refine


def test_before_and_after_are_measured_on_clips_tuned_on_and_held_out_apart(tuned) -> None:
    kept = record(tuned[0])
    assert kept["state"] == "complete" and kept["family"] == "motion"
    for side, names in (("tuned", ["one", "two"]), ("held_out", ["held"])):
        found = kept["verdict"][side]
        assert found["clips"] == names
        entry = found["changes"]["tasks"]["motion"]["pooled"]["pixels"]["f"]
        assert found["pooled"] == {"before": entry["first"], "after": entry["second"]}
        assert 0 <= entry["first"] <= 1 and entry["first"] != entry["second"]
    assert "Tuned on (2 clips): f" in tuned[1] and "Held out (1 clip): f" in tuned[1]
    assert [step["step"] for step in kept["history"]] == list(range(11))
    assert "step 10 of 10: loss" in tuned[1] and "watched" in tuned[1]
    page = (tuned[0] / "report.html").read_text()
    assert THRESHOLD in page and "Clips tuned on" in page and "Clips held out" in page and "http" not in page


def test_the_figures_are_those_of_the_study_with_the_tuned_settings(clips, tuned) -> None:
    words = ["evaluate", "--dataset", str(clips), "--config", str(tuned[0] / "tuned.toml"), "--clips", "held"]
    out = clips.parent / "again"
    result = CliRunner().invoke(app, [*words, "--out", str(out), "--cache", str(clips.parent / "cache"), "--jobs", "1"])
    assert result.exit_code == 0, result.output
    measured = json.loads((out / "metrics.json").read_text())["tasks"]["motion"]["pooled"]["pixels"]["f"]
    kept = record(tuned[0])
    assert kept["verdict"]["held_out"]["pooled"]["after"] == measured


def test_a_run_that_is_taken_up_does_no_step_twice_and_says_the_same(clips, tuned, tmp_path) -> None:
    bowl = Bowl(place=math.log(6))
    out = clips.parent / "first"
    before = record(out)
    result = asked(clips, *ASKED, "--holdout", "h*", "--out", str(out), "--resume", bowl=bowl)
    after = record(out)
    assert result.exit_code == 0 and bowl.calls == []
    assert (before["taken"], after["taken"]) == (10, 0) and "s a step" not in (out / "report.html").read_text()
    assert after["history"] == before["history"] and after["verdict"] == before["verdict"]


def test_a_pull_holds_the_parameter_where_it_began(clips, tuned, tmp_path) -> None:
    result = asked(clips, *ASKED, "--clips", "one", "--pull", "100", "--out", str(tmp_path))
    assert result.exit_code == 0, result.output
    held, free = (record(out)["history"] for out in (tmp_path, tuned[0]))
    moved = [abs(steps[-1]["knobs"][THRESHOLD] - steps[0]["knobs"][THRESHOLD]) for steps in (held, free)]
    assert moved[0] < moved[1] / 2
    wrong = asked(clips, *ASKED, "--pull", "-1", "--out", str(tmp_path / "wrong"))
    assert wrong.exit_code == 2 and "pull must be 0 or more, got -1" in wrong.output


def test_a_cost_is_measured_once_and_kept_for_a_run_that_is_taken_up(clips, tmp_path, monkeypatch) -> None:
    calls = list[float]()

    def timed(settings) -> float:
        calls.append(settings.difference.threshold)
        return settings.difference.threshold

    monkeypatch.setattr(time_cost, "frame_timer", lambda *_: timed)
    words = (*ASKED, "--clips", "one", "--cost", "0.5", "--out", str(tmp_path))
    assert asked(clips, *words).exit_code == 0
    count = len(calls)
    kept = record(tmp_path)["cost"]
    assert kept["weight"] == 0.5 and [curve["knob"] for curve in kept["curves"]] == [THRESHOLD]
    assert asked(clips, *words, "--resume").exit_code == 0
    assert len(calls) == count > 0
    assert "What time costs" in (tmp_path / "report.html").read_text()


def test_what_is_refused_leaves_the_record_of_the_run_before(clips, tmp_path) -> None:
    words = (*ASKED, "--clips", "one", "--out", str(tmp_path))
    assert asked(clips, *words).exit_code == 0
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for option, value in (("patience", "3"), ("cost", "2")):
        result = asked(clips, *words, f"--{option}", value, "--resume", "--quiet")
        assert f"with other {option}" in bad(result)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@dataclass
class Choosy(Bowl):
    """A bowl of two losses."""

    losses: tuple[str, ...] = ("round", "square")
    loss_name: str = "round"


def test_the_loss_that_was_chosen_is_recorded_and_no_checkpoint_of_another_is_taken(clips, tmp_path) -> None:
    words = (*ASKED, "--clips", "one", "--out", str(tmp_path))
    bowl = Choosy(place=math.log(6))
    assert asked(clips, *words, "--loss", "square", bowl=bowl).exit_code == 0
    assert record(tmp_path)["loss"] == "square"
    assert "motion, loss square, on" in (tmp_path / "report.html").read_text()
    result = asked(clips, *words, "--resume", "--quiet", bowl=bowl)
    assert "with other loss, square and not round" in bad(result)
    unknown = asked(clips, *words, "--loss", "oval", bowl=bowl)
    assert "'oval' is no loss of the family motion; wanted one of round, square" in bad(unknown)


def test_settings_that_tuning_would_overwrite_are_refused(clips, tmp_path) -> None:
    """The figures before are of those settings, read again once the new ones are written."""
    (tmp_path / "tuned.toml").write_text("[difference]\nthreshold = 12.0\n")
    config = str(tmp_path / "tuned.toml")
    result = asked(clips, *ASKED, "--config", config, "--out", str(tmp_path))
    assert "tuned.toml is a file that this run writes" in bad(result)
    assert load_config(config).difference.threshold == 12


def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_computed(clips, tmp_path) -> None:
    (tmp_path / "file").touch()
    bowl = Bowl()
    bowl.examples = lambda *_: pytest.fail("examples were prepared")  # type: ignore[method-assign]
    assert "cannot write" in bad(asked(clips, *ASKED, "--out", str(tmp_path / "file"), bowl=bowl))


def stopped(after: int) -> Bowl:
    """A bowl that Ctrl-C ends after so many losses."""

    class Stopped(Bowl):
        def loss(self, parameters, batch, softness):
            if len(self.calls) > after:
                raise KeyboardInterrupt
            return super().loss(parameters, batch, softness)

    return Stopped(place=math.log(6))


def test_a_run_that_is_stopped_says_so_and_can_be_resumed(clips, tmp_path) -> None:
    words = (*ASKED, "--clips", "one", "--out", str(tmp_path))
    assert asked(clips, *words, bowl=stopped(9)).exit_code == 130
    assert record(tmp_path)["state"] == "interrupted"
    assert asked(clips, *words, "--resume").exit_code == 0
    whole = asked(clips, *words[:-1], str(tmp_path / "whole"))
    assert whole.exit_code == 0
    histories = [record(place)["history"] for place in (tmp_path, tmp_path / "whole")]
    assert histories[0] == histories[1]


def test_without_a_checkpoint_to_go_on_from_it_is_said_that_it_begins_anew(clips, tmp_path) -> None:
    words = (*ASKED, "--clips", "one", "--out", str(tmp_path), "--resume")
    first = asked(clips, *words)
    assert first.exit_code == 0
    assert f"there is no checkpoint at {tmp_path / 'checkpoint.pt'}: it begins anew" in first.output.splitlines()
    assert "begins anew" not in asked(clips, *words).output


def test_an_unfinished_descent_is_kept_beside_the_new_one(clips, tmp_path) -> None:
    words = (*ASKED, "--clips", "one", "--out", str(tmp_path))
    old, now = tmp_path / "checkpoint.old.pt", tmp_path / "checkpoint.pt"
    assert asked(clips, *words, bowl=stopped(8)).exit_code == 130
    begun = now.read_bytes()
    again = asked(clips, *words, "--rate", "0.1", bowl=stopped(2))  # not as far as the first step's look
    assert again.exit_code == 130 and "unfinished descent, of 5 steps; kept as checkpoint.old.pt" in again.output
    assert old.read_bytes() == begun != now.read_bytes()
    assert asked(clips, *words).exit_code == 0
    assert old.read_bytes() == begun, "one of fewer steps took the place of the one of more"
    assert asked(clips, *words).exit_code == 0
    assert old.read_bytes() == begun, "a descent that came to its end was kept as unfinished"
    old.replace(now)
    assert asked(clips, *words, "--resume").exit_code == 0
    assert record(tmp_path)["taken"] == 5


def test_without_torch_one_line_says_what_to_install(clips, monkeypatch) -> None:
    for name in ("torch", "kornia"):
        monkeypatch.setitem(sys.modules, name, None)
    result = CliRunner().invoke(app, ["tune", str(clips), *ASKED])
    assert "needs torch and kornia; pip install" in bad(result)


def test_a_loss_that_is_no_number_ends_in_one_line_and_keeps_the_last_good_settings(clips, tmp_path) -> None:
    bowl = Bowl(place=math.log(60), wrong=("one", 2), wrong_above=12)
    result = asked(clips, *ASKED, "--clips", "one", "--set", f"{THRESHOLD}=10", "--out", str(tmp_path), bowl=bowl)
    assert result.exit_code == 2 and "Traceback" not in result.output
    last = result.output.strip().splitlines()[-1]
    assert last.startswith("dddas: ") and "one, frame 2" in last and THRESHOLD in last
    assert load_config(tmp_path / "tuned.toml").difference.threshold <= 12
    assert record(tmp_path)["state"] == "failed"
    assert "Stopped" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--knobs", "difference.absent"), "difference.threshold (0.1 to"),
        (("--knobs", "registration.keypoints"), "is no parameter that can be tuned"),
        (("--knobs", ""), "names no parameter"),
        (("--knobs", f"{THRESHOLD},track.speed"), "several families"),
        (("--knobs", THRESHOLD, "--steps", "0"), "steps must be 1 or more, got 0"),
        (("--knobs", THRESHOLD, "--holdout", "none*"), "fits no clip"),
        (("--knobs", THRESHOLD, "--holdout", "*"), "leaves no clip"),
        (("--knobs", THRESHOLD, "--cost", "-1"), "--cost must be 0 or more"),
        (("--knobs", THRESHOLD, "--device", "nowhere"), "--device nowhere"),
        (("--knobs", THRESHOLD, "--device", "meta"), "--device meta"),
        (("--knobs", THRESHOLD, "--minutes", "0"), "--minutes must be more than 0"),
        (("--knobs", THRESHOLD, "--loss", "f"), "is no loss of the family motion; it has one only"),
        (("--knobs", THRESHOLD, "--measure", "motion.pixels"), "is no measure"),
        (("--knobs", THRESHOLD, "--measure", "motion.pixels.iou"), "no measure of motion.pixels; wanted accuracy, "),
        (("--knobs", THRESHOLD, "--measure", "motion.target.hit"), "no clip has truth for motion.target.hit"),
    ],
)
def test_bad_input_is_one_line(clips, tmp_path, words: tuple[str, ...], said: str) -> None:
    result = asked(clips, *words, "--out", str(tmp_path / "out"))
    assert said in bad(result)
