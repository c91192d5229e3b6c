"""Whatever a file holds, its reader takes it or refuses it in one clear line. `eval/fuzz.py` tries many more inputs."""

import os
import random
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz import seeds
from tests.fuzz.damage import LONGEST as LARGEST
from tests.fuzz.damage import damaged
from tests.fuzz.parsers import PARSERS, Parser
from torchvision_dddas.errors import LONGEST, InputError
from torchvision_dddas.io.images import natural_order

INPUTS = 25
NOT_WHOLE = {
    # What the seeds of another reader are to this one.
    "MOT text": {3}, "truth of a clip": {3}, "tracks of a result": {1, 3}, "detections as text": {3},
    "tables of other programs": {2}, "folder of PNGs": {2}, "names of inputs": {2, 3, 4, 5, 6, 7},
    "classifier .yml": {1}, "classifier .xml": {1}, "classifier .json": {1}, "other words": {0, 1, 2, 5},
}  # fmt: skip
# Their input is words, or one of several files.
WORDS = {"overrides", "addresses to serve at", "names of streams", "names of inputs", "other words", "run.json"}
# Files that may be empty.
EMPTY = {"detections as text", "detections as CSV", "settings TOML"}
BY_NAME = {parser.name: parser for parser in PARSERS}


@pytest.fixture(params=PARSERS, ids=lambda parser: parser.name.replace(" ", "-"))
def parser(request: pytest.FixtureRequest) -> Parser:
    if not request.param.there:
        pytest.skip(f"needs {request.param.needs}")
    return request.param


@pytest.mark.filterwarnings("error", "ignore::DeprecationWarning", "ignore::PendingDeprecationWarning")
def test_a_damaged_file_is_taken_or_refused_in_one_line(parser: Parser, tmp_path: Path) -> None:
    path = parser.prepare(tmp_path)
    whole = len(parser.seeds())
    taken = [parser.try_on(path, parser.case(0, number)) is None for number in range(whole + INPUTS)]
    refused_whole = {number for number in range(whole) if not taken[number]}
    assert refused_whole == NOT_WHOLE.get(parser.name, set())


@pytest.mark.parametrize("content", [None, b"", b"\xff\xfe\x00\x01\x80"], ids=["absent", "empty", "garbage"])
@pytest.mark.parametrize(
    "name", [parser.name for parser in PARSERS if "/" not in parser.file and parser.name not in WORDS]
)
def test_a_file_that_is_absent_empty_or_garbage_is_refused_by_its_name(tmp_path: Path, name: str, content) -> None:
    parser = BY_NAME[name]
    if not parser.there:
        pytest.skip(f"needs {parser.needs}")
    path = parser.prepare(tmp_path)
    if content is not None:
        path.write_bytes(content)
    if content == b"" and name in EMPTY:
        parser.read(path)
    else:
        with pytest.raises(InputError, match=path.name):
            parser.read(path)


def test_the_same_number_gives_the_same_input_and_another_gives_another() -> None:
    camera = BY_NAME["camera TOML"]
    assert [camera.case(1, k) for k in range(40)] == [camera.case(1, k) for k in range(40)]
    assert len({camera.case(1, k) for k in range(40)}) > 30
    assert [camera.case(1, k) for k in range(5, 40)] != [camera.case(2, k) for k in range(5, 40)]
    for text in (True, False):
        sizes = [len(damaged([b"1,2,3\n" * 9000], random.Random(seed), text)) for seed in range(20)]
        assert max(sizes) <= LARGEST and len(set(sizes)) > 5


def test_a_reader_that_raises_anything_else_is_noticed(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError):
        Parser("x", "x", lambda: [b""], lambda path: 1 / 0).try_on(tmp_path / "x", b"")


def test_a_refusal_is_one_line_that_a_terminal_shows_however_bad_the_input() -> None:
    error = InputError("a file \x1b[31mred\x07 of \udc80\nlines" + "9" * 10_000 + "; wanted 1 to 5")
    assert str(error).isprintable() and len(str(error)) <= LONGEST
    assert r"\x1b[31mred\x07 of \udc80 lines" in str(error) and str(error).endswith("; wanted 1 to 5")


# -- What was found, each with what it was -----------------------------------------------------------------------------


def test_a_png_that_says_a_chunk_is_longer_than_the_file_is_refused_at_once(tmp_path: Path) -> None:
    """OpenCV 4.14 never returns from one, or asks for 4 GB."""
    whole = seeds.pictures(".png")[0]
    place = whole.index(b"IDAT") - 4
    cut = whole[:place] + struct.pack(">I", 0xFEFEFE75) + whole[place + 4 :]
    assert BY_NAME["masks"].try_on(tmp_path / "a.png", cut) is not None
    assert BY_NAME["masks"].try_on(tmp_path / "a.png", whole) is None


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("settings TOML", b"a = " + b"[" * 20_000),
        ("settings TOML", b"[registration]\nkeypoints = " + b"1" * 5000),
        ("overrides", b"registration.keypoints=" + b"1" * 5000),
        ("overrides", b"registration.keypoints=" + b"[" * 5000),
        ("names of inputs", b"a" * 300),
        ("names of inputs", b"a\0b"),
        ("other words", "camera:\u00b2".encode()),
        ("addresses to serve at", "\u00b2".encode()),
        ("overrides", b"crowd." + b"1" * 5000 + b".people=3"),
        ("names of inputs", b"sim:" + b"a" * 300),
        ("seqinfo.ini", b"[Sequence]\nseqLength=" + b"9" * 60),
        ("MOT text", b"1,1,0,0,1e200,1e200\n"),
        ("BMS's definition", BY_NAME["BMS's definition"].seeds()[0].replace(b"cars_01.pgm", b"a" * 300 + b".pgm")),
        ("BMS's definition", BY_NAME["BMS's definition"].seeds()[0].replace(b"cars_01.pgm", b"/")),
        ("KITTI's calib", BY_NAME["KITTI's calib"].seeds()[0].replace(b"R_rect 1", b"R_rect 0")),
        ("scenario TOML", b'[world]\nphoto = "' + b"a" * 300 + b'"'),
    ],
)
def test_what_has_no_end_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    path = BY_NAME[name].prepare(tmp_path)
    assert BY_NAME[name].try_on(path, content) is not None


def test_a_px4_log_whose_last_message_says_it_is_longer_than_the_file_comes_to_an_end(tmp_path: Path) -> None:
    """pyulog 1.3 reads its end for ever."""
    pytest.importorskip("pyulog")
    whole = seeds.px4()[0]
    first = whole[: 16 + 3 + int.from_bytes(whole[16:18], "little")]
    content = first + bytes(40_000) + struct.pack("<HB", 60, 0) + bytes(10)
    assert BY_NAME["PX4 ULog"].try_on(tmp_path / "a.ulg", content) is not None


def test_a_table_with_a_quote_about_several_cells_is_refused(tmp_path: Path) -> None:
    content = b'frame,x_px,y_px,width_px,height_px\n1,"2,3\n2,3,4,5,6\n'
    assert BY_NAME["detections as CSV"].try_on(tmp_path / "a.csv", content) is not None


def test_names_with_digits_of_any_script_are_put_in_order() -> None:
    names = "frame10.png\nframe\u0663.png\nframe2.png\n\u00b95.png\n7\u00b9.png\n"
    assert sorted(names.splitlines(), key=natural_order)[0] == "7\u00b9.png"


@pytest.mark.parametrize(
    "record", [b'{"frames": {"written": Infinity}, "state": 1, "outputs": 5}', b"[" * 20_000, b"[1]"]
)
def test_a_record_of_a_run_that_says_nothing_sensible_counts_as_none(tmp_path: Path, record: bytes) -> None:
    path = BY_NAME["run.json"].prepare(tmp_path)
    assert BY_NAME["run.json"].try_on(path, record) is None


@pytest.mark.skipif(os.geteuid() == 0, reason="root may enter every folder")
def test_a_folder_that_may_not_be_entered_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "clip"
    folder.mkdir(mode=0)
    assert BY_NAME["names of inputs"].try_on(tmp_path / "input.txt", str(folder).encode()) is not None


# -- Tables of any cells -----------------------------------------------------------------------------------------------

CELLS = st.one_of(
    st.floats(width=64).map(repr),
    st.integers(-(2**70), 2**70).map(str),
    st.sampled_from(["", "1", "2", "0", "nan", "inf", "-0", "1e999", "0.5", "red"]),
    st.text(max_size=6),
)


def columns_of(name: str) -> list[str]:
    """All that the seeds of a reader name in their first lines."""
    return sorted({cell for content in BY_NAME[name].seeds() for cell in content.decode().split("\n")[0].split(",")})


@pytest.mark.parametrize("name", ["detections as CSV", "positions CSV", "landmarks CSV", "poses CSV", "telemetry CSV"])
@settings(derandomize=True, max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_table_of_any_cells_is_taken_or_refused(tmp_path_factory: pytest.TempPathFactory, name: str, data) -> None:
    parser = BY_NAME[name]
    first = data.draw(st.sampled_from([content.decode().split("\n")[0].split(",") for content in parser.seeds()]))
    more = data.draw(st.lists(st.sampled_from(columns_of(name)), max_size=2))
    header = data.draw(st.permutations([*first, *more])) if more else first
    rows = data.draw(st.lists(st.lists(CELLS, min_size=len(header), max_size=len(header)), max_size=5))
    text = "\n".join(",".join(cells) for cells in [header, *rows])
    path = tmp_path_factory.getbasetemp() / parser.file
    with warnings.catch_warnings(), np.errstate(all="warn", under="ignore"):
        warnings.simplefilter("error")
        parser.try_on(path, text.encode("utf-8", "surrogatepass"))
