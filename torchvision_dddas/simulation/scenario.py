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

    origin_deg: Place = parameter((-110.95, 31.6), "deg", meaning="longitude and latitude of the world's middle")
    side_m: float = parameter(400.0, "m", 40, 4000, meaning="length of the square world's side")
    texel_m: float = parameter(0.1, "m", 0.02, 2, meaning="size of a pixel of the ground's texture")
    above_sea_m: float = parameter(1300.0, "m", -500, 9000, meaning="height of the middle above the sea")
    relief_m: float = parameter(3.0, "m", 0, 1000, meaning="from the lowest to the highest ground; 0: level")
    elevation: str = parameter("", "-", meaning="a GeoTIFF of heights in place of the synthetic relief")
    photo: str = parameter("", "-", meaning="an ortho-photo, a GeoTIFF, in place of the synthetic desert scrub")
    bushes_per_ha: float = parameter(40.0, "1/ha", 0, 2000, meaning="bushes on a hectare")
    trees_per_ha: float = parameter(3.0, "1/ha", 0, 500, meaning="trees on a hectare")
    buildings: int = parameter(2, "buildings", 0, 200, meaning="buildings in the world")
    sun_azimuth_deg: float = parameter(140.0, "deg", 0, 360, meaning="where the sun stands, clockwise from north")
    sun_height_deg: float = parameter(50.0, "deg", 5, 90, meaning="how high it stands above the horizon")


class CrowdPlan(Group):
    """A crowd: people who go together."""

    people: int = parameter(10, "people", 1, 5000, meaning="how many they are")
    start_m: Place = parameter((0.0, 0.0), "m", meaning="where their middle is at first")
    radius_m: float = parameter(2.0, "m", 0, 200, meaning="how far from their middle they are")
    behaviour: Literal["walk", "random", "stand"] = parameter(
        "walk", "-", meaning="walk: along way_m or heading_deg; random: a new velocity each time unit; stand"
    )
    speed_m_s: float = parameter(1.4, "m/s", 0, 10, meaning="how fast they walk")
    heading_deg: float = parameter(90.0, "deg", -360, 360, meaning="direction, clockwise from north, without way_m")
    way_m: tuple[Place, ...] = parameter(
        (), "m", meaning="places they walk through, one after the other, and back again"
    )
    from_s: float = parameter(0.0, "s", 0, 86400, meaning="when they set out; until then they stand")


class CarPlan(Group):
    """A vehicle that is no landmark: clutter, which no person is."""

    start_m: Place = parameter((0.0, 0.0), "m", meaning="where it is at first")
    heading_deg: float = parameter(90.0, "deg", -360, 360, meaning="direction, clockwise from north, without way_m")
    speed_m_s: float = parameter(6.0, "m/s", 0, 40, meaning="how fast it drives")
    way_m: tuple[Place, ...] = parameter(
        (), "m", meaning="places it drives through, one after the other, and back again"
    )
    from_s: float = parameter(0.0, "s", 0, 86400, meaning="when it sets out")


class Happening(Group):
    """Something that crowds do at a time. Crowds are numbered from 1, in the order of the file."""

    time_s: float = parameter(10.0, "s", 0, 86400, meaning="when")
    what: Literal["join", "split", "scatter"] = parameter(
        "join",
        "-",
        meaning="join: two or more walk to one place and go on as the first; split: one parts in two, whose ways "
        "differ by turn_deg; scatter: everyone of it runs off on their own",
    )
    crowds: Annotated[tuple[Annotated[int, Field(ge=1, le=10_000)], ...], Field(min_length=1)] = parameter(
        (1,), "-", meaning="which crowds"
    )
    turn_deg: float = parameter(60.0, "deg", 0, 180, meaning="angle between the ways of the two parts of a split")


class TeamParameters(Group):
    """The ground vehicles: landmarks for the aerial camera, and eyes on the ground."""

    ugvs: int = parameter(4, "vehicles", 0, 12, meaning="how many there are; each wears a colour of its own")
    ring_m: float = parameter(
        14.0, "m", 0, 1000, meaning="radius of the ring about middle_m on which they stand at first"
    )
    middle_m: Place = parameter((0.0, 0.0), "m", meaning="middle of that ring")
    patrol_m_s: float = parameter(1.0, "m/s", 0, 10, meaning="speed along their planned ways, while nobody steers them")
    patrol: Literal["stand", "random", "gather", "along"] = parameter(
        "random",
        "-",
        meaning="planned ways: none; from place to place within the ring; to its middle, fast and then slow, as the "
        "source's; with the UAV's own way",
    )
    planned: bool = parameter(True, "-", meaning="they share their planned waypoints, which bridge GPS dropouts")
    hfov_deg: float = parameter(56.0, "deg", 10, 120, meaning="width of the field of view of their cameras")
    width_px: int = parameter(640, "px", 64, 3840, meaning="width of their pictures")
    height_px: int = parameter(480, "px", 64, 2160, meaning="height of their pictures")
    camera_m: float = parameter(1.3, "m", 0.1, 20, meaning="height of their cameras above ground")


class GpsParameters(Group):
    """The receivers of the ground vehicles."""

    error95_m: float = parameter(0.0, "m", 0, 1000, meaning="95 % of the places are this near the truth; 0: exact")
    white_share: float = parameter(0.1, "-", 0, 1, meaning="share of the variance that is new in each report")
    correlation_s: float = parameter(60.0, "s", 0.1, 1e5, meaning="time over which the rest stays alike")
    common_m: float = parameter(0.0, "m", 0, 1000, meaning="standard deviation, per axis, of what all receivers share")
    rate_hz: float = parameter(10.0, "1/s", 0.01, 100, meaning="reports a second")


class AircraftParameters(Group):
    """The UAV, what it reports of itself, and how it flies while nobody steers it."""

    altitude_m: float = parameter(50.0, "m", 2, 2000, meaning="height above the ground below it")
    pitch_deg: float = parameter(90.0, "deg", 10, 90, meaning="how far the camera looks below the horizon; 90: down")
    heading_deg: float = parameter(0.0, "deg", -360, 360, meaning="heading of the picture's upper edge at first")
    start_m: Place = parameter((0.0, 0.0), "m", meaning="ground that is in the middle of the picture at first")
    way_m: tuple[Place, ...] = parameter(
        (), "m", meaning="places that it looks at, one after the other, and back again"
    )
    speed_m_s: float = parameter(2.0, "m/s", 0, 40, meaning="speed along its way")
    maximum_m_s: float = parameter(10.0, "m/s", 0.1, 60, meaning="fastest that it flies when it is steered")
    wind_m_s: float = parameter(1.0, "m/s", 0, 30, meaning="standard deviation of the gusts that push it about")
    shake_deg: float = parameter(
        0.15, "deg", 0, 20, meaning="standard deviation of the camera's angles about the intended"
    )
    place_error95_m: float = parameter(3.5, "m", 0, 1000, meaning="of its own GPS, as in gps.error95_m")
    angle_error_deg: float = parameter(1.0, "deg", 0, 90, meaning="standard deviation of the tilt it reports, lasting")
    heading_error_deg: float = parameter(3.0, "deg", 0, 180, meaning="of the heading")
    altitude_error: float = parameter(0.01, "-", 0, 1, meaning="of the altitude, as a share")


class CameraParameters(Group):
    """The UAV's camera."""

    width_px: int = parameter(640, "px", 64, 3840, meaning="width of the picture")
    height_px: int = parameter(480, "px", 64, 2160, meaning="height of the picture")
    hfov_deg: float = parameter(60.0, "deg", 5, 120, meaning="width of the field of view")
    exposure_s: float = parameter(0.002, "s", 0, 0.5, meaning="time of exposure: what moves is blurred along its way")
    readout_s: float = parameter(0.015, "s", 0, 0.5, meaning="rolling shutter: how much later the last row is read")
    vibration_px: float = parameter(
        0.04, "px", 0, 10, meaning="rolling shutter: standard deviation of how far vibration moves rows aside"
    )
    sharpness_px: float = parameter(0.6, "px", 0, 10, meaning="standard deviation of the lens's blur")
    shot_noise: float = parameter(
        0.015, "-", 0, 10, meaning="variance of the noise, in grey levels, for each grey level"
    )
    read_noise: float = parameter(0.6, "grey levels", 0, 50, meaning="standard deviation of the noise in the dark")
    drift: float = parameter(0.03, "-", 0, 0.5, meaning="amplitude of slow changes of exposure, as a share")
    quality: int = parameter(75, "-", 10, 100, meaning="of the JPEG compression; 100: none")


class Fault(Group):
    """Something that goes wrong for a while."""

    what: Literal[
        "ugv_lost", "gps_dropout", "gps_jump", "frozen", "dropped", "gust", "landmark_hidden", "telemetry_silent"
    ] = parameter(
        "gps_dropout",
        "-",
        meaning="a vehicle stops and is silent; its receiver is silent; its places are off by `size` metres; the "
        "camera repeats a picture; pictures are missing; the UAV is pushed with `size` m/s; a marker is covered; the "
        "UAV says nothing of itself",
    )
    time_s: float = parameter(10.0, "s", 0, 86400, meaning="when it begins")
    seconds: float = parameter(5.0, "s", 0, 86400, meaning="how long it lasts")
    vehicle: int = parameter(1, "-", 1, 12, meaning="which ground vehicle, counted from 1")
    size: float = parameter(10.0, "-", 0, 1000, meaning="how far or fast, in metres or metres a second")


class ClipParameters(Group):
    """How long the run is, and how it is located."""

    seconds: float = parameter(30.0, "s", 0.3, 86400, meaning="length of the run")
    rate_hz: float = parameter(10.0, "1/s", 1, 120, meaning="pictures a second")
    located_by: Literal["landmarks", "telemetry", "nothing"] = parameter(
        "landmarks",
        "-",
        meaning="what lays the UAV's pictures on the ground in `dddas run sim:`; telemetry: markers are not looked for",
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
