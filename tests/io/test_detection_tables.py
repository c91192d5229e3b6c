"""Tables of detections: what may be read, and one line with file and line number for what may not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.detection_tables import (
    MOT_NAMES,
    check_birth_score,
    check_table,
    read_detections,
    read_header,
    read_rows,
)
from torchvision_dddas.io.tables import LAST_FRAME
from torchvision_dddas.types import DetectionTable, is_sampled


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


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("1,-1,2,3,4,x", "height_px is 'x'; wanted pixels from 0.001 to 1e+09"),
        ("1,-1,2,nan,4,5", "y_px is 'nan'; wanted pixels from -1e+09"),
        ("1,-1,inf,3,4,5", "x_px is 'inf'"),
        ("1,-1,2,3,4,5,nan", "score is 'nan'; wanted a finite number"),
        ("1,-1,2,3,0.000999,5", "width_px is '0.000999'; wanted pixels from 0.001"),
        ("1,-1,1_0,3,4,5", "x_px is '1_0'"),
        ("1,-1,2,-1e12,4,5", "y_px is '-1e12'"),
        ("0,-1,2,3,4,5", "frame is '0'; wanted a whole number from 1"),
        ("1.5,-1,2,3,4,5", "frame is '1.5'"),
        (f"{LAST_FRAME + 1},-1,2,3,4,5", "frame is"),
        (",-1,2,3,4,5", "frame is ''"),
        ("1,-1,2,3,4", "5 columns; wanted frame,id,x,y,w,h[,score]"),
        ("7", "1 column; wanted"),
        ("1;-1;2;3;4;5", "1 column; wanted"),
    ],
)
def test_a_bad_row_is_one_line_that_names_file_and_line(table, row, says):
    path = table(f"1,-1,2,3,4,5\n\n{row}\n1,-1,2,3,4,5\n")
    with pytest.raises(InputError) as error:
        read_detections(path)
    assert says in str(error.value) and f"{path}, line 3: " in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("frame,x,y\n1,2,3", "lacks x_px, y_px, width_px, height_px; its columns are frame, x, y"),
        ("hello world", "its columns are hello world"),
        ("frame,x_px,y_px,width_px,height_px\n1,2,3,4", "line 2: 4 columns; the first line names 5"),
        ("frame,x_px,y_px,width_px,height_px,cut\n1,0,0,5,5,maybe\n", "line 2: cut is 'maybe'; wanted 1 where"),
    ],
)
def test_a_bad_csv_is_one_line(table, text, says):
    with pytest.raises(InputError, match=r"det\.txt") as error:
        read_detections(table(text))
    assert says in str(error.value)


def test_identities_and_cuts_are_kept_where_a_table_has_them(table):
    named = "frame,identity,x_px,y_px,width_px,height_px,cut\n1,7,0,0,5,5,1\n1,,0,0,5,5,0\n2,x,0,0,5,5,\n"
    found = read_detections(table(named))
    assert found.identity is not None and found.identity.tolist() == [7, -1, -1]
    assert found.cut is not None and found.cut.tolist() == [True, False, False]
    by_place = read_detections(table("1,3,0,0,5,5\n1,-1,0,0,5,5\n1,nan,0,0,5,5\n"))
    assert by_place.identity is not None and by_place.identity.tolist() == [3, -1, -1]
    assert by_place.cut is None


def test_the_own_words_of_a_table_are_kept_for_a_copy_with_more_columns(table):
    named = table('frame,note,x_px,y_px,width_px,height_px\n2,b,0,0,5,5\n1,"a, b",0,0,5,5\n')
    assert read_header(named)[:2] == ["frame", "note"]
    assert read_rows(named, ("x_px", "y_px")) == (
        ["frame", "note", "width_px", "height_px"],
        [["1", "a, b", "5", "5"], ["2", "b", "5", "5"]],
    )
    by_place = table("2 1 0 0 5 5 0.50 x\n1 1 0 0 5 5\n")
    header, rows = read_rows(by_place)
    assert header == [*MOT_NAMES, "column_8"] and rows[0] == ["1", "1", "0", "0", "5", "5", "", ""]
    assert read_header(table("")) == []


def rows_on(frames, box_px=(10, 10, 5, 5), score=1.0):
    frames = np.array(frames, int)
    n = len(frames)
    boxes = np.broadcast_to(np.array(box_px, float), (n, 4))
    return DetectionTable("det.txt", frames, boxes, np.full(n, score), np.arange(n) + 1)


def clip(count, exact=True):
    return SimpleNamespace(name="walk.mp4", count=count, exact=exact, size=(64, 48))


def test_a_table_that_fits_its_clip_needs_no_note():
    assert check_table(rows_on([1, 2, 2, 5]), 1, clip(5)) == []
    assert check_table(rows_on([1, 6, 11]), 5, clip(14)) == []


def test_frames_after_the_end_of_a_clip_are_refused_with_the_first_such_line():
    with pytest.raises(
        InputError, match=r"det\.txt, line 3: .* frame 9 but walk\.mp4 ends after frame 5 \(2 of 4 rows"
    ):
        check_table(rows_on([1, 5, 6, 9]), 1, clip(5))


@pytest.mark.parametrize("source", [clip(5, exact=False), clip(None, exact=False), None])
def test_a_length_that_is_only_guessed_refuses_nothing(source):
    assert check_table(rows_on([1, 2, 9]), 1, source) == []


def test_rows_between_the_frames_looked_at_are_counted():
    table = rows_on([1, 2, 3, 4, 5, 6, 6])
    assert is_sampled(table.frame, 5).tolist() == [True, False, False, False, False, True, True]
    assert check_table(table, 5) == ["4 of 7 rows lie on frames that --interval 5 leaves out"]


def test_a_table_of_which_no_row_is_looked_at_is_refused():
    with pytest.raises(InputError, match=r"no row on frames 1, 6, 11, .* --interval 5 .* first is on frame 5"):
        check_table(rows_on([5, 10, 15]), 5)


def test_rows_on_every_fifth_frame_only_call_for_the_interval():
    (note,) = check_table(rows_on([1, 6, 21]), 1)
    assert "--interval 5 if" in note
    assert check_table(rows_on([1, 6]), 1) == []  # two frames are too few to tell


def test_scores_that_are_no_probabilities_own_rows_and_an_empty_table_are_told():
    (note,) = check_table(rows_on([1, 2, 3], score=43.3), 1)
    assert "from 43.3 to 43.3 are no probabilities" in note
    assert check_table(replace(rows_on([1, 2, 3], score=0.5), own=True), 1) == [
        "all rows are moving targets of dddas detect: every row counts as certain"
    ]
    assert check_table(rows_on([]), 1, clip(5)) == ["detections det.txt holds no rows"]


@pytest.mark.parametrize("box", [(-9, 10, 9, 5), (64, 10, 5, 5), (10, -5, 5, 5), (10, 48, 5, 5)])
def test_boxes_wholly_outside_the_picture_are_counted_and_those_at_its_edge_are_not(box):
    (note,) = check_table(rows_on([1, 2, 3], box), 1, clip(3))
    assert note.startswith("3 boxes lie wholly outside")
    x, y, w, h = box
    assert check_table(rows_on([1, 2, 3], (x - np.sign(x) * 0.5, y - np.sign(y) * 0.5, w, h)), 1, clip(3)) == []


def test_scores_too_low_for_any_track_are_noted_and_others_are_not():
    (note,) = check_birth_score(rows_on([1, 2], score=0.8), 0.95)
    assert "det.txt reaches track.birth_score = 0.95" in note
    assert check_birth_score(rows_on([1, 2], score=0.95), 0.95) == []
    assert check_birth_score(replace(rows_on([1, 2], score=0.8), own=True), 0.95) == []
    assert check_birth_score(rows_on([]), 0.95) == []
