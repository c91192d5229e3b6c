"""The tables of tracks and people that runs write."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.cli.conftest import rows as rows_of
from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.io.output.tables import PEOPLE, TRACKS, people_tables, track_rows, track_tables
from torchvision_dddas.io.overlay import Trails
from torchvision_dddas.io.tables import MOT_TRACKS
from torchvision_dddas.types import Detections, Frame, People, PeopleFrame, TrackedFrame, Tracks


def followed(number, boxes, identity=None, score=None, **rest):
    boxes = np.array(boxes, float).reshape(-1, 4)
    n = len(boxes)
    score = np.ones(n) if score is None else np.array(score, float)
    given = Detections(boxes, score, np.zeros(0), np.zeros(0), np.zeros(0), "given")
    tracks = Tracks(number, np.arange(n) + 1 if identity is None else np.array(identity), boxes, score, np.arange(n))
    return TrackedFrame(number, None, given, tracks, **rest)


def written(table, folder, *items):
    """The tables after some items: the text file, and the rows of the CSV."""
    for item in items:
        table.write(item)
    assert not [path for path in folder.iterdir() if not path.name.startswith(".")]  # nothing before the end
    table.close(complete=True)
    (text,), (table,) = (list(folder.glob(f"*{end}")) for end in (".txt", ".csv"))
    return text.read_text(), rows_of(table)


@given(st.lists(st.floats(-1e5, 1e5), min_size=4, max_size=4), st.floats(-100, 100))
def test_boxes_are_written_to_a_hundredth_of_a_pixel_and_scores_to_six_digits(box, score):
    text = MOT_TRACKS.format_rows(track_rows(followed(7, [box], [3], score=[score])))
    fields = text.rstrip("\n").split(",")
    assert (len(fields), fields[:2], fields[7:]) == (10, ["7", "3"], ["-1"] * 3)
    assert np.abs(np.array(fields[2:6], float) - box).max() <= 0.0051
    assert float(fields[6]) == pytest.approx(score, rel=1e-5)


def test_every_detection_is_in_the_csv_with_its_line_and_what_became_of_it(tmp_path):
    boxes = np.array([[0, 0, 9, 9], [20, 0, 9, 9], [40, 0, 9, 9.0]])
    given = Detections(boxes[[2, 0]], np.array([0.5, 0.9]), np.zeros(0), np.zeros(0), np.zeros(0), "given")
    tracks = Tracks(4, np.array([8, 5]), boxes[:2], np.array([0.9, 0.7]), np.array([1, -1]), np.array([0.625, np.nan]))
    frame = TrackedFrame(4, None, given, tracks, lines=np.array([31, 17]))
    text, rows = written(track_tables(tmp_path), tmp_path, frame)
    assert [(r["identity"], r["kind"], r["row"], r["x_px"]) for r in rows] == [
        ("8", "detection", "17", "0.00"),
        ("5", "bridge", "", "20.00"),
        ("", "untracked", "31", "40.00"),
    ]
    assert [(r["heading_deg"], r["speed_px_per_frame"]) for r in rows] == [("", "")] * 3
    assert [r["link"] for r in rows] == ["0.625", "", ""]
    assert text.count("\n") == 2


def test_classes_of_tracks_are_written_and_read_back(tmp_path):
    boxes = np.array([[0, 0, 9, 9], [20, 0, 9, 9], [40, 0, 9, 9.0]])
    found = Detections(boxes, np.ones(3), kind="given", label=np.array(["car", "red, large", "dog"]))
    label = np.array(["red, large", "car"], object)
    number, row = np.array([3, -1]), np.array([1, 0])
    tracks = Tracks(1, np.array([5, 8]), boxes[:2], np.ones(2), row, label=label, class_id=number)
    first = TrackedFrame(1, None, found, tracks)
    last = TrackedFrame(2, None, Detections(), replace(tracks, row=np.full(2, -1)))
    _, rows = written(track_tables(tmp_path), tmp_path, first, last)
    assert [(r["identity"], r["class"]) for r in rows] == [
        *(("5", "red, large"), ("8", "car"), ("", "dog")),
        *(("5", "red, large"), ("8", "car")),
    ]
    again = read_detections(tmp_path / "tracks.csv")
    assert again.at(2).label.tolist() == ["red, large", "car"] and again.at(2).class_id.tolist() == [3, -1]


def test_heading_and_speed_are_over_the_ground_and_a_frame(tmp_path):
    """The camera pans by 10 px to the right; what stands still moves 10 px to the left in the picture."""
    pan = np.array([[1, 0, -10.0], [0, 1, 0], [0, 0, 1]])
    first = followed(1, [[100, 50, 10, 20], [30, 30, 10, 10]])
    second = followed(5, [[90, 50, 10, 20], [20, 22, 10, 10]], now_from_before=pan)
    _, rows = written(track_tables(tmp_path), tmp_path, first, second)
    assert [(r["heading_deg"], r["speed_px_per_frame"]) for r in rows[:2]] == [("", ""), ("", "")]
    assert [float(r["speed_px_per_frame"]) for r in rows[2:]] == [0, 2]
    assert rows[3]["heading_deg"] == "0.0"  # up the picture
    assert [row["row"] for row in rows] == ["1", "2"] * 2  # numbered within their frame


BODIES = People(
    np.array([[10, 20, 30, 90.5], [-4, 2, 40, 100]]),
    np.array([0.98765, 0.5]),
    np.array([2.7, 0.5]),
    np.array([False, True]),
    np.array([[0, 5, 60, 120.0], [-14, -8, 80, 130]]),
)


def people(number=7, bodies=BODIES):
    return PeopleFrame(Frame(number, 0.6, np.zeros((120, 160), np.uint8)), bodies)


def test_people_have_probability_feet_margin_and_whether_the_border_cuts_them(tmp_path):
    text, (first, second, *_) = written(people_tables(tmp_path), tmp_path, people(7), people(8))
    assert text.startswith("7,-1,10.00,20.00,30.00,90.50,0.9877,-1,-1,-1\n7,-1,-4.00,2.00,40.00,100.00,0.5000,-1,")
    assert (first["frame"], first["target"], first["kind"], first["cut"]) == ("7", "1", "person", "0")
    assert (first["margin"], first["feet_u_px"], first["feet_v_px"]) == ("2.7000", "24.50", "110.00")
    assert (second["target"], second["cut"], second["score"]) == ("2", "1", "0.5000")
    for name in ("detections.txt", "detections.csv"):
        table = read_detections(tmp_path / name)
        assert table.frame.tolist() == [7, 7, 8, 8]
        assert table.box_px[:2] == pytest.approx(BODIES.box_px)
        assert table.score[:2] == pytest.approx(BODIES.score, abs=1e-4)
        assert table.probable and not table.own and not table.certain


@pytest.mark.parametrize(
    ("tables", "nothing", "schema"),
    [(track_tables, followed(1, []), TRACKS), (people_tables, people(1, People()), PEOPLE)],
)
def test_an_empty_clip_leaves_headings_and_a_discard_nothing(tmp_path, tables, nothing, schema):
    assert written(tables(tmp_path), tmp_path, nothing) == ("", [])
    assert next(tmp_path.glob("*.csv")).read_text() == schema.header
    (tmp_path / "no").mkdir()
    discarded = tables(tmp_path / "no")
    discarded.write(nothing)
    discarded.discard()
    assert not list((tmp_path / "no").iterdir())


def test_trails_are_carried_along_cut_to_length_and_forgotten():
    zoom = np.diag([2.0, 2.0, 1.0])
    trails = Trails(length=3, memory_frames=10)
    for number in range(1, 6):
        trails.add(followed(number, [[number - 1, -1, 2, 2]], now_from_before=zoom if number == 5 else None))
    assert trails.places == {1: [(3, 6, 0), (4, 8, 0), (5, 5, 0)]}
    trails.add(followed(15, []))
    assert 1 in trails.places
    trails.add(followed(16, [[0, 0, 2, 2]], [7], now_from_before=np.eye(3)))
    assert set(trails.places) == {7} and np.isfinite(trails.places[7]).all()
