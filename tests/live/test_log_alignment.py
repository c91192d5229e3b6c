"""A stored log is aligned with live pictures by the clock, or refused."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.log_alignment import align_log, describe_landmarks, describe_log
from torchvision_dddas.live.runner import Feed
from torchvision_dddas.live.watchdog import Watchdog
from torchvision_dddas.types import Frame, Landmarks, Telemetry

NOW_S = 1.7e9
PICTURE = np.zeros((4, 4), np.uint8)


def log(begins_s: float = -10.0, seconds: float = 60.0, has_clock: bool = True, offset_s: float = 0.0) -> Telemetry:
    """A log of one sample a second, as a reader makes it; its altitude is the seconds since NOW_S + 1000 m."""
    utc_s = NOW_S + begins_s + np.arange(0.0, seconds + 1)
    start_utc_s = utc_s[0] - offset_s if has_clock else float("nan")
    return Telemetry(
        utc_s - utc_s[0] + offset_s, 1000 + utc_s - NOW_S, np.full(len(utc_s), 5.0), start_utc_s=start_utc_s
    )


@pytest.mark.parametrize(
    ("begins_s", "ends_s", "is_refused"),
    [
        (-1500, -1440, True),
        (-200, -61, True),
        (-86_400 * 365, -86_400 * 364.9, True),
        (-200, -59, False),
        (-1440, 60, False),  # old at its beginning, and still going on
        (-5, 5, False),
        (0, 60, False),
        (30, 90, False),
        (86_400, 86_460, False),
    ],
)
@pytest.mark.parametrize("offset_s", [0.0, 3.0])
def test_a_log_that_ended_a_minute_before_the_first_picture_is_refused_beside_a_camera(
    begins_s, ends_s, is_refused, offset_s
):
    given = log(begins_s, ends_s - begins_s, offset_s=offset_s)
    if is_refused:
        with pytest.raises(InputError, match=r"before the first picture \(2023-11-14T22:13:20\.000Z"):
            describe_log(given, False, NOW_S, 0.0)
    else:
        note = describe_log(given, False, NOW_S, offset_s)
        assert "aligned by the clock" in note
        assert ("nothing is located by it" in note) == (not begins_s + offset_s <= 0 <= ends_s + offset_s)
    assert "this is a recording" in describe_log(given, True, NOW_S, offset_s)


@pytest.mark.parametrize(("days", "is_refused"), [(365.0, True), (1.0, True), (0.4, False), (-1.0, False)])
def test_a_log_whose_dates_lack_a_zone_is_refused_beside_a_camera_where_no_zone_makes_it_current(days, is_refused):
    given = replace(log(-1500, 60, has_clock=False), latest_utc_s=NOW_S - 86_400 * days + 43_200)
    if is_refused:
        with pytest.raises(InputError, match="by its dates, which lack a time zone: its places are not current"):
            describe_log(given, False, NOW_S, 0.0)
    else:
        assert "gives no time of day" in describe_log(given, False, NOW_S, 0.0)
    assert "this is a recording" in describe_log(given, True, NOW_S, 0.0)


def test_a_log_without_a_clock_is_said_to_count_from_the_first_picture_of_a_camera():
    given = log(-1500, 60, has_clock=False)
    assert "gives no time of day: its time 0 is taken as the first picture's" in describe_log(given, False, NOW_S, 0.0)
    assert describe_log(given, True, NOW_S, 0.0) == "times of day are those of playing it: this is a recording"


@pytest.mark.parametrize("offset_s", [0.0, 0.3, -2.0])
@pytest.mark.parametrize("begins_s", [-1000.0, -10.0, 0.5])
def test_a_picture_gets_the_sample_of_its_exposure(begins_s, offset_s):
    aligned = align_log(log(begins_s, 2000, offset_s=offset_s), NOW_S, offset_s)
    # A picture that comes 20 s after the first was exposed offset_s earlier.
    flight = aligned.at(20.0)
    assert flight is not None and flight.altitude_m == pytest.approx(1000 + 20.0 - offset_s, abs=1e-3)
    again = align_log(aligned, NOW_S, offset_s)
    np.testing.assert_allclose(again.time_s, aligned.time_s, atol=1e-6)


class Camera:
    """Frames at 10 Hz; the machine's clock is set before one of them."""

    name, rate_hz, size, last = "camera", 10.0, (4, 4), 0

    def __init__(self, start_utc_s: float, count: int, set_at: int = 0, by_s: float = 0.0) -> None:
        self.start_utc_s, self.count, self.set_at, self.by_s = start_utc_s, count, set_at, by_s

    def __iter__(self):
        for number in range(1, self.count + 1):
            if number == self.set_at:
                self.start_utc_s += self.by_s
            yield Frame(number, (number - 1) / 10, PICTURE)


def feed_of(camera: Camera, telemetry: Telemetry, clock_offset_s: float = float("nan")) -> tuple[Feed, Health]:
    source: Any = camera
    health = Health()
    feed = Feed(source, health, Watchdog(health, 0), telemetry)
    feed.clock_offset_s = clock_offset_s
    return feed, health


def altitudes(feed: Feed) -> list[float | None]:
    """What the pipeline reads of the log at each frame."""
    assert feed.telemetry is not None
    flights = [feed.log.at(frame.time_s) for frame in feed if feed.log is not None and feed.telemetry() is feed.log]
    return [None if flight is None else float(flight.altitude_m) for flight in flights]


def test_a_camera_sees_the_log_by_the_clock_and_follows_a_clock_that_is_set():
    feed, health = feed_of(Camera(NOW_S - 3600, 40, set_at=21, by_s=3600), log(-10, 60), clock_offset_s=0.0)
    taken: list[Telemetry] = []
    feed.aligned = taken.append
    seen = altitudes(feed)
    assert seen[:20] == [None] * 20  # by the wrong clock the log is of the future
    assert seen[20:] == pytest.approx([1000 + n / 10 for n in range(20, 40)], abs=1e-3)
    assert len(taken) == 2 and taken[-1] is feed.log
    texts = [event.text for event in health.snapshot().events]
    assert texts == ["telemetry is silent", "telemetry is there again"]


def test_a_recording_counts_from_its_first_picture_whatever_the_clock():
    feed, _ = feed_of(Camera(NOW_S, 3), log(-1500, 60))
    aligned: list[Telemetry] = []
    feed.aligned = aligned.append
    assert altitudes(feed) == pytest.approx([-500, -499.9, -499.8]) and not aligned


def test_a_log_that_ends_before_the_run_is_a_trouble_that_says_so():
    feed, health = feed_of(Camera(NOW_S, 40), log(-10, 11), clock_offset_s=0.0)
    list(feed)
    assert health.snapshot().troubles == ("telemetry is silent: its log has ended",)


@pytest.mark.parametrize(
    ("places", "is_noted"),
    [
        ([(0, 0), (0, 0)], False),
        ([(0, 0), (np.nan, np.nan)], False),
        ([(0, 0), (1, 0)], True),
        ([(np.nan, np.nan)] * 2, False),
    ],
)
def test_landmarks_that_move_are_noted(places, is_noted):
    two, none = np.ones(2), np.full((2, 2), np.nan)
    marks = Landmarks(("a",), two, np.zeros(2, int), none, np.array(places, float), two, two == 0, two.astype(int))
    assert bool(describe_landmarks(marks)) == is_noted
    assert describe_landmarks(marks[:0]) == []
