"""`dddas run`: from a clip to places on the ground, and one line for each mistake."""

import cv2
import numpy as np
import pytest

from tests.cli.conftest import bad, record, rows
from tests.overflight import COLOURS_TOML, Overflight, pictures

FRAMES, RATE_HZ = 24, 8.0
# The painted targets are flat: their centres are on the ground.
FLAT = ("--set", "aerial.point=centre")


def over():
    """The flight that the clip is of."""
    return Overflight(
        frames=FRAMES, size=(640, 360), focal_px=457.0, height_m=45.0, heading_rad=0.1, pace=3.0, rate_hz=RATE_HZ
    )


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A clip of a flight and the files beside it; the folder."""
    folder, flight = tmp_path_factory.mktemp("flown"), over()
    (folder / "clip").mkdir()
    for k, picture in enumerate(pictures(flight), 1):
        cv2.imwrite(str(folder / "clip" / f"{k:05d}.png"), picture)
    (folder / "landmarks.csv").write_text(flight.landmarks_csv(pictured=False))
    (folder / "pictured.csv").write_text(flight.landmarks_csv())
    (folder / "telemetry.csv").write_text(flight.telemetry_csv())
    (folder / "camera.toml").write_text(flight.camera_toml())
    (folder / "colours.toml").write_text(COLOURS_TOML)
    return folder


@pytest.fixture(scope="module")
def whole(flown, tmp_path_factory):
    """The whole path, run once: the result and its folder."""
    from typer.testing import CliRunner

    from torchvision_dddas.cli import app

    out = tmp_path_factory.mktemp("whole") / "out"
    words = [*given(flown), *FLAT, "--save", "overlay,map", "--out", out]
    return CliRunner().invoke(app, [str(word) for word in words]), out


def given(folder, landmarks="landmarks.csv", colours="colours.toml", **files):
    """The words of a run on the files of a folder."""
    names = {"telemetry": "telemetry.csv", "camera": "camera.toml", **files}
    words = ["run", folder / "clip", "--rate", RATE_HZ, "--landmarks", folder / landmarks]
    words += ["--colours", folder / colours] if colours else []
    return [*words, *(word for what, name in names.items() if name for word in (f"--{what}", folder / name))]


def missed_by(found):
    """(N,) metres from each row of positions.csv to the nearest target in its frame, and which that is."""
    flight = over()
    origin = flight.marks(1)[0]
    apart, which = [], []
    for row in found:
        place = np.array([float(row["east_m"]), float(row["north_m"])]) + origin
        distance = np.linalg.norm(flight.targets(int(row["frame"])) - place, axis=1)
        apart.append(distance.min())
        which.append(int(distance.argmin()))
    return np.array(apart), np.array(which)


@pytest.mark.slow
def test_targets_are_located_to_some_decimetres(whole):
    result, out = whole
    assert result.exit_code == 0, result.output
    found = rows(out / "positions.csv")
    apart, which = missed_by(found)
    assert len(found) > 60
    assert np.median(apart) < 0.3
    assert np.quantile(apart, 0.9) < 1.0
    assert set(which.tolist()) == {0, 1, 2, 3}


@pytest.mark.slow
def test_a_position_is_that_of_its_own_frame(whole):
    """Identities are settled some frames later than pictures are georeferenced."""
    _, out = whole
    found = rows(out / "positions.csv")
    flight = over()
    away = {}
    for shift in (-4, 0, 4):
        moved = [{**row, "frame": int(row["frame"]) + shift} for row in found]
        away[shift] = np.median(missed_by([row for row in moved if 1 <= row["frame"] <= flight.frames])[0])
    assert away[0] < 0.3 * min(away[-4], away[4])


@pytest.mark.slow
def test_landmarks_are_no_targets(whole):
    """All but never: a blob that looks too large for its landmark alone stays among the targets."""
    _, out = whole
    flight = over()
    found = rows(out / "detections.csv")
    at_landmarks = 0
    for row in found:
        x, y, width, height = (float(row[name]) for name in ("x_px", "y_px", "width_px", "height_px"))
        at = flight.shown(int(row["frame"]), flight.marks(int(row["frame"])))
        centre = np.array([x + width / 2, y + height / 2])
        at_landmarks += np.linalg.norm(at - centre, axis=1).min() < 10
    assert at_landmarks < 0.1 * len(found)


@pytest.mark.slow
def test_landmarks_are_where_they_were_seen_and_can_be_read_again(whole, dddas, flown, tmp_path):
    _, out = whole
    flight = over()
    seen = rows(out / "landmarks.csv")
    assert len(seen) > 3.5 * flight.frames
    apart = [
        np.linalg.norm(
            flight.shown(int(row["frame"]), flight.marks(int(row["frame"])))[int(row["landmark"][-1])]
            - [float(row["u_px"]), float(row["v_px"])]
        )
        for row in seen
    ]
    assert np.median(apart) < 2
    words = ("--camera", flown / "camera.toml", "--telemetry", flown / "telemetry.csv", "--rate", RATE_HZ)
    result = dddas(
        "locate", "aerial", out / "tracks.csv", "--landmarks", out / "landmarks.csv", *words, *FLAT, "--save", "none",
        "--out", tmp_path / "again",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    again = {(row["frame"], row["target"]): row for row in rows(tmp_path / "again" / "positions.csv")}
    for row in rows(out / "positions.csv"):
        same = again[row["frame"], row["target"]]
        assert float(same["east_m"]) == pytest.approx(float(row["east_m"]), abs=0.1)


@pytest.mark.slow
def test_everything_is_written_and_recorded(whole):
    result, out = whole
    names = {path.name for path in out.iterdir()}
    assert names >= {
        *("detections.csv", "detections.txt", "tracks.csv", "tracks.txt", "positions.csv", "fixes.csv"),
        *("landmarks.csv", "tracks.geojson", "overlay.mp4", "map.png", "run.json"),
    }
    kept = record(out)
    assert kept["state"] == "complete"
    assert kept["frames"]["written"] == FRAMES
    assert kept["identities"] >= 4
    assert {"register", "foreground", "landmarks", "fix", "track", "ground"} <= set(kept["seconds"]["stages"])
    assert "interval.frames" in {moved["knob"] for moved in kept["adjustments"]}
    assert set(kept["landmarks"]) == {"ugv0", "ugv1", "ugv2", "ugv3"}
    assert "positions; of the frames" in result.stdout


@pytest.mark.slow
def test_pixels_in_the_table_need_no_colours_and_only_sampled_frames_are_located(dddas, flown, tmp_path):
    words = given(flown, "pictured.csv", None)
    result = dddas(*words, *FLAT, "--interval", 3, "--save", "none", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    found = rows(tmp_path / "out" / "positions.csv")
    assert {int(row["frame"]) % 3 for row in found} == {1}
    assert np.median(missed_by(found)[0]) < 0.3


def test_without_landmarks_it_says_that_nothing_is_located(dddas, clip, engine, tmp_path):
    assert dddas("run", clip, "--save", "none", "--out", tmp_path / "out").exit_code == 0
    # As if an earlier run had located something here.
    (tmp_path / "out" / "positions.csv").write_text("old")
    result = dddas("run", clip, "--save", "none", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "note: no --landmarks was given: nothing was located" in result.stdout
    assert (tmp_path / "out" / "tracks.csv").exists()
    assert not (tmp_path / "out" / "positions.csv").exists()


@pytest.mark.slow
def test_ctrl_c_keeps_what_was_done(dddas, flown, tmp_path, monkeypatch):
    from torchvision_dddas.pipeline import Pipeline

    whole = Pipeline.__call__

    def stopped(*how):
        for count, result in enumerate(whole(*how)):
            if count == 4:
                raise KeyboardInterrupt
            yield result

    monkeypatch.setattr(Pipeline, "__call__", stopped)
    result = dddas(*given(flown), *FLAT, "--save", "none", "--out", tmp_path / "out")
    assert result.exit_code == 130
    kept = record(tmp_path / "out")
    assert kept["state"] == "interrupted"
    assert {int(row["frame"]) for row in rows(tmp_path / "out" / "fixes.csv")} == set(range(1, 5))
    assert max(int(row["frame"]) for row in rows(tmp_path / "out" / "positions.csv")) <= 4


@pytest.mark.parametrize(
    ("how", "changed", "message"),
    [
        ({"colours": None}, "", "--colours FILE"),
        ({"colours": "other.toml"}, COLOURS_TOML.replace("[ugv2]", "[tank]"), "the colours name tank"),
        ({"colours": "other.toml", "telemetry": None}, COLOURS_TOML.split("[ugv3]")[0], "given for 3: 1 missing"),
        ({"telemetry": "late.csv"}, over().telemetry_csv(shift_s=900.0), "900.0 to 902.9 s, the clip 0.0 to 2.9 s"),
    ],
)
def test_bad_input_is_one_line_and_leaves_no_folder(dddas, flown, file, tmp_path, how, changed, message):
    changed = {name: file(name, changed) if name in ("other.toml", "late.csv") else name for name in how.values()}
    line = bad(dddas(*given(flown, **{what: changed[name] for what, name in how.items()}), "--out", tmp_path / "out"))
    assert message in line
    assert not (tmp_path / "out").exists()


def test_a_grey_clip_has_no_colours(dddas, flown, tmp_path):
    grey = tmp_path / "grey"
    (grey / "clip").mkdir(parents=True)
    for path in sorted((flown / "clip").iterdir())[:6]:
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        cv2.imwrite(str(grey / "clip" / path.name), picture)
    words = given(flown)
    words[1] = grey / "clip"
    assert "the clip is grey" in bad(dddas(*words, "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()
