"""Files made to keep a reader busy: each costs time in proportion to its length, whatever it holds."""

import io
import signal
import struct
import subprocess
import sys
import tracemalloc
import zipfile
import zlib
from functools import partial

import cv2
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from tests.io.flights import packet, sentence, ulog
from torchvision_dddas.cli import app
from torchvision_dddas.config import read_toml
from torchvision_dddas.errors import InputError
from torchvision_dddas.io import detection_tables
from torchvision_dddas.io.camera_files import read_poses
from torchvision_dddas.io.ground_tables import read_landmarks, read_positions
from torchvision_dddas.io.images import decode_image, read_image, size_in_header
from torchvision_dddas.io.sources import ImageSource, VideoSource
from torchvision_dddas.io.tables import read_csv
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.io.telemetry.misb import KEY, local_sets
from torchvision_dddas.lab.evaluation.evaluate import Result, load_result
from torchvision_dddas.lab.evaluation.metrics.truth import TrackTable, load_truth, read_mask, read_seqinfo
from torchvision_dddas.memory import check_memory
from torchvision_dddas.people.classifiers import read_classifier

SECONDS = 15.0
"""Processor time after which a reader counts as hung: it needs about a second, and needed minutes."""

SUBTITLES = (
    "1\n00:00:00,000 --> 00:00:01,000\nGPS (1,2,3) H:5m {}\n\n"
    "2\n00:00:01,000 --> 00:00:02,000\nGPS (1,2,3) H:5m\n\n3\n00:00:02,000 --> 00:00:03,000\nGPS (1,2,3) H:5m\n"
)
RMC = "GPRMC,12003{},A,4807.0380,N,01131.0000,W,10.0,084.4,230394,003.1,W"


@pytest.fixture(autouse=True)
def hang_ends():
    """Raise TimeoutError where a test takes more than SECONDS of processor time."""

    def stop(*_):
        raise TimeoutError(f"more than {SECONDS} s of processor time")

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
    yield
    signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    signal.signal(signal.SIGVTALRM, before)


def mavlink(magic, period):
    """A log of four messages, before the last of which lie megabytes of beginnings of messages."""
    dialect = pytest.importorskip("pymavlink.dialects.v20.all")

    def message(second):
        place = dialect.MAVLink_global_position_int_message(second * 1000, 10**8, 10**8, 5000, 5000, 0, 0, 0, 0)
        return struct.pack(">Q", 1_700_000_000_000_000 + second * 10**6) + place.pack(
            dialect.MAVLink(None), force_mavlink1=True
        )

    rest = magic.ljust(period, b"\x01") * ((6_000_000 if period > len(magic) else 1_000_000) // period)
    return message(0) + message(1) + message(2) + rest + b"\0" * 300 + message(3) + b"\0" * 9


def px4(rubbish):
    """A log of 40 messages with megabytes of rubbish among them."""
    pytest.importorskip("pyulog")
    fields, rows = ("double lat", "double lon", "float alt"), [(i * 100_000, 63.4, 10.4, 60 + i) for i in range(40)]
    content = ulog({"vehicle_global_position": (fields, rows)})
    half = len(content) - 20 * 33  # messages of 3 + 2 + 28 bytes
    return content[:half] + rubbish * (5_000_000 // len(rubbish)) + content[half:]


def programme_tables():
    header = b"\x02\xb0\xb0\0\x01\xc1\0\0\xe1\x01\xf0\0"
    table = b"G\x41\x00\x10\x00" + header + b"\x1b\xe1\x01\xf0\0" * 34 + b"\0"
    return b"G\x40\x00\x10\x00" + b"\0\xb0\x0d\0\x01\xc1\0\0\0\x01\xe1\0" + b"\0" * 171 + table * 12_000


def timed(clock, digits):
    return "time,latitude,longitude,altitude\n" + f"{clock.format('9' * digits)},48,11,50\n" * 2


TIMELESS = "Latitude: 1.5 Longitude: 2.5\n\n" * 40_000
WORDS = ("a" * 60_000 + " " * 60_000, "a." * 60_000, "<" * 120_000, "a:" + " " * 120_000, "a(" * 60_000, "-" * 120_000)
NAMES = ("(" * 120_000, "a" + " " * 120_000 + "b", "[ " * 60_000, "(" * 60_000 + "m")
SENTENCES = ("$GPGGA," + " " * 100_000 + "*X\n", "$GPGGA," + " *" * 50_000 + "\n")
CLOCKS = ("{}:00:00", "00:{}:00", "00:00:{}", "{}", "2024-01-01 {}:00:00")
# The file's name, its content, how many samples it has, 0 where it is refused, and what is said.
LOGS = [
    *(("a.srt", SUBTITLES.format(word), 3, "") for word in WORDS),
    ("b.srt", "GPS (1,2,3)\n\n" + TIMELESS, 0, "nothing in it"),
    ("c.srt", f"2024-01-01 00:00:00\nGPS (1,2,3) H:5m\n\n{TIMELESS}", 1, "without time is left out, 40000 in all"),
    *(
        ("a.nmea", line.join(f"{sentence(RMC.format(k))}\n" for k in range(3)), 3, "line 2: sentences are left out")
        for line in SENTENCES
    ),
    *(("a.csv", f"latitude [deg],longitude,time (ms),{n}\n1,2,0,\n1,2,1000,\n1,2,2000,\n", 3, "") for n in NAMES),
    # More digits than a float holds, and than Python makes a number of.
    *(
        ("a.csv", timed(clock, n), 0, "is not a time; wanted a date with a time")
        for clock in CLOCKS
        for n in (400, 5000)
    ),
    ("a.csv", "height,seconds" + ",a" * 150_000 + "\n" + "".join(f"1,{k}\n" for k in range(150_000)), 150_000, ""),
    ("a.ts", programme_tables, 0, "carries no KLV metadata; its streams are of the types 0x1b"),
    *(("a.tlog", partial(mavlink, *given), 4, "are not MAVLink messages") for given in ((b"\xfe", 12), (b"\xfd", 12))),
    ("a.tlog", partial(mavlink, b"\xfe\x81", 2), 4, "are not MAVLink messages"),
    *(("a.ulg", partial(px4, rubbish), 40, "the log is damaged") for rubbish in (b"\xff", b"a.", b"0")),
]


@pytest.mark.parametrize(("name", "content", "samples", "words"), LOGS, ids=range(len(LOGS)))
def test_a_log_made_to_keep_a_reader_busy_is_read_on_or_refused_in_seconds(tmp_path, name, content, samples, words):
    content = content() if callable(content) else content
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    try:
        found = read_telemetry(tmp_path / name)
    except InputError as error:
        count, said = 0, [str(error)]
    else:
        count, said = len(found.time_s), [*found.notes]
    assert count == samples and sum(words in text for text in said) == (1 if words else len(said)), said


def nested(count, length, tail=b""):
    """Sets of which each lies in the one before, up to the longest that may be."""
    whole = count * 20 + len(tail)
    lengths = (min(whole - 20 * (k + 1), length) for k in range(count))
    return b"".join(KEY + b"\x83" + size.to_bytes(3, "big") for size in lengths) + tail


@pytest.mark.parametrize("tail", [b"", b"\xff" * 30_000, b"\x05\x00" * 15_000])
def test_sets_that_lie_in_each_other_are_found_one_by_one(tail):
    # A length whose bytes are a tag's and its length to the set around it: 117 bytes, to six sets further on.
    found = list(local_sets(nested(10_000, 0x757F, tail) + packet(0, {5: b"\0\1"})))
    assert len(found) > 5000 and sum(one.whole for one in found) == 1
    assert found[-1].whole and found[-1].tags[5] == b"\0\1"


@pytest.mark.parametrize("key", ["a." * 200_000 + "a = 1", "[" + "a . " * 100_000 + "a]", "x = {" + "'a'." * 100_000])
def test_a_key_of_endless_parts_is_refused(tmp_path, key):
    path = tmp_path / "a.toml"
    path.write_text(key + "\n")
    with pytest.raises(InputError, match="not valid TOML: a key has more than 100 dots"):
        read_toml(path)
    path.write_text("about = '" + "." * 300 + "'\nway = [" + "1.5, " * 300 + "2.5]\n")
    assert len(read_toml(path)["way"]) == 301


@pytest.mark.parametrize(
    ("read_places", "text"),
    [(read_positions, "frame,target,east_m,north_m\n1,1,{},2\n"), (read_poses, "frame,east_m,north_m\n1,{},2\n")],
)
def test_a_cell_of_endless_digits_that_is_no_number_is_refused(tmp_path, read_places, text):
    path = tmp_path / "a.csv"
    path.write_text(text.format("1" * 60_000 + "-1"))
    with pytest.raises(InputError, match="line 2: east_m is '111"):
        read_places(path)


def test_blank_lines_of_a_table_take_no_memory(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("a,b\n" + "\n" * 100_000 + "1,2\n" + " , \n" * 100_000)
    tracemalloc.start()
    text = read_csv(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert text == (["a", "b"], [100_002], [["1", "2"]]) and most < 2_000_000


def test_the_bad_lines_of_a_seqinfo_are_not_listed_one_by_one(tmp_path):
    path = tmp_path / "seqinfo.ini"
    path.write_text("[Sequence]\nseqLength=5\n" + "a\n" * 250_000)
    with pytest.raises(InputError, match="500023 characters; wanted at most 16384"):
        read_seqinfo(path)


def test_the_boxes_of_many_frames_are_found_by_frame(tmp_path):
    count = 400_000
    number = np.arange(1, count + 1)
    tracks = TrackTable(number, np.ones(count, np.int64), number[:, None] * np.ones(4))
    result = Result(tmp_path, 0, None, False, "complete", tracks)
    assert all(result.boxes_at(k)[0, 0] == k for k in range(1, count + 1)) and not len(result.boxes_at(count + 1))


def test_lines_are_not_all_filled_up_to_the_longest(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("1,1,1,1,1,1\n" * 2000 + "1,1,1,1,1,1" + ",1" * 40_000 + "\n")
    with pytest.raises(InputError, match=r"line 2001: 40006 columns, over 10 times as many as usual"):
        detection_tables.read_rows(path)
    path.write_text("1,1,1,1,1,1\n1,1,1,1,1,1,0.5,-1,-1,-1\n")
    header, rows = detection_tables.read_rows(path)
    assert len(header) == 10 and [len(row) for row in rows] == [10, 10]


# --------------------------------------------------------------------------------------------------------------------
# Files that announce more than memory should hold.


def announced(suffix, width, height):
    """A small picture whose header says another size."""
    data = cv2.imencode(suffix, np.full((48, 64), 90, np.uint8))[1].tobytes()
    assert size_in_header(data) == (64, 48)
    if suffix == ".png":
        head = data[12:16] + struct.pack(">II", width, height) + data[24:29]
        return data[:12] + head + struct.pack(">I", zlib.crc32(head)) + data[33:]
    if suffix == ".bmp":
        return data[:18] + struct.pack("<ii", width, height) + data[26:]
    if suffix == ".jpg":
        return data.replace(struct.pack(">HH", 48, 64), struct.pack(">HH", height, width), 1)
    if suffix == ".tif":
        for tag, old, new in ((256, 64, width), (257, 48, height)):
            data = data.replace(struct.pack("<HHIHH", tag, 3, 1, old, 0), struct.pack("<HHIHH", tag, 3, 1, new, 0))
        return data
    return data.replace(b"64 48", f"{width} {height}".encode(), 1)


def chunk(kind, data, length=None):
    """A chunk of a PNG, which says another length than it has."""
    size = struct.pack(">I", len(data) if length is None else length)
    return size + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def jpeg2000(width, height, boxes=True):
    """A blank JPEG 2000 of some hundred bytes; without boxes its bare codestream."""
    data = cv2.imencode(".jp2", np.zeros((height, width), np.uint8))[1].tobytes()
    return data if boxes else data[data.index(b"\xff\x4f\xff\x51") :]


def tiff_of_one_tile(width, height, side):
    """A picture's directory alone, whose tile is larger than the picture. Tags of 2 bytes each."""
    tags = {256: width, 257: height, 258: 8, 259: 1, 262: 1, 277: 1, 322: side, 323: side, 324: 8, 325: 1}
    entries = b"".join(struct.pack("<HHIHH", tag, 3, 1, value, 0) for tag, value in tags.items())
    return b"II*\0\x08\0\0\0" + struct.pack("<H", len(tags)) + entries + bytes(4)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".jpg", ".tif", ".pgm"])
def test_a_picture_of_too_many_pixels_is_refused_by_its_header(tmp_path, monkeypatch, suffix):
    path = tmp_path / f"1{suffix}"
    path.write_bytes(announced(suffix, 20_000, 20_000))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    for read_it in (read_image, read_mask, lambda p: ImageSource([p], "clip")):
        with pytest.raises(InputError, match=r"1.* is 20000x20000 pixels; that takes .* MB of memory, wanted at most"):
            read_it(path)


@pytest.mark.parametrize(
    ("content", "width"),
    [
        (jpeg2000(4700, 4700, boxes=False), 4700),
        (jpeg2000(4700, 4700).replace(struct.pack(">II", 4700, 4700), struct.pack(">II", 99, 99), 1), 4700),
        (jpeg2000(99, 99).replace(struct.pack(">II", 99, 99), struct.pack(">II", 4700, 4700), 1), 4700),
        (tiff_of_one_tile(9, 9, 30_000), 30_000),
        (announced(".jpg", 20_000, 20_000).replace(b"\xff\xdb", b"rubbish\xff\xff\xff\xdb", 1), 20_000),
        (announced(".pgm", 20_000, 20_000).replace(b"P5", b"P5" + b" " * 5000 + b"#" * 5000, 1), 20_000),
        (announced(".bmp", 20_000, -20_000), 20_000),
    ],
    ids=[
        "bare codestream",
        "small box",
        "large box",
        "tile",
        "rubbish between segments",
        "long comment",
        "upside down",
    ],
)
def test_the_size_that_counts_is_the_one_that_the_decoder_makes_room_for(monkeypatch, content, width):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(InputError, match=f"a picture is {width}x{width} pixels; that takes"):
        decode_image(content, cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize(
    "content",
    [
        b"P7\nWIDTH 40000\nHEIGHT 40000\nDEPTH 3\nMAXVAL 255\nTUPLTYPE RGB\nENDHDR\n",
        b"PF\n40000 40000\n-1.0\n",
        b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 40000 +X 40000\n",
        struct.pack(">8I", 0x59A66A95, 40_000, 40_000, 24, 0, 1, 0, 0),
        b"\x76\x2f\x31\x01\x02\0\0\0channels",
        b"P5" + b" " * 200_000 + b"x",
        b"\xff\xd8" + b"\xff" * 200_000,
        b"II*\0",
    ],
    ids=["PAM", "PFM", "HDR", "Sun raster", "EXR", "endless blanks", "endless fill bytes", "cut short"],
)
def test_a_picture_whose_size_is_not_known_is_not_decoded(monkeypatch, content):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    assert decode_image(content + bytes(50), cv2.IMREAD_UNCHANGED) is None


@pytest.mark.parametrize("length", [0xFFFFFFF0, 0x7FFFFFF0, 1])
def test_a_png_whose_end_says_a_length_is_not_decoded(monkeypatch, length):
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 1, 1, 8, 2, 0, 0, 0)) + chunk(b"acTL", struct.pack(">II", 2, 0))
    content = b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(bytes(4))) + chunk(b"IEND", b"", length)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    assert decode_image(content, cv2.IMREAD_UNCHANGED) is None


def test_a_large_file_may_take_more_memory_than_a_small_one():
    check_memory(5e9, "a.png is large", 5_000_000)
    with pytest.raises(InputError, match=r"a\.png is large; that takes 5,000 MB of memory, wanted at most 1,100 MB"):
        check_memory(5e9, "a.png is large", 4_999_999)
    with pytest.raises(InputError, match="that takes 7,000 MB of memory, wanted at most 6,000 MB: make it smaller"):
        check_memory(7e9, "a camera is large")


@pytest.mark.parametrize(
    ("count", "each", "taken"),
    [(1, 10, ""), (3, 1_600_000, ""), (12, 1_600_000, ""), (12, 10, r"1,757"), (40, 10, r"1,996")],
    ids=["one photo", "three", "a folder of 19 MB", "twelve that hold nothing", "forty"],
)
def test_photos_of_20_million_pixels_are_read_unless_many_hold_next_to_nothing(
    tmp_path, monkeypatch, count, each, taken
):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: np.zeros((4, 6, 3), np.uint8))
    for k in range(count):
        (tmp_path / f"{k}.jpg").write_bytes(announced(".jpg", 5472, 3648) + bytes(each))
    if not taken:
        assert len(list(ImageSource(sorted(tmp_path.iterdir()), "clip"))) == count
        return
    with pytest.raises(InputError, match=f"that takes {taken} MB of memory, wanted at most 1,100 MB"):
        ImageSource(sorted(tmp_path.iterdir()), "clip")


def test_the_budget_of_memory_can_be_set(tmp_path, monkeypatch):
    path = tmp_path / "1.png"
    path.write_bytes(announced(".png", 200, 100))
    monkeypatch.setenv("DDDAS_MEMORY_MB", "1")
    with pytest.raises(InputError, match="200x100 pixels; that takes 1 MB of memory, wanted at most 1 MB: make it"):
        read_image(path)
    monkeypatch.setenv("DDDAS_MEMORY_MB", "2")
    assert read_image(path) is None  # its header told a lie
    for words in ("many", "0", "9" * 5000):
        monkeypatch.setenv("DDDAS_MEMORY_MB", words)
        with pytest.raises(InputError, match=f"DDDAS_MEMORY_MB is '{words[:4]}"):
            read_image(path)


@pytest.mark.parametrize("suffix", [".avi", ".mp4"])
def test_a_video_of_too_many_pixels_is_refused_before_a_frame_is_read(tmp_path, monkeypatch, suffix):
    path = str(tmp_path / f"a{suffix}")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*("MJPG" if suffix == ".avi" else "mp4v")), 10, (640, 480))
    for _ in range(3):
        writer.write(np.zeros((480, 640, 3), np.uint8))
    writer.release()
    assert VideoSource(path, "a").size == (640, 480)
    monkeypatch.setenv("DDDAS_MEMORY_MB", "30")
    with pytest.raises(InputError, match="a has frames of 640x480 pixels; that takes 31 MB of memory, wanted at most"):
        VideoSource(path, "a")


@pytest.mark.parametrize("suffix", [".webp", ".jp2", ".gif", ".png", ".bmp", ".jpg", ".tif", ".ppm"])
def test_the_size_in_a_header_is_the_pictures(suffix):
    if suffix == ".gif":  # OpenCV writes it from 4.11 on
        Image.new("L", (64, 48), 90).save(written := io.BytesIO(), "GIF")
        data = written.getvalue()
    else:
        data = bytes(cv2.imencode(suffix, np.full((48, 64, 3), 90, np.uint8))[1])
    assert size_in_header(data) == (64, 48)


SVM = "   svmType: C_SVC\n   kernel: {{ type: LINEAR }}\n   support_vectors: {}\n   decision_functions: {}\n"
HOG = "%YAML:1.0\n---\nhog: !!opencv-object-detector-hog\n"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.yml", HOG + "   x: " + "a: " * 100_000),
        ("a.yml", HOG + "   x: " + "-" * 100_000),
        ("a.yml", HOG + "   x: " + "{a: " * 100_000),
        ("a.xml", "<opencv_storage>" + "<a>" * 100_000),
        ("a.json", '{"a":' * 100_000),
        ("a.json", '{"a":' + "[" * 100_000),
    ],
    ids=["yml names", "yml dashes", "yml braces", "xml", "json objects", "json lists"],
)
def test_a_classifier_whose_parts_lie_deep_in_each_other_is_refused_before_opencv_reads_it(tmp_path, name, content):
    path = tmp_path / name
    path.write_text(content)
    # OpenCV ends the process on such a file.
    code = (
        "import sys; from torchvision_dddas.people.classifiers import read_classifier; read_classifier(sys.argv[1], 6)"
    )
    result = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, timeout=60)
    assert result.returncode == 1
    assert "keys, lists and items; wanted at most 10,000" in result.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ("   SVMDetector: [ {} ]\n", "has 300001 numbers; a descriptor of these settings has 3780"),
        ("   winSize: [ {} ]\n   SVMDetector: [ 1. ]\n", "its parts do not fit together"),
        (SVM.format("[ {} ]", "[ { alpha: [ 1 ], rho: 1 } ]"), "has 300,001 support vectors"),
        (SVM.format("[ [ 1 ] ]", "[ { alpha: [ {} ], rho: 1 } ]"), "its parts do not fit together"),
    ],
)
def test_a_classifier_of_too_many_numbers_is_refused_by_their_count(tmp_path, part, words):
    path = tmp_path / "a.yml"
    path.write_text(HOG + part.replace("{}", "1," * 300_000 + "1"))
    with pytest.raises(InputError, match=words):
        read_classifier(path, 3780)


def array(shape, kind="<f8", numbers=b""):
    """An array in NumPy's format, whose header may announce more than follows."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": kind, "fortran_order": False, "shape": shape})
    return file.getvalue() + numbers


def archive(path, **members):
    """An .npz of members by name."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return path


LONG_HEADER = b"\x93NUMPY\2\0\xf0\xff\xff\x7f" + bytes(1000)
ANNOUNCED = "announces 400000 x 1000 numbers; wanted at most 1,000,000"


@pytest.mark.parametrize("kind", [".npy", ".npz"])
@pytest.mark.parametrize(
    ("content", "words"), [(array((400_000, 1000)), ANNOUNCED), (LONG_HEADER, "a header of 2,147,483,632 bytes")]
)
def test_an_array_of_too_many_numbers_is_refused_by_its_header(tmp_path, monkeypatch, kind, content, words):
    path = tmp_path / f"a{kind}"
    if kind == ".npy":
        path.write_bytes(content)
    else:
        archive(path, **{"weights.npy": content})
    monkeypatch.setattr(np.lib.format, "read_array", lambda *_, **__: pytest.fail("it was loaded"))
    with pytest.raises(InputError, match=words):
        read_classifier(path, 3780)


def test_of_an_archive_only_the_arrays_of_a_classifier_are_read(tmp_path):
    others = {f"a{k}.npy": array((900_000,), numbers=bytes(7_200_000)) for k in range(5)}
    others |= {"weights": array((50_000_000,)), "rubbish": bytes(50_000_000)}
    weights = {"weights.npy": array((3,), numbers=np.arange(3.0).tobytes())}
    path = archive(tmp_path / "a.npz", **others, **weights)
    tracemalloc.start()
    assert read_classifier(path, 3).weights.tolist() == [0, 1, 2]
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 5_000_000
    with pytest.raises(InputError, match=r"holds a0, a1, a2, a3, a4; wanted weights \(and bias\)"):
        read_classifier(archive(tmp_path / "b.npz", **others), 3)


def test_a_table_of_too_many_boxes_in_a_frame_is_refused(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("".join(f"{frame},{k + 1},{k},1,1,1,1\n" for frame in (1, 2, 3) for k in range(1001)))
    for read_it in (detection_tables.read_detections, load_truth, load_result):
        with pytest.raises(InputError, match="has 1001 boxes in frame 1; wanted at most 1000 in a frame"):
            read_it(path)
    for read_places, kind in ((read_positions, "target"), (read_landmarks, "landmark")):
        rows = "".join(f"7,{k + 1},{k},1\n" for k in range(1001))
        (tmp_path / "a.csv").write_text(f"frame,{kind},east_m,north_m\n{rows}")
        with pytest.raises(InputError, match=r"has 1001 (places|landmarks) in frame 7; wanted at most 1000 in a frame"):
            read_places(tmp_path / "a.csv")
    result = CliRunner().invoke(app, ["track", "--detections", str(path), "--out", str(tmp_path / "out")])
    assert result.exit_code == 2 and "1001 boxes" in result.output and "Traceback" not in result.output
