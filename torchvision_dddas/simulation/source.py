"""A simulated run as a clip that can be steered, with all that its vehicles say and the truth beside it."""

import math
from collections import deque
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple
from pathlib import Path

import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.elevation import read_elevation, read_ortho
from torchvision_dddas.simulation.agents import Moment
from torchvision_dddas.simulation.scenario import Scenario
from torchvision_dddas.simulation.scenario_file import load_scenario
from torchvision_dddas.simulation.simulator import Simulator
from torchvision_dddas.simulation.vehicle_shapes import UGV_HEIGHT_M
from torchvision_dddas.types import (
    Camera,
    Colours,
    Command,
    Elevation,
    Frame,
    GroundPicture,
    Landmarks,
    Problem,
    Telemetry,
    Truth,
    is_sampled,
)

KEPT = 100  # pictures and truths kept until they are fetched: a megabyte each


class SimulatorSource:
    """A scenario as a Source, its frames rendered on demand.

    Beside what every source offers: scenario; camera, the aerial one; colours of the landmarks; elevation, of the
    ground about origin_deg; steer; and what is there of the run until now: landmarks, telemetry, pictures, truths.
    Every iteration starts the run again. Frames that a command leaves out are not drawn; those that the camera
    drops are missing numbers.
    """

    exact = True

    def __init__(self, scenario: Scenario, name: str = "simulation") -> None:
        """Raises InputError where the scenario cannot be, or a raster that it names cannot be read."""
        self.scenario, self.name = scenario, name
        self._simulator = simulator = open_simulator(scenario)
        self.camera: Camera = simulator.camera
        self.colours: Colours = simulator.colours
        self.elevation: Elevation = simulator.world.relief
        self.origin_deg = scenario.world.origin_deg
        self.plate_m = UGV_HEIGHT_M
        world = scenario.world
        self.sun_rad: tuple[float, float] | None = (
            math.radians(world.sun_azimuth_deg),
            math.radians(world.sun_height_deg),
        )
        self.names: tuple[str, ...] = simulator.names
        self.count: int | None = simulator.frames
        self.rate_hz = scenario.clip.rate_hz
        self.size = simulator.camera.size_px
        self.problems: list[Problem] = []
        self._wanted: list[str] = []
        self._pictures: deque[GroundPicture] = deque(maxlen=KEPT)
        self._truths: deque[Truth] = deque(maxlen=KEPT)
        self._restart()

    def __iter__(self) -> Iterator[Frame]:
        self._restart()
        while (shot := self._simulator.next()) is not None:
            self.last = shot.truth.frame
            for moment in shot.said:
                self._heard(moment)
            self._truths.append(shot.truth)
            # Vehicles look when the picture from the air is taken, dropped or not: each order is for one look.
            for name in self._wanted:
                if (seen := self._simulator.picture(name)) is not None:
                    self._pictures.append(seen)
            self._wanted.clear()
            if shot.frame is None:
                self.problems.append(Problem(self.last, f"frame {self.last} was dropped by the camera"))
                continue
            yield shot.frame

    def every(self, interval: int) -> Iterator[Frame]:
        """Frames 1, 1 + interval, ...: the others are drawn as well, so that what was seen stays the same."""
        return (frame for frame in self if is_sampled(frame.number, interval))

    def steer(self, command: Command) -> None:
        """Carry out a command from the next frame on; places in longitude and latitude. Raises as `Simulator.steer`."""
        self._simulator.steer(command)
        # A later command before the next frame takes no request for a picture back.
        asked = [order.vehicle for order in command.orders if order.picture]
        self._wanted += [name for name in asked if name not in self._wanted]

    def landmarks(self) -> Landmarks:
        """All reports of the ground vehicles until now, in longitude and latitude; of plans for a frame the newest."""
        rows = self._reports.rows
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        count = len(rows)
        return Landmarks(
            self.names,
            rows[:, 0],
            rows[:, 1].astype(np.int64),
            np.full((count, 2), np.nan),
            rows[:, 2:4],
            rows[:, 4],
            rows[:, 5] == 1,
            np.arange(2, count + 2),
            True,
            self.name,
        )

    def telemetry(self) -> Telemetry:
        """All that the UAV said of itself until now, in longitude and latitude."""
        rows = self._flown.rows
        above_sea, heading, pitch, roll, hfov, vehicle_heading = rows[:, 5:].T
        return Telemetry(
            rows[:, 0],
            rows[:, 1],
            rows[:, 2],
            rows[:, 3:5],
            True,
            above_sea,
            heading,
            pitch,
            roll,
            hfov,
            vehicle_heading,
            origin=self.name,
        )

    def pictures(self) -> list[GroundPicture]:
        """What ground vehicles saw since this was last asked; the last KEPT at most."""
        seen = list(self._pictures)
        self._pictures.clear()
        return seen

    def truths(self) -> list[Truth]:
        """What is true of the frames since this was last asked, dropped ones among them; the last KEPT at most."""
        true = list(self._truths)
        self._truths.clear()
        return true

    def picture(self, vehicle: str) -> GroundPicture | None:
        """What a ground vehicle sees at the frame yielded last; None while nothing is heard of it."""
        return self._simulator.picture(vehicle)

    def _restart(self) -> None:
        self._simulator.restart()
        self.problems.clear()
        self.last = 0
        self._reports, self._flown = Rows(6), Rows(11)
        self._pictures.clear()
        self._truths.clear()
        self._wanted.clear()

    def _heard(self, moment: Moment) -> None:
        for r in moment.reports:
            row = (r.frame, r.vehicle, *np.asarray(r.lonlat_deg).tolist(), r.sigma_m, r.planned)
            self._reports.add(row, (r.vehicle, round(r.frame, 6), r.planned))
        if moment.flight is not None:
            self._flown.add(np.hstack([moment.time_s, *astuple(moment.flight)]).tolist())


class Rows:
    """A table that grows: (N, columns) float64, in the order in which its rows came."""

    def __init__(self, columns: int) -> None:
        self._table, self._count = np.zeros((256, columns)), 0
        self._place: dict[Hashable, int] = {}

    def add(self, row: Sequence[float], key: Hashable = None) -> None:
        """Add a row, or put it in the place of the one that has its key already."""
        place = self._count if key is None else self._place.setdefault(key, self._count)
        if place == self._count:
            if self._count == len(self._table):
                self._table = np.concatenate([self._table, np.zeros_like(self._table)])
            self._count += 1
        self._table[place] = row

    @property
    def rows(self) -> np.ndarray:
        """What is there; not to be written to."""
        return self._table[: self._count]


def open_simulator(scenario: Scenario) -> Simulator:
    """A run of a scenario, with the rasters of the ground that it names. Raises InputError."""
    world = scenario.world
    ends = np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)]) * world.side_m / 2
    try:
        elevation = read_elevation(world.elevation, ends, world.origin_deg, 10.0) if world.elevation else None
        photo = read_ortho(world.photo, ends, world.origin_deg, 0.0) if world.photo else None
    except InputError as error:
        # The reader knows of landmarks alone.
        raise InputError(str(error).replace("the landmarks lie", "the world lies")) from None
    return Simulator(scenario, elevation, photo)


def open_scenario(spec: str, overrides: Sequence[str] = (), seed: int | None = None) -> SimulatorSource:
    """A scenario by its name or file, as `simulation.scenario.load` takes it. Raises InputError with one line."""
    scenario = load_scenario(spec, overrides, seed)
    with name_scenario_in_errors(spec):
        return SimulatorSource(scenario, Path(spec).stem)


@contextmanager
def name_scenario_in_errors(spec: str) -> Iterator[None]:
    """Say before each InputError of which scenario it speaks."""
    try:
        yield
    except InputError as error:
        raise InputError(f"scenario {spec}: {error}") from None
