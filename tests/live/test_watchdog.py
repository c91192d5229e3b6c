"""Steps that hang, notices to a supervisor, and signals as requests."""

import os
import signal
import socket
import threading

import pytest

from torchvision_dddas.io.interrupts import StopSignals
from torchvision_dddas.live.health import Health
from torchvision_dddas.live.watchdog import Supervisor, Watchdog

PATIENCE_S = 60.0


class Case:
    """A watchdog whose clock the test sets. ended: the last words of a process that was ended."""

    def __init__(self, hung_s=10.0, supervisor=None):
        self.ended: list[str] = []
        self.now_s, self.health = 0.0, Health()
        self.dog = Watchdog(self.health, hung_s, supervisor, self.ended.append, lambda: self.now_s)

    def at(self, *times_s):
        for self.now_s in times_s:
            self.dog.check()

    @property
    def reported(self):
        return [(event.kind, event.frame) for event in self.health.snapshot().events]


def test_a_step_that_hangs_is_reported_once_and_ended_after_twice_as_long():
    case = Case()
    case.dog.begin(7)
    case.at(10.0)
    assert case.reported == []
    case.at(11.0, 19.0)
    assert case.reported == [("watchdog", 7)]
    assert "frame 7" in case.dog.hung and not case.ended
    case.at(20.5)
    assert ["frame 7 has taken 20 s" in words for words in case.ended] == [True]


def test_a_late_step_is_forgiven_and_the_next_one_is_reported_again():
    case = Case()
    for frame, now_s in ((1, 11.0), (2, 41.0)):
        case.dog.begin(frame)
        case.at(now_s)
        case.dog.done()
        case.at(now_s + 19.0)  # waiting for pictures never counts as hung
        assert case.dog.hung == ""
    assert case.reported == [("watchdog", 1), ("watchdog", 2)] and not case.ended
    unlimited = Case(hung_s=0.0)
    unlimited.dog.begin(1)
    unlimited.at(1e6)
    assert unlimited.reported == [] and not unlimited.ended


@pytest.fixture
def notified(tmp_path):
    """The path of a supervisor's socket, and a function that gives what was sent to it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as way:
        way.bind(str(tmp_path / "notify"))
        way.setblocking(False)

        def received():
            try:
                return [way.recv(4096).decode(), *received()]
            except BlockingIOError:
                return []

        yield str(tmp_path / "notify"), received


def test_a_supervisor_is_notified_while_no_step_hangs(notified):
    path, received = notified
    case = Case(supervisor=Supervisor({"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "8000000"}))
    case.dog.begin(1)
    case.at(0.0, 1.0, 2.0, 3.0, 4.0)
    assert received() == ["WATCHDOG=1"] * 3
    case.at(11.0, 15.0)
    assert received() == []
    case.dog.done()
    case.at(16.0)
    assert received() == ["WATCHDOG=1"]


def test_a_supervisor_is_not_notified_while_results_are_due_and_do_not_come(notified):
    path, received = notified
    case = Case(supervisor=Supervisor({"NOTIFY_SOCKET": path, "WATCHDOG_USEC": "8000000"}))
    case.dog.idle_s = lambda: case.now_s
    case.at(4.0, 9.0, 14.0, 60.0)
    assert received() == ["WATCHDOG=1"] * 2
    case.dog.idle_s = lambda: 0.0
    case.at(61.0)
    assert received() == ["WATCHDOG=1"]


@pytest.mark.parametrize(
    "environ",
    [{}, {"NOTIFY_SOCKET": "/nowhere/at/all"}, {"NOTIFY_SOCKET": "@nobody-is-there"}, {"WATCHDOG_USEC": "1000"}],
)
def test_a_notice_is_sent_where_a_supervisor_listens_and_never_raises(notified, environ):
    path, received = notified
    Supervisor({"NOTIFY_SOCKET": path}).say("READY=1", "STATUS=well")
    Supervisor(environ).say("READY=1")
    assert received() == ["READY=1\nSTATUS=well"]


@pytest.mark.parametrize(
    ("more", "every_s"), [({}, 1.0), ({"WATCHDOG_PID": "1"}, 0.0), ({"WATCHDOG_USEC": "never"}, 0.0)]
)
def test_only_the_process_that_is_meant_answers_the_watchdog(more, every_s):
    environ = {"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "2000000", **more}
    assert Supervisor(environ).every_s == every_s


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_asks_the_second_ends_at_once_and_handlers_are_restored(number):
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    asked, ended, codes = threading.Event(), threading.Event(), []

    def at_once(code):
        codes.append(code)
        ended.set()

    with StopSignals(lambda number: asked.set(), at_once, together_s=0.0) as stopping:
        assert stopping.signal is None and not asked.is_set()
        os.kill(os.getpid(), number)
        assert asked.wait(PATIENCE_S)
        assert stopping.signal == number and not codes
        os.kill(os.getpid(), signal.SIGTERM)
        assert ended.wait(PATIENCE_S)
    assert codes == [128 + signal.SIGTERM]
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
    assert signal.set_wakeup_fd(-1) == -1


def test_another_thread_leaves_the_handlers_as_they_are():
    before, seen = signal.getsignal(signal.SIGTERM), []

    def inside():
        with StopSignals(lambda number: None):
            seen.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=inside)
    thread.start()
    thread.join(PATIENCE_S)
    assert seen == [before]
