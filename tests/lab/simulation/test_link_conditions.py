"""A simulated link delays, loses and keeps the order, as its conditions say."""

import math
import threading

import pytest

from torchvision_dddas.errors import InputError
from torchvision_dddas.lab.simulation.link_conditions import DelayedWriter, LinkConditions, LinkDelay, parse_link

WAIT_S = 20.0


@pytest.mark.parametrize(
    "text", ["", "latency", "latency=-1", "loss=1.5", "delay=1", "latency=1/2", "dropout=3", "dropout=3/2", "loss=nan"]
)
def test_a_wrong_condition_is_named(text):
    with pytest.raises(InputError, match="is no condition of a link; wanted latency=S"):
        parse_link(text)


def test_conditions_are_read_from_one_text():
    text = "latency=0.5, jitter=0.1,loss=0.05,dropout=2/20,clock=-3"
    assert parse_link(text) == LinkConditions(0.5, 0.1, 0.05, -3.0, (2.0, 20.0))


def test_arrivals_keep_the_order_and_lie_between_the_delays():
    delay = LinkDelay(LinkConditions(latency=0.5, jitter=2.0), 1, 0)
    arrivals = [delay.arrival_s(k / 10) for k in range(200)]
    assert arrivals == sorted(arrivals)
    late = [arrival - k / 10 for k, arrival in enumerate(arrivals)]
    assert min(late) >= 0.5 - 1e-9
    assert max(late) <= 2.5


def test_a_perfect_link_changes_nothing():
    delay = LinkDelay(LinkConditions(), 1, 0)
    assert [delay.arrival_s(float(k)) for k in range(9)] == list(range(9))


def test_a_share_is_lost_and_differs_between_directions():
    one, other = (LinkDelay(LinkConditions(loss=0.2), 5, stream) for stream in (0, 1))
    lost = [[math.isnan(delay.arrival_s(float(k))) for k in range(2000)] for delay in (one, other)]
    assert sum(lost[0]) / 2000 == pytest.approx(0.2, abs=0.04)
    assert lost[0] != lost[1]


def test_a_dropout_ends_each_period():
    delay = LinkDelay(LinkConditions(dropout=(2.0, 10.0)), 1, 0)
    begin_s = delay._begin_s
    silent = [math.isnan(delay.arrival_s(begin_s + k + 0.5)) for k in range(20)]
    assert silent == 2 * ([False] * 8 + [True] * 2)


@pytest.mark.parametrize("latency", [0.0, 0.05])
def test_items_arrive_in_their_order(latency):
    arrived, last = list[int](), threading.Event()

    def take(item):
        arrived.append(item)
        if item == 49:
            last.set()

    with DelayedWriter(take, LinkDelay(LinkConditions(latency=latency), 1, 0)) as writer:
        for item in range(50):
            writer.send(item)
        assert last.wait(WAIT_S)
    assert arrived == list(range(50))


def test_what_has_not_arrived_at_the_end_is_lost():
    arrived = list[int]()
    with DelayedWriter(arrived.append, LinkDelay(LinkConditions(latency=50.0), 1, 0)) as writer:
        writer.send(1)
    assert arrived == []
