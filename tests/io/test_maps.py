"""Maps for other tools: GeoJSON, KML, Cursor-on-Target, and the ellipses that they show."""

import json
from dataclasses import replace
from datetime import datetime
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.io.ground import NAMES, ORIGIN, START, positions, tracks
from torchvision_dddas import geometry
from torchvision_dddas.io.maps.formats import UNKNOWN, cot, ellipses_geojson, encode_geojson, geojson, kml, xml_text
from torchvision_dddas.io.maps.ground_tracks import CHI2_95, cut_line, ellipse_rows, ring_about, ring_m, semi_axes
from torchvision_dddas.io.output import GroundRecorder
from torchvision_dddas.types import GroundLocations, Sightings

DATE_LINE = (179.9999, -17.0)
"""180 degrees are 10.6 m east of it."""
UNCLOCKED = {"start_utc_s": float("nan")}


def walk(count=30, origin=ORIGIN, covariance=((4, 0), (0, 1)), step=1.0):
    return [positions(k + 1, [[step * k, 0], [0, -k]], covariance, origin) for k in range(count)]


def signed_area(ring):
    x, y = (np.array(ring) - ring[0])[:, :2].T
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum() / 2)


@pytest.mark.parametrize("make", [geojson, ellipses_geojson, kml, cot])
def test_no_positions_are_a_valid_map_and_local_metres_are_refused(make):
    assert make(tracks([]))
    with pytest.raises(ValueError, match="no longitude"):
        make(tracks(walk(origin=None)))
    for unclocked in (tracks(walk(), **UNCLOCKED), tracks(walk(), timed=False)):
        with pytest.raises(ValueError, match="no clock"):
            cot(unclocked)


# --------------------------------------------------------------------------------------------------------------------
# GeoJSON.


def features(*given, make=geojson, **rest):
    return json.loads(encode_geojson(make(*given, **rest)))["features"]


def places(found):
    return [found] if isinstance(found[0], (int, float)) else [p for part in found for p in places(part)]


def test_a_track_has_its_frames_times_and_errors_beside_its_places():
    one, _ = features(tracks(walk(), START + 0.0004))  # times are read to the millisecond
    shape, properties = one["geometry"], one["properties"]
    assert shape["type"] == "LineString" and properties["target"] == 1 and properties["frames"] == list(range(1, 31))
    assert len(shape["coordinates"]) == len(properties["times"]) == 30
    assert properties["times"][:2] == ["2020-09-13T12:26:40.250Z", "2020-09-13T12:26:40.350Z"]
    assert properties["sigma_m"][0] == pytest.approx(np.sqrt(5), abs=1e-3)
    assert shape["coordinates"][0] == pytest.approx(ORIGIN)
    seconds, none = (features(tracks(walk(), **how))[0]["properties"] for how in (UNCLOCKED, {"timed": False}))
    assert seconds["seconds"][:3] == [0, 0.1, 0.2] and "times" not in seconds
    assert not {"seconds", "times"} & none.keys()


def test_ellipses_are_polygons_of_95_percent_where_the_error_is_known_and_landmarks_are_named():
    found = features(tracks(walk()), make=ellipses_geojson)
    assert [f["properties"]["frame"] for f in found if f["properties"]["target"] == 2] == [1, 11, 21, 30]
    properties = found[-1]["properties"]
    assert (properties["semi_major_m"], properties["semi_minor_m"]) == pytest.approx((4.8955, 2.4477), abs=1e-3)
    assert properties["bearing_deg"] == 90 and properties["time"].startswith("2020-09-13T12:26:43.15")
    (ring,) = found[-1]["geometry"]["coordinates"]
    assert ring[0] == ring[-1] and signed_area(ring) > 0
    unknown = tracks(walk(covariance=np.full((2, 2), np.nan)))
    assert features(unknown, make=ellipses_geojson) == []
    assert features(unknown)[0]["properties"]["sigma_m"][0] is None
    mark = features(tracks(walk()), landmarks=tracks([positions(1, [[5, 5]], target=[3])]), names=NAMES)[-1]
    assert mark["properties"]["landmark"] == "delta & <co>" and mark["geometry"]["type"] == "Point"


@pytest.mark.parametrize(
    ("origin", "make"), [(ORIGIN, geojson), (DATE_LINE, geojson), ((-180.0, 60.0), ellipses_geojson)]
)
def test_the_box_holds_all_places_also_over_180_degrees(origin, make):
    found = make(tracks(walk(origin=origin, step=5.0)))
    west, south, east, north = found["bbox"]
    assert (west > east) == (origin != ORIGIN)
    for feature in found["features"]:
        for longitude, latitude in places(feature["geometry"]["coordinates"]):
            assert south <= latitude <= north and abs(longitude) <= 180
            assert west <= longitude <= east if west <= east else longitude >= west or longitude <= east
    kinds = {feature["geometry"]["type"] for feature in found["features"]}
    assert any(kind.startswith("Multi") for kind in kinds) == (origin != ORIGIN)


# --------------------------------------------------------------------------------------------------------------------
# KML.

KML, GX = "{http://www.opengis.net/kml/2.2}", "{http://www.google.com/kml/ext/2.2}"


def read_kml(*given, **rest):
    return ElementTree.fromstring(kml(*given, **rest).encode())


def marks_of(root, name):
    folders = [f for f in root.iter(f"{KML}Folder") if f.findtext(f"{KML}name") == name]
    return folders[0].findall(f"{KML}Placemark") if folders else []


def test_places_and_ellipses_of_a_track_have_times():
    one, two = marks_of(read_kml(tracks(walk())), "tracks")
    track = one.find(f"{GX}Track")
    assert track is not None and two.findtext(f"{KML}name") == "target 2"
    assert [e.tag for e in track] == [f"{KML}altitudeMode", *[f"{KML}when"] * 30, *[f"{GX}coord"] * 30]
    assert track[2].text == "2020-09-13T12:26:40.350Z"
    assert [float(v) for v in (track[31].text or "").split()] == pytest.approx([*ORIGIN, 0])
    found = marks_of(read_kml(tracks(walk())), "95 % ellipses")
    assert found[1].findtext(f"{KML}TimeStamp/{KML}when") == "2020-09-13T12:26:41.250Z"
    for mark in found:
        text = mark.findtext(f"{KML}Polygon/{KML}outerBoundaryIs/{KML}LinearRing/{KML}coordinates") or ""
        ring = [[float(v) for v in place.split(",")] for place in text.split()]
        assert ring[0] == ring[-1] and signed_area(ring) > 0


def test_without_a_clock_a_track_is_a_line_and_has_only_its_last_ellipse():
    root = read_kml(tracks(walk(), **UNCLOCKED))
    assert not list(root.iter(f"{KML}when"))
    line = (marks_of(root, "tracks")[0].findtext(f"{KML}LineString/{KML}coordinates") or "").split()
    assert len(line) == 30 and [float(v) for v in line[0].split(",")] == pytest.approx([*ORIGIN, 0])
    names = [m.findtext(f"{KML}name") for m in marks_of(root, "95 % ellipses")]
    assert names == ["target 1, frame 30", "target 2, frame 30"]


def test_the_document_follows_the_schema_has_its_styles_and_keeps_names():
    marks = tracks([positions(1, [[5, 5]], target=[3])])
    root = read_kml(tracks(walk()), name='a "<clip>" & \x00more', landmarks=marks, names=NAMES)
    order = ["name", "description", "TimeStamp", "styleUrl", "geometry"]
    for mark in root.iter(f"{KML}Placemark"):
        names = [e.tag.split("}")[1] for e in mark]
        ranks = [order.index(n) if n in order else 4 for n in names]
        assert ranks == sorted(ranks) and ranks[-1] == 4
    kinds = [e.tag for e in root[0]]
    assert kinds == sorted(kinds, key=[f"{KML}name", f"{KML}Style", f"{KML}Folder"].index)
    assert {e.text for e in root.iter(f"{KML}styleUrl")} == {f"#{e.get('id')}" for e in root.iter(f"{KML}Style")}
    assert root[0].findtext(f"{KML}name") == 'a "<clip>" & more'
    assert marks_of(root, "landmarks")[0].findtext(f"{KML}name") == "delta & <co>"
    assert xml_text("a\x0bb\ud800\uffff") == "ab"


def test_a_track_over_180_degrees_is_several_whose_places_are_all_there():
    pieces = marks_of(read_kml(tracks(walk(origin=DATE_LINE))), "tracks")[0].findall(f"{GX}MultiTrack/{GX}Track")
    longitudes = [[float((e.text or "").split()[0]) for e in piece.findall(f"{GX}coord")] for piece in pieces]
    assert len(pieces) == 2 and sum(map(len, longitudes)) == 30 and all(np.ptp(part) < 1 for part in longitudes)
    root = read_kml(tracks(walk(origin=DATE_LINE), **UNCLOCKED))
    assert len(marks_of(root, "tracks")[0].findall(f"{KML}MultiGeometry/{KML}LineString")) == 2


def test_people_located_from_the_ground_are_written_too(tmp_path):
    none = np.zeros(0)
    places = np.zeros((0, 2))
    sightings = Sightings(places, none, none, none, np.zeros((0, 2, 2)), places, np.zeros((0, 2, 6)))
    with GroundRecorder(tmp_path) as output:
        output.begin({}, ("a",), True)
        for frame in walk(3):
            rest = (np.zeros((2, 1), int), sightings, none, none, none, none, np.zeros((0, 4)))
            output.write(GroundLocations(int(frame.frame[0]), frame, *rest))
    root = ElementTree.parse(tmp_path / "tracks.kml").getroot()
    assert [m.findtext(f"{KML}name") for m in marks_of(root, "tracks")] == ["target 1", "target 2"]


# --------------------------------------------------------------------------------------------------------------------
# Cursor-on-Target.


def events(found):
    return list(ElementTree.fromstring(cot(found)).iter("event"))


def test_a_target_gives_one_event_a_second_with_its_place_and_error():
    found = events(tracks(walk(25)))
    assert [e.get("uid") for e in found] == ["dddas-1600000000-1", "dddas-1600000000-2"] * 3
    one = found[0]
    assert (one.get("version"), one.get("type"), one.get("how")) == ("2.0", "a-u-G", "m-f")
    point, track = one.find("point"), one.find("detail/track")
    assert point is not None and track is not None
    assert (float(point.get("lon", "")), float(point.get("lat", ""))) == pytest.approx(ORIGIN)
    assert (point.get("ce"), point.get("hae"), point.get("le")) == ("2.00", UNKNOWN, UNKNOWN)
    assert (track.get("course"), track.get("speed")) == ("0.0", "2.00")
    (point,) = events(tracks([positions(1, [[0, 0]], np.full((2, 2), np.nan))]))[0].iter("point")
    assert point.get("ce") == UNKNOWN


def test_heights_of_targets_stand_in_geojson_and_as_hae_in_events_where_they_are_known():
    high = replace(positions(1, [[0, 0]]), above_sea_m=np.array([720.0]), above_ellipsoid_m=np.array([691.26]))
    found = tracks([high, positions(2, [[0, 0]])])
    (point,) = events(found)[0].iter("point")
    assert point.get("hae") == "691.26"
    properties = geojson(found)["features"][0]["properties"]
    assert properties["above_sea_m"] == [720.0, None] and properties["above_ellipsoid_m"] == [691.26, None]
    assert "above_sea_m" not in geojson(tracks(walk(2)))["features"][0]["properties"]


def test_events_are_at_least_a_second_apart_and_valid_until_after_the_next():
    times: dict[str | None, list[float]] = {}
    for event in events(tracks(walk(38))):
        at, start, stale = (datetime.fromisoformat(event.get(n, "")).timestamp() for n in ("time", "start", "stale"))
        assert at == start and stale > at + 1
        times.setdefault(event.get("uid"), []).append(at)
    assert len(times) == 2 and all(np.diff(own).min() >= 0.999 and len(own) == 4 for own in times.values())


# --------------------------------------------------------------------------------------------------------------------
# Ellipses and rings.


def test_an_ellipse_lies_along_its_larger_variance_clockwise_from_north():
    axes, bearing = semi_axes(np.array([[[4, 0], [0, 1.0]], [[1, 0], [0, 4]], [[2.5, 1.5], [1.5, 2.5]]]), chi2=1)
    assert np.allclose(axes, [2, 1]) and np.allclose(np.degrees(bearing), [90, 0, 45])
    axes, bearing = semi_axes(np.array([[[1, 1], [1, 1.0]], [[np.nan] * 2] * 2]))  # a line, and an unknown one
    assert axes[0, 1] == pytest.approx(0, abs=1e-7) and np.degrees(bearing[0]) == pytest.approx(45)
    assert np.isnan(axes[1]).all()


@given(st.floats(0.1, 9), st.floats(0.1, 9), st.floats(-0.95, 0.95))
def test_every_point_of_the_ring_is_as_unlikely(east, north, correlation):
    both = correlation * np.sqrt(east * north)
    covariance = np.array([[east, both], [both, north]])
    ring = ring_m(*semi_axes(covariance[None]))[0]
    assert np.allclose(np.einsum("ki,ij,kj->k", ring, np.linalg.inv(covariance), ring), CHI2_95)


RING = ring_m(np.array([[60.0, 30.0]]), np.array([0.7]))[0]


@pytest.mark.parametrize("origin", [(10.0, 0.0), (-110.95, 32.23), (20.0, -70.0)])
def test_rings_in_degrees_are_those_of_the_ellipsoid(origin):
    (found,) = ring_about(np.array(origin), RING)
    assert found[0] == found[-1] and len(found) == len(RING) + 1
    assert np.abs(geometry.east_north(np.array(found[:-1]), origin) - RING).max() < 0.002


@pytest.mark.parametrize("longitude", [180.0, 179.9999, -179.9999, -180.0])
def test_a_ring_over_180_degrees_is_cut_into_two_closed_anticlockwise_ones(longitude):
    rings = ring_about(np.array([longitude, -17.0]), RING)
    areas = [signed_area(ring) for ring in rings]
    (whole,) = ring_about(np.array([10.0, -17.0]), RING)
    assert len(rings) == 2 and min(areas) > 0 and sum(areas) == pytest.approx(signed_area(whole), rel=1e-3)
    for ring in rings:
        longitudes = np.array(ring)[:, 0]
        assert ring[0] == ring[-1] and np.abs(longitudes).max() == 180 and np.ptp(longitudes) < 0.01


@pytest.mark.parametrize("place", [(12.0, 90.0), (12.0, -90.0), (12.0, 89.9995), (np.nan, np.nan)])
def test_a_ring_around_a_pole_or_nowhere_is_left_out(place):
    assert ring_about(np.array(place), RING) == []


def test_a_line_is_cut_each_time_it_goes_over_180_degrees():
    assert cut_line([[179.0, 0.0], [-179.0, 2.0], [179.0, 4.0]]) == [
        [[179.0, 0.0], [180.0, 1.0]],
        [[-180.0, 1.0], [-179.0, 2.0], [-180.0, 3.0]],
        [[180.0, 3.0], [179.0, 4.0]],
    ]


def test_ellipses_are_shown_once_a_second_and_at_the_last_place_where_they_are_known():
    found = tracks([positions(frame, [[0, 0]]) for frame in range(1, 36)])
    assert found.frame[ellipse_rows(found)].tolist() == [1, 11, 21, 31, 35]
    assert found.frame[ellipse_rows(found, most=2)].tolist() == [1, 18, 35]
    untimed = tracks([positions(frame, [[0, 0]]) for frame in (1, 2, 3)], timed=False)
    assert untimed.frame[ellipse_rows(untimed)].tolist() == [3]
    assert len(ellipse_rows(tracks([positions(1, [[0, 0]], np.full((2, 2), np.nan))]))) == 0
