"""The operator's page in a browser, fed by a thread that plays a run."""

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.browser import Browser, needs_browser
from tests.zoned import ORIGIN, result
from torchvision_dddas.io.output import MapSite
from torchvision_dddas.io.streams import About
from torchvision_dddas.live import Health
from torchvision_dddas.live.access import Access
from torchvision_dddas.live.operator_view import OperatorView
from torchvision_dddas.live.server import HealthServer, health_pages
from torchvision_dddas.live.watchdog import Watchdog
from torchvision_dddas.types import Camera, Frame, Zone

pytestmark = [pytest.mark.browser, pytest.mark.slow, needs_browser]

HOSTILE = "</script><img src=x onerror=document.title='taken'><b>field</b>"
CAMERA = Camera("uav", (320, 240), (300.0, 300.0), (159.5, 119.5))
SQUARE = np.array([[-8.0, -8], [8, -8], [8, 8], [-8, 8]])
TOKEN = "token-of-the-test"


class Run:
    """A run whose pictures are red, with a target that goes east and one that stands; `stands` stops its results."""

    def __init__(self, located: bool = True) -> None:
        self.health, self.view = Health(), OperatorView()
        site = MapSite((), ORIGIN, camera=CAMERA) if located else None
        zones = [Zone(HOSTILE, (SQUARE,), unit="m")] if located else []
        self.view.begin(1, About(1.6e9, located), site, zones)
        self.pages = health_pages(
            self.health, Watchdog(self.health, 0.0), [], lambda: "running", HOSTILE, "1", 60.0, self.view
        )
        self.stands, self._ended, self._located = threading.Event(), threading.Event(), located
        self._thread = threading.Thread(target=self._play, daemon=True)

    def _play(self) -> None:
        number, image = 0, np.full((240, 320, 3), (40, 40, 200), np.uint8)
        while not self._ended.wait(0.05):
            if not self.stands.is_set():
                number += 1
                self.view.take(Frame(number, number / 20, image))
                shown = result(number, [[number / 20, 4], [-5, 0]], 20.0, located=self._located)
                if shown.locations is not None:
                    velocity = np.array([[1.0, 0.0], [0.0, 0.0]])
                    shown = replace(shown, locations=replace(shown.locations, velocity_m_s=velocity))
                self.view.show(shown, None)
                self.health.result()

    def __enter__(self) -> "Run":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self.view.close()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory):
    with Browser(Path(tmp_path_factory.mktemp("browser"))) as browser:
        yield browser


@pytest.fixture(autouse=True)
def page_of_its_own(browser):
    browser.requested.clear()
    browser.trouble.clear()
    yield
    browser.open("about:blank")


def is_red(picture, box):
    x, y, width, height = (round(v) for v in box)
    blue, _, red = np.median(picture[y : y + height, x : x + width].reshape(-1, 3), axis=0)
    return red > blue + 80


BOX = "(b=>[b.x,b.y,b.width,b.height])(document.getElementById('%s').getBoundingClientRect())"


@pytest.mark.parametrize(("width", "height", "phone"), [(1400, 900, False), (390, 844, True)])
def test_the_page_shows_picture_map_targets_and_alarms_and_fits(browser, width, height, phone):
    with Run() as run, HealthServer(("127.0.0.1", 0), run.pages) as server:
        browser.open(server.url, width, height, phone)
        browser.wait("document.querySelectorAll('#targets tbody tr').length === 2")
        browser.wait("document.getElementById('picture')?.naturalWidth === 320")
        browser.wait("document.getElementById('stale')?.textContent === ''")
        rows = browser.evaluate("[...document.querySelectorAll('#targets tbody tr')].map(row => row.innerText)")
        assert "mover" in rows[0] and "1.0 m/s" in rows[0] and "32.23" in rows[0] and "CAT I" in rows[0]
        tags = "[...document.querySelectorAll('#map .tag')].map(tag => tag.textContent)"
        browser.wait(f"{tags}.includes({HOSTILE!r})".replace("'</", '"</').replace("</b>'", '</b>"'))
        assert {"1", "2", "camera"} <= set(browser.evaluate(tags))
        run.health.event("zone", f"target 1 enters {HOSTILE}", 7)
        browser.wait("document.getElementById('alarm')?.hidden === false")
        assert HOSTILE in browser.evaluate("document.getElementById('alarm').textContent")
        assert browser.evaluate("document.querySelector('#events .is-alarm .badge').textContent") == "alarm"
        assert browser.evaluate("document.querySelectorAll('.tiles dd').length") >= 2
        assert browser.evaluate("document.documentElement.scrollWidth") <= width
        picture, scale = browser.picture(), 2 if phone else 1
        assert is_red(picture, np.array(browser.evaluate(BOX % "picture")) * (scale, scale, scale, scale / 3))
        if not phone:  # the map is in the window: the track and the ellipses are drawn
            x, y, wide, high = (round(v) for v in browser.evaluate(BOX % "map"))
            assert len(np.unique(picture[y : y + high, x : x + wide].reshape(-1, 3), axis=0)) > 20
        # Names stay text, nothing is asked of others, and the policy of the page was not touched.
        assert browser.evaluate("document.querySelectorAll('b,img[src=x]').length") == 0
        assert browser.evaluate("document.title").startswith("running")
        assert browser.trouble == []
        assert all(url.startswith(server.url) for url in browser.requested if url != "about:blank")


def test_a_page_whose_results_stop_says_so_and_so_does_a_lost_run(browser):
    with Run() as run, HealthServer(("127.0.0.1", 0), run.pages) as server:
        browser.open(server.url)
        browser.wait("document.getElementById('picture')?.naturalWidth === 320")
        run.stands.set()
        browser.wait("/^no new result for \\d+ s$/.test(document.getElementById('stale')?.textContent)")
        run.stands.clear()
        browser.wait("document.getElementById('stale')?.textContent === ''")
    browser.wait("document.getElementById('stale')?.textContent === 'no connection to the run'")
    # A new run on the same port takes over the page.
    with Run() as run, HealthServer(server.address, run.pages):
        browser.wait("document.getElementById('stale')?.textContent === ''")
        browser.wait("document.getElementById('picture')?.naturalWidth === 320")


def test_a_run_that_locates_nothing_has_no_map_and_lists_pixels(browser):
    with Run(located=False) as run, HealthServer(("127.0.0.1", 0), run.pages) as server:
        browser.open(server.url)
        browser.wait("document.querySelectorAll('#targets tbody tr').length === 2")
        assert browser.evaluate("document.getElementById('where').hidden")
        assert "pixel " in browser.evaluate("document.querySelector('#targets tbody').innerText")


def test_a_moved_map_stays_and_show_all_brings_the_targets_back(browser):
    tag = "[...document.querySelectorAll('#map .tag')].find(tag => tag.textContent === '2').getBoundingClientRect().x"
    with Run() as run, HealthServer(("127.0.0.1", 0), run.pages) as server:
        browser.open(server.url)
        browser.wait("[...document.querySelectorAll('#map .tag')].some(tag => tag.textContent === '2')")
        browser.wait("document.getElementById('picture')?.naturalWidth === 320")
        run.stands.set()
        browser.wait("/^no new/.test(document.getElementById('stale').textContent)")  # nothing moves
        browser.evaluate("document.getElementById('whole').click()")
        before = browser.evaluate(tag)
        browser.evaluate("document.querySelector('.leaflet-control-zoom-in').click()")
        browser.wait(f"Math.abs({tag} - {before}) > 5")
        browser.evaluate("document.getElementById('whole').click()")
        browser.wait(f"Math.abs({tag} - {before}) < 1")


def test_a_browser_without_the_token_gets_a_form_and_with_it_the_page_and_a_clean_address(browser):
    with Run() as run, HealthServer(("127.0.0.1", 0), run.pages, Access(TOKEN)) as server:
        browser.open(server.url)
        browser.wait("document.querySelector('input[name=token]') !== null")
        assert browser.evaluate("fetch('state.json').then(answer => answer.status)") == 401
        browser.evaluate(f"document.querySelector('input').value = '{TOKEN}', document.querySelector('form').submit()")
        browser.wait("document.getElementById('picture')?.naturalWidth === 320")
        browser.wait("document.querySelectorAll('#targets tbody tr').length === 2")
        assert browser.evaluate("location.href") == server.url
        assert TOKEN not in browser.evaluate("document.documentElement.outerHTML + document.cookie")
