"""What a message, a table or a page shows of an address has no password, and any encoding can hold it."""

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError, printable, readable, without_secrets
from torchvision_dddas.io.output.run_record import finite

SIGNS = st.characters(min_codepoint=32, max_codepoint=126)
PASSWORDS = st.text(SIGNS, min_size=6).map(lambda text: f"Q{text}Q")


@given(PASSWORDS, st.sampled_from(["rtsp", "http", "tcp"]), st.sampled_from(["cannot open {}", "{}", "'{}' is lost"]))
def test_no_password_before_the_host_is_ever_shown(password, scheme, words):
    text = words.format(f"{scheme}://me:{password}@10.0.0.1:554/live")
    for shown in (without_secrets(text), str(InputError(text)), finite([text])[0]):
        assert password not in shown
        assert "10.0.0.1:554/live" in shown


@given(
    st.text(SIGNS.filter(lambda sign: sign not in "&@"), min_size=6).map(lambda text: f"Q{text}Q"),
    st.sampled_from(["password", "pwd", "access_token", "Passphrase", "api_key", "X-Amz-Signature"]),
    st.sampled_from(["?", "?channel=1&", "/user=admin&"]),
)
def test_no_secret_of_a_query_is_ever_shown(secret, key, before):
    shown = without_secrets(f"cannot open http://10.0.0.1/live{before}{key}={secret}&stream=2 as a stream")
    assert secret not in shown
    assert "http://10.0.0.1/live" in shown and shown.endswith("&stream=2 as a stream")


def test_what_was_hidden_once_keeps_the_words_that_follow():
    name = without_secrets("http://host/live?password=two words")
    assert name == "http://host/live?password=***"
    assert str(InputError(f"{name} sent nothing; try again")) == f"{name} sent nothing; try again"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("rtsp://me:pa/ss@host/live", "rtsp://host/live"),
        ("rtsp://me@work:pa/ss@host/live", "rtsp://host/live"),
        ("rtsp:/me:pass@host/live", "rtsp:/host/live"),
        ("me:pass@host/live does not exist", "host/live does not exist"),
        ("rtsp://host/live@2x/clip", "rtsp://host/live@2x/clip"),
        ("http://host:80/a?stream=2", "http://host:80/a?stream=2"),
        ("rtsp://host/a?k=x is lost; try x=3", "rtsp://host/a?k=*** is lost; try x=3"),
        ("cannot open 'udp://host:5?ttl=4&k=x'; wait", "cannot open 'udp://host:5?ttl=4&k=***'; wait"),
        ("frames/a@b", "frames/a@b"),
        ("json:/home/me@work/x.jsonl", "json:/home/me@work/x.jsonl"),
        ("keys/key=5/clip.mp4", "keys/key=5/clip.mp4"),
        ("json:/home/key=5/clip.mp4", "json:/home/key=5/clip.mp4"),
    ],
)
def test_what_is_no_secret_stays(text, shown):
    assert without_secrets(text) == shown


@pytest.mark.parametrize(
    "address",
    [
        "rtsp://10.0.0.1/user=admin_password=hush_channel=1_stream=0.sdp",
        "http://10.0.0.1/video.cgi?loginuse=admin&loginpas=hush",
        "http://10.0.0.1/a?u=admin&p=hush",
        "https://10.0.0.1/a?sas=hush",
        "rtsp://10.0.0.1:1/?u=me&k=hush",
        "rtsp://10.0.0.1:1/live?stream=2;login=hush&x",
        "'https://10.0.0.1/a?x=hush.hush,'",
        "/vsicurl/http:/me:hush@10.0.0.1/a.tif",
        "http:/10.0.0.1/a.tif?password=hush",
        "rtsp//me:hush@10.0.0.1/live",
        "rtsp;//me:hush@10.0.0.1/live",
    ],
)
def test_no_secret_is_shown_of_the_addresses_that_cameras_have(address):
    shown = str(InputError(f"{address} does not exist"))
    assert "hush" not in shown and "10.0.0.1" in shown


def test_a_text_is_searched_for_secrets_in_time_in_proportion_to_its_length():
    texts = ("@" + "a" * 99, "a" * 99 + "://=", "@" + "a." * 50, "?" + "pass" * 25, "p_" * 50, "a_" * 50 + "://a@b=")
    more = ("a://" * 25, "//a:" * 25, "pass_" * 20, "=a:/" * 25, "?a=." * 25, "?a=." + "." * 96, "\u00e9" * 99)
    for text in (*texts, *more):
        whole, begin_s = text[:-1] * 600, time.process_time()
        for shape in (whole, f"@{whole}", f"{whole}@", f"://=?{whole}", f"{text}{whole} ://a@="):
            without_secrets(shape)
        assert time.process_time() - begin_s < 5  # of 300 KB; most took minutes


@given(st.text(st.characters(codec="utf-16", categories=None) | st.sampled_from("\udcff\udc80\ud800")))
def test_every_text_is_readable_in_utf8(text):
    shown = readable(text)
    shown.encode()
    assert readable(shown) == shown


def test_bytes_of_a_name_that_are_no_utf8_are_shown_by_their_numbers():
    for show in (readable, printable, lambda text: str(InputError(text))):
        assert show("cl\udcffip.mp4") == r"cl\xffip.mp4"
    assert readable("\udcc3\udcbc") == "ü"  # a name in UTF-8 where the locale is another
