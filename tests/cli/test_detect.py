import json

from tests.cli.conftest import bad
from torchvision_dddas.errors import InputError


def test_masks_and_tables_for_every_frame_and_no_word_when_quiet(dddas, engine, clip, tmp_path):
    result = dddas("detect", clip, "--out", tmp_path / "out", "--save", "masks", "--quiet")
    assert (result.exit_code, result.output) == (0, "")
    assert sorted(p.name for p in (tmp_path / "out/masks").iterdir()) == [f"{k:06d}.png" for k in range(1, 6)]
    assert len((tmp_path / "out/detections.txt").read_text().splitlines()) == 5
    assert not (tmp_path / "out/overlay.mp4").exists()


def test_everything_is_saved_by_default_and_the_end_is_summed_up(dddas, engine, clip, tmp_path):
    result = dddas("detect", clip, "--out", tmp_path / "out", "--backend", "onboard")
    assert result.exit_code == 0
    assert result.stdout.splitlines() == [
        "5 frames, 5 targets, 1 frames with unreliable registration",
        f"{tmp_path / 'out'}: detections.csv, detections.txt, masks/, overlay.mp4, run.json",
    ]
    record = json.loads((tmp_path / "out/run.json").read_text())
    assert (record["state"], record["backend"]) == ("complete", "stub onboard")
    assert record["clip"]["size"] == [64, 48]
    assert record["unreliable"] == [{"first": 2, "last": 2, "cause": "blank"}]
    assert "registration" in record["settings"]


def test_a_frame_that_cannot_be_decoded_is_told_and_recorded(dddas, engine, clip, tmp_path):
    (clip / "00002.png").write_bytes(b"no picture")
    result = dddas("detect", clip, "--out", tmp_path / "out", "--save", "none")
    assert result.exit_code == 0
    assert "1 problem while reading, the first: " in result.stdout
    assert len(json.loads((tmp_path / "out/run.json").read_text())["problems"]) == 1


def test_several_clips_get_a_folder_each(dddas, engine, clip, tmp_path):
    result = dddas("detect", clip, clip, "--out", tmp_path / "out", "--save", "none", "--quiet")
    assert result.exit_code == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["walk", "walk-2"]


def test_knobs_are_set_and_recorded(dddas, engine, clip, tmp_path):
    words = ("--set", "registration.keypoints=77", "--config", "fast", "--save", "none", "--quiet")
    assert dddas("detect", clip, "--out", tmp_path / "out", *words).exit_code == 0
    record = json.loads((tmp_path / "out/run.json").read_text())
    assert record["settings"]["registration"]["keypoints"] == 77


def test_an_error_that_the_engine_raises_is_one_line(dddas, engine, clip, tmp_path):
    def stop(scene):
        raise InputError("the clip has 1 frame;\nthe window needs 3: 2 are missing")

    engine(after=stop)
    assert "the window needs 3: 2 are missing" in bad(dddas("detect", clip, "--out", tmp_path / "out", "--quiet"))
    assert not (tmp_path / "out/detections.txt").exists()
