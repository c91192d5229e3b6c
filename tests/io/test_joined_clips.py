"""Clips of one flight are one clip: numbers and times go on, each log belongs to its clip, a pause stays a pause."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.io.clips import number_of, write_video
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.joined_clips import JoinedSource
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.types import Telemetry

FRAMES, RATE_HZ = (20, 12, 8), 10.0
ENDS = np.cumsum(FRAMES)


def clips(folder, sizes=((64, 48),) * 3, rates=(RATE_HZ,) * 3):
    return [
        open_source(write_video(folder / f"{k}.mp4", "mp4v", n, size, rate))
        for k, (n, size, rate) in enumerate(zip(FRAMES, sizes, rates, strict=True))
    ]


def joining(*given: Any, **options: Any) -> Any:
    """A joined source whose logs have any names."""
    return JoinedSource(*given, **options)


def log(k, start_utc_s=np.nan, frames=None, **more: Any):
    """The log of a clip, a sample a picture: from one to the next the vehicle flies 1 m to the east."""
    time_s = np.arange(frames or FRAMES[k]) / RATE_HZ
    east = time_s * RATE_HZ + (0 if k == 0 else ENDS[k - 1])
    place = np.stack([east, 0 * east], axis=1)
    return Telemetry(
        time_s, 50 + 0 * east, 10 + 0 * east, place, False, start_utc_s=start_utc_s, notes=("a", f"b{k}"), **more
    )


def test_numbers_and_times_go_on_from_clip_to_clip(tmp_path):
    joined = JoinedSource(clips(tmp_path))
    assert (joined.count, joined.size, joined.rate_hz, joined.exact) == (40, (64, 48), RATE_HZ, True)
    for interval in (1, 3):
        frames = list(joined.every(interval))
        assert [frame.number for frame in frames] == list(range(1, 41, interval)) and joined.last == 40
        assert [frame.time_s for frame in frames] == pytest.approx([(f.number - 1) / RATE_HZ for f in frames])
    firsts = [frame for frame in joined if frame.number in (1, 21, 33)]
    assert [number_of(frame.image) for frame in firsts] == [1, 1, 1]


@pytest.mark.parametrize("clock", [False, True])
def test_each_log_belongs_to_its_clip(tmp_path, clock):
    joined = joining(clips(tmp_path), ["0.srt", "1.srt", "2.srt"])
    starts = (0.0, *ENDS[:-1] / RATE_HZ)
    flight = joined.read_logs(lambda path, _: log(int(path[0]), 1000 + starts[int(path[0])] if clock else np.nan))
    for frame in joined:
        state = flight.at(frame.time_s)
        assert state is not None and state.place[0] == pytest.approx(frame.number - 1, abs=1e-6)
    assert flight.notes[0] == "a" and sorted(note[-2:] for note in flight.notes if note[-2:-1] == "b") == [
        "b0",
        "b1",
        "b2",
    ]
    assert any("no clock in common" in note for note in flight.notes) != clock


def test_samples_beyond_the_end_of_a_clip_do_not_count_for_the_next(tmp_path):
    joined = joining(clips(tmp_path), ["0", "1", "2"])
    flight = joined.read_logs(lambda path, _: log(int(path), frames=60))
    east = [flight.at(frame.time_s).place[0] for frame in joined]
    assert east == pytest.approx(np.arange(40), abs=1e-6)


def test_a_pause_between_two_clips_stays_one_and_nothing_is_known_in_it(tmp_path):
    joined, pause_s = joining(clips(tmp_path), ["0", "1", "2"]), np.array([0.0, 30.0, 30.0])
    starts = np.array([0.0, *ENDS[:-1] / RATE_HZ]) + pause_s
    flight = joined.read_logs(lambda path, _: log(int(path), 1000 + starts[int(path)]))
    times = [frame.time_s for frame in joined]
    assert np.diff(times).max() == pytest.approx(30.1) and times[-1] == pytest.approx(33.9)
    assert [flight.at(at).place[0] for at in times] == pytest.approx(np.arange(40), abs=1e-6)
    assert not np.isfinite(flight.at(15.0).place).any()


def subtitles(k, begun_s, frames):
    """DJI's subtitles of a clip: dates without a zone."""
    timings = (f"{n}\n00:00:0{n // 10},{n % 10}00 --> 00:00:0{n // 10},{n % 10}90" for n in range(frames))
    dates = (f"2023-05-03 23:59:{(begun_s + n / 10):06.3f}" for n in range(frames))
    place = f"[latitude: 48.{k}] [longitude: 11.5] [rel_alt: 15.0 abs_alt: 540.0]"
    return "".join(f"{timing}\n{date}\n{place}\n\n" for timing, date in zip(timings, dates, strict=True))


@pytest.mark.parametrize(
    ("begun_s", "pause_s"), [((0.0, 2.0, 3.2), 0.0), ((0.0, 22.0, 23.2), 20.0), ((5.0, 0.0, 9.0), None)]
)
def test_the_local_dates_of_subtitles_tell_pauses_and_order(tmp_path, begun_s, pause_s):
    logs = [tmp_path / f"{k}.srt" for k in range(3)]
    for k, path in enumerate(logs):
        path.write_text(subtitles(k, begun_s[k], FRAMES[k]))
    joined = joining(clips(tmp_path), logs)
    if pause_s is None:
        with pytest.raises(InputError, match=r"1\.mp4 begins 7\.0 s before .*0\.mp4 ends"):
            joined.read_logs(lambda path, _: read_telemetry(path))
        return
    flight = joined.read_logs(lambda path, _: read_telemetry(path))
    times = [frame.time_s for frame in joined]
    assert times[20] == pytest.approx(2 + pause_s, abs=0.01) and times[32] == pytest.approx(3.2 + pause_s, abs=0.01)
    assert flight.at(times[21]).place[1] == pytest.approx(48.1)
    assert not any("no clock in common" in note for note in flight.notes)


@pytest.mark.parametrize("column", ["date", "UTC time"])
def test_the_dates_of_tables_tell_pauses_too(tmp_path, column):
    logs = [tmp_path / f"{k}.csv" for k in range(3)]
    for k, path in enumerate(logs):
        begun_s = (0.0, 12.0, 33.2)[k]
        rows = (f"2023-05-03 10:00:{begun_s + n / 10:06.3f},48.{k},11.5,15\n" for n in range(FRAMES[k]))
        path.write_text(f"{column},latitude,longitude,height\n" + "".join(rows))
    joined = joining(clips(tmp_path), logs)
    joined.read_logs(lambda path, _: read_telemetry(path))
    assert [frame.time_s for frame in joined if frame.number in (21, 33)] == pytest.approx([12.0, 33.2], abs=0.01)


def test_one_log_for_all_clips_goes_through(tmp_path):
    joined = joining(clips(tmp_path), ["all"])
    flight = joined.read_logs(lambda *_: log(0, frames=40))
    assert [flight.at(frame.time_s).place[0] for frame in joined] == pytest.approx(np.arange(40), abs=1e-6)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda f: JoinedSource(clips(f, sizes=((64, 48), (64, 48), (48, 64)))), "48x64 at 10 Hz, .*64x48 at 10 Hz"),
        (lambda f: JoinedSource(clips(f, rates=(10, 10, 25))), "at 25 Hz, .* at 10 Hz; clips of one run"),
        (lambda f: joining(clips(f), ["a", "b"]), "3 clips and 2 logs"),
        (
            lambda f: joining(clips(f), ["0", "1", "2"]).read_logs(lambda p, _: log(int(p), 1000 - 9 * int(p))),
            r"1.mp4 begins 11.0 s before .*0.mp4 ends",
        ),
        (
            lambda f: joining(clips(f), ["0", "1", "2"]).read_logs(
                lambda p, _: replace(log(int(p)), geographic=p == "1")
            ),
            "one kind",
        ),
    ],
)
def test_what_does_not_belong_together_is_one_line(tmp_path, make, words):
    with pytest.raises(InputError, match=words):
        make(tmp_path)
