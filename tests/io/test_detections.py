"""Tables of detections: what may be read, and one line with file and line number for what may not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.detection_tables import LAST_FRAME, read_detections
from torchvision_dddas.types import DetectionTable


@pytest.fixture
def table(tmp_path):
    def write(text):
        path = tmp_path / "det.txt"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_rows_of_the_benchmarks_are_read_as_they_stand(table):
    read = read_detections(table("1,-1,649.441,231.502,44.417,86.13,0.995,-1,-1,-1\n2,7,1,2,3,4,0.5\n"))
    assert read.frame.tolist() == [1, 2]
    assert read.box_px.tolist() == [[649.441, 231.502, 44.417, 86.13], [1, 2, 3, 4]]
    assert read.score.tolist() == [0.995, 0.5]
    assert (read.first, read.last, len(read)) == (1, 2, 2)


@pytest.mark.parametrize(
    "text",
    [
        "3 -1 10 20 30 40 0.5",
        "3\t-1\t10\t20\t30\t40\t0.5\t-1",
        "3, 8, 10, 20, 30, 40, 0.5",
        "3.0,person,1e1,20,30,40,.5,words,are,ignored",
        "\ufeff3,-1,10,20,30,40,0.5\r\n\r\n",
        "frame,target,x_px,y_px,width_px,height_px,score,kind\n3,1,10.00,20.00,30.00,40.00,0.5000,moving",
        "score,height_px,width_px,y_px,x_px,frame\n0.5,40,30,20,10,3",
    ],
)
def test_commas_blanks_and_named_columns_say_the_same(table, text):
    read = read_detections(table(text))
    assert (read.frame.tolist(), read.box_px.tolist(), read.score.tolist()) == ([3], [[10, 20, 30, 40]], [0.5])


@pytest.mark.parametrize("text", ["1,-1,2,3,4,5", "1,-1,2,3,4,5,", "frame,x_px,y_px,width_px,height_px\n1,2,3,4,5"])
def test_a_missing_score_is_one(table, text):
    assert read_detections(table(text)).score.tolist() == [1]


def test_unsorted_rows_are_sorted_by_frame_and_keep_their_order_within_it(table):
    read = read_detections(table("5,-1,1,0,9,9\n2,-1,2,0,9,9\n\n5,-1,3,0,9,9\n2,-1,4,0,9,9\n"))
    assert read.frame.tolist() == [2, 2, 5, 5]
    assert read.box_px[:, 0].tolist() == [2, 4, 1, 3]
    assert read.line.tolist() == [2, 5, 1, 4]
    assert read.at(5).box_px[:, 0].tolist() == [1, 3]
    assert len(read.at(3)) == 0


def test_a_frame_s_detections_are_of_the_kind_given_with_unknown_motion(table):
    found = read_detections(table("1,-1,2,3,4,5,0.9")).at(1)
    assert (found.kind, found.area_px.tolist(), found.score.tolist()) == ("given", [20], [0.9])
    assert np.isnan([found.heading_rad, found.speed_px]).all()


@pytest.mark.parametrize("text", ["", "\n \n", "frame,x_px,y_px,width_px,height_px\n"])
def test_a_table_without_rows_is_valid_because_detect_writes_one(table, text):
    read = read_detections(table(text))
    assert (len(read), read.first, read.last, len(read.at(1)), read.probable) == (0, 0, 0, 0, True)


@pytest.mark.parametrize(("score", "probable"), [("0", True), ("1", True), ("43.3", False), ("-1", False)])
def test_one_score_outside_0_to_1_means_that_none_is_a_probability(table, score, probable):
    read = read_detections(table(f"1,-1,2,3,4,5,0.5\n1,-1,2,3,4,5,{score}\n"))
    assert read.probable is probable
    assert read.score.tolist() == [0.5, float(score)]


@pytest.mark.parametrize(
    ("good", "bad", "refused"), [(4358, 1, True), (199, 1, True), (198, 2, False), (99, 1, False), (0, 2, False)]
)
def test_a_few_scores_outside_0_to_1_are_mistakes_and_many_are_another_scale(table, good, bad, refused):
    rows = ["2,-1,2,3,4,5,1.3\n"] * bad + ["1,-1,2,3,4,5,0.5\n"] * good
    path = table("".join(rows[bad:] + rows[:bad]))
    if not refused:
        assert read_detections(path).certain
        return
    with pytest.raises(InputError) as error:
        read_detections(path)
    assert f"det.txt, line {good + 1}: score is 1.3; {bad} of {good + bad} scores lie outside" in str(error.value)


@pytest.mark.parametrize(
    ("kinds", "own"), [(("moving", "moving"), True), (("moving", "given"), False), (("detection",) * 2, False), ((), 0)]
)
def test_a_csv_whose_kinds_are_all_moving_is_our_own_and_certain(table, kinds, own):
    rows = [f"{n},10,20,30,40, {kind} ,0.55" for n, kind in enumerate(kinds, 1)]
    read = read_detections(table("\n".join(["frame,x_px,y_px,width_px,height_px,kind,score", *rows])))
    assert (read.own, read.certain, read.probable) == (own, own, True)
    assert not read_detections(table("1,-1,2,3,4,5,0.5,moving")).own


def boxes(right, bottom, score, own=False):
    n = len(right)
    box_px = np.stack([np.asarray(right) - 10, np.asarray(bottom) - 20, np.full(n, 10), np.full(n, 20)], axis=1)
    return DetectionTable("det.txt", np.ones(n, int), box_px.astype(float), np.full(n, score), np.arange(n) + 1, own)


def test_three_stray_boxes_leave_the_extent_as_it_is_and_a_fourth_counts():
    right, bottom = np.arange(601, 641), np.full(40, 480)
    assert boxes(right, bottom, 0.9).extent == (637, 480)
    strays = np.array([1e9, 5e6, 7e7])
    assert boxes([*right, *strays], [*bottom, *strays], 0.9).extent == (640, 480)
    assert boxes([*right, *strays, 800], [*bottom, *strays, 500], 0.9).extent == (800, 500)


def test_the_extent_is_told_by_thirty_likely_boxes_at_least():
    right, bottom = np.arange(1, 31), np.arange(1, 31)
    assert boxes(right, bottom, 0.5).extent == (27, 27)
    assert boxes(right[1:], bottom[1:], 0.5).extent is None
    assert boxes(right, bottom, 0.4).extent is None
    # Where scores are no probabilities, every row counts.
    assert boxes(right, bottom, -0.4).extent == boxes(right, bottom, 0.4, own=True).extent == (27, 27)


BAD = [
    ("1,-1,2,3,4,x", "height is 'x'; wanted a finite number"),
    ("1,-1,2,nan,4,5", "y is 'nan'"),
    ("1,-1,inf,3,4,5", "x is 'inf'"),
    ("1,-1,2,3,4,5,nan", "score is 'nan'"),
    ("1,-1,2,3,4,5,high", "score is 'high'"),
    ("1,-1,2,3,-4,5", "width is '-4'; wanted pixels, 0.001 at least"),
    ("1,-1,2,3,4,0", "height is '0'; wanted pixels, 0.001 at least"),
    ("1,-1,2,3,0.000999,5", "width is '0.000999'; wanted pixels, 0.001 at least"),
    ("1,-1,1_0,3,4,5", "x is '1_0'; wanted a finite number"),
    ("1_0,-1,2,3,4,5", "frame is '1_0'; wanted a finite number"),
    ("1,-1,2,-1e12,4,5", "y is '-1e12'; wanted pixels, 1e+09 at most"),
    ("1,-1,2,3,1e300,5", "width is '1e300'; wanted pixels"),
    ("0,-1,2,3,4,5", "frame is '0'; wanted a whole number from 1"),
    ("-3,-1,2,3,4,5", "frame is '-3'"),
    ("1.5,-1,2,3,4,5", "frame is '1.5'"),
    (f"{LAST_FRAME + 1},-1,2,3,4,5", "frame is"),
    ("1e300,-1,2,3,4,5", "frame is '1e300'"),
    ("nan,-1,2,3,4,5", "frame is 'nan'; wanted a finite number"),
    (",-1,2,3,4,5", "frame is ''"),
    ("1,-1,2,3,4", "5 columns; wanted frame,id,x,y,w,h[,score]"),
    ("1 2 3", "3 columns"),
    ("7", "1 column; wanted"),
    ("1;-1;2;3;4;5", "1 column; wanted"),
]


@pytest.mark.parametrize(("row", "says"), BAD)
def test_a_bad_row_is_one_line_that_names_file_and_line(table, row, says):
    path = table(f"1,-1,2,3,4,5\n\n{row}\n1,-1,2,3,4,5\n")
    with pytest.raises(InputError) as error:
        read_detections(path)
    assert says in str(error.value)
    assert f"{path}, line 3: " in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("frame,x,y\n1,2,3", "line 1: its columns are frame, x, y; x_px, y_px, width_px, height_px missing"),
        ("frame,x_px,y_px,width_px,height_px,x_px\n1,2,3,4,5,6", "line 1: column x_px is named twice"),
        ("frame,x_px,y_px,width_px,height_px,note,note\n1,2,3,4,5,6,7", "line 1: column note is named twice"),
        ("hello world", "line 1: its columns are hello world"),
        ("frame,x_px,y_px,width_px,height_px\n1,2,3,4", "line 2: 4 columns; the first line names 5"),
        ("frame,x_px,y_px,width_px,height_px\n1,2,3,4,wide", "line 2: height is 'wide'"),
    ],
)
def test_a_bad_csv_is_one_line_that_names_file_and_line(table, text, says):
    with pytest.raises(InputError, match=r"det\.txt") as error:
        read_detections(table(text))
    assert says in str(error.value)


def test_a_file_that_cannot_be_read_is_one_line(tmp_path):
    with pytest.raises(InputError, match=r"nosuch\.txt cannot be read: No such file"):
        read_detections(tmp_path / "nosuch.txt")
    with pytest.raises(InputError, match="cannot be read"):
        read_detections(tmp_path)
    (tmp_path / "film.mp4").write_bytes(b"\x00\x00\xff\xfe\x80ftyp")
    with pytest.raises(InputError, match=r"film\.mp4 is no text"):
        read_detections(tmp_path / "film.mp4")


@given(st.text(max_size=60))
def test_whatever_stands_in_a_file_is_read_or_refused_in_one_line(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "any.txt"
    path.write_text(text, encoding="utf-8", newline="")
    try:
        said = read_detections(path).path
    except InputError as error:
        said = str(error)
    assert str(path) in said


def test_identities_and_cuts_are_kept_where_a_table_has_them(table):
    named = "frame,identity,x_px,y_px,width_px,height_px,cut\n1,7,0,0,5,5,1\n1,,0,0,5,5,0\n2,x,0,0,5,5,\n"
    found = read_detections(table(named))
    assert found.identity is not None and found.identity.tolist() == [7, -1, -1]
    assert found.cut is not None and found.cut.tolist() == [True, False, False]
    by_place = read_detections(table("1,3,0,0,5,5\n1,-1,0,0,5,5\n1,nan,0,0,5,5\n"))
    assert by_place.identity is not None and by_place.identity.tolist() == [3, -1, -1]
    assert by_place.cut is None


def test_a_cut_that_is_neither_0_nor_1_is_named(table):
    with pytest.raises(InputError, match="line 2: cut is 'maybe'; wanted 1 where the border cuts it, else 0"):
        read_detections(table("frame,x_px,y_px,width_px,height_px,cut\n1,0,0,5,5,maybe\n"))
