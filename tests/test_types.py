"""Records: rows, columns, and the boxes of other libraries."""

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Adjustment, Detections, Positions, Telemetry, Tracks

CORNERS = np.array([[10.0, 20, 40, 80], [0, 0, 5, 5]])


def test_boxes_of_another_detector_come_back_as_they_were():
    found = Detections.from_supervision(SimpleNamespace(xyxy=CORNERS, confidence=np.array([0.5, 0.9])))
    assert found.box_px.tolist() == [[10, 20, 30, 60], [0, 0, 5, 5]] and found.score.tolist() == [0.5, 0.9]
    assert (found.xyxy == CORNERS).all() and found.kind == "given" and np.isnan(found.heading_rad).all()
    assert Detections.from_supervision(SimpleNamespace(xyxy=CORNERS, confidence=None)).score.tolist() == [1, 1]
    empty = SimpleNamespace(xyxy=np.zeros((0, 4)), confidence=np.zeros(0), class_id=np.zeros(0, int), data={})
    assert len(Detections.from_supervision(empty)) == len(Detections.from_supervision(empty).label) == 0


@pytest.mark.parametrize(
    ("classes", "label"),
    [
        ({}, ["", ""]),
        ({"class_id": None, "data": {}}, ["", ""]),
        ({"class_id": np.array([2, 0]), "data": {}}, ["2", "0"]),
        ({"class_id": np.array([2, 0]), "data": {"class_name": np.array(["car", "person"])}}, ["car", "person"]),
        ({"data": {"class_name": ["car", None]}}, ["car", ""]),
    ],
)
def test_classes_of_another_detector_stay_with_their_rows(classes, label):
    found = Detections.from_supervision(SimpleNamespace(xyxy=CORNERS, confidence=None, **classes))
    assert found.label.tolist() == label
    assert found[::-1].label.tolist() == label[::-1] and found[np.array([False, True])].label.tolist() == label[1:]
    assert Detections.concat([found, Detections(found.box_px, found.score)]).label.tolist() == [*label, "", ""]


def test_classes_go_to_supervision_by_the_names_that_it_has_for_them(monkeypatch):
    monkeypatch.setitem(sys.modules, "supervision", SimpleNamespace(Detections=SimpleNamespace))
    named = Detections(CORNERS, np.ones(2), label=np.array(["car", ""])).to_supervision()
    assert named.data["class_name"].tolist() == ["car", ""]
    assert Detections(CORNERS, np.ones(2)).to_supervision().data == {}


@pytest.mark.parametrize(
    ("xyxy", "confidence", "message"),
    [
        (np.zeros((2, 3)), None, r"xyxy must have the shape \(N, 4\), got \(2, 3\)"),
        (np.array([[5.0, 5, 5, 9]]), None, "must hold finite left, top, right and bottom edges"),
        (np.array([[5.0, 5, np.nan, 9]]), None, "must hold finite"),
        (CORNERS, np.zeros(3), r"confidence must have the shape \(2,\), got \(3,\)"),
    ],
)
def test_boxes_of_wrong_shapes_are_refused(xyxy, confidence, message):
    with pytest.raises(InputError, match=message):
        Detections.from_supervision(SimpleNamespace(xyxy=xyxy, confidence=confidence))


@pytest.mark.parametrize(
    ("classes", "message"),
    [
        ({"class_id": np.zeros(3, int)}, r"class_id must have the shape \(2,\), got \(3,\)"),
        ({"data": {"class_name": ["car"]}}, r"data\['class_name'\] must have the shape \(2,\), got \(1,\)"),
    ],
)
def test_classes_of_wrong_shapes_are_refused(classes, message):
    with pytest.raises(InputError, match=message):
        Detections.from_supervision(SimpleNamespace(xyxy=CORNERS, confidence=None, **classes))


def test_arrays_of_several_columns_are_split_by_name():
    tracks = Tracks(3, np.array([7]), np.array([[1.0, 2, 3, 4]]), np.array([0.5]), np.array([0]))
    columns = tracks.to_columns()
    assert list(columns) == ["identity", "x_px", "y_px", "width_px", "height_px", "score", "row", "link"]
    assert columns["width_px"].tolist() == [3] and tracks.id.tolist() == [7] and tracks.xyxy.tolist() == [[1, 2, 4, 6]]
    assert {"east_m", "north_m", "var_north_m2"} <= set(Positions().to_columns())


def test_the_confidence_of_a_link_is_unknown_unless_given_and_stays_with_its_row():
    boxes = np.tile([1.0, 2, 3, 4], (3, 1))
    known = Tracks(3, np.arange(3) + 1, boxes, np.ones(3), np.arange(3), np.array([np.nan, 0.25, 0.75]))
    unknown = Tracks(3, np.arange(3) + 1, boxes, np.ones(3), np.arange(3))
    assert len(Tracks(3).link) == 0 and np.isnan(unknown.link).all()
    joined = Tracks.concat([known[1:], unknown[:1], known[np.array([2, 1])]])
    np.testing.assert_array_equal(joined.link, [0.25, 0.75, np.nan, 0.75, 0.25])


def test_telemetry_takes_lists_and_refuses_columns_of_other_lengths_and_times_that_decrease():
    lists: Any = [0.0, 1.0], [40.0, 42.0], [1.0, 1.0]
    flight = Telemetry(*lists).at(0.5)
    assert flight is not None and flight.altitude_m == 41.0
    cases: Any = (
        ({"altitude_m": np.ones(3)}, r"altitude_m of telemetry must have the shape \(2,\), a row a time, got \(3,\)"),
        ({"place": np.ones((2, 3))}, r"place of telemetry must have the shape \(2, 2\)"),
        ({"time_s": np.array([1.0, 0.0])}, "time_s of telemetry must not decrease"),
    )
    for given, message in cases:
        with pytest.raises(InputError, match=message):
            Telemetry(**{"time_s": np.arange(2.0), "altitude_m": np.ones(2), "speed_m_s": np.ones(2), **given})


def test_an_adjustment_calls_a_bound_that_is_not_set_none():
    assert Adjustment(3, "gates.max_size_px", float("inf"), 75.0, "").describe() == "gates.max_size_px none -> 75"


def test_a_table_becomes_a_pandas_frame_of_its_columns(monkeypatch):
    tracks = Tracks(3, np.array([7]), np.array([[1.0, 2, 3, 4]]), np.array([0.5]), np.array([0]))
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))
    assert tracks.to_pandas().keys() == tracks.to_columns().keys()
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match="to_pandas needs pandas: pip install pandas"):
        tracks.to_pandas()
