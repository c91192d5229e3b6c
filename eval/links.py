"""Compare the closed loop over real links with the closed loop in process, in the same simulated worlds.

python eval/links.py loop --seeds 10 --cache links.jsonl      crowds known, and errors in metres
python eval/links.py faults                                   when faults of instruments are reported, and how they end
python eval/links.py repeat --runs 200                        short closed loops over links: how many fail

`dddas simulate --serve --serve-mavlink` serves a world, and `dddas run --live` sees and steers it: pictures and KLV
over UDP, commands over MAVLink. Beside it, `dddas run sim:NAME` flies the same world in process, with the same
configuration, terrain and lens. All runs locate their pictures by telemetry, without ground vehicles.
"""

import csv
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import bench
import numpy as np
from bench import Spread

from torchvision_dddas.lab.simulation import load_scenario, scenario_settings

PROGRAM = (sys.executable, "-c", "import sys; from torchvision_dddas.cli import main; sys.exit(main())")
WITHIN_M, HOLD_S, EVERY_S = 5.0, 2.0, 0.5
# The crowd stands until a live run has joined the world. Moments count soon after it begins to walk.
FROM_S, SETTLED_S = 8.0, 3.0
PATIENCE_S, POLL_S = 60.0, 0.1
LINKS, PROCESS, PLANNED = "over links", "in process", "in process, not steered"
INSTRUMENTS, VERBS = ("camera", "gps", "attitude"), ("off", "stuck", "wrong", "slow")
FAULT_S, APART_S = 5.0, 20.0  # duration of a fault, and from one fault to the next
Case = dict[str, Any]
Rows = list[tuple[float, np.ndarray]]
"""Times of the world, and places (N, 2) in longitude and latitude."""


def measure_loop(options: bench.Options) -> tuple[str, Any]:
    """Measure the share of known crowds and their errors, over links and in process.

    A crowd is known at a moment if a located target is within 5 m of the mean place of its people, in the newest
    results of the last 2 s of the world. The error is the distance of the nearest target. The moments are every half
    second, from 3 s after the crowd begins to walk, whether the picture shows the crowd or not. Results count at the
    times that they give for their pictures. --speed below 1 gives a busy machine time. Decisions are then older by the
    clock, and commands that are older than 3 s never leave. --conditions: texts of --link, and wind=M_S for gusts; ""
    is a perfect link. --fewer: seeds of the conditions other than the first.
    """
    common = {"scenario": options.scenario, "config": options.config, "speed": options.speed}
    cases: list[Case] = []
    for condition in options.conditions:
        wind = [f"uav.wind_m_s={condition.removeprefix('wind=')}"] if condition.startswith("wind=") else []
        link = "" if wind else condition
        for seed in range(options.seeds if condition == options.conditions[0] else options.fewer):
            case = common | {"scene": [*scene(options), *wind], "seed": seed, "condition": condition, "link": link}
            ways = (
                (LINKS, PROCESS, PLANNED) if condition == options.conditions[0] else (LINKS, PROCESS)[: 1 + bool(wind)]
            )
            cases += [case | {"way": way} for way in ways]
    load = bench.OtherLoad()
    results = bench.run_cases(cases, fly, 1, options.cache)
    found = [
        {name: case[name] for name in ("condition", "way", "seed")} | result
        for case, result in zip(cases, results, strict=True)
    ]
    about = f"`{options.scenario}`, {options.seconds:g} s at {options.size}, `--config {options.config}`, speed "
    about += f"{options.speed:g}; {bench.machine_words()}; {load.words()}. Mean ± standard error (range)."
    return f"{table(found)}\n\n{about}", found


def table(found: Sequence[Case]) -> str:
    """Return the figures of each condition and way, beside the loop in process with the same seeds and wind."""
    head = ["condition", "loop", "seeds", "crowds known, % of moments", "of in process, %"]
    head += ["error, m", "error in process / error, %", "commands"]
    rows = []
    for condition, way in dict.fromkeys((row["condition"], row["way"]) for row in found):
        of = {row["seed"]: row for row in found if (row["condition"], row["way"]) == (condition, way)}
        own = [row for row in found if row["way"] == PROCESS and row["seed"] in of]
        beside = [row for row in own if row["condition"] == condition] or own
        beside = list({row["seed"]: row for row in reversed(beside)}.values())
        known, error, known_in, error_in = (
            Spread(row[name] for row in rows) for rows in (of.values(), beside) for name in ("known", "error_m")
        )
        shares = known.mean / known_in.mean, error_in.mean / error.mean
        ratios = [f"{100 * share:.0f}" if np.isfinite(share) else "–" for share in shares]
        commands = Spread(row.get("commands") for row in of.values()).text(0) if way == LINKS else ""
        cells = [len(of), known.text(1, 100), ratios[0], error.text(2), ratios[1], commands]
        rows.append([condition or "perfect link", way, *cells])
    return bench.format_table(head, rows)


def scene(options: bench.Options) -> list[str]:
    """Return the changes of the scenario for all runs."""
    width, height = bench.parse_size(options.size)
    changes = [f"camera.width_px={width}", f"camera.height_px={height}", f"uav.altitude_m={options.altitude:g}"]
    return [f"clip.seconds={options.seconds:g}", "clip.located_by='telemetry'", "team.ugvs=0", *changes] + [
        f"crowd.{k}.from_s={FROM_S:g}" for k in range(1, 1 + len(load_scenario(options.scenario).crowd))
    ]


def fly(case: Case) -> dict[str, float]:
    """Fly a world one way. Return its figures."""
    rate_hz, begin_s = load_scenario(case["scenario"], case["scene"]).clip.rate_hz, FROM_S + SETTLED_S
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        if case["way"] == LINKS:
            commands, _ = fly_links(out, case)
            figures = score(out / "world", live_places(out), rate_hz, begin_s) | {"commands": commands}
        else:
            world = [f"sim:{case['scenario']}", "--seed", case["seed"], *repeat("--scene", case["scene"])]
            steering = ["--set", "steering.follow=false"] * (case["way"] == PLANNED)
            run("run", *world, *configure(case), "--save", "truth", "--quiet", *steering, "--out", out)
            figures = score(out, places(out / "positions.csv", rate_hz), rate_hz, begin_s)
    bench.log(case["condition"], case["way"], case["seed"], figures)
    return figures


def configure(case: Case) -> list[str]:
    """Return the options of the system for all runs: the configuration, and the scenario's own settings."""
    scenario = load_scenario(case["scenario"], case["scene"], case["seed"])
    settings = [f"{name}={json.dumps(value)}" for name, value in scenario_settings(scenario).items()]
    unsampled = [text for text in settings if not text.startswith("steering.sampling")]
    return ["--config", case["config"], *repeat("--set", [*unsampled, "steering.sampling=false"])]


def measure_faults(options: bench.Options) -> tuple[str, Any]:
    """Measure when faults of instruments are reported, and how long after their end a run is healthy.

    Each instrument fails for 5 s in each of the four ways, one after the other, and the live run's /health.json is read
    ten times a second. It sends no commands, because some faults end commanding for good. reported: from the begin of
    the fault to a trouble. healthy: from the end of the fault to the last trouble; a dash for a fault without any.
    """
    common = {"scenario": options.scenario, "config": options.config, "speed": options.speed, "link": ""}
    length = {"scene": [*scene(options), f"clip.seconds={FROM_S + APART_S * len(VERBS):g}"]}
    cases = [common | length | {"seed": 0, "instrument": instrument} for instrument in INSTRUMENTS]
    results = bench.run_cases(cases, fly_faults, 1, options.cache)
    found = [row for result in results for row in result]
    rows = []
    for row in found:
        times = ["–" if row[name] is None else f"{row[name]:.1f}" for name in ("reported_s", "healthy_s")]
        rows.append([row["instrument"], row["verb"], *times, row["trouble"] or "–"])
    head = ["instrument", "fault", "reported after, s", "healthy again after, s", "trouble"]
    about = f"`{options.scenario}` at {options.size}, `--config {options.config}`, speed {options.speed:g}"
    return f"{bench.format_table(head, rows)}\n\n{about}; {bench.machine_words()}.", found


def fly_faults(case: Case) -> list[dict[str, Any]]:
    """Let an instrument fail in each way, and return when the run says so."""
    begin_s = [FROM_S + APART_S * k for k in range(len(VERBS))]
    faults = [f"{case['instrument']}={verb}@{s:g}..{s + FAULT_S:g}" for verb, s in zip(VERBS, begin_s, strict=True)]
    seen = list[tuple[float, str]]()

    def watch(page: str) -> None:
        with suppress(OSError, ValueError):
            try:
                answer = urllib.request.urlopen(f"{page}/health.json", timeout=1.0)
            except urllib.error.HTTPError as error:  # 503 is the answer in trouble
                answer = error
            seen.append((time.time(), json.loads(answer.read())["trouble"]))

    with tempfile.TemporaryDirectory() as folder:
        fly_links(Path(folder) / "out", case, faults, watch)
        served = np.array(
            [[float(row[n]) for n in ("time_s", "utc_s")] for row in read(Path(folder) / "out/world/served.csv")]
        )
    found = []
    for verb, (from_s, until_s) in zip(VERBS, pairwise([*begin_s, begin_s[-1] + APART_S]), strict=True):
        begin, end, until = np.interp([from_s, from_s + FAULT_S, until_s], *served.T)
        told = [(utc_s, words) for utc_s, words in seen if begin < utc_s < until and words]
        first, last = (told[0][0] - begin, max(0.0, told[-1][0] + POLL_S - end)) if told else (None, None)
        words = re.sub(r"udp://\S+", "the camera", told[0][1]) if told else ""
        found.append(
            {"instrument": case["instrument"], "verb": verb, "reported_s": first, "healthy_s": last, "trouble": words}
        )
        bench.log(found[-1])
    return found


def measure_repeat(options: bench.Options) -> tuple[str, Any]:
    """Repeat a short closed loop over links. A run fails if it ends with an error, locates nothing or sends no command.

    It fails, too, if commanding ends before the world does. With --cache, more runs can follow later.
    """
    common = {"scenario": options.scenario, "config": options.config, "speed": options.speed, "link": ""}
    cases = [common | {"scene": scene(options), "seed": seed} for seed in range(options.runs)]
    results = bench.run_cases(cases, fly_once, 1, options.cache)
    failed = [words for words in results if words]
    text = f"{len(failed)} of {len(results)} runs failed ({100 * len(failed) / len(results):.1f} %)."
    return "\n".join([text, *(f"- {words}" for words in sorted(set(failed)))]), {"runs": len(results), "failed": failed}


def fly_once(case: Case) -> str:
    """Fly a closed loop over links. Return why it failed; "" if it did not."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        try:
            commands, events = fly_links(out, case)
        except (SystemExit, subprocess.TimeoutExpired) as error:
            return str(error)
        served_s = float(read(out / "world" / "served.csv")[-1]["utc_s"])
        ended = [line for line in events if "commanding has ended" in line]
        if ended and datetime.fromisoformat(ended[0].split()[0]).timestamp() < served_s:
            return ended[0].partition("command: ")[2]
        located = sum(len(places) for _, places in live_places(out))
    return "" if commands and located else f"{commands} commands, {located} located targets"


def fly_links(
    folder: Path, case: Case, faults: Sequence[str] = (), watch: Callable[[str], object] | None = None
) -> tuple[int, list[str]]:
    """Serve a world and run live over its links. Return the number of commands that were sent, and the events.

    watch: called ten times a second with the address of the live run's pages; the run then sends no commands.
    """
    pictures, vehicle = f"udp://127.0.0.1:{free_port()}", f"127.0.0.1:{free_port()}"
    scenario = load_scenario(case["scenario"], case["scene"], case["seed"])
    longitude, latitude = scenario.world.origin_deg
    fence, band = f"{longitude},{latitude},{scenario.world.side_m:g}", f"5,{4 * scenario.uav.altitude_m:g}"
    folder.mkdir()
    # The loop in process knows the terrain and the lens too.
    world = ["simulate", case["scenario"], "--seed", case["seed"], *repeat("--set", case["scene"])]
    site = folder / "site"
    run(*world, "--frames", 1, "--save", "none", "--quiet", "--out", site)
    serve = [*PROGRAM, *world, "--serve", pictures, "--serve-mavlink", f"udpout:{vehicle}", "--speed", case["speed"]]
    serve += ["--link", case["link"]] * bool(case["link"]) + repeat("--fault", faults)
    serve += ["--out", folder / "world", "--quiet"]
    live = [*PROGRAM, "run", pictures, "--live", "--wait", "--quiet", "--out", folder / "run"]
    live += ["--telemetry", "klv", "--dem", site / "dem.tif", "--camera", site / "camera.toml", *configure(case)]
    live += ["--set", "live.watchdog_s=0"]
    page = f"127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    if watch is None:
        live += ["--command", f"mavlink:udp:{vehicle}?system=1", f"--geofence={fence}", "--altitude-band", band]
        live += ["--allow-commands"]
    else:
        live += ["--serve", page, "--set", "live.deadline_ms=5000"]  # a busy machine is no fault of an instrument
    with subprocess.Popen(list(map(str, live))) as running:
        try:
            time.sleep(2.0)  # the world should not run ahead of its observer
            until_s = time.monotonic() + 5 * scenario.clip.seconds / case["speed"] + PATIENCE_S
            with subprocess.Popen(list(map(str, serve))) as serving:
                while serving.poll() is None and time.monotonic() < until_s:
                    time.sleep(POLL_S)
                    if watch is not None:
                        watch(f"http://{page}")
                serving.kill()
            time.sleep(3.0)
        finally:
            running.send_signal(signal.SIGTERM)
        if running.wait(PATIENCE_S) or serving.returncode:
            raise SystemExit(f"the live run ended with {running.returncode}, the world with {serving.returncode}")
    (session,) = (folder / "run").iterdir()
    events = (session / "events.log").read_text().splitlines()
    return int(json.loads((session / "run.json").read_text())["counts"].get("commands", 0)), events


def repeat(option: str, values: Sequence[str]) -> list[Any]:
    """Return an option with each of some values."""
    return [word for value in values for word in (option, value)]


def run(*words: object) -> None:
    """Run a command. Its exit code may say that nothing was located."""
    code = subprocess.run([*PROGRAM, *map(str, words)], env=os.environ).returncode
    if code not in (0, 3):
        raise SystemExit(f"dddas {' '.join(map(str, words))} ended with {code}")


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    """Return a free port, of UDP unless another kind is given."""
    with socket.socket(socket.AF_INET, kind) as free:
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
    options = {"--scenario": "leaving", "--config": "fast", "--seconds": 32.0, "--size": "320x240", "--altitude": 30.0}
    options |= {"--speed": 0.7, "--cache": None}
    conditions = ["", "latency=0.5", "latency=1", "latency=2", "loss=0.05", "loss=0.2", "wind=5"]
    loop = options | {"--seeds": 10, "--fewer": 4, "--conditions": conditions}
    faults = options | {"--speed": 1.0}
    repeated = options | {"--speed": 1.0, "--seconds": 14.0, "--runs": 200}
    studies = {"loop": (measure_loop, loop), "faults": (measure_faults, faults), "repeat": (measure_repeat, repeated)}
    bench.main(__doc__, studies)
