"""Plain ground, straight walkers and a steady camera, until each of them is there in full."""

import cv2
import numpy as np

from torchvision_dddas.simulation.camera import axes, view_of
from torchvision_dddas.simulation.moment import Moment, Report
from torchvision_dddas.simulation.scenario import Scenario, WorldKnobs
from torchvision_dddas.targets import geodesy
from torchvision_dddas.types import (
    Bodies,
    Camera,
    CameraPose,
    Colours,
    Command,
    Elevation,
    Flight,
    GroundPicture,
    Ortho,
)

HUES = (0, 60, 120, 150, 30, 90, 15, 45, 75, 105, 135, 165)


class World:
    def __init__(self, knobs: WorldKnobs, seed: int) -> None:
        self.side_m, self.texel_m = knobs.side_m, max(knobs.texel_m, 0.2)
        size = round(self.side_m / self.texel_m)
        rng = np.random.default_rng([seed, 0])
        noise = sum(
            cv2.resize(rng.normal(0, s, (size // k, size // k)).astype(np.float32), (size, size), interpolation=2)
            for k, s in ((1, 8.0), (4, 12.0), (20, 10.0))
        )
        self.albedo = np.clip(noise[..., None] + (110, 140, 160), 0, 255).astype(np.uint8)
        self.relief = Elevation(np.zeros((3, 3)), (-self.side_m / 2,) * 2, self.side_m / 2)

    def up_m(self, east_north: np.ndarray) -> np.ndarray:
        return np.zeros(len(east_north))


def build(knobs: WorldKnobs, seed: int, elevation: Elevation | None = None, photo: Ortho | None = None) -> World:
    return World(knobs, seed)


def plates(count: int) -> tuple[tuple[str, ...], np.ndarray, Colours]:
    hues = np.array(HUES[:count], int)
    hsv = np.stack([hues, np.full(count, 230), np.full(count, 230)], axis=1).astype(np.uint8)
    bgr = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2BGR)[0].astype(float) if count else np.zeros((0, 3))
    low = np.stack([(hues - 6) % 180, np.full(count, 140), np.full(count, 100)], axis=1).astype(np.int64)
    high = np.stack([hues + 6, np.full(count, 255), np.full(count, 255)], axis=1).astype(np.int64)
    names = tuple(f"ugv{k + 1}" for k in range(count))
    return names, bgr, Colours(names, low, high)


class Agents:
    def __init__(self, scenario: Scenario, world: World) -> None:
        self.scenario, self.world = scenario, world
        rng = np.random.default_rng([scenario.seed, 1])
        rows = []
        target = 0
        for crowd in scenario.crowd:
            target += 1
            heading = np.radians(crowd.heading_deg)
            velocity = crowd.speed_m_s * np.array([np.sin(heading), np.cos(heading)]) * (crowd.behaviour != "stand")
            for _ in range(crowd.people):
                rows.append(
                    ("person", target, np.array(crowd.start_m) + rng.normal(0, crowd.radius_m / 2, 2), velocity)
                )
        for car in scenario.car:
            target += 1
            heading = np.radians(car.heading_deg)
            velocity = car.speed_m_s * np.array([np.sin(heading), np.cos(heading)])
            rows.append(("car", target, np.array(car.start_m), velocity))
        team = scenario.team
        self.names, self.plate, self.colours = plates(team.ugvs)
        for k in range(team.ugvs):
            target += 1
            turn = 2 * np.pi * (k + 0.5) / team.ugvs
            place = np.array(team.middle_m) + team.ring_m * np.array([np.sin(turn), np.cos(turn)])
            rows.append(("ugv", target, place, np.zeros(2)))
        self.kind = np.array([r[0] for r in rows])
        self.target = np.array([r[1] for r in rows], np.int64)
        self.place = np.array([r[2] for r in rows]).reshape(-1, 2)
        self.velocity = np.array([r[3] for r in rows]).reshape(-1, 2)
        self.colour = rng.uniform(20, 230, (len(rows), 3))
        self.number = 1
        self.goals: dict[int, np.ndarray] = {}

    def steer(self, command: Command) -> None:
        for order in command.orders:
            k = self.names.index(order.vehicle)
            self.goals[k] = geodesy.east_north(order.goal[None], self.scenario.world.origin_deg)[0]

    def step(self, every: int = 1) -> None:
        dt = every / self.scenario.clip.rate_hz
        ugvs = np.flatnonzero(self.kind == "ugv")
        for k, goal in self.goals.items():
            way = goal - self.place[ugvs[k]]
            self.velocity[ugvs[k]] = way / max(float(np.hypot(*way)), 1.0)
        self.place = self.place + self.velocity * dt
        self.number += every

    def moment(self) -> Moment:
        s = self.scenario
        n = len(self.kind)
        time_s = (self.number - 1) / s.clip.rate_hz
        ugv = self.kind == "ugv"
        plate = np.full((n, 3), np.nan)
        plate[ugv] = self.plate
        facing = np.arctan2(self.velocity[:, 0], self.velocity[:, 1])
        bodies = Bodies(
            np.arange(1, n + 1), self.kind, self.target, np.c_[self.place, np.zeros(n)], self.velocity, facing,
            np.full(n, 1.75), np.full(n, time_s), self.colour, plate, np.zeros(n, bool),
        )  # fmt: skip
        rng = np.random.default_rng([s.seed, 2, self.number])
        angles = np.radians([s.uav.heading_deg, s.uav.pitch_deg, 0]) + np.radians(s.uav.shake_deg) * rng.normal(size=3)
        back = s.uav.altitude_m / np.tan(np.radians(s.uav.pitch_deg)) if s.uav.pitch_deg < 90 else 0.0
        heading = np.radians(s.uav.heading_deg)
        middle = np.array(s.uav.start_m) - back * np.array([np.sin(heading), np.cos(heading)])
        pose = CameraPose(np.append(middle + rng.normal(0, 0.1, 2), s.uav.altitude_m), axes(*angles))
        lonlat = geodesy.lonlat(np.r_[self.place[ugv], middle[None]], s.world.origin_deg)
        flight = Flight(
            s.uav.altitude_m, 0.0, tuple(lonlat[-1]), s.world.above_sea_m + s.uav.altitude_m,
            heading, np.radians(s.uav.pitch_deg), 0.0, np.radians(s.camera.hfov_deg), heading,
        )  # fmt: skip
        reports = tuple(Report(k, float(self.number), place, 0.05) for k, place in enumerate(lonlat[:-1]))
        return Moment(
            self.number, time_s, bodies, pose, np.zeros(3), np.zeros(3), flight, reports,
            facing[ugv], lonlat[:-1], facing[ugv],
        )  # fmt: skip


class AerialCamera:
    def __init__(self, world: World, scenario: Scenario) -> None:
        knobs = scenario.camera
        self.world, self.scenario = world, scenario
        focal = knobs.width_px / 2 / np.tan(np.radians(knobs.hfov_deg / 2))
        size = knobs.width_px, knobs.height_px
        self.camera = Camera("uav", size, (focal, focal), ((size[0] - 1) / 2, (size[1] - 1) / 2))

    def take(self, moment: Moment) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        view = view_of(moment.pose, self.camera)
        size, t, side = self.camera.size_px, self.world.texel_m, self.world.side_m
        ground_from_texel = np.array([[t, 0, -side / 2 + t / 2], [0, -t, side / 2 - t / 2], [0, 0, 1]])
        warp = view.image_from_ground @ ground_from_texel
        image = cv2.warpPerspective(self.world.albedo, warp, size, flags=1, borderMode=cv2.BORDER_REFLECT)
        mask, people = (np.zeros(size[::-1], np.uint16) for _ in range(2))
        bodies = moment.bodies
        for k in range(len(bodies)):
            place = bodies.place_m[k]
            u, v = view.project(place[None])[0]
            if not (-50 < u < size[0] + 50 and -50 < v < size[1] + 50):
                continue
            radius = {"person": 0.3, "car": 1.5, "ugv": 0.6}[str(bodies.kind[k])] * view.pixels_per_metre(place)
            centre, radius = (round(u), round(v)), max(1, round(radius))
            colour = bodies.plate[k] if bodies.kind[k] == "ugv" else bodies.colour[k]
            cv2.circle(image, centre, radius, colour.tolist(), -1, cv2.LINE_AA)
            cv2.circle(mask, centre, radius, int(bodies.target[k]), -1)
            cv2.circle(people, centre, radius, int(bodies.number[k]), -1)
        rng = np.random.default_rng([self.scenario.seed, 3, moment.number])
        image = np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
        return image, mask, people


class GroundCamera:
    def __init__(self, world: World, scenario: Scenario) -> None:
        self.scenario = scenario

    def take(self, moment: Moment, vehicle: int) -> GroundPicture:
        team = self.scenario.team
        size = team.width_px, team.height_px
        focal = size[0] / 2 / np.tan(np.radians(team.hfov_deg / 2))
        camera = Camera(
            f"ugv{vehicle + 1}", size, (focal, focal), ((size[0] - 1) / 2, (size[1] - 1) / 2),
            tuple(moment.said_lonlat_deg[vehicle]), True, float(moment.said_heading_rad[vehicle]), height_m=team.camera_m,
        )  # fmt: skip
        image = np.full((*size[::-1], 3), 150, np.uint8)
        return GroundPicture(camera.name, moment.number, image, camera)
