"""`dddas confirm`: the blobs' rows with what people near them say."""

import pytest

from tests.cli.conftest import record, rows

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


def place(frame, target, east, north, sigma=0.3, *more):
    return ",".join(map(str, (frame, target, east, north, sigma**2, 0, sigma**2, *more)))


@pytest.fixture
def write(tmp_path):
    """Write a table in a folder of its own, which gives a vehicle its name."""

    def table(name, *lines):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    return table


@pytest.fixture
def scene(write):
    """Two frames: a person 10 m ahead, something else beside them, and a third thing behind the vehicle."""
    rows = [place(frame, *row) for frame in (1, 2) for row in ((7, 0, 10), (8, 4, 12), (9, 0, -10))]
    blobs = write("air/positions.csv", HEADER + ",note", *(f"{row},n{i}" for i, row in enumerate(rows)))
    people = write("ugv/positions.csv", HEADER, place(1, 1, 0.2, 10.1, 0.1), place(2, 1, 0.1, 10, 0.1))
    return blobs, people, write("ugv.toml", CAMERA)


@pytest.fixture
def confirm(dddas, tmp_path):
    """Confirm; the rows, and what was said."""

    def run(*words):
        done = dddas("confirm", *words, "--out", tmp_path / "out")
        assert done.exit_code == 0, done.output
        return rows(tmp_path / "out" / "confirmed.csv"), done.stdout

    return run


def kinds(found):
    return [row["kind"] for row in found]


def chances(found):
    return [float(row["probability"]) for row in found]


def test_blobs_become_human_not_human_and_unseen_with_the_evidence(confirm, scene, tmp_path):
    blobs, people, camera = scene
    found, said = confirm(blobs, people, "--camera", camera, "--identities")
    assert "2 human, 2 not human, 2 unseen" in said
    assert kinds(found) == ["human", "not_human", "unseen"] * 2
    assert [row["note"] for row in found] == [f"n{i}" for i in range(6)]
    assert [row["seen_by"] for row in found[:3]] == ["positions", "positions", ""]
    assert [row["people"] for row in found[:3]] == ["1", "0", "0"]
    assert float(found[0]["nearest_m"]) == pytest.approx(0.224, abs=1e-3)
    assert chances(found)[3] > chances(found)[0] > 0.9  # the second look adds up
    assert chances(found)[2] == 0.5
    kept = record(tmp_path / "out")
    assert (kept["state"], kept["rows_looked_at"]) == ("complete", 4)
    assert kept["kinds"] == {"human": 2, "not_human": 2, "unseen": 2}


def test_without_a_camera_nothing_is_found_not_human_and_a_note_says_so(confirm, scene):
    found, said = confirm(*scene[:2])
    assert "note: without --camera" in said
    assert set(kinds(found)) == {"human", "unseen"}


def test_several_vehicles_have_a_table_and_a_camera_each(confirm, scene, write):
    blobs, people, camera = scene
    back = write("back.toml", CAMERA.replace("heading_deg = 0", "heading_deg = 180"))
    found, _ = confirm(blobs, people, write("second/positions.csv", HEADER), "--camera", camera, "--camera", back)
    assert kinds(found[:3]) == ["human", "not_human", "not_human"]
    assert [row["seen_by"] for row in found[:3]] == ["ugv", "ugv", "second"]


def test_frames_in_which_nobody_was_looked_for_say_nothing(confirm, scene):
    blobs, people, camera = scene
    found, _ = confirm(blobs, people, "--camera", camera, "--identities", "--interval", 2)
    assert [row["seen_by"] for row in found[3:]] == ["", "", ""]
    assert chances(found[:3]) == chances(found[3:])


def test_rows_whose_targets_are_no_identities_are_judged_alone(confirm, scene, write):
    blobs = write("b.csv", HEADER, place(1, 1, 0, 10), place(1, 2, 3, 10), place(2, 1, 9, 9))
    found, said = confirm(blobs, scene[1])
    assert "rows are judged alone" in said
    assert kinds(found) == ["human", "unseen", "unseen"]
    assert kinds(confirm(blobs, scene[1], "--identities")[0]) == ["human", "unseen", "human"]


def test_degrees_are_brought_to_common_metres(confirm, write):
    # 1e-4 degrees of latitude are 11.1 m; each table has an origin of its own.
    header = HEADER + ",longitude_deg,latitude_deg"
    blobs = write("b.csv", header, place(1, 5, 100, 200, 0.3, 16.0, 48.0001))
    people = write("p.csv", header, place(1, 5, -7, 3, 0.1, 16.0, 48.0001))
    degrees = CAMERA.replace("east_m = 0", "longitude_deg = 16").replace("north_m = 0", "latitude_deg = 48")
    ((row,), _) = confirm(blobs, people, "--camera", write("c.toml", degrees))
    assert (row["kind"], float(row["nearest_m"])) == ("human", 0)


def test_boxes_of_one_clip_are_confirmed_by_boxes(confirm, write):
    boxes = ("1,1,100,100,60,130", "1,2,300,100,60,130", "2,1,400,100,20,20")
    blobs = write("detections.csv", BOXES, *(f"{box},1,moving" for box in boxes))
    found, _ = confirm(blobs, write("people.csv", BOXES, "1,1,110,105,40,120,0.9,person"))
    assert kinds(found) == ["human", "not_human", "unseen"]
    assert ",".join(found[0]).startswith(BOXES)


def test_looks_add_up_over_the_identities_of_tracks(confirm, write):
    track = write("tracks.txt", *(f"{t},4,{100 + t},100,60,130,1,-1,-1,-1" for t in (2, 1, 3)))
    people = write("people.txt", *(f"{t},-1,105,105,40,120,0.9,-1,-1,-1" for t in (1, 2)))
    found, _ = confirm(track, people)
    assert [row["frame"] for row in found] == ["1", "2", "3"] and kinds(found) == ["human"] * 3
    first, second, third = chances(found)
    assert second > first > 0.5 and second > third > 0.5
    assert kinds(confirm(track, people, "--no-identities")[0]) == ["human", "human", "not_human"]


def test_a_table_without_rows_is_confirmed_to_one_without_rows(confirm, scene, write):
    found, said = confirm(write("none.csv", HEADER), scene[1], "--camera", scene[2])
    assert found == [] and "has no rows" in said
