"""Tables of detections: what may be read, and one line with file and line number for what may not."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.detection_tables import (
    MOT_NAMES,
    ORDERS,
    check_table,
    read_detections,
    read_header,
    read_rows,
)
from torchvision_dddas.io.tables import LAST_FRAME
from torchvision_dddas.types import DetectionTable

NAMED = "frame,x_px,y_px,width_px,height_px"


@pytest.fixture
def write(tmp_path):
    def write(text):
        path = tmp_path / "det.txt"
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.fixture
def read(write):
    return lambda text: read_detections(write(text))


@pytest.mark.parametrize(
    "text",
    [
        "3 -1 10 20 30 40 0.5",
        "3, 8, 10, 20, 30, 40, 0.5",
        "3.0,person,1e1,20,30,40,.5,words,are,ignored",
        "\ufeff3,-1,10,20,30,40,0.5\r\n\r\n",
        "frame,target,x_px,y_px,width_px,height_px,score,kind\n3,1,10.00,20.00,30.00,40.00,0.5000,moving",
        "score,height_px,width_px,y_px,x_px,frame\n0.5,40,30,20,10,3",
    ],
)
def test_commas_blanks_and_named_columns_mean_the_same(read, text):
    table = read(text)
    assert (table.frame.tolist(), table.box_px.tolist(), table.score.tolist()) == ([3], [[10, 20, 30, 40]], [0.5])


@pytest.mark.parametrize("name", ["class", "class_name", "label"])
def test_classes_stay_with_their_rows_in_the_order_of_frames(read, name):
    table = read(f"{NAMED},{name}\n2,1,2,3,4,person\n1,5,6,7,8,\n1,6,6,7,8,car")
    assert (table.at(1).label.tolist(), table.at(2).label.tolist(), len(table.at(3).label)) == (
        ["", "car"],
        ["person"],
        0,
    )


def test_a_table_without_classes_has_empty_ones(read):
    assert (
        read("1,-1,2,3,4,5,0.5,person").at(1).label.tolist() == read(f"{NAMED}\n1,2,3,4,5").at(1).label.tolist() == [""]
    )


@pytest.mark.parametrize("text", ["1,-1,2,3,4,5", "1,-1,2,3,4,5,", f"{NAMED}\n1,2,3,4,5"])
def test_a_missing_score_is_one_and_motion_is_unknown(read, text):
    found = read(text).at(1)
    assert (found.kind, found.area_px.tolist(), found.score.tolist()) == ("given", [20], [1])
    assert np.isnan([found.heading_rad, found.speed_px]).all()


def test_rows_are_sorted_by_frame_and_keep_their_order_within_it(read):
    table = read("5,-1,1,0,9,9\n2,-1,2,0,9,9\n\n5,-1,3,0,9,9\n2,-1,4,0,9,9\n")
    assert table.frame.tolist() == [2, 2, 5, 5] and (table.first, table.last) == (2, 5)
    assert table.box_px[:, 0].tolist() == [2, 4, 1, 3] and table.line.tolist() == [2, 5, 1, 4]
    assert table.at(5).box_px[:, 0].tolist() == [1, 3] and len(table.at(3)) == 0


@pytest.mark.parametrize("text", ["", "\n \n", f"{NAMED}\n"])
def test_a_table_without_rows_is_valid_because_detect_writes_one(read, text):
    table = read(text)
    assert (len(table), table.first, table.last, len(table.at(1)), table.probable) == (0, 0, 0, 0, True)


@pytest.mark.parametrize(
    ("good", "bad", "refused"), [(4358, 1, True), (199, 1, True), (198, 2, False), (99, 1, False), (0, 2, False)]
)
def test_a_few_scores_outside_0_to_1_are_mistakes_and_many_are_another_scale(read, good, bad, refused):
    text = "".join(f"{1 + k // 1000},-1,2,3,4,5,0.5\n" for k in range(good)) + "9,-1,2,3,4,5,1.3\n" * bad
    if refused:
        with pytest.raises(InputError, match=rf"line {good + 1}: score is 1.3; {bad} of {good + bad} scores lie"):
            read(text)
    else:
        assert read(text).certain


@pytest.mark.parametrize(("kinds", "own"), [(("moving",) * 2, True), (("moving", "given"), False), ((), False)])
def test_a_csv_whose_kinds_are_all_moving_is_our_own_and_certain(read, kinds, own):
    rows = [f"{n},10,20,30,40, {kind} ,0.55" for n, kind in enumerate(kinds, 1)]
    table = read("\n".join([f"{NAMED},kind,score", *rows]))
    assert (table.own, table.certain, table.probable) == (own, own, True)
    assert not read("1,-1,2,3,4,5,0.5,moving").own


def boxes(right, bottom, score, own=False):
    n = len(right)
    box_px = np.stack([np.asarray(right) - 10, np.asarray(bottom) - 20, np.full(n, 10), np.full(n, 20)], axis=1)
    return DetectionTable("det.txt", np.ones(n, int), box_px.astype(float), np.full(n, score), np.arange(n) + 1, own)


def test_the_extent_comes_from_thirty_likely_boxes_without_three_stray_ones():
    right, bottom = np.arange(601, 641), np.full(40, 480)
    strays = np.array([1e9, 5e6, 7e7])
    assert boxes(right, bottom, 0.9).extent == (637, 480)
    assert boxes([*right, *strays], [*bottom, *strays], 0.9).extent == (640, 480)
    assert boxes([*right, *strays, 800], [*bottom, *strays, 500], 0.9).extent == (800, 500)
    few = np.arange(1, 31)
    assert boxes(few, few, 0.5).extent == (27, 27)
    assert boxes(few[1:], few[1:], 0.5).extent is boxes(few, few, 0.4).extent is None
    # Where scores are not probabilities, every row counts.
    assert boxes(few, few, -0.4).extent == boxes(few, few, 0.4, own=True).extent == (27, 27)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1,-1,2,3,4,5\n\n1,-1,2,3,4,x", "line 3: height_px is 'x'; wanted pixels from 0.001 to 1e+09"),
        ("1,-1,inf,3,4,5", "x_px is 'inf'"),
        ("1,-1,2,3,4,5,nan", "score is 'nan'; wanted a finite number"),
        ("1,-1,2,3,0.000999,5", "width_px is '0.000999'; wanted pixels from 0.001"),
        ("-1,-1,2,3,4,5", "frame is '-1'; wanted a whole number from 1 to 10000000, or from 0 throughout"),
        # Other columns than those of MOTChallenge.
        (
            "1,104.1,101.9,144.1,131.9,0.9,2\n2,108.3,103.9,148.1,133.9,0.9,2",
            "every height is below 1 px; wanted frame",
        ),
        (
            "1,104.1,101.9,144.1,131.9,0.9,2\n2,108.3,103.9,148.1,133.9,0.9,2",
            "frame,id,x1,y1,x2,y2[,score] with --box-format xyxy, or a first line",
        ),
        ("1,104.1,101.9,144.1,131.9,9,2\n2,108.3,103.9,148.1,133.9,9,2", "the second column holds no identities"),
        ("".join(f"{k},2,0.9,104,101,40,30\n" for k in range(1, 7)), "every x is below 1 px"),
        (f"{LAST_FRAME + 1},-1,2,3,4,5", "frame is"),
        ("1,-1,2,3,4", "5 columns; wanted frame,id,x,y,w,h[,score]"),
        ("1:-1:2:3:4:5", "1 column; wanted"),
        ("frame,x,y\n1,2,3", "lacks x_px, y_px, width_px, height_px; its columns are frame, x, y"),
        ("hello world", "its columns are hello world"),
        (f"{NAMED}\n1,2,3,4", "line 2: 4 columns; the first line names 5"),
        (f"{NAMED},cut\n1,0,0,5,5,maybe\n", "line 2: cut is 'maybe'; wanted 1 if the border"),
    ],
)
def test_a_mistake_is_one_line_that_names_file_and_line(refused, text, words):
    assert words in refused(read_detections, text)


def test_identities_and_cuts_are_kept_where_a_table_has_them(read):
    table = read(f"{NAMED},identity,cut\n1,0,0,5,5,7,1\n1,0,0,5,5,,0\n2,0,0,5,5,x,\n")
    assert table.identity.tolist() == [7, -1, -1] and table.cut.tolist() == [True, False, False]
    by_place = read("1,3,0,0,5,5\n1,-1,0,0,5,5\n1,nan,0,0,5,5\n")
    assert by_place.identity.tolist() == [3, -1, -1] and by_place.cut is None


def test_the_words_of_a_table_are_kept_for_a_copy_with_more_columns(write):
    named = write('frame,note,x_px,y_px,width_px,height_px\n2,b,0,0,5,5\n1,"a, b",0,0,5,5\n')
    assert read_header(named)[:2] == ["frame", "note"]
    rows = [["1", "a, b", "5", "5"], ["2", "b", "5", "5"]]
    assert read_rows(named, ("x_px", "y_px")) == (["frame", "note", "width_px", "height_px"], rows)
    header, rows = read_rows(write("2 1 0 0 5 5 0.50 x\n1 1 0 0 5 5\n"))
    assert header == [*MOT_NAMES, "column_8"] and rows[0] == ["1", "1", "0", "0", "5", "5", "", ""]
    assert read_header(write("")) == []


# -- Boxes of other kinds than x, y, width, height in pixels -----------------------------------------------------------

PLACES = np.array([[20 + 7 * k, 30 + 3 * k, 12 + k % 2, 25 + k % 3] for k in range(12)], float)  # x, y, width, height
SHAPE = (320, 240)


def unique(values: Any) -> set:
    return set(values.tolist())


def in_order(order: str, shares: bool) -> np.ndarray:
    first, size = PLACES[:, :2], PLACES[:, 2:]
    box = {"xywh": PLACES, "xyxy": np.c_[first, first + size], "yolo": np.c_[first + size / 2, size]}[order]
    return box / (*SHAPE, *SHAPE) if shares else box


def lines_of(box: np.ndarray, second: object = -1, score: object = 0.5, sep: str = ",") -> str:
    return "".join(
        sep.join(map(str, (k, second, *(f"{v:.7f}" for v in row), score))) + "\n" for k, row in enumerate(box, 1)
    )


@pytest.mark.parametrize(
    ("order", "shares", "given"),
    [
        ("xyxy", True, None),
        ("xyxy", False, None),
        ("xywh", False, None),
        *((order, shares, order) for order in ("yolo", "xyxy", "xywh") for shares in (True, False)),
    ],
)
def test_the_order_of_a_box_comes_from_its_numbers_or_is_given(write, order, shares, given):
    table = read_detections(write(lines_of(in_order(order, shares))), order=given, size=SHAPE)
    np.testing.assert_allclose(table.box_px, PLACES, atol=1e-3)
    assert bool(table.notes) == (shares or (order, given) == ("xyxy", None))


@pytest.mark.parametrize("shares", [True, False])
@pytest.mark.parametrize(("order", "names"), [(order, names) for order, several in ORDERS.items() for names in several])
def test_columns_of_other_programs_are_known_by_their_names(write, order, names, shares):
    header = f"frame_index,tracker_id,{names.replace(' ', ',')},confidence"
    table = read_detections(write(header + "\n" + lines_of(in_order(order, shares), 4)), order=None, size=SHAPE)
    np.testing.assert_allclose(table.box_px, PLACES, atol=1e-3)
    assert (table.frame[-1], unique(table.identity), set(table.score)) == (12, {4}, {0.5})


def test_the_class_of_yolo_is_kept_and_shares_without_a_size_are_refused(write, refused):
    table = read_detections(write(lines_of(in_order("yolo", True), 0, sep=" ")), order="yolo", size=SHAPE)
    assert set(table.at(1).class_id) == {0} and set(table.at(1).label) == {"0"} and unique(table.identity) == {-1}
    assert "are shares of a picture (yolo or xywh), whose size is not known" in refused(
        read_detections, lines_of(in_order("yolo", True))
    )


@pytest.mark.parametrize(
    ("header", "order"),
    [
        ("Frame,X1,Y1,X2,Y2,Score", "xyxy"),
        ("frame,bbox_x,bbox_y,bbox_w,bbox_h,conf", "xywh"),
        ("frame,bbox_left,bbox_top,bbox_width,bbox_height,conf", "xywh"),
        ("FRAME_ID,box_xmin,box_ymin,box_xmax,box_ymax,Confidence", "xyxy"),
        ("frame,xcenter,ycenter,width,height,confidence,class,name", "yolo"),
    ],
)
def test_capitals_prefixes_and_the_names_of_yolov5_are_known(write, header, order):
    cells = [[k, *row, 0.9, 3, "car"][: header.count(",") + 1] for k, row in enumerate(in_order(order, False), 1)]
    table = read_detections(write("\n".join([header, *(",".join(map(str, row)) for row in cells)])))
    np.testing.assert_allclose(table.box_px, PLACES)
    assert (table.first, set(table.score)) == (1, {0.9})
    if "class" in header:
        assert (unique(table.class_id), unique(table.label)) == ({3}, {"car"})


def test_shares_and_percent_without_names_are_refused_where_their_order_is_not_known(write):
    for order in ("yolo", "xywh"):
        with pytest.raises(InputError, match=r"boxes in \[0, 1\] may be yolo or xywh; pass --box-format"):
            read_detections(write(lines_of(in_order(order, True))), order=None, size=SHAPE)
    # Some of these would leave the picture if they were top left corners.
    table = read_detections(
        write(lines_of(in_order("yolo", True) + np.array([0.655, 0, 0, 0]))), order=None, size=SHAPE
    )
    np.testing.assert_allclose(table.box_px, PLACES + np.array([0.655 * SHAPE[0], 0, 0, 0]), atol=1e-3)


@pytest.mark.parametrize("order", ["yolo", "xyxy", "xywh"])
@pytest.mark.parametrize("many", [True, False])
def test_boxes_in_percent_are_read_where_there_are_many_and_noted_else(write, order, many):
    count = 24 if many else 6
    first = np.c_[np.linspace(3, 70, count), np.linspace(60, 7, count)]
    box = np.c_[first + 0.123, np.full((count, 2), 8)] + (4 * np.eye(4)[:2].sum(0) if order == "yolo" else 0)
    box[:, 2:] += box[:, :2] if order == "xyxy" else 0
    given = order if many else None
    table = read_detections(write(lines_of(box)), order=given, size=(1280, 720))
    if many:
        corner = (first + 0.123) * [12.80, 7.20]
        np.testing.assert_allclose(table.box_px, np.c_[corner, np.full((count, 2), 8) * [12.80, 7.20]], atol=1e-4)
        assert any("in percent of 1280 x 720" in note for note in table.notes)
    else:
        assert any("divide them by 100 if they are percent" in note for note in table.notes)


def test_labels_of_a_folder_in_pixels_are_centre_and_size_or_refused(tmp_path):
    for k in range(8):
        (tmp_path / f"img_{k:03d}.txt").write_text(f"2 {60 + 5 * k} 70 90 90 0.9\n")
    table = read_detections(tmp_path, order=None, size=SHAPE)
    np.testing.assert_allclose(table.box_px[0], [15, 25, 90, 90])
    assert unique(table.class_id) == {2} and unique(table.identity) == {-1}
    assert "centre and size in pixels" in " ".join(table.notes)
    for k in range(8):
        (tmp_path / f"img_{k:03d}.txt").write_text(f"2 {60 + 9 * k} {70 + 5 * k} {80 + 9 * k} {90 + 5 * k} 0.9\n")
    with pytest.raises(InputError, match="corners; pass --box-format xyxy if they are"):
        read_detections(tmp_path, order=None, size=SHAPE)
    table = read_detections(tmp_path, order="xyxy", size=SHAPE)
    np.testing.assert_allclose(table.box_px[0], [60, 70, 20, 20])
    assert unique(table.class_id) == {2} and unique(table.identity) == {-1}


def test_frames_that_count_from_0_are_the_pictures_in_order(read):
    table = read("frame,x1,y1,x2,y2\n2,0,0,5,5\n0,0,0,5,5\n1,0,0,5,5\n")
    assert table.frame.tolist() == [1, 2, 3] and "frames count from 0" in " ".join(table.notes)
    assert read("1,-1,0,0,5,5\n").notes == ()


@pytest.mark.parametrize("first", [0, 1, 7])
def test_a_folder_of_yolos_labels_is_read_frame_by_frame(tmp_path, first):
    for k, row in enumerate(in_order("yolo", True)):
        (tmp_path / f"clip_{first + k}.txt").write_text("2 {:.7f} {:.7f} {:.7f} {:.7f} 0.9 5\n\n".format(*row) * 2)
    (tmp_path / "classes.txt").write_text("person\ncar\n")
    table = read_detections(tmp_path, order=None, size=SHAPE)
    np.testing.assert_allclose(table.box_px[::2], PLACES, atol=1e-3)
    assert (table.first, table.last, set(table.score), unique(table.class_id)) == (
        first or 1,
        (first or 1) + 11,
        {0.9},
        {2},
    )
    # With the pictures of the clip their names count.
    named = read_detections(tmp_path, order=None, size=SHAPE, pictures=[f"clip_{first + k}" for k in range(12)])
    assert (named.first, named.last) == (1, 12)
    (tmp_path / "clip_x.txt").write_text("0 0.5 0.5 0.1 0.1\n")
    with pytest.raises(InputError, match=r"clip_x\.txt belongs to no picture"):
        read_detections(tmp_path, order=None, size=SHAPE)
    (tmp_path / "clip_x.txt").rename(tmp_path / "clip_99.txt").write_text("0 0.1 0.1 0.2 0.2 0.3 0.3 0.4 0.1\n")
    with pytest.raises(InputError, match=r"clip_99\.txt, line 1: 9 columns; wanted class cx cy w h"):
        read_detections(tmp_path, order=None, size=SHAPE)


@pytest.mark.parametrize(
    ("scores", "read_as", "note"),
    [
        ((87, 92, 40), [0.87, 0.92, 0.4], "read as percent"),
        ((87.5, 92, 40), [87.5, 92, 40], ""),
        ((1, 1, 0), [1, 1, 0], ""),
        ((0.3, "", 0.4), [0.3, 1, 0.4], "1 of 3 rows have no score"),
    ],
)
def test_scores_in_percent_and_missing_ones_are_noted(read, scores, read_as, note):
    table = read("".join(f"{k},-1,{10 * k},2,30,4,{score}\n" for k, score in enumerate(scores, 1)))
    assert table.score.tolist() == read_as and note in " ".join(table.notes)


def test_scores_with_decimals_up_to_100_are_percent_where_a_name_says_scores(read):
    table = read(f"{NAMED},score\n1,0,0,5,5,87.5\n2,0,0,5,5,40\n")
    assert table.score.tolist() == [0.875, 0.4] and "read as percent" in " ".join(table.notes)


# -- Whether a table fits its clip -------------------------------------------------------------------------------------


def rows_on(frames, box_px=(10, 10, 5, 5), score=1.0):
    n = len(frames)
    box = np.broadcast_to(np.array(box_px, float), (n, 4))
    return DetectionTable("det.txt", np.array(frames, int), box, np.full(n, score), np.arange(n) + 1)


def clip(count, exact=True):
    return SimpleNamespace(name="walk.mp4", count=count, exact=exact, size=(64, 48))


OWN = replace(rows_on([1, 2, 3], score=0.5), own=True)


@pytest.mark.parametrize(
    ("table", "interval", "source", "notes"),
    [
        (rows_on([1, 2, 2, 5]), 1, clip(5), []),
        (rows_on([1, 6, 11]), 5, clip(14), []),
        (rows_on([1, 2, 9]), 1, clip(5, exact=False), []),  # a length that is only guessed refuses nothing
        (rows_on([1, 2, 9]), 1, None, []),
        (rows_on([1, 2, 3, 4, 5, 6, 6]), 5, None, ["4 of 7 rows lie on frames that --interval 5 leaves out"]),
        (rows_on([1, 6, 21]), 1, None, ["--interval 5 if"]),
        (rows_on([1, 6]), 1, None, []),  # two frames do not show an interval
        (rows_on([1, 2, 3], score=43.3), 1, None, ["from 43.3 to 43.3 are not probabilities"]),
        (OWN, 1, None, ["all rows are moving targets of dddas detect: every row counts as certain"]),
        (rows_on([]), 1, clip(5), ["detections det.txt holds no rows"]),
        *(
            (rows_on([1, 2, 3], box), 1, clip(3), ["3 boxes lie wholly outside"])
            for box in ((-9, 10, 9, 5), (64, 9, 5, 5))
        ),
        (rows_on([1, 2, 3], (20, 55, 5, 5)), 1, clip(3), ["are x and y swapped?"]),
        *((rows_on([1, 2, 3], box), 1, clip(3), []) for box in ((-8.5, 10, 9, 5), (63.5, 9, 5, 5), (10, 47.5, 5, 5))),
    ],
)
def test_what_is_left_out_or_read_in_an_unexpected_way_is_noted(table, interval, source, notes):
    found = check_table(table, interval, source)
    assert len(found) == len(notes) and all(words in note for words, note in zip(notes, found, strict=True))
    assert all("swapped" in words for words, note in zip(notes, found, strict=True) if "swapped" in note)


def test_a_table_of_another_clip_or_interval_is_refused():
    with pytest.raises(InputError, match=r"det\.txt, line 3: .* frame 9 but walk\.mp4 ends after frame 5 \(2 of 4"):
        check_table(rows_on([1, 5, 6, 9]), 1, clip(5))
    with pytest.raises(InputError, match=r"no row on frames 1, 6, 11, .* --interval 5 .* first row is on frame 5"):
        check_table(rows_on([5, 10, 15]), 5)


def test_the_classes_of_a_folder_of_labels_have_the_names_of_classes_txt(tmp_path):
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "a_1.txt").write_text("0 0.5 0.5 0.1 0.1\n7 0.2 0.2 0.1 0.1\n")
    for encoding in ("utf-8", "utf-8-sig"):  # some editors begin a file with a byte order mark
        (tmp_path / "classes.txt").write_text("person\ncar\n", encoding)
        read = read_detections(tmp_path / "labels", size=(640, 480))
        assert read.classes(slice(None))[0].tolist() == ["person", "7"]
