import json

import numpy as np
import pytest

from tests.io.ground import NAMES, ORIGIN, START, positions, tracks
from torchvision_dddas.io.maps import encode_geojson, geojson


def walk(count=30, origin=ORIGIN, covariance=((4, 0), (0, 1)), step=1.0):
    return [positions(k + 1, [[step * k, 0], [0, -k]], covariance, origin) for k in range(count)]


def read(*given, **more):
    return json.loads(encode_geojson(geojson(*given, **more)))


def test_a_track_has_its_frames_times_and_errors_beside_its_places():
    found = read(tracks(walk()))
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
    (one, _) = read(tracks(walk(), start_utc_s=float("nan")))["features"]
    assert one["properties"]["seconds"][:3] == [0, 0.1, 0.2] and "times" not in one["properties"]
    (one, _) = read(tracks(walk(), timed=False))["features"]
    assert not {"seconds", "times"} & one["properties"].keys()


def test_ellipses_are_right_handed_polygons_of_95_percent():
    found = read(tracks(walk()), ellipses=True)["features"]
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
    found = read(tracks(walk(covariance=np.full((2, 2), np.nan))), ellipses=True)["features"]
    assert len(found) == 2 and found[0]["properties"]["sigma_m"][0] is None


def test_landmarks_are_named():
    marks = tracks([positions(1, [[5, 5]], target=[3])])
    found = read(tracks(walk()), landmarks=marks, names=NAMES)["features"]
    assert found[-1]["properties"]["landmark"] == "delta & <co>"
    assert found[-1]["geometry"]["type"] == "Point"


@pytest.mark.parametrize("origin", [ORIGIN, (179.9999, -17.0), (-180.0, 60.0)])
def test_the_box_holds_all_places_also_over_180_degrees(origin):
    found = read(tracks(walk(origin=origin, step=5.0)), ellipses=True)
    west, south, east, north = found["bbox"]
    assert (west > east) == (origin != ORIGIN)
    for feature in found["features"]:
        for longitude, latitude in places(feature["geometry"]["coordinates"]):
            assert south <= latitude <= north
            assert west <= longitude <= east if west <= east else longitude >= west or longitude <= east


def test_lines_and_ellipses_over_180_degrees_are_cut():
    # 180 degrees are 10.6 m east of the origin.
    found = read(tracks(walk(origin=(179.9999, -17.0), step=1.0)), ellipses=True)["features"]
    kinds = {f["geometry"]["type"] for f in found}
    assert kinds == {"MultiLineString", "LineString", "Polygon", "MultiPolygon"}
    assert all(abs(longitude) <= 180 for f in found for longitude, _ in places(f["geometry"]["coordinates"]))


def test_at_a_pole_there_are_places_and_no_ellipses():
    found = read(tracks(walk(origin=(0.0, 90.0))), ellipses=True)["features"]
    assert [f["geometry"]["type"] for f in found if "target" not in f["properties"]] == []
    assert all(abs(v) <= 180 for f in found for p in places(f["geometry"]["coordinates"]) for v in p)


def test_no_positions_are_an_empty_collection():
    assert read(tracks([]), ellipses=True) == {"type": "FeatureCollection", "features": []}


def test_local_metres_are_refused():
    with pytest.raises(ValueError, match="no longitude"):
        geojson(tracks(walk(origin=None)))


def test_the_clock_is_read_to_the_millisecond():
    found = read(tracks(walk(2), start_utc_s=START + 0.0004))["features"]
    assert found[0]["properties"]["times"][0] == "2020-09-13T12:26:40.250Z"


def places(found):
    return [found] if isinstance(found[0], (int, float)) else [p for part in found for p in places(part)]
