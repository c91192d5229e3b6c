"""People as tables: what other commands read, and what an empty result is."""

import csv

import numpy as np
import pytest

from torchvision_dddas.io.detection_tables import read_detections
from torchvision_dddas.io.output.people_tables import COLUMNS, PeopleTables, csv_lines, mot_lines
from torchvision_dddas.types import Frame, People, PeopleFrame

PEOPLE = People(
    np.array([[10, 20, 30, 90.5], [-4, 2, 40, 100]]),
    np.array([0.98765, 0.5]),
    np.array([2.7, 0.5]),
    np.array([False, True]),
    np.array([[0, 5, 60, 120.0], [-14, -8, 80, 130]]),
)


def recognized(number=7, people=PEOPLE):
    return PeopleFrame(Frame(number, 0.6, np.zeros((120, 160), np.uint8)), people)


def test_mot_lines_hold_the_probability_and_no_identity():
    assert mot_lines(recognized()) == (
        "7,-1,10.00,20.00,30.00,90.50,0.9877,-1,-1,-1\n7,-1,-4.00,2.00,40.00,100.00,0.5000,-1,-1,-1\n"
    )


def test_named_columns_hold_feet_margin_and_whether_the_border_cuts():
    first, second = csv.DictReader(csv_lines(recognized()).splitlines(), fieldnames=COLUMNS)
    assert (first["frame"], first["target"], first["kind"], first["cut"]) == ("7", "1", "person", "0")
    assert (first["margin"], first["feet_u_px"], first["feet_v_px"]) == ("2.7000", "24.50", "110.00")
    assert (second["target"], second["cut"], second["score"]) == ("2", "1", "0.5000")


@pytest.mark.parametrize("name", ["detections.txt", "detections.csv"])
def test_both_tables_are_read_back_as_detections_whose_scores_are_probabilities(tmp_path, name):
    tables = PeopleTables(tmp_path)
    for number in (7, 8):
        tables.write(recognized(number))
    tables.close(complete=True)
    table = read_detections(tmp_path / name)
    assert table.frame.tolist() == [7, 7, 8, 8]
    assert table.box_px[:2] == pytest.approx(PEOPLE.box_px)
    assert table.score[:2] == pytest.approx(PEOPLE.score, abs=1e-4)
    assert table.probable and not table.own and not table.certain


def test_nobody_in_the_clip_gives_empty_tables_with_a_heading_line(tmp_path):
    tables = PeopleTables(tmp_path)
    tables.write(recognized(1, People()))
    tables.close(complete=True)
    assert (tmp_path / "detections.txt").read_text() == ""
    assert (tmp_path / "detections.csv").read_text() == ",".join(COLUMNS) + "\n"


def test_no_table_is_there_before_the_end_and_none_after_a_discard(tmp_path):
    tables = PeopleTables(tmp_path)
    tables.write(recognized())
    assert not list(tmp_path.glob("detections*"))
    tables.discard()
    assert not list(tmp_path.iterdir())
