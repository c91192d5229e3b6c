"""`dddas locate aerial`: what it writes, how near it comes to the truth, and one line for each mistake."""

import re

import numpy as np
import pytest

from tests.cli.conftest import bad, record, rows
from tests.overflight import Overflight

FLAT = ("--set", "aerial.mode=homography")


@pytest.fixture
def aerial(dddas, file, tmp_path):
    """Run the command on the files of a flight; a file given by name replaces one, None leaves it out."""
    names = {"landmarks": "l.csv", "telemetry": "tel.csv", "camera": "c.toml", "table": "t.txt"}

    def run(flight, *more, rate=True, **files):
        given = {
            "landmarks": flight.landmarks_csv(),
            "telemetry": flight.telemetry_csv(),
            "camera": flight.camera_toml(),
            "table": flight.tracks_txt(),
            **files,
        }
        paths = {what: file(names[what], text) for what, text in given.items() if text is not None}
        table = paths.pop("table")
        words = [word for what, path in paths.items() for word in (f"--{what}", path)]
        words += ["--rate", flight.rate_hz] if rate else []
        return dddas("locate", "aerial", table, *words, "--out", tmp_path / "out", "--save", "none", *more)

    return run


@pytest.fixture
def located(aerial, tmp_path):
    """The rows of the positions, and what was said."""

    def run(flight, *more, **files):
        result = aerial(flight, *more, **files)
        assert result.exit_code == 0, result.output
        return rows(tmp_path / "out" / "positions.csv"), result.stdout

    return run


def test_exact_input_puts_every_target_where_it_is(located):
    flight = Overflight()
    found, said = located(flight)
    assert len(found) == 40
    assert flight.errors(found).max() < 0.001
    assert {row["by"] for row in found} == {"pose"}
    way = (flight.targets(2) - flight.targets(1)) * flight.rate_hz
    velocity = [[float(row[f"velocity_{axis}_m_s"]) for axis in ("east", "north")] for row in found[-4:]]
    np.testing.assert_allclose(velocity, way, atol=0.1)
    assert "note: repaired" not in said and "lie far outside" not in said


@pytest.mark.slow
def test_warnings_and_repairs_are_reported_at_the_end(located):
    flight = Overflight()
    _, up = located(flight, telemetry=flight.telemetry_csv(heading_deg=-150))
    assert "note: located with a warning, frames 1 to 10: landmarks and telemetry disagree" in up
    header, *lines = (line.split(",") for line in flight.landmarks_csv().splitlines())
    for one, other in zip(lines[::4], lines[1::4], strict=True):
        one[2:4], other[2:4] = other[2:4], one[2:4]
    swapped = "\n".join(map(",".join, [header, *lines])) + "\n"
    assert "note: repaired, frames 1 to 10: identities" in located(flight, landmarks=swapped)[1]


def test_landmarks_alone_will_do_and_so_will_local_metres(located, tmp_path):
    flight = Overflight(geographic=False)
    found, _ = located(flight, telemetry=None)
    assert flight.errors(found).max() < 0.001
    assert "longitude_deg" not in found[0]
    assert not (tmp_path / "out" / "tracks.geojson").exists()


@pytest.mark.parametrize("backend", ["onboard", "torch"])
def test_a_homography_needs_neither_camera_nor_rate(located, tmp_path, backend):
    pytest.importorskip("torch")
    flight = Overflight()
    found, _ = located(flight, *FLAT, "--backend", backend, telemetry=None, camera=None, rate=False)
    assert flight.errors(found).max() < 0.001
    assert {row["by"] for row in found} == {"homography"}
    assert any("no --rate" in note for note in record(tmp_path / "out")["notes"])


def test_the_foot_of_a_body_is_below_its_middle_or_where_the_table_says(located):
    flight = Overflight(pitch_deg=45, body_m=1.7)
    foot, centre = (flight.errors(located(flight, "--set", f"aerial.point={at}")[0]) for at in ("foot", "centre"))
    assert foot.max() < 0.01
    assert centre.min() > 0.5
    lines = ["frame,x_px,y_px,width_px,height_px,feet_u_px,feet_v_px"]
    for frame in flight.numbers():
        shown = flight.shown(frame, flight.targets(frame))
        lines += [f"{frame},{u - 20:.3f},{v - 90:.3f},40,60,{u:.4f},{v:.4f}" for u, v in shown]
    assert flight.errors(located(flight, table="\n".join(lines) + "\n")[0]).max() < 0.001


def test_the_error_that_all_receivers_share_is_in_the_absolute_covariance_alone(located):
    flight = Overflight(frames=3)
    (alone, *_), _ = located(flight)
    (shared, *_), _ = located(flight, "--set", "landmarks.common_sigma_m=2.0")
    for key in ("var_east_m2", "var_north_m2"):
        assert float(shared[key]) - float(alone[key]) == pytest.approx(4.0, abs=1e-3)
    assert [shared[name] for name in ("relative_sigma_m", "east_m")] == [alone["relative_sigma_m"], alone["east_m"]]


@pytest.mark.slow
def test_ellipses_hold_the_truth_where_receivers_err(located):
    """Each flight has receivers of its own; in all of them together about 95 % of the ellipses hold."""
    inside = []
    for seed in range(12):
        flight = Overflight(frames=1, gps_m=1.43, pixel=1.0, seed=seed)
        for row in located(flight)[0]:
            # The origin moves with the first landmark's receiver: compare on the globe.
            away = np.array([float(row["east_m"]), float(row["north_m"])]) - flight.at_origin(1, row)
            east, both, north = (float(row[name]) for name in ("var_east_m2", "cov_east_north_m2", "var_north_m2"))
            inside.append(away @ np.linalg.solve([[east, both], [both, north]], away) < 5.99)
    assert np.mean(inside) > 0.85


def test_a_frame_with_too_few_landmarks_is_a_flagged_gap(located, tmp_path):
    flight = Overflight()
    few = flight.landmarks_csv(keep=lambda frame, k: frame != 4 or k < 3)
    found, said = located(flight, landmarks=few, telemetry=None)
    assert {int(row["frame"]) for row in found} == set(range(1, 11)) - {4}
    (gap,) = record(tmp_path / "out")["unreliable"]
    assert (gap["first"], gap["last"]) == (4, 4)
    assert "3 landmarks" in gap["cause"] and "1 missing" in gap["cause"]
    assert said.splitlines()[-1].endswith("; 1 of 10 frames without a position; run.json lists the causes")


def test_frames_that_a_log_does_not_cover_are_counted_on_the_screen_in_the_record_and_in_the_report(located, tmp_path):
    flight = Overflight(frames=30)
    head, *lines = flight.telemetry_csv().splitlines()
    for first, last in ((0, 18), (12, 30), (5, 25)):
        part = "\n".join([head, *lines[first:last]]) + "\n"
        found, said = located(flight, "--save", "report", telemetry=part, landmarks=None)
        assert {int(row["frame"]) for row in found} == set(range(first + 1, last + 1))
        missing = 30 - (last - first)
        assert f"; {missing} of 30 frames without a position" in said.splitlines()[-1]
        assert record(tmp_path / "out")["frames_without_position"] == missing
        page = (tmp_path / "out" / "report.html").read_text()
        assert re.search(rf"frames without a position\W.*?>\s*{missing}\s*<", page, re.DOTALL)
    assert "without a position" not in located(flight, landmarks=None)[1]


def test_a_landmark_hardly_ever_at_its_place_is_reported(located):
    class Wrong(Overflight):
        def shown(self, frame, east_north, up_m=0.0):
            seen = super().shown(frame, east_north, up_m)
            # The picture shows another vehicle, 200 px away, in its place.
            return seen + [[200.0, 0.0]] * np.isclose(east_north, self.marks(frame)[1]).all(axis=1)[:, None]

    found, said = located(Wrong(landmarks=6))
    assert Overflight(landmarks=6).errors(found).max() < 0.3
    assert "note: ugv1 was left out in 10 of 10 frames" in said


def test_telemetry_alone_bridges_a_frame_without_landmarks(located):
    flight = Overflight()
    found, _ = located(flight, landmarks=flight.landmarks_csv(keep=lambda frame, k: frame != 4))
    here = [row for row in found if row["frame"] == "4"]
    assert [row["by"] for row in here] == ["telemetry"] * 4
    assert flight.errors(here).max() < 0.5


def test_a_table_without_rows_gives_no_positions(located):
    assert located(Overflight(), table="")[0] == []


class Row(Overflight):
    """Landmarks on one line."""

    def marks(self, frame):
        return np.outer(np.arange(4) - 1.5, [8.0, 3.0])


def change(text, names, new):
    """A table with the cells of some columns changed: new(cells) gives theirs."""
    header, *lines = (line.split(",") for line in text.splitlines())
    columns = [header.index(name) for name in names]
    for line in lines:
        for column, cell in zip(columns, new([line[column] for column in columns]), strict=True):
            line[column] = cell
    return "\n".join(map(",".join, [header, *lines])) + "\n"


FLIGHT, METRES = Overflight(), Overflight(geographic=False)
MARKS, TELEMETRY, TRACKS = FLIGHT.landmarks_csv(), FLIGHT.telemetry_csv(), FLIGHT.tracks_txt()
SWAPPED = change(MARKS, ("longitude_deg", "latitude_deg"), lambda cells: cells[::-1])
FAR = change(METRES.telemetry_csv(), ("east_m",), lambda cells: ["541000.0"])
LATER = "".join(f"{int(line.split(',', 1)[0]) + 100},{line.split(',', 1)[1]}\n" for line in TRACKS.splitlines())
SMALL = FLIGHT.camera_toml().replace("1280", "320").replace("720", "180")


@pytest.mark.parametrize(
    ("flight", "how", "parts"),
    [
        (Overflight(landmarks=3), {"telemetry": None}, ("needs 4 landmarks", "frame 1 has 3", "1 missing")),
        (Row(), {"telemetry": None}, ("lie on one line",)),
        (METRES, {"telemetry": TELEMETRY}, ("landmarks are in local metres, the telemetry in longitude",)),
        (FLIGHT, {"landmarks": SWAPPED}, ("swapped",)),
        (FLIGHT, {"landmarks": MARKS + MARKS.splitlines()[1] + "\n"}, ("ugv0 is in frame 1 already",)),
        (FLIGHT, {"telemetry": FLIGHT.telemetry_csv(shift_s=500.0)}, ("500.0 to 500.9 s", "0.0 to 0.9 s")),
        (FLIGHT, {"telemetry": FLIGHT.telemetry_csv(altitude_m=-3.0)}, ("below ground",)),
        (FLIGHT, {"telemetry": FLIGHT.telemetry_csv(pitch_deg=-90.0)}, ("into the sky", "change the sign of pitch")),
        (METRES, {"telemetry": FAR}, ("the vehicle is 541 km or more from the landmarks",)),
        (FLIGHT, {"table": LATER, "telemetry": None}, ("frames 101 to 110", "1 to 10")),
        (FLIGHT, {"landmarks": FLIGHT.landmarks_csv(pictured=False)}, ("u_px,v_px",)),
        (FLIGHT, {"camera": None}, ("--camera FILE or --clip CLIP",)),
        (FLIGHT, {"camera": SMALL}, ("l.csv, line ", "far outside the camera's pictures of 320 x 180 px")),
        (FLIGHT, {"rate": False}, ("--rate",)),
        (METRES, {"telemetry": None, "more": ("--set", "aerial.mode=paper")}, ("needs degrees",)),
        (FLIGHT, {"table": TRACKS + TRACKS.splitlines()[0] + "\n"}, ("identity 1 occurs twice",)),
    ],
)
def test_bad_input_is_one_line_and_leaves_no_folder(aerial, tmp_path, flight, how, parts):
    line = bad(aerial(flight, *how.pop("more", ()), **how))
    assert [part for part in parts if part not in line] == []
    assert not (tmp_path / "out").exists()


def test_a_camera_of_another_size_than_the_clip_is_refused(aerial, clip):
    assert "1280 x 720 px, the clip of 64 x 48" in bad(aerial(Overflight(frames=5), "--clip", clip))


def test_a_camera_too_small_for_its_landmarks_does_not_matter_to_a_homography(located):
    assert FLIGHT.errors(located(FLIGHT, *FLAT, camera=SMALL)[0]).max() < 0.05


def test_landmarks_on_a_line_widened_by_receivers_errors_need_telemetry(aerial, located):
    flight = Row(gps_m=1.43, pixel=1.0, frames=2)
    assert "lie on one line" in bad(aerial(flight, telemetry=None))
    assert flight.errors(located(flight)[0]).max() < 3.0


def test_an_altitude_below_the_ground_for_a_while_is_reported_and_not_used(located):
    header, *lines = TELEMETRY.splitlines(keepends=True)
    low = change("".join([header, *lines[:4]]), ("altitude_m",), lambda cells: ["-3.0"])
    found, said = located(FLIGHT, telemetry="".join([low, *lines[4:]]))
    assert FLIGHT.errors(found).max() < 0.05
    assert "at or below ground in 4 of 10 samples, the first at 0.0 s: it is not used there" in said


def test_boxes_far_outside_the_cameras_pictures_are_reported(located):
    _, said = located(FLIGHT, table=TRACKS + "10,9,3000,100,20,20,1,-1,-1,-1\n")
    assert "note: 1 of 41 boxes lie far outside the camera's pictures of 1280 x 720 px" in said


ALONE = {"landmarks": None}


def test_telemetry_alone_locates_every_target_without_a_warning(located, tmp_path):
    flight = Overflight(geographic=False, pitch_deg=60)
    found, said = located(flight, **ALONE)
    assert len(found) == 40 and {row["by"] for row in found} == {"telemetry"}
    assert np.hypot(*np.diff([[float(r["east_m"]), float(r["north_m"])] for r in found[:2]], axis=0)[0]) > 10
    assert flight.errors(found).max() < 0.01
    assert "located with a warning" not in said and "0 located" not in said
    assert record(tmp_path / "out")["by"]["telemetry"] == 10


def test_what_the_log_lacks_comes_from_the_cameras_file(aerial, located, tmp_path):
    flight = Overflight(geographic=False, pitch_deg=60)
    lines = [line.split(",") for line in flight.telemetry_csv().splitlines()]
    bare = "\n".join(",".join(line[:5]) for line in lines) + "\n"  # neither heading, pitch nor roll
    angles = f"heading_deg = {np.degrees(flight.heading_rad)}\npitch_deg = 60\nroll_deg = 0\n"
    found, said = located(flight, telemetry=bare, camera=flight.camera_toml() + angles, **ALONE)
    assert flight.errors(found).max() < 0.01
    assert "note: the log does not say heading_deg, pitch_deg, roll_deg: they are taken from camera c" in said
    nothing = aerial(flight, "--quiet", telemetry=bare, **ALONE)
    cause = "0 located, because the telemetry does not say the camera's heading, pitch; add the columns heading_deg"
    assert (nothing.exit_code, nothing.stdout, rows(tmp_path / "out" / "positions.csv")) == (3, "", [])
    assert nothing.stderr.startswith(f"dddas: {cause}") and nothing.stderr.count("\n") == 1
    assert any(note.startswith(cause) for note in record(tmp_path / "out")["notes"])


def test_a_camera_that_looks_straight_down_or_by_its_file_into_the_sky(aerial, located):
    flight = Overflight(geographic=False)
    lines = [line.split(",") for line in flight.telemetry_csv().splitlines()]
    bare = "\n".join(",".join(line[:5]) for line in lines) + "\n"
    file = f"{flight.camera_toml()}heading_deg = {np.degrees(flight.heading_rad)}\nroll_deg = 0\npitch_deg = "
    found, _ = located(flight, telemetry=bare, camera=f"{file}90\n", **ALONE)
    assert flight.pitch_deg == 90 and flight.errors(found).max() < 0.01
    line = bad(aerial(flight, telemetry=bare, camera=f"{file}-60\n", **ALONE))
    assert "by the camera file's pitch of -60 degrees the camera looks into the sky" in line
    assert "change the sign" in line


def test_a_take_off_above_the_whole_flight_is_refused(aerial):
    flight = Overflight(geographic=False)
    telemetry = flight.telemetry_csv().replace("altitude_m", "above_sea_m", 1)
    line = bad(
        aerial(flight, telemetry=telemetry, camera=flight.camera_toml() + "takeoff_above_sea_m = 900\n", **ALONE)
    )
    assert "the altitude by the camera's takeoff_above_sea_m is -" in line and "below ground throughout" in line


def test_bridges_and_untracked_detections_have_no_place_as_in_a_run(located, tmp_path):
    flight = Overflight(geographic=False, pitch_deg=60)
    lines = ["frame,identity,x_px,y_px,width_px,height_px,score,kind,row,speed_px_per_frame"]
    for cells in (line.split(",") for line in flight.tracks_txt().splitlines()):
        kind = "bridge" if (cells[0], cells[1]) in (("4", "2"), ("5", "2")) else "detection"
        lines.append(",".join([*cells[:6], "1", kind, "" if kind == "bridge" else "1", ""]))
    lines.append("6,-1,100,100,20,20,0.1,untracked,9,")
    found, said = located(flight, table="\n".join(lines) + "\n", **ALONE)
    assert "10 frames, 38 detections\n38 positions; of the frames 10 by telemetry\n" in said
    assert "note: boxes that bridge gaps between detections were not seen and have no place: 2\n" in said
    assert "note: detections without identity were not tracked and have no place: 1\n" in said
    assert {row["frame"] for row in found if row["target"] == "2"} == {*"1236789", "10"}
    assert (record(tmp_path / "out")["positions"], record(tmp_path / "out")["bridges"]) == (38, 2)


def test_boxes_above_the_horizon_have_no_row_and_are_counted(located, tmp_path):
    flight = Overflight(geographic=False, pitch_deg=15)
    table = flight.tracks_txt() + "".join(f"{frame},9,600,2,20,20,1,-1,-1,-1\n" for frame in flight.numbers())
    found, said = located(flight, table=table, **ALONE)
    assert {row["target"] for row in found} == {"1", "2", "3", "4"}
    assert "note: 10 boxes of located frames have no place: they lie above the horizon" in said
    assert record(tmp_path / "out")["unplaced"] == 10


def test_locating_needs_telemetry_or_landmarks_and_a_key_that_no_camera_has_is_refused(aerial):
    assert "needs --telemetry FILE or --landmarks FILE" in bad(aerial(Overflight(), telemetry=None, **ALONE))
    wrong = Overflight().camera_toml() + "pich_deg = 45\n"
    assert "has the unknown key pich_deg; did you mean pitch_deg?" in bad(aerial(Overflight(), camera=wrong, **ALONE))
