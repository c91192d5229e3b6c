"""Maps for other tools: GeoJSON, KML, Cursor-on-Target, and the ellipses that they show."""

import json
from datetime import datetime
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.io.ground import NAMES, ORIGIN, START, positions, tracks
from torchvision_dddas import geometry
from torchvision_dddas.io.maps import encode_geojson, geojson
from torchvision_dddas.io.maps.formats import UNKNOWN, cot, kml, xml_text
from torchvision_dddas.io.maps.ground_tracks import (
    CHI2_95,
    cut_line,
    ellipse_rows,
    ring_about,
    ring_m,
    semi_axes,
)
from torchvision_dddas.io.output import GroundRecorder
from torchvision_dddas.types import GroundLocations, Sightings


@pytest.mark.parametrize("make", [geojson, kml, cot])
def test_no_positions_are_a_valid_map_and_local_metres_are_refused(make):
    assert make(tracks([]))
    with pytest.raises(ValueError, match="no longitude"):
        make(tracks(walk(origin=None)))


@pytest.mark.parametrize("how", [{"start_utc_s": float("nan")}, {"timed": False}])
def test_events_need_a_clock(how):
    with pytest.raises(ValueError, match="no clock"):
        cot(tracks(walk(), **how))


def walk(count=30, origin=ORIGIN, covariance=((4, 0), (0, 1)), step=1.0):
    return [positions(k + 1, [[step * k, 0], [0, -k]], covariance, origin) for k in range(count)]


def read_geojson(*given, **more):
    return json.loads(encode_geojson(geojson(*given, **more)))


def test_a_track_has_its_frames_times_and_errors_beside_its_places():
    found = read_geojson(tracks(walk()))
    assert found["type"] == "FeatureCollection" and len(found["features"]) == 2
    one = found["features"][0]
    assert one["geometry"]["type"] == "LineString" and one["properties"]["target"] == 1
    assert len(one["geometry"]["coordinates"]) == len(one["properties"]["times"]) == 30
    assert one["properties"]["frames"] == list(range(1, 31))
    assert one["properties"]["times"][:2] == ["2020-09-13T12:26:40.250Z", "2020-09-13T12:26:40.350Z"]
    assert one["properties"]["sigma_m"][0] == pytest.approx(np.sqrt(5), abs=1e-3)
    longitude, latitude = one["geometry"]["coordinates"][0]
    assert (longitude, latitude) == pytest.approx(ORIGIN)


def test_without_a_clock_times_are_seconds_and_without_any_there_are_none():
    (one, _) = read_geojson(tracks(walk(), start_utc_s=float("nan")))["features"]
    assert one["properties"]["seconds"][:3] == [0, 0.1, 0.2] and "times" not in one["properties"]
    (one, _) = read_geojson(tracks(walk(), timed=False))["features"]
    assert not {"seconds", "times"} & one["properties"].keys()


def test_ellipses_are_right_handed_polygons_of_95_percent():
    found = read_geojson(tracks(walk()), ellipses=True)["features"]
    rounds = [f for f in found if "ellipse_of" in f["properties"]]
    assert [f["properties"]["frame"] for f in rounds if f["properties"]["ellipse_of"] == 2] == [1, 11, 21, 30]
    one = rounds[-1]
    assert one["properties"]["semi_major_m"] == pytest.approx(2 * 2.4477, abs=1e-3)
    assert one["properties"]["semi_minor_m"] == pytest.approx(2.4477, abs=1e-3)
    assert one["properties"]["bearing_deg"] == 90 and one["properties"]["time"].startswith("2020-09-13T12:26:43.15")
    (ring,) = one["geometry"]["coordinates"]
    x, y = (np.array(ring) - ring[0]).T
    assert ring[0] == ring[-1] and (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() > 0


def test_a_place_without_a_known_error_has_no_ellipse():
    found = read_geojson(tracks(walk(covariance=np.full((2, 2), np.nan))), ellipses=True)["features"]
    assert len(found) == 2 and found[0]["properties"]["sigma_m"][0] is None


def test_landmarks_are_named():
    marks = tracks([positions(1, [[5, 5]], target=[3])])
    found = read_geojson(tracks(walk()), landmarks=marks, names=NAMES)["features"]
    assert found[-1]["properties"]["landmark"] == "delta & <co>"
    assert found[-1]["geometry"]["type"] == "Point"


@pytest.mark.parametrize("origin", [ORIGIN, (179.9999, -17.0), (-180.0, 60.0)])
def test_the_box_holds_all_places_also_over_180_degrees(origin):
    found = read_geojson(tracks(walk(origin=origin, step=5.0)), ellipses=True)
    west, south, east, north = found["bbox"]
    assert (west > east) == (origin != ORIGIN)
    for feature in found["features"]:
        for longitude, latitude in places(feature["geometry"]["coordinates"]):
            assert south <= latitude <= north
            assert west <= longitude <= east if west <= east else longitude >= west or longitude <= east


def test_lines_and_ellipses_over_180_degrees_are_cut():
    # 180 degrees are 10.6 m east of the origin.
    found = read_geojson(tracks(walk(origin=(179.9999, -17.0), step=1.0)), ellipses=True)["features"]
    kinds = {f["geometry"]["type"] for f in found}
    assert kinds == {"MultiLineString", "LineString", "Polygon", "MultiPolygon"}
    assert all(abs(longitude) <= 180 for f in found for longitude, _ in places(f["geometry"]["coordinates"]))


def test_at_a_pole_there_are_places_and_no_ellipses():
    found = read_geojson(tracks(walk(origin=(0.0, 90.0))), ellipses=True)["features"]
    assert [f["geometry"]["type"] for f in found if "target" not in f["properties"]] == []
    assert all(abs(v) <= 180 for f in found for p in places(f["geometry"]["coordinates"]) for v in p)


def test_the_clock_is_read_to_the_millisecond():
    found = read_geojson(tracks(walk(2), start_utc_s=START + 0.0004))["features"]
    assert found[0]["properties"]["times"][0] == "2020-09-13T12:26:40.250Z"


def places(found):
    return [found] if isinstance(found[0], (int, float)) else [p for part in found for p in places(part)]


KML, GX = "{http://www.opengis.net/kml/2.2}", "{http://www.google.com/kml/ext/2.2}"
ORDER = ["name", "description", "TimeStamp", "styleUrl", "geometry"]
"""Of what a Placemark holds, as the schema of KML 2.2 wants it."""


def read_kml(*given, **more):
    return ElementTree.fromstring(kml(*given, **more).encode())


def marks_of(root, name):
    folders = [f for f in root.iter(f"{KML}Folder") if f.findtext(f"{KML}name") == name]
    return folders[0].findall(f"{KML}Placemark") if folders else []


def test_a_track_has_a_time_for_each_of_its_places():
    (one, two) = marks_of(read_kml(tracks(walk())), "tracks")
    track = one.find(f"{GX}Track")
    assert track is not None and two.findtext(f"{KML}name") == "target 2"
    when = [e.text for e in track.findall(f"{KML}when")]
    places = [e.text.split() for e in track.findall(f"{GX}coord") if e.text]
    assert len(when) == len(places) == 30 and when[1] == "2020-09-13T12:26:40.350Z"
    assert [float(v) for v in places[0]] == pytest.approx([*ORIGIN, 0])
    assert [e.tag for e in track] == [f"{KML}altitudeMode", *[f"{KML}when"] * 30, *[f"{GX}coord"] * 30]


def test_without_a_clock_a_track_is_a_line_and_has_only_its_last_ellipse():
    root = read_kml(tracks(walk(), start_utc_s=float("nan")))
    assert not list(root.iter(f"{KML}when"))
    line = marks_of(root, "tracks")[0].find(f"{KML}LineString/{KML}coordinates")
    assert line is not None and line.text is not None
    assert len(line.text.split()) == 30
    assert [float(v) for v in line.text.split()[0].split(",")] == pytest.approx([*ORIGIN, 0])
    assert [m.findtext(f"{KML}name") for m in marks_of(root, "95 % ellipses")] == [
        "target 1, frame 30",
        "target 2, frame 30",
    ]


def test_ellipses_have_times_and_closed_anticlockwise_rings():
    found = marks_of(read_kml(tracks(walk())), "95 % ellipses")
    assert [m.findtext(f"{KML}TimeStamp/{KML}when") for m in found][1] == "2020-09-13T12:26:41.250Z"
    for mark in found:
        text = mark.findtext(f"{KML}Polygon/{KML}outerBoundaryIs/{KML}LinearRing/{KML}coordinates")
        assert text is not None
        ring = np.array([[float(v) for v in place.split(",")] for place in text.split()])
        x, y = (ring - ring[0])[:, :2].T
        assert (ring[0] == ring[-1]).all() and (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() > 0


def test_a_placemark_holds_its_parts_in_the_order_of_the_schema():
    marks = tracks([positions(1, [[5, 5]], target=[0])])
    root = read_kml(tracks(walk()), landmarks=marks, names=NAMES)
    for mark in root.iter(f"{KML}Placemark"):
        names = [e.tag.split("}")[1] for e in mark]
        ranks = [ORDER.index(n) if n in ORDER else 4 for n in names]
        assert ranks == sorted(ranks) and ranks[-1] == 4
    document = root[0]
    kinds = [e.tag for e in document]
    assert kinds == sorted(kinds, key=[f"{KML}name", f"{KML}Style", f"{KML}Folder"].index)


def test_every_style_that_is_used_is_there():
    marks = tracks([positions(1, [[5, 5]], target=[0])])
    root = read_kml(tracks(walk()), landmarks=marks, names=NAMES)
    used = {e.text for e in root.iter(f"{KML}styleUrl")}
    assert used == {f"#{e.get('id')}" for e in root.iter(f"{KML}Style")}


def test_names_come_back_as_they_were_given():
    marks = tracks([positions(1, [[5, 5]], target=[3])])
    root = read_kml(tracks(walk()), name='a "<clip>" & \x00more', landmarks=marks, names=NAMES)
    assert root[0].findtext(f"{KML}name") == 'a "<clip>" & more'
    assert marks_of(root, "landmarks")[0].findtext(f"{KML}name") == "delta & <co>"
    assert xml_text("a\x0bb\ud800\uffff") == "ab"


def test_a_track_over_180_degrees_is_several_whose_places_are_all_there():
    root = read_kml(tracks(walk(origin=(179.9999, -17.0))))
    pieces = marks_of(root, "tracks")[0].findall(f"{GX}MultiTrack/{GX}Track")
    assert len(pieces) == 2
    assert sum(len(p.findall(f"{KML}when")) for p in pieces) == 30
    for piece in pieces:
        longitudes = [float(e.text.split()[0]) for e in piece.findall(f"{GX}coord") if e.text]
        assert max(longitudes) - min(longitudes) < 1


def test_without_a_clock_a_line_over_180_degrees_is_cut():
    root = read_kml(tracks(walk(origin=(179.9999, -17.0)), start_utc_s=float("nan")))
    lines = marks_of(root, "tracks")[0].findall(f"{KML}MultiGeometry/{KML}LineString")
    assert len(lines) == 2


def test_people_located_from_the_ground_are_written_too(tmp_path):
    none = np.zeros(0)
    sightings = Sightings(
        np.zeros((0, 2)), none, none, none, np.zeros((0, 2, 2)), np.zeros((0, 2)), np.zeros((0, 2, 6))
    )
    for geographic in (True, False):
        with GroundRecorder(tmp_path) as output:
            output.begin({}, ("a",), geographic)
            for frame in walk(3, origin=ORIGIN if geographic else None):
                members = np.zeros((2, 1), int)
                number = int(frame.frame[0])
                output.write(
                    GroundLocations(number, frame, members, sightings, none, none, none, none, np.zeros((0, 4)))
                )
        if geographic:
            root = ElementTree.parse(tmp_path / "tracks.kml").getroot()
            assert [m.findtext(f"{KML}name") for m in marks_of(root, "tracks")] == ["target 1", "target 2"]
            assert not list(root.iter(f"{KML}when"))
    assert {path.name for path in tmp_path.iterdir()} == {"positions.csv", "sightings.csv", "run.json"}


def events(found):
    return list(ElementTree.fromstring(cot(found)).iter("event"))


def test_a_target_gives_one_event_a_second_with_its_place_and_error():
    found = events(tracks(walk(25)))
    assert [e.get("uid") for e in found] == ["dddas-1600000000-1", "dddas-1600000000-2"] * 3
    one = found[0]
    assert (one.get("version"), one.get("type"), one.get("how")) == ("2.0", "a-u-G", "m-f")
    point = one.find("point")
    assert point is not None
    assert (float(point.get("lon", "")), float(point.get("lat", ""))) == pytest.approx(ORIGIN)
    assert (point.get("ce"), point.get("hae"), point.get("le")) == ("2.00", UNKNOWN, UNKNOWN)
    track = one.find("detail/track")
    assert track is not None and (track.get("course"), track.get("speed")) == ("0.0", "2.00")


def test_events_are_at_least_a_second_apart_and_believed_until_after_the_next():
    times: dict[str | None, list[float]] = {}
    for event in events(tracks(walk(38))):
        at, start, stale = (
            datetime.fromisoformat(event.get(name, "")).timestamp() for name in ("time", "start", "stale")
        )
        assert at == start and stale > at + 1
        times.setdefault(event.get("uid"), []).append(at)
    assert len(times) == 2
    assert all(np.diff(own).min() >= 0.999 and len(own) == 4 for own in times.values())


def test_an_unknown_error_is_said_to_be_unknown():
    point = events(tracks(walk(1, covariance=np.full((2, 2), np.nan))))[0].find("point")
    assert point is not None and point.get("ce") == UNKNOWN


def test_an_ellipse_lies_along_its_larger_variance_clockwise_from_north():
    axes, bearing = semi_axes(np.array([[[4, 0], [0, 1.0]], [[1, 0], [0, 4]], [[2.5, 1.5], [1.5, 2.5]]]), chi2=1)
    assert np.allclose(axes, [2, 1])
    assert np.allclose(np.degrees(bearing), [90, 0, 45])


@given(st.floats(0.1, 9), st.floats(0.1, 9), st.floats(-0.95, 0.95))
def test_every_point_of_the_ring_is_as_unlikely(east, north, correlation):
    both = correlation * np.sqrt(east * north)
    covariance = np.array([[east, both], [both, north]])
    ring = ring_m(*semi_axes(covariance[None]))[0]
    assert np.allclose(np.einsum("ki,ij,kj->k", ring, np.linalg.inv(covariance), ring), CHI2_95)


def test_95_of_100_errors_lie_in_the_ellipse():
    covariance = np.array([[3.0, 1.2], [1.2, 1.0]])
    error = np.random.default_rng(4).multivariate_normal((0, 0), covariance, 20_000)
    inside = (error @ np.linalg.inv(covariance) * error).sum(axis=1) <= CHI2_95
    assert abs(inside.mean() - 0.95) < 0.006


def test_a_covariance_that_is_a_line_or_unknown_gives_no_wrong_number():
    axes, bearing = semi_axes(np.array([[[1, 1], [1, 1.0]], [[np.nan] * 2] * 2]))
    assert axes[0, 1] == pytest.approx(0, abs=1e-7) and np.degrees(bearing[0]) == pytest.approx(45)
    assert np.isnan(axes[1]).all()


@pytest.mark.parametrize("origin", [(10.0, 0.0), (-110.95, 32.23), (20.0, -70.0)])
def test_rings_in_degrees_are_those_of_the_ellipsoid(origin):
    ring = ring_m(np.array([[60.0, 30.0]]), np.array([0.7]))[0]
    (found,) = ring_about(np.array(origin), ring)
    assert found[0] == found[-1] and len(found) == len(ring) + 1
    back = geometry.east_north(np.array(found[:-1]), origin)
    assert np.abs(back - ring).max() < 0.002


@pytest.mark.parametrize("longitude", [180.0, 179.9999, -179.9999, -180.0])
def test_a_ring_over_180_degrees_is_cut_into_two_closed_anticlockwise_ones(longitude):
    ring = ring_m(np.array([[60.0, 30.0]]), np.array([0.7]))[0]
    rings = ring_about(np.array([longitude, -17.0]), ring)
    assert len(rings) == 2
    areas = [_area(np.array(r)) for r in rings]
    (whole,) = ring_about(np.array([10.0, -17.0]), ring)
    assert min(areas) > 0 and sum(areas) == pytest.approx(_area(np.array(whole)), rel=1e-3)
    for part in rings:
        assert part[0] == part[-1]
        longitudes = np.array(part)[:, 0]
        assert np.abs(longitudes).max() == 180 and np.ptp(longitudes) < 0.01


def _area(ring):
    x, y = (ring - ring[0]).T
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum() / 2)


def test_a_ring_around_a_pole_is_left_out():
    ring = ring_m(np.array([[60.0, 30.0]]), np.array([0.7]))[0]
    for latitude in (90.0, -90.0, 89.9995):
        assert ring_about(np.array([12.0, latitude]), ring) == []
    assert ring_about(np.array([np.nan, np.nan]), ring) == []


def test_a_line_is_cut_each_time_it_goes_over_180_degrees():
    lines = cut_line([[179.0, 0.0], [-179.0, 2.0], [179.0, 4.0]])
    assert lines == [
        [[179.0, 0.0], [180.0, 1.0]],
        [[-180.0, 1.0], [-179.0, 2.0], [-180.0, 3.0]],
        [[180.0, 3.0], [179.0, 4.0]],
    ]


def test_ellipses_are_shown_once_a_second_and_at_the_last_place():
    found = tracks([positions(frame, [[0, 0]]) for frame in range(1, 36)])
    assert found.frame[ellipse_rows(found)].tolist() == [1, 11, 21, 31, 35]
    assert found.frame[ellipse_rows(found, most=2)].tolist() == [1, 18, 35]


def test_without_times_or_with_unknown_errors_only_what_is_known_is_ellipse_rows():
    untimed = tracks([positions(frame, [[0, 0]]) for frame in (1, 2, 3)], timed=False)
    assert untimed.frame[ellipse_rows(untimed)].tolist() == [3]
    unknown = tracks([positions(1, [[0, 0]], np.full((2, 2), np.nan))])
    assert len(ellipse_rows(unknown)) == 0
