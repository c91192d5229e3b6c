"""How quick the simulator is: pictures from the air and from the ground, steps of a thousand people, a world.

    python eval/sim_speed.py [--rounds 12] [--out FILE] [--least]

Pictures from the air are of 640x480 and 1280x720, from 50 and 200 m, straight down and at 45 degrees: four ground
vehicles, two crowds of twelve, two cars, noise and compression as scenarios have them by default. A ground picture is
that of a vehicle at the edge of the crowds. A step is that of a frame at 10 frames/s, and what the world is then. All
take their turns, each turn a different frame; figures are medians over the turns of the time of one call, with the
lower and upper quartile, and the processor's time over all threads, as the clock's grows with the load of the machine.
A world is opened --worlds times before that: 400 m, with all that a run of it needs. No data are needed.

--least: ends with 1 where a goal is missed by the clock: 25 and 10 pictures a second from the air, 30 ms a ground
picture, 10 ms a step, 4 s a world.
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas.simulation import Scenario, Simulator, World
from torchvision_dddas.simulation.aerial_camera import AerialCamera
from torchvision_dddas.simulation.agents import Agents, Moment
from torchvision_dddas.simulation.ground_camera import GroundCamera

SIZES = ((640, 480), (1280, 720))
LOOKS = ((50.0, 90.0), (50.0, 45.0), (200.0, 90.0), (200.0, 45.0))
"""Altitudes in metres and pitches in degrees below the horizon."""
SIDE_M, PEOPLE, CROWDS, WARM_UP = 400.0, 1000, 20, 2
GOAL_S = {"640x480": 1 / 25, "1280x720": 1 / 10, "ground": 0.03, "agents": 0.01, "world": 4.0}


def scenario(size: tuple[int, int] = SIZES[0], altitude_m: float = 50.0, pitch_deg: float = 90.0) -> Scenario:
    """Two crowds, two cars and four ground vehicles about the middle of the picture."""
    return Scenario.model_validate(
        {
            "world": {"side_m": SIDE_M, "buildings": 2},
            "uav": {"altitude_m": altitude_m, "pitch_deg": pitch_deg},
            "camera": {"width_px": size[0], "height_px": size[1]},
            "crowd": tuple({"people": 12, "start_m": place} for place in ((-5.0, 2.0), (6.0, -3.0))),
            "car": tuple({"start_m": place} for place in ((-12.0, -9.0), (12.0, 10.0))),
        }
    )


def thousand() -> Scenario:
    """A thousand people in crowds of fifty, spread over the world."""
    places = np.random.default_rng(5).uniform(-0.4 * SIDE_M, 0.4 * SIDE_M, (CROWDS, 2)).tolist()
    crowds = tuple({"people": PEOPLE // CROWDS, "start_m": tuple(p), "behaviour": "random"} for p in places)
    return Scenario.model_validate({"world": {"side_m": SIDE_M}, "crowd": crowds})


def calls(world: World, turns: int) -> dict[str, Callable[[int], object]]:
    """What is timed, each a call that is told which turn it is."""
    found: dict[str, Callable[[int], object]] = {}

    def looking(camera: AerialCamera, moments: list[Moment]) -> Callable[[int], object]:
        return lambda turn: camera.take(moments[turn])

    for size in SIZES:
        for altitude, pitch in LOOKS:
            one = scenario(size, altitude, pitch)
            camera, moments = AerialCamera(world, one), filmed(one, world, turns)
            found[f"{size[0]}x{size[1]}, {altitude:g} m, {pitch:g} deg"] = looking(camera, moments)
    ground, seen = GroundCamera(world, scenario()), [turned(m) for m in filmed(scenario(), world, turns)]
    found["ground picture"] = lambda turn: ground.take(seen[turn], turn % 4)
    many = Agents(thousand(), world)
    found[f"agents, {PEOPLE} people"] = lambda turn: (many.step(), many.moment())
    return found


def filmed(one: Scenario, world: World, turns: int) -> list[Moment]:
    """Moments of a scenario, one after the other."""
    agents, moments = Agents(one, world), []
    for _ in range(turns):
        agents.step()
        moments.append(agents.moment())
    return moments


def turned(moment: Moment) -> Moment:
    """A moment at which all ground vehicles look at the people and are heard."""
    bodies = moment.bodies
    people = bodies.place_m[bodies.kind == "person", :2].mean(axis=0)
    away = people - bodies.place_m[bodies.kind == "ugv", :2]
    heading = np.arctan2(away[:, 0], away[:, 1])
    return replace(
        moment, heading_rad=heading, reported_heading_rad=heading, reported_lonlat_deg=np.zeros((len(away), 2))
    )


def measured(one: Callable[[], object]) -> tuple[float, float]:
    """Seconds of a call by the clock, and of the processor."""
    clock, processor = time.perf_counter(), time.process_time()
    one()
    return time.perf_counter() - clock, time.process_time() - processor


def figures(seconds: list[tuple[float, float]], goal_s: float) -> dict[str, float]:
    """Median and quartiles, ms, of the clock, and the processor's median; calls a second by the median of the clock."""
    clock, processor = 1e3 * np.array(seconds).T
    low, median, high = np.percentile(clock, (25, 50, 75)).tolist()
    return {
        "median_ms": median,
        "low_ms": low,
        "high_ms": high,
        "least_ms": float(clock.min()),
        "processor_ms": float(np.median(processor)),
        "per_s": 1e3 / median,
        "goal_ms": 1e3 * goal_s,
    }


def main() -> None:
    """Measure in turns, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=12, help="turns of each")
    parser.add_argument("--worlds", type=int, default=3, help="so often a world is opened")
    parser.add_argument("--out", type=Path, help="a JSON file for the figures")
    parser.add_argument("--least", action="store_true", help="fail where a goal is missed")
    options = parser.parse_args()
    opened = [measured(lambda: Simulator(scenario())) for _ in range(options.worlds)]
    found = {f"opening a world of {SIDE_M:g} m": figures(opened, GOAL_S["world"])}
    turns = WARM_UP + options.rounds
    seconds: dict[str, list[tuple[float, float]]] = {}
    for turn, rows in enumerate(in_turns(calls(Simulator(scenario()).world, turns), turns)):
        print(f"\rturn {turn + 1} of {turns}", end="", file=sys.stderr, flush=True)
        for name, row in rows.items():
            if turn >= WARM_UP:
                seconds.setdefault(name, []).append(row)
    print(file=sys.stderr)
    for name, rows in seconds.items():
        found[name] = figures(rows, GOAL_S[name.replace(",", " ").split()[0]])
    machine = f"{os.cpu_count()} cores, OpenCV {cv2.__version__}, NumPy {np.__version__}, {platform.machine()}"
    print(f"{machine}; load {os.getloadavg()[0]:.1f}\n")
    print("| what | median ms (quartiles) | least ms | processor ms | a second | goal ms |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for name, row in found.items():
        print(
            f"| {name} | {row['median_ms']:.1f} ({row['low_ms']:.1f}–{row['high_ms']:.1f}) | {row['least_ms']:.1f} | "
            f"{row['processor_ms']:.1f} | {row['per_s']:.1f} | {row['goal_ms']:.0f} |"
        )
    if options.out:
        load = os.getloadavg()[0]
        options.out.write_text(json.dumps({"machine": machine, "load": load, "figures": found}, indent=1) + "\n")
    missed = [name for name, row in found.items() if row["median_ms"] > row["goal_ms"]]
    if options.least and missed:
        sys.exit(f"slower than wanted: {'; '.join(missed)}")


def in_turns(ones: dict[str, Callable[[int], object]], turns: int) -> Iterator[dict[str, tuple[float, float]]]:
    """The times of all calls, turn by turn."""
    for turn in range(turns):
        yield {name: measured(lambda c=call, t=turn: c(t)) for name, call in ones.items()}


if __name__ == "__main__":
    main()
