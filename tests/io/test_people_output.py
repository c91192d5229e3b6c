"""The record of a run that recognizes people."""

import json

import cv2
import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.io.output import PeopleRecorder
from torchvision_dddas.types import Adjustment, Frame, People, PeopleFrame


def recognized(number, share=1.0, cause="", adjustments=()):
    box_px = np.array([[10, 20, 30, 90.0], [60, 5, 30, 80]])
    people = People(box_px, np.array([0.9, 0.4]), np.ones(2), np.array([False, True]), box_px) if share else People()
    frame = Frame(number, 0.1 * number, np.zeros((120, 160, 3), np.uint8))
    return PeopleFrame(
        frame, people, None if share == 1 else np.zeros((3, 4)), share, cause, adjustments, {"score": 0.02}
    )


def record(folder):
    return json.loads((folder / "run.json").read_text())


def test_the_record_counts_people_windows_and_the_frames_that_could_not_be_read(tmp_path):
    line = Adjustment(2, "people.regions_share", 1.0, 0.2, "2 people expected")
    with PeopleRecorder(tmp_path / "out", ()) as output:
        output.begin({"input": "x"}, 10)
        for one in (
            recognized(1),
            recognized(2, 0.2, adjustments=(line,)),
            recognized(3, 0, cause="the frame could not be read"),
            recognized(4, 0.4),
            recognized(5, 0),
        ):
            output.write(one)
    kept = record(tmp_path / "out")
    assert (kept["targets"], kept["unlikely"], kept["cut"], kept["frames"]) == (
        6,
        3,
        3,
        {"written": 5, "unreliable": 1},
    )
    assert kept["searched"] == {
        "share_of_windows": pytest.approx(0.4),
        "frames_everywhere": 1,
        "frames_in_regions": 2,
        "frames_nowhere": 1,
    }
    assert kept["unreliable"] == [{"first": 3, "last": 3, "cause": "the frame could not be read"}]
    assert [a["cause"] for a in kept["adjustments"]] == ["2 people expected"]
    assert kept["seconds"]["stages"]["score"]["total"] == pytest.approx(0.1)


@pytest.mark.parametrize("single", [False, True])
def test_a_clip_gets_a_film_and_a_picture_a_picture(tmp_path, single):
    with PeopleRecorder(tmp_path) as output:
        journal = output.begin({}, 10, single)
        for number in range(1, 2 if single else 4):
            output.write(recognized(number))
    name, other = ("overlay.png", "overlay.mp4") if single else ("overlay.mp4", "overlay.png")
    assert journal.overlay == name
    assert (tmp_path / name).exists() and not (tmp_path / other).exists()
    assert single or cv2.VideoCapture(str(tmp_path / name)).get(cv2.CAP_PROP_FRAME_COUNT) == 3


@pytest.mark.parametrize("name", ["overlay.png", "detections.csv"])
def test_files_of_someone_else_are_not_replaced(tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(InputError, match=f"{name} was not written by dddas"):
        PeopleRecorder(tmp_path)
