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
from tests.fuzz.parsers import PARSERS
from torchvision_dddas.errors import LONGEST, InputError
from torchvision_dddas.io.images import natural_order

INPUTS = 25
NOT_WHOLE = {
    # What the seeds of another reader are to this one.
    "MOT text": {3}, "truth of a clip": {3}, "tracks of a result": {1, 3}, "detections as text": {3},
    "tables of other programs": {2}, "folder of PNGs": {2}, "names of inputs": {2, 3, 4, 5, 6},
    "classifier .yml": {1}, "classifier .xml": {1}, "classifier .json": {1}, "other words": {0, 1, 2, 5},
}  # fmt: skip
# Their input is words, or one of several files.
WORDS = {"overrides", "addresses to serve at", "names of streams", "names of inputs", "other words", "run.json"}
# Files that may be empty.
EMPTY = {"detections as text", "detections as CSV", "settings TOML"}
BY_NAME = {parser.name: parser for parser in PARSERS}
ALONE = [name for name, parser in BY_NAME.items() if "/" not in parser.file and name not in WORDS]


@pytest.fixture
def parser(name):
    if not BY_NAME[name].there:
        pytest.skip(f"needs {BY_NAME[name].needs}")
    return BY_NAME[name]


@pytest.fixture
def path(parser, tmp_path):
    return parser.prepare(tmp_path)


@pytest.mark.filterwarnings("error", "ignore::DeprecationWarning", "ignore::PendingDeprecationWarning")
@pytest.mark.parametrize("name", BY_NAME)
def test_a_damaged_file_is_taken_or_refused_in_one_line(name, parser, path):
    whole = len(parser.seeds())
    taken = [parser.try_on(path, parser.case(0, number)) is None for number in range(whole + INPUTS)]
    assert {number for number in range(whole) if not taken[number]} == NOT_WHOLE.get(name, set())


@pytest.mark.parametrize("name", ALONE)
def test_a_file_that_is_absent_empty_or_garbage_is_refused_by_its_name(name, parser, path):
    for content in (None, b"\xff\xfe\x00\x01\x80", *([] if name in EMPTY else [b""])):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(InputError, match=path.name):
            parser.read(path)


def test_the_same_number_gives_the_same_input_and_another_gives_another() -> None:
    camera = BY_NAME["camera TOML"]
    cases = [camera.case(1, k) for k in range(40)]
    assert cases == [camera.case(1, k) for k in range(40)] and len(set(cases)) > 30
    assert cases[5:] != [camera.case(2, k) for k in range(5, 40)]
    for text in (True, False):
        sizes = [len(damaged([b"1,2,3\n" * 9000], random.Random(seed), text)) for seed in range(20)]
        assert max(sizes) <= LARGEST and len(set(sizes)) > 5


def test_a_refusal_is_one_line_that_a_terminal_shows_however_bad_the_input() -> None:
    error = InputError("a file \x1b[31mred\x07 of \udc80\nlines" + "9" * 10_000 + "; wanted 1 to 5")
    assert str(error).isprintable() and len(str(error)) <= LONGEST
    assert r"\x1b[31mred\x07 of \x80 lines" in str(error) and str(error).endswith("; wanted 1 to 5")


# -- What was found ----------------------------------------------------------------------------------------------------

PNG, PX4 = seeds.pictures(".png")[0], seeds.px4()[0]
CHUNK = PNG.index(b"IDAT") - 4
DEFINITION = BY_NAME["BMS's definition"].seeds()[0]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("settings TOML", b"a = " + b"[" * 20_000),
        ("settings TOML", b"[registration]\nkeypoints = " + b"1" * 5000),
        ("overrides", b"registration.keypoints=" + b"1" * 5000),
        ("overrides", b"registration.keypoints=" + b"[" * 5000),
        ("overrides", b"crowd." + b"1" * 5000 + b".people=3"),
        ("names of inputs", b"a" * 300),
        ("names of inputs", b"a\0b"),
        ("names of inputs", b"sim:" + b"a" * 300),
        ("other words", "camera:\u00b2".encode()),
        ("addresses to serve at", "\u00b2".encode()),
        ("seqinfo.ini", b"[Sequence]\nseqLength=" + b"9" * 60),
        ("MOT text", b"1,1,0,0,1e200,1e200\n"),
        ("BMS's definition", DEFINITION.replace(b"cars_0001_gt.ppm", b"a" * 300 + b".pgm")),
        ("BMS's definition", DEFINITION.replace(b"cars_0001_gt.ppm", b"/")),
        ("scenario TOML", b'[world]\nphoto = "' + b"a" * 300 + b'"'),
        # OpenCV 4.14 never returns from a chunk longer than the file, or asks for 4 GB.
        ("masks", PNG[:CHUNK] + struct.pack(">I", 0xFEFEFE75) + PNG[CHUNK + 4 :]),
        # pyulog 1.3 reads the end for ever where the last message says it is longer than the file.
        ("PX4 ULog", PX4[: 19 + int.from_bytes(PX4[16:18], "little")] + bytes(40_000) + b"<\0\0" + bytes(10)),
        ("detections as CSV", b'frame,x_px,y_px,width_px,height_px\n1,"2,3\n2,3,4,5,6\n'),
    ],
)
def test_what_once_crashed_or_never_ended_is_refused(parser, path, content):
    assert parser.try_on(path, content) is not None


def test_names_with_digits_of_any_script_are_put_in_order() -> None:
    names = "frame10.png\nframe\u0663.png\nframe2.png\n\u00b95.png\n7\u00b9.png\n"
    assert sorted(names.splitlines(), key=natural_order)[0] == "7\u00b9.png"


@pytest.mark.parametrize("name", ["run.json"])
@pytest.mark.parametrize(
    "record", [b'{"frames": {"written": Infinity}, "state": 1, "outputs": 5}', b"[" * 20_000, b"[1]"]
)
def test_a_record_of_a_run_that_says_nothing_sensible_counts_as_none(parser, path, record):
    assert parser.try_on(path, record) is None


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


_TELEMETRY = ["telemetry CSV", "tables of other programs"]


@pytest.mark.parametrize("name", ["detections as CSV", "positions CSV", "landmarks CSV", "poses CSV", *_TELEMETRY])
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
