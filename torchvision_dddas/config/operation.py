"""Parameters of confirmation from the ground, of steering, of live runs and of 16-bit grey levels."""

from pydantic import model_validator

from torchvision_dddas.config.group import Group, parameter


class ConfirmParameters(Group):
    """Confirmation of blobs seen from the air by people seen from the ground: two fidelities (appendix A, III-B)."""

    gate_probability: float = parameter(
        0.99, "share of people inside the gate of their blob, which both covariances define", "-", 0.5, 0.9999
    )
    spread_m: float = parameter(
        0.5, "standard deviation of people around the position of their blob, which may be a crowd", "m", 0, 20
    )
    unknown_sigma_m: float = parameter(2.0, "standard deviation of positions without covariance", "m", 0.01, 100)
    inside_sigmas: float = parameter(2.0, "margin of a blob inside a view, in its standard deviations", "-", 0, 10)
    body_width_m: float = parameter(0.6, "nearer objects within this distance of the line of sight occlude", "m", 0, 10)
    least_score: float = parameter(0.5, "people of a lower probability are no evidence about their blob", "-", 0.5, 1)
    detection_rate: float = parameter(
        0.7, "share of observations of people in which a person is recognized", "-", 0.01, 0.999
    )
    false_rate: float = parameter(
        0.05, "share of observations of other blobs with a recognized person", "-", 0.001, 0.99
    )
    crowd_share: float = parameter(
        0.5, "in pictures: detection rate of people in a crowd, relative to that of a single person", "-", 0, 1
    )
    prior: float = parameter(0.5, "share of blobs that are people", "-", 0.01, 0.99)
    fresh: float = parameter(0.3, "weight of a vehicle's repeated observation: its errors are correlated", "-", 0, 1)
    limit: float = parameter(7.0, "largest absolute log-odds, so that later observations still count", "-", 0.5, 50)
    share: float = parameter(
        0.5, "in pictures: smallest intersection of a person and a blob, as a share of the smaller box", "-", 0.01, 1
    )


class SteeringParameters(Group):
    """Control of the vehicles by the results, in a run whose source can be steered."""

    on: bool = parameter(True, "steer the vehicles; false flies as planned")
    sampling: bool = parameter(False, "process every k-th frame, k from the interval rule; needs a clip in order")
    sampling_share: float = parameter(0.5, "k divided by the rule's interval (before its bounds)", "-", 0.01, 10)
    least_move_px: float = parameter(3.0, "a walker moves by at least this between processed frames", "px", 0, 100)
    maximum_every: int = parameter(8, "largest k, however slow the scene", "frames", 1, 60)
    follow: bool = parameter(True, "the UAV keeps the crowds in view; false flies as planned")
    look: bool = parameter(True, "UGVs drive to targets that need a closer look; false drives as planned")
    fast_m_s: float = parameter(3.0, "speed of a UGV far from its goal", "m/s", 0, 30)
    slow_m_s: float = parameter(1.0, "speed of a UGV near its goal: its motion degrades its position", "m/s", 0, 30)
    near_m: float = parameter(6.0, "distance to the goal that counts as near", "m", 0, 1000)
    station_m: float = parameter(12.0, "distance of UGVs from the crowd they observe", "m", 2, 1000)
    look_m: float = parameter(14.0, "largest distance at which a UGV recognizes people: bodies of 64 px", "m", 1, 1000)
    picture_s: float = parameter(1.0, "time between two pictures of one UGV", "s", 0.01, 3600)
    maximum_altitude_m: float = parameter(0.0, "largest UAV altitude; 0: twice the initial altitude", "m", 0, 10_000)


class LiveParameters(Group):
    """A run that must keep up with a camera."""

    pace: float = parameter(1.0, "playback speed of a file over real time; 0: as fast as possible", "-", 0, 1000)
    queue_frames: int = parameter(2, "frames that may wait; beyond that the oldest is dropped", "frames", 1, 64)
    deadline_ms: float = parameter(80.0, "largest latency from camera to results without look-ahead", "ms", 1, 60_000)
    shed: bool = parameter(True, "reduce the load when processing is too slow; false drops frames instead")
    load: float = parameter(0.85, "largest processing time, as a share of the time between frames", "-", 0.1, 1)
    calm_s: float = parameter(5.0, "time with spare capacity after which the load is raised again", "s", 0.1, 600)
    least_keypoints: int = parameter(80, "smallest number of keypoints under load", "-", 16, 10_000)
    maximum_every: int = parameter(8, "process at least one of this many frames under load", "frames", 1, 60)
    stall_s: float = parameter(5.0, "a stream without frames for this long counts as lost", "s", 0.1, 600)
    retry_s: float = parameter(0.5, "first delay before a lost stream is opened again; then it doubles", "s", 0.01, 600)
    retry_most_s: float = parameter(5.0, "longest delay before a lost stream is opened again", "s", 0.01, 3600)
    lost_s: float = parameter(40.0, "a camera lost for this time ends the run (exit code 70); 0: never", "s", 0, 86_400)
    watchdog_s: float = parameter(30.0, "a step that takes longer counts as hung; 0: no watchdog", "s", 0, 3600)
    status_s: float = parameter(2.0, "time between two writes of the status and the results", "s", 0.1, 600)
    clip_s: float = parameter(5.0, "time before and after an event in a clip of --save clips", "s", 0, 60)

    @model_validator(mode="after")
    def _pauses_grow(self) -> "LiveParameters":
        if self.retry_most_s < self.retry_s:
            raise ValueError(f"retry_most_s = {self.retry_most_s:g} is below retry_s = {self.retry_s:g}")
        return self


class LevelParameters(Group):
    """Conversion of 16-bit pictures, such as those of thermal cameras, to 8 bits."""

    black: int = parameter(0, "value that becomes black; both 0: taken from the clip", "counts", 0, 65535)
    white: int = parameter(0, "value that becomes white", "counts", 0, 65535)

    @property
    def given(self) -> tuple[int, int] | None:
        """Black and white for `open_video`; None if they are taken from the clip."""
        return (self.black, self.white) if self.white else None
