"""The closed loop: it takes the vehicles' reports, and returns commands to the aerial and the ground vehicles."""

import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import Settings, is_set, with_parameters
from torchvision_dddas.control.footprint import CameraMount, ground_in_middle, inside, update_mount
from torchvision_dddas.control.ground_confirmation import GroundConfirmation
from torchvision_dddas.control.prediction import MISSED, Prediction, TargetPredictor
from torchvision_dddas.control.rules import AdjustmentLog, every_least, every_wanted, sampled
from torchvision_dddas.control.sensor_monitor import Notice, SensorMonitor
from torchvision_dddas.control.uav_commands import UavSteering
from torchvision_dddas.control.ugv_commands import UgvTeam
from torchvision_dddas.detection import (
    describe_distance,
    interval_from_flow,
    interval_from_telemetry,
    look_cost,
    pixels_per_metre,
)
from torchvision_dddas.geo import AerialLocator, LandmarkWatch, Site, build_site, geoid_of, load_solver, to_local
from torchvision_dddas.geometry import shift_origin
from torchvision_dddas.people import load_scorer
from torchvision_dddas.types import (
    Adjustment,
    AerialLocations,
    Camera,
    Colours,
    Command,
    Confirmation,
    Elevation,
    Flight,
    Frame,
    FrameResult,
    GroundCrowds,
    GroundPicture,
    LandmarkObservations,
    Landmarks,
    Order,
    Registration,
    Scene,
    Telemetry,
)

# Reports older than this are dropped, because they would slow down a long run.
_MEMORY_S = 15.0
# Shortest time between new goals of the vehicles: results are a second old, and vehicles do not turn faster.
_PERIOD_S = 0.2
# After the loss of a target every frame is processed for this time.
_ALERT_S = 4.0
# The number of processed frames is reduced only if its last change is at least this time ago.
_CALM_S = 3.0
# A registration is weak if a smaller share of its points are inliers.
_WEAK = 0.5


class Instrument(Protocol):
    """A source of frames and of vehicle reports whose vehicles can be steered, such as the simulator.

    camera: the aerial camera. colours: colours of the landmarks. elevation: elevation of the ground, in metres relative
    to origin_deg, (longitude, latitude). sun_rad: azimuth and elevation of the sun, None if unknown. plate_m: height of
    the landmarks' coloured plates above ground.
    """

    name: str
    count: int | None
    exact: bool
    rate_hz: float
    size: tuple[int, int]
    last: int
    camera: Camera
    colours: Colours
    elevation: Elevation
    origin_deg: tuple[float, float]
    sun_rad: tuple[float, float] | None
    plate_m: float

    def __iter__(self) -> Iterator[Frame]: ...

    def steer(self, command: Command) -> None:
        """Follow a command from the next frame on. Its positions are in degrees."""

    def landmarks(self) -> Landmarks:
        """Return all reports of the ground vehicles up to now, in degrees."""

    def telemetry(self) -> Telemetry:
        """Return all reports of the aerial vehicle up to now, in degrees."""

    def pictures(self) -> list[GroundPicture]:
        """Return the pictures that ground vehicles took since the last call."""


class StartedSource:
    """A source whose first frame has been read, so that its vehicles have reported. All else is as in the source."""

    def __init__(self, source: Instrument) -> None:
        self._source, self._frames = source, iter(source)
        self._first = next(self._frames, None)

    def __iter__(self) -> Iterator[Frame]:
        if self._first is not None:
            yield self._first
            self._first = None
        yield from self._frames

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)


def build_mission(source: Instrument, settings: Settings, backend: str, by_landmarks: bool = True) -> "Mission":
    """Build the closed loop around a source whose first frame has been read, so that it has reports.

    by_landmarks: search for the ground vehicles' markers; otherwise only telemetry gives the camera's pose.
    Raises InputError if the reports are not sufficient.
    """
    settings = fit_settings(settings, source)
    landmarks, telemetry, elevation = source.landmarks(), source.telemetry(), source.elevation
    if np.isfinite(landmarks.place).all(axis=1).any():
        site = build_site(landmarks, telemetry)
    else:  # use the source's own origin until a ground vehicle has reported
        origin = source.origin_deg
        site = Site(to_local(landmarks, origin), to_local(telemetry, origin), origin)
    if site.origin_deg is not None:
        elevation = shift_origin(elevation, -geometry.east_north(np.array([source.origin_deg]), site.origin_deg)[0])
    geoid_m = geoid_of(np.zeros((1, 2)), site.origin_deg, settings.aerial.geoid)
    site = replace(site, elevation=elevation, sun_rad=source.sun_rad)
    site = replace(site, geoid_m=geoid_m, plane_above_sea_m=elevation.base_m)
    locator = AerialLocator.from_site(site, source.camera, settings, load_solver(backend), source.rate_hz, True)
    colours = source.colours if by_landmarks and len(source.colours) else None
    watch = LandmarkWatch(locator, colours)
    confirmation, steering = None, None
    if len(source.colours):
        confirmation = GroundConfirmation(settings, load_scorer(settings.people, backend))
    if settings.steering.on:
        steering = Steering(settings, source.camera, source.rate_hz, site.landmarks.names)
        source.steer(steering.begin(locator.telemetry_at(0.0)))
    return Mission(source, watch, settings, confirmation, steering)


def fit_settings(settings: Settings, source: Instrument) -> Settings:
    """Return the settings with the source's focal length and height of markers, unless the user has set them."""
    own: dict[str, object] = {}
    if not is_set(settings, "gates.focal_px"):
        own["gates.focal_px"] = float(source.camera.focal_px[0])
    if not is_set(settings, "landmarks.height_m"):
        own["landmarks.height_m"] = source.plate_m
    return with_parameters(settings, own)


class Mission:
    """The state of a run that steers its vehicles. settings: from `fit_settings`."""

    def __init__(
        self,
        source: Instrument,
        watch: LandmarkWatch,
        settings: Settings,
        confirmation: GroundConfirmation | None,
        steering: "Steering | None",
    ) -> None:
        self.source, self.watch, self.settings = source, watch, settings
        self._confirmation, self._steering = confirmation, steering
        self._origin = watch.locator.site.origin_deg
        self._monitor = SensorMonitor(watch.locator.site.landmarks.names, source.rate_hz)

    def take_reports(self, scene: Scene) -> None:
        """Take the reports up to now. Call this before the scene is located."""
        locator, frame = self.watch.locator, scene.frame
        landmarks, telemetry = self.source.landmarks(), self.source.telemetry()
        landmarks = landmarks[landmarks.frame >= frame.number - _MEMORY_S * self.source.rate_hz]
        if self._origin is not None:
            landmarks, telemetry = to_local(landmarks, self._origin), to_local(telemetry, self._origin)
        locator.set_site(replace(locator.site, landmarks=landmarks, telemetry=telemetry))
        self._monitor.check_reports(self.source.last, landmarks, telemetry)
        if frame.image.any():  # an all-black picture stands for a missing one
            flight, metres_per_px = locator.telemetry_at(frame.time_s), float("nan")
            if flight is not None:  # the scale of level ground in the centre of the picture
                metres_per_px = float(flight.distance_m / self.source.camera.focal_px[0])
            self._monitor.check_picture(frame, scene.step, metres_per_px)
        if self._confirmation is not None:
            self._confirmation.take(self.source.pictures())

    def notices(self) -> list[Notice]:
        """Return the sensor failures and recoveries noticed since the last call."""
        return self._monitor.notices()

    def steer(self, result: FrameResult, step: Registration | None) -> FrameResult:
        """Confirm the targets of a frame by the ground vehicles' pictures, and send commands to the vehicles.

        step: the background's motion from the frame before to this frame; None if unknown.
        """
        located = result.locations
        if located is None:
            return result
        seconds, locator, adjustments = dict(located.seconds), self.watch.locator, located.adjustments
        confirmed, command, crowds = None, None, None
        if self._confirmation is not None:
            start = time.perf_counter()
            radius = np.nan_to_num(locator.ground_radii(located.fix, located.box_px[located.row]))
            missing = None if self._steering is None else self._steering.missing(located)
            confirmed, crowds = self._confirmation.confirm(located, radius, missing)
            if missing is not None:
                crowds = replace(crowds, steers=np.isin(crowds.target, missing.target[missing.is_human]))
            seconds["people"] = time.perf_counter() - start
        if self._steering is not None:
            start = time.perf_counter()
            now = self.source.last
            now_s = (now - 1) / self.source.rate_hz
            marks, flight = locator.landmarks_at(now), locator.telemetry_at(now_s)
            command, made = self._steering.update(located, confirmed, now_s, marks, flight, step, crowds)
            command = self._in_degrees(command)
            self.source.steer(command)
            adjustments = (*adjustments, *made)
            seconds["steer"] = time.perf_counter() - start
        located = replace(located, adjustments=adjustments, seconds=seconds)
        return replace(result, locations=located, confirmed=confirmed, command=command, crowds=crowds)

    def _in_degrees(self, command: Command) -> Command:
        origin = self._origin
        if origin is None:
            return command

        def lonlat(place: Any) -> Any:
            return None if place is None else geometry.lonlat(np.asarray(place, float)[None], origin)[0]

        orders = tuple(replace(o, goal=lonlat(o.goal), look_at=lonlat(o.look_at)) for o in command.orders)
        return replace(command, fly_to=lonlat(command.fly_to), look_at=lonlat(command.look_at), orders=orders)


class Steering:
    """Commands the vehicles and decides which frames are processed. Pass located frames in order to `update`."""

    def __init__(self, settings: Settings, camera: Camera, rate_hz: float, vehicles: Sequence[str]) -> None:
        """Start without targets. camera: the aerial camera. vehicles: names of the ground vehicles, as in Landmarks."""
        self.settings, self.camera, self.rate_hz = settings, camera, rate_hz
        self._predictor, self._log = TargetPredictor(camera), AdjustmentLog()
        self._uav, self._team = UavSteering(settings, self._log), UgvTeam(settings, vehicles, self._log)
        self._mount: CameraMount | None = None
        self._command, self._steered_s = Command(), -np.inf
        self._every, self._every_changed_s, self._last_frame = 1, -np.inf, 0
        self._alert_s, self._alert = -np.inf, ""
        self._by_ground: list[int] = []  # targets that only ground vehicles see
        self._costs: deque[float] = deque(maxlen=settings.interval.memory_frames)  # computing time of looks, s

    def begin(self, flight: Flight | None) -> Command:
        """Return the first command: process every k-th frame, so that a walker moves visibly in between."""
        parameters = self.settings.steering
        if parameters.sampling and flight is not None and flight.altitude_m > 0:
            self._every = int(np.clip(round(self._least_every(flight)), 1, parameters.maximum_every))
        self._command = Command(self._every)
        return self._command

    def missing(self, located: AerialLocations) -> Prediction:
        """Return the known targets that a frame did not locate. Call this before `update`."""
        return self._predictor.missing(located)

    def update(
        self,
        located: AerialLocations,
        confirmed: Confirmation | None,
        now_s: float,
        marks: LandmarkObservations,
        flight: Flight | None,
        step: Registration | None = None,
        crowds: GroundCrowds | None = None,
    ) -> tuple[Command, tuple[Adjustment, ...]]:
        """Return the command after a frame was located, in local metres, and the adjustments with their causes.

        confirmed: its rows are rows of located.positions. now_s: time of the newest frame read, which is later than the
        located frame. marks, flight: current reports of the ground vehicles and of the aerial vehicle, in local metres;
        None while silent. The altitude counts from up = 0. step: the background's motion to the located frame. crowds:
        crowds seen from the ground at that frame.
        """
        parameters = self.settings.steering
        self._log.begin(located.frame)
        now_s = max(now_s, located.time_s)
        prediction = self._predictor.update(located, confirmed, now_s, crowds)
        self._note_ground(prediction, crowds)
        mount = self._mount = update_mount(flight, located.fix, self._mount, self.camera)
        if parameters.sampling:
            self._choose_frames(located, prediction, now_s, flight, step)
        if now_s - self._steered_s < _PERIOD_S - 1e-6:
            repeated = tuple(replace(order, picture=False) for order in self._command.orders)
            self._command = replace(self._command, every=self._every, orders=repeated)
            return self._command, self._log.made()
        self._steered_s = now_s
        team_m = self._team.hear(marks, now_s)
        if parameters.follow:
            middle = ground_in_middle(flight, located.fix, mount) if mount is not None else None
            self._uav.update(prediction, team_m, mount, middle, now_s)
        look_at, altitude_m = self._uav.look_at, self._uav.altitude_m
        if mount is not None and altitude_m is not None:
            mount = replace(mount, altitude_m=altitude_m)
        orders: tuple[Order, ...] = ()
        if parameters.look:
            orders = self._team.orders(prediction, self._uav.followed(prediction), mount)
        fly_to = None
        if look_at is not None and mount is not None:
            fly_to = mount.pose(look_at, mount.altitude_m).place_m[:2]
        self._command = Command(self._every, fly_to, look_at, altitude_m, orders)
        return self._command, self._log.made()

    def _note_ground(self, prediction: Prediction, crowds: GroundCrowds | None) -> None:
        """Log the number of targets that only ground vehicles see, when it changes."""
        before, self._by_ground = self._by_ground, prediction.target[prediction.by_ground].tolist()
        if new := [target for target in self._by_ground if target not in before]:
            assert crowds is not None
            row = crowds.target.tolist().index(new[0])
            (east, north), speed = crowds.east_north_m[row], float(np.linalg.norm(crowds.velocity_m_s[row]))
            cause = f"target {new[0]} is not located from the air: {crowds.people[row]} of its people seen by "
            cause += f"{crowds.seen_by[row].replace(';', ' and ')} around ({east:.0f}, {north:.0f}) m"
            cause += f", moving at {speed:.1f} m/s" if np.isfinite(speed) else ""
        else:
            gone = next((target for target in before if target not in self._by_ground), 0)
            cause = f"target {gone} is {'located from the air again' if gone in prediction.target else 'lost'}"
        self._log.set("team.by_ground", len(self._by_ground), cause)

    def _least_every(self, flight: Flight) -> float:
        scale = pixels_per_metre(flight.distance_m, self.camera.focal_px[0])
        return every_least(scale, self.rate_hz, self.settings.steering)

    def _choose_frames(
        self,
        located: AerialLocations,
        prediction: Prediction,
        now_s: float,
        flight: Flight | None,
        step: Registration | None,
    ) -> None:
        """Choose k, so that one of k frames is processed."""
        frame, parameters, interval = located.frame, self.settings.steering, self.settings.interval
        between, self._last_frame = max(frame - self._last_frame, 1), frame
        self._costs.append(sum(located.seconds.values()))
        cost, measured = look_cost(self._costs, interval)
        lost = np.flatnonzero(prediction.wanted & (prediction.missed == MISSED))
        if located.fix.pose is not None and len(lost):  # a target outside the picture does not count as lost
            lost = lost[inside(prediction.east_north_m[lost], located.fix.pose, self.camera) > 0]
        if len(lost):
            self._alert_s, self._alert = now_s + _ALERT_S, f"target {prediction.target[lost[0]]} was lost"
        elif step is not None and (not step.reliable or step.inliers < _WEAK * step.tracked):
            self._alert_s = now_s + _ALERT_S
            self._alert = f"weak registration: {step.inliers} of {step.tracked} points agree"
        wanted, why = 1.0, self._alert
        if now_s >= self._alert_s:
            if flight is not None and np.isfinite([flight.altitude_m, flight.speed_m_s]).all():
                wanted = interval_from_telemetry(flight.distance_m, flight.speed_m_s, self.rate_hz, cost, interval)
                why = f"{describe_distance(flight)}, speed {flight.speed_m_s:.1f} m/s"
            elif step is not None and step.reliable:
                wanted = interval_from_flow([step.flow_px / between], self.camera.size_px[0], cost, interval)
                why = f"background flow {step.flow_px / between:.2f} px a frame"
            else:
                return
            # A target that was missed in few frames still counts.
            seen = prediction.missed <= MISSED
            speed, size = prediction.speed_m_s[seen], 2 * prediction.radius_m[seen]
            wanted, limit = every_wanted(wanted, self.rate_hz, speed, size, parameters)
            why += measured + limit
        if flight is not None and flight.altitude_m > 0:
            wanted = max(wanted, self._least_every(flight))
        every, made = sampled(frame, self._every, wanted, why, parameters)
        if every > self._every and now_s - self._every_changed_s < _CALM_S:
            return
        if made:
            self._every, self._every_changed_s = every, now_s
        self._log.add(made)
