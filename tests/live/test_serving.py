"""The pages over HTTP."""

import socket
import threading
import urllib.error
import urllib.request

import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.live.server import HealthServer, address_of

PATIENCE_S = 60.0


@pytest.fixture
def health_pages():
    pages = {"/": lambda: (200, "text/html", "<p>é"), "/health.json": lambda: (503, "application/json", "{}")}
    with HealthServer(("127.0.0.1", 0), pages) as serving:
        yield serving


def asked(serving, path="/", method="GET"):
    request = urllib.request.Request("http://{}:{}{}".format(*serving.address, path), method=method)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
            return answer.status, answer.headers, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.headers, error.read()


def test_a_page_comes_with_its_status_type_and_length(health_pages):
    status, headers, body = asked(health_pages, "/?again")
    assert (status, body.decode()) == (200, "<p>é")
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert headers["Content-Length"] == str(len(body))
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert asked(health_pages, "/health.json")[0] == 503


def test_head_gives_no_body_and_another_path_names_those_that_are(health_pages):
    assert asked(health_pages, "/", "HEAD")[2] == b""
    status, _, body = asked(health_pages, "/../etc/passwd")
    assert status == 404
    assert b"/health.json" in body


def test_nothing_can_be_sent_to_it(health_pages):
    assert asked(health_pages, "/", "POST")[0] == 501


def test_clients_that_say_nothing_keep_nobody_from_the_pages(health_pages):
    with socket.create_connection(health_pages.address), socket.create_connection(health_pages.address):
        assert asked(health_pages)[0] == 200


def test_a_page_that_fails_ends_nothing():
    def failing() -> tuple[int, str, str]:
        raise ZeroDivisionError

    with HealthServer(("127.0.0.1", 0), {"/": failing, "/well": lambda: (200, "text/plain", "well")}) as serving:
        with pytest.raises((urllib.error.URLError, ConnectionError)):
            asked(serving)
        assert asked(serving, "/well")[0] == 200


def test_a_port_in_use_is_one_line(health_pages):
    with pytest.raises(InputError, match=r"cannot serve at 127\.0\.0\.1:\d+: address already in use; choose another"):
        HealthServer(health_pages.address, {})


def test_when_it_is_left_the_port_is_free_and_no_thread_stays():
    before = threading.active_count()
    with HealthServer(("127.0.0.1", 0), {}) as serving:
        address = serving.address
    assert threading.active_count() == before
    with HealthServer(address, {}):
        pass


@pytest.mark.parametrize(
    ("spec", "address"),
    [
        ("8080", ("127.0.0.1", 8080)),
        (":8080", ("127.0.0.1", 8080)),
        ("0.0.0.0:1", ("0.0.0.0", 1)),
        ("[::1]:9", ("::1", 9)),
    ],
)
def test_a_port_alone_is_this_machines_own(spec, address):
    assert address_of(spec) == address


@pytest.mark.parametrize("spec", ["", "eighty", "1.2.3.4", "host:", "70000", "-1", "8080/"])
def test_what_is_no_address_is_one_line(spec):
    with pytest.raises(InputError, match=r"--serve .* is no address; wanted PORT or HOST:PORT"):
        address_of(spec)
