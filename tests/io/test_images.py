"""Folders and globs: order, depth, orientation, and one clear line for what cannot be used."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.io.clips import number_of, picture, write_images, write_video
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.sources import open_source


def save(path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path), image)


def test_images_come_in_natural_order_with_the_given_rate(tmp_path: Path) -> None:
    source = open_source(write_images(tmp_path, range(1, 13)), rate_hz=4)
    frames = list(source)
    assert source.count == 12
    assert [number_of(frame.image) for frame in frames] == list(range(1, 13))
    assert [frame.number for frame in frames] == list(range(1, 13))
    assert frames[-1].time_s == pytest.approx(11 / 4)
    assert open_source(tmp_path).rate_hz == 10


def test_every_so_many_images_open_no_other_file(tmp_path: Path) -> None:
    source = open_source(write_images(tmp_path, range(1, 13)))
    (tmp_path / "frame5.png").unlink()
    assert [(frame.number, number_of(frame.image)) for frame in source.every(5)] == [(1, 1), (6, 6), (11, 11)]
    assert (source.last, source.problems, source.exact) == (12, [], True)


def test_a_folder_is_read_past_what_is_no_image(tmp_path: Path) -> None:
    write_images(tmp_path, range(1, 4))
    (tmp_path / "notes.txt").write_text("not a frame")
    (tmp_path / "._frame1.png").write_bytes(b"hidden")
    (tmp_path / "old.png").mkdir()
    assert len(list(open_source(tmp_path))) == 3


def test_a_glob_takes_only_what_it_matches(tmp_path: Path) -> None:
    write_images(tmp_path, range(1, 21))
    frames = list(open_source(str(tmp_path / "frame1?.png")))
    assert [number_of(frame.image) for frame in frames] == list(range(10, 20))
    assert [frame.number for frame in frames] == list(range(1, 11))


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
def test_pixels_are_those_of_the_file_without_alpha(tmp_path: Path, make, shape: tuple[int, ...]) -> None:
    written = make(picture(7))
    save(tmp_path / "a.png", written)
    (frame,) = open_source(tmp_path)
    assert frame.image.shape == shape
    np.testing.assert_array_equal(frame.image, written[..., :3] if written.ndim == 3 else written)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_sixteen_bit_files_are_scaled_by_the_sensor_that_holds_their_brightest_pixel(tmp_path: Path, bits: int) -> None:
    top = 2**bits - 1
    ramp = np.linspace(0, 0.6, 64 * 48).reshape(48, 64)
    save(tmp_path / "1.png", (ramp * top).astype(np.uint16))
    save(tmp_path / "2.png", (ramp * 1.6 * top).astype(np.uint16))
    first, second = (frame.image for frame in open_source(tmp_path))
    assert first.dtype == np.uint8
    np.testing.assert_allclose(first, ramp * 255, atol=1)
    np.testing.assert_allclose(second, ramp * 1.6 * 255, atol=1)  # one factor for the clip: no flicker


def test_sixteen_bit_colour_and_a_given_full_scale(tmp_path: Path) -> None:
    save(tmp_path / "1.png", picture(7).astype(np.uint16) * 16)
    (frame,) = open_source(tmp_path, full_scale=255 * 16)
    np.testing.assert_array_equal(frame.image, picture(7))


def test_a_pixel_above_the_scale_saturates_and_is_reported_once(tmp_path: Path) -> None:
    for number in range(1, 4):
        save(tmp_path / f"{number}.png", np.full((48, 64), 1000 * number, np.uint16))
    source = open_source(tmp_path, full_scale=1500)
    assert [int(frame.image.max()) for frame in source] == [170, 255, 255]
    assert [problem.frame for problem in source.problems] == [2]


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_exif_rotation_is_honoured(tmp_path: Path, suffix: str) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # turn clockwise to show
    image = picture(20)
    Image.fromarray(image[..., ::-1].copy()).save(tmp_path / f"a{suffix}", exif=exif)
    source = open_source(tmp_path)
    (frame,) = source
    assert source.size == (48, 64)
    assert np.abs(frame.image.astype(int) - cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE)).mean() < 8


def test_the_first_image_decides_between_grey_and_colour(tmp_path: Path) -> None:
    save(tmp_path / "1.png", picture(1))
    save(tmp_path / "2.png", picture(2)[..., 0])
    assert [frame.image.shape for frame in open_source(tmp_path)] == [(48, 64, 3)] * 2


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp"])
@pytest.mark.parametrize("keep", [0, 40, 0.5, 0.95])
def test_a_damaged_image_is_left_out_and_the_others_keep_their_numbers(
    tmp_path: Path, suffix: str, keep: float
) -> None:
    write_images(tmp_path, range(1, 6), suffix)
    damaged = tmp_path / f"frame3{suffix}"
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[: int(keep * len(whole)) if keep < 1 else int(keep)])
    source = open_source(tmp_path)
    assert [frame.number for frame in source] == [1, 2, 4, 5]
    assert [problem.frame for problem in source.problems] == [3]
    assert source.last == source.count
    assert damaged.name in str(source.problems[0])


def test_an_image_of_another_size_stops_the_clip_and_names_file_and_sizes(tmp_path: Path) -> None:
    write_images(tmp_path, range(1, 4))
    save(tmp_path / "frame4.png", picture(4, 32, 24))
    with pytest.raises(InputError, match=r"frame4\.png is 32x24 but frame1\.png is 64x48"):
        list(open_source(tmp_path))


def test_an_image_of_another_depth_stops_the_clip(tmp_path: Path) -> None:
    write_images(tmp_path, range(1, 3))
    save(tmp_path / "frame3.png", picture(3).astype(np.uint16))
    with pytest.raises(InputError, match=r"frame3\.png holds uint16 pixels but frame1\.png uint8"):
        list(open_source(tmp_path))


def test_what_is_no_clip_gets_one_line_that_says_what_to_do(tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    outer = tmp_path / "outer"
    outer.mkdir()
    write_images(outer / "frames")
    films = tmp_path / "films"
    films.mkdir()
    write_video(films / "clip.avi", "MJPG", frames=2)
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "1.png").write_bytes(b"nothing")
    floats = tmp_path / "floats"
    floats.mkdir()
    save(floats / "1.tiff", picture(1).astype(np.float32))
    mistakes: list[tuple[str | Path, str]] = [
        (tmp_path / "absent", "does not exist"),
        ("", "name is empty"),
        (empty, "holds no images"),
        (outer, f"did you mean {outer / 'frames'}?"),
        (films, f"did you mean {films / 'clip.avi'}?"),
        (broken, "the first image"),
        (floats, "float32"),
        (f"{tmp_path}/*.png", "no image matches"),
        (f"{films}/*", "1 other files"),
        (outer / "frames" / "frame1.png", "one image"),
    ]
    for spec, wanted in mistakes:
        with pytest.raises(InputError) as error:
            open_source(spec)
        assert wanted in str(error.value)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("options", [{"rate_hz": 0}, {"rate_hz": -1}, {"rate_hz": float("nan")}, {"full_scale": 0}])
def test_an_impossible_rate_or_scale_is_refused(tmp_path: Path, options: dict) -> None:
    with pytest.raises(InputError, match="must be"):
        open_source(write_images(tmp_path), **options)


def test_a_single_image_is_a_clip_of_one_frame_where_that_is_asked_for(tmp_path: Path) -> None:
    file = write_images(tmp_path, range(1, 4)) / "frame2.png"
    source = open_source(file, single=True)
    (frame,) = source
    assert (source.count, source.exact, source.last, frame.number, number_of(frame.image)) == (1, True, 1, 1, 2)
    assert source.name == str(file)
