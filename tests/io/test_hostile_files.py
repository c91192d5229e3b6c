"""Files made to keep a reader busy: each costs time in proportion to its length, whatever it holds."""

import io
import signal
import struct
import subprocess
import sys
import tracemalloc
import zipfile
import zlib

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.io.flights import packet, sentence, ulog
from torchvision_dddas.cli import app
from torchvision_dddas.config import read_toml
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.evaluate import Result, load_result
from torchvision_dddas.evaluation.metrics.truth import TrackTable, load_truth, read_mask, read_rows, read_seqinfo
from torchvision_dddas.io import detection_tables
from torchvision_dddas.io.ground_tables import read_landmarks, read_positions
from torchvision_dddas.io.images import read_image, size_in_header
from torchvision_dddas.io.sources import ImageSource
from torchvision_dddas.io.tables import read_csv
from torchvision_dddas.io.telemetry import read_telemetry
from torchvision_dddas.io.telemetry.misb import KEY, local_sets
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


def read(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_telemetry(path)


@pytest.mark.parametrize(
    "words",
    ["a" * 60_000 + " " * 60_000, "a." * 60_000, "<" * 120_000, "a:" + " " * 120_000, "a(" * 60_000, "-" * 120_000],
)
def test_subtitles_with_endless_words_are_read(tmp_path, words):
    found = read(tmp_path / "a.srt", SUBTITLES.format(words))
    assert len(found.time_s) == 3 and found.altitude_m[2] == 5


def test_many_subtitles_without_a_time_are_noted_once(tmp_path):
    timeless = "Latitude: 1.5 Longitude: 2.5\n\n" * 40_000
    with pytest.raises(InputError, match="nothing in it"):
        read(tmp_path / "b.srt", "GPS (1,2,3)\n\n" + timeless)
    dated = "2024-01-01 00:00:00\nGPS (1,2,3) H:5m\n\n"
    found = read(tmp_path / "c.srt", dated + timeless)
    assert sum("without time" in note for note in found.notes) == 1
    assert any("line 4: a subtitle without time is left out, 40000 in all" in note for note in found.notes)


@pytest.mark.parametrize("line", ["$GPGGA," + " " * 100_000 + "*X\n", "$GPGGA," + " *" * 50_000 + "\n"])
def test_an_endless_nmea_sentence_is_left_out(tmp_path, line):
    found = read(tmp_path / "a.nmea", line.join(f"{sentence(RMC.format(k))}\n" for k in range(3)))
    assert len(found.time_s) == 3
    assert any("line 2: sentences are left out" in note for note in found.notes)


@pytest.mark.parametrize("name", ["(" * 120_000, "a" + " " * 120_000 + "b", "[ " * 60_000, "(" * 60_000 + "m"])
def test_a_table_with_an_endless_name_is_read(tmp_path, name):
    found = read(tmp_path / "a.csv", f"latitude [deg],longitude,time (ms),{name}\n1,2,0,\n1,2,1000,\n1,2,2000,\n")
    np.testing.assert_allclose(found.time_s, [0, 1, 2])


@pytest.mark.parametrize("clock", ["{}:00:00", "00:{}:00", "00:00:{}", "{}", "2024-01-01 {}:00:00"])
@pytest.mark.parametrize("digits", [400, 5000])  # more than a float holds, and than Python makes a number of
def test_a_time_of_endless_digits_is_refused(tmp_path, clock, digits):
    cells = f"{clock.format('9' * digits)},48,11,50\n"
    with pytest.raises(InputError, match=r"line 2: '.* is no time; wanted a date with a time, or seconds"):
        read(tmp_path / "a.csv", f"time,latitude,longitude,altitude\n{cells}{cells}")


def test_a_table_of_many_columns_and_many_short_rows_is_read(tmp_path):
    rows = "".join(f"1,{k}\n" for k in range(150_000))
    found = read(tmp_path / "a.csv", "height,seconds" + ",a" * 150_000 + "\n" + rows)
    assert len(found.time_s) == 150_000


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


def test_programme_tables_without_end_are_read(tmp_path):
    header = b"\x02\xb0\xb0\0\x01\xc1\0\0\xe1\x01\xf0\0"
    table = b"G\x41\x00\x10\x00" + header + b"\x1b\xe1\x01\xf0\0" * 34 + b"\0"
    start = b"G\x40\x00\x10\x00" + b"\0\xb0\x0d\0\x01\xc1\0\0\0\x01\xe1\0" + b"\0" * 171
    with pytest.raises(InputError, match="carries no KLV metadata; its streams are of the types 0x1b"):
        read(tmp_path / "a.ts", start + table * 12_000)


@pytest.mark.parametrize(("magic", "period"), [(b"\xfe", 12), (b"\xfd", 12), (b"\xfe\x81", 2)])
def test_a_log_full_of_beginnings_of_messages_is_read(tmp_path, magic, period):
    mavlink = pytest.importorskip("pymavlink.dialects.v20.all")
    sender = mavlink.MAVLink(None)

    def message(second):
        place = mavlink.MAVLink_global_position_int_message(second * 1000, 10**8, 10**8, 5000, 5000, 0, 0, 0, 0)
        return struct.pack(">Q", 1_700_000_000_000_000 + second * 10**6) + place.pack(sender, force_mavlink1=True)

    size = 6_000_000 if period > len(magic) else 1_000_000
    rest = magic.ljust(period, b"\x01") * (size // period)
    found = read(
        tmp_path / "a.tlog", message(0) + message(1) + message(2) + rest + b"\0" * 300 + message(3) + b"\0" * 9
    )
    assert len(found.time_s) >= 3 and found.place[0, 0] == pytest.approx(10)
    assert any("are no MAVLink messages" in note for note in found.notes)


@pytest.mark.parametrize("rubbish", [b"\xff", b"a.", b"0"])
def test_a_px4_log_is_read_on_behind_megabytes_of_rubbish(tmp_path, rubbish):
    pytest.importorskip("pyulog")
    fields, rows = ("double lat", "double lon", "float alt"), [(i * 100_000, 63.4, 10.4, 60 + i) for i in range(40)]
    content = ulog({"vehicle_global_position": (fields, rows)})
    half = len(content) - 20 * 33  # messages of 3 + 2 + 28 bytes
    flown = read(tmp_path / "a.ulg", content[:half] + rubbish * (5_000_000 // len(rubbish)) + content[half:])
    np.testing.assert_array_equal(flown.above_sea_m, np.arange(60, 100))
    assert any("the log is damaged" in note for note in flown.notes)


@pytest.mark.parametrize("key", ["a." * 200_000 + "a = 1", "[" + "a . " * 100_000 + "a]", "x = {" + "'a'." * 100_000])
def test_a_key_of_endless_parts_is_refused(tmp_path, key):
    path = tmp_path / "a.toml"
    path.write_text(key + "\n")
    with pytest.raises(InputError, match="not valid TOML: a key has more than 100 dots"):
        read_toml(path)
    path.write_text("about = '" + "." * 300 + "'\nway = [" + "1.5, " * 300 + "2.5]\n")
    assert len(read_toml(path)["way"]) == 301


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


@pytest.mark.parametrize("score", [",0.5", ""])
@pytest.mark.parametrize("separator", [",", " "])
def test_rows_are_the_same_read_fast_and_cell_by_cell(tmp_path, monkeypatch, score, separator):
    path = tmp_path / "a.txt"
    text = "".join(f"{k},2,{k}.25,-1e1,3,4{score}\n\n" for k in range(1, 9)).replace(",", separator)
    path.write_text(text)
    fast = read_rows(path, "truth")
    monkeypatch.setattr("torchvision_dddas.evaluation.metrics.truth._read_fast", lambda lines: None)
    slow = read_rows(path, "truth")
    for one, other in zip((*fast.table, *fast[1:]), (*slow.table, *slow[1:]), strict=True):
        np.testing.assert_array_equal(one, other)
    assert fast.line.tolist() == list(range(1, 17, 2)) and fast.mark[0] == (0.5 if score else 1)


def test_lines_are_not_all_filled_up_to_the_longest(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("1,1,1,1,1,1\n" * 2000 + "1,1,1,1,1,1" + ",1" * 40_000 + "\n")
    with pytest.raises(InputError, match=r"line 2001: 40006 columns, over 10 times those of most"):
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


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".jpg", ".tif", ".pgm"])
def test_a_picture_of_too_many_pixels_is_refused_by_its_header(tmp_path, monkeypatch, suffix):
    path = tmp_path / f"1{suffix}"
    path.write_bytes(announced(suffix, 20_000, 20_000))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    for read_it in (read_image, read_mask, lambda p: ImageSource([p], "clip")):
        with pytest.raises(InputError, match=r"1.* is 20000x20000 pixels; wanted at most 100,000,000"):
            read_it(path)


def test_the_limit_of_pixels_can_be_set(tmp_path, monkeypatch):
    path = tmp_path / "1.png"
    path.write_bytes(announced(".png", 64, 48))
    monkeypatch.setenv("DDDAS_MOST_PIXELS", "3072")
    assert np.asarray(read_image(path)).shape == (48, 64)
    monkeypatch.setenv("DDDAS_MOST_PIXELS", "3071")
    with pytest.raises(InputError, match="64x48 pixels; wanted at most 3,071"):
        read_image(path)
    for words in ("many", "9" * 5000):
        monkeypatch.setenv("DDDAS_MOST_PIXELS", words)
        with pytest.raises(InputError, match=f"DDDAS_MOST_PIXELS is '{words[:4]}"):
            read_image(path)


@pytest.mark.parametrize("suffix", [".webp", ".jp2", ".gif", ".png", ".bmp", ".jpg", ".tif", ".ppm"])
def test_the_size_in_a_header_is_the_pictures(suffix):
    ok, data = cv2.imencode(suffix, np.full((48, 64, 3), 90, np.uint8))
    assert ok and size_in_header(bytes(data)) == (64, 48)


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
        ("   winSize: [ {} ]\n   SVMDetector: [ 1. ]\n", "its parts do not fit"),
        (SVM.format("[ {} ]", "[ { alpha: [ 1 ], rho: 1 } ]"), "has 300,001 support vectors"),
        (SVM.format("[ [ 1 ] ]", "[ { alpha: [ {} ], rho: 1 } ]"), "its parts do not fit"),
    ],
)
def test_a_classifier_of_too_many_numbers_is_refused_by_their_count(tmp_path, part, words):
    path = tmp_path / "a.yml"
    path.write_text(HOG + part.replace("{}", "1," * 300_000 + "1"))
    with pytest.raises(InputError, match=words):
        read_classifier(path, 3780)


@pytest.mark.parametrize("kind", [".npy", ".npz"])
def test_an_array_of_too_many_numbers_is_refused_by_its_header(tmp_path, monkeypatch, kind):
    path, file = tmp_path / f"a{kind}", io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (400_000, 1000)})
    if kind == ".npy":
        path.write_bytes(file.getvalue())
    else:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("weights.npy", file.getvalue())
    monkeypatch.setattr(np, "load", lambda *_, **__: pytest.fail("it was loaded"))
    with pytest.raises(InputError, match="announces 400000 x 1000 numbers; wanted at most 1,000,000"):
        read_classifier(path, 3780)


def test_a_table_of_too_many_boxes_in_a_frame_is_refused(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("".join(f"{frame},{k + 1},{k},1,1,1,1\n" for frame in (1, 2, 3) for k in range(3001)))
    for read_it in (detection_tables.read_detections, load_truth, load_result):
        with pytest.raises(InputError, match="has 3001 boxes in frame 1; wanted at most 3000 in a frame"):
            read_it(path)
    for read_places, kind in ((read_positions, "target"), (read_landmarks, "landmark")):
        rows = "".join(f"7,{k + 1},{k},1\n" for k in range(3001))
        (tmp_path / "a.csv").write_text(f"frame,{kind},east_m,north_m\n{rows}")
        with pytest.raises(InputError, match=r"has 3001 (places|landmarks) in frame 7; wanted at most 3000 in a frame"):
            read_places(tmp_path / "a.csv")
    result = CliRunner().invoke(app, ["track", "--detections", str(path), "--out", str(tmp_path / "out")])
    assert result.exit_code == 2 and "3001 boxes" in result.output and "Traceback" not in result.output
