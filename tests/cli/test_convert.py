"""`dddas convert`: one format of boxes or places to another."""

import json
import sqlite3
from contextlib import closing

import pytest
from typer.testing import CliRunner

from torchvision_dddas.cli import app

BOXES = "frame,identity,x_px,y_px,width_px,height_px,score,class\n1,2,10,20,30,40,0.5,car\n"
PLACES = "frame,target,east_m,north_m,longitude_deg,latitude_deg,by\n1,2,3.0,4.0,-110.95,32.23,pose\n"


def convert(*words):
    return CliRunner().invoke(app, ["convert", *map(str, words)])


def test_boxes_are_converted_and_what_is_lost_is_told(tmp_path):
    (tmp_path / "in.csv").write_text(BOXES)
    assert convert(tmp_path / "in.csv", tmp_path / "out.json").exit_code == 0
    (box,) = json.loads((tmp_path / "out.json").read_text())["annotations"]
    assert (box["bbox"], box["track_id"]) == ([10, 20, 30, 40], 2)
    result = convert(tmp_path / "out.json", tmp_path / "out.txt")
    assert "note: mot has no place for classes" in result.output
    assert (tmp_path / "out.txt").read_text() == "1,2,10.00,20.00,30.00,40.00,0.5,-1,-1,-1\n"


def test_positions_become_a_geopackage(tmp_path):
    (tmp_path / "in.csv").write_text(PLACES)
    assert "1 positions" in convert(tmp_path / "in.csv", tmp_path / "out.gpkg").output
    with closing(sqlite3.connect(tmp_path / "out.gpkg")) as base:
        assert base.execute('SELECT frame, east_m, "by" FROM positions').fetchall() == [(1, 3, "pose")]


@pytest.mark.parametrize(
    ("out", "said"), [("a.doc", "the ending of a.doc"), ("labels", "--clip"), ("a.gpkg", "positions.csv")]
)
def test_what_cannot_be_written_is_one_line(out, said, tmp_path):
    (tmp_path / "in.csv").write_text(BOXES)
    result = convert(tmp_path / "in.csv", tmp_path / out)
    assert result.exit_code == 2 and said in result.output and result.output.count("\n") == 1
