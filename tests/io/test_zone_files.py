"""Zones read from GeoJSON and KML, and one line for each mistake in them."""

import json

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.zone_files import read_zones

RING = [[-110.95, 32.23], [-110.94, 32.23], [-110.94, 32.24], [-110.95, 32.24], [-110.95, 32.23]]
HOLE = [[-110.948, 32.232], [-110.946, 32.232], [-110.947, 32.234], [-110.948, 32.232]]


def feature(kind, coordinates, **properties):
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


def collection(*features, **members):
    return json.dumps({"type": "FeatureCollection", "features": features, **members})


def test_polygons_lines_and_their_properties_are_read(file):
    text = collection(
        feature("Polygon", [RING, HOLE], name="field", dwell_s=30),
        feature("MultiPolygon", [[RING], [HOLE]], name="field"),
        feature("LineString", RING[:3]),
        feature("Point", RING[0]),
    )
    (field, one, other, line), notes = read_zones(file("zones.geojson", text))
    assert (field.name, field.dwell_s, field.is_line, field.unit) == ("field", 30, False, "deg")
    assert [len(ring) for ring in field.rings] == [4, 3]
    assert [[len(ring) for ring in area.rings] for area in (one, other)] == [[4], [3]], "areas of a zone may overlap"
    assert (one.name, other.name) == ("field #2", "field #3") and (line.name, line.is_line) == ("line 4", True)
    np.testing.assert_allclose(line.rings[0], RING[:3])
    assert len(notes) == 3 and "field occurs more than once" in notes[0] and "are left out: 1" in notes[2]


@pytest.mark.parametrize(
    ("ring", "says"),
    [
        ([[0, 0], [10**400, 0], [1, 1]], "must be a list of places"),
        ([[0, 0], [1, 1], [2, 2]], "its points lie on one line"),
        ([[0, 0], [0, 0], [1, 1]], "wanted 3 or more"),
    ],
)
def test_a_zone_without_an_inside_is_refused(file, ring, says):
    with pytest.raises(InputError, match=says):
        read_zones(file("bad.geojson", collection(feature("Polygon", [ring]))))


def test_a_point_twice_in_a_row_and_a_stated_wgs84_are_taken(file):
    twice = [RING[0], RING[0], *RING[1:]]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::4326"}}
    for members in ({"crs": None}, {"crs": crs}):
        (zone,), _ = read_zones(file("zones.geojson", collection(feature("Polygon", [twice]), **members)))
        assert len(zone.rings[0]) == 4
    with pytest.raises(InputError, match="save it in WGS84"):
        read_zones(file("zones.geojson", collection(feature("Polygon", [RING]), crs={"name": "EPSG:43261"})))


def test_a_kml_gives_the_same_zones(file):
    ring, hole = (" ".join(f"{x},{y},0" for x, y in part) for part in (RING, HOLE))
    text = f"""<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Folder>
<Placemark><name>field</name><ExtendedData><Data name="dwell_s"><value>30</value></Data></ExtendedData><Polygon>
<outerBoundaryIs><LinearRing><coordinates>{ring}</coordinates></LinearRing></outerBoundaryIs>
<innerBoundaryIs><LinearRing><coordinates>{hole}</coordinates></LinearRing></innerBoundaryIs></Polygon></Placemark>
<Placemark><LineString><coordinates>{ring}</coordinates></LineString></Placemark></Folder></Document></kml>"""
    (field, line), notes = read_zones(file("zones.kml", text))
    (same,), _ = read_zones(
        file("same.geojson", collection(feature("Polygon", [RING, HOLE], name="field", dwell_s=30)))
    )
    assert (field.name, field.dwell_s) == (same.name, same.dwell_s) and not notes
    for outline, other in zip(field.rings, same.rings, strict=True):
        np.testing.assert_allclose(outline, other)
    assert line.is_line and len(line.rings[0]) == 5


def test_a_kml_of_a_map_program_keeps_its_own_data_and_a_point_beside_an_area_is_counted(file):
    ring = " ".join(f"{x},{y},0" for x, y in RING)
    outline = f"<outerBoundaryIs><LinearRing><coordinates>{ring}</coordinates></LinearRing></outerBoundaryIs>"
    data = '<ExtendedData><SchemaData><SimpleData name="dwell_s">30</SimpleData></SchemaData></ExtendedData>'
    point = "<Point><coordinates>1,2</coordinates></Point>"
    text = f"<kml><Placemark>{data}<MultiGeometry><Polygon>{outline}</Polygon>{point}</MultiGeometry></Placemark></kml>"
    (zone,), notes = read_zones(file("zones.kml", text))
    assert zone.dwell_s == 30 and "neither polygon nor line are left out: 1" in notes[0]


def test_a_unit_beside_the_features_is_that_of_the_coordinates(file):
    text = collection(feature("Polygon", [[[0, 0], [640, 0], [640, 480]]]), unit="px")
    assert read_zones(file("door.geojson", text))[0][0].unit == "px"


def test_a_name_can_be_written_anywhere(file):
    text = collection(feature("Polygon", [RING], name="a\nb \ud800"), feature("LineString", RING, name=7))
    (one, other), _ = read_zones(file("zones.geojson", text))
    assert one.name.startswith("a b") and one.name.encode() and other.name == "7"


CROSSED = [RING[0], RING[2], RING[1], RING[3]]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("frame,target\n", "neither GeoJSON nor KML"),
        ('{"type": "FeatureColl', "neither GeoJSON nor KML"),
        ("[" * 100_000, "neither GeoJSON nor KML"),
        ('{"a":' * 100_000, "neither GeoJSON nor KML"),
        ("PK\x03\x04", "is an archive"),
        (collection(), "has no polygons and lines"),
        (collection(feature("Point", RING[0])), "has no polygons and lines"),
        (
            "<kml><Placemark><Point><coordinates>1,2</coordinates></Point></Placemark></kml>",
            "has no polygons and lines",
        ),
        (collection(feature("Polygon", [CROSSED], name="bow")), "bow crosses itself"),
        (collection(feature("Polygon", [RING[:2]])), "3 or more"),
        (collection(feature("Polygon", [RING[0]])), "must be a list of places"),
        (collection(feature("Polygon", None)), "must be a list of places"),
        (collection(feature("Polygon", [RING], dwell_s="long")), "must be a list of places"),
        (collection(feature("Polygon", [RING], dwell_s=-1)), "not positive"),
        (collection(feature("LineString", [[0, 0], [1e400, 0]])), "not finite"),
        (collection(feature("LineString", [[0, 0], [640, 480]])), '"unit"'),
        (collection(feature("LineString", [[32.2, -110.9], [32.3, -110.9]])), "longitude, latitude"),
        (collection(feature("LineString", [[32.2, -110.9], [32.3, -110.9]])), r"swapped\? write the longitude first"),
        (collection(feature("Polygon", [[[k / 1000, k * k / 1e8] for k in range(2001)]])), "2000 at most"),
        (collection(feature("Polygon", [RING]), unit="feet"), "unit of zones"),
        (collection(feature("Polygon", [RING]), crs={"properties": {"name": "EPSG:25832"}}), "WGS84"),
    ],
)
def test_bad_zones_are_refused_in_one_line_with_the_file(file, text, says):
    path = file("zones.json", text)
    with pytest.raises(InputError, match=says) as caught:
        read_zones(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_file_that_is_not_there_is_named(tmp_path):
    for path in (tmp_path / "none.geojson", tmp_path):
        with pytest.raises(InputError, match="cannot be read"):
            read_zones(path)
