"""Reports are continued beyond the newest one, with standard deviations that cover what happens."""

import numpy as np
import pytest

from torchvision_dddas.config import AerialParameters
from torchvision_dddas.geo.flight_prediction import predict_flight
from torchvision_dddas.types import Flight, Telemetry

AERIAL = AerialParameters()


def at(log: Telemetry, time_s: float) -> Flight:
    flight = log.at(time_s)
    assert flight is not None
    return flight


def flight(
    until_s: float, turn_deg_s: float = 0.0, speed_m_s: float = 15.0, rate_hz: float = 10.0, **more
) -> Telemetry:
    """A vehicle that flies a circle, or straight to the north."""
    time = np.arange(0.0, until_s + 1e-6, 1 / rate_hz)
    heading = np.radians(turn_deg_s) * time
    if turn_deg_s:
        radius = speed_m_s / np.radians(turn_deg_s)
        place = radius * np.c_[1 - np.cos(heading), np.sin(heading)]
    else:
        place = np.c_[0 * time, speed_m_s * time]
    flat = {"pitch_rad": np.ones_like(time), "roll_rad": 0 * time, "heading_rad": heading % (2 * np.pi)}
    return Telemetry(time, 50 + 0 * time, speed_m_s + 0 * time, geographic=False, **({"place": place} | flat | more))


@pytest.mark.parametrize("turn_deg_s", [0.0, 10.0])
def test_a_place_is_continued_along_the_flight_and_its_sigma_covers_the_error(turn_deg_s):
    longer, made = flight(32.0, turn_deg_s), predict_flight(flight(30.0, turn_deg_s), AERIAL)
    assert made.time_s[-1] == pytest.approx(32.0)
    for ahead_s in (0.2, 1.0, 2.0):
        truth, found = at(longer, 30 + ahead_s), at(made, 30 + ahead_s)
        off_m = np.hypot(*np.subtract(found.place, truth.place))
        # The rate over the last second is half a second old.
        assert off_m <= 1.05 * 15 * np.radians(turn_deg_s) * (ahead_s + 1) * ahead_s / 2 + 1e-6
        assert off_m < 3 * found.position_sigma_m
        assert found.position_sigma_m > AERIAL.position_sigma_m
        turned = (found.heading_rad - truth.heading_rad + np.pi) % (2 * np.pi) - np.pi
        assert abs(turned) < 3 * found.heading_sigma_rad


def test_the_record_itself_keeps_its_values_and_standard_deviations():
    log = flight(30.0)
    made = predict_flight(log, AERIAL)
    before = made[: len(log)]
    np.testing.assert_array_equal(before.place, log.place)
    np.testing.assert_array_equal(before.time_s, log.time_s)
    np.testing.assert_allclose(before.position_sigma_m, AERIAL.position_sigma_m)
    np.testing.assert_allclose(before.altitude_sigma_m, AERIAL.altitude_sigma * 50)
    np.testing.assert_allclose(before.tilt_sigma_rad, np.radians(AERIAL.tilt_sigma_deg))
    assert (np.diff(made.position_sigma_m[len(log) :]) > 0).all()


def test_a_slower_quantity_is_continued_from_its_own_last_report():
    log = flight(30.0)
    place = log.place.copy()
    place[-5:] = place[-6]  # the last half second repeats the last known place
    made = predict_flight(flight(30.0, place=place), AERIAL)
    np.testing.assert_allclose(at(made, 30.0).place, (0, 450), atol=0.1)
    np.testing.assert_allclose(at(made, 31.0).place, (0, 465), atol=0.2)


def test_what_is_unknown_stays_unknown_and_so_does_what_is_over_for_long():
    pitch = np.where(np.arange(301) < 250, 1.0, np.nan)
    made = predict_flight(flight(30.0, pitch_rad=pitch, roll_rad=np.full(301, np.nan)), AERIAL)
    assert (
        np.isnan(made.roll_rad).all()
        and np.isnan(made.pitch_rad[-8:]).all()
        and np.isnan(made.tilt_sigma_rad[-8:]).all()
    )


def test_a_standing_camera_stays_where_it_is():
    made = predict_flight(flight(30.0, speed_m_s=0.0), AERIAL)
    assert at(made, 31.0).place == (0, 0) and at(made, 31.0).position_sigma_m < 2 * AERIAL.position_sigma_m


@pytest.mark.parametrize(("rate_hz", "reach_s"), [(10.0, 2.0), (1.0, 3.0), (0.2, 6.0)])
def test_slow_reports_are_continued_for_longer(rate_hz, reach_s):
    log = flight(30.0, rate_hz=rate_hz)
    assert predict_flight(log, AERIAL).time_s[-1] - log.time_s[-1] == pytest.approx(reach_s)


def test_a_young_flight_has_the_growth_of_an_unknown_one():
    made = predict_flight(flight(0.5), AERIAL)
    assert at(made, 1.5).position_sigma_m == pytest.approx(np.hypot(AERIAL.position_sigma_m, 2.0), rel=0.02)


def test_a_flood_of_reports_predicts_the_same_from_a_few_hundred_of_them(monkeypatch):
    shapes, whole = list[int](), np.linalg.norm

    def norm(values, **more):
        shapes.append(len(values))
        return whole(values, **more)

    monkeypatch.setattr(np.linalg, "norm", norm)
    made, few = predict_flight(flight(30.0, 10.0, rate_hz=1000.0), AERIAL), predict_flight(flight(30.0, 10.0), AERIAL)
    assert max(shapes) < 1000
    for ahead_s in (0.5, 2.0):
        found, wanted = at(made, 30 + ahead_s), at(few, 30 + ahead_s)
        np.testing.assert_allclose(found.place, wanted.place, atol=0.05)
        assert found.position_sigma_m == pytest.approx(wanted.position_sigma_m, rel=0.05)
