"""Records: rows, columns, and the boxes of other libraries."""

import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from torchvision_dddas.config import Settings, check_settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.types import (
    Adjustment,
    Camera,
    Detections,
    DetectionTable,
    Frame,
    FrameResult,
    Positions,
    Telemetry,
    TrackedFrame,
    Tracks,
    as_picture,
    share_orders,
)

CORNERS = np.array([[10.0, 20, 40, 80], [0, 0, 5, 5]])
LOG = Telemetry(np.arange(3.0), np.full(3, 40.0), np.zeros(3), np.zeros((3, 2)))


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
    assert Detections.concat([found, Detections(found.box_px, found.score, kind="given")]).label.tolist() == [
        *label,
        "",
        "",
    ]


def test_classes_go_to_supervision_by_the_names_that_it_has_for_them(monkeypatch):
    monkeypatch.setitem(sys.modules, "supervision", SimpleNamespace(Detections=SimpleNamespace))
    named = Detections(CORNERS, np.ones(2), label=np.array(["car", ""])).to_supervision()
    assert named.data["class_name"].tolist() == ["car", ""]
    assert Detections(CORNERS, np.ones(2)).to_supervision().data == {}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"xyxy": np.zeros((2, 3))}, r"xyxy must have the shape \(N, 4\), got \(2, 3\)"),
        ({"xyxy": np.array([[5.0, 5, 5, 9]])}, "must hold finite left, top, right and bottom edges"),
        ({"xyxy": np.array([[5.0, 5, np.nan, 9]])}, "must hold finite"),
        ({"confidence": np.zeros(3)}, r"confidence must have the shape \(2,\), got \(3,\)"),
        ({"class_id": np.zeros(3, int)}, r"class_id must have the shape \(2,\), got \(3,\)"),
        ({"data": {"class_name": ["car"]}}, r"data\['class_name'\] must have the shape \(2,\), got \(1,\)"),
    ],
)
def test_boxes_and_classes_of_wrong_shapes_are_refused(wrong, message):
    with pytest.raises(InputError, match=message):
        Detections.from_supervision(SimpleNamespace(**{"xyxy": CORNERS, "confidence": None} | wrong))


def test_arrays_of_several_columns_are_split_by_name():
    tracks = Tracks(3, np.array([7]), np.array([[1.0, 2, 3, 4]]), np.array([0.5]), np.array([0]))
    columns = tracks.to_columns()
    box = ["x_px", "y_px", "width_px", "height_px"]
    assert list(columns) == ["frame", "identity", *box, "score", "row", "link", "class", "class_id"]
    assert columns["frame"].tolist() == [3]
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
        ({"altitude_m": np.ones(3)}, r"altitude_m of telemetry must have the shape \(2,\), a row per time, got \(3,\)"),
        ({"place": np.ones((2, 3))}, r"place of telemetry must have the shape \(2, 2\)"),
        ({"time_s": np.array([1.0, 0.0])}, "time_s of telemetry must not decrease"),
    )
    for given, message in cases:
        with pytest.raises(InputError, match=message):
            Telemetry(**{"time_s": np.arange(2.0), "altitude_m": np.ones(2), "speed_m_s": np.ones(2), **given})


def test_an_adjustment_calls_a_bound_that_is_not_set_none():
    assert Adjustment(3, "gates.max_size_px", float("inf"), 75.0, "").describe() == "gates.max_size_px none -> 75"


def test_a_record_prints_counts_and_ranges_in_one_short_line():
    tracks = Tracks(3, np.array([7, 9]), CORNERS, np.array([0.5, 0.9]), np.arange(2))
    assert repr(tracks).startswith("Tracks(2 rows, frame=3, identity: 7 to 9, box_px: 0 to 80, score: 0.5 to 0.9")
    result = FrameResult(TrackedFrame(3, Frame(3, 0.2, np.zeros((480, 640), np.uint8)), Detections(), tracks))
    assert repr(result) == "FrameResult(tracked=TrackedFrame(...))"
    assert "frame=Frame(...), detections=Detections(0 rows), tracks=Tracks(2 rows)" in repr(result.tracked)
    assert repr(result.frame) == "Frame(number=3, time_s=0.2, image: 480x640 0)"
    long = [replace(LOG, origin="/a/long/path" * 9, notes=("A note for the user.",) * 9), Positions(), result.tracked]
    assert all(len(repr(record)) < 300 and "array" not in repr(record) for record in long)


def test_a_table_is_sliced_by_a_number_and_goes_row_by_row():
    rows = list(Detections(CORNERS, np.ones(2)))
    assert [row.xyxy.tolist() for row in rows] == [[[10, 20, 50, 100]], [[0, 0, 5, 5]]]
    assert rows[0][-1].xyxy.tolist() == rows[0].xyxy.tolist() and len(LOG[1:]) == 2
    with pytest.raises(IndexError):
        LOG[3]


def test_tables_that_mean_something_else_are_not_joined():
    assert len(Telemetry.concat([LOG[:2], LOG[2:]])) == len(Telemetry.concat(row for row in LOG)) == 3
    with pytest.raises(InputError, match=r"must have the same geographic$"):
        Telemetry.concat([LOG[:2], replace(LOG[2:], geographic=False)])
    with pytest.raises(InputError, match=r"must have the same lonlat_deg$"):
        Positions.concat([Positions(), Positions(lonlat_deg=np.zeros((0, 2)))])
    found = Detections(CORNERS, np.ones(2))
    with pytest.raises(InputError, match="must have the same kind, got moving and given; "):
        Detections.concat([found, replace(found, kind="given")])
    with pytest.raises(InputError, match="concat got no tables"):
        Positions.concat([])


def test_places_are_columns_by_their_unit():
    assert "latitude_deg" in LOG.to_columns() and "north_m" in replace(LOG, geographic=False).to_columns()


def test_a_table_becomes_a_pandas_frame_of_its_columns(monkeypatch):
    tracks = Tracks(3, np.array([7]), np.array([[1.0, 2, 3, 4]]), np.array([0.5]), np.array([0]))
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))
    assert tracks.to_pandas().keys() == tracks.to_columns().keys()
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match="to_pandas needs pandas: pip install pandas"):
        tracks.to_pandas()


# -- The results of other libraries ------------------------------------------------------------------------------------


class Tensor:
    """What this package needs of a tensor on a device: ultralytics and torchvision give such."""

    def __init__(self, values):
        self.values = np.asarray(values)

    def detach(self):
        return self

    def cpu(self):
        return self

    def numpy(self):
        return self.values


BOXES = SimpleNamespace(
    xyxy=Tensor(CORNERS), conf=Tensor([0.5, 0.9]), cls=Tensor([2.0, 0.0]), id=None, data=Tensor(np.zeros((2, 6)))
)


@pytest.mark.parametrize(
    ("given", "label", "number"),
    [
        (BOXES, ["2", "0"], [2, 0]),
        (SimpleNamespace(boxes=BOXES, names={0: "person", 2: "car"}), ["car", "person"], [2, 0]),
        ({"boxes": Tensor(CORNERS), "scores": Tensor([0.5, 0.9]), "labels": Tensor([2, 0])}, ["2", "0"], [2, 0]),
        ({"boxes": CORNERS, "scores": [0.5, 0.9], "labels": ["car", "person"]}, ["car", "person"], [-1, -1]),
        (SimpleNamespace(bboxes=CORNERS, scores=[0.5, 0.9], labels=[2, -1]), ["2", ""], [2, -1]),
        (SimpleNamespace(boxes=BOXES, names=None), ["2", "0"], [2, 0]),
        (SimpleNamespace(xyxy=CORNERS, conf=[0.5, 0.9], cls=[2.0, np.nan]), ["2", ""], [2, -1]),
        (
            SimpleNamespace(xyxy=CORNERS, confidence=None, conf=[0.5, 0.9], class_id=None, cls=[2, 0]),
            ["2", "0"],
            [2, 0],
        ),
    ],
    ids=["Boxes", "Results", "torchvision", "words", "InstanceData", "no names", "unknown class", "empty fields"],
)
def test_results_of_other_libraries_keep_their_scores_and_classes(given, label, number):
    found = Detections.from_supervision(given)
    assert (found.xyxy == CORNERS).all() and found.score.tolist() == [0.5, 0.9]
    assert (found.label.tolist(), found.class_id.tolist()) == (label, number)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (SimpleNamespace(xyxy=CORNERS), "SimpleNamespace without confidence"),
        ([BOXES], "list without xyxy"),
        (CORNERS, "ndarray without xyxy"),
        (DetectionTable("a.csv", np.ones(2, int), CORNERS, np.ones(2), np.arange(2)), "give table.at(n) for frame n"),
        (SimpleNamespace(xyxy=CORNERS, confidence=[50.0, 90.0]), "got 50 to 90; divide percent by 100"),
        (SimpleNamespace(xyxy=CORNERS, confidence=[0.5, np.nan]), "must be finite"),
        (SimpleNamespace(xyxy=CORNERS / 100, confidence=[0.5, 0.9]), "multiply them by its width and height"),
    ],
)
def test_what_would_be_misread_is_refused_in_one_line(given, words):
    with pytest.raises(InputError) as error:
        Detections.from_supervision(given)
    assert words in str(error.value)


def test_arrays_of_other_lengths_are_no_record():
    for columns in ({"score": np.ones(3)}, {"score": np.ones(2), "label": np.array(["car"], object)}):
        with pytest.raises(InputError, match="of Detections must have 2 rows, got"):
            Detections(CORNERS, **columns)


@pytest.mark.parametrize(
    ("box", "orders"),
    [
        ([[0.19, 0.19, 0.06, 0.17]], ["yolo", "xywh"]),
        ([[0.9, 0.9, 0.1, 0.1]], ["yolo", "xywh"]),
        ([[0.1, 0.1, 0.3, 0.5]], ["xyxy", "xywh"]),
        ([[0.7, 0.8, 0.9, 0.9]], ["xyxy"]),
        ([[1, 1, 1, 1]], []),
        ([[0.5, 0.5, 1.0, 20]], []),
        (np.zeros((0, 4)), []),
    ],
)
def test_shares_of_a_picture_tell_the_orders_in_which_they_lie_inside(box, orders):
    assert share_orders(np.array(box)) == orders


def test_tracks_go_to_supervision_and_pandas_with_frame_and_class(monkeypatch):
    monkeypatch.setitem(sys.modules, "supervision", SimpleNamespace(Detections=SimpleNamespace))
    named: Any = {"label": np.array(["car", ""], object), "class_id": np.array([2, -1])}
    tracks = Tracks(7, np.array([1, 5]), CORNERS, np.ones(2), np.arange(2), **named)
    given = tracks.to_supervision()
    assert given.tracker_id.tolist() == [1, 5] and given.class_id.tolist() == [2, -1]
    assert given.data["class_name"].tolist() == ["car", ""]
    # Its annotators colour by class: without one, they need a number all the same.
    assert Tracks(7, np.array([1]), CORNERS[:1], np.ones(1), np.zeros(1, int)).to_supervision().class_id.tolist() == [0]
    joined = Tracks.concat([tracks, Tracks(9, np.array([5]), CORNERS[:1], np.ones(1), np.zeros(1, int))])
    columns = joined[1:].to_columns()
    assert (columns["frame"].tolist(), columns["class"].tolist(), columns["class_id"].tolist()) == (
        *([7, 9], ["", ""], [-1, -1]),
    )


# -- Arguments ---------------------------------------------------------------------------------------------------------

GREY = np.tile(np.arange(250, dtype=np.uint8), (180, 1))
COLOUR = np.dstack([GREY] * 3)


@pytest.mark.parametrize(
    "given",
    [
        COLOUR / 255.0,
        GREY.astype(np.float32),
        GREY.astype(np.int64),
        GREY.astype(np.uint16) * 5 + 29315,
        GREY > 100,
        np.moveaxis(COLOUR, -1, 0),
        np.moveaxis(COLOUR, -1, 0)[None] / 255.0,
        np.dstack([COLOUR, GREY]),
        GREY[None],
        COLOUR[None],
        Tensor(np.moveaxis(COLOUR, -1, 0) / 255.0),
        np.where(GREY > 200, np.nan, GREY / 255),
    ],
    ids=["float", "levels", "int64", "uint16", "bool", "CHW", "NCHW", "BGRA", "1HW", "NHWC", "tensor", "NaN"],
)
def test_a_picture_of_another_kind_is_refused_with_the_code_that_converts_it(given):
    with pytest.raises(InputError, match=r"frame must be uint8 of shape \(H, W\) or \(H, W, 3\), got ") as error:
        as_picture(given)
    code = str(error.value).partition("convert it: ")[2]
    made = as_picture(eval(code, {"frame": given, "np": np}))
    assert made.shape[:2] == GREY.shape and made.max() >= 200


def test_a_single_channel_is_dropped_and_what_no_code_converts_is_named():
    assert as_picture(GREY[..., None]).shape == GREY.shape and as_picture(COLOUR) is COLOUR
    others = ((None, "is None; could its file be read?"), ("a.png", "got str"), ([[1]], "got list"))
    for given, words in (*others, (COLOUR[..., :2], r"uint8 of shape \(180, 250, 2\); choose its channels$")):
        with pytest.raises(InputError, match=words):
            as_picture(given)


def test_the_name_of_a_configuration_is_no_settings():
    assert check_settings(None) == Settings()
    with pytest.raises(InputError, match=r"type Settings, got str: td\.load_settings\('fast'\) makes them"):
        check_settings("fast")


def test_a_camera_knows_what_it_was_given_also_a_heading_of_zero():
    camera = Camera("uav", (640, 480), (500.0, 500.0), (319.5, 239.5), heading_rad=0.0, height_m=float("nan"))
    assert camera.knows("heading_rad") and not camera.knows("pitch_rad") and not camera.knows("height_m")
    turned = replace(camera, pitch_rad=1.0)
    assert turned.knows("pitch_rad") and turned.knows("heading_rad") and not turned.knows("roll_rad")


def test_a_log_is_asked_for_one_time():
    log = Telemetry(np.arange(3.0), np.full(3, 40.0), np.zeros(3))
    flight = log.at(1.5)
    assert flight is not None and flight.altitude_m == 40.0
    with pytest.raises(InputError, match="one number, got"):
        log.at(np.array([0.5, 1.5]))  # type: ignore[arg-type]


def test_detections_may_be_lists():
    found = Detections([[40, 60, 20, 20]], [0.9], label=["car"])  # type: ignore[arg-type]
    assert found.xyxy.tolist() == [[40, 60, 60, 80]] and found.label.dtype == object and found.class_id.tolist() == [-1]
    assert Detections(CORNERS).score.tolist() == [1.0, 1.0]
    assert Detections([], []).xyxy.shape == (0, 4)  # type: ignore[arg-type]


def test_detections_may_be_tensors():
    torch = pytest.importorskip("torch")
    found = Detections(torch.tensor([[40.0, 60, 20, 20]]), torch.tensor([0.5]), class_id=torch.tensor([2]))
    assert found.xyxy.tolist() == [[40, 60, 60, 80]] and found.class_id.dtype == np.int64


@pytest.mark.parametrize("wrong", [{"box_px": [1, 2, 3]}, {"class_id": [np.nan]}, {"label": "car"}, {"score": 0.9}])
def test_what_is_no_column_of_detections_is_one_line(wrong):
    with pytest.raises(InputError, match=f"{next(iter(wrong))} of Detections") as error:
        Detections(**{"box_px": [[40, 60, 20, 20]], "score": [0.9], **wrong})
    assert np.ndim(*wrong.values()) or "give a list, such as [" in str(error.value)
