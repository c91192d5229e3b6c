"""Pictures of a stream come as they were sent, also where their size changes; what is no stream is one line."""

import sys

import numpy as np
import pytest

from tests.io.clips import number_of, picture, write_by_av, write_images, write_video
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.captures import AvCapture, open_by_opencv
from torchvision_dddas.io.live_streams import OpenedStream, first_picture, open_stream

LIMITS_S = (5.0, 5.0)
STAMPS_MS = list(range(0, 600, 100))


def pictures(stream):
    found = []
    while stream.grab():
        image = stream.retrieve()
        assert image is not None
        found.append(image)
    stream.release()
    return found


def test_both_drivers_give_the_same_pictures(tmp_path):
    film = write_video(tmp_path / "film.avi", "MJPG")
    by_av, by_opencv = (OpenedStream(opens(str(film), "film")) for opens in (AvCapture, open_by_opencv))
    assert by_av.rate_hz == pytest.approx(by_opencv.rate_hz)
    ours, theirs = pictures(by_av), pictures(by_opencv)
    assert [number_of(image) for image in ours] == [number_of(image) for image in theirs] != []
    assert all(np.abs(one.astype(int) - other).mean() < 3 for one, other in zip(ours, theirs, strict=True))


def test_a_stream_that_changes_its_size_gives_pictures_of_both_sizes(tmp_path):
    films = [
        write_by_av(tmp_path / f"{at}.ts", "libx264", STAMPS_MS, size) for at, size in enumerate([(64, 48), (96, 48)])
    ]
    joined = tmp_path / "joined.ts"
    joined.write_bytes(b"".join(film.read_bytes() for film in films))
    assert {image.shape[:2] for image in pictures(open_stream(str(joined), "joined", LIMITS_S))} == {(48, 64), (48, 96)}


def test_an_address_is_not_read_by_opencv_which_squeezes_pictures_of_another_size(monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"rtsp://127.0.0.1:9/live needs PyAV: pip install"):
        open_stream("rtsp://127.0.0.1:9/live", "rtsp://127.0.0.1:9/live", LIMITS_S)


def test_damage_costs_pictures_and_not_the_stream(tmp_path):
    film = write_by_av(tmp_path / "film.ts", "libx264", STAMPS_MS)
    data = bytearray(film.read_bytes())
    data[len(data) // 2 :][:188] = bytes(188)
    film.write_bytes(bytes(data[: len(data) // 2]) + bytes(400) + bytes(data[len(data) // 2 + 400 :]))
    assert 1 <= len(pictures(OpenedStream(AvCapture(str(film), "film", LIMITS_S)))) <= len(STAMPS_MS)


@pytest.mark.parametrize("without_av", [False, True])
def test_what_is_no_stream_is_one_line(tmp_path, monkeypatch, without_av):
    if without_av:
        monkeypatch.setitem(sys.modules, "av", None)
    (tmp_path / "text.txt").write_text("no film\n" * 100)
    (tmp_path / "noise.ts").write_bytes(np.random.default_rng(0).bytes(4000))
    for name in ("absent.ts", "text.txt", "noise.ts"):
        with pytest.raises(InputError) as error:
            first_picture(open_stream(str(tmp_path / name), name, LIMITS_S), name)
        assert name in str(error.value)


def test_options_of_ffmpeg_are_read_as_opencv_reads_them(tmp_path, monkeypatch):
    folder = write_images(tmp_path / "images", range(7, 10))
    monkeypatch.setenv("OPENCV_FFMPEG_CAPTURE_OPTIONS", "start_number;8|framerate;5")
    stream = open_stream(str(folder / "frame%d.png"), "images", LIMITS_S)
    assert stream.rate_hz == 5.0
    assert np.array_equal(first_picture(stream, "images"), picture(8))
    stream.release()
