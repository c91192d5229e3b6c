"""Signals as requests."""

import os
import signal
import threading

import pytest

from torchvision_dddas.live.watchdog import StopSignals

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
