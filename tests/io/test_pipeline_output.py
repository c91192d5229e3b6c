"""What a run of the whole pipeline leaves in its folder, and what its pictures show."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.cli.conftest import record, rows
from torchvision_dddas.geometry import east_north
from torchvision_dddas.io.ground_tables import read_landmarks
from torchvision_dddas.io.output import PROBLEM, MapSite, PipelineRecorder
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
    GroundCrowds,
    LandmarkObservations,
    Order,
    Positions,
    TrackedFrame,
    Tracks,
)

NAMES = ("ugv, red", "blue")
SIZE = (200, 120)
ORIGIN = (-110.95, 32.23)


def located(frame, by="pose", cause="", states=("used", "excluded"), geographic=False, adjustments=()):
    """One target and two landmarks, of which the second lies at the right."""
    unknown, boxes = np.full(1, np.nan), np.array([[10, 12, 8, 8.0]])
    found = Detections(boxes, np.ones(1), np.full(1, 64.0), unknown, unknown)
    picture = np.full((120, 200, 3), 128, np.uint8)
    tracks = Tracks(frame, np.array([3]), boxes, np.ones(1), np.array([0]))
    tracked = TrackedFrame(frame, Frame(frame, frame / 10, picture), found, tracks)
    pixels, places = np.array([[40.0, 30], [120, 50]]), np.array([[1.0, 2], [3, 4]])
    marks = LandmarkObservations(np.arange(2), pixels, places, np.ones(2), np.ones(2), np.zeros(2))
    at = 1 if by else 0
    variance = np.tile(0.04 * np.eye(2), (at, 1, 1))
    positions = Positions(np.full(at, frame), np.full(at, 3), np.zeros((at, 2)), variance, np.ones(at))
    fix = Fix(frame, by, landmark=np.arange(2), state=states, cause=cause)
    unsure = np.zeros((at, 2, 2)), np.full((at, 2), np.nan)
    rest = (np.arange(at), *unsure, boxes, fix, marks, adjustments, {"fix": 0.01})
    degrees = np.array([[-110.95, 32.23], [-110.94, 32.24]]) if geographic else None
    return FrameResult(tracked, AerialLocations(frame, frame / 10, positions, *rest), ("motion", "colour"), degrees)


def confirmed(result, kind, by=()):
    """The same, with what ground vehicles say of its target."""
    one, count = np.ones(1), 4 * np.ones(1, np.int64)
    chance = {"human": 0.96, "not_human": 0.04, "unseen": 0.5}[kind] * one
    rest = (chance, (by,), count, 0.3 * one, 0.5 * one, np.nan * one)
    return replace(result, confirmed=Confirmation(result.number, np.zeros(1, np.int64), (kind,), *rest))


def run(folder, frames, save=("report",), events=(), score=None, site=MapSite(NAMES)):  # noqa: B008
    """Record a run; its record."""
    with PipelineRecorder(folder, save) as output:
        output.begin({"input": "sim:two"}, 10.0, SIZE, site)
        for event in events:
            output.story.event(*event)
        for frame in frames:
            output.write(frame)
        if score:
            output.story.score(*score)
    return record(folder)


def log(folder):
    return (folder / "log.txt").read_text().splitlines()[3:]


# --------------------------------------------------------------------------------------------------------------------
# Tables and the record.


@pytest.mark.parametrize("geographic", [False, True])
def test_the_landmarks_table_can_be_read_as_one(tmp_path, geographic):
    table = landmark_table(tmp_path, NAMES, geographic)
    for frame in (1, 2):
        table.write(located(frame, geographic=geographic))
    table.close(True)
    found = read_landmarks(tmp_path / "landmarks.csv")
    assert found.names == NAMES and found.geographic is geographic
    np.testing.assert_allclose(found.image_px[:2], [[40, 30], [120, 50]])
    np.testing.assert_allclose(found.place[0], ORIGIN if geographic else [1, 2])
    states = [(row["seen_by"], row["state"]) for row in rows(tmp_path / "landmarks.csv")]
    assert states == [("motion", "used"), ("colour", "excluded")] * 2


def test_the_record_counts_identities_beside_what_was_located(tmp_path):
    kept = run(tmp_path, [located(1), located(2)], save=())
    assert kept["identities"] == 3 and kept["positions"] == 2 and kept["landmarks"]["blue"]["used"] == 0
    assert len(rows(tmp_path / "tracks.csv")) == len(rows(tmp_path / "detections.csv")) == 2
    assert not (tmp_path / "overlay.mp4").exists()


def test_what_ground_vehicles_say_is_a_table_and_counted(tmp_path):
    said = [("unseen", ()), ("human", ("blue",)), ("not_human", ("ugv, red", "blue"))]
    kept = run(tmp_path, [*(confirmed(located(k), *one) for k, one in enumerate(said, 1)), located(4)])
    table = rows(tmp_path / "confirmed.csv")
    assert [(row["frame"], row["target"], row["kind"]) for row in table] == [
        ("1", "3", "unseen"), ("2", "3", "human"), ("3", "3", "not_human"),
    ]  # fmt: skip
    assert table[1]["probability"] == "0.9600" and table[1]["seen_by"] == "blue" and table[1]["best_score"] == ""
    assert table[2]["seen_by"] == "ugv, red;blue" and float(table[2]["east_m"]) == 0
    assert kept["kinds"] == {"unseen": 1, "human": 1, "not_human": 1} and kept["rows_looked_at"] == 2
    assert "it was judged human before" in log(tmp_path)[-1]
    assert "kinds" not in run(tmp_path, [located(1)]) and not (tmp_path / "confirmed.csv").exists()


@pytest.mark.parametrize("geographic", [False, True])
def test_crowds_that_ground_vehicles_see_are_a_table_and_without_any_there_is_none(tmp_path, geographic):
    site = MapSite(NAMES, ORIGIN if geographic else None)
    place, velocity = np.array([[2.0, 1.0], [9.0, 9.0]]), np.array([[0.5, -0.5], [np.nan, np.nan]])
    by, steers = np.array(["blue;red", "red"], object), np.array([True, False])
    seen = GroundCrowds(np.array([3, 5]), place, velocity, np.array([4, 1]), by, steers)
    results = [located(k, geographic=geographic) for k in (1, 2, 3)]
    at = [replace(one.locations.positions, origin_deg=site.origin_deg) for one in results]
    there = [replace(one.locations, positions=where) for one, where in zip(results, at, strict=True)]
    crowds = (GroundCrowds(), seen, None)
    frames = [replace(*one[:1], locations=one[1], crowds=one[2]) for one in zip(results, there, crowds, strict=True)]
    run(tmp_path, frames, site=site)
    one, other = rows(tmp_path / "crowds.csv")
    names = ("frame", "target", "people", "seen_by", "steers")
    assert [one[name] for name in names] == ["2", "3", "4", "blue;red", "1"]
    assert (one["east_m"], one["north_m"], one["velocity_east_m_s"]) == ("2.0000", "1.0000", "0.5000")
    assert (other["target"], other["velocity_east_m_s"], other["steers"]) == ("5", "", "0")
    assert ("longitude_deg" in one) == geographic
    if geographic:
        degrees = np.array([[float(one["longitude_deg"]), float(one["latitude_deg"])]])
        np.testing.assert_allclose(east_north(degrees, ORIGIN)[0], place[0], atol=0.01)
    run(tmp_path, frames[2:], site=site)
    assert not (tmp_path / "crowds.csv").exists()


# --------------------------------------------------------------------------------------------------------------------
# The log and the report.


def test_the_log_tells_the_run_from_top_to_bottom(tmp_path):
    change = Adjustment(3, "interval.frames", 1, 2, "background flow 0.5 px a frame")
    frames = [
        located(1),
        located(2, by="", cause="too few landmarks", states=("excluded",) * 2),
        located(3, adjustments=(change,)),
        confirmed(located(4), "unseen"),
        confirmed(located(5), "human", ("blue",)),
    ]
    run(tmp_path, frames, events=[(4, "crowds 1 and 2 join"), (5, "a frame was lost", 0.45, PROBLEM)])
    lines = [" ".join(line.split()) for line in log(tmp_path)]
    assert lines[:4] == [
        "0.200 2 problem not located: too few landmarks",
        "0.300 3 adjusted interval.frames 1 -> 2: background flow 0.5 px a frame",
        "0.400 4 world crowds 1 and 2 join",
        "0.450 5 problem a frame was lost",
    ]
    assert lines[4].startswith("0.500 5 told target 3 is human") and "seen by blue" in lines[4] and len(lines) == 5


def test_a_landmark_not_seen_for_a_while_is_logged_once(tmp_path):
    def without(frame):
        item = located(frame)
        marks = item.locations.marks
        gone = np.where(np.arange(2)[:, None] == 1, np.nan, marks.image_px)
        return replace(item, locations=replace(item.locations, marks=replace(marks, image_px=gone)))

    run(tmp_path, [located(1), *(without(k) for k in range(2, 9)), located(9), without(10)])
    (line,) = [line for line in log(tmp_path) if " landmark " in line]
    assert "blue is not seen in the picture (to frame 10, in 8 of 9 frames)" in line


@pytest.mark.parametrize("geographic", [False, True])
def test_orders_are_logged_when_they_lead_elsewhere_and_no_adjustment_explains_them(tmp_path, geographic):
    def sent(frame, east_m, *adjustments):
        place = np.array([east_m, 0.0])
        goal = [-110.95, 32.23] + (place - (1, 2)) * (0.005, 0.005) if geographic else place  # 0.01 degrees are 2 m
        orders = (Order("blue", goal, 2.0, goal), Order("ugv, red", goal, 1.0))
        command = Command(2, None, goal, 55.0, orders)
        return replace(located(frame, geographic=geographic, adjustments=adjustments), command=command)

    why = (Adjustment(1, "ugv, red.speed_m_s", 0, 1, "near its station"), Adjustment(1, "uav.look_at", 0, 1, "crowd"))
    run(tmp_path, [sent(1, 0.0, why[0]), sent(2, 3.0, why[1]), sent(3, 40.0)])
    ordered = [line.partition(" ordered ")[2].strip() for line in log(tmp_path) if " ordered " in line]
    assert ordered == [
        "the UAV keeps (0.0, 0.0) m in view from 55 m",
        *(f"blue goes to ({east}, 0.0) m at 2 m/s and looks at ({east}, 0.0) m" for east in ("0.0", "40.0")),
    ]


def test_the_report_is_one_light_page_with_plots_of_parameters_key_frames_and_causes(tmp_path):
    at = {k: (Adjustment(k, "interval.frames", k % 3, (k + 10) % 3, f"flow <{k}>"),) for k in range(5, 60, 10)}
    score = ({"crowd_error_m": 0.25, "of": {"count": 3}}, ["places 0.25 m off"])
    frames = [located(k, adjustments=at.get(k, ())) for k in range(1, 61)]
    kept = run(tmp_path, frames, events=[(30, "crowds 1 & 2 join")], score=score)
    text = (tmp_path / "report.html").read_text()
    assert len(text) < 2_000_000
    assert not re.search(r"url\(|@import|<link|<iframe|src=\"(?!data:|map.png)", text)
    assert 6 <= text.count("data:image/jpeg") <= 9
    assert 'class="title">interval.frames</text>' in text and 'class="title">time spent on a frame' in text
    assert "flow &lt;15&gt;" in text and "crowds 1 &amp; 2 join" in text
    assert "<h2>Against the truth</h2>" in text and "places 0.25 m off" in text
    assert kept["truth_score"] == {"crowd_error_m": 0.25, "of": {"count": 3}}
    assert kept["events"] == [{"frame": 30, "time_s": 3.0, "what": "crowds 1 & 2 join"}]
    assert "truth_score" not in run(tmp_path, [located(1), located(2)])
    assert "Against the truth" not in (tmp_path / "report.html").read_text()


def test_a_run_that_locates_nothing_has_a_log_and_if_wanted_a_report_without_a_map(tmp_path):
    change = Adjustment(2, "interval.frames", 1, 2, "background flow 0.5 px a frame")
    frames = [FrameResult(replace(located(k).tracked, adjustments=(change,) if k == 2 else ())) for k in (1, 2, 3)]
    run(tmp_path, frames, site=None, events=[(3, "frame 3 could not be read", None, PROBLEM)])
    assert [line.split()[2] for line in log(tmp_path)] == ["adjusted", "problem"]
    text = (tmp_path / "report.html").read_text()
    assert "data:image/png" not in text and text.count("data:image/jpeg") == 3
    assert "interval.frames 1 -&gt; 2" in text and not (tmp_path / "confirmed.csv").exists()
    run(tmp_path, frames, site=None, save=())
    assert not (tmp_path / "report.html").exists() and (tmp_path / "log.txt").exists()


# --------------------------------------------------------------------------------------------------------------------
# The overlay.


def test_landmarks_are_drawn_in_the_colour_of_their_state():
    picture = RunPictures(SIZE, NAMES)(located(1))
    for (u, v), state in (((40, 30), "used"), ((120, 50), "excluded")):
        ring = np.abs(picture[v - 14 : v + 15, u - 14 : u + 15].astype(int) - LANDMARK[state]).max(axis=2) < 40
        assert ring.sum() > 20


def test_the_caption_says_why_a_frame_is_not_located_and_frames_without_places_show_their_tracks():
    draw = RunPictures(SIZE, NAMES)
    good, gap = draw(located(1)), draw(located(2, by="", cause="too few", states=("excluded",) * 2))
    good_red, gap_red = (((p[100:, :, 2] > 200) & (p[100:, :, 1] < 120)).sum() for p in (good, gap))
    assert gap_red > 20 > good_red
    plain = RunPictures(SIZE, ())(FrameResult(located(1).tracked))
    assert plain.shape == (120, 200, 3) and (plain != 128).any()


def test_the_overlay_differs_with_what_ground_vehicles_say_of_a_target():
    results = [located(1), *(confirmed(located(1), kind) for kind in ("human", "not_human", "unseen"))]
    pictures = [RunPictures(SIZE, NAMES)(result)[:40, :60] for result in results]
    assert all(cv2.absdiff(a, b).any() for k, a in enumerate(pictures) for b in pictures[:k])


def test_an_order_is_an_arrow_from_the_vehicle_towards_its_goal():
    """Three landmarks at 10 px a metre, north up, tell where east is; the first is sent there."""
    item = located(1)
    place = np.array([[0.0, 0], [5, 0], [0, 4]])
    marks = LandmarkObservations(np.arange(3), place * (10, -10) + (60, 50), place, np.ones(3), np.ones(3), np.zeros(3))
    fix = replace(item.locations.fix, landmark=np.arange(3), state=("used",) * 3)
    item = replace(item, locations=replace(item.locations, marks=marks, fix=fix))
    sent = replace(item, command=Command(orders=(Order("a", np.array([30.0, 0]), 2.0),)))
    plain, drawn = (RunPictures(SIZE, ("a", "b", "c"))(one) for one in (item, sent))
    _, columns = np.nonzero((np.abs(plain.astype(int) - drawn) > 60).any(axis=2)[40:60])
    assert 55 <= columns.min() < 66 and 68 <= columns.max() <= 80
