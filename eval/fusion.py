"""Measure the gain by fusion over time, for a UAV with two ground vehicles and for two UAVs. Needs no data.

python eval/fusion.py vehicles   errors of single platforms and of all together, with a biased receiver, delays, losses
python eval/fusion.py uavs       identities that two UAVs share, and those that targets keep from one view to the other

People of a simulated scenario walk on level ground. Their true places become noisy boxes in the pictures of a UAV (50 m
high, looking down) and of two ground vehicles. These stand 14 m from the middle and look at the place with most people.
All other inputs are the vehicles' reports with the simulator's errors: receivers with 3.5 m in 95 % and a time constant
of 60 s, UAV tilt 1 degree, UAV heading 3 degrees, vehicles' headings 2 degrees. Boxes have errors of 1 px from the air,
and of 3 % and 5 % of the body's height from the ground. AerialLocator and GroundLocator turn boxes into records, which
TargetFusion fuses. Only the UAV gives identities. No picture is drawn, and people do not hide each other.

The two UAVs hover 16 m west and 16 m east of the middle. One looks down from 50 m. The other looks from 60 m with a
pitch of 65 degrees and a random heading. Both have the errors above. The views overlap partly. 5 % of boxes are missed,
and a person who was out of a view for 0.5 s returns with a new number. handed over: people whom a UAV has not seen for
a second while the other UAV sees them, and who keep the identity that the first UAV gave them.
"""

import math
from dataclasses import replace
from typing import Any

import bench
import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, load_config
from torchvision_dddas.geo import AerialLocator, GroundLocator, TargetFusion, Targets
from torchvision_dddas.lab.simulation import load_scenario, open_simulator
from torchvision_dddas.lab.simulation.uav import ReportedPose, rotation_matrix
from torchvision_dddas.types import Camera, CameraPose, Command, FusedTargets, Order, People, Telemetry

SECONDS, SETTLE_S, AIR_EVERY, GROUND_EVERY = 30.0, 10.0, 2, 5
SCENE = (
    *("world.relief_m=0", "team.ugvs=2", "team.patrol='stand'", "gps.error95_m=3.5", f"clip.seconds={SECONDS}"),
    *("uav.altitude_m=50", "world.buildings=0", "clip.located_by='telemetry'"),
)
SCENARIOS = "crossing", "joining", "splitting"
BOX_PX, AIR_PX, FEET, TALL, LEAST_PX = 12.0, 1.0, 0.03, 0.05, 48.0
CASES: dict[str, dict[str, Any]] = {
    "all": {},
    "all, ugv2 off by 5 m": {"jump_m": 5.0},
    "all, delays to 2 s": {"delay_s": 2.0},
    "all, 20 % lost": {"loss": 0.2},
}
Way = dict[tuple[float, int], np.ndarray]


def measure(options: bench.Options) -> tuple[str, Any]:
    """Measure errors, coverage and consistency by platform and case."""
    seeds = range(1, options.seeds + 1)
    results = bench.run_cases([{"seed": seed} for seed in seeds], fly, options.jobs, options.cache)
    rows = []
    for name in results[0]:
        of = [result[name] for result in results]
        cells = [bench.Spread([one[key] for one in of]).text(2, spread=key == "rms_m") for key in KEYS]
        rows.append([name, *cells])
    best = [min(result[name]["rms_m"] for name in ALONE) for result in results]
    share = bench.Spread([r["all"]["rms_m"] / one for r, one in zip(results, best, strict=True)]).text(2)
    pooled = np.sqrt(np.mean([r["all"]["rms_m"] ** 2 for r in results]))
    alone = min(np.sqrt(np.mean([r[name]["rms_m"] ** 2 for r in results])) for name in ALONE)
    lines = [f"all / better platform alone (filtered), by seed: {share}; of all seeds together {pooled / alone:.2f}"]
    for name in list(CASES)[1:]:
        more = np.sqrt(np.mean([r[name]["rms_m"] ** 2 for r in results])) / pooled
        lines.append(f"{name}: error x {more:.3f}")
    head = ["platforms", "RMS m, mean (range)", "median m", "68 %", "95 %", "NEES", "speed 68 %", "speed 95 %", "seen"]
    return "\n".join([bench.format_table(head, rows), "", *lines]), results


KEYS = ("rms_m", "median_m", "in68", "in95", "nees", "speed68", "speed95", "seen")
ALONE = ("UAV alone", "ugv1 alone", "ugv2 alone")


def fly(case: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a seed."""
    settings = load_config(None, ())
    air, ground, truth = record(case["seed"], settings)
    figures = {"UAV, frame by frame": score(_single_frames(air), truth)}
    for name, kept in zip(ALONE, ("uav", "ugv1", "ugv2"), strict=True):
        figures[name] = score(fuse(settings, air, ground, case["seed"], {kept}, known=True)[0], truth)
    for name, options in CASES.items():
        own = (air, ground)
        if "jump_m" in options:
            own = record(case["seed"], settings, options["jump_m"])[:2]
        final, now = fuse(settings, *own, case["seed"], {"uav", "ugv1", "ugv2"}, **_links(options))
        figures[name] = score(final, truth)
        if "delay_s" in options or not options:
            figures[f"{name}, at once"] = score(now, truth)
    return figures


def _links(options: dict[str, Any]) -> dict[str, float]:
    return {name: options[name] for name in ("delay_s", "loss") if name in options}


def record(seed: int, settings: Settings, jump_m: float = 0.0) -> tuple[list, list, Way]:
    """Return records from air and ground, as (time, platform, locations), and the true places and velocities.

    The truth is in the local metres of the UAV's records.
    """
    fault = (f"fault=[{{what='gps_jump',vehicle=2,time_s=0,seconds={2 * SECONDS},size={jump_m}}}]",) if jump_m else ()
    scenario = load_scenario(SCENARIOS[seed % len(SCENARIOS)], (*SCENE, *fault), seed)
    simulator, origin = open_simulator(scenario), scenario.world.origin_deg
    agents, rate = simulator._agents, scenario.clip.rate_hz
    rng, moments = np.random.default_rng([seed, 1]), []
    for _ in range(round(SECONDS * rate)):
        moment = agents.moment()
        moments.append(moment)
        ugvs = moment.bodies.place_m[moment.bodies.kind == "ugv", :2]
        stay = geometry.lonlat(ugvs, origin)
        middle = moment.bodies.place_m[moment.bodies.kind == "person", :2].mean(axis=0)
        middle = geometry.lonlat(middle[None], origin)[0]
        agents.steer(
            Command(orders=tuple(Order(n, p, 1.0, middle) for n, p in zip(simulator.names, stay, strict=True)))
        )
        agents.step()
    names = ("altitude_m", "speed_m_s", "above_sea_m", "heading_rad", "pitch_rad", "roll_rad", "hfov_rad")
    columns = {name: np.array([getattr(m.flight, name) for m in moments]) for name in names}
    lonlat = np.array([m.flight.place for m in moments])
    times = np.array([m.time_s for m in moments])
    telemetry = Telemetry(time_s=times, place=lonlat, geographic=True, origin="simulated", **columns)
    locator = AerialLocator(simulator.camera, telemetry, settings=settings, rate_hz=rate, backend="onboard")
    shift = geometry.east_north(np.array([origin]), locator.site.origin_deg)[0]
    air, ground, truth = [], [], {}
    for moment in moments:
        bodies = moment.bodies
        own = bodies.kind == "person"
        feet, number = bodies.place_m[own], bodies.number[own]
        for n, at, speed in zip(number.tolist(), feet[:, :2] + shift, bodies.velocity_m_s[own], strict=True):
            truth[round(moment.time_s, 3), n] = np.r_[at, speed]
        if (moment.number - 1) % AIR_EVERY == 0:
            pixel = geometry.project(feet, moment.pose, simulator.camera) + rng.normal(0, AIR_PX, (len(feet), 2))
            seen = ((pixel > 0) & (pixel < np.array(simulator.camera.size_px) - 1)).all(axis=1)
            box = np.c_[pixel[seen] - (BOX_PX - 1) / 2, np.full((seen.sum(), 2), BOX_PX)]
            targets = Targets(box, number[seen].astype(np.int64), np.ones(seen.sum(), bool), np.ones(seen.sum()))
            fixed = locator.fix_frame(moment.number, locator.landmarks_at(moment.number), time_s=moment.time_s)
            air.append((moment.time_s, "uav", locator.locate_targets(fixed, targets)))
        if (moment.number - 1) % GROUND_EVERY == 0:
            for k, name in enumerate(simulator.names):
                ground.append(
                    (moment.time_s, name, look(simulator, moment, k, feet, bodies.height_m[own], number, rng))
                )
    located = []
    for time_s, name, (camera, people, numbers) in ground:
        one = GroundLocator(camera, settings=settings).locate(people)
        located.append((time_s, name, replace(one, target=numbers.astype(np.int64))))
    return air, located, truth


def look(simulator: Any, moment: Any, k: int, feet: np.ndarray, tall: np.ndarray, number: np.ndarray, rng: Any) -> Any:
    """Return a vehicle's camera with its reported pose, the people in its picture, and their numbers."""
    view, ground = simulator._ground._view(moment, k), simulator._ground
    width, height = ground._size_px
    foot, head = view.homogeneous(feet), view.homogeneous(feet + np.c_[np.zeros((len(feet), 2)), tall])
    low, high = foot[:, :2] / foot[:, 2:], head[:, :2] / head[:, 2:]
    size = low[:, 1] - high[:, 1]
    lower = low[:, 1] + rng.normal(0, FEET, len(feet)) * size
    measured = size * (1 + rng.normal(0, TALL, len(feet)))
    middle = low[:, 0] + rng.normal(0, FEET, len(feet)) * size
    box = np.c_[middle - 0.2 * measured + 0.5, lower - measured + 0.5, 0.4 * measured, measured]
    seen = (foot[:, 2] > 0.5) & (box[:, :2] > 2).all(axis=1) & (box[:, 3] > LEAST_PX)
    seen &= (box[:, 0] + box[:, 2] < width - 2) & (box[:, 1] + box[:, 3] < height - 2)
    (longitude, latitude), team = moment.reported_lonlat_deg[k].tolist(), simulator.scenario.team
    camera = Camera(
        simulator.names[k], (width, height), (ground.focal_px,) * 2, ground._centre_px, (longitude, latitude), True,
        float(moment.reported_heading_rad[k]), height_m=team.camera_m, heading_sigma_rad=math.radians(2.0),
        position_sigma_m=simulator.scenario.gps.error95_m / 2.4477,
    )  # fmt: skip
    ones = np.ones(seen.sum())
    return camera, People(box[seen], ones, ones, np.zeros(seen.sum(), bool), box[seen]), number[seen]


def fuse(
    settings: Settings,
    air: list,
    ground: list,
    seed: int,
    platforms: set[str],
    known: bool = False,
    delay_s: float = 0.0,
    loss: float = 0.0,
) -> tuple[list, list]:
    """Return final and immediate results at each aerial frame: (time, number of the person or 0, state, covariance).

    known: ground vehicles know the identities of people.
    """
    rng = np.random.default_rng([seed, 2])
    fusion = TargetFusion(settings, delay_s=2.0 if delay_s else 0.0)
    arriving = [(time_s, time_s, name, one) for time_s, name, one in air if name in platforms]
    for time_s, name, one in ground:
        late = rng.uniform(0, delay_s) if delay_s else 0.0
        if name in platforms and rng.uniform() >= loss:
            arriving.append((time_s + late, time_s, name, one))
    final, now, origin = [], [], air[0][2].positions.origin_deg
    who = "uav" if "uav" in platforms else next(iter(platforms))
    for _, time_s, name, one in sorted(arriving, key=lambda entry: (entry[0], entry[2] != "uav")):
        for fused in fusion.update(one, name, time_s=time_s, lasting=known or name == "uav"):
            final += _rows(fused, who, origin)
        if name == who and (latest := fusion.now()) is not None:
            now += _rows(latest, who, origin)
    for fused in fusion.flush():
        final += _rows(fused, who, origin)
    return final, now


def _rows(fused: FusedTargets, who: str, origin: tuple[float, float]) -> list:
    if fused.by != who:
        return []
    places = geometry.east_north(geometry.lonlat(fused.state[:, :2], fused.origin_deg), origin)
    return [
        (fused.time_s, seen.get(who, 0), np.r_[place, speed], covariance)
        for place, speed, covariance, seen in zip(
            places, fused.state[:, 2:], fused.covariance, fused.seen_by, strict=True
        )
    ]


def _single_frames(air: list) -> list:
    rows = []
    for time_s, _, one in air:
        for k, number in enumerate(one.positions.target.tolist()):
            covariance = np.full((4, 4), np.nan)
            covariance[:2, :2] = one.positions.covariance_m2[k]
            rows.append((time_s, number, np.r_[one.positions.east_north_m[k], one.velocity_m_s[k]], covariance))
    return rows


def score(rows: list, truth: Way) -> dict[str, float]:
    """Return errors in metres, ellipse coverage, NEES of four states, shares of speeds within 1 and 1.96 sigma."""
    apart, inside, nees, speed = [], [], [], []
    for time_s, number, state, spread in rows:
        true = truth.get((round(time_s, 3), number))
        if true is None or time_s < SETTLE_S:
            continue
        error = state - true
        apart.append(math.hypot(*error[:2]))
        inside.append(error[:2] @ np.linalg.solve(spread[:2, :2], error[:2]))
        if np.isfinite(spread).all():
            nees.append(error @ np.linalg.solve(spread, error))
            fast = math.hypot(*state[2:])
            along = state[2:] / max(fast, 1e-9)
            speed.append((fast - math.hypot(*true[2:])) / math.sqrt(along @ spread[2:, 2:] @ along))
    limits = -2 * np.log(1 - np.array([0.68, 0.95]))
    found = np.array(inside)
    return {
        "rms_m": float(np.sqrt(np.mean(np.square(apart)))),
        "median_m": float(np.median(apart)),
        "in68": float((found < limits[0]).mean()),
        "in95": float((found < limits[1]).mean()),
        "nees": float(np.mean(nees)) if nees else math.nan,
        "speed68": float((np.abs(speed) < 1).mean()) if speed else math.nan,
        "speed95": float((np.abs(speed) < 1.96).mean()) if speed else math.nan,
        "seen": len(apart),
    }


# -- two UAVs --------------------------------------------------------------------------------------------------------

WEST_EAST_M, OTHER_HEIGHT_M, OTHER_PITCH_DEG, MISSED, AWAY_S = 16.0, 60.0, 65.0, 0.05, 0.5
UAVS = "uav", "uav2"


def measure_uavs(options: bench.Options) -> tuple[str, Any]:
    """Measure hand-overs and shared identities by scenario."""
    results = bench.run_cases(
        [{"seed": seed} for seed in range(1, options.seeds + 1)], hover, options.jobs, options.cache
    )
    rows = []
    for k, name in [*enumerate(SCENARIOS), (None, "all")]:
        of = [one for seed, one in enumerate(results, 1) if k in (None, seed % len(SCENARIOS))]
        total = {key: sum(one[key] for one in of) for key in of[0]}
        whole = sum(one["kept"] == one["left"] for one in of)
        rows.append([
            name, f"{total['kept']} of {total['left']}", f"{whole} of {len(of)}",
            f"{total['right'] / max(total['told'], 1):.3f}", f"{total['right'] / total['both']:.3f}",
            f"{total['identities'] / total['people']:.2f}",
        ])  # fmt: skip
    head = ["scenario", "handed over", "seeds without loss", "precision", "recall", "identities a person"]
    lost = {seed: one["left"] - one["kept"] for seed, one in enumerate(results, 1) if one["kept"] < one["left"]}
    return "\n".join([bench.format_table(head, rows), "", f"lost by seed: {lost}"]), results


def hover(case: dict[str, Any]) -> dict[str, int]:
    """Return counts about the identities of a seed."""
    settings, fusion = load_config(None, ()), TargetFusion(delay_s=0.0)
    records, who = record_uavs(case["seed"], settings)
    counts = dict.fromkeys(("kept", "left", "told", "both", "right"), 0)
    names: dict[int, set[int]] = {}  # the identities of each person
    last: dict[tuple[str, int], float] = {}  # time at which a UAV last saw a person
    leaving: dict[tuple[str, int], int] = {}  # identity from a UAV while both saw the person
    for time_s, name, located in records:
        fused = fusion.update(located, name, time_s=time_s)[-1]
        last |= {(name, who[name][n]): time_s for n in located.positions.target.tolist()}
        now: dict[tuple[str, int], int] = {}
        for target, seen in zip(fused.target.tolist(), fused.seen_by, strict=True):
            people = {platform: who[platform][n] for platform, n in seen.items()}
            now |= dict.fromkeys(people.items(), target)
            counts["told"] += len(people) == 2
            counts["right"] += len(people) == 2 and len(set(people.values())) == 1
        for (_, person), target in now.items():
            names.setdefault(person, set()).add(target)
        recent = {n: {p for (platform, p), t in last.items() if platform == n and time_s - t < 1.0} for n in UAVS}
        both = recent["uav"] & recent["uav2"]
        counts["both"] += len(both)
        for n, other in (UAVS, UAVS[::-1]):
            leaving |= {(n, person): now.get((n, person), 0) for person in both}
            for person in recent[other] - recent[n]:
                if (n, person) in leaving:
                    counts["left"] += 1
                    counts["kept"] += now.get((other, person), -1) == leaving.pop((n, person))
    return counts | {"identities": sum(map(len, names.values())), "people": len(names)}


def record_uavs(seed: int, settings: Settings) -> tuple[list, dict[str, dict[int, int]]]:
    """Return the records of both UAVs in order, and the person behind each of their numbers."""
    scenario = load_scenario(SCENARIOS[seed % len(SCENARIOS)], (*SCENE, "clip.seconds=45"), seed)
    simulator, rate, origin = open_simulator(scenario), scenario.clip.rate_hz, scenario.world.origin_deg
    agents, rng, moments = simulator._agents, np.random.default_rng([seed, 3]), []
    for _ in range(round(scenario.clip.seconds * rate)):
        moments.append(agents.moment())
        agents.step()
    turn = rotation_matrix(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    records, who = [], {}
    for k, name in enumerate(UAVS):
        reported, poses, flights = ReportedPose(scenario.uav, 1000 * seed + k), [], []
        for moment in moments:
            errors = reported.errors(1 / rate)
            pose = moment.pose if k == 0 else tilted(moment.pose, turn)
            pose = replace(pose, place_m=pose.place_m + np.array([WEST_EAST_M * (2 * k - 1), 0.0, 0.0]))
            angles = CameraPose(pose.place_m, rotation_matrix(errors[:3]) @ pose.axes).angles_rad
            place = geometry.lonlat(pose.place_m[None, :2] + errors[4:], origin)[0]
            poses.append(pose)
            flights.append((pose.place_m[2] * (1 + errors[3]), *angles, *place))
        columns = np.array(flights).T
        flight = dict(zip(("altitude_m", "heading_rad", "pitch_rad", "roll_rad"), columns, strict=False))
        telemetry = Telemetry(
            time_s=np.array([m.time_s for m in moments]), place=columns[4:].T, geographic=True, origin="simulated",
            hfov_rad=np.full(len(moments), math.radians(scenario.camera.hfov_deg)), speed_m_s=np.zeros(len(moments)),
            above_sea_m=columns[0] + scenario.world.above_sea_m, **flight,
        )  # fmt: skip
        locator = AerialLocator(simulator.camera, telemetry, settings=settings, rate_hz=rate, backend="onboard")
        numbers, seen_s, who[name] = {}, {}, {}
        for moment, pose in list(zip(moments, poses, strict=True))[k::AIR_EVERY]:
            own = moment.bodies.kind == "person"
            feet, person = moment.bodies.place_m[own], moment.bodies.number[own]
            pixel = geometry.project(feet, pose, simulator.camera) + rng.normal(0, AIR_PX, (len(feet), 2))
            seen = ((pixel > 0) & (pixel < np.array(simulator.camera.size_px) - 1)).all(axis=1)
            seen &= rng.uniform(size=len(seen)) >= MISSED
            for one in person[seen].tolist():
                if moment.time_s - seen_s.get(one, -math.inf) > AWAY_S:
                    numbers[one] = len(who[name]) + 1
                    who[name][numbers[one]] = one
                seen_s[one] = moment.time_s
            box = np.c_[pixel[seen] - (BOX_PX - 1) / 2, np.full((seen.sum(), 2), BOX_PX)]
            number = np.array([numbers[one] for one in person[seen].tolist()], np.int64)
            targets = Targets(box, number, np.ones(seen.sum(), bool), np.ones(seen.sum()))
            fixed = locator.fix_frame(moment.number, locator.landmarks_at(moment.number), time_s=moment.time_s)
            records.append((moment.time_s, name, locator.locate_targets(fixed, targets)))
    return sorted(records, key=lambda entry: entry[:2]), who


def tilted(pose: CameraPose, turn: np.ndarray) -> CameraPose:
    """Return the pose of the other UAV, which looks at the same point with the same shaking."""
    axes = turn @ pose.axes
    axes = rotation_matrix(axes[:, 0] * math.radians(90 - OTHER_PITCH_DEG)) @ axes
    middle = np.r_[pose.place_m[:2], 0.0]
    return CameraPose(middle - axes[:, 2] * OTHER_HEIGHT_M / abs(axes[2, 2]), axes)


if __name__ == "__main__":
    options = {"--seeds": 6, "--jobs": 1, "--cache": None}
    bench.main(__doc__, {"vehicles": (measure, options), "uavs": (measure_uavs, options | {"--seeds": 20})})
