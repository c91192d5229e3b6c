"""Video files: what is whole is read, what is damaged is reported, and every frame keeps its number."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.io.clips import mark_rotated, number_of, picture, spoil_avi_frame, write_by_av, write_video
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.sources import open_source


@pytest.mark.parametrize(("name", "codec"), [("clip.mp4", "mp4v"), ("clip.avi", "MJPG")])
def test_a_whole_video_is_read_in_order_with_its_times(tmp_path: Path, name: str, codec: str) -> None:
    source = open_source(write_video(tmp_path / name, codec))
    frames = list(source)
    assert (source.count, source.rate_hz, source.size) == (30, 10.0, (64, 48))
    assert [frame.number for frame in frames] == list(range(1, 31))
    assert [number_of(frame.image) for frame in frames] == pytest.approx(range(1, 31), abs=1)
    assert [frame.time_s for frame in frames] == pytest.approx(np.arange(30) / 10, abs=1e-3)
    assert frames[0].image.shape == (48, 64, 3)
    assert frames[0].image.dtype == np.uint8
    assert source.problems == []


def test_a_video_can_be_read_twice_and_left_in_the_middle(tmp_path: Path) -> None:
    source = open_source(write_video(tmp_path / "clip.avi", "MJPG"))
    for frame in source:
        if frame.number == 3:
            break
    assert [frame.number for frame in source] == list(range(1, 31))


def test_a_given_rate_replaces_the_files(tmp_path: Path) -> None:
    source = open_source(write_video(tmp_path / "clip.mp4", "mp4v", frames=4), rate_hz=25)
    assert source.rate_hz == 25
    assert [frame.time_s for frame in source] == pytest.approx([0, 0.04, 0.08, 0.12])


def test_a_rotated_video_comes_upright(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mp4", "mp4v", frames=3)
    flat = [frame.image for frame in open_source(path)]
    mark_rotated(path)
    source = open_source(path)
    turned = [frame.image for frame in source]
    assert source.size == (48, 64)
    np.testing.assert_array_equal(turned[2], cv2.rotate(flat[2], cv2.ROTATE_90_CLOCKWISE))


def test_an_undecodable_frame_leaves_a_gap_in_the_numbers_and_is_named(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", "MJPG")
    spoil_avi_frame(path, 12)
    spoil_avi_frame(path, 20)
    spoil_avi_frame(path, 21)
    source = open_source(path)
    frames = list(source)
    assert [frame.number for frame in frames] == [n for n in range(1, 31) if n not in (12, 20, 21)]
    assert all(abs(number_of(frame.image) - frame.number) <= 1 for frame in frames)
    assert [problem.frame for problem in source.problems] == [12, 20]
    assert "frame 12 " in str(source.problems[0])
    assert "frames 20 to 21 " in str(source.problems[1])


def test_undecodable_frames_at_the_end_are_named_and_still_counted(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", "MJPG")
    spoil_avi_frame(path, 29)
    spoil_avi_frame(path, 30)
    source = open_source(path)
    assert [frame.number for frame in source] == list(range(1, 29))
    assert source.last == 30
    assert [str(problem) for problem in source.problems] == ["frames 29 to 30 could not be decoded and were left out"]


def test_problems_do_not_pile_up_when_a_clip_is_read_again(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", "MJPG")
    spoil_avi_frame(path, 12)
    source = open_source(path)
    assert len(list(source)) == len(list(source)) == 29
    assert len(source.problems) == 1


def test_a_truncated_video_gives_what_it_holds_and_says_where_it_ends(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", "MJPG")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    source = open_source(path)
    frames = list(source)
    assert 3 <= len(frames) < 30
    assert [frame.number for frame in frames] == list(range(1, len(frames) + 1))
    assert len(source.problems) == 1
    assert f"ends after frame {len(frames)} but announces 30" in str(source.problems[0])
    assert source.last == len(frames)


def test_a_damaged_stretch_of_an_mp4_does_not_shift_the_frames_after_it(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mp4", "mp4v")
    data = bytearray(path.read_bytes())
    middle = (data.index(b"mdat") + data.index(b"moov")) // 2
    data[middle : middle + 200] = bytes(200)
    path.write_bytes(data)
    source = open_source(path)
    frames = list(source)
    assert len(frames) < 30
    assert source.problems
    numbers = [frame.number for frame in frames]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == 30
    assert abs(number_of(frames[-1].image) - 30) <= 1  # the picture that was written last, under its own number


def test_an_mp4_cut_short_has_lost_its_index_and_is_refused(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.mp4", "mp4v")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=r"clip\.mp4 as a video"):
        open_source(path)


@pytest.mark.parametrize("content", [b"", b"no video\n" * 500, bytes(range(256)) * 40])
@pytest.mark.parametrize("name", ["clip.mp4", "clip.avi", "clip.txt"])
def test_a_file_that_is_no_video_gets_one_line(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError) as error:
        open_source(path)
    assert name in str(error.value)
    assert "\n" not in str(error.value)


def test_refusing_garbage_prints_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "clip.mp4").write_bytes(b"no video" * 500)
    with pytest.raises(InputError):
        open_source(tmp_path / "clip.mp4")
    assert capfd.readouterr() == ("", "")


def test_a_video_whose_first_frame_is_damaged_is_refused(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", "MJPG")
    spoil_avi_frame(path, 1)
    with pytest.raises(InputError, match="first frame"):
        open_source(path)


def test_odd_sizes_are_kept(tmp_path: Path) -> None:
    source = open_source(write_by_av(tmp_path / "clip.mkv", "ffv1", [0, 100, 200], size=(63, 47)))
    assert source.size == (63, 47)
    np.testing.assert_array_equal(next(iter(source)).image, picture(1, 63, 47))


def test_a_clip_of_varying_rate_is_numbered_by_counting_and_timed_by_its_stamps(tmp_path: Path) -> None:
    stamps = np.cumsum(np.random.default_rng(0).integers(60, 180, 30)).tolist()
    source = open_source(write_by_av(tmp_path / "clip.mkv", "mjpeg", stamps))
    frames = list(source)
    assert [frame.number for frame in frames] == list(range(1, 31))
    assert [frame.time_s for frame in frames] == pytest.approx((np.array(stamps) - stamps[0]) / 1000, abs=2e-3)
    assert source.problems == []


def test_a_pause_of_the_recorder_is_no_lost_frame(tmp_path: Path) -> None:
    stamps = [100 * n if n < 8 else 100 * n + 500 for n in range(30)]
    source = open_source(write_by_av(tmp_path / "clip.mkv", "mjpeg", stamps))
    assert [frame.number for frame in source] == list(range(1, 31))
    assert source.problems == []


def test_a_damaged_h264_keeps_order_numbers_and_times(tmp_path: Path) -> None:
    path = write_by_av(tmp_path / "clip.mp4", "libx264", list(range(0, 3000, 100)), g="8", bf="2")
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat")
    place = start + (data.index(b"moov") - start) * 2 // 3
    data[place : place + 300] = b"\xff" * 300
    path.write_bytes(data)
    source = open_source(path)
    frames = list(source)
    numbers = [frame.number for frame in frames]
    assert len(numbers) < 30
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == 30
    assert abs(number_of(frames[-1].image) - 30) <= 1
    assert [frame.time_s for frame in frames] == pytest.approx([(n - 1) / 10 for n in numbers])
    assert source.problems


class ScriptedCapture:
    """Stands for a decoder: a stamp in frames for each read, None for one that fails; afterwards every read fails."""

    def __init__(self, script: list[float | None]) -> None:
        self.script, self.stamp = list(script), 0.0

    def grab(self) -> bool:
        stamp = self.script.pop(0) if self.script else None
        self.stamp = self.stamp if stamp is None else stamp
        return stamp is not None

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, picture(1)

    def get(self, _property: int) -> float:
        return self.stamp * 100.0

    def release(self) -> None:
        self.script.clear()


@pytest.mark.parametrize(
    ("script", "numbers", "problems"),
    [
        ([0, 1, None, 3], [1, 2, 4], ["frame 3 could not"]),
        ([0, 1, None, 5, 2, 6, 3, 7], [1, 2, 6, 7, 8], ["frames 3 to 5 could not", "out of order", "out of order"]),
        ([0, 1, 2.4, None, 4.6], [1, 2, 3, 5], ["frame 4 could not"]),  # a varying rate: counted
        ([0, 0, 0, None, 0], [1, 2, 3, 5], ["frame 4 could not"]),  # no stamps: counted
        ([0, 2, 4, 6], [1, 2, 3, 4], []),  # the rate is announced twice too high
    ],
)
def test_frames_are_numbered_by_stamps_where_these_can_be_believed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: list[float | None], numbers: list[int], problems: list[str]
) -> None:
    source = open_source(write_video(tmp_path / "clip.avi", "MJPG", frames=8))
    monkeypatch.setattr(source, "count", None)
    monkeypatch.setattr(source, "_open", lambda: ScriptedCapture(script))
    frames = list(source)
    assert [frame.number for frame in frames] == numbers
    assert len(source.problems) == len(problems)
    for problem, words in zip(source.problems, problems, strict=True):
        assert words in str(problem)
    times = [frame.time_s for frame in frames]
    assert times == sorted(set(times))


@pytest.mark.parametrize("codec", ["avi MJPG", "mp4 mp4v"])
@pytest.mark.parametrize("interval", [1, 4, 50])
def test_every_so_many_frames_are_those_of_the_whole_clip(tmp_path: Path, codec: str, interval: int) -> None:
    suffix, fourcc = codec.split()
    source = open_source(write_video(tmp_path / f"clip.{suffix}", fourcc))
    whole = [frame for frame in source if (frame.number - 1) % interval == 0]
    picked = list(source.every(interval))
    assert [(frame.number, frame.time_s) for frame in picked] == [(frame.number, frame.time_s) for frame in whole]
    assert all(np.array_equal(a.image, b.image) for a, b in zip(picked, whole, strict=True))
    assert (source.last, source.problems, source.exact) == (30, [], True)


def test_a_damaged_frame_is_named_whether_or_not_it_is_wanted(tmp_path: Path) -> None:
    path = write_video(tmp_path / "clip.avi", "MJPG", frames=10)
    spoil_avi_frame(path, 7)
    source = open_source(path)
    assert [frame.number for frame in source.every(3)] == [1, 4, 10]
    assert [problem.frame for problem in source.problems] == [7]
    assert [frame.number for frame in source.every(4)] == [1, 5, 9]


def test_a_camera_that_is_not_there_and_a_name_that_is_no_camera_are_refused() -> None:
    with pytest.raises(InputError, match="cannot open camera 97"):
        open_source("camera:97")
    with pytest.raises(InputError, match="names no camera"):
        open_source("camera:front")
