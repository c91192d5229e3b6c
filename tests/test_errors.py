"""What a message, a table or a page shows of an address has no password, and any encoding can hold it."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchvision_dddas.errors import InputError, readable, without_secrets
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
        ("frames/a@b", "frames/a@b"),
        ("json:/home/me@work/x.jsonl", "json:/home/me@work/x.jsonl"),
        ("keys/key=5/clip.mp4", "keys/key=5/clip.mp4"),
    ],
)
def test_what_is_no_secret_stays(text, shown):
    assert without_secrets(text) == shown


@given(st.text(st.characters(codec="utf-16", categories=None) | st.sampled_from("\udcff\udc80\ud800")))
def test_every_text_is_readable_in_utf8(text):
    shown = readable(text)
    shown.encode()
    assert readable(shown) == shown


def test_bytes_of_a_name_that_are_no_utf8_are_shown_by_their_numbers():
    assert readable("cl\udcffip.mp4") == r"cl\xffip.mp4"
    assert readable("\udcc3\udcbc") == "ü"  # a name in UTF-8 where the locale is another
