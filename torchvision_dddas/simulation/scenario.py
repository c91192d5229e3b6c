"""What a simulated world holds and what happens in it: every number of a scenario, with its unit and range.

Metres are local: east and north of the world's origin, which is its middle. Speeds, behaviours and heights follow
appendix A, section V: a border area near Tucson, 1300 m above the sea, crowds at U(1.11, 3.34) m a time unit along east
and along north, UGVs that are fast at first and slow near the crowd, a UAV 50 to 200 m above ground.
"""

from typing import Annotated, Literal

from pydantic import Field

from torchvision_dddas.config import Group, parameter

Place = tuple[float, float]


class WorldParameters(Group):
    """The ground and what stands on it."""

    origin_deg: Place = parameter((-110.95, 31.6), "longitude and latitude of the world's middle", "deg")
    side_m: float = parameter(400.0, "length of the square world's side", "m", 40, 4000)
    texel_m: float = parameter(0.1, "size of a pixel of the ground's texture", "m", 0.02, 2)
    above_sea_m: float = parameter(1300.0, "height of the middle above the sea", "m", -500, 9000)
    relief_m: float = parameter(3.0, "from the lowest to the highest ground; 0: level", "m", 0, 1000)
    elevation: str = parameter("", "a GeoTIFF of heights in place of the synthetic relief")
    photo: str = parameter("", "an ortho-photo, a GeoTIFF, in place of the synthetic desert scrub")
    bushes_per_ha: float = parameter(40.0, "bushes on a hectare", "1/ha", 0, 2000)
    trees_per_ha: float = parameter(3.0, "trees on a hectare", "1/ha", 0, 500)
    buildings: int = parameter(2, "buildings in the world", "buildings", 0, 200)
    sun_azimuth_deg: float = parameter(140.0, "direction of the sun, clockwise from north", "deg", 0, 360)
    sun_height_deg: float = parameter(50.0, "elevation of the sun", "deg", 5, 90)


class CrowdPlan(Group):
    """A crowd: people who go together."""

    people: int = parameter(10, "number of people in it", "people", 1, 5000)
    start_m: Place = parameter((0.0, 0.0), "their initial centre", "m")
    radius_m: float = parameter(2.0, "their largest distance from the centre", "m", 0, 200)
    behaviour: Literal["walk", "random", "stand"] = parameter(
        "walk", "walk: along way_m or heading_deg; random: a new velocity each time unit; stand"
    )
    speed_m_s: float = parameter(1.4, "their walking speed", "m/s", 0, 10)
    heading_deg: float = parameter(90.0, "direction, clockwise from north, without way_m", "deg", -360, 360)
    way_m: tuple[Place, ...] = parameter((), "waypoints, walked there and back", "m")
    from_s: float = parameter(0.0, "start time; until then they stand", "s", 0, 86400)


class CarPlan(Group):
    """A vehicle that is no landmark: clutter, which no person is."""

    start_m: Place = parameter((0.0, 0.0), "its initial position", "m")
    heading_deg: float = parameter(90.0, "direction, clockwise from north, without way_m", "deg", -360, 360)
    speed_m_s: float = parameter(6.0, "its driving speed", "m/s", 0, 40)
    way_m: tuple[Place, ...] = parameter((), "waypoints, driven there and back", "m")
    from_s: float = parameter(0.0, "its start time", "s", 0, 86400)


class Happening(Group):
    """Something that crowds do at a time. Crowds are numbered from 1, in the order of the file."""

    time_s: float = parameter(10.0, "when", "s", 0, 86400)
    what: Literal["join", "split", "scatter"] = parameter(
        "join",
        "join: two or more walk to one place and go on as the first; split: one parts in two, whose ways differ "
        "by turn_deg; scatter: everyone of it runs off on their own",
    )
    crowds: Annotated[tuple[Annotated[int, Field(ge=1, le=10_000)], ...], Field(min_length=1)] = parameter(
        (1,), "which crowds"
    )
    turn_deg: float = parameter(60.0, "angle between the ways of the two parts of a split", "deg", 0, 180)


class TeamParameters(Group):
    """The ground vehicles: landmarks for the aerial camera, and eyes on the ground."""

    ugvs: int = parameter(4, "number of vehicles; each has its own colour", "vehicles", 0, 12)
    ring_m: float = parameter(14.0, "radius of the ring about middle_m on which they stand at first", "m", 0, 1000)
    middle_m: Place = parameter((0.0, 0.0), "middle of that ring", "m")
    patrol_m_s: float = parameter(1.0, "speed along their planned ways, while nobody steers them", "m/s", 0, 10)
    patrol: Literal["stand", "random", "gather", "along"] = parameter(
        "random",
        "planned ways: none; from place to place within the ring; to its middle, fast and then slow, as the "
        "source's; with the UAV's own way",
    )
    planned: bool = parameter(True, "they share their planned waypoints, which bridge GPS dropouts")
    hfov_deg: float = parameter(56.0, "width of the field of view of their cameras", "deg", 10, 120)
    width_px: int = parameter(640, "width of their pictures", "px", 64, 3840)
    height_px: int = parameter(480, "height of their pictures", "px", 64, 2160)
    camera_m: float = parameter(1.3, "height of their cameras above ground", "m", 0.1, 20)


class GpsParameters(Group):
    """The receivers of the ground vehicles."""

    error95_m: float = parameter(0.0, "95 % of the places are this near the truth; 0: exact", "m", 0, 1000)
    white_share: float = parameter(0.1, "share of the variance that is new in each report", "-", 0, 1)
    correlation_s: float = parameter(60.0, "time over which the rest stays alike", "s", 0.1, 1e5)
    common_m: float = parameter(0.0, "standard deviation, per axis, of what all receivers share", "m", 0, 1000)
    rate_hz: float = parameter(10.0, "reports a second", "1/s", 0.01, 100)


class AircraftParameters(Group):
    """The UAV, what it reports of itself, and how it flies while nobody steers it."""

    altitude_m: float = parameter(50.0, "height above the ground below it", "m", 2, 2000)
    pitch_deg: float = parameter(90.0, "how far the camera looks below the horizon; 90: down", "deg", 10, 90)
    heading_deg: float = parameter(0.0, "heading of the picture's upper edge at first", "deg", -360, 360)
    start_m: Place = parameter((0.0, 0.0), "ground that is in the middle of the picture at first", "m")
    way_m: tuple[Place, ...] = parameter((), "places that it looks at, one after the other, and back again", "m")
    speed_m_s: float = parameter(2.0, "speed along its way", "m/s", 0, 40)
    maximum_m_s: float = parameter(10.0, "fastest that it flies when it is steered", "m/s", 0.1, 60)
    wind_m_s: float = parameter(1.0, "standard deviation of the gusts that push it about", "m/s", 0, 30)
    shake_deg: float = parameter(0.15, "standard deviation of the camera's angles about the intended", "deg", 0, 20)
    place_error95_m: float = parameter(3.5, "of its own GPS, as in gps.error95_m", "m", 0, 1000)
    angle_error_deg: float = parameter(1.0, "standard deviation of the tilt it reports, lasting", "deg", 0, 90)
    heading_error_deg: float = parameter(3.0, "of the heading", "deg", 0, 180)
    altitude_error: float = parameter(0.01, "of the altitude, as a share", "-", 0, 1)


class CameraParameters(Group):
    """The UAV's camera."""

    width_px: int = parameter(640, "width of the picture", "px", 64, 3840)
    height_px: int = parameter(480, "height of the picture", "px", 64, 2160)
    hfov_deg: float = parameter(60.0, "width of the field of view", "deg", 5, 120)
    exposure_s: float = parameter(0.002, "time of exposure: what moves is blurred along its way", "s", 0, 0.5)
    readout_s: float = parameter(0.015, "rolling shutter: how much later the last row is read", "s", 0, 0.5)
    vibration_px: float = parameter(
        0.04, "rolling shutter: standard deviation of how far vibration moves rows aside", "px", 0, 10
    )
    sharpness_px: float = parameter(0.6, "standard deviation of the lens's blur", "px", 0, 10)
    shot_noise: float = parameter(0.015, "variance of the noise, in grey levels, for each grey level", "-", 0, 10)
    read_noise: float = parameter(0.6, "standard deviation of the noise in the dark", "grey levels", 0, 50)
    drift: float = parameter(0.03, "amplitude of slow changes of exposure, as a share", "-", 0, 0.5)
    quality: int = parameter(75, "of the JPEG compression; 100: none", "-", 10, 100)


class Fault(Group):
    """Something that goes wrong for a while."""

    what: Literal[
        "ugv_lost", "gps_dropout", "gps_jump", "frozen", "dropped", "gust", "landmark_hidden", "telemetry_silent"
    ] = parameter(
        "gps_dropout",
        "a vehicle stops and is silent; its receiver is silent; its places are off by `size` metres; the camera "
        "repeats a picture; pictures are missing; the UAV is pushed with `size` m/s; a marker is covered; the "
        "UAV says nothing of itself",
    )
    time_s: float = parameter(10.0, "when it begins", "s", 0, 86400)
    seconds: float = parameter(5.0, "how long it lasts", "s", 0, 86400)
    vehicle: int = parameter(1, "which ground vehicle, counted from 1", "-", 1, 12)
    size: float = parameter(10.0, "how far or fast, in metres or metres a second", "-", 0, 1000)


class ClipParameters(Group):
    """How long the run is, and how it is located."""

    seconds: float = parameter(30.0, "length of the run", "s", 0.3, 86400)
    rate_hz: float = parameter(10.0, "pictures a second", "1/s", 1, 120)
    located_by: Literal["landmarks", "telemetry", "nothing"] = parameter(
        "landmarks",
        "what lays the UAV's pictures on the ground in `dddas run sim:`; telemetry: markers are not looked for",
    )


class Scenario(Group):
    """A whole scenario. seed: of everything that chance decides in it; about: what it shows, in a sentence."""

    about: str = ""
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    clip: ClipParameters = ClipParameters()
    world: WorldParameters = WorldParameters()
    uav: AircraftParameters = AircraftParameters()
    camera: CameraParameters = CameraParameters()
    team: TeamParameters = TeamParameters()
    gps: GpsParameters = GpsParameters()
    crowd: tuple[CrowdPlan, ...] = ()
    car: tuple[CarPlan, ...] = ()
    happening: tuple[Happening, ...] = ()
    fault: tuple[Fault, ...] = ()
    settings: dict[str, dict[str, object]] = Field(default_factory=dict)
