"""Videos of a live run: overlay.mp4, clips around events, full disks, and pictures that come too fast."""

import threading
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.zoned import result
from torchvision_dddas.io import video_packets
from torchvision_dddas.io.streams import About
from torchvision_dddas.io.streams.video import VideoMessages
from torchvision_dddas.io.video_packets import VideoFile
from torchvision_dddas.live import recording
from torchvision_dddas.live.recording import EventClips, OverlayFiles, Recorder, SentPictures
from torchvision_dddas.types import Frame, ZoneEvent

av = pytest.importorskip("av", reason="the extra video is not installed")

RATE_HZ = 10.0


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    monkeypatch.setattr(recording, "_CLOSE_S", 120.0)  # on a machine that is busy with other things


@pytest.fixture
def told():
    return []


def record(outputs, told, count, events=None, size=(64, 48), first=1, waits=True):
    """Record frames whose red is their number. events: by the frame that reports them."""
    recorder = Recorder(outputs, RATE_HZ, 1, About(), (), lambda kind, text: told.append(text), waits)
    film(recorder, count, events or {}, size, first)
    recorder.close()


def film(recorder, count, events=None, size=(64, 48), first=1):
    for number in range(first, first + count):
        image = np.full((size[1], size[0], 3), (0, 0, number % 250), np.uint8)
        frame = Frame(number, (number - 1) / RATE_HZ, image)
        recorder.take(frame)
        seen = result(number, [(1.0, 1.0)], RATE_HZ, located=False)
        tracked = replace(seen.tracked, frame=replace(frame, image=np.zeros((0, 0), np.uint8)))
        recorder.show(replace(seen, tracked=tracked, events=(events or {}).get(number, ())), None, 1.6e9)


def event(frame, kind="enter"):
    return (ZoneEvent(kind, "door", 1, frame, (frame - 1) / RATE_HZ),)


def pictures(path):
    """The times of the pictures of a video, and the numbers of their frames."""
    with av.open(str(path)) as opened:
        frames = list(opened.decode(video=0))
    images = [frame.to_ndarray(format="bgr24") for frame in frames]
    return [float(f.pts * f.time_base) for f in frames], [float(image[2, -4, 2]) for image in images], images[0].shape


def names(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def test_the_overlay_has_each_picture_at_its_own_time(tmp_path, told):
    record([OverlayFiles(tmp_path)], told, 25, size=(63, 47))
    times, numbers, shape = pictures(tmp_path / "overlay.mp4")
    assert times == pytest.approx([k / RATE_HZ for k in range(25)], abs=1e-3) and shape == (48, 64, 3)
    assert numbers == pytest.approx(range(1, 26), abs=5)
    assert names(tmp_path) == ["overlay.mp4"] and told == []


def test_a_long_overlay_and_pictures_of_another_size_begin_another_file(tmp_path, told, monkeypatch):
    monkeypatch.setattr(recording, "_PART_S", 2.0)
    recorder = Recorder([OverlayFiles(tmp_path)], RATE_HZ, 1, About(), (), lambda kind, text: told.append(text), True)
    film(recorder, 35)
    film(recorder, 5, size=(80, 60), first=36)
    recorder.close()
    assert names(tmp_path) == ["overlay-2.mp4", "overlay-3.mp4", "overlay.mp4"] and told == []
    parts = [pictures(tmp_path / name) for name in ("overlay.mp4", "overlay-2.mp4", "overlay-3.mp4")]
    assert [len(times) for times, *_ in parts] == [20, 15, 5]
    assert parts[2][2] == (60, 80, 3) and all(times[0] == 0 for times, *_ in parts)


def test_a_clip_has_the_seconds_around_an_event_that_was_certain_later(tmp_path, told):
    record([EventClips(tmp_path, 1.5, print)], told, 90, {55: event(40)})
    assert names(tmp_path) == ["clips/000040-enter.mp4"] and told == []
    times, numbers, _ = pictures(tmp_path / "clips/000040-enter.mp4")
    assert 15 < numbers[0] <= 25 + 5 and numbers[-1] == pytest.approx(55, abs=5)
    assert 3.0 <= times[-1] <= 4.0 + 1e-6


def test_events_in_succession_share_a_clip_and_an_old_event_gets_the_past_alone(tmp_path, told):
    record([EventClips(tmp_path, 1.0, print)], told, 120, {30: event(30), 38: event(38), 90: event(60, "leave")})
    assert names(tmp_path) == ["clips/000030-enter.mp4", "clips/000060-leave.mp4"]
    _, numbers, _ = pictures(tmp_path / "clips/000030-enter.mp4")
    assert numbers[-1] == pytest.approx(48, abs=5)
    _, numbers, _ = pictures(tmp_path / "clips/000060-leave.mp4")
    assert numbers[-1] == pytest.approx(70, abs=5)


def test_the_memory_before_an_event_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "_MOST_BYTES", 3000)
    clips = EventClips(tmp_path, 60.0, print)
    record([clips], [], 200)
    assert sum(len(one.content) for group in clips._groups for one in group) < 3000 + 2000
    assert len(clips._groups) < 15


def test_a_run_that_ends_within_a_clip_keeps_it(tmp_path, told):
    record([EventClips(tmp_path, 5.0, print), OverlayFiles(tmp_path)], told, 20, {18: event(18)})
    assert names(tmp_path) == ["clips/000018-enter.mp4", "overlay.mp4"]
    assert len(pictures(tmp_path / "clips/000018-enter.mp4")[0]) == 20


def test_a_full_disk_ends_the_overlay_with_one_event_and_the_clips_go_on(tmp_path, told, monkeypatch):
    written = VideoFile.write

    def refuse(file, packet):
        if file.path.name == "overlay.mp4" and packet.pts > 90_000:
            raise OSError(28, "No space left on device")
        written(file, packet)

    monkeypatch.setattr(VideoFile, "write", refuse)
    record([OverlayFiles(tmp_path), EventClips(tmp_path, 1.0, print)], told, 40, {20: event(20)})
    assert told == ["overlay.mp4 ends: No space left on device; the run goes on without it"]
    assert names(tmp_path) == ["clips/000020-enter.mp4"]


def test_a_clip_that_cannot_be_written_is_told_and_the_next_is_tried(tmp_path, told, monkeypatch):
    finish = VideoFile.close

    def refuse(file):
        if file.path.name == "000020-enter.mp4":
            raise OSError(28, "No space left on device")
        finish(file)

    monkeypatch.setattr(VideoFile, "close", refuse)
    clips = EventClips(tmp_path, 0.5, lambda kind, text: told.append(text))
    record([clips], told, 80, {20: event(20), 50: event(50)})
    assert told == ["clips/000020-enter.mp4 cannot be written: No space left on device; the next one is tried"]
    assert names(tmp_path) == ["clips/000050-enter.mp4"]


def test_the_run_never_waits_and_what_is_left_out_is_counted(tmp_path, told, monkeypatch):
    go_on, encode = threading.Event(), video_packets.VideoEncoder.encode

    def slowly(encoder, picture, time_s):
        assert go_on.wait(30)
        return encode(encoder, picture, time_s)

    monkeypatch.setattr(video_packets.VideoEncoder, "encode", slowly)
    recorder = Recorder([OverlayFiles(tmp_path)], RATE_HZ, 1, About(), (), lambda kind, text: told.append(text))
    film(recorder, 100)
    go_on.set()
    recorder.close()
    assert told == ["the recording lacks 68 of 100 pictures: drawing and encoding took too long"]
    assert len(pictures(tmp_path / "overlay.mp4")[0]) == 32


def test_results_of_missing_pictures_do_not_count_as_drawn_too_slowly(tmp_path, told):
    recorder = Recorder([OverlayFiles(tmp_path)], RATE_HZ, 1, About(), (), lambda kind, text: told.append(text))
    film(recorder, 3)
    seen = result(4, [(1.0, 1.0)], RATE_HZ, located=False)
    frame = Frame(4, 0.3, np.zeros((0, 0), np.uint8))  # of another size, or lost: the run does not see it
    recorder.show(replace(seen, tracked=replace(seen.tracked, frame=frame)), None, 1.6e9)
    recorder.close()
    assert told == [] and len(pictures(tmp_path / "overlay.mp4")[0]) == 3


def test_a_picture_that_cannot_be_drawn_ends_the_recording_and_not_the_run(tmp_path, told, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("no picture")

    monkeypatch.setattr(recording, "draw_result", fail)
    record([OverlayFiles(tmp_path)], told, 5)
    assert told == ["overlay.mp4 ends: ZeroDivisionError: no picture; the run goes on without it"]
    assert names(tmp_path) == []


def test_a_stream_of_pictures_has_the_start_time_of_each_result(told):
    video, sent = VideoMessages(About(5.0)), []
    stream: Any = SimpleNamespace(name="video", video=video, write=lambda _: sent.append(video.about.start_utc_s))
    about = About()
    recorder = Recorder(
        [SentPictures(stream, about)], RATE_HZ, 1, about, (), lambda kind, text: told.append(text), True
    )
    for number in (1, 2):
        image = np.zeros((48, 64, 3), np.uint8)
        frame = Frame(number, (number - 1) / RATE_HZ, image)
        recorder.take(frame)
        seen = result(number, [(1.0, 1.0)], RATE_HZ, located=False)
        recorder.show(replace(seen, tracked=replace(seen.tracked, frame=frame)), None, 1e9 + number)
    recorder.close()
    assert sent == [1e9 + 1, 1e9 + 2] and told == []
