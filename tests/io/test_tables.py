"""Tables as text: what a schema writes, and what it reads and refuses."""

import math

import numpy as np
import pytest

from torchvision_dddas.io.tables import (
    DETECTIONS,
    Column,
    Schema,
    TableFiles,
    compass_deg,
    detection_tables,
    parse_numbers,
    read_table,
)

PLACES = Schema(
    "places",
    Column("frame", "d", 1, 1000, is_whole=True),
    Column("name"),
    Column("east_m", ".2f", -100, 100, may_be_empty=True),
)


def test_rows_are_read_as_they_were_written(tmp_path):
    names = ["north, by north-west", 'the "old" one', "two\nlines", "plain"]
    rows = {"frame": 7, "name": names, "east_m": np.array([1.234, math.nan, math.inf, -0.5])}
    files = TableFiles({tmp_path / "places.csv": (PLACES, lambda item: item)})
    files.write(rows)
    files.close()
    read = read_table(tmp_path / "places.csv", PLACES)
    assert read["frame"].tolist() == [7] * 4 and read.columns["name"] == names
    np.testing.assert_array_equal(read["east_m"], [1.23, math.nan, math.nan, -0.5])
    assert PLACES.format_rows({"frame": 1, "name": None, "east_m": 0.126}) == "1,,0.13\n"  # single values are one line
    assert PLACES.format_rows({"frame": 1, "name": "a", "east_m": np.zeros(0)}) == ""


def test_columns_in_any_order_with_others_between_and_a_byte_order_mark(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text('\ufeffeast_m, note,"frame"\r\n\r\n1e1,x,2\r\n,y,3\r\n', encoding="utf-8")
    read = read_table(path, PLACES, ("frame",))
    assert read["frame"].tolist() == [2, 3] and read.line.tolist() == [3, 4] and "name" not in read
    np.testing.assert_array_equal(read["east_m"], [10, math.nan])


@pytest.mark.parametrize(
    "text",
    [
        "frame;name;east_m\n1;a, b;-1,5\n2;c;10,25\n",
        "frame;name;east_m\n1;a, b;-1.5\n2;c;10.25\n",
        "frame\tname\teast_m\n1\ta, b\t-1,5\n2\tc\t10,25\n",
        "frame|name|east_m\n1|a, b|-1.5\n2|c|10.25\n",
        'frame,name,east_m\n1,"a, b","-1,5"\n2,c,"10,25"\n',
        "sep=;\nframe;name;east_m\n1;a, b;-1,5\n2;c;10,25\n",
        '"sep=,"\nframe,name,east_m\n1,"a, b",-1.5\n2,c,10.25\n',
        '\n\nframe,name,east_m\n1,"a, b",-1.5\n2,c,10.25\n',
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_the_separator_and_the_decimal_sign_follow_from_the_first_lines(tmp_path, text, encoding):
    path = tmp_path / "t.csv"
    path.write_text(text, encoding=encoding)
    read = read_table(path, PLACES, ("frame",))
    assert (read["frame"].tolist(), read["east_m"].tolist()) == ([1, 2], [-1.5, 10.25])
    assert read.columns["name"] == ["a, b", "c"] and read.line[-1] == len(text.splitlines())


def test_commas_between_thousands_are_no_decimal_ones_and_neither_are_unsure_ones(tmp_path, refused):
    path = tmp_path / "t.csv"
    path.write_text('frame,east_m,north_m\n"1,000",1.5,2.5\n')
    assert read_table(path, PLACES)["frame"].tolist() == [1000]
    line = refused(lambda path: read_table(path, PLACES), 'frame,east_m\n1,"1,000"\n')
    assert "line 2: east_m is '1,000'; wanted a number" in line


def test_text_that_is_no_utf_8_is_that_of_windows(tmp_path):
    path = tmp_path / "t.csv"
    path.write_bytes("frame;name\n1;Höhe\n".encode("cp1252"))
    assert read_table(path, PLACES).columns["name"] == ["Höhe"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,east_m\na,1\n", "lacks frame; its columns are name, east_m, wanted frame,east_m"),
        ("", "lacks frame, east_m; its columns are none"),
        ("frame,frame,east_m\n1,1,2\n", "column frame is named twice"),
        ("frame,east_m\n1,2\n2\n", "line 3: 1 column; the first line names 2"),
        ("frame,east_m\n\n1.5,2\n", "line 3: frame is '1.5'; wanted a whole number from 1 to 1000"),
        ("frame,east_m\n1,0\n1001,2\n", "line 3: frame is '1001'; wanted a whole number from 1 to 1000"),
        ("frame,east_m\n1,1_0\n", "line 2: east_m is '1_0'; wanted a number from -100 to 100, or nothing"),
        ("frame,east_m\n1,inf\n", "east_m is 'inf'"),
    ],
)
def test_each_mistake_is_one_line_with_file_and_line(refused, text, message):
    assert message in refused(lambda path: read_table(path, PLACES, ("frame", "east_m")), text)


def test_ragged_lines_are_read_as_far_as_the_wanted_columns_go(tmp_path, refused):
    path = tmp_path / "t.csv"
    path.write_text("frame,east_m,note\n1,2\n3,4,a,b\n")
    assert read_table(path, PLACES, is_ragged=True)["east_m"].tolist() == [2, 4]
    line = refused(lambda path: read_table(path, PLACES, is_ragged=True), "frame,east_m\n1,2\n3\n")
    assert "line 3: east_m is missing: the line ends before it" in line


def test_numbers_are_told_from_what_is_none():
    np.testing.assert_array_equal(parse_numbers(["1", "", "-2e3"]), [1, math.nan, -2000])
    np.testing.assert_array_equal(parse_numbers(["1", "", "x"]), [1, math.nan, math.inf])
    np.testing.assert_array_equal(parse_numbers(["nan", "1_0", ""]), [math.inf, math.inf, math.nan])


@pytest.mark.parametrize(
    ("heading_rad", "degrees"),
    [(-math.pi / 2, 0), (0, 90), (math.pi / 2, 180), (math.pi, 270), (-math.pi / 2 - 1e-4, 0)],
)
def test_heading_is_clockwise_from_image_up_and_below_360(heading_rad, degrees):
    assert compass_deg(heading_rad) == degrees


def test_detections_of_a_scene_as_motchallenge_text_and_csv(tmp_path, scene):
    tables = detection_tables(tmp_path)
    tables.write(scene(7, targets=2))
    assert not list(tmp_path.glob("detections*"))  # none before the end
    tables.close()
    mot = (tmp_path / "detections.txt").read_text()
    assert mot == "7,-1,0.00,0.00,2.00,2.00,0.8750,-1,-1,-1\n7,-1,3.00,0.00,2.00,2.00,0.8750,-1,-1,-1\n"
    header, first, second = (tmp_path / "detections.csv").read_text().splitlines()
    assert header.startswith("frame,target,x_px,y_px,width_px,height_px,score,kind,area_px,heading_deg,speed_px")
    assert first == "7,1,0.00,0.00,2.00,2.00,0.8750,moving,4,0.0,1.500,,"
    assert second == "7,2,3.00,0.00,2.00,2.00,0.8750,moving,4,,,,"


def test_a_clip_without_targets_gives_empty_tables_and_a_discard_leaves_none(tmp_path, scene):
    tables = detection_tables(tmp_path)
    tables.write(scene(1, targets=0))
    tables.close()
    assert (tmp_path / "detections.txt").read_text() == ""
    assert (tmp_path / "detections.csv").read_text() == DETECTIONS.header
    again = detection_tables(tmp_path / "again")
    (tmp_path / "again").mkdir()
    again.write(scene(1))
    again.discard()
    assert not list((tmp_path / "again").iterdir())
