"""Parameters of location on the ground: from the ground, from the air, by landmarks, and of crowds."""

from typing import Literal

from torchvision_dddas.config.group import Group, parameter


class GroundParameters(Group):
    """Location of people from the ground (appendix A, IV-C), and matching of several sightings of one person."""

    mode: Literal["default", "paper"] = parameter(
        "default", "default: height and foot row with covariances, on the ellipsoid; paper: eq. 13 to 15"
    )
    use: Literal["both", "height", "feet"] = parameter(
        "both", "measure distance by the body's height, the row of the feet, or both by variance"
    )
    body_height_m: float = parameter(1.75, "height of a typical person", "m", 0.3, 3)
    body_height_sigma_m: float = parameter(0.1, "standard deviation of people's heights", "m", 0, 1)
    height_sigma: float = parameter(0.05, "standard deviation of a box's height, in box heights", "-", 0, 1)
    feet_sigma: float = parameter(0.03, "standard deviation of the foot row, in box heights", "-", 0, 1)
    gate_sigmas: float = parameter(3.0, "sightings at a larger distance are different people", "-", 0.5, 10)
    within_frames: int = parameter(0, "frames of several cameras this close count as simultaneous", "frames", 0, 1000)


class FusionParameters(Group):
    """Fusion of the measurements of all platforms to one state per target, and correlation of a platform's errors."""

    delay_s: float = parameter(2.0, "measurements that arrive later than this are left out", "s", 0, 60)
    position_s: float = parameter(60.0, "correlation time of a platform's position error", "s", 0.1, 1e6)
    angle_s: float = parameter(
        300.0, "correlation time of errors of a platform's heading, tilt, height and focal length", "s", 0.1, 1e6
    )
    white_share: float = parameter(0.1, "share of a platform's error variance that is new in each record", "-", 0, 1)
    acceleration_m_s2: float = parameter(0.5, "random acceleration of targets, in m/s per root of a second", "-", 0, 50)
    freedom: float = parameter(
        2.0, "degrees of freedom of the t distribution of platform positions; low: outliers count less", "-", 0.1, 1e6
    )
    forget_s: float = parameter(5.0, "a target that no platform has seen for this time is dropped", "s", 0.1, 3600)


class LandmarkParameters(Group):
    """Ground vehicles as landmarks: search by colour, separation from targets, tracking (appendix A, IV-A)."""

    differentiation: Literal["exact", "greedy"] = parameter(
        "exact", "assignment of blobs to landmarks: most pairs with the smallest distance, or greedy"
    )
    centre: Literal["motion", "colour"] = parameter(
        "motion",
        "position of a landmark with a blob: the centre of the blob, or of the colour in the middle of the vehicle",
    )
    reach_px: float = parameter(40.0, "largest distance between a landmark's colour and its blob", "px", 0, 10000)
    interval_frames: int = parameter(
        10, "frames between two separations of landmarks from targets (tracking interval)", "frames", 1, 10000
    )
    least_area_px: int = parameter(12, "smaller patches of colour are ignored", "px", 1, 1_000_000)
    pixel_sigma: float = parameter(1.0, "standard deviation of a landmark's position in the picture", "px", 0.01, 100)
    sigma_m: float = parameter(
        1.43, "standard deviation of a landmark's report if none is given: GPS with 3.5 m at 95 %", "m", 0, 1000
    )
    common_sigma_m: float = parameter(0.0, "standard deviation of the error that all receivers share", "m", 0, 1000)
    gap_s: float = parameter(5.0, "a landmark without planned waypoints ends after this dropout", "s", 0, 3600)
    drift_m_s: float = parameter(0.5, "growth of the position's uncertainty during a dropout", "m/s", 0, 100)
    height_m: float = parameter(0.0, "height of the colour (or of the point given in pixels) above ground", "m", 0, 20)
    length_m: float = parameter(
        4.0, "largest length of a moving blob at the colour that is the landmark and not a target", "m", 0.1, 50
    )
    least: int = parameter(4, "number of landmarks used if detection is good (4-or-more rule)", "landmarks", 4, 64)
    rule: Literal["all", "source"] = parameter(
        "all", "all: use every landmark; source: use more than `least` only if detection is poor"
    )
    poor_speed_m_s: float = parameter(
        2.0, "source rule: detection is poor if landmarks move faster than this on average", "m/s", 0, 100
    )


class AerialParameters(Group):
    """Georeferencing of the picture from the air by landmarks and telemetry (appendix A, IV-B)."""

    mode: Literal["pose", "homography", "paper"] = parameter(
        "pose", "pose: from landmarks and telemetry; homography: landmarks only; paper: as printed, in degrees"
    )
    hfov_deg: float = parameter(
        70.0, "field of view if camera and telemetry give none; as a default, of the longer side", "deg", 1, 170
    )
    pitch_deg: float = parameter(
        90.0, "pitch below the horizon if camera and telemetry give none; 90 is straight down", "deg", -90, 90
    )
    focal_sigma: float = parameter(
        0.01, "relative standard deviation of a given focal length, unless the camera's file gives it", "-", 0, 1
    )
    focal_guess_sigma: float = parameter(0.2, "relative standard deviation of a focal length from hfov_deg", "-", 0, 1)
    tilt_sigma_deg: float = parameter(1.0, "standard deviation of the reported tilt, per axis", "deg", 0, 90)
    tilt_guess_sigma_deg: float = parameter(15.0, "standard deviation of the tilt if pitch_deg is used", "deg", 0, 180)
    heading_sigma_deg: float = parameter(5.0, "standard deviation of the reported heading", "deg", 0, 180)
    heading_offset_deg: float = parameter(
        0.0,
        "added to the log's headings, clockwise: declination (east positive) or how the camera is mounted",
        "deg",
        -180,
        180,
    )
    pitch_offset_deg: float = parameter(
        0.0, "added to the log's pitch, downwards: how the camera is mounted in its gimbal", "deg", -90, 90
    )
    course_sigma_deg: float = parameter(
        10.0, "standard deviation of a heading that is taken from the vehicle's nose or course", "deg", 0, 180
    )
    altitude_sigma: float = parameter(0.02, "relative standard deviation of the altitude", "-", 0, 10)
    altitude_sigma_m: float = parameter(0.0, "additional standard deviation of the altitude", "m", 0, 1000)
    datum_sigma_m: float = parameter(
        0.0, "standard deviation of the offset between the height datums of vehicle and ground", "m", 0, 1000
    )
    terrain_sigma_m: float = parameter(
        0.0, "standard deviation of the ground's height at a target, for level ground or elevation data", "m", 0, 1000
    )
    geoid: str = parameter("", "raster file of geoid heights above the ellipsoid; empty: a coarse table of EGM96")
    grid: Literal["", "mgrs", "utm"] = parameter("", "grid of additional coordinates in positions.csv; empty: none")
    position_sigma_m: float = parameter(
        1.43, "standard deviation of the vehicle's position, east and north: 3.5 m at 95 %", "m", 0, 1000
    )
    target_sigma_px: float = parameter(1.0, "standard deviation of a target's position in the picture", "px", 0, 100)
    own_sigma: float = parameter(0.13, "additional sigma for targets that dddas detected, in box sides", "sides", 0, 2)
    point: Literal["auto", "centre", "foot"] = parameter(
        "auto",
        "point of a box that is on the ground: centre or foot; auto: the table's feet, the foot for tables of dddas, "
        "else the centre",
    )
    shadows: bool = parameter(False, "blobs are bodies with shadows: the foot is found from the sun's direction")
    sun_azimuth_deg: float = parameter(0.0, "direction of the sun, clockwise from north", "deg", 0, 360)
    sun_height_deg: float = parameter(
        0.0, "elevation of the sun; 0: from the telemetry's clock, no shadows without a clock", "deg", 0, 90
    )
    target_height_m: float = parameter(1.7, "height of a target: its centre and its shadow depend on it", "m", 0, 100)
    gate_probability: float = parameter(0.999, "share of correct landmarks that pass the test", "-", 0.5, 0.999999)
    correlation_s: float = parameter(
        20.0, "correlation time of telemetry and receiver errors; 0: independent in each frame", "s", 0, 10000
    )
    least_spread: float = parameter(0.02, "landmarks with a smaller ratio of width to length are collinear", "-", 0, 1)
    clock_offset_s: float = parameter(
        0.0, "added to times of telemetry and landmarks to give clip times", "s", -1e6, 1e6
    )
    time_zone: str = parameter(
        "", "time zone of a log with local times: a name, Europe/Berlin, or hours from UTC, +02:00"
    )
    order: Literal["auto", "lat-lon", "lon-lat"] = parameter(
        "auto", "order of two coordinates in one field of a log, GPS(48.1, 11.5); auto: the order of its program"
    )


class CrowdParameters(Group):
    """Joining moving targets that move together to crowds."""

    join_m: float = parameter(
        0.0, "targets located from the air with gaps up to this become one crowd; 0: off", "m", 0, 100
    )
    speed_m_s: float = parameter(1.5, "largest velocity difference over ground within a crowd", "m/s", 0.01, 100)
