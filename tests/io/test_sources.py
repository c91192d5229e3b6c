"""Videos, folders and globs: what is whole is read, what is damaged is reported, and every frame keeps its number."""

import math
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.io.clips import (
    mark_rotated,
    number_of,
    picture,
    spoil_avi_frame,
    textured,
    write_by_av,
    write_images,
    write_video,
)
from torchvision_dddas import open_video
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.sources import frame_times, open_source


@pytest.fixture
def avi(tmp_path):
    return write_video(tmp_path / "clip.avi", "MJPG")


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(exist_ok=True)
    assert cv2.imwrite(str(path), image)


# -- Videos ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "codec"), [("clip.mp4", "mp4v"), ("clip.avi", "MJPG")])
@pytest.mark.parametrize("interval", [1, 4, 50])
def test_a_whole_video_is_read_in_order_with_its_times(tmp_path, name, codec, interval):
    source = open_source(write_video(tmp_path / name, codec))
    for frame in source:  # left in the middle
        if frame.number == 3:
            break
    frames = list(source.every(interval))
    numbers = np.arange(1, 31, interval)
    assert (source.count, source.rate_hz, source.size) == (30, 10.0, (64, 48))
    assert [frame.number for frame in frames] == numbers.tolist()
    assert [number_of(frame.image) for frame in frames] == pytest.approx(numbers, abs=1)
    assert [frame.time_s for frame in frames] == pytest.approx((numbers - 1) / 10, abs=1e-3)
    assert frames[0].image.shape == (48, 64, 3) and frames[0].image.dtype == np.uint8
    assert (source.last, source.problems, source.exact) == (30, [], True)
    assert source.notes == []  # type: ignore[attr-defined]
    assert open_source(tmp_path / name, rate_hz=25).rate_hz == 25


def test_a_rotated_video_comes_upright(tmp_path):
    path = write_video(tmp_path / "clip.mp4", "mp4v", frames=3)
    flat = [frame.image for frame in open_source(path)]
    mark_rotated(path)
    source = open_source(path)
    assert source.size == (48, 64)
    np.testing.assert_array_equal([f.image for f in source][2], cv2.rotate(flat[2], cv2.ROTATE_90_CLOCKWISE))


@pytest.mark.parametrize(
    ("spoiled", "problems"),
    [([12, 20, 21], ["frame 12 could not be decoded", "frames 20 to 21 could"]), ([29, 30], ["frames 29 to 30 could"])],
)
def test_undecodable_frames_leave_gaps_in_the_numbers_and_are_named(avi, spoiled, problems):
    for number in spoiled:
        spoil_avi_frame(avi, number)
    source = open_source(avi)
    for _ in range(2):  # problems do not pile up
        frames = list(source)
        assert [frame.number for frame in frames] == [n for n in range(1, 31) if n not in spoiled]
        assert all(abs(number_of(frame.image) - frame.number) <= 1 for frame in frames)
        assert len(source.problems) == len(problems) and source.last == 30
        assert all(str(found).startswith(words) for found, words in zip(source.problems, problems, strict=True))
    assert [n for n in [frame.number for frame in source.every(3)] if n in spoiled] == []
    assert len(source.problems) == len(problems)  # named whether or not they are wanted


def test_a_truncated_video_gives_what_it_holds_and_says_where_it_ends(avi):
    avi.write_bytes(avi.read_bytes()[: avi.stat().st_size // 2])
    source = open_source(avi)
    numbers = [frame.number for frame in source]
    assert 3 <= len(numbers) < 30 and numbers == list(range(1, len(numbers) + 1))
    # Decoders conceal the errors of the last frame, or cannot decode it: then it is named as such.
    *of_the_last, problem = map(str, source.problems)
    assert f"ends after frame {source.last} but announces 30" in problem
    if source.last != len(numbers):
        assert source.last == len(numbers) + 1 and f"frame {source.last} could not be decoded" in " ".join(of_the_last)
    assert all(f"frame {source.last}" in other for other in of_the_last)


@pytest.mark.parametrize(("codec", "filling"), [("mp4v", b"\0" * 200), ("libx264", b"\xff" * 300)])
def test_a_damaged_stretch_does_not_shift_the_frames_after_it(tmp_path, codec, filling):
    path = tmp_path / "clip.mp4"
    if codec == "mp4v":
        write_video(path, codec)
    else:
        write_by_av(path, codec, list(range(0, 3000, 100)), g="8", bf="2")
    data = bytearray(path.read_bytes())
    start = data.index(b"mdat")
    place = start + (data.index(b"moov") - start) * 2 // 3
    data[place : place + len(filling)] = filling
    path.write_bytes(data)
    source = open_source(path)
    frames = list(source)
    numbers = [frame.number for frame in frames]
    assert len(numbers) < 30 and numbers == sorted(set(numbers)) and numbers[-1] == 30 and source.problems
    assert abs(number_of(frames[-1].image) - 30) <= 1
    assert [frame.time_s for frame in frames] == pytest.approx([(number - 1) / 10 for number in numbers])


def cut_mp4(folder):
    path = write_video(folder / "whole.mp4", "mp4v")
    return path.read_bytes()[: path.stat().st_size // 2]  # it has lost its index


@pytest.mark.parametrize("content", [b"", b"no video\n" * 500, bytes(range(256)) * 40, cut_mp4])
@pytest.mark.parametrize("name", ["clip.mp4", "clip.avi", "clip.txt"])
def test_a_file_that_is_no_video_gets_one_line_and_no_word_of_a_decoder(refused, tmp_path, capfd, name, content):
    data = content if isinstance(content, bytes) else content(tmp_path)
    message = refused(open_source, data, name)
    assert name in message and ("CLIP --detections" in message) == (name == "clip.txt")
    assert capfd.readouterr() == ("", "")


def test_a_video_whose_first_frame_is_damaged_and_a_camera_that_is_none_are_refused(avi):
    spoil_avi_frame(avi, 1)
    for spec, words in ((avi, "first frame"), ("camera:97", "cannot open camera 97"), ("camera:front", "no camera")):
        with pytest.raises(InputError, match=words):
            open_source(spec)


@pytest.mark.parametrize(
    "stamps",
    [
        np.cumsum(np.random.default_rng(0).integers(60, 180, 30)),  # a varying rate
        np.arange(0, 3000, 100) + 500 * (np.arange(30) >= 8),  # a pause of the recorder is no lost frame
    ],
)
def test_a_clip_of_varying_rate_is_numbered_by_counting_and_timed_by_its_stamps(tmp_path, stamps):
    source = open_source(write_by_av(tmp_path / "clip.mkv", "mjpeg", stamps.tolist()))
    frames = list(source)
    assert [frame.number for frame in frames] == list(range(1, 31)) and source.problems == []
    assert [frame.time_s for frame in frames] == pytest.approx((stamps - stamps[0]) / 1000, abs=2e-3)
    assert len(source.notes) == 1 and "the frame rate varies" in source.notes[0]  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["cam1:2024-05-01.mp4", "file:1.mp4", "camera:0.mp4", "sim:four.mp4", "http:a.mp4"])
def test_a_colon_in_a_files_name_begins_no_address(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    write_video(tmp_path / "clip.mp4", "mp4v", frames=4).rename(tmp_path / name)
    for opened in (open_video(name), open_video(tmp_path / name)):
        assert [frame.number for frame in opened] == [1, 2, 3, 4]


def write_with_cover(path: Path, marked: bool, is_first: bool = True) -> Path:
    """A film of 12 pictures and a cover, which is marked as one or is a picture in a stream of its own."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as file:

        def add(codec, size, pix_fmt):
            stream = file.add_stream(codec, rate=10)
            (stream.width, stream.height), stream.pix_fmt = size, pix_fmt
            return stream

        kinds = [("mjpeg", (80, 80), "yuvj420p"), ("libx264", (64, 48), "yuv420p")]
        streams = [add(*kind) for kind in (kinds if is_first else kinds[::-1])]
        cover, film = streams if is_first else streams[::-1]
        if marked:
            cover.disposition = av.stream.Disposition.attached_pic.value
        for stream, numbers in ((cover, [40]), (film, range(1, 13))):
            for number in numbers:
                image = picture(number, stream.width, stream.height)
                file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
            file.mux(stream.encode())
    return path


@pytest.mark.parametrize(
    ("name", "marked", "is_first"),
    [
        ("c.mkv", False, True),
        ("c.mkv", True, True),
        ("c.mov", False, True),
        ("c.mkv", False, False),
        ("c.mp4", True, True),
    ],
)
def test_the_cover_of_a_film_is_not_read_in_its_place(tmp_path, name, marked, is_first):
    source = open_source(write_with_cover(tmp_path / name, marked, is_first))
    assert source.size == (64, 48)
    assert [frame.number for frame in source] == list(range(1, 13)) and source.problems == []


def write_changing(folder: Path, kind: str, sizes: list[tuple[int, int]], each: int = 20) -> Path:
    """Films of several sizes in one file; the time stamps of each part begin anew."""
    if kind == "mjpeg":
        shots = [picture(n, *size) for size in sizes for n in range(1, each + 1)]
        parts = [cv2.imencode(".jpg", image)[1].tobytes() for image in shots]
    elif kind == "mpg2.ts":
        parts = [write_video(folder / f"{k}.ts", "mpg2", each, size, 25).read_bytes() for k, size in enumerate(sizes)]
    else:
        codec, ending = kind.split(".")
        stamps = list(range(0, 100 * each, 100))
        parts = [
            write_by_av(folder / f"{k}.{ending}", codec, stamps, size).read_bytes() for k, size in enumerate(sizes)
        ]
    path = folder / f"joined.{kind.split('.')[-1]}"
    path.write_bytes(b"".join(parts))
    return path


@pytest.mark.parametrize("kind", ["libx264.ts", "mpg2.ts", "libx264.h264", "mjpeg"])
@pytest.mark.parametrize("second", [(48, 36), (96, 72), (48, 64)])
def test_a_film_that_changes_its_size_is_refused_and_never_squeezed(tmp_path, kind, second):
    seen: list[tuple[int, ...]] = []
    film = iter(open_source(write_changing(tmp_path, kind, [(64, 48), second])))
    with pytest.raises(InputError, match=f"is {second[0]}x{second[1]} but the first is 64x48"):
        seen.extend(frame.image.shape for frame in film)
    assert 18 <= len(seen) <= 20 and set(seen) == {(48, 64, 3)}


def test_without_pyav_a_film_whose_size_may_change_is_noted(tmp_path, monkeypatch):
    film, whole = write_changing(tmp_path, "mpg2.ts", [(64, 48)]), write_video(tmp_path / "clip.mp4", "mp4v")
    monkeypatch.setitem(sys.modules, "av", None)
    for path, count in ((film, 1), (whole, 0)):
        source = open_source(path)
        assert len(list(source)) >= 19
        assert sum("without PyAV" in note for note in source.notes) == count  # type: ignore[attr-defined]


def test_time_stamps_that_begin_anew_in_the_middle_go_on(tmp_path):
    frames = list(open_source(write_changing(tmp_path, "mpg2.ts", [(64, 48)] * 2, each=40)))
    assert [frame.number for frame in frames] == list(range(1, len(frames) + 1)) and len(frames) >= 78
    assert [frame.time_s for frame in frames] == pytest.approx(np.arange(len(frames)) / 25, abs=1e-3)


def without_stamps(path: Path, numbers: set[int]) -> Path:
    """Clear the time stamps of some pictures of a transport stream."""
    data, seen = bytearray(path.read_bytes()), 0
    for place in range(0, len(data), 188):
        begins = data.find(b"\0\0\1\xe0", place, place + 188) if data[place + 1] & 0x40 else -1
        seen += begins >= 0
        if begins >= 0 and seen in numbers:
            data[begins + 7] &= 0x3F
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("numbers", [{1}, {2}, {20}, {39, 40}, {1, 2, 12, 13, 14}, set(range(1, 41))])
def test_a_picture_without_a_time_stamp_shifts_no_other(tmp_path, numbers):
    path = write_by_av(tmp_path / "clip.ts", "libx264", list(range(0, 4000, 100)), bf="0", g="12")
    source: Any = open_source(without_stamps(path, numbers))
    frames = list(source)
    assert [frame.number for frame in frames] == list(range(1, 41))
    assert [frame.time_s for frame in frames] == pytest.approx(np.arange(40) / 10, abs=1e-3)
    assert not source.notes and not source.problems
    assert frame_times(source) == pytest.approx({frame.number: frame.time_s for frame in frames})


def test_a_missing_stamp_of_a_varying_rate_lies_between_its_neighbours(tmp_path, monkeypatch):
    source = open_source(write_video(tmp_path / "clip.avi", "MJPG"))
    script = [0, 1.3, 2.1, 4.4, math.nan, 5.3, math.nan, None, 7.9]
    for name, value in (("count", None), ("_open", lambda: ScriptedCapture(script))):
        monkeypatch.setattr(source, name, value)
    frames = {frame.number: frame.time_s for frame in source}
    assert frames == pytest.approx({1: 0, 2: 0.13, 3: 0.21, 4: 0.44, 5: 0.52, 6: 0.53, 7: 0.61, 9: 0.79}, abs=2e-3)


@pytest.mark.parametrize(
    ("rate", "stamps", "hz"),
    [
        (10, np.arange(30) * 40, 25.0),
        (10, np.round(np.arange(30) * 1000 / 30), 30.0),  # stamps in whole milliseconds
        (10, np.arange(30) * 40 + 3000 * (np.arange(30) > 20), 25.0),
        (10, np.arange(30) * 100, 10.0),
    ],
)
def test_a_rate_that_the_time_stamps_contradict_is_measured(tmp_path, rate, stamps, hz):
    source = open_source(write_by_av(tmp_path / "clip.mkv", "mjpeg", stamps.astype(int).tolist()))
    assert source.rate_hz == pytest.approx(hz, rel=0.005)


@pytest.mark.parametrize(("codec", "ending"), [("libx264", "mp4"), ("mpeg4", "avi"), ("libx264", "ts")])
def test_frames_in_which_errors_were_concealed_are_counted_and_what_builds_on_them_is_damaged(tmp_path, codec, ending):
    stamps, size = list(range(0, 4000, 100)), (320, 240)
    path = write_by_av(tmp_path / f"clip.{ending}", codec, stamps, size, textured, g="10", bf="0")
    assert open_source(path).concealed == 0  # type: ignore[attr-defined]
    data, rng = bytearray(path.read_bytes()), np.random.default_rng(0)
    if ending == "ts":
        packets = [data[k : k + 188] for k in range(0, len(data), 188)]
        lost = rng.integers(len(packets) // 3, len(packets) * 2 // 3, 4).tolist()
        data = bytearray(b"".join(packet for k, packet in enumerate(packets) if k not in lost))
    else:
        for place in rng.integers(len(data) // 4, len(data) * 3 // 4, 12).tolist():
            data[place] ^= 255
    path.write_bytes(bytes(data))
    source = open_source(path)
    frames = list(source)
    damaged = [frame.number for frame in frames if frame.damaged]
    assert 0 < source.concealed <= len(damaged) < len(frames)  # type: ignore[attr-defined]
    assert any("the decoder concealed errors in frame" in str(problem) for problem in source.problems)
    assert not frames[0].damaged


def test_the_times_of_frames_are_known_without_reading_pictures(tmp_path):
    stamps = np.cumsum(np.random.default_rng(0).integers(60, 180, 30))
    source = open_source(write_by_av(tmp_path / "clip.mkv", "libx264", stamps.tolist(), bf="2"))
    assert frame_times(source) == pytest.approx({frame.number: frame.time_s for frame in source})
    assert frame_times(open_source(write_images(tmp_path / "images"))) == {}


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

    def read(self) -> tuple[bool, np.ndarray]:
        return self.grab(), picture(1)

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
@pytest.mark.parametrize("is_live", [False, True])
def test_frames_are_numbered_by_stamps_where_these_can_be_believed(
    avi, monkeypatch, script, numbers, problems, is_live
):
    source = open_source(avi)
    for name, value in (("count", None), ("_open", lambda: ScriptedCapture(script)), ("_live", is_live)):
        monkeypatch.setattr(source, name, value)
    frames = list(source)
    if is_live:  # a stream is numbered by counting reads, failed ones included
        assert [frame.number for frame in frames] == [k for k, stamp in enumerate(script, 1) if stamp is not None]
        assert len(source.problems) == script.count(None)
    else:
        assert [frame.number for frame in frames] == numbers
        assert len(source.problems) == len(problems)
        assert all(words in str(problem) for problem, words in zip(source.problems, problems, strict=True))
    times = [frame.time_s for frame in frames]
    assert times == sorted(set(times))


# -- Images ------------------------------------------------------------------------------------------------------------


def test_images_come_in_natural_order_and_only_those_that_are_wanted_are_opened(tmp_path):
    source = open_source(write_images(tmp_path, range(1, 13)), rate_hz=4)
    frames = list(source)
    assert source.count == 12 and open_source(tmp_path).rate_hz == 10
    assert [(f.number, number_of(f.image), f.time_s) for f in frames] == [(n, n, (n - 1) / 4) for n in range(1, 13)]
    (tmp_path / "frame5.png").unlink()
    assert [(frame.number, number_of(frame.image)) for frame in source.every(5)] == [(1, 1), (6, 6), (11, 11)]
    assert (source.last, source.problems, source.exact) == (12, [], True)


def test_what_is_no_image_is_passed_over_and_a_glob_takes_what_it_matches(tmp_path):
    write_images(tmp_path, range(1, 21))
    (tmp_path / "notes.txt").write_text("not a frame")
    (tmp_path / "._frame1.png").write_bytes(b"hidden")
    (tmp_path / "old.png").mkdir()
    assert len(list(open_source(tmp_path))) == 20
    frames = list(open_source(str(tmp_path / "frame1?.png")))
    assert [(frame.number, number_of(frame.image)) for frame in frames] == [(n, n + 9) for n in range(1, 11)]


@pytest.mark.parametrize(
    ("make", "shape"),
    [
        (lambda image: image[..., 0], (48, 64)),
        (lambda image: image, (48, 64, 3)),
        (lambda image: np.dstack([image, image[..., 0]]), (48, 64, 3)),
        (lambda image: image[:47, :63], (47, 63, 3)),
    ],
    ids=["grey", "colour", "alpha", "odd size"],
)
def test_pixels_are_those_of_the_file_without_alpha(tmp_path, make, shape):
    written = make(picture(7))
    save(tmp_path / "a.png", written)
    (frame,) = open_source(tmp_path)
    assert frame.image.shape == shape
    np.testing.assert_array_equal(frame.image, written[..., :3] if written.ndim == 3 else written)


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_sixteen_bit_files_are_scaled_by_the_sensor_that_holds_their_brightest_pixel(tmp_path, bits):
    top = 2**bits - 1
    ramp = np.linspace(0, 0.6, 64 * 48).reshape(48, 64)
    for k, gain in enumerate((1.0, 1.6), 1):
        save(tmp_path / f"{k}.png", (ramp * gain * top).astype(np.uint16))
    first, second = (frame.image for frame in open_source(tmp_path))
    assert first.dtype == np.uint8
    np.testing.assert_allclose(first, ramp * 255, atol=1)
    np.testing.assert_allclose(second, ramp * 1.6 * 255, atol=1)  # one factor for the clip: no flicker


def test_a_given_scale_saturates_what_is_above_it_and_says_so_once(tmp_path):
    save(tmp_path / "colour" / "1.png", picture(7).astype(np.uint16) * 16)
    (frame,) = open_source(tmp_path / "colour", full_scale=255 * 16)
    np.testing.assert_array_equal(frame.image, picture(7))
    for number in range(1, 4):
        save(tmp_path / "grey" / f"{number}.png", np.full((48, 64), 1000 * number, np.uint16))
    source = open_source(tmp_path / "grey", full_scale=1500)
    assert [int(frame.image.max()) for frame in source] == [170, 255, 255]
    assert [problem.frame for problem in source.problems] == [2]


def thermal(levels: int = 120) -> list[np.ndarray]:
    """Twelve 8-bit pictures whose values fill less than the range, as a camera stretches a scene of few degrees."""
    ground = np.random.default_rng(0).normal(130, levels / 8, (96, 128))
    still = np.clip(cv2.GaussianBlur(ground, (3, 3), 0.7), 130 - levels / 2, 130 + levels / 2)
    films = np.tile(still, (12, 1, 1))
    for k, film in enumerate(films):
        film[40:52, 4 + 8 * k : 10 + 8 * k] = 130 + levels / 2
    return list(films.round().astype(int))


def stored(folder: Path, images: list[np.ndarray]) -> Path:
    for k, image in enumerate(images):
        save(folder / f"{k:02d}.png", np.clip(image, 0, 65535).astype(np.uint16))
    return folder


def stated(source: Any) -> str:
    return str(source.levels)


def spoiled(image: np.ndarray, k: int) -> np.ndarray:
    image = image * 5 + 29315
    image[3 * k, 7], image[5, 9], image[60, 61] = 65535, 0, 65535
    return image


@pytest.mark.parametrize(
    "store",
    [
        lambda image, k: image,
        lambda image, k: image * 257,
        lambda image, k: image * 16,
        lambda image, k: image * 5 + 29315,
        lambda image, k: image * 64 + 2000,
        lambda image, k: image * 4 + 7000 + 40 * k,  # the sensor warms up
        lambda image, k: image * 5 + 29315 + 900 * (k > 5),  # and calibrates itself
        lambda image, k: np.full_like(image, 9000) if k == 7 else image * 3 + 9000,  # behind its shutter
        spoiled,
    ],
    ids=["plain", "x257", "12 bits", "thermal", "14 bits", "drift", "jump", "shutter", "bad pixels"],
)
def test_what_a_thermal_camera_stores_in_16_bits_is_read_as_its_8_bit_picture(tmp_path, store):
    images = thermal()
    source = open_source(stored(tmp_path, [store(image, k) for k, image in enumerate(images)]))
    apart = [frame.image.astype(int) - image for frame, image in zip(source, images, strict=True)]
    offset = [float(np.median(difference)) for difference in apart]
    same = [(a == o).mean() for a, o in zip(apart, offset, strict=True)]
    assert min([*same[:7], *same[8:]]) > 0.999
    assert {problem.frame for problem in source.problems} <= {8}


@pytest.mark.parametrize(
    ("rows", "columns", "value"),
    [(6, 0, 0), (0, 16, 0), (0, 45, 0), (0, 16, 65535), (0, 16, "warm"), (6, 16, "both")],
)
@pytest.mark.parametrize("gain", [5, 7])
def test_bars_and_the_sun_take_nothing_from_the_range_of_the_scene(tmp_path, rows, columns, value, gain):
    rng, images = np.random.default_rng(2), thermal()
    filled = [image * gain + 29311 + rng.integers(0, gain - 4, image.shape) for image in images]
    for k, image in enumerate(filled):
        for part in (image[:rows], image[96 - rows :], image[:, :columns], image[:, 128 - columns :]):
            part[:] = 60000 + rng.integers(0, 50, part.shape) if value == "warm" else 0 if value == "both" else value
        if value == "both":
            image[:, :20] = 65535 - k
    scene = np.s_[rows : 96 - rows, max(32, columns) : 128 - max(32, columns)]
    bare = open_source(stored(tmp_path, filled))
    found = [frame.image[scene] for frame in bare]
    assert bare.problems == []
    for k, image in enumerate(found):
        contrast = np.ptp(np.percentile(image, [5, 95])) / np.ptp(np.percentile(images[k][scene], [5, 95]))
        low, high = np.percentile(image[:30], [1, 99])
        assert contrast > 0.99 and low > 0 and high < 255, (k, contrast)


def test_the_few_counts_of_a_dull_scene_fill_most_of_the_range(tmp_path):
    (first, *_), (image, *_) = open_source(stored(tmp_path, [image + 29000 for image in thermal()])), thermal()
    assert np.unique(first.image[:30] - 3 * image[:30].astype(np.uint8)).size == 1  # exactly, and brighter than before
    assert first.image[40:52].max() == 255


@pytest.mark.parametrize("drift", [0, -13, 300])
def test_the_range_of_many_values_is_that_of_most_pixels_and_follows_a_drift(tmp_path, drift):
    rng = np.random.default_rng(1)
    images = [image * 7 + rng.integers(0, 7, image.shape) + 20000 + drift * k for k, image in enumerate(thermal())]
    for image in images:
        image[:10, :10] = 60000  # the sun, on a hundredth of the picture
    source = open_source(stored(tmp_path, images))
    first, *others = [frame.image for frame in source]
    low, high = np.percentile(first, [5, 95])
    assert high - low == pytest.approx(255 / 2.5, rel=0.1)  # as much contrast as a thermal camera's own 8 bits
    for image in others:
        assert 10 < np.percentile(image, 5) < np.percentile(image, 95) < 245
        assert image[40:52].max() > np.percentile(image, 95) + 10  # the target stands out
        assert np.ptp(image[20:30].astype(float)) == pytest.approx(np.ptp(first[20:30].astype(float)), abs=12)
    assert "taken from the clip" in stated(source) and source.problems == []


def test_a_given_range_holds_for_the_whole_clip_and_the_range_is_stated(tmp_path):
    images = [image * 5 + 29315 for image in thermal()]
    source = open_source(stored(tmp_path, images), full_scale=(29315, 30590))
    for frame, image in zip(source, thermal(), strict=True):
        np.testing.assert_array_equal(frame.image, image)
    assert "values from 29315 to 30590" in stated(source)
    assert stated(open_source(write_images(tmp_path / "bytes"))) == "None"
    for scale in ((5, 5), (9, 5), (0, 70000), (-1, 5)):
        with pytest.raises(InputError, match="black below white"):
            open_source(tmp_path, full_scale=scale)


@pytest.mark.parametrize(("form", "bits"), [("gray16le", 16), ("gray12le", 12)])
def test_grey_videos_of_more_than_8_bits_are_read_whole(tmp_path, form, bits):
    av, path = pytest.importorskip("av"), tmp_path / "clip.mkv"
    with av.open(str(path), "w") as file:
        stream = file.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 128, 96, form
        for k, image in enumerate(thermal()):
            frame = av.VideoFrame.from_ndarray((image * 5 + 29315).astype(np.uint16), format="gray16le")
            frame = frame.reformat(format=form)
            frame.pts = k
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    source = open_source(path)
    for _ in range(2):
        frames = list(source)
        assert len(frames) == 12 and frames[0].image.shape == (96, 128, 3)
        if bits == 16:
            levels = np.array([frame.image[..., 0] for frame in frames], int)
            assert len(np.unique(levels - thermal())) == 1
        assert source.problems == []


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_exif_rotation_is_honoured(tmp_path, suffix):
    exif = Image.Exif()
    exif[0x0112] = 6  # turn clockwise to show
    image = picture(20)
    Image.fromarray(image[..., ::-1].copy()).save(tmp_path / f"a{suffix}", exif=exif)
    source = open_source(tmp_path)
    (frame,) = source
    assert source.size == (48, 64)
    assert np.abs(frame.image.astype(int) - cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE)).mean() < 8


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp"])
@pytest.mark.parametrize("keep", [0, 40, 0.95])
def test_a_damaged_image_is_left_out_and_the_others_keep_their_numbers(tmp_path, suffix, keep):
    write_images(tmp_path, range(1, 6), suffix)
    damaged = tmp_path / f"frame3{suffix}"
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[: int(keep * len(whole)) if keep < 1 else int(keep)])
    source = open_source(tmp_path)
    assert [frame.number for frame in source] == [1, 2, 4, 5] and source.last == source.count
    (problem,) = source.problems
    assert problem.frame == 3 and damaged.name in str(problem)


def test_the_first_image_decides_on_colour_size_and_depth(tmp_path):
    write_images(tmp_path, range(1, 3))
    save(tmp_path / "frame3.png", picture(3)[..., 0])
    assert [frame.image.shape for frame in open_source(tmp_path)] == [(48, 64, 3)] * 3
    for odd, words in (
        (picture(4, 32, 24), "is 32x24 but frame1.png is 64x48"),
        (picture(4).astype(np.uint16), "uint16"),
    ):
        save(tmp_path / "frame4.png", odd)
        with pytest.raises(InputError, match=rf"frame4\.png .*{words}"):
            list(open_source(tmp_path))
        source = open_source(tmp_path)
        source.tolerant = True  # type: ignore[attr-defined]
        assert [frame.number for frame in source] == [1, 2, 3] and "left out" in str(source.problems[0])


def test_what_is_no_clip_gets_one_line_that_says_what_to_do(tmp_path):
    for name in ("empty", "outer", "films"):
        (tmp_path / name).mkdir()
    frames = write_images(tmp_path / "outer" / "frames")
    film = write_video(tmp_path / "films" / "clip.avi", "MJPG", frames=2)
    save(tmp_path / "floats" / "1.tiff", picture(1).astype(np.float32))
    save(tmp_path / "broken" / "1.png", picture(1))
    (tmp_path / "broken" / "1.png").write_bytes(b"nothing")
    mistakes = {
        "absent": "does not exist",
        "empty": "holds no images",
        "outer": f"did you mean {frames}?",
        "films": f"did you mean {film}?",
        "broken": "the first image",
        "floats": "float32",
        "*.png": "no image matches",
        "films/*": "1 other files",
        "outer/frames/frame1.png": "one image",
    }
    for spec, words in mistakes.items():
        with pytest.raises(InputError) as error:
            open_source(f"{tmp_path}/{spec}")
        assert words in str(error.value)
    with pytest.raises(InputError, match="name is empty"):
        open_source("")
    for rate_hz, full_scale in ((0, None), (-1, None), (float("nan"), None), (None, 0)):
        with pytest.raises(InputError, match="must be"):
            open_source(frames, rate_hz=rate_hz, full_scale=full_scale)


def test_a_single_image_is_a_clip_of_one_frame_where_that_is_asked_for(tmp_path):
    file = write_images(tmp_path, range(1, 4)) / "frame2.png"
    source = open_source(file, single=True)
    (frame,) = source
    assert (source.count, source.exact, source.last, frame.number, number_of(frame.image)) == (1, True, 1, 1, 2)
    assert source.name == str(file)
