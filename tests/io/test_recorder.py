"""The folder of a run: whole or not at all, whatever ends it."""

import errno
import json
import os
import signal
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.io.conftest import make_scene
from tests.io.ground import NAMES, ORIGIN, START, grounded
from torchvision_dddas.errors import InputError, LostInputError
from torchvision_dddas.io.images import Masks
from torchvision_dddas.io.output import (
    AerialRecorder,
    DetectionRecorder,
    MapSite,
    PeopleRecorder,
    PipelineRecorder,
    TrackRecorder,
    describe_nothing_located,
    parse_save,
)
from torchvision_dddas.io.output.run_record import Durations, finite, write_run_record
from torchvision_dddas.io.tables import TableFiles
from torchvision_dddas.types import (
    Adjustment,
    AppearanceUse,
    Detections,
    Frame,
    FrameResult,
    People,
    PeopleFrame,
    TrackedFrame,
    Tracks,
)

PICTURE = np.zeros((60, 80, 3), np.uint8)
SITE = MapSite(NAMES, ORIGIN, START, 10.0)
FULL = errno.ENOSPC, os.strerror(errno.ENOSPC)
BOTH = ("masks", "overlay")
ALL_OF_TWO = ["detections.csv", "detections.txt", "masks/000001.png", "masks/000002.png", "overlay.mp4", "run.json"]


def run_json(folder):
    return json.loads((folder / "run.json").read_text())


def visible(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


def contents(folder):
    return {name: (folder / name).read_bytes() for name in visible(folder)}


# --------------------------------------------------------------------------------------------------------------------
# Every recorder.


def tracked(number):
    return TrackedFrame(number, Frame(number, number / 10, PICTURE), Detections(), Tracks(number))


# A recorder, how it begins, and the item of a frame.
RECORDERS: dict[str, Any] = {
    "detect": (DetectionRecorder, lambda r: r.begin({}, 10), make_scene),
    "people": (PeopleRecorder, lambda r: r.begin({}, 10), lambda n: PeopleFrame(Frame(n, 0.1, PICTURE), People())),
    "aerial": (AerialRecorder, lambda r: r.begin({}, SITE), grounded),
    "run": (PipelineRecorder, lambda r: r.begin({}, 10, (80, 60)), lambda n: FrameResult(tracked(n))),
    "run, located": (
        PipelineRecorder,
        lambda r: r.begin({}, 10, (80, 60), SITE),
        lambda n: FrameResult(tracked(n), grounded(n)),
    ),
}


def record(kind, folder, error=None):
    make, begin, item = RECORDERS[kind]
    with make(folder) as recorder:
        begin(recorder)
        for number in (1, 2, 3):
            recorder.write(item(number))
        assert run_json(folder)["state"] == "running"  # as a run that is killed leaves it
        if error is not None:
            raise error


@pytest.mark.parametrize("kind", RECORDERS)
def test_ctrl_c_leaves_the_files_of_a_whole_run_and_an_error_none_but_the_record(tmp_path, kind):
    record(kind, tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        record(kind, tmp_path / "interrupted", error=KeyboardInterrupt())
    with pytest.raises(InputError):
        record(kind, tmp_path / "failed", error=InputError("frame 4 is no picture"))
    assert visible(tmp_path / "whole") == visible(tmp_path / "interrupted")
    written = {name for name in visible(tmp_path / "whole") if "masks/" not in name}
    assert written <= set(RECORDERS[kind][0].files)
    assert [name for name in visible(tmp_path / "failed") if "masks/" not in name] == ["run.json"]
    states = [run_json(tmp_path / name)["state"] for name in ("whole", "interrupted", "failed")]
    assert states == ["complete", "interrupted", "failed"]
    assert run_json(tmp_path / "failed")["problems"] == ["frame 4 is no picture"]


@pytest.mark.parametrize(
    "make", dict.fromkeys(recorder[0] for recorder in RECORDERS.values()), ids=lambda make: make.__name__
)
def test_a_recorder_replaces_no_file_of_another_program(tmp_path, make):
    for name in (*make.files, "masks/000001.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("mine")
        with pytest.raises(InputError, match=f"{name} was not written by dddas"):
            make(tmp_path)
        assert (tmp_path / name).read_text() == "mine"
        (tmp_path / name).unlink()


def make_old(folder):
    """A complete run of each recorder's files, as if an earlier one had left them, and files of the user's."""
    folder.mkdir()
    for name in {name for make, *_ in RECORDERS.values() for name in make.files} - {"run.json"}:
        (folder / name).write_text("old")
    for number in (1, 2, 3, 40):
        (folder / "masks").mkdir(exist_ok=True)
        (folder / "masks" / f"{number:06d}.png").write_text("old")
    (folder / "notes.txt").write_text("old, and the user's")
    write_run_record(folder / "run.json", "complete", {})


@pytest.mark.parametrize("ended", ["whole", "interrupted", "failed", "without overlay", "killed"])
@pytest.mark.parametrize("kind", RECORDERS)
def test_from_its_first_item_on_a_run_has_the_folder_for_itself_however_it_ends(tmp_path, kind, ended, monkeypatch):
    make, begin, item = RECORDERS[kind]
    folder, own = tmp_path / "out", set(make.files)
    make_old(folder)
    others = {name for name in visible(folder) if name not in own and not ("masks/" in name and make.numbered)}

    def refuse(*_):
        raise ValueError("the encoder is out of order")

    if ended == "without overlay":
        monkeypatch.setattr("torchvision_dddas.io.overlay_video._H264.encode", refuse)
    error = {"interrupted": KeyboardInterrupt(), "failed": InputError("frame 3 is no picture")}.get(ended)
    recorder = make(folder)
    with suppress(InputError, KeyboardInterrupt), recorder:
        begin(recorder)
        for number in (1, 2):
            recorder.write(item(number))
        if ended == "killed":  # nothing of what follows is done
            now = {name: content for name, content in contents(folder).items() if ".part" not in name}
        if error is not None:
            raise error
    now = now if ended == "killed" else contents(folder)
    state = json.loads(now["run.json"])["state"]
    assert state == {"interrupted": "interrupted", "failed": "failed", "killed": "running"}.get(ended, "complete")
    assert {name for name, content in now.items() if content.startswith(b"old")} == others
    assert "notes.txt" in others


def test_what_is_not_saved_is_not_left_from_the_run_before(tmp_path):
    fill(tmp_path, [make_scene(n) for n in (1, 2, 3)])
    fill(tmp_path, [make_scene(n) for n in (1, 3)], save=("masks",))
    assert visible(tmp_path) == ["detections.csv", "detections.txt", "masks/000001.png", "masks/000003.png", "run.json"]
    fill(tmp_path, [])
    assert visible(tmp_path) == ["detections.csv", "detections.txt", "run.json"]
    assert run_json(tmp_path)["state"] == "complete"


def test_a_file_of_the_run_before_that_cannot_be_removed_is_one_line_and_the_run_is_not_complete(tmp_path):
    fill(tmp_path, [make_scene(1)])
    (tmp_path / "overlay.mp4").unlink()
    (tmp_path / "overlay.mp4" / "mine").mkdir(parents=True)
    with pytest.raises(InputError, match=r"cannot write .*overlay\.mp4: "):
        fill(tmp_path, [make_scene(1), make_scene(2)], save=())
    assert run_json(tmp_path)["state"] == "failed"


# --------------------------------------------------------------------------------------------------------------------
# dddas detect.


def fill(folder, scenes, save=BOTH):
    with DetectionRecorder(folder, save) as output:
        output.begin({"backend": "onboard", "settings": {"points": 5}}, rate_hz=10)
        for scene in scenes:
            output.write(scene)


def test_the_record_has_causes_adjustments_durations_and_versions(tmp_path, adjustment):
    doubtful = make_scene(2, 0, reliable=False, cause="blank", adjustments=(adjustment,), seconds={"track": 0.030})
    fill(tmp_path / "a/b", [make_scene(1, seconds={"track": 0.010}), doubtful])
    assert visible(tmp_path / "a/b") == ALL_OF_TWO
    record = run_json(tmp_path / "a/b")
    assert (record["state"], record["interrupted"]) == ("complete", False)
    assert record["frames"] == {"written": 2, "unreliable": 1}
    assert record["unreliable"] == [{"first": 2, "last": 2, "cause": "blank"}]
    assert record["adjustments"][0] == {
        "frame": 2, "knob": "interval_frames", "old": 1.0, "new": 2.0, "cause": "background flow 0.4 px a frame",
    }  # fmt: skip
    assert record["seconds"]["stages"]["track"]["total"] == pytest.approx(0.04)
    assert record["settings"] == {"points": 5}
    assert {"torchvision_dddas", "python", "numpy", "cv2"} <= set(record["versions"])


def test_the_record_lists_the_first_thousand_changes_of_a_parameter_and_counts_the_others(tmp_path):
    def changes(number):
        rare = [Adjustment(number, "interval.frames", 1, 2, "flow")] if number in (1, 2500) else []
        return (*rare, Adjustment(number, "appearance.looked", number % 2, 1 - number % 2, "a rival"))

    fill(tmp_path, (make_scene(n, 0, adjustments=changes(n)) for n in range(1, 2501)), save=())
    kept = run_json(tmp_path)
    assert kept["adjustments_made"] == {"interval.frames": 2, "appearance.looked": 2500}
    frames = [row["frame"] for row in kept["adjustments"] if row["knob"] == "appearance.looked"]
    assert frames == list(range(1, 1001))
    assert [row["frame"] for row in kept["adjustments"] if row["knob"] == "interval.frames"] == [1, 2500]


def test_nothing_located_names_the_causes_with_their_frames_the_most_frequent_first():
    assert describe_nothing_located({"no heading": 12}, 0) == "0 located, because no heading"
    causes = {"no heading": 12, "the log has ended": 48, "blank": 2, "shaken": 1}
    words = "0 located, because the log has ended (48 frames); no heading (12 frames); blank (2 frames)"
    assert describe_nothing_located(causes, 0) == words


def test_decisions_on_appearance_are_a_table_and_a_summary_and_without_any_there_is_neither(tmp_path):
    uses = [None, AppearanceUse(False, "locations 0.900, above 0.65", 1.0, 0.9)]
    uses += [AppearanceUse(True, f"locations {d}, of appearances 0.70", 0.0, d, 0.7) for d in (0.5, 0.3)]
    folder = tmp_path / "out"
    for given in (uses, [None]):
        with TrackRecorder(folder, ()) as output:
            output.begin({}, 10, (80, 60))
            for number, use in enumerate(given, 1):
                item = tracked(number)
                output.write(replace(item, tracks=replace(item.tracks, appearance=use)))
        if len(given) == 1:
            break
        assert (folder / "appearance.csv").read_text().splitlines() == [
            "frame,looked,weight,location_dispersion,appearance_dispersion,cause",
            '2,0,1,0.9000,,"locations 0.900, above 0.65"',
            '3,1,0,0.5000,0.7000,"locations 0.5, of appearances 0.70"',
            '4,1,0,0.3000,0.7000,"locations 0.3, of appearances 0.70"',
        ]
        assert run_json(folder)["appearance"] == {
            "decisions": 3, "looked_at": 2, "causes": {"locations #, above #": 1, "locations #, of appearances #": 2},
            "location_dispersion": [0.3, 0.9], "appearance_dispersion": [0.7, 0.7],
        }  # fmt: skip
    assert not (folder / "appearance.csv").exists() and "appearance" not in run_json(folder)


def test_a_second_run_replaces_the_first_and_foreign_files_stay(tmp_path):
    fill(tmp_path, [make_scene(1), make_scene(2), make_scene(3)])
    foreign = ["notes.txt", "masks/000003.txt", "masks/0003.png", "masks/notes.png"]
    for name in foreign:
        (tmp_path / name).write_text("mine")
    fill(tmp_path, [make_scene(1, targets=4), make_scene(2)])
    assert visible(tmp_path) == sorted([*ALL_OF_TWO, *foreign])
    assert len((tmp_path / "detections.txt").read_text().splitlines()) == 5
    fill(tmp_path / "tables", [make_scene(1)], save=())
    assert visible(tmp_path / "tables") == ["detections.csv", "detections.txt", "run.json"]


def test_ctrl_c_while_a_frame_is_written_waits_for_the_whole_frame(tmp_path, monkeypatch):
    honest = TableFiles.write

    def interrupted(self, made):
        honest(self, made)
        if made.frame.number == 2:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(TableFiles, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fill(tmp_path, [make_scene(1), make_scene(2), make_scene(3)])
    assert visible(tmp_path) == ALL_OF_TWO
    assert len((tmp_path / "detections.txt").read_text().splitlines()) == 2
    assert cv2.VideoCapture(str(tmp_path / "overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 2


@pytest.mark.parametrize("victim", ["mask", "table", "closing"])
def test_a_full_disk_is_one_line_that_names_the_file_and_leaves_nothing_half_written(tmp_path, monkeypatch, victim):
    write, replace = os.write, Path.replace

    def refuse(*_):
        raise OSError(*FULL)

    def refuse_mask(file, content):
        is_second = any(os.path.samestat(os.fstat(file), p.stat()) for p in tmp_path.glob("masks/.000002.*"))
        return refuse(write(file, content[:10])) if is_second else write(file, content)

    def refuse_table(self, target):
        if target.name == "detections.csv":
            raise OSError(*FULL, str(self))
        return replace(self, target)

    place, how, file = {
        "mask": ("os.write", refuse_mask, "masks/000002.png"),
        "table": ("torchvision_dddas.io.tables.mot_rows", refuse, ""),
        "closing": ("pathlib.Path.replace", refuse_table, "detections.csv"),
    }[victim]
    monkeypatch.setattr(place, how)
    with pytest.raises(InputError, match="No space left on device") as error:
        fill(tmp_path, [make_scene(1), make_scene(2)])
    assert f"cannot write {tmp_path / file}: " in str(error.value)
    assert "Unfinished files, such as tables being written, are removed" in str(error.value)
    assert not any(".part" in name for name in visible(tmp_path))
    assert not {"detections.csv", "overlay.mp4"} & set(visible(tmp_path)) or victim == "closing"
    # The film is encoded beside the rest: the next mask may be there, and whole, before its error is known.
    assert ("masks/000002.png" in visible(tmp_path)) <= (victim in ("overlay", "closing"))
    assert run_json(tmp_path)["state"] == "failed"


def test_bad_input_before_the_first_frame_leaves_the_earlier_run_and_no_new_folder(tmp_path):
    def bad():
        yield from ()
        raise InputError("no such clip")

    fill(tmp_path / "old", [make_scene(1)])
    before = contents(tmp_path / "old")
    for folder in ("old", "new/deep"):
        with pytest.raises(InputError):
            fill(tmp_path / folder, bad())
    assert contents(tmp_path / "old") == before
    assert not (tmp_path / "new").exists()


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path, monkeypatch):
    (tmp_path / "out").write_text("")
    with pytest.raises(InputError, match=r"cannot write into .*out.*--out"):
        DetectionRecorder(tmp_path / "out/deeper")

    def refuse(path, *_):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr("os.open", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        DetectionRecorder(tmp_path)


@pytest.mark.parametrize(("names", "save"), [(None, BOTH), ("all", BOTH), ("none", ()), ("overlay, masks", BOTH)])
def test_names_to_save(names, save):
    assert parse_save(names, DetectionRecorder.saved) == save
    with pytest.raises(InputError, match=r"masks, overlay, all or none, got 'film'"):
        parse_save("masks,film", DetectionRecorder.saved)


def test_the_median_of_durations_is_within_a_hundredth_and_json_holds_no_nan():
    times = Durations()
    for k in range(1, 1002):
        times.add(k * 1e-4)
    assert times.median_s == pytest.approx(501e-4, rel=0.01) and Durations().median_s == 0
    given = {"a": np.float32("nan"), "b": (np.int64(3), Path("x")), 1: True}
    assert finite(given) == {"a": None, "b": [3, "x"], "1": True}


@pytest.mark.parametrize(("targets", "kind"), [(0, np.uint8), (255, np.uint8), (256, np.uint16)])
def test_masks_hold_every_target_number_in_the_smallest_type(tmp_path, targets, kind):
    made = make_scene(3, targets=targets, size=(99, 61))
    Masks(tmp_path).write(made)
    read = cv2.imread(str(tmp_path / "masks/000003.png"), cv2.IMREAD_UNCHANGED)
    assert read is not None and read.dtype == kind and np.array_equal(read, made.mask)


# --------------------------------------------------------------------------------------------------------------------
# dddas people.


def people_frame(number, share=1.0, cause="", adjustments=()):
    box_px = np.array([[10, 20, 30, 90.0], [60, 5, 30, 80]])
    people = People(box_px, np.array([0.9, 0.4]), np.ones(2), np.array([False, True]), box_px) if share else People()
    regions = None if share == 1 else np.zeros((3, 4))
    frame = Frame(number, 0.1 * number, np.zeros((120, 160, 3), np.uint8))
    return PeopleFrame(frame, people, regions, share, cause, adjustments, {"score": 0.02})


def test_the_record_counts_people_windows_and_the_frames_that_could_not_be_read(tmp_path):
    line = Adjustment(2, "people.regions_share", 1.0, 0.2, "2 people expected")
    with PeopleRecorder(tmp_path / "out", ()) as output:
        output.begin({"input": "x"}, 10)
        output.write(people_frame(1))
        output.write(people_frame(2, 0.2, adjustments=(line,)))
        output.write(people_frame(3, 0, cause="the frame could not be read"))
        output.write(people_frame(4, 0.4))
        output.write(people_frame(5, 0))
    kept = run_json(tmp_path / "out")
    assert (kept["targets"], kept["unlikely"], kept["cut"]) == (6, 3, 3)
    assert kept["frames"] == {"written": 5, "unreliable": 1}
    frames = {"frames_everywhere": 1, "frames_in_regions": 2, "frames_nowhere": 1}
    assert kept["searched"] == {"share_of_windows": pytest.approx(0.4), **frames}
    assert kept["unreliable"] == [{"first": 3, "last": 3, "cause": "the frame could not be read"}]
    assert [a["cause"] for a in kept["adjustments"]] == ["2 people expected"]
    assert kept["seconds"]["stages"]["score"]["total"] == pytest.approx(0.1)


def test_an_overlay_that_fails_costs_itself_alone_and_is_told(tmp_path, monkeypatch):
    def refuse(*_):
        raise ValueError("the encoder is out of order")

    monkeypatch.setattr("torchvision_dddas.io.overlay_video._H264.encode", refuse)
    words = "overlay could not be written: the encoder is out of order; all other results are in"
    with pytest.raises(InputError, match=words):
        fill(tmp_path, [make_scene(1), make_scene(2)])
    assert {"detections.csv", "detections.txt", "masks/000002.png", "run.json"} <= set(visible(tmp_path))
    assert "overlay.mp4" not in visible(tmp_path)
    record = json.loads((tmp_path / "run.json").read_text())
    assert (record["state"], "overlay" in record["outputs"], len(record["problems"])) == ("complete", False, 1)


def test_an_input_that_is_lost_keeps_what_came_before(tmp_path):
    def scenes():
        yield make_scene(1)
        raise LostInputError("it sent nothing for 30 s")

    with pytest.raises(LostInputError) as error:
        fill(tmp_path, scenes())
    assert error.value.__notes__ == ["results up to here are kept"]
    record = json.loads((tmp_path / "run.json").read_text())
    assert (record["state"], record["frames"]["written"]) == ("interrupted", 1)
    assert "detections.csv" in visible(tmp_path)
