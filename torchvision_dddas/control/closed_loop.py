"""The loop about the whole path: reports come in, what is found goes out as commands."""

import time
from dataclasses import replace

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, with_parameters
from torchvision_dddas.control.ground_confirmation import CloserLook
from torchvision_dddas.control.sensor_monitor import Notice, Vigilance
from torchvision_dddas.control.steering_api import Steering
from torchvision_dddas.control.vehicles import Instrument
from torchvision_dddas.geo import AerialLocator, LandmarkWatch, Site, build_site, to_local
from torchvision_dddas.geo.colours import load_colours
from torchvision_dddas.geo.plane_solvers import load_solver
from torchvision_dddas.geo.terrain import shift_origin
from torchvision_dddas.people.detector import recognizer_of
from torchvision_dddas.types import Command, Elevation, FrameResult, Landmarks, Order, Registration, Scene, Telemetry

MEMORY_S = 15.0
"""Reports this old no longer tell where anything is: the rest of a long run would only cost time."""


def mission_of(source: Instrument, settings: Settings, backend: str, by_landmarks: bool = True) -> "Mission":
    """Everything about a source that can be steered, whose first frame has been read: it has reports by then.

    by_landmarks: whether the ground vehicles' markers are looked for; else telemetry alone lays pictures on the ground.
    Raises InputError where the reports do not do.
    """
    settings = fitted(settings, source)
    site = _site_of(source)
    site = replace(site, elevation=_elevation(source, site), sun_rad=source.sun_rad)
    locator = AerialLocator.from_site(site, source.camera, settings, load_solver(backend), source.rate_hz, True)
    colours = source.colours
    by_landmarks = by_landmarks and len(colours) > 0
    watch = (
        LandmarkWatch(locator, colours, load_colours(backend)) if by_landmarks else LandmarkWatch(locator, None, None)
    )
    closer = CloserLook(settings, recognizer_of(settings.people, backend)) if len(colours) else None
    steering = Steering(settings, source.camera, source.rate_hz, site.landmarks.names) if settings.steering.on else None
    if steering is not None:
        source.steer(steering.begin(locator.telemetry_at(0.0)))
    return Mission(source, watch, settings, closer, steering)


def fitted(settings: Settings, source: Instrument) -> Settings:
    """The settings with what the source says of itself where nothing else was set: sizes in metres hold by it."""
    own: dict[str, object] = {}
    if settings.gates.focal_px == Settings().gates.focal_px:
        own["gates.focal_px"] = float(source.camera.focal_px[0])
    if settings.landmarks.height_m == Settings().landmarks.height_m:
        own["landmarks.height_m"] = source.plate_m
    return with_parameters(settings, own)


class Mission:
    """The state of a run that steers. watch: takes the scenes; settings: with what the source itself says."""

    def __init__(
        self,
        source: Instrument,
        watch: LandmarkWatch,
        settings: Settings,
        closer: CloserLook | None,
        steering: Steering | None,
    ) -> None:
        self.source, self.watch, self.settings = source, watch, settings
        self._closer, self._steering = closer, steering
        self._origin = watch.locator.site.origin_deg
        self._vigilance = Vigilance(watch.locator.site.landmarks.names, source.rate_hz)

    def refresh(self, scene: Scene) -> None:
        """Before a scene is laid on the ground: take what was reported meanwhile."""
        locator, frame = self.watch.locator, scene.frame
        first = frame.number - MEMORY_S * self.source.rate_hz
        site = self._site(_recent(self.source.landmarks(), first), self.source.telemetry())
        locator.set_site(site)
        assert site.telemetry is not None
        self._vigilance.reports(self.source.last, site.landmarks, site.telemetry)
        if frame.image.any():  # no picture is all black, but what stands for a missing one
            self._vigilance.picture(frame, scene.step, self._metres_per_px(frame.time_s))
        if self._closer is not None:
            self._closer.take(self.source.pictures())

    def notices(self) -> list[Notice]:
        """What was seen to go wrong, or to be well again, since this was last asked."""
        return self._vigilance.notices()

    def after(self, surveyed: FrameResult, step: Registration | None) -> FrameResult:
        """Judge the targets of a frame by what the ground vehicles saw, and say where all go next.

        step: how the background moved up to the frame.
        """
        grounded = surveyed.grounded
        if grounded is None:
            return surveyed
        seconds = dict(grounded.seconds)
        confirmed = None
        if self._closer is not None:
            confirmed = self._closer.confirm(grounded, self._extent_m(surveyed))
            seconds["people"] = self._closer.spent_s
        command = None
        adjustments = grounded.adjustments
        if self._steering is not None:
            start = time.perf_counter()
            now = self.source.last
            now_s = (now - 1) / self.source.rate_hz
            locator = self.watch.locator
            there, moved = self._steering.step(
                grounded, confirmed, now_s, locator.landmarks_at(now), locator.telemetry_at(now_s), step
            )
            command = self._in_degrees(there)
            self.source.steer(command)
            adjustments = (*adjustments, *moved)
            seconds["steer"] = time.perf_counter() - start
        grounded = replace(grounded, adjustments=adjustments, seconds=seconds)
        return replace(surveyed, grounded=grounded, confirmed=confirmed, command=command)

    def _site(self, landmarks: Landmarks, telemetry: Telemetry) -> Site:
        """The reports in the metres of the site."""
        site = self.watch.locator.site
        if self._origin is not None:
            landmarks, telemetry = to_local(landmarks, self._origin), to_local(telemetry, self._origin)
        return replace(site, landmarks=landmarks, telemetry=telemetry)

    def _metres_per_px(self, time_s: float) -> float:
        """On level ground in the picture's middle; NaN where the UAV does not say how it flies."""
        flight = self.watch.locator.telemetry_at(time_s)
        if flight is None:
            return float("nan")
        down = np.sin(flight.pitch_rad) if np.isfinite(flight.pitch_rad) else 1.0
        return float(flight.altitude_m / max(down, 0.1) / self.source.camera.focal_px[0])

    def _extent_m(self, surveyed: FrameResult) -> np.ndarray:
        """(P,) radius of each located target on the ground; 0 where unknown."""
        grounded = surveyed.grounded
        assert grounded is not None
        return np.nan_to_num(self.watch.locator.ground_radii(grounded.fix, grounded.box_px[grounded.row]))

    def _in_degrees(self, command: Command) -> Command:
        """A command with the places that the vehicles understand."""
        if self._origin is None:
            return command
        origin = self._origin

        def there(place: np.ndarray | None) -> np.ndarray | None:
            return None if place is None else geometry.lonlat(np.asarray(place, float)[None], origin)[0]

        orders = tuple(
            Order(o.vehicle, geometry.lonlat(o.goal[None], origin)[0], o.speed_m_s, there(o.look_at), o.picture)
            for o in command.orders
        )
        return replace(command, fly_to=there(command.fly_to), look_at=there(command.look_at), orders=orders)


def _site_of(source: Instrument) -> Site:
    """The reports so far, about the first of them; about the source's own origin while no ground vehicle has any."""
    landmarks, telemetry = source.landmarks(), source.telemetry()
    if np.isfinite(landmarks.place).all(axis=1).any():
        return build_site(landmarks, telemetry)
    origin = source.origin_deg
    return Site(to_local(landmarks, origin), to_local(telemetry, origin), origin)


def _elevation(source: Instrument, site: Site) -> Elevation:
    """The heights of the ground in the metres of the site."""
    if site.origin_deg is None:
        return source.elevation
    return shift_origin(source.elevation, -geometry.east_north(np.array([source.origin_deg]), site.origin_deg)[0])


def _recent(landmarks: Landmarks, first: float) -> Landmarks:
    """The reports from a frame on."""
    rows = landmarks.frame >= first
    return replace(
        landmarks,
        frame=landmarks.frame[rows],
        landmark=landmarks.landmark[rows],
        image_px=landmarks.image_px[rows],
        place=landmarks.place[rows],
        sigma_m=landmarks.sigma_m[rows],
        planned=landmarks.planned[rows],
        line=landmarks.line[rows],
    )
