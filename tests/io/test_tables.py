import csv
import math

import pytest

from torchvision_dddas.io.tables import COLUMNS, Tables, compass_deg, csv_lines, mot_lines


def test_mot_lines_have_ten_fields_and_no_identity(scene):
    assert (
        mot_lines(scene(7, targets=2))
        == "7,-1,0.00,0.00,2.00,2.00,0.8750,-1,-1,-1\n7,-1,3.00,0.00,2.00,2.00,0.8750,-1,-1,-1\n"
    )


@pytest.mark.parametrize(
    ("heading_rad", "degrees"),
    [(-math.pi / 2, 0), (0, 90), (math.pi / 2, 180), (math.pi, 270), (-math.pi / 2 - 1e-4, 0)],
)
def test_heading_is_clockwise_from_image_up_and_below_360(heading_rad, degrees):
    assert compass_deg(heading_rad) == degrees


def test_what_is_unknown_is_an_empty_cell(scene):
    rows = list(csv.DictReader(csv_lines(scene(1, targets=2)).splitlines(), fieldnames=COLUMNS))
    assert (rows[0]["heading_deg"], rows[0]["speed_px_per_frame"]) == ("0.0", "1.500")
    assert (rows[1]["heading_deg"], rows[1]["speed_px_per_frame"]) == ("", "")
    assert (rows[1]["target"], rows[1]["kind"], rows[1]["area_px"]) == ("2", "moving", "4")


def test_a_clip_without_targets_gives_empty_tables_with_a_heading_line(tmp_path, scene):
    tables = Tables(tmp_path)
    tables.write(scene(1, targets=0))
    tables.close(complete=True)
    assert (tmp_path / "detections.txt").read_text() == ""
    assert (tmp_path / "detections.csv").read_text() == ",".join(COLUMNS) + "\n"


def test_no_table_is_there_before_the_end_and_none_after_a_discard(tmp_path, scene):
    tables = Tables(tmp_path)
    tables.write(scene(1))
    assert not list(tmp_path.glob("detections*"))
    tables.discard()
    assert not list(tmp_path.iterdir())
