"""The truth of a simulated run as files that its judges read."""

import csv
import json

import numpy as np
import pytest

from torchvision_dddas.evaluation.metrics import truth as read
from torchvision_dddas.io.ground_tables import read_positions
from torchvision_dddas.simulation import TruthOutput
from torchvision_dddas.types import Bodies, CameraPose, Truth


def bodies(speeds=(1.0, 1.0, 5.0, 0.5)):
    """Two people of crowd 1, a car (2), a ground vehicle (3)."""
    kind = np.array(["person", "person", "car", "ugv"])
    place = np.array([[0.0, 0, 0], [2, 4, 0], [10, 10, 0], [-5, 5, 0]])
    velocity = np.stack([np.array(speeds), np.zeros(4)], axis=1)
    return Bodies(
        np.array([1, 2, 5, 6]),
        kind,
        np.array([1, 1, 2, 3]),
        place,
        velocity,
        np.zeros(4),
        np.full(4, 1.7),
        np.zeros(4),
        np.zeros((4, 3)),
        np.full((4, 3), np.nan),
        np.zeros(4, bool),
    )


def truth(frame=1, speeds=(1.0, 1.0, 5.0, 0.5), car=True):
    mask, people = (np.zeros((40, 60), np.uint16) for _ in range(2))
    mask[5:8, 10:12], people[5:8, 10:12] = 1, 1
    mask[9:12, 20:22], people[9:12, 20:22] = 1, 2
    if car:
        mask[20:25, 30:40], people[20:25, 30:40] = 2, 5
    mask[30:34, 50:54], people[30:34, 50:54] = 3, 6
    pose = CameraPose(np.array([0, 0, 50.0]), np.eye(3))
    return Truth(frame, (frame - 1) / 10, mask, people, bodies(speeds), pose)


def degrees(metres):
    return np.asarray(metres) / 1e5 + (-110.0, 31.0)


def written(tmp_path, *truths, **how):
    sink = TruthOutput(tmp_path, degrees, **how)
    for item in truths:
        sink.write(item)
    sink.close(True)
    return tmp_path / "truth"


def rows(path):
    return [[float(c) for c in line.split(",")] for line in path.read_text().splitlines()]


def test_boxes_of_targets_leave_the_landmarks_out(tmp_path):
    folder = written(tmp_path, truth(1), truth(2, car=False))
    assert [r[:7] for r in rows(folder / "gt.txt")] == [
        [1, 1, 10, 5, 12, 7, 1],
        [1, 2, 30, 20, 10, 5, 1],
        [2, 1, 10, 5, 12, 7, 1],
    ]
    found = read.load_truth(folder / "gt.txt")
    assert found.kind == "boxes"
    assert found.tracks is not None
    assert found.tracks.identity.tolist() == [1, 2, 1]


def test_boxes_of_persons_have_their_own_numbers(tmp_path):
    folder = written(tmp_path, truth())
    assert [r[:6] for r in rows(folder / "people.txt")] == [[1, 1, 10, 5, 2, 3], [1, 2, 20, 9, 2, 3]]


def test_what_stands_is_in_no_mask_and_its_box_does_not_count(tmp_path):
    folder = written(tmp_path, truth(speeds=(0.0, 0.0, 5.0, 0.0)))
    assert {(r[1], r[6]) for r in rows(folder / "gt.txt")} == {(1, 0), (2, 1)}
    assert set(np.unique(read.read_mask(folder / "masks" / "000001.png"))) == {0, 2}


def test_masks_of_many_targets_keep_their_numbers(tmp_path):
    item = truth()
    item.mask[item.mask == 1] = 700
    folder = written(tmp_path, item)
    assert set(np.unique(read.read_mask(folder / "masks" / "000001.png"))) == {0, 2, 3, 700}


def test_a_crowds_place_is_the_middle_of_its_people(tmp_path):
    folder = written(tmp_path, truth(1), truth(2, car=False))
    table = list(csv.DictReader((folder / "positions.csv").open()))
    crowd, car, vehicle = table[:3]
    assert (crowd["kind"], crowd["people"], crowd["target"]) == ("person", "2", "1")
    assert (float(crowd["east_m"]), float(crowd["north_m"])) == (1, 2)
    assert (car["kind"], car["people"], car["visible_px"]) == ("car", "0", "50")
    assert vehicle["kind"] == "ugv"
    assert table[4]["visible_px"] == "0"  # the car, out of the second picture
    positions = read_positions(folder / "positions.csv")
    assert positions.target.tolist() == [1, 2, 3, 1, 2, 3]
    assert positions.lonlat_deg is not None
    np.testing.assert_allclose(positions.lonlat_deg[0], degrees([1, 2]))


def test_the_map_has_a_line_a_target_and_names_the_landmarks(tmp_path):
    folder = written(tmp_path, truth(1), truth(2))
    features = json.loads((folder / "tracks.geojson").read_text())["features"]
    assert [f["properties"].get("target") for f in features] == [1, 2, None]
    assert features[2]["properties"]["landmark"] == "ugv1"
    assert features[0]["properties"]["frames"] == [1, 2]
    assert features[0]["properties"]["seconds"] == [0, 0.1]


def test_a_run_that_fails_leaves_no_tables(tmp_path):
    sink = TruthOutput(tmp_path, degrees)
    sink.write(truth())
    sink.discard()
    assert [p.name for p in (tmp_path / "truth").iterdir()] == ["masks"]


@pytest.mark.parametrize("after", [0, 2])
def test_masks_of_an_earlier_longer_run_go(tmp_path, after):
    written(tmp_path, *(truth(k) for k in range(1, 4)))
    folder = written(tmp_path, *(truth(k) for k in range(1, after + 1)))
    assert len(list((folder / "masks").iterdir())) == after
