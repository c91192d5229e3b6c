"""What a run of the whole path leaves in its folder."""

import csv
import json

import cv2
import numpy as np
import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.sinks.mark_table import MarkTable
from torchvision_dddas.sinks.survey_output import SurveyOutput
from torchvision_dddas.sinks.survey_overlay import STATES, SurveyPictures
from torchvision_dddas.sources.landmarks import read_landmarks
from torchvision_dddas.types import Detections, Fix, Followed, Frame, Grounded, Marks, Positions, Surveyed, Tracks

NAMES = ("ugv, red", "blue")


def surveyed(frame, by="pose", cause="", states=("used", "excluded"), geographic=False):
    """One target and two landmarks, of which the second lies at the right."""
    unknown = np.full(1, np.nan)
    boxes = np.array([[10, 12, 8, 8.0]])
    found = Detections(boxes, np.ones(1), np.full(1, 64.0), unknown, unknown)
    picture = np.full((120, 200, 3), 128, np.uint8)
    followed = Followed(
        frame, Frame(frame, frame / 10, picture), found, Tracks(frame, np.array([3]), boxes, np.ones(1), np.array([0]))
    )
    marks = Marks(
        np.arange(2),
        np.array([[40.0, 30], [120, 50]]),
        np.array([[1.0, 2], [3, 4]]),
        np.ones(2),
        np.ones(2),
        np.zeros(2),
    )
    at = 1 if by else 0
    positions = Positions(
        np.full(at, frame), np.full(at, 3), np.zeros((at, 2)), np.tile(0.04 * np.eye(2), (at, 1, 1)), np.ones(at)
    )
    nothing = np.zeros((at, 2, 2))
    fix = Fix(frame, by, landmark=np.arange(2), state=states, cause=cause)
    grounded = Grounded(
        frame, frame / 10, positions, np.arange(at), nothing, np.full((at, 2), np.nan), boxes, fix, marks
    )
    degrees = np.array([[-110.95, 32.23], [-110.94, 32.24]]) if geographic else None
    return Surveyed(followed, grounded, ("motion", "colour"), degrees)


def rows(path):
    with path.open(newline="") as text:
        return list(csv.DictReader(text))


@pytest.mark.parametrize("geographic", [False, True])
def test_the_landmarks_table_can_be_read_as_one(tmp_path, geographic):
    table = MarkTable(tmp_path, NAMES, geographic)
    for frame in (1, 2):
        table.write(surveyed(frame, geographic=geographic))
    table.close(True)
    found = read_landmarks(tmp_path / "landmarks.csv")
    assert found.names == NAMES
    assert found.geographic is geographic
    np.testing.assert_allclose(found.image_px[:2], [[40, 30], [120, 50]])
    np.testing.assert_allclose(found.place[0], [-110.95, 32.23] if geographic else [1, 2])
    states = [(row["seen_by"], row["state"]) for row in rows(tmp_path / "landmarks.csv")]
    assert states == [("motion", "used"), ("colour", "excluded")] * 2


def test_the_record_counts_identities_beside_what_was_located(tmp_path):
    with SurveyOutput(tmp_path, ()) as output:
        journal = output.begin({"input": "clip"}, NAMES, None)
        output.also(journal, 10.0, (200, 120), NAMES, False)
        for frame in (1, 2):
            output.survey(surveyed(frame))
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["identities"] == 3
    assert record["positions"] == 2
    assert record["landmarks"]["blue"]["used"] == 0
    assert len(rows(tmp_path / "tracks.csv")) == len(rows(tmp_path / "detections.csv")) == 2
    assert not (tmp_path / "overlay.mp4").exists()


def test_a_run_that_fails_leaves_nothing_that_looks_whole(tmp_path):
    def failing():
        with SurveyOutput(tmp_path / "out", ("overlay",)) as output:
            journal = output.begin({"input": "clip"}, NAMES, None)
            output.also(journal, 10.0, (200, 120), NAMES, False)
            output.survey(surveyed(1))
            raise InputError("the disk is full")

    with pytest.raises(InputError):
        failing()
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"run.json"}
    assert json.loads((tmp_path / "out" / "run.json").read_text())["state"] == "failed"


def test_landmarks_are_drawn_in_the_colour_of_what_became_of_them():
    picture = SurveyPictures((200, 120), NAMES)(surveyed(1))
    for (u, v), state in (((40, 30), "used"), ((120, 50), "excluded")):
        ring = np.abs(picture[v - 14 : v + 15, u - 14 : u + 15].astype(int) - STATES[state]).max(axis=2) < 40
        assert ring.sum() > 20


def test_the_caption_says_why_a_frame_is_not_located():
    drawer = SurveyPictures((200, 120), NAMES)
    good, gap = drawer(surveyed(1)), drawer(surveyed(2, by="", cause="too few", states=("excluded",) * 2))
    red = lambda picture: ((picture[100:, :, 2] > 200) & (picture[100:, :, 1] < 120)).sum()  # noqa: E731
    assert red(gap) > 20 > red(good)


def test_a_frame_that_nothing_lays_on_the_ground_is_drawn_with_its_tracks():
    drawn = SurveyPictures((200, 120), ())(Surveyed(surveyed(1).followed))
    assert drawn.shape == (120, 200, 3)
    assert cv2.absdiff(drawn, np.full_like(drawn, 128)).any()
