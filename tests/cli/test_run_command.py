"""`dddas run`: from a clip to places on the ground, and one line for each mistake."""

import json

import cv2
import numpy as np
import pytest

from tests.cli.conftest import bad, names, record, rows
from tests.onnx_models import write_finder
from tests.overflight import COLOURS_TOML, ORIGIN, Overflight, pictures
from torchvision_dddas.geometry import lonlat

RATE_HZ = 8.0
FLIGHT = Overflight(
    frames=24, size=(640, 360), focal_px=457.0, height_m=45.0, heading_rad=0.1, pace=3.0, rate_hz=RATE_HZ
)
# The painted targets are flat: their centres are on the ground.
FLAT = ("--set", "aerial.point=centre")


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A clip of a flight and the files beside it; the folder."""
    folder = tmp_path_factory.mktemp("flown")
    (folder / "clip").mkdir()
    for k, picture in enumerate(pictures(FLIGHT), 1):
        cv2.imwrite(str(folder / "clip" / f"{k:05d}.png"), picture)
    (folder / "landmarks.csv").write_text(FLIGHT.landmarks_csv(pictured=False))
    (folder / "pictured.csv").write_text(FLIGHT.landmarks_csv())
    (folder / "telemetry.csv").write_text(FLIGHT.telemetry_csv())
    (folder / "camera.toml").write_text(FLIGHT.camera_toml())
    (folder / "colours.toml").write_text(COLOURS_TOML)
    return folder


@pytest.fixture(scope="module")
def whole(flown, tmp_path_factory):
    """The folder of a run with everything, and what it said."""
    from typer.testing import CliRunner

    from torchvision_dddas.cli import app

    out = tmp_path_factory.mktemp("whole") / "out"
    words = [*given(flown), *FLAT, "--save", "overlay,map", "--out", out]
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return out, result.stdout


def given(folder, landmarks="landmarks.csv", colours="colours.toml", **files):
    """The words of a run on the files of a folder."""
    names = {"telemetry": "telemetry.csv", "camera": "camera.toml", "colours": colours, **files}
    words = ["run", folder / "clip", "--rate", RATE_HZ, "--landmarks", folder / landmarks]
    return [*words, *(word for what, name in names.items() if name for word in (f"--{what}", folder / name))]


def number(row, *columns):
    return np.array([float(row[name]) for name in columns])


def missed_by(found, shift=0):
    """Metres from each row of positions.csv to the nearest target some frames later, and which that is."""
    origin = FLIGHT.marks(1)[0]
    apart, which = [], []
    for row in found:
        if 1 <= int(row["frame"]) + shift <= FLIGHT.frames:
            place = number(row, "east_m", "north_m") + origin
            distance = np.linalg.norm(FLIGHT.targets(int(row["frame"]) + shift) - place, axis=1)
            apart.append(distance.min())
            which.append(int(distance.argmin()))
    return np.array(apart), set(which)


@pytest.mark.slow
def test_targets_are_located_to_some_decimetres_in_their_own_frames(whole):
    """Identities are settled some frames later than pictures are georeferenced."""
    found = rows(whole[0] / "positions.csv")
    apart, which = missed_by(found)
    assert len(found) > 60 and which == {0, 1, 2, 3}
    assert np.median(apart) < 0.3
    assert np.quantile(apart, 0.9) < 1.0
    assert np.median(apart) < 0.3 * min(np.median(missed_by(found, shift)[0]) for shift in (-4, 4))


@pytest.mark.slow
def test_landmarks_are_no_targets(whole):
    """All but never: a blob that looks too large for its landmark alone stays among the targets."""
    found = rows(whole[0] / "detections.csv")
    at_landmarks = 0
    for row in found:
        at = FLIGHT.shown(int(row["frame"]), FLIGHT.marks(int(row["frame"])))
        centre = number(row, "x_px", "y_px") + number(row, "width_px", "height_px") / 2
        at_landmarks += np.linalg.norm(at - centre, axis=1).min() < 10
    assert at_landmarks < 0.1 * len(found)


@pytest.mark.slow
def test_landmarks_are_where_they_were_seen_and_locate_the_same_again(whole, dddas, flown, tmp_path):
    out, _ = whole
    seen = rows(out / "landmarks.csv")
    assert len(seen) > 3.5 * FLIGHT.frames
    apart = []
    for row in seen:
        shown = FLIGHT.shown(int(row["frame"]), FLIGHT.marks(int(row["frame"])))[int(row["landmark"][-1])]
        apart.append(np.linalg.norm(shown - number(row, "u_px", "v_px")))
    assert np.median(apart) < 2
    words = ["locate", "aerial", out / "tracks.csv", "--landmarks", out / "landmarks.csv", "--rate", RATE_HZ]
    words += ["--camera", flown / "camera.toml", "--telemetry", flown / "telemetry.csv", "--save", "none"]
    result = dddas(*words, *FLAT, "--out", tmp_path / "again")
    assert result.exit_code == 0, result.output
    again = {(row["frame"], row["target"]): row for row in rows(tmp_path / "again" / "positions.csv")}
    for row in rows(out / "positions.csv"):
        same = again[row["frame"], row["target"]]
        assert float(same["east_m"]) == pytest.approx(float(row["east_m"]), abs=0.1)


@pytest.mark.slow
def test_everything_is_written_and_recorded(whole):
    out, said = whole
    assert set(names(out)) >= {
        *("detections.csv", "detections.txt", "tracks.csv", "tracks.txt", "positions.csv", "fixes.csv"),
        *("landmarks.csv", "tracks.geojson", "overlay.mp4", "map.png", "run.json"),
    }
    kept = record(out)
    assert kept["state"] == "complete" and kept["frames"]["written"] == FLIGHT.frames and kept["identities"] >= 4
    assert {"register", "foreground", "landmarks", "fix", "track", "ground"} <= set(kept["seconds"]["stages"])
    assert "interval.frames" in {moved["knob"] for moved in kept["adjustments"]}
    assert set(kept["landmarks"]) == {"ugv0", "ugv1", "ugv2", "ugv3"}
    assert "positions; of the frames" in said


@pytest.mark.slow
def test_landmarks_with_pixels_need_no_colours_and_only_sampled_frames_are_located(dddas, flown, tmp_path):
    words = given(flown, "pictured.csv", None)
    result = dddas(*words, *FLAT, "--interval", 3, "--save", "none", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    found = rows(tmp_path / "out" / "positions.csv")
    assert {int(row["frame"]) % 3 for row in found} == {1}
    assert np.median(missed_by(found)[0]) < 0.3


@pytest.mark.parametrize(
    ("words", "note"),
    [
        (("track", "--interval", 9), "--interval 9 is beyond the clip's 5 frames: only frame 1 was tracked"),
        (("run", "--interval", 9), "--interval 9 is beyond the clip's 5 frames: only frame 1 was tracked"),
        (
            ("detect", "--set", "small.min_area_px=5000", "--set", "gates.min_area_px=4000"),
            "64x48 px are too small",
        ),
    ],
    ids=["track", "run", "detect"],
)
def test_what_keeps_all_targets_from_being_found_is_noted(dddas, clip, tmp_path, words, note):
    command, *more = words
    result = dddas(command, clip, *more, "--save", "none", "--out", tmp_path / "out", "--backend", "onboard")
    assert result.exit_code == 0, result.output
    assert "note: " in result.stdout and note in result.stdout
    assert any(note in line for line in record(tmp_path / "out")["notes"])


def test_without_landmarks_nothing_is_located_and_earlier_positions_go(dddas, clip, engine, tmp_path):
    out = tmp_path / "out"
    assert dddas("run", clip, "--save", "none", "--out", out).exit_code == 0
    (out / "positions.csv").write_text("old")
    result = dddas("run", clip, "--save", "none", "--out", out)
    assert result.exit_code == 0, result.output
    assert "note: 0 located, because neither --telemetry nor --landmarks were given" in result.stdout
    assert "tracks.csv" in names(out) and "positions.csv" not in names(out)


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
    out = tmp_path / "out"
    assert dddas(*given(flown), *FLAT, "--save", "none", "--out", out).exit_code == 130
    assert record(out)["state"] == "interrupted"
    assert {int(row["frame"]) for row in rows(out / "fixes.csv")} == set(range(1, 5))
    assert max(int(row["frame"]) for row in rows(out / "positions.csv")) <= 4


@pytest.mark.parametrize(
    ("how", "changed", "message"),
    [
        ({"colours": None}, "", "--colours FILE"),
        ({"colours": "other.toml"}, COLOURS_TOML.replace("[ugv2]", "[tank]"), "the colours name tank"),
        ({"colours": "other.toml", "telemetry": None}, COLOURS_TOML.split("[ugv3]")[0], "given for 3: 1 missing"),
        ({"telemetry": "late.csv"}, FLIGHT.telemetry_csv(shift_s=900.0), "900.0 to 902.9 s, the clip 0.0 to 2.9 s"),
    ],
)
def test_bad_input_is_one_line_and_leaves_no_folder(dddas, flown, file, tmp_path, how, changed, message):
    changed = {name: file(name, changed) if name in ("other.toml", "late.csv") else name for name in how.values()}
    line = bad(dddas(*given(flown, **{what: changed[name] for what, name in how.items()}), "--out", tmp_path / "out"))
    assert message in line
    assert not (tmp_path / "out").exists()


def test_a_grey_clip_is_refused_where_landmarks_are_found_by_colour(dddas, flown, tmp_path):
    (tmp_path / "grey").mkdir()
    for path in sorted((flown / "clip").iterdir())[:6]:
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        cv2.imwrite(str(tmp_path / "grey" / path.name), picture)
    command, _, *words = given(flown)
    assert "the clip is grey" in bad(dddas(command, tmp_path / "grey", *words, "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def alone(folder, *more, telemetry="telemetry.csv"):
    """The words of a run with telemetry and without landmarks."""
    return ["run", folder / "clip", "--rate", RATE_HZ, "--telemetry", folder / telemetry, *FLAT, *more]


def test_a_clip_and_a_log_alone_give_places_maps_and_a_picture_without_a_bar_of_landmarks(dddas, flown, tmp_path):
    words = alone(flown, "--camera", flown / "camera.toml", "--config", "fast", "--save", "map,report")
    result = dddas(*words, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    found = rows(tmp_path / "positions.csv")
    assert {row["by"] for row in found} == {"telemetry"} and "longitude_deg" in found[0]
    assert {"tracks.geojson", "map.png", "report.html"} <= set(names(tmp_path))
    assert "0 of 0" not in result.stdout and "located with a warning" not in result.stdout
    kept = record(tmp_path)
    assert not any("are assumed" in note for note in kept["notes"])
    identities = len({row["identity"] for row in rows(tmp_path / "tracks.csv") if row["kind"] != "untracked"})
    assert f"24 frames, {kept['targets']} detections of {identities} identities\n" in result.stdout
    assert "identities located" in (tmp_path / "report.html").read_text()
    assert kept["positions"] == len(found) > 20 and kept["by"]["telemetry"] == FLIGHT.frames
    assert kept["telemetry"].endswith("telemetry.csv") and kept["landmarks_file"] is None


def test_boxes_of_ones_own_detector_are_located_with_their_classes(dddas, flown, file, tmp_path):
    lines = ["frame,x,y,width,height,score,class"]
    for frame in range(1, FLIGHT.frames + 1):
        for at, label in zip(
            FLIGHT.shown(frame, FLIGHT.targets(frame)), ("car", "person", "car", "person"), strict=True
        ):
            lines.append(f"{frame},{at[0] - 8:.2f},{at[1] - 8:.2f},17,17,0.9,{label}")
    boxes = file("boxes.csv", "\n".join(lines) + "\n")
    words = alone(flown, "--camera", flown / "camera.toml", "--detections", boxes, "--save", "none", "--out", tmp_path)
    result = dddas(*words)
    assert result.exit_code == 0, result.output
    assert sorted(row["class"] for row in rows(tmp_path / "summary.csv")) == ["car", "car", "person", "person"]
    found = rows(tmp_path / "positions.csv")
    assert len(found) == 4 * FLIGHT.frames and {row["class"] for row in found} == {"car", "person"}
    assert record(tmp_path)["detections_file"] == str(boxes) and "scale:" not in result.stdout


def test_a_network_gives_classes_to_places_and_zones_and_what_moves_is_kept(dddas, flown, file, tmp_path):
    (tmp_path / "clip").mkdir()
    for frame, picture in enumerate(pictures(FLIGHT), 1):
        picture = np.minimum(picture, 150)
        u, v = np.round(FLIGHT.shown(frame, FLIGHT.targets(frame))[0]).astype(int)
        picture[v - 8 : v + 9, u - 8 : u + 9] = (0, 0, 255)
        cv2.imwrite(str(tmp_path / "clip" / f"{frame:05d}.png"), picture)
    metadata = {"names": "['car', 'person', 'bus']", "imgsz": "[640, 640]"}
    model = write_finder(tmp_path / "finder.onnx", "YOLO without NMS", metadata=metadata, is_free=True)
    corners = lonlat(np.array([[-2.0, -60], [60, -60], [60, 60], [-2, 60], [-2, -60]]), ORIGIN).tolist()
    field = {"type": "Polygon", "coordinates": [corners]}
    feature = {"type": "Feature", "properties": {"name": "field"}, "geometry": field}
    zones = file("zones.geojson", json.dumps({"type": "FeatureCollection", "features": [feature]}))
    words = alone(flown, "--camera", flown / "camera.toml", "--detector", model, "--movers", "--zones", zones)
    words[1] = tmp_path / "clip"
    result = dddas(*words, "--save", "none", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    summary = rows(tmp_path / "out" / "summary.csv")
    assert [row["class"] for row in summary].count("person") == 1 and "" in {row["class"] for row in summary}
    assert sum(row["class"] == "person" for row in rows(tmp_path / "out" / "positions.csv")) == FLIGHT.frames
    assert "person" in {row["class"] for row in rows(tmp_path / "out" / "events.csv")}
    assert record(tmp_path / "out")["detector"]["layout"] == "YOLO without NMS"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--detections", "{boxes}", "--ignore", "mask.png"], "--ignore is for the search"),
        (
            ["--detections", "{boxes}", "--live"],
            "--detections is of no use with --live: a live run cannot take a table",
        ),
        (["--box-format", "xyxy"], "--box-format is for --detections FILE"),
        (["--provider", "cuda"], "--provider is for --detector MODEL"),
        (["--movers"], "--movers is for --detector or --detections"),
        (["--detector", "a.onnx", "--detections", "{boxes}"], "were both given"),
        (["--detector", "none.onnx"], "none.onnx is no file"),
        (["--detections", "none.csv"], "none.csv cannot be read"),
    ],
)
def test_boxes_that_cannot_be_used_are_one_line(dddas, flown, file, tmp_path, words, says):
    boxes = file("boxes.csv", "frame,x,y,width,height\n1,5,5,9,9\n")
    out = tmp_path / "out"
    words = [str(boxes) if word == "{boxes}" else word for word in words]
    assert says in bad(dddas("run", flown / "clip", *words, "--out", out)) and not out.exists()


def test_single_pixels_of_a_moment_are_located(dddas, flown):
    flight = [flown / "clip", "--rate", RATE_HZ, "--telemetry", flown / "telemetry.csv"]
    (u, v), *_ = FLIGHT.shown(9, FLIGHT.targets(9))
    words = ["locate", "pixel", *flight, "--camera", flown / "camera.toml", "--time", FLIGHT.time(9)]
    result = dddas(*words, f"{u:.1f},{v:.1f}", "320,180")
    assert result.exit_code == 0, result.output
    one, other, *_ = result.stdout.splitlines()
    assert (
        one.startswith(f"{u:g}"[:4])
        and "latitude" in one
        and "with 95 % within" in one
        and other.startswith("320,180: ")
    )
    for pixel, says in (("9000,5", "lies outside "), ("5", "a pixel must be u,v")):
        assert says in bad(dddas(*words, pixel))
    assert "give its --telemetry" in bad(dddas("locate", "pixel", flown / "clip", "5,5"))


def test_a_rate_that_nothing_tells_is_named(dddas, flown, tmp_path):
    words = [word for word in alone(flown, "--camera", flown / "camera.toml", "--config", "fast") if word != "--rate"]
    result = dddas(*[word for word in words if word != RATE_HZ], "--save", "none", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    assert any("10 frames a second are assumed" in note and "--rate" in note for note in record(tmp_path)["notes"])


def test_why_nothing_was_located_stands_on_the_screen_in_the_report_and_in_the_record(dddas, flown, tmp_path):
    lines = [line.split(",") for line in FLIGHT.telemetry_csv().splitlines()]
    (flown / "bare.csv").write_text("\n".join(",".join(line[:5]) for line in lines) + "\n")
    (flown / "placeless.csv").write_text("\n".join(",".join(line[:2]) for line in lines) + "\n")
    for name, cause in (("bare.csv", "the camera's heading, pitch"), ("placeless.csv", "holds no place")):
        out = tmp_path / name
        words = alone(flown, "--config", "fast", "--save", "report", telemetry=name)
        result = dddas(*words, "--out", out)
        assert result.exit_code == 3, result.output
        (said,) = result.stderr.splitlines()[-1:]
        assert said.startswith("dddas: 0 located, because the telemetry") and cause in said
        assert said.endswith(f"; all other results are in {out}") and "0 located" not in result.stdout
        assert record(out)["state"] == "complete" and len(rows(out / "tracks.csv")) > 20
        assert any("0 located, because" in note and cause in note for note in record(out)["notes"])
        page = (out / "report.html").read_text()
        assert "0 located, because the telemetry" in page


def test_a_table_without_heights_takes_that_of_the_cameras_file(dddas, flown, tmp_path):
    lines = [line.split(",") for line in FLIGHT.telemetry_csv().splitlines()]
    column = lines[0].index("altitude_m")
    (flown / "low.csv").write_text("\n".join(",".join(line[:column] + line[column + 1 :]) for line in lines) + "\n")
    (tmp_path / "camera.toml").write_text(FLIGHT.camera_toml() + f"height_m = {FLIGHT.height_m}\n")
    words = alone(flown, "--config", "fast", "--save", "none", "--out", tmp_path / "out", telemetry="low.csv")
    result = dddas(*words, "--camera", tmp_path / "camera.toml")
    assert result.exit_code == 0, result.output
    assert record(tmp_path / "out")["positions"] > 20
    assert "note: the log does not say height_m: it is taken from camera camera" in result.stdout
    result = dddas(*words)
    assert result.exit_code == 3 and "height_m or takeoff_above_sea_m in the camera's file" in result.stderr


def test_detect_and_run_take_the_logs_field_of_view_before_the_cameras(dddas, flown, engine, tmp_path):
    (tmp_path / "log.csv").write_text(FLIGHT.telemetry_csv(hfov_deg=60.0))
    (tmp_path / "placeless.csv").write_text("time_s,altitude_m,hfov_deg\n0,45,60\n3,45,60\n")
    clip, out = (flown / "clip", "--rate", RATE_HZ), ("--save", "none", "--out", tmp_path / "out")
    focal = []
    for command, log, *more in (
        ("detect", "log.csv"),
        ("run", "log.csv"),
        ("run", "log.csv", "--camera", flown / "camera.toml"),
        ("run", "placeless.csv"),
    ):
        result = dddas(command, *clip, *out, "--telemetry", tmp_path / log, *more)
        assert result.exit_code == 3 * (log == "placeless.csv"), result.output
        assert "note: gates.focal_px is set to 554 px from the log's field of view" in result.stdout
        focal.append(record(tmp_path / "out")["settings"]["gates"]["focal_px"])
    assert focal == pytest.approx([320 / np.tan(np.radians(30))] * 4)
    (tmp_path / "own.toml").write_text("[gates]\nfocal_px = 1000\n")
    for command, words, wanted in (
        ("detect", ("--set", "gates.focal_px=900"), 900),
        ("detect", ("--set", "gates.focal_px=1000"), 1000),
        ("run", ("--config", tmp_path / "own.toml"), 1000),
    ):
        result = dddas(command, *clip, *out, "--telemetry", tmp_path / "log.csv", *words)
        assert result.exit_code == 0, result.output
        assert record(tmp_path / "out")["settings"]["gates"]["focal_px"] == wanted
        assert "gates.focal_px is" not in result.stdout


def test_nothing_to_locate_is_no_failure(dddas, flown, engine, tmp_path):
    engine(found=False)
    result = dddas(*alone(flown, "--save", "none"), "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "note: 0 located, because no target was found" in result.stdout


def test_the_telemetry_of_detect_is_any_log(dddas):
    told = dddas("detect", "--help").output
    assert ".SRT" in told and "--telemetry" in told and "CSV  " not in told.split("--telemetry")[1][:20]


@pytest.mark.parametrize("option", ["--camera", "--dem", "--background"])
def test_a_file_that_is_not_there_is_refused_also_where_nothing_can_be_located(dddas, clip, tmp_path, option):
    log = tmp_path / "log.csv"
    log.write_text("time_s,altitude_m\n" + "".join(f"{k},50\n" for k in range(5)))
    said = bad(dddas("run", clip, "--telemetry", log, option, tmp_path / "nowhere.x", "--out", tmp_path / "out"))
    assert "nowhere.x" in said and not (tmp_path / "out" / "run.json").exists()


def test_the_scale_stands_on_the_screen_in_the_record_and_in_the_report(dddas, flown, tmp_path):
    """45 m above ground at 457 px people are 5.1 px."""
    result = dddas(*alone(flown, "--camera", flown / "camera.toml"), "--save", "report", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    said = "a person is about 5.1 px (altitude 45.0 m, focal length 457 px); the settings for tiny people"
    assert f"scale: {said}" in result.stdout.splitlines() and said in (tmp_path / "report.html").read_text()
    scale = record(tmp_path)["scale"]
    assert scale["person_px"] == pytest.approx([5.08, 5.08], abs=0.02)
    assert scale["frames"] == scale["frames_tiny"] == FLIGHT.frames and scale["from"] in said


def test_the_same_clip_without_telemetry_says_that_its_scale_is_not_known(dddas, engine, flown, tmp_path):
    for words, said in (
        ((), "the size of people is unknown"),
        (("--config", "patrol"), "about 4.0 px (as gates.person_px"),
    ):
        result = dddas("detect", flown / "clip", "--rate", RATE_HZ, *words, "--save", "none", "--out", tmp_path)
        assert result.exit_code == 0 and "scale: " in result.stdout and said in result.stdout, result.output
        assert ("--config patrol assumes people of about" in result.stderr) == bool(words)


def test_patrol_beside_a_configuration_on_which_it_has_no_effect_is_refused(dddas, flown):
    result = dddas("detect", flown / "clip", "--config", "fast,patrol")
    assert result.exit_code == 2 and "patrol has no effect beside fast" in result.stderr


@pytest.mark.parametrize("command", ["detect", "track"])
def test_pictures_outside_of_the_telemetry_are_counted_in_a_note(dddas, engine, flown, tmp_path, command):
    (tmp_path / "short.csv").write_text("time_s,altitude_m,hfov_deg\n0,45,60\n0.5,45,60\n")
    words = (flown / "clip", "--rate", RATE_HZ, "--telemetry", tmp_path / "short.csv", "--save", "none")
    result = dddas(command, *words, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert "note: 11 of 24 pictures lie outside the telemetry, which covers 0.0 to 0.5 s" in result.stdout
    assert "note: gates.focal_px is set to 554 px from the log's field of view" in result.stdout


def test_track_takes_telemetry_as_detect_does_and_refuses_it_beside_a_table(dddas, flown, tmp_path):
    clip, log = (flown / "clip", "--rate", RATE_HZ), ("--telemetry", flown / "telemetry.csv")
    focal, out = ("--set", "gates.focal_px=457"), ("--save", "none", "--out")
    for command in ("detect", "track"):
        result = dddas(command, *clip, *log, *focal, *out, tmp_path / command)
        assert result.exit_code == 0 and "scale: a person is about 5.1 px" in result.stdout, result.output
    found, tracked = (record(tmp_path / command) for command in ("detect", "track"))
    assert found["targets"] == tracked["targets"] > 40 and tracked["telemetry"] == str(flown / "telemetry.csv")
    table = ("--detections", tmp_path / "detect" / "detections.csv")
    assert "leave --detections out" in bad(dddas("track", *clip, *log, *table, *out, tmp_path / "none"))


@pytest.mark.parametrize("command", ["detect", "track", "run"])
def test_pictures_without_a_rate_are_noted(dddas, engine, clip, tmp_path, command):
    for words, is_noted in (((), True), (("--rate", 5), False)):
        result = dddas(command, clip, *words, "--save", "none", "--out", tmp_path / "out")
        assert result.exit_code == 0 and ("10 frames a second are assumed" in result.stdout) == is_noted, result.output
