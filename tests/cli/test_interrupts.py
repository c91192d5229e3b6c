"""Ctrl-C: exit code 130, one line, and whole files of what was done until then."""

import shlex
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import cv2
import pytest

from tests.cli.conftest import record

ROOT = Path(__file__).resolve().parents[2]

# A command whose progress stops it in its third frame, until the signal comes.
PROGRAM = textwrap.dedent("""
    import time
    from contextlib import contextmanager
    from torchvision_dddas.cli import main, progress

    @contextmanager
    def stopping(*_):
        count = 0

        def tick():
            nonlocal count
            count += 1
            if count == 3:
                print("now", flush=True)
                time.sleep(60)

        yield tick

    progress.progress = stopping
    main()
""")


@pytest.mark.parametrize(
    ("line", "table"),
    [
        pytest.param("detect {clip} --config fast", "detections.txt", marks=pytest.mark.slow),
        ("track {clip} --detections {folder}/det.txt", "tracks.txt"),
        pytest.param("people {clip} --set people.enlarge=4", "detections.txt", marks=pytest.mark.slow),
    ],
)
def test_ctrl_c_exits_with_130_and_leaves_valid_outputs(clip, tmp_path, line, table):
    (tmp_path / "det.txt").write_text("".join(f"{n},-1,{4 + n},10,8,24,0.95,-1,-1,-1\n" for n in range(1, 6)))
    out = tmp_path / "out"
    words = shlex.split(line.format(clip=clip, folder=tmp_path))
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *words, "--out", str(out), "--quiet"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "now\n", process.communicate(timeout=60)[1]
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert error == "dddas: interrupted; results up to here are kept\n"
    kept = record(out)
    assert (kept["interrupted"], kept["frames"]["written"]) == (True, 3)
    assert {row.split(",")[0] for row in (out / table).read_text().splitlines()} <= {"1", "2", "3"}
    assert cv2.VideoCapture(str(out / "overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 3
    assert not list(out.rglob("*.part*"))
