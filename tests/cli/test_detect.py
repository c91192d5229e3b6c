import json
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import cv2
import pytest

from tests.cli.mistakes import bad
from torchvision_dddas.errors import InputError

ROOT = Path(__file__).resolve().parents[2]


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


def test_the_clip_is_not_written_over(dddas, engine, clip, tmp_path):
    (tmp_path / "out").mkdir()
    film = tmp_path / "out/overlay.mp4"
    film.write_bytes(b"a clip")
    said = bad(dddas("detect", film, "--out", tmp_path / "out"))
    assert "overlay.mp4 is a file that this run writes; choose another folder with --out" in said
    assert film.read_bytes() == b"a clip"


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


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--save", "film"), "--save must name some of masks, overlay, all or none, got 'film'"),
        (("--set", "registration.keypints=5"), "unknown parameter"),
        (("--set", "registration.keypoints=5"), "50 to 5000"),
        (("--config", "nosuch"), "nosuch"),
        (("--telemetry", "nosuch.csv"), "nosuch.csv"),
        (("--rate", "0"), "frame rate"),
    ],
)
def test_a_mistake_in_an_option_is_one_line_and_leaves_no_folder(dddas, engine, clip, tmp_path, words, says):
    assert says in bad(dddas("detect", clip, "--out", tmp_path / "out", *words))
    assert not (tmp_path / "out").exists()


def test_a_missing_input_is_one_line_and_leaves_no_folder(dddas, engine, tmp_path):
    assert "nosuch.mp4" in bad(dddas("detect", tmp_path / "nosuch.mp4", "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_an_output_folder_that_cannot_be_made_is_told_before_the_input_is_opened(dddas, engine, clip, tmp_path):
    (tmp_path / "file").write_text("")
    assert "cannot write into" in bad(dddas("detect", tmp_path / "nosuch", "--out", tmp_path / "file/out"))


def test_an_error_that_the_engine_raises_is_one_line(dddas, engine, clip, tmp_path):
    def stop(scene):
        raise InputError("the clip has 1 frame;\nthe window needs 3: 2 are missing")

    engine(after=stop)
    assert "the window needs 3: 2 are missing" in bad(dddas("detect", clip, "--out", tmp_path / "out", "--quiet"))
    assert not (tmp_path / "out/detections.txt").exists()


def test_usage_errors_exit_with_2(dddas):
    assert dddas("detect").exit_code == 2
    assert dddas("detect", "x", "--backend", "gpu").exit_code == 2
    assert dddas("nosuch").exit_code == 2


def test_ctrl_c_exits_with_130_and_leaves_valid_outputs(clip, tmp_path):
    """In a process of its own, with a true signal while the third frame is on its way."""
    program = f"""
        import importlib.util, os, signal, sys, time
        spec = importlib.util.spec_from_file_location("stubs", {str(Path(__file__).with_name("conftest.py"))!r})
        stubs = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(stubs)

        def after(scene):
            if scene.frame.number == 2:
                print("now", flush=True)
                time.sleep(60)

        import torchvision_dddas.detection as detection
        for name, stub in stubs.stub_engine(after=after).items():
            setattr(detection, name, stub)
        from torchvision_dddas.cli import main
        main()
    """
    words = [
        sys.executable,
        "-c",
        textwrap.dedent(program),
        "detect",
        str(clip),
        "--out",
        str(tmp_path / "out"),
        "--quiet",
    ]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    assert process.stdout.readline() == "now\n"
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=30)
    assert process.returncode == 130
    assert error == "dddas: stopped; what was done until then is kept\n"
    record = json.loads((tmp_path / "out/run.json").read_text())
    assert (record["interrupted"], record["frames"]["written"]) == (True, 2)
    assert len((tmp_path / "out/detections.txt").read_text().splitlines()) == 2
    assert cv2.VideoCapture(str(tmp_path / "out/overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 2
    assert not list((tmp_path / "out").rglob("*.part*"))
