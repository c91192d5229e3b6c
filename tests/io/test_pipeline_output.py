"""What a run of the whole path leaves in its folder."""

import csv
import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from torchvision_dddas.io.ground_tables import read_landmarks
from torchvision_dddas.io.output import PROBLEM, PipelineRecorder, Site
from torchvision_dddas.io.output.tables import landmark_table
from torchvision_dddas.io.overlay import LANDMARK, RunPictures
from torchvision_dddas.types import (
    Adjustment,
    AerialLocations,
    Command,
    Confirmation,
    Detections,
    Fix,
    Frame,
    FrameResult,
    LandmarkObservations,
    Order,
    Positions,
    TrackedFrame,
    Tracks,
)

NAMES = ("ugv, red", "blue")


def surveyed(frame, by="pose", cause="", states=("used", "excluded"), geographic=False):
    """One target and two landmarks, of which the second lies at the right."""
    unknown = np.full(1, np.nan)
    boxes = np.array([[10, 12, 8, 8.0]])
    found = Detections(boxes, np.ones(1), np.full(1, 64.0), unknown, unknown)
    picture = np.full((120, 200, 3), 128, np.uint8)
    followed = TrackedFrame(
        frame, Frame(frame, frame / 10, picture), found, Tracks(frame, np.array([3]), boxes, np.ones(1), np.array([0]))
    )
    marks = LandmarkObservations(
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
    grounded = AerialLocations(
        frame, frame / 10, positions, np.arange(at), nothing, np.full((at, 2), np.nan), boxes, fix, marks
    )
    degrees = np.array([[-110.95, 32.23], [-110.94, 32.24]]) if geographic else None
    return FrameResult(followed, grounded, ("motion", "colour"), degrees)


def rows(path):
    with path.open(newline="") as text:
        return list(csv.DictReader(text))


@pytest.mark.parametrize("geographic", [False, True])
def test_the_landmarks_table_can_be_read_as_one(tmp_path, geographic):
    table = landmark_table(tmp_path, NAMES, geographic)
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
    with PipelineRecorder(tmp_path, ()) as output:
        output.begin({"input": "clip"}, 10.0, (200, 120), Site(NAMES))
        for frame in (1, 2):
            output.write(surveyed(frame))
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["identities"] == 3
    assert record["positions"] == 2
    assert record["landmarks"]["blue"]["used"] == 0
    assert len(rows(tmp_path / "tracks.csv")) == len(rows(tmp_path / "detections.csv")) == 2
    assert not (tmp_path / "overlay.mp4").exists()


def test_landmarks_are_drawn_in_the_colour_of_what_became_of_them():
    picture = RunPictures((200, 120), NAMES)(surveyed(1))
    for (u, v), state in (((40, 30), "used"), ((120, 50), "excluded")):
        ring = np.abs(picture[v - 14 : v + 15, u - 14 : u + 15].astype(int) - LANDMARK[state]).max(axis=2) < 40
        assert ring.sum() > 20


def test_the_caption_says_why_a_frame_is_not_located():
    drawer = RunPictures((200, 120), NAMES)
    good, gap = drawer(surveyed(1)), drawer(surveyed(2, by="", cause="too few", states=("excluded",) * 2))
    red = lambda picture: ((picture[100:, :, 2] > 200) & (picture[100:, :, 1] < 120)).sum()  # noqa: E731
    assert red(gap) > 20 > red(good)


def test_a_frame_that_nothing_lays_on_the_ground_is_drawn_with_its_tracks():
    drawn = RunPictures((200, 120), ())(FrameResult(surveyed(1).tracked))
    assert drawn.shape == (120, 200, 3)
    assert cv2.absdiff(drawn, np.full_like(drawn, 128)).any()


# --------------------------------------------------------------------------------------------------------------------
# What the run tells of itself.


def confirmed(surveyed, kind, by=()):
    """The same, with what ground vehicles say of its target."""
    one = np.ones(1)
    probability = {"human": 0.96, "not_human": 0.04, "unseen": 0.5}[kind]
    said = Confirmation(
        surveyed.tracked.number, np.zeros(1, np.int64), (kind,), probability * one, (by,), 4 * np.ones(1, np.int64),
        0.3 * one, 0.5 * one, np.nan * one,
    )  # fmt: skip
    return replace(surveyed, confirmed=said)


def moved(surveyed, *adjustments):
    """The same, with adjustments at it."""
    return replace(surveyed, locations=replace(surveyed.locations, adjustments=adjustments, seconds={"fix": 0.01}))


def flown(folder, frames, save=("report",), events=(), score=None, geographic=False):
    """A run with all that is told of it; its record."""
    with PipelineRecorder(folder, save) as output:
        origin = (-110.95, 32.23) if geographic else None
        output.begin({"input": "sim:two"}, 10.0, (200, 120), Site(NAMES, origin))
        for event in events:
            output.story.event(*event)
        for frame in frames:
            output.write(frame)
        if score:
            output.story.score(*score)
    return json.loads((folder / "run.json").read_text())


def log(folder):
    return (folder / "log.txt").read_text().splitlines()[3:]


def test_the_log_tells_the_run_from_top_to_bottom(tmp_path):
    change = Adjustment(3, "interval.frames", 1, 2, "background flow 0.5 px a frame")
    frames = [
        surveyed(1),
        surveyed(2, by="", cause="too few landmarks", states=("excluded",) * 2),
        moved(surveyed(3), change),
        confirmed(surveyed(4), "unseen"),
        confirmed(surveyed(5), "human", ("blue",)),
    ]
    flown(tmp_path, frames, events=[(4, "crowds 1 and 2 join"), (5, "a frame was lost", 0.45, PROBLEM)])
    told = [(line.split()[1:3], line) for line in log(tmp_path)]
    assert [kind for kind, _ in told] == [
        ["2", "problem"], ["3", "adjusted"], ["4", "world"], ["5", "problem"], ["5", "told"],
    ]  # fmt: skip
    words = [line for _, line in told]
    assert "not located: too few landmarks" in words[0]
    assert "interval.frames 1 -> 2: background flow 0.5 px a frame" in words[1]
    assert words[2].split()[0] == "0.400"
    assert "target 3 is human" in words[4] and "seen by blue" in words[4]


def test_a_landmark_that_is_not_seen_for_a_while_is_told_once(tmp_path):
    def without(frame):
        item = surveyed(frame)
        marks = item.locations.marks
        gone = np.where(np.arange(2)[:, None] == 1, np.nan, marks.image_px)
        return replace(item, locations=replace(item.locations, marks=replace(marks, image_px=gone)))

    flown(tmp_path, [surveyed(1), *(without(k) for k in range(2, 9)), surveyed(9), without(10)])
    (line,) = [line for line in log(tmp_path) if " landmark " in line]
    assert "blue is not seen in the picture (to frame 10, in 8 of 9 frames)" in line


def test_what_ground_vehicles_say_is_a_table_and_is_counted(tmp_path):
    kinds = [("unseen", ()), ("human", ("blue",)), ("not_human", ("ugv, red", "blue"))]
    frames = [confirmed(surveyed(k), *said) for k, said in enumerate(kinds, 1)]
    record = flown(tmp_path, [*frames, surveyed(4)])
    table = rows(tmp_path / "confirmed.csv")
    assert [(row["frame"], row["target"], row["kind"]) for row in table] == [
        ("1", "3", "unseen"), ("2", "3", "human"), ("3", "3", "not_human"),
    ]  # fmt: skip
    assert table[1]["probability"] == "0.9600" and table[1]["seen_by"] == "blue" and table[1]["best_score"] == ""
    assert table[2]["seen_by"] == "ugv, red;blue" and float(table[2]["east_m"]) == 0
    assert record["kinds"] == {"unseen": 1, "human": 1, "not_human": 1} and record["rows_looked_at"] == 2
    assert "it was told human before" in log(tmp_path)[-1]


def test_where_nobody_looked_there_is_no_table_of_it_not_even_an_old_one(tmp_path):
    flown(tmp_path, [confirmed(surveyed(1), "human")])
    assert (tmp_path / "confirmed.csv").exists()
    record = flown(tmp_path, [surveyed(1)])
    assert not (tmp_path / "confirmed.csv").exists() and "kinds" not in record


def test_the_report_is_one_light_page_with_plots_of_knobs_key_frames_and_causes(tmp_path):
    at = {k: Adjustment(k, "interval.frames", k % 3, (k + 10) % 3, f"flow <{k}>") for k in range(5, 60, 10)}
    frames = [moved(surveyed(k), *([at[k]] if k in at else [])) for k in range(1, 61)]
    score = ({"crowd_error_m": 0.25, "of": {"count": 3}}, ["places 0.25 m off"])
    record = flown(tmp_path, frames, events=[(30, "crowds 1 & 2 join")], score=score)
    text = (tmp_path / "report.html").read_text()
    assert len(text) < 2_000_000
    assert not re.search(r"https?:|//[a-z]|url\(|@import|<link|<iframe", re.sub(r'"data:[^"]*"', "", text))
    assert 6 <= text.count("data:image/jpeg") <= 9
    assert 'class="title">interval.frames</text>' in text and 'class="title">time spent on a frame' in text
    assert "flow &lt;15&gt;" in text and "crowds 1 &amp; 2 join" in text
    assert "<h2>Against the truth</h2>" in text and "places 0.25 m off" in text
    assert record["truth_score"] == {"crowd_error_m": 0.25, "of": {"count": 3}}
    assert record["events"] == [{"frame": 30, "time_s": 3.0, "what": "crowds 1 & 2 join"}]


def test_without_a_truth_there_is_no_section_of_it(tmp_path):
    record = flown(tmp_path, [surveyed(1), surveyed(2)])
    assert "Against the truth" not in (tmp_path / "report.html").read_text() and "truth_score" not in record


def test_a_run_that_locates_nothing_has_a_log_and_a_report_without_a_map(tmp_path):
    change = Adjustment(2, "interval.frames", 1, 2, "background flow 0.5 px a frame")
    with PipelineRecorder(tmp_path, ("report",)) as output:
        output.begin({"input": "clip"}, 10.0, (200, 120))
        output.story.event(3, "frame 3 could not be read", None, PROBLEM)
        for k in (1, 2, 3):
            output.write(FrameResult(replace(surveyed(k).tracked, adjustments=(change,) if k == 2 else ())))
    assert [line.split()[2] for line in log(tmp_path)] == ["adjusted", "problem"]
    text = (tmp_path / "report.html").read_text()
    assert "data:image/png" not in text and text.count("data:image/jpeg") == 3
    assert "interval.frames 1 -&gt; 2" in text
    assert not (tmp_path / "confirmed.csv").exists()


def test_a_report_that_is_not_wanted_is_not_made_and_an_old_one_goes(tmp_path):
    for save, there in ((("report",), True), ((), False)):
        with PipelineRecorder(tmp_path, save) as output:
            output.begin({"input": "clip"}, 10.0, (200, 120))
            output.write(FrameResult(surveyed(1).tracked))
        assert (tmp_path / "report.html").exists() is there
        assert (tmp_path / "log.txt").exists()


@pytest.mark.parametrize("kind", ["human", "not_human", "unseen"])
def test_the_overlay_says_what_a_target_was_told_to_be(kind):
    plain, told = (RunPictures((200, 120), NAMES)(item) for item in (surveyed(1), confirmed(surveyed(1), kind)))
    others = [RunPictures((200, 120), NAMES)(confirmed(surveyed(1), k)) for k in ("human", "not_human", "unseen")]
    assert cv2.absdiff(plain, told)[:40, :60].any()
    assert sum(np.array_equal(told, other) for other in others) == 1


def test_an_order_is_an_arrow_from_the_vehicle_towards_its_goal():
    """Three landmarks at 10 px a metre, north up, tell where east is; the first is sent there."""
    item = surveyed(1)
    place = np.array([[0.0, 0], [5, 0], [0, 4]])
    marks = LandmarkObservations(np.arange(3), place * (10, -10) + (60, 50), place, np.ones(3), np.ones(3), np.zeros(3))
    fix = replace(item.locations.fix, landmark=np.arange(3), state=("used",) * 3)
    item = replace(item, locations=replace(item.locations, marks=marks, fix=fix))
    sent = replace(item, command=Command(orders=(Order("a", np.array([30.0, 0]), 2.0),)))
    plain, drawn = (RunPictures((200, 120), ("a", "b", "c"))(one) for one in (item, sent))
    _, columns = np.nonzero((np.abs(plain.astype(int) - drawn) > 60).any(axis=2)[40:60])
    assert 55 <= columns.min() < 66 and 68 <= columns.max() <= 80


def test_the_first_order_is_told_and_then_those_that_lead_elsewhere_unless_an_adjustment_explains_them(tmp_path):
    def sent(frame, east, *adjustments):
        orders = (Order("blue", np.array([east, 0.0]), 2.0), Order("ugv, red", np.array([east, 5.0]), 1.0))
        return moved(replace(surveyed(frame), command=Command(orders=orders)), *adjustments)

    why = Adjustment(1, "ugv, red.speed_m_s", 0, 1, "near its station")
    flown(tmp_path, [sent(1, 0.0, why), sent(2, 3.0), sent(3, 40.0)])
    ordered = [line for line in log(tmp_path) if " ordered " in line]
    assert len(ordered) == 2 and all("blue goes to" in line for line in ordered)
    assert "(40.0, 0.0) m at 2 m/s" in ordered[1]
