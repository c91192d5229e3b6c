"""No command leaves files at home or needs a network: what it uses lies in its inputs, and what it makes in --out."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.lab.evaluation.studies import world
from torchvision_dddas.cli import app

# In a new network namespace only the loopback device is there, and it is down.
LOOPBACK_UP = """
import fcntl, socket, struct
with socket.socket() as any_socket:
    fcntl.ioctl(any_socket, 0x8914, struct.pack("16sH14x", b"lo", 1))
"""
MAIN = "from torchvision_dddas.cli import main; main()"
ISOLATED = ["unshare", "--map-root-user", "--net"]

MADE = "--telemetry made/telemetry.csv --landmarks made/landmarks.csv --colours made/colours.toml"
COMMANDS = f"""
settings
citation
demo --out demo
simulate four --set clip.seconds=1 --out made
detect made/frames --config patrol --out found
advise made/frames --rate 10 --telemetry made/telemetry.csv
bench --seconds 5 --size 160x120
people made/ground/ugv1 --out people
track made/frames --config patrol --out tracks
convert tracks/tracks.csv boxes.json
run made/frames --rate 10 --config patrol {MADE} --camera made/camera.toml --dem made/dem.tif --out run
run sim:four --scene clip.seconds=1 --out flown
colours made/frames/000001.jpg --count 2 --out colours.toml
calibrate-flight run/landmarks.csv --telemetry made/telemetry.csv --camera made/camera.toml --rate 10 --out flight.toml
views run/tracks.csv run/tracks.csv --out shared
locate aerial run/tracks.csv --landmarks run/landmarks.csv --camera made/camera.toml --out located
locate ground people/detections.csv --camera camera.toml --out walkers
confirm located/positions.csv walkers/positions.csv --camera camera.toml --out confirmed
calibrate --body-height 1.8 --distance 10 --pixels 215 --size 1280x720 --out lens.toml
evaluate demo/clip/masks demo --out scored
evaluate --dataset study.toml --cache cache --jobs 2 --out before
evaluate --dataset study.toml --cache cache --jobs 1 --set difference.threshold=5 --out after
compare before after --out compare.html
sweep --dataset study.toml --cache cache --grid difference.threshold=4,5 --measure motion.pixels.f --jobs 1 --out swept
tune study.toml --cache cache --parameters difference.threshold --clips masks --steps 1 --jobs 1 --out tuned
export --graph people --out graphs
"""
CAMERA = "focal_px = 1000\nwidth_px = 1280\nheight_px = 960\nheight_m = 1.2\n"


def call(folder: Path, words: list[str]) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder with an empty home, and without a network where the system allows that."""
    home = folder / "home"
    (home / "tmp").mkdir(parents=True, exist_ok=True)
    keep = {name: value for name, value in os.environ.items() if name in ("PATH", "LD_LIBRARY_PATH", "PYTHONPATH")}
    path = os.pathsep.join(filter(None, (str(Path(__file__).parents[2]), keep.pop("PYTHONPATH", ""))))
    environment = keep | {"HOME": str(home), "TMPDIR": str(home / "tmp"), "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    environment["PYTHONDONTWRITEBYTECODE"] = "1"
    alone = shutil.which("unshare") and subprocess.run([*ISOLATED, "true"], capture_output=True).returncode == 0
    line = [*ISOLATED, sys.executable, "-c", LOOPBACK_UP + MAIN] if alone else [sys.executable, "-c", MAIN]
    return subprocess.run([*line, *words], cwd=folder, env=environment, capture_output=True, text=True, check=False)


def files_at_home(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in (folder / "home").rglob("*") if path.is_file())


def test_a_graph_is_run_without_a_trace_at_home_or_a_network(tmp_path) -> None:
    world.filmed(tmp_path, "clip", frames=2, masks=False)
    done = call(tmp_path, ["people", "clip/frames", "--out", "out"])
    assert done.returncode == 0, done.stderr
    assert files_at_home(tmp_path) == []


@pytest.mark.slow
@pytest.mark.e2e
def test_no_command_leaves_a_file_at_home_or_beside_its_outputs_or_needs_a_network(tmp_path) -> None:
    for module in ("torch", "distributed", "rasterio", "onnxscript"):
        pytest.importorskip(module)
    lines = [line.split() for line in COMMANDS.strip().splitlines()]
    called = (command.callback for command in app.registered_commands)
    names = {callback.__name__.replace("_", "-") for callback in called if callback is not None}
    assert {words[0] for words in lines} == names | {group.name for group in app.registered_groups}
    world.three(tmp_path / "clips")
    (tmp_path / "camera.toml").write_text(CAMERA)
    known = {path.name for path in tmp_path.iterdir()} | {"home", "cache", "colours.png"}
    for words in lines:
        done = call(tmp_path, words)
        assert done.returncode == 0, (words, done.stderr[-2000:])
        assert files_at_home(tmp_path) == [], words
    named = {words[words.index("--out") + 1] for words in lines if "--out" in words}
    named |= {"boxes.json", "compare-tables", "compare-figures"}  # of convert, and beside the page of compare
    assert {path.name for path in tmp_path.iterdir()} - known == named
