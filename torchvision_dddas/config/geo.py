"""Parameters of places on the ground: from the ground, from the air, of landmarks and crowds."""

from typing import Literal

from torchvision_dddas.config.group import Group, parameter


class GroundParameters(Group):
    """Where people stand, seen from the ground (appendix A, IV-C), and which of several sightings are one person."""

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


class LandmarkParameters(Group):
    """How ground vehicles serve as landmarks: found by colour, separated from targets, tracked (appendix A, IV-A)."""

    differentiation: Literal["exact", "greedy"] = parameter(
        "exact", "assignment of blobs to landmarks: most pairs at the least distance, or greedy"
    )
    centre: Literal["motion", "colour"] = parameter(
        "motion", "position of a landmark with a blob: the blob's centre, or the colour's (if in the vehicle's middle)"
    )
    reach_px: float = parameter(40.0, "largest distance between a landmark's colour and its blob", "px", 0, 10000)
    interval_frames: int = parameter(
        10, "frames between two separations of landmarks from targets (tracking interval)", "frames", 1, 10000
    )
    least_area_px: int = parameter(12, "smaller patches of colour are ignored", "px", 1, 1_000_000)
    pixel_sigma: float = parameter(1.0, "standard deviation of a landmark's position in the picture", "px", 0.01, 100)
    sigma_m: float = parameter(
        1.43, "standard deviation of a landmark's report where none is given: GPS with 3.5 m at 95 %", "m", 0, 1000
    )
    common_sigma_m: float = parameter(0.0, "sigma of the error common to all receivers of the team", "m", 0, 1000)
    gap_s: float = parameter(5.0, "a landmark ends after such a dropout without planned waypoints", "s", 0, 3600)
    drift_m_s: float = parameter(0.5, "growth of the position's uncertainty during a dropout", "m/s", 0, 100)
    height_m: float = parameter(0.0, "height of the colour (or of the point given in pixels) above ground", "m", 0, 20)
    length_m: float = parameter(
        4.0, "vehicle length: a moving blob at its colour up to this length is the landmark, not a target", "m", 0.1, 50
    )
    least: int = parameter(4, "number of landmarks used where detection is good (4-or-more rule)", "landmarks", 4, 64)
    rule: Literal["all", "source"] = parameter(
        "all", "all: use every landmark; source: use more than `least` only where detection is poor"
    )
    poor_speed_m_s: float = parameter(
        2.0, "source rule: detection is poor if landmarks move faster than this on average", "m/s", 0, 100
    )


class AerialParameters(Group):
    """How the picture from the air is georeferenced by landmarks and telemetry (appendix A, IV-B)."""

    mode: Literal["pose", "homography", "paper"] = parameter(
        "pose", "pose: from landmarks and telemetry; homography: landmarks only; paper: as printed, in degrees"
    )
    hfov_deg: float = parameter(
        70.0, "field of view where camera and telemetry give none; of the longer side unless set", "deg", 1, 170
    )
    pitch_deg: float = parameter(
        90.0, "angle of the optical axis below the horizon if neither gives it; 90 is straight down", "deg", -90, 90
    )
    focal_sigma: float = parameter(
        0.01, "relative standard deviation of a given focal length, unless the camera's file gives it", "-", 0, 1
    )
    focal_guess_sigma: float = parameter(0.2, "relative sigma of a focal length that follows from hfov_deg", "-", 0, 1)
    tilt_sigma_deg: float = parameter(1.0, "standard deviation of the reported tilt, per axis", "deg", 0, 90)
    tilt_guess_sigma_deg: float = parameter(15.0, "standard deviation of the tilt if pitch_deg is used", "deg", 0, 180)
    heading_sigma_deg: float = parameter(5.0, "standard deviation of the reported heading", "deg", 0, 180)
    course_sigma_deg: float = parameter(
        10.0, "sigma of a camera's heading that is taken from the vehicle's nose or course", "deg", 0, 180
    )
    altitude_sigma: float = parameter(0.02, "relative standard deviation of the altitude", "-", 0, 10)
    altitude_sigma_m: float = parameter(0.0, "standard deviation added to it, in metres", "m", 0, 1000)
    position_sigma_m: float = parameter(
        1.43, "standard deviation of the vehicle's position, east and north: 3.5 m at 95 %", "m", 0, 1000
    )
    target_sigma_px: float = parameter(1.0, "standard deviation of a target's position in the picture", "px", 0, 100)
    own_sigma: float = parameter(0.13, "additional sigma for targets that dddas detected, in box sides", "sides", 0, 2)
    point: Literal["auto", "centre", "foot"] = parameter(
        "auto",
        "point of a box on the ground: centre, foot, or auto: the table's feet, the foot for tables of dddas, "
        "else the centre",
    )
    shadows: bool = parameter(False, "blobs are bodies with shadows: the foot is found from the sun's direction")
    sun_azimuth_deg: float = parameter(0.0, "direction of the sun, clockwise from north", "deg", 0, 360)
    sun_height_deg: float = parameter(
        0.0, "elevation of the sun; 0: from the telemetry's clock, no shadows without a clock", "deg", 0, 90
    )
    target_height_m: float = parameter(1.7, "height of the body whose foot is wanted", "m", 0, 100)
    gate_probability: float = parameter(0.999, "share of right landmarks that pass the test", "-", 0.5, 0.999999)
    correlation_s: float = parameter(
        20.0, "correlation time of telemetry and receiver errors; 0: independent in each frame", "s", 0, 10000
    )
    least_spread: float = parameter(0.02, "landmarks of a smaller width over length count as collinear", "-", 0, 1)
    clock_offset_s: float = parameter(0.0, "added to times of telemetry and landmarks: the clip's time", "s", -1e6, 1e6)
    time_zone: str = parameter(
        "", "of a log whose dates are in local time: a name, Europe/Berlin, or hours from UTC, +02:00"
    )
    order: Literal["auto", "lat-lon", "lon-lat"] = parameter(
        "auto", "of two coordinates in one field of a log, GPS(48.1, 11.5); auto: as its program writes them"
    )


class CrowdParameters(Group):
    """Moving targets that go together as one crowd."""

    join_m: float = parameter(
        0.0, "targets located from the air with gaps up to this are one crowd; 0: off", "m", 0, 100
    )
    speed_m_s: float = parameter(1.5, "largest velocity difference over ground within a crowd", "m/s", 0.01, 100)
