"""`dddas confirm`: the blobs' rows with what people near them say, and a line for every mistake."""

import pytest

from tests.cli.conftest import record
from tests.cli.conftest import rows as read_rows

HEADER = "frame,target,east_m,north_m,var_east_m2,cov_east_north_m2,var_north_m2"
BOXES = "frame,target,x_px,y_px,width_px,height_px,score,kind"
CAMERA = """
focal_px = 1000
width_px = 1280
height_px = 960
height_m = 1.2
heading_deg = 0
east_m = 0
north_m = 0
position_sigma_m = 0.1
heading_sigma_deg = 0.5
"""


def write(path, *lines):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def place(frame, target, east, north, sigma=0.3, *more):
    return ",".join(map(str, (frame, target, east, north, sigma**2, 0, sigma**2, *more)))


def rows(folder):
    return read_rows(folder / "confirmed.csv")


@pytest.fixture
def scene(tmp_path):
    """Two frames: a person 10 m ahead, something else beside them, and a third thing behind the vehicle."""
    rows = [place(frame, *row) for frame in (1, 2) for row in ((7, 0, 10), (8, 4, 12), (9, 0, -10))]
    blobs = write(tmp_path / "air" / "positions.csv", HEADER + ",note", *(f"{row},n{i}" for i, row in enumerate(rows)))
    people = write(tmp_path / "ugv" / "positions.csv", HEADER, place(1, 1, 0.2, 10.1, 0.1), place(2, 1, 0.1, 10, 0.1))
    return blobs, people, write(tmp_path / "ugv.toml", CAMERA)


def test_blobs_become_human_not_human_and_unseen_with_the_evidence(dddas, scene, tmp_path):
    blobs, people, camera = scene
    done = dddas("confirm", blobs, people, "--camera", camera, "--identities", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert "2 human, 2 not human, 2 unseen" in done.stdout
    found = rows(tmp_path / "out")
    assert [row["kind"] for row in found] == ["human", "not_human", "unseen"] * 2
    assert [row["note"] for row in found] == [f"n{i}" for i in range(6)]
    assert [row["seen_by"] for row in found[:3]] == ["positions", "positions", ""]
    assert [row["people"] for row in found[:3]] == ["1", "0", "0"]
    assert float(found[0]["nearest_m"]) == pytest.approx(0.224, abs=1e-3)
    assert float(found[3]["probability"]) > float(found[0]["probability"]) > 0.9  # the second look adds up
    assert float(found[2]["probability"]) == 0.5
    kept = record(tmp_path / "out")
    assert (kept["state"], kept["rows_looked_at"]) == ("complete", 4)
    assert kept["kinds"] == {"human": 2, "not_human": 2, "unseen": 2}


def test_without_a_camera_nothing_is_found_not_human_and_a_note_says_so(dddas, scene, tmp_path):
    blobs, people, _ = scene
    done = dddas("confirm", blobs, people, "--out", tmp_path / "out")
    assert "note: without --camera" in done.stdout
    assert {row["kind"] for row in rows(tmp_path / "out")} == {"human", "unseen"}


def test_several_vehicles_have_a_table_and_a_camera_each(dddas, scene, tmp_path):
    blobs, people, camera = scene
    nobody = write(tmp_path / "second" / "positions.csv", HEADER)
    back = write(tmp_path / "back.toml", CAMERA.replace("heading_deg = 0", "heading_deg = 180"))
    words = ["--camera", camera, "--camera", back, "--out", tmp_path / "out", "--quiet"]
    assert dddas("confirm", blobs, people, nobody, *words).exit_code == 0
    found = rows(tmp_path / "out")
    assert [row["kind"] for row in found[:3]] == ["human", "not_human", "not_human"]
    assert [row["seen_by"] for row in found[:3]] == ["ugv", "ugv", "second"]


def test_frames_in_which_nobody_was_looked_for_say_nothing(dddas, scene, tmp_path):
    blobs, people, camera = scene
    words = ["--camera", camera, "--out", tmp_path / "out", "--quiet"]
    assert dddas("confirm", blobs, people, *words, "--identities", "--interval", 2).exit_code == 0
    found = rows(tmp_path / "out")
    assert [row["seen_by"] for row in found[3:]] == ["", "", ""]
    assert [row["probability"] for row in found[:3]] == [row["probability"] for row in found[3:]]


def test_targets_counted_anew_in_each_frame_are_judged_alone_unless_told_otherwise(dddas, scene, tmp_path):
    _, people, _ = scene
    blobs = write(tmp_path / "b.csv", HEADER, place(1, 1, 0, 10), place(1, 2, 3, 10), place(2, 1, 9, 9))
    done = dddas("confirm", blobs, people, "--out", tmp_path / "out")
    assert "every row is judged alone" in done.stdout
    assert [row["kind"] for row in rows(tmp_path / "out")] == ["human", "unseen", "unseen"]
    dddas("confirm", blobs, people, "--identities", "--out", tmp_path / "out")
    assert [row["kind"] for row in rows(tmp_path / "out")] == ["human", "unseen", "human"]


def test_degrees_are_brought_to_common_metres(dddas, scene, tmp_path):
    # 1e-4 degrees of latitude are 11.1 m; each table has an origin of its own.
    header = HEADER + ",longitude_deg,latitude_deg"
    blobs = write(tmp_path / "b.csv", header, place(1, 5, 100, 200, 0.3, 16.0, 48.0001))
    people = write(tmp_path / "p.csv", header, place(1, 5, -7, 3, 0.1, 16.0, 48.0001))
    degrees = CAMERA.replace("east_m", "longitude_deg").replace("north_m = 0", "latitude_deg = 48")
    camera = write(tmp_path / "c.toml", degrees.replace("longitude_deg = 0", "longitude_deg = 16"))
    assert dddas("confirm", blobs, people, "--camera", camera, "--out", tmp_path / "out").exit_code == 0
    (row,) = rows(tmp_path / "out")
    assert (row["kind"], float(row["nearest_m"])) == ("human", 0)


def test_boxes_of_one_clip_are_confirmed_by_boxes(dddas, tmp_path):
    boxes = ("1,1,100,100,60,130", "1,2,300,100,60,130", "2,1,400,100,20,20")
    blobs = write(tmp_path / "detections.csv", BOXES, *(f"{box},1,moving" for box in boxes))
    people = write(tmp_path / "people.csv", BOXES, "1,1,110,105,40,120,0.9,person")
    done = dddas("confirm", blobs, people, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert [row["kind"] for row in rows(tmp_path / "out")] == ["human", "not_human", "unseen"]
    assert ",".join(rows(tmp_path / "out")[0]).startswith(BOXES)


def test_looks_add_up_over_the_identities_of_tracks(dddas, tmp_path):
    track = write(tmp_path / "tracks.txt", *(f"{t},4,{100 + t},100,60,130,1,-1,-1,-1" for t in (2, 1, 3)))
    people = write(tmp_path / "people.txt", "1,-1,105,105,40,120,0.9,-1,-1,-1", "2,-1,105,105,40,120,0.9,-1,-1,-1")
    assert dddas("confirm", track, people, "--out", tmp_path / "out").exit_code == 0
    found = rows(tmp_path / "out")
    assert [row["frame"] for row in found] == ["1", "2", "3"]
    assert [row["kind"] for row in found] == ["human"] * 3
    first, second, third = (float(row["probability"]) for row in found)
    assert second > first > 0.5
    assert second > third > 0.5
    dddas("confirm", track, people, "--no-identities", "--out", tmp_path / "out")
    assert [row["kind"] for row in rows(tmp_path / "out")] == ["human", "human", "not_human"]


def test_a_table_without_rows_is_confirmed_to_one_without_rows(dddas, scene, tmp_path):
    _, people, camera = scene
    empty = write(tmp_path / "none.csv", HEADER)
    done = dddas("confirm", empty, people, "--camera", camera, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert "has no rows" in done.stdout
    assert rows(tmp_path / "out") == []
