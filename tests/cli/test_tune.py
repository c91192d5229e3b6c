"""`dddas tune` on small clips with a family that is known: what it writes, that it goes on, and bad input."""

import json
import math
import sys
from functools import partial
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.cli.conftest import bad, record
from tests.lab.evaluation.studies.world import filmed, study
from tests.lab.tuning.toys import Bowl
from torchvision_dddas.cli import app
from torchvision_dddas.config import load_config
from torchvision_dddas.lab.evaluation.metrics import bootstrap
from torchvision_dddas.lab.tuning import family

THRESHOLD = "difference.threshold"
STEPS = ("--parameters", THRESHOLD, "--steps", "10", "--rate", "0.2", "--jobs", "1")
BOTTOM = math.log(6)


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> Path:
    """A study of three small clips."""
    place = tmp_path_factory.mktemp("tune") / "clips"
    for seed, name in enumerate(("one", "two", "held")):
        filmed(place, name, seed, frames=7)
    return study(place, 'config = "fast"')


def tune(clips: Path, out: Path, *words: str, bowl: Bowl | None = None):
    """Run the command with a bowl as the family of motion."""
    with pytest.MonkeyPatch.context() as here:
        # Fewer samples than in earnest: what is tested here is no interval.
        here.setattr(bootstrap, "effects", partial(bootstrap.effects, resamples=40, most=40))
        here.setattr(family, "load_family", lambda name: bowl or Bowl(place=BOTTOM))
        cache = str(clips.parent / "cache")
        return CliRunner().invoke(app, ["tune", str(clips), "--cache", cache, *STEPS, "--out", str(out), *words])


@pytest.fixture
def one(clips, tmp_path):
    """Tune on one clip into the test's folder."""
    return lambda *words, **rest: tune(clips, tmp_path, "--clips", "one", *words, **rest)


@pytest.fixture(scope="module")
def tuned(clips) -> tuple[Path, str]:
    """The folder of a run, and what it said."""
    out = clips.parent / "first"
    result = tune(clips, out, "--holdout", "h*")
    assert result.exit_code == 0, result.output
    return out, result.output


def test_before_and_after_are_measured_on_clips_tuned_on_and_held_out_apart(clips, tuned) -> None:
    out, said = tuned
    kept = record(out)
    assert kept["state"] == "complete" and kept["family"] == "motion"
    for side, names in (("tuned", ["one", "two"]), ("held_out", ["held"])):
        found = kept["verdict"][side]
        assert found["clips"] == names
        entry = found["changes"]["tasks"]["motion"]["pooled"]["pixels"]["f"]
        assert found["pooled"] == {"before": entry["first"], "after": entry["second"]}
        assert 0 <= entry["first"] <= 1 and entry["first"] != entry["second"]
    assert "Tuned on (2 clips): f" in said and "Held out (1 clip): f" in said
    assert [step["step"] for step in kept["history"]] == list(range(11))
    assert "step 10 of 10: loss" in said and "watched" in said
    page = (out / "report.html").read_text()
    assert THRESHOLD in page and "Clips tuned on" in page and "Clips held out" in page and "http" not in page


def test_a_study_with_the_tuned_settings_gives_the_same_figures(clips, tuned) -> None:
    path, out = tuned[0] / "tuned.toml", clips.parent / "again"
    settings, before = load_config(path), load_config("fast")
    assert settings.difference.threshold == pytest.approx(6, rel=0.4) != before.difference.threshold
    assert settings.registration == before.registration and settings.refine == before.refine
    words = ["evaluate", "--dataset", str(clips), "--config", str(path), "--clips", "held", "--jobs", "1"]
    result = CliRunner().invoke(app, [*words, "--out", str(out), "--cache", str(clips.parent / "cache")])
    assert result.exit_code == 0, result.output
    measured = json.loads((out / "metrics.json").read_text())["tasks"]["motion"]["pooled"]["pixels"]["f"]
    assert record(tuned[0])["verdict"]["held_out"]["pooled"]["after"] == measured


def test_a_resumed_run_does_no_step_twice_and_says_the_same(clips, tuned) -> None:
    out, bowl = tuned[0], Bowl(place=BOTTOM)
    before = record(out)
    result = tune(clips, out, "--holdout", "h*", "--resume", bowl=bowl)
    after = record(out)
    assert result.exit_code == 0 and bowl.calls == []
    assert (before["taken"], after["taken"]) == (10, 0) and "s a step" not in (out / "report.html").read_text()
    assert after["history"] == before["history"] and after["verdict"] == before["verdict"]


def test_a_checkpoint_of_another_plan_is_refused_and_the_run_before_stays(one, tmp_path) -> None:
    assert one().exit_code == 0
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert "with other patience" in bad(one("--patience", "3", "--resume", "--quiet"))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_settings_that_tuning_would_overwrite_are_refused(one, tmp_path) -> None:
    """The figures before are of those settings, read again once the new ones are written."""
    config = tmp_path / "tuned.toml"
    config.write_text("[difference]\nthreshold = 12.0\n")
    assert "tuned.toml is a file that this run writes" in bad(one("--config", str(config)))
    assert load_config(str(config)).difference.threshold == 12


def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_computed(clips, tmp_path) -> None:
    (tmp_path / "file").touch()
    bowl = Bowl()
    bowl.examples = lambda *_: pytest.fail("examples were prepared")  # type: ignore[method-assign]
    assert "cannot write" in bad(tune(clips, tmp_path / "file", bowl=bowl))


def stopped(after: int) -> Bowl:
    """A bowl that Ctrl-C ends after so many losses."""

    class Stopped(Bowl):
        def loss(self, parameters, batch, softness):
            if len(self.calls) > after:
                raise KeyboardInterrupt
            return super().loss(parameters, batch, softness)

    return Stopped(place=BOTTOM)


def test_an_interrupted_run_resumes_to_the_same_end(one, clips, tmp_path) -> None:
    first = one("--resume", bowl=stopped(9))
    assert (
        f"there is no checkpoint at {tmp_path / 'checkpoint.pt'}: the descent starts from the settings"
        in first.output.splitlines()
    )
    assert first.exit_code == 130 and record(tmp_path)["state"] == "interrupted"
    again = one("--resume")
    assert again.exit_code == 0 and "there is no checkpoint" not in again.output
    assert tune(clips, tmp_path / "whole", "--clips", "one").exit_code == 0
    assert record(tmp_path)["history"] == record(tmp_path / "whole")["history"]


def test_an_unfinished_descent_is_kept_beside_the_new_one(one, tmp_path) -> None:
    old, now = tmp_path / "checkpoint.old.pt", tmp_path / "checkpoint.pt"
    assert one(bowl=stopped(8)).exit_code == 130
    begun = now.read_bytes()
    again = one("--rate", "0.1", bowl=stopped(2))  # not as far as the first step's look
    assert again.exit_code == 130 and "unfinished descent of 5 steps, now kept as checkpoint.old.pt" in again.output
    assert old.read_bytes() == begun != now.read_bytes()
    assert one().exit_code == 0
    assert old.read_bytes() == begun, "one of fewer steps took the place of the one of more"
    assert one().exit_code == 0
    assert old.read_bytes() == begun, "a descent that came to its end was kept as unfinished"
    old.replace(now)
    assert one("--resume").exit_code == 0
    assert record(tmp_path)["taken"] == 5


def test_without_torch_one_line_says_what_to_install(clips, monkeypatch) -> None:
    for name in ("torch", "kornia"):
        monkeypatch.setitem(sys.modules, name, None)
    result = CliRunner().invoke(app, ["tune", str(clips), *STEPS])
    assert "needs torch and kornia; pip install" in bad(result)


def test_a_loss_that_is_no_number_ends_in_one_line_and_keeps_the_last_good_settings(one, tmp_path) -> None:
    bowl = Bowl(place=math.log(60), wrong=("one", 2), wrong_above=12)
    result = one("--set", f"{THRESHOLD}=10", bowl=bowl)
    assert result.exit_code == 2 and "Traceback" not in result.output
    last = result.output.strip().splitlines()[-1]
    assert last.startswith("dddas: ") and "one, frame 2" in last and THRESHOLD in last
    assert load_config(tmp_path / "tuned.toml").difference.threshold <= 12
    assert record(tmp_path)["state"] == "failed"
    assert "Stopped" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--parameters difference.absent", "difference.threshold (0.1 to"),
        ("--parameters registration.keypoints", "is not a parameter that can be tuned"),
        ("--parameters=", "names no parameter"),
        (f"--parameters {THRESHOLD},track.wander", "several families"),
        ("--steps 0", "steps must be 1 or more, got 0"),
        ("--pull -1", "pull must be 0 or more, got -1"),
        ("--holdout none*", "fits no clip"),
        ("--holdout *", "leaves no clip"),
        ("--device nowhere", "--device nowhere"),
        ("--device meta", "--device meta"),
        ("--minutes 0", "--minutes must be more than 0"),
        ("--measure motion.pixels", "is not a measure"),
        ("--measure motion.pixels.iou", "not a measure of motion.pixels; wanted accuracy, "),
        ("--measure motion.target.hit", "no clip has truth for motion.target.hit"),
    ],
)
def test_bad_input_is_one_line(clips, tmp_path, words: str, said: str) -> None:
    assert said in bad(tune(clips, tmp_path / "out", *words.split()))
