from xml.etree import ElementTree

import numpy as np
import pytest

from tests.io.ground import NAMES, ORIGIN, positions, tracks
from torchvision_dddas.io.maps.kml import kml, xml_text
from torchvision_dddas.io.output import GroundRecorder
from torchvision_dddas.types import GroundLocations, Sightings

KML, GX = "{http://www.opengis.net/kml/2.2}", "{http://www.google.com/kml/ext/2.2}"
ORDER = ["name", "description", "TimeStamp", "styleUrl", "geometry"]
"""Of what a Placemark holds, as the schema of KML 2.2 wants it."""


def walk(count=30, origin=ORIGIN, step=1.0):
    return [positions(k + 1, [[step * k, 0], [0, -k]], [[4, 0], [0, 1]], origin) for k in range(count)]


def read(*given, **more):
    return ElementTree.fromstring(kml(*given, **more).encode())


def marks_of(root, name):
    folders = [f for f in root.iter(f"{KML}Folder") if f.findtext(f"{KML}name") == name]
    return folders[0].findall(f"{KML}Placemark") if folders else []


def test_a_track_has_a_time_for_each_of_its_places():
    (one, two) = marks_of(read(tracks(walk())), "tracks")
    track = one.find(f"{GX}Track")
    assert track is not None and two.findtext(f"{KML}name") == "target 2"
    when = [e.text for e in track.findall(f"{KML}when")]
    places = [e.text.split() for e in track.findall(f"{GX}coord") if e.text]
    assert len(when) == len(places) == 30 and when[1] == "2020-09-13T12:26:40.350Z"
    assert [float(v) for v in places[0]] == pytest.approx([*ORIGIN, 0])
    assert [e.tag for e in track] == [f"{KML}altitudeMode", *[f"{KML}when"] * 30, *[f"{GX}coord"] * 30]


def test_without_a_clock_a_track_is_a_line_and_has_only_its_last_ellipse():
    root = read(tracks(walk(), start_utc_s=float("nan")))
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
    found = marks_of(read(tracks(walk())), "95 % ellipses")
    assert [m.findtext(f"{KML}TimeStamp/{KML}when") for m in found][1] == "2020-09-13T12:26:41.250Z"
    for mark in found:
        text = mark.findtext(f"{KML}Polygon/{KML}outerBoundaryIs/{KML}LinearRing/{KML}coordinates")
        assert text is not None
        ring = np.array([[float(v) for v in place.split(",")] for place in text.split()])
        x, y = (ring - ring[0])[:, :2].T
        assert (ring[0] == ring[-1]).all() and (x[:-1] * y[1:] - x[1:] * y[:-1]).sum() > 0


def test_a_placemark_holds_its_parts_in_the_order_of_the_schema():
    marks = tracks([positions(1, [[5, 5]], target=[0])])
    root = read(tracks(walk()), landmarks=marks, names=NAMES)
    for mark in root.iter(f"{KML}Placemark"):
        names = [e.tag.split("}")[1] for e in mark]
        ranks = [ORDER.index(n) if n in ORDER else 4 for n in names]
        assert ranks == sorted(ranks) and ranks[-1] == 4
    document = root[0]
    kinds = [e.tag for e in document]
    assert kinds == sorted(kinds, key=[f"{KML}name", f"{KML}Style", f"{KML}Folder"].index)


def test_every_style_that_is_used_is_there():
    marks = tracks([positions(1, [[5, 5]], target=[0])])
    root = read(tracks(walk()), landmarks=marks, names=NAMES)
    used = {e.text for e in root.iter(f"{KML}styleUrl")}
    assert used == {f"#{e.get('id')}" for e in root.iter(f"{KML}Style")}


def test_names_come_back_as_they_were_given():
    marks = tracks([positions(1, [[5, 5]], target=[3])])
    root = read(tracks(walk()), name='a "<clip>" & \x00more', landmarks=marks, names=NAMES)
    assert root[0].findtext(f"{KML}name") == 'a "<clip>" & more'
    assert marks_of(root, "landmarks")[0].findtext(f"{KML}name") == "delta & <co>"
    assert xml_text("a\x0bb\ud800\uffff") == "ab"


def test_a_track_over_180_degrees_is_several_whose_places_are_all_there():
    root = read(tracks(walk(origin=(179.9999, -17.0))))
    pieces = marks_of(root, "tracks")[0].findall(f"{GX}MultiTrack/{GX}Track")
    assert len(pieces) == 2
    assert sum(len(p.findall(f"{KML}when")) for p in pieces) == 30
    for piece in pieces:
        longitudes = [float(e.text.split()[0]) for e in piece.findall(f"{GX}coord") if e.text]
        assert max(longitudes) - min(longitudes) < 1


def test_without_a_clock_a_line_over_180_degrees_is_cut():
    root = read(tracks(walk(origin=(179.9999, -17.0)), start_utc_s=float("nan")))
    lines = marks_of(root, "tracks")[0].findall(f"{KML}MultiGeometry/{KML}LineString")
    assert len(lines) == 2


def test_no_positions_are_a_valid_document():
    assert read(tracks([]))[0].findtext(f"{KML}name") == "tracks"


def test_local_metres_are_refused():
    with pytest.raises(ValueError, match="no longitude"):
        kml(tracks(walk(origin=None)))


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
