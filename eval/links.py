"""Compare the closed loop over real links with the closed loop in process, in the same simulated worlds.

python eval/links.py --seeds 5 --cache links.jsonl      crowds known, and errors in metres

`dddas simulate --serve --serve-mavlink` serves a world, and `dddas run --live` sees and steers it: pictures and KLV
over UDP, commands over MAVLink. Beside it, `dddas run sim:NAME` flies the same world in process, with the same
configuration. All runs locate their pictures by telemetry, without ground vehicles. A crowd is known at a moment if a
located target is within 5 m of the mean place of its people, in the newest results of the last 2 s of the world. The
error is the distance of the nearest target. The moments are every half second, from 2 s after the first live result of
the seed on, whether the picture shows the crowd or not. A live run takes the time of reception as the time of a
picture, so that latency of the pictures counts as an error. --speed below 1 gives a busy machine time. Decisions are
then older by the clock, and commands that are older than 3 s never leave. --conditions: texts of --link; "" is a
perfect link.
"""

import csv
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import bench
import numpy as np
from bench import Spread

from torchvision_dddas.lab.simulation import load_scenario, scenario_settings

PROGRAM = (sys.executable, "-c", "import sys; from torchvision_dddas.cli import main; sys.exit(main())")
WITHIN_M, HOLD_S, EVERY_S, SETTLED_S = 5.0, 2.0, 0.5, 2.0
PATIENCE_S = 60.0
IN_PROCESS, PLANNED = "in process", "in process, the UAV flies as planned"
Case = dict[str, Any]
Rows = list[tuple[float, np.ndarray]]
"""Times of the world, and places (N, 2) in longitude and latitude."""


def measure(options: bench.Options) -> tuple[str, Any]:
    """Measure the share of known crowds and their errors, over links and in process."""
    load = bench.OtherLoad()
    common = {name: getattr(options, name) for name in ("scenario", "config", "speed", "conditions")}
    cases = [common | {"scene": scene(options), "seed": seed} for seed in range(options.seeds)]
    results = bench.run_cases(cases, fly, 1, options.cache)
    rows = []
    for way in results[0] if results else ():
        of = [result[way] for result in results]
        cells = [Spread(one["known"] for one in of).text(1, 100), Spread(one["error_m"] for one in of).text(2)]
        rows.append([way, *cells, Spread(one.get("commands") for one in of).text(0)])
    head = ["loop", "crowds known, % of moments", "error, m", "commands"]
    about = f"`{options.scenario}`, {options.seconds:g} s at {options.size}, `--config {options.config}`, "
    about += f"{options.seeds} seeds, speed {options.speed:g}; {load.words()}. Mean ± standard error (range)."
    return f"{bench.format_table(head, rows)}\n\n{about}", results


def scene(options: bench.Options) -> list[str]:
    """Return the changes of the scenario for all runs."""
    width, height = bench.parse_size(options.size)
    size = [f"camera.width_px={width}", f"camera.height_px={height}"]
    return [f"clip.seconds={options.seconds:g}", "clip.located_by='telemetry'", "team.ugvs=0", *size]


def fly(case: Case) -> dict[str, dict[str, float]]:
    """Fly a world over links with each condition, and twice in process. Return the figures of each."""
    world = [f"sim:{case['scenario']}", "--seed", case["seed"], *repeat("--scene", case["scene"])]
    world += [*configure(case), "--save", "truth", "--quiet"]
    rate_hz = load_scenario(case["scenario"], case["scene"]).clip.rate_hz
    with tempfile.TemporaryDirectory() as folder:
        sent, found = dict[str, int](), dict[str, tuple[Path, Rows]]()
        for k, link in enumerate(case["conditions"]):
            out, way = Path(folder) / f"links{k}", f"over links, {link or 'perfect'}"
            sent[way] = fly_links(out, case, link)
            found[way] = out / "world", live_places(out)
        begin_s = SETTLED_S + max((rows[0][0] for _, rows in found.values() if rows), default=0.0)
        for name, words in ((IN_PROCESS, []), (PLANNED, ["--set", "steering.follow=false"])):
            out = Path(folder) / name
            run("run", *world, *words, "--out", out)
            found[name] = out, places(out / "positions.csv", rate_hz)
        figures = {way: score(out, rows, rate_hz, begin_s) for way, (out, rows) in found.items()}
    for way, commands in sent.items():
        figures[way]["commands"] = float(commands)
    bench.log(case["seed"], figures)
    return figures


def configure(case: Case) -> list[str]:
    """Return the options of the system for all runs: the configuration, and the scenario's own settings."""
    scenario = load_scenario(case["scenario"], case["scene"], case["seed"])
    settings = [f"{name}={json.dumps(value)}" for name, value in scenario_settings(scenario).items()]
    unsampled = [text for text in settings if not text.startswith("steering.sampling")]
    return ["--config", case["config"], *repeat("--set", [*unsampled, "steering.sampling=false"])]


def fly_links(folder: Path, case: Case, link: str) -> int:
    """Serve a world and run live over its links. Return the number of commands that were sent."""
    pictures, vehicle = f"udp://127.0.0.1:{free_port()}", f"127.0.0.1:{free_port()}"
    scenario = load_scenario(case["scenario"], case["scene"], case["seed"])
    longitude, latitude = scenario.world.origin_deg
    fence, band = f"{longitude},{latitude},{scenario.world.side_m:g}", f"5,{4 * scenario.uav.altitude_m:g}"
    folder.mkdir()
    serve = [*PROGRAM, "simulate", case["scenario"], "--seed", case["seed"], *repeat("--set", case["scene"])]
    serve += ["--serve", pictures, "--serve-mavlink", f"udpout:{vehicle}", "--speed", case["speed"]]
    serve += ["--link", link] * bool(link) + ["--out", folder / "world", "--quiet"]
    live = [*PROGRAM, "run", pictures, "--live", "--wait", "--quiet", "--out", folder / "run", "--allow-commands"]
    live += ["--command", f"mavlink:udp:{vehicle}?system=1", f"--geofence={fence}", "--altitude-band", band]
    live += [*configure(case), "--set", "live.watchdog_s=0"]
    with subprocess.Popen(list(map(str, live))) as running:
        time.sleep(2.0)  # the world should not run ahead of its observer
        run_s = scenario.clip.seconds / case["speed"]
        subprocess.run(list(map(str, serve)), check=True, timeout=5 * run_s + PATIENCE_S)
        time.sleep(3.0)
        running.send_signal(signal.SIGTERM)
        if running.wait(PATIENCE_S):
            raise SystemExit(f"the live run ended with {running.returncode}")
    (session,) = (folder / "run").iterdir()
    bench.log(*(line for line in (session / "events.log").read_text().splitlines() if "command: comm" in line))
    return int(json.loads((session / "run.json").read_text())["counts"].get("commands", 0))


def repeat(option: str, values: Sequence[str]) -> list[str]:
    """Return an option with each of some values."""
    return [word for value in values for word in (option, value)]


def run(*words: object) -> None:
    """Run a command. Its exit code may say that nothing was located."""
    code = subprocess.run([*PROGRAM, *map(str, words)], env=os.environ).returncode
    if code not in (0, 3):
        raise SystemExit(f"dddas {' '.join(map(str, words))} ended with {code}")


def free_port() -> int:
    """Return a free UDP port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def read(path: Path) -> list[Mapping[str, str]]:
    """Return the rows of a table."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def places(path: Path, rate_hz: float, kind: str = "") -> Rows:
    """Return the places of a table by frame. kind: of the rows that count."""
    found: dict[int, list[list[float]]] = {}
    for row in read(path) if path.exists() else []:
        if not kind or row["kind"] == kind:
            found.setdefault(int(row["frame"]), []).append([float(row["longitude_deg"]), float(row["latitude_deg"])])
    return [((frame - 1) / rate_hz, np.array(at)) for frame, at in sorted(found.items())]


def live_places(folder: Path) -> Rows:
    """Return the located targets of a live run at the times of the world that it saw."""
    served = np.array([[float(row["utc_s"]), float(row["time_s"])] for row in read(folder / "world" / "served.csv")])
    (session,) = (folder / "run").iterdir()
    found = []
    for line in (session / "results.jsonl").read_text().splitlines():
        result = json.loads(line)
        utc_s = datetime.fromisoformat(result["utc"]).timestamp()
        targets = [t["lonlat_deg"] for t in result["targets"] if t.get("seen") and t.get("lonlat_deg")]
        found.append((float(np.interp(utc_s, *served.T)), np.array(targets).reshape(-1, 2)))
    return found


def score(out: Path, found: Rows, rate_hz: float, begin_s: float) -> dict[str, float]:
    """Return the share of moments at which crowds are known, and the mean error."""
    true = dict(places(out / "truth" / "positions.csv", rate_hz, "person"))
    times, errors = np.array([time_s for time_s, _ in found]), []
    for time_s in np.arange(begin_s, max(true), EVERY_S):
        at = true[min(true, key=lambda known_s: abs(known_s - time_s))]
        now = (times <= time_s + 1e-6) & (times > time_s - HOLD_S)
        # The newest result with targets counts: frames between two looks have none.
        targets = next((found[k][1] for k in np.flatnonzero(now)[::-1] if len(found[k][1])), np.zeros((0, 2)))
        metres = np.array([111_320.0 * np.cos(np.radians(at[0, 1])), 111_320.0])
        apart = np.linalg.norm((at[:, None] - targets) * metres, axis=2)
        errors += apart.min(axis=1, initial=np.inf).tolist()
    known = [error for error in errors if error <= WITHIN_M]
    share = len(known) / len(errors) if errors else float("nan")
    return {"known": share, "error_m": float(np.mean(known)) if known else float("nan"), "from_s": begin_s}


if __name__ == "__main__":
    options = {"--scenario": "leaving", "--config": "fast", "--seconds": 28.0, "--size": "320x240", "--speed": 0.8}
    options |= {"--seeds": 5, "--conditions": ["", "latency=0.5", "loss=0.02"], "--cache": None}
    bench.main(__doc__, {"": (measure, options)})
