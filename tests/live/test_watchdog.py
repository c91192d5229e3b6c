"""Steps that hang, what a supervisor hears, and signals as requests."""

import os
import signal
import socket
import threading
from contextlib import suppress

import pytest

from torchvision_dddas.live.health import Health
from torchvision_dddas.live.watchdog import StopSignals, Supervisor, Watchdog


class Case:
    """A watchdog with a clock of its own. ended: with what words the process would have been."""

    def __init__(self, hung_s=10.0, supervisor=None):
        self.ended: list[str] = []
        self.now_s, self.health = 0.0, Health()
        self.dog = Watchdog(self.health, hung_s, supervisor, self.ended.append, lambda: self.now_s)

    def at(self, now_s):
        self.now_s = now_s
        self.dog.check()

    @property
    def told(self):
        return [(event.kind, event.frame) for event in self.health.snapshot().events]


def test_a_step_that_hangs_is_told_once_and_ended_after_twice_as_long():
    case = Case()
    case.dog.begin(7)
    case.at(10.0)
    assert case.told == []
    case.at(11.0)
    case.at(19.0)
    assert case.told == [("watchdog", 7)]
    assert "frame 7" in case.dog.hung
    assert not case.ended
    case.at(20.5)
    assert len(case.ended) == 1
    assert "frame 7 has taken 20 s" in case.ended[0]


def test_a_step_that_ends_late_is_forgiven_and_the_next_one_told_again():
    case = Case()
    for frame, now_s in ((1, 11.0), (2, 41.0)):
        case.dog.begin(frame)
        case.at(now_s)
        case.dog.done()
        case.at(now_s + 19.0)  # waiting for pictures never counts as hung
        assert case.dog.hung == ""
    assert case.told == [("watchdog", 1), ("watchdog", 2)] and not case.ended
    unlimited = Case(hung_s=0.0)
    unlimited.dog.begin(1)
    unlimited.at(1e6)
    assert unlimited.told == [] and not unlimited.ended


class Heard:
    """A supervisor's socket: called, it gives what was said to it."""

    def __init__(self, way: socket.socket, path: str) -> None:
        self.way, self.path = way, path
        way.bind(path)
        way.setblocking(False)

    def __call__(self) -> list[str]:
        said: list[str] = []
        with suppress(BlockingIOError):
            while True:
                said.append(self.way.recv(4096).decode())
        return said


@pytest.fixture
def heard(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as way:
        yield Heard(way, str(tmp_path / "notify"))


def test_a_supervisor_hears_that_all_is_well_while_it_is(heard):
    case = Case(supervisor=Supervisor({"NOTIFY_SOCKET": heard.path, "WATCHDOG_USEC": "8000000"}))
    case.dog.begin(1)
    for now_s in (0.0, 1.0, 2.0, 3.0, 4.0):
        case.at(now_s)
    assert heard() == ["WATCHDOG=1"] * 3
    case.at(11.0)
    case.at(15.0)
    assert heard() == []
    case.dog.done()
    case.at(16.0)
    assert heard() == ["WATCHDOG=1"]


@pytest.mark.parametrize(
    "environ",
    [{}, {"NOTIFY_SOCKET": "/nowhere/at/all"}, {"NOTIFY_SOCKET": "@nobody-is-there"}, {"WATCHDOG_USEC": "1000"}],
)
def test_a_supervisor_hears_words_and_where_nobody_listens_nothing_is_raised(heard, environ):
    Supervisor({"NOTIFY_SOCKET": heard.path}).say("READY=1", "STATUS=well")
    Supervisor(environ).say("READY=1")
    assert heard() == ["READY=1\nSTATUS=well"]


@pytest.mark.parametrize(
    ("more", "every_s"), [({}, 1.0), ({"WATCHDOG_PID": "1"}, 0.0), ({"WATCHDOG_USEC": "never"}, 0.0)]
)
def test_only_the_process_that_is_meant_answers_the_watchdog(more, every_s):
    environ = {"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "2000000", **more}
    assert Supervisor(environ).every_s == every_s


PATIENCE_S = 60.0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_asks_and_the_second_ends_at_once(number):
    asked, ended, codes = threading.Event(), threading.Event(), []

    def at_once(code):
        codes.append(code)
        ended.set()

    with StopSignals(lambda number: asked.set(), at_once) as stopping:
        os.kill(os.getpid(), number)
        assert asked.wait(PATIENCE_S)
        assert stopping.signal == number
        assert not codes
        os.kill(os.getpid(), signal.SIGTERM)
        assert ended.wait(PATIENCE_S)
    assert codes == [128 + signal.SIGTERM]


def test_nothing_is_asked_without_a_signal_and_handlers_are_given_back():
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with StopSignals(lambda number: pytest.fail("nobody asked")) as stopping:
        assert signal.getsignal(signal.SIGINT) is not before[0]
    assert stopping.signal is None
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
    assert signal.set_wakeup_fd(-1) == -1


def test_in_another_thread_signals_stay_as_they_are():
    before, seen = signal.getsignal(signal.SIGTERM), []

    def inside():
        with StopSignals(lambda number: None):
            seen.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=inside)
    thread.start()
    thread.join(PATIENCE_S)
    assert seen == [before]
