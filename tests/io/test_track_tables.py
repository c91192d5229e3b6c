import csv
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.io.output.track_tables import COLUMNS, TrackTables, csv_lines, mot_lines
from torchvision_dddas.io.overlay.layers import Trails
from torchvision_dddas.types import Detections, TrackedFrame, Tracks


def followed(number, boxes, identity=None, row=None, score=None, **rest):
    boxes = np.array(boxes, float).reshape(-1, 4)
    n = len(boxes)
    row = np.arange(n) if row is None else np.array(row, int)
    score = np.ones(n) if score is None else np.array(score, float)
    given = Detections(boxes[row >= 0], score[row >= 0], np.zeros(0), np.zeros(0), np.zeros(0), "given")
    tracks = Tracks(number, np.arange(n) + 1 if identity is None else np.array(identity), boxes, score, row)
    return TrackedFrame(number, None, given, tracks, **rest)


def read(text):
    return list(csv.DictReader(text.splitlines(), fieldnames=COLUMNS))


@given(st.lists(st.floats(-1e5, 1e5), min_size=4, max_size=4), st.floats(-100, 100))
def test_boxes_are_written_to_a_hundredth_of_a_pixel_and_scores_to_six_digits(box, score):
    fields = mot_lines(followed(7, [box], [3], score=[score])).rstrip("\n").split(",")
    assert (len(fields), fields[:2], fields[7:]) == (10, ["7", "3"], ["-1"] * 3)
    assert np.abs(np.array(fields[2:6], float) - box).max() <= 0.0051
    assert float(fields[6]) == pytest.approx(score, rel=1e-5)


def test_every_detection_is_in_the_csv_with_its_line_and_what_became_of_it():
    boxes = np.array([[0, 0, 9, 9], [20, 0, 9, 9], [40, 0, 9, 9.0]])
    given = Detections(boxes[[2, 0]], np.array([0.5, 0.9]), np.zeros(0), np.zeros(0), np.zeros(0), "given")
    tracks = Tracks(4, np.array([8, 5]), boxes[:2], np.array([0.9, 0.7]), np.array([1, -1]))
    rows = read(csv_lines(TrackedFrame(4, None, given, tracks, lines=np.array([31, 17])), {8: (90.0, 2.5)}))
    assert [(r["identity"], r["kind"], r["row"], r["x_px"]) for r in rows] == [
        ("8", "detection", "17", "0.00"),
        ("5", "bridge", "", "20.00"),
        ("", "untracked", "31", "40.00"),
    ]
    assert [(r["heading_deg"], r["speed_px_per_frame"]) for r in rows] == [("90.0", "2.500"), ("", ""), ("", "")]
    assert mot_lines(TrackedFrame(4, None, given, tracks)).count("\n") == 2


def test_own_detections_are_numbered_within_their_frame():
    assert [r["row"] for r in read(csv_lines(followed(1, [[0, 0, 1, 1], [5, 5, 1, 1]]), {}))] == ["1", "2"]


def test_heading_and_speed_are_over_the_ground_and_a_frame(tmp_path):
    """The camera pans by 10 px to the right; what stands still moves 10 px to the left in the picture."""
    pan = np.array([[1, 0, -10.0], [0, 1, 0], [0, 0, 1]])
    tables = TrackTables(tmp_path)
    tables.write(followed(1, [[100, 50, 10, 20], [30, 30, 10, 10]], [1, 2]))
    tables.write(followed(5, [[90, 50, 10, 20], [20, 22, 10, 10]], [1, 2], now_from_before=pan))
    tables.close(complete=True)
    rows = read((tmp_path / "tracks.csv").read_text())[1:]
    assert [(r["heading_deg"], r["speed_px_per_frame"]) for r in rows[:2]] == [("", ""), ("", "")]
    assert [float(r["speed_px_per_frame"]) for r in rows[2:]] == [0, 2]
    assert rows[3]["heading_deg"] == "0.0"  # up the picture


def test_no_table_is_there_before_the_end_and_an_empty_clip_has_a_heading_line(tmp_path):
    tables = TrackTables(tmp_path)
    tables.write(followed(1, []))
    assert not list(tmp_path.glob("tracks*"))
    tables.close(complete=True)
    assert (tmp_path / "tracks.txt").read_text() == ""
    assert (tmp_path / "tracks.csv").read_text() == ",".join(COLUMNS) + "\n"


def test_none_is_there_after_a_discard(tmp_path):
    tables = TrackTables(tmp_path)
    tables.write(followed(1, [[0, 0, 1, 1]]))
    tables.discard()
    assert not list(tmp_path.iterdir())


def test_trails_are_carried_along_cut_to_length_and_forgotten():
    zoom = np.diag([2.0, 2.0, 1.0])
    trails = Trails(length=3, memory_frames=10)
    for number in range(1, 6):
        trails.add(followed(number, [[number - 1, -1, 2, 2]], now_from_before=zoom if number == 5 else None))
    assert trails.places == {1: [(3, 6, 0), (4, 8, 0), (5, 5, 0)]}
    trails.add(followed(15, []))
    assert 1 in trails.places
    trails.add(followed(16, [[0, 0, 2, 2]], [7], now_from_before=np.eye(3)))
    assert set(trails.places) == {7}
    assert not any(math.isnan(v) for trail in trails.places.values() for place in trail for v in place)
