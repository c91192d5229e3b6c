"""Platforms beside a clip from the air, from their files to `confirmed` and `fused`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.geo.test_fusion import aerial
from torchvision_dddas.config import Settings
from torchvision_dddas.control import FurtherUav, GroundTeam
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.platform_files import Platform
from torchvision_dddas.types import Detections, FrameResult, TrackedFrame, Tracks

CAMERA = """
[camera]
width_px = 1280
height_px = 960
focal_px = 1000
height_m = 1.5
pitch_deg = 0
heading_deg = 0
east_m = 0
north_m = {north}
"""


def platform(folder, name, people, extra="rate_hz = 2", north=-10.0):
    """A camera 10 m south of the middle that looks north, and a table of people at metres (ahead, aside) by frame."""
    rows = ["frame,x_px,y_px,width_px,height_px,score"]
    for frame, (ahead, aside) in people:
        tall, u, v = 1750 / ahead, 639.5 + 1000 * aside / ahead, 479.5 + 1500 / ahead
        rows.append(f"{frame},{u - 0.2 * tall + 0.5},{v - tall + 0.5},{0.4 * tall},{tall},0.95")
    (folder / f"{name}.csv").write_text("\n".join(rows) + "\n")
    path = folder / f"{name}.toml"
    path.write_text(f'detections = "{name}.csv"\n{extra}\n' + CAMERA.format(north=north))
    return path


def results(place, seconds=4.0, origin=None):
    for k in range(round(10 * seconds)):
        located = aerial(k / 10, place, origin=origin)
        tracked = TrackedFrame(k + 1, None, Detections(), Tracks(k + 1))
        yield FrameResult(tracked, located)


def run(paths, place=((0.0, 0.0), (30.0, 0.0))):
    team = GroundTeam(paths, Settings())
    team.check(True, None)
    return team, list(team.mark(results(place)))


STANDS = [(frame, (10.0, 0.0)) for frame in range(1, 8)]


def test_people_seen_from_the_ground_confirm_a_target_and_measure_its_place(tmp_path):
    team, found = run([platform(tmp_path, "ugv1", STANDS)])
    last = found[-1]
    assert last.confirmed.kind == ("human", "unseen") and found[-1].fused.by == "uav"
    seen = {seen["uav"]: set(seen) for seen in found[-5].fused.seen_by}
    assert seen == {1: {"uav", "ugv1"}, 2: {"uav"}}
    assert np.trace(last.fused.covariance[0, :2, :2]) < 0.7 * np.trace(last.locations.positions.covariance_m2[0])
    assert team.facts["ugv1"]["shared"] == 7 and team.notes == []


def test_a_target_where_nobody_is_seen_is_not_human(tmp_path):
    people = [(frame, (16.0, 8.0)) for frame in range(1, 8)]  # beside it
    _, found = run([platform(tmp_path, "ugv1", people)], ((0.0, 0.0),))
    assert found[-1].confirmed.kind == ("not_human",)


def test_a_clip_that_begins_later_is_used_from_then_on(tmp_path):
    team, found = run([platform(tmp_path, "ugv1", STANDS, "rate_hz = 2\nstarts_s = 2.0")])
    assert found[15].confirmed.kind[0] == "unseen" and found[-1].confirmed.kind[0] == "human"
    assert team.facts["ugv1"]["frames"] == 4


@pytest.mark.parametrize(
    ("extra", "north", "says"),
    [
        ("rate_hz = 2\nstarts_s = 60", -10.0, "was not used"),
        ("rate_hz = 2", -200.0, "none of them is where another platform"),
    ],
)
def test_a_platform_that_is_elsewhere_in_time_or_space_is_noted(tmp_path, extra, north, says):
    team, found = run([platform(tmp_path, "ugv1", STANDS, extra, north=north)])
    assert [says in note for note in team.notes] == [True] and found[-1].confirmed.kind[0] == "unseen"


def test_frames_without_a_pose_are_left_out_and_counted(tmp_path):
    path = platform(tmp_path, "ugv1", STANDS, 'rate_hz = 2\nposes = "poses.csv"')
    (tmp_path / "poses.csv").write_text("frame,east_m,north_m,heading_deg\n1,0,-10,0\n4,0,-10,0\n")
    team, _ = run([path])
    assert team.facts["ugv1"]["frames"] == 4 and any("3 pictures lie outside its poses" in n for n in team.notes)


def test_poses_by_time_hold_up_to_their_last(tmp_path):
    path = platform(tmp_path, "ugv1", STANDS, 'rate_hz = 10\nposes = "poses.csv"')
    (tmp_path / "poses.csv").write_text("time_s,east_m,north_m,heading_deg\n0,0,-10,0\n0.3,0,-10,0\n")
    team, _ = run([path])
    assert team.facts["ugv1"]["frames"] == 4  # the fourth is at 3 / 10 s, a little more than 0.3


def test_a_platform_that_sees_nobody_is_noted(tmp_path):
    far = [(frame, (5000.0, 0.0)) for frame in range(1, 4)]
    team, _ = run([platform(tmp_path, "ugv1", far)])
    assert team.notes and "located nobody in its" in team.notes[-1]


def test_a_clip_without_places_of_another_kind_or_without_a_clock_is_refused(tmp_path):
    path = platform(tmp_path, "ugv1", STANDS)
    for located, origin, says in ((False, None, "--telemetry or --landmarks"), (True, (8.0, 50.0), "one kind")):
        with pytest.raises(InputError, match=says):
            GroundTeam([path], Settings()).check(located, origin)
    dated = platform(tmp_path, "ugv2", STANDS, "rate_hz = 2\nstarts_utc = 2026-05-01T12:00:00Z")
    with pytest.raises(InputError, match="starts_s"):
        GroundTeam([dated], Settings()).check(True, None)
    with pytest.raises(InputError, match="its own name"):
        GroundTeam([path, path], Settings())


def test_a_date_is_a_start_where_the_log_tells_one(tmp_path):
    path = platform(tmp_path, "ugv1", STANDS, "rate_hz = 2\nstarts_utc = 1970-01-01T00:01:42Z")
    team = GroundTeam([path], Settings())
    team.check(True, None, 100.0)
    list(team.mark(results(((0.0, 0.0),))))
    assert team.facts["ugv1"]["frames"] == 4


def seen_from(shown, shift=(0.0, 0.0), seconds=9.0, starts_s=0.0):
    """Results of a UAV that shows some of three walkers; shown(walker, time_s) is its number, 0 if out of view."""
    for k in range(round(10 * seconds)):
        time_s = k / 10 + starts_s
        place = np.array([[0.0, 0.0], [9.0, 2.0], [-8.0, 5.0]]) + time_s * np.array([1.0, 0.5]) + shift
        number = np.array([shown(walker, time_s) for walker in range(3)])
        located = replace(aerial(k / 10, place[number > 0], number[number > 0]), frame=k + 1)
        yield FrameResult(TrackedFrame(k + 1, None, Detections(), Tracks(k + 1)), located)


def further(name, results, starts_s=0.0):
    file = Platform(
        name=name, clip=f"{name}.mp4", detections=None, starts_s=starts_s, starts_utc_s=np.nan, rate_hz=None,
        interval=1, files=(Path(f"{name}.toml"),),
    )  # fmt: skip
    return FurtherUav(file, results, None, np.nan, lambda: ["a note"])


def test_a_target_that_leaves_one_view_keeps_its_identity_in_the_other():
    def main(walker, time_s):  # the first two leave, and one of them comes back as another number
        return 0 if walker < 2 and 5 < time_s < (12 if walker else 7) else walker + 1 + 10 * (time_s >= 7)

    def second(walker, time_s):
        return 0 if walker == 2 and time_s > 4 else 7 - walker

    uav2 = further("uav2", seen_from(second, (1.5, -1.0), starts_s=0.1), starts_s=0.1)
    team = GroundTeam([], Settings(), uavs=[uav2])
    team.check(True, None)
    found = [result.fused for result in team.mark(seen_from(main)) if result.fused is not None]
    numbers = {tuple(sorted(one.target.tolist())) for one in found[40:]}
    assert len(numbers) == 1 and len(numbers.pop()) == 3
    pairs = [dict(zip(one.target, one.seen_by, strict=True)) for one in (found[40], found[85])]
    by_walker = {seen["uav"] - 1: n for n, seen in pairs[0].items()}
    assert pairs[0][by_walker[0]] == {"uav": 1, "uav2": 7} and pairs[1][by_walker[0]] == {"uav": 11, "uav2": 7}
    assert pairs[1][by_walker[1]] == {"uav2": 6} and pairs[1][by_walker[2]] == {"uav": 13}
    assert (
        team.notes == ["uav2: a note"]
        and team.facts["uav2"]["frames"] == 89
        and team.facts["uav"]["shared"] > 0
        and team.fusion.late == 0
    )
