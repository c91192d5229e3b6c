"""Health adds up whoever tells, and its percentiles are of the latest."""

import threading

import pytest

from torchvision_dddas.live import Health


def test_counts_of_many_threads_add_up():
    health = Health()

    def often():
        for _ in range(500):
            health.count("read")

    threads = [threading.Thread(target=often) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert health.snapshot().counts == {"read": 2000}


def test_percentiles_are_of_the_latest_times():
    health = Health()
    for _ in range(10):
        health.took("step", 9.0)
    for k in range(4096):
        health.took("step", k / 4095)
    assert health.snapshot().seconds["step"] == pytest.approx((0.5, 0.95, 0.99), abs=1e-3)


def test_a_result_makes_the_run_fresh_and_events_are_kept_in_order():
    health = Health()
    health.event("stream", "lost", 3)
    health.event("stream", "found again", 7)
    health.result()
    told = health.snapshot()
    assert told.idle_s < 1
    assert [(event.frame, event.text) for event in told.events] == [(3, "lost"), (7, "found again")]
    assert told.counts == {"events_stream": 2, "results": 1}
