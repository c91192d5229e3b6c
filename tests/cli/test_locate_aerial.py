"""`dddas locate aerial`: what it writes, how near it comes to the truth, and one line for each mistake."""

import numpy as np
import pytest

from tests.cli.conftest import bad, record
from tests.cli.conftest import rows as read_rows
from tests.overflight import Overflight


def located(result, folder):
    assert result.exit_code == 0, result.output
    return read_rows(folder / "positions.csv")


@pytest.fixture
def aerial(dddas, file, tmp_path):
    """Run the command on the files of a flight; a file given by name replaces one, None leaves it out."""

    def run(flight, *more, out=tmp_path / "out", rate=True, **files):
        given = {
            "landmarks": flight.landmarks_csv(),
            "telemetry": flight.telemetry_csv(),
            "camera": flight.camera_toml(),
            "table": flight.tracks_txt(),
            **files,
        }
        names = {"landmarks": "l.csv", "telemetry": "tel.csv", "camera": "c.toml", "table": "t.txt"}
        paths = {what: file(names[what], text) for what, text in given.items() if text is not None}
        table = paths.pop("table")
        words = [word for what, path in paths.items() for word in (f"--{what}", path)]
        words += ["--rate", flight.rate_hz] if rate else []
        return dddas("locate", "aerial", table, *words, "--out", out, "--save", "none", *more)

    return run


def test_exact_input_puts_every_target_where_it_is(aerial, tmp_path):
    flight = Overflight()
    found = located(aerial(flight), tmp_path / "out")
    assert len(found) == 40
    assert flight.errors(found).max() < 0.001
    assert {row["by"] for row in found} == {"pose"}
    last = [row for row in found if row["frame"] == "10"]
    way = (flight.targets(2) - flight.targets(1)) * flight.rate_hz
    velocity = np.array([[float(row["velocity_east_m_s"]), float(row["velocity_north_m_s"])] for row in last])
    np.testing.assert_allclose(velocity, way, atol=0.1)


@pytest.mark.slow
def test_warnings_and_repairs_are_reported_at_the_end(aerial):
    flight = Overflight()
    assert "note: repaired" not in aerial(flight).stdout
    up = aerial(flight, telemetry=flight.telemetry_csv(heading_deg=-150)).stdout
    assert "note: located with a warning, frames 1 to 10: landmarks and telemetry disagree" in up
    header, *lines = (line.split(",") for line in flight.landmarks_csv().splitlines())
    for one, other in zip(lines[::4], lines[1::4], strict=True):
        one[2:4], other[2:4] = other[2:4], one[2:4]
    swapped = "\n".join(map(",".join, [header, *lines])) + "\n"
    assert "note: repaired, frames 1 to 10: identities" in aerial(flight, landmarks=swapped).stdout


def test_landmarks_alone_will_do_and_so_will_local_metres(aerial, tmp_path):
    flight = Overflight(geographic=False)
    found = located(aerial(flight, telemetry=None), tmp_path / "out")
    assert flight.errors(found).max() < 0.001
    assert "longitude_deg" not in found[0]
    assert not (tmp_path / "out" / "tracks.geojson").exists()


def test_a_homography_needs_neither_camera_nor_size(aerial, tmp_path):
    flight = Overflight()
    found = located(
        aerial(flight, "--set", "aerial.mode=homography", telemetry=None, camera=None, rate=False), tmp_path / "out"
    )
    assert flight.errors(found).max() < 0.001
    assert {row["by"] for row in found} == {"homography"}
    assert any("no --rate" in note for note in record(tmp_path / "out")["notes"])


def test_the_foot_of_a_body_is_found_below_its_middle(aerial, tmp_path):
    flight = Overflight(pitch_deg=45, body_m=1.7)
    foot = flight.errors(located(aerial(flight, "--set", "aerial.point=foot"), tmp_path / "out"))
    centre = flight.errors(located(aerial(flight, "--set", "aerial.point=centre"), tmp_path / "out"))
    assert foot.max() < 0.01
    assert centre.min() > 0.5


def test_feet_that_the_table_names_are_taken(aerial, tmp_path):
    flight = Overflight(pitch_deg=45)
    lines = ["frame,x_px,y_px,width_px,height_px,feet_u_px,feet_v_px"]
    for frame in flight.numbers():
        lines += [
            f"{frame},{u - 20:.3f},{v - 90:.3f},40,60,{u:.4f},{v:.4f}"
            for u, v in flight.shown(frame, flight.targets(frame))
        ]
    found = located(aerial(flight, table="\n".join(lines) + "\n"), tmp_path / "out")
    assert flight.errors(found).max() < 0.001


def test_the_error_that_all_receivers_share_is_in_the_absolute_covariance_alone(aerial, tmp_path):
    flight = Overflight(frames=3)
    alone = located(aerial(flight), tmp_path / "out")
    shared = located(aerial(flight, "--set", "landmarks.common_sigma_m=2.0"), tmp_path / "out")
    for key in ("var_east_m2", "var_north_m2"):
        assert float(shared[0][key]) - float(alone[0][key]) == pytest.approx(4.0, abs=1e-3)
    assert shared[0]["relative_sigma_m"] == alone[0]["relative_sigma_m"]
    assert shared[0]["east_m"] == alone[0]["east_m"]


@pytest.mark.slow
def test_ellipses_hold_the_truth_where_receivers_err(aerial, tmp_path):
    """Each flight has receivers of its own; in all of them together about 95 % of the ellipses hold."""
    inside = []
    for seed in range(12):
        flight = Overflight(frames=1, gps_m=1.43, pixel=1.0, seed=seed)
        for row in located(aerial(flight), tmp_path / "out"):
            # The origin moves with the first landmark's receiver: compare on the globe.
            away = np.array([float(row["east_m"]), float(row["north_m"])]) - flight.at_origin(1, row)
            cov = np.array(
                [[float(row["var_east_m2"]), float(row["cov_east_north_m2"])], [0, float(row["var_north_m2"])]]
            )
            cov[1, 0] = cov[0, 1]
            inside.append(away @ np.linalg.solve(cov, away) < 5.99)
    assert np.mean(inside) > 0.85


def test_a_frame_with_too_few_landmarks_is_a_flagged_gap(aerial, tmp_path):
    flight = Overflight()
    few = flight.landmarks_csv(keep=lambda frame, k: frame != 4 or k < 3)
    result = aerial(flight, landmarks=few, telemetry=None)
    found = located(result, tmp_path / "out")
    assert {int(row["frame"]) for row in found} == set(range(1, 11)) - {4}
    kept = record(tmp_path / "out")
    (gap,) = kept["unreliable"]
    assert (gap["first"], gap["last"]) == (4, 4)
    assert "3 landmarks" in gap["cause"]
    assert "1 missing" in gap["cause"]
    assert "note: 1 frames could not be located" in result.stdout


def test_a_landmark_that_is_hardly_ever_where_it_is_expected_is_told_of(aerial, tmp_path):
    class Wrong(Overflight):
        def shown(self, frame, east_north, up_m=0.0):
            seen = super().shown(frame, east_north, up_m)
            # The picture shows another vehicle, 200 px away, in its place.
            return seen + [[200.0, 0.0]] * np.isclose(east_north, self.marks(frame)[1]).all(axis=1)[:, None]

    result = aerial(Wrong(landmarks=6))
    found = located(result, tmp_path / "out")
    assert Overflight(landmarks=6).errors(found).max() < 0.3
    assert "note: ugv1 was left out in 10 of 10 frames" in result.stdout


def test_telemetry_alone_bridges_a_frame_without_landmarks(aerial, tmp_path):
    flight = Overflight()
    few = flight.landmarks_csv(keep=lambda frame, k: frame != 4)
    found = located(aerial(flight, landmarks=few), tmp_path / "out")
    here = [row for row in found if row["frame"] == "4"]
    assert len(here) == 4
    assert {row["by"] for row in here} == {"telemetry"}
    assert flight.errors(here).max() < 0.5


def test_a_table_without_rows_gives_no_positions(aerial, tmp_path):
    assert located(aerial(Overflight(), table=""), tmp_path / "out") == []


@pytest.mark.parametrize("backend", ["onboard", "torch"])
def test_both_back_ends_agree(aerial, tmp_path, backend):
    if backend == "torch":
        pytest.importorskip("torch")
    flight = Overflight(frames=2, gps_m=1.0, pixel=1.0)
    options = ("--backend", backend, "--set", "aerial.mode=homography")
    found = located(aerial(flight, *options, telemetry=None), tmp_path / "out")
    reference = located(
        aerial(Overflight(frames=2, gps_m=1.0, pixel=1.0), *options[2:], telemetry=None), tmp_path / "out"
    )
    for a, b in zip(found, reference, strict=True):
        assert float(a["east_m"]) == pytest.approx(float(b["east_m"]), abs=1e-4)


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
        (FLIGHT, {"telemetry": FLIGHT.telemetry_csv(pitch_deg=-90.0)}, ("into the sky", "turn the sign of pitch_deg")),
        (METRES, {"telemetry": FAR}, ("the vehicle is 541 km or more from the landmarks",)),
        (FLIGHT, {"table": LATER, "telemetry": None}, ("frames 101 to 110", "1 to 10")),
        (FLIGHT, {"landmarks": FLIGHT.landmarks_csv(pictured=False)}, ("u_px,v_px",)),
        (FLIGHT, {"camera": None}, ("--camera FILE or --clip CLIP",)),
        (FLIGHT, {"rate": False}, ("--rate",)),
        (METRES, {"telemetry": None, "more": ("--set", "aerial.mode=paper")}, ("works in degrees",)),
        (FLIGHT, {"table": TRACKS + TRACKS.splitlines()[0] + "\n"}, ("identity 1 is there already",)),
    ],
)
def test_bad_input_is_one_line_and_leaves_no_folder(aerial, tmp_path, flight, how, parts):
    line = bad(aerial(flight, *how.pop("more", ()), **how))
    assert [part for part in parts if part not in line] == []
    assert not (tmp_path / "out").exists()


def test_a_camera_of_another_size_than_the_clip(aerial, clip):
    assert "1280 x 720 px, the clip of 64 x 48" in bad(aerial(Overflight(frames=5), "--clip", clip))


def test_landmarks_on_one_line_that_receivers_errors_widen(aerial, tmp_path):
    flight = Row(gps_m=1.43, pixel=1.0, frames=2)
    assert "lie on one line" in bad(aerial(flight, telemetry=None))
    assert flight.errors(located(aerial(flight), tmp_path / "out")).max() < 3.0


def test_an_altitude_below_the_ground_for_a_while_is_told_of_and_not_used(aerial, tmp_path):
    flight = Overflight()
    header, *lines = flight.telemetry_csv().splitlines(keepends=True)
    low = change("".join([header, *lines[:4]]), ("altitude_m",), lambda cells: ["-3.0"])
    result = aerial(flight, telemetry="".join([low, *lines[4:]]))
    assert flight.errors(located(result, tmp_path / "out")).max() < 0.05
    assert "at or below ground in 4 of 10 samples, the first at 0.0 s: it is not used there" in result.stdout


def test_landmarks_far_outside_the_cameras_pictures(aerial, tmp_path):
    flight = Overflight()
    small = flight.camera_toml().replace("1280", "320").replace("720", "180")
    line = bad(aerial(flight, camera=small))
    assert "l.csv, line " in line
    assert "far outside the camera's pictures of 320 x 180 px" in line
    flat = aerial(flight, "--set", "aerial.mode=homography", camera=small)
    assert flight.errors(located(flat, tmp_path / "out")).max() < 0.05


def test_boxes_far_outside_the_cameras_pictures_are_told_of(aerial):
    flight = Overflight()
    assert "lie far outside" not in aerial(flight).stdout
    away = aerial(flight, table=flight.tracks_txt() + "10,9,3000,100,20,20,1,-1,-1,-1\n")
    assert "note: 1 of 41 boxes lie far outside the camera's pictures of 1280 x 720 px" in away.stdout
