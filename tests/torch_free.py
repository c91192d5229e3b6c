"""Does the package do its work where only its own dependencies are installed, from the wheel, without torch?

    .venv-onboard/bin/python -I tests/torch_free.py

`make test` runs it in such an environment. -I keeps the checkout out: what is tried is what was installed.
"""

import csv
import json
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import torchvision_dddas

DDDAS = Path(sys.executable).parent / "dddas"


def main() -> None:
    """Try every command that flies."""
    for absent in ("torch", "kornia", "onnx", "av", "matplotlib"):
        wants(find_spec(absent) is None, f"{absent} is not installed")
    wants("site-packages" in torchvision_dddas.__file__, "the package is the installed one")
    with tempfile.TemporaryDirectory() as place:
        tried(Path(place))
    sys.stdout.write(f"torch-free: all {len(DONE)} hold\n")


def tried(place: Path) -> None:
    """Detect, recognize, track, locate, fly; and what needs torch says so."""
    dddas("demo", "--out", place / "demo")
    wants(len(rows(place / "demo" / "detections.csv")) > 20, "the demo finds what moves")
    dddas("simulate", "four", "--set", "clip.seconds=3", "--out", place / "made")
    made = place / "made"
    camera = "--camera", made / "camera.toml"
    files = {"--telemetry": "telemetry.csv", "--landmarks": "landmarks.csv", "--colours": "colours.toml"}
    told_by = [word for option, name in files.items() for word in (option, made / name)]
    dddas("run", made / "frames", "--rate", "10", "--config", "patrol", *told_by, *camera, "--out", place / "run")
    found = rows(place / "run" / "positions.csv")
    wants(len(found) > 0 and all(row["longitude_deg"] for row in found), "a clip's targets get places on Earth")
    dddas("track", "--detections", place / "run" / "detections.csv", "--out", place / "tracks")
    wants(len(rows(place / "tracks" / "tracks.csv")) > 0, "a table's targets get identities")
    seen = "--landmarks", place / "run" / "landmarks.csv"
    dddas("locate", "aerial", place / "tracks" / "tracks.csv", *seen, *camera, "--out", place / "located")
    wants(len(rows(place / "located" / "positions.csv")) > 0, "a table's targets get places")
    grounds = sorted((made / "ground").rglob("*.jpg")) + sorted((made / "ground").rglob("*.png"))
    dddas("people", grounds[0].parent, "--out", place / "people")
    wants((place / "people" / "detections.csv").exists(), "pictures from the ground are searched for people")
    dddas("run", "sim:four", "--scene", "clip.seconds=3", "--out", place / "flown")
    told = json.loads((place / "flown" / "run.json").read_text())
    wants(told["state"] == "complete" and told["backend"] == "onboard", "a simulated team flies in a closed loop")
    said = dddas("detect", made / "frames", "--backend", "torch", "--out", place / "no", rc=2).strip().splitlines()
    wants(len(said) == 1 and "pip install" in said[0], "what needs torch says how to get it, in one line")


DONE: list[str] = []


def wants(holds: bool, what: str) -> None:
    """One thing that must hold."""
    if not holds:
        sys.exit(f"torch-free: does not hold: {what}")
    DONE.append(what)


def dddas(*words: object, rc: int = 0) -> str:
    """Run a command; what it said to standard error."""
    line = [str(DDDAS), *map(str, words), "--quiet"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=300)
    if done.returncode != rc:
        sys.exit(f"torch-free: {' '.join(line[1:])} ended with {done.returncode}, not {rc}:\n{done.stderr[-2000:]}")
    return done.stderr


def rows(table: Path) -> list[dict[str, str]]:
    """Those of a CSV."""
    with table.open(newline="") as text:
        return list(csv.DictReader(text))


if __name__ == "__main__":
    main()
