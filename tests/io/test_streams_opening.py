from dataclasses import replace

import pytest

from tests.io.streamed import ABOUT, Told, surveyed
from torchvision_dddas.errors import InputError
from torchvision_dddas.io.streams import open_stream, open_streams


@pytest.mark.parametrize("text", ["", "json", "json:", "xml:-", "JSON:-", "-", "json:tcp://127.0.0.1:5", ":-"])
def test_what_is_no_stream_is_refused_with_what_is(text):
    with pytest.raises(InputError, match=r"is no stream; wanted json, mot or cot, .* as in json:-$"):
        open_stream(text, ABOUT, Told())


@pytest.mark.parametrize(
    ("place", "words"),
    [("absent/x", "No such file"), ("", "Is a directory"), ("a\0b", "zero byte"), ("n" * 300, "too long")],
)
def test_a_file_that_cannot_be_written_is_refused_in_one_line(tmp_path, place, words):
    with pytest.raises(InputError, match=words) as refused:
        open_stream(f"json:{tmp_path}/{place}", ABOUT, Told())
    assert "\n" not in str(refused.value) and "choose another place" in str(refused.value)


@pytest.mark.parametrize("kind", ["json", "mot", "cot"])
def test_a_file_that_holds_something_else_is_left_alone(tmp_path, kind):
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"\0\0\0\x18ftypmp42")
    with pytest.raises(InputError, match="holds something else than"):
        open_stream(f"{kind}:{path}", ABOUT, Told())
    assert path.read_bytes() == b"\0\0\0\x18ftypmp42"


@pytest.mark.parametrize(
    ("about", "words"),
    [(replace(ABOUT, geographic=False), "longitudes and latitudes"), (replace(ABOUT, clock=False), "time of day")],
)
def test_events_that_could_not_say_where_or_when_are_refused(about, words):
    with pytest.raises(InputError, match=words):
        open_stream("cot:-", about, Told())


def test_two_streams_to_one_place_are_refused_and_two_addresses_are_not(tmp_path):
    for one, other in (("json:-", "mot:-"), (f"json:{tmp_path}/x", f"mot:{tmp_path}/./x")):
        with pytest.raises(InputError, match="same place"):
            open_streams([one, other], ABOUT, Told())
    streams = open_streams(["json:udp://127.0.0.1:9", "cot:udp://127.0.0.1:9"], ABOUT, Told())
    assert len(streams) == 2
    for stream in streams:
        stream.close()


def test_of_several_all_are_opened_or_none_stays_open(tmp_path, monkeypatch):
    closed = []
    monkeypatch.setattr("torchvision_dddas.io.streams.stream.Stream.close", lambda stream: closed.append(stream.name))
    with pytest.raises(InputError, match="is no stream"):
        open_streams([f"json:{tmp_path}/x", "nothing"], ABOUT, Told())
    assert closed == [f"json:{tmp_path}/x"]


def test_each_kind_writes_its_own(tmp_path):
    for kind, begins in (("json", b'{"frame":1,'), ("mot", b"1,1,10.00,"), ("cot", b'<event version="2.0" ')):
        for _ in range(2):  # what it wrote itself it takes for its own
            stream = open_stream(f"{kind}:{tmp_path}/{kind}", ABOUT, Told())
            stream.write(surveyed(1))
            stream.close()
        written = (tmp_path / kind).read_bytes()
        assert written.startswith(begins) and written.count(begins) == 2
