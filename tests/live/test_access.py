"""Who may read the pages of a live run: tokens, cookies, and names of hosts."""

import urllib.error
import urllib.request
from typing import Any

import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.live.access import TOKEN, Access, choose_access
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.server import HealthServer, health_pages

SECRET = "a-Token_of.22~letters"


@pytest.fixture(autouse=True)
def no_token_in_the_environment(monkeypatch):
    monkeypatch.delenv(TOKEN, raising=False)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.8.8", "::1", "localhost"])
def test_pages_on_this_machine_need_no_token(host):
    assert choose_access(host, None) == Access()


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.7", "board.example"])
def test_pages_beyond_this_machine_have_a_new_token_each_time(host):
    first, second = choose_access(host, None), choose_access(host, None)
    assert first.is_made and len(first.token) >= 22 and first.token != second.token


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_a_given_token_holds_everywhere_before_that_of_the_environment(host, monkeypatch):
    monkeypatch.setenv(TOKEN, "of-the-environment")
    assert choose_access(host, SECRET) == Access(SECRET)
    assert choose_access(host, None) == Access("of-the-environment")


@pytest.mark.parametrize("token", ["", "short", "with blanks in it", "semi;colon;semi", "tökentöken", "x" * 201])
def test_a_token_that_an_address_or_a_cookie_cannot_hold_is_one_line_without_it(token):
    with pytest.raises(InputError, match=r"^--serve-token has \d+ characters; give 8 to 200 of letters") as told:
        choose_access("0.0.0.0", token)
    assert not token or token not in str(told.value)


def test_a_wrong_token_of_the_environment_is_named_after_its_variable(monkeypatch):
    monkeypatch.setenv(TOKEN, "short")
    with pytest.raises(InputError, match=r"^\$DDDAS_SERVE_TOKEN has 5 characters"):
        choose_access("127.0.0.1", None)


@pytest.mark.parametrize(
    ("headers", "query", "is_allowed"),
    [
        ({}, "", False),
        ({}, f"token={SECRET}", True),
        ({}, f"a=b&token={SECRET}", True),
        ({}, f"token={SECRET}x", False),
        ({}, "token=", False),
        ({"Authorization": f"Bearer {SECRET}"}, "", True),
        ({"Authorization": f"bearer  {SECRET} "}, "", True),
        ({"Authorization": f"Basic {SECRET}"}, "", False),
        ({"Authorization": "Bearer"}, "", False),
        ({"Authorization": "Bearer tökentökentöken"}, "", False),
        ({"Cookie": f"other=1; dddas_token_80={SECRET}"}, "", True),
        ({"Cookie": f"dddas_token_81={SECRET}"}, "", False),
        ({"Cookie": f"dddas_token_80; dddas_token_80={SECRET[:-1]}"}, "", False),
        ({"Host": "127.0.0.1"}, "", False),
    ],
)
def test_a_request_has_the_token_in_its_query_a_cookie_or_as_a_bearer(headers, query, is_allowed):
    assert Access(SECRET).allows(headers, query, 80) == is_allowed


@pytest.mark.parametrize(
    ("host", "is_allowed"),
    [
        *((name, True) for name in ("127.0.0.1:8080", "localhost", "localhost:9", "[::1]:80", "[::1]", "10.0.0.7:80")),
        *((name, False) for name in ("evil.example:8080", "localhost.evil.example", "127.0.0.1.evil.example:1")),
    ],
)
def test_without_a_token_no_other_name_may_lead_to_this_machine(host, is_allowed):
    assert Access().allows({"Host": host}, "", 8080) == is_allowed


class Unfollowed(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_):
        return None


def asked(server, path, **headers):
    request = urllib.request.Request("http://{}:{}{}".format(*server.address, path), headers=headers)
    try:
        with urllib.request.build_opener(Unfollowed).open(request, timeout=60) as answer:
            return answer.status, answer.headers, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.headers, error.read().decode()


class Run(Any):
    hung = ""


def pages():
    return health_pages(Health(), Run(), [], lambda: "running", "x", "1", 60.0)


def test_each_page_needs_the_token_and_its_address_leaves_it_in_a_cookie():
    with HealthServer(("127.0.0.1", 0), pages(), Access(SECRET, is_made=True)) as server:
        for path in (*pages(), "/other"):
            status, headers, body = asked(server, path)
            assert (status, headers["WWW-Authenticate"]) == (401, "Bearer") and SECRET not in body
        assert '<input name="token"' in asked(server, "/")[2]
        for path in ("/health.json", "/metrics", "/state.json", "/live.js"):
            assert asked(server, path, Authorization=f"Bearer {SECRET}")[0] == 200
        path = server.url.removeprefix("http://{}:{}".format(*server.address))
        status, headers, _ = asked(server, path)
        cookie, *flags = headers["Set-Cookie"].split("; ")
        assert (status, headers["Location"]) == (303, "./") and {"HttpOnly", "SameSite=Lax"} <= set(flags)
        assert asked(server, "/", Cookie=cookie)[0] == 200
        assert asked(server, "/", Cookie=cookie + "x")[0] == 401


def test_a_token_that_was_given_is_not_in_the_printed_address():
    with HealthServer(("127.0.0.1", 0), {}, Access(SECRET)) as server:
        assert server.url == "http://{}:{}/".format(*server.address)


def test_the_printed_address_of_a_server_for_all_hosts_can_be_opened():
    with HealthServer(("127.0.0.1", 0), {}) as server:
        server.address = "0.0.0.0", 8080
        assert server.url.endswith(":8080/") and "0.0.0.0" not in server.url
        server.address = "::1", 8080
        assert server.url == "http://[::1]:8080/"


def test_a_page_under_another_name_is_refused_with_a_line_that_says_what_to_do():
    with HealthServer(("127.0.0.1", 0), pages()) as server:
        status, _, body = asked(server, "/state.json", Host="evil.example")
        assert status == 403 and "--serve-token" in body
