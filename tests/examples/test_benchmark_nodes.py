"""The graphs that are measured do the work that is claimed for them, and all of it."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

Load = Callable[[str, str], ModuleType]


@pytest.fixture
def benchmark8(sim: Any, load_example: Load) -> ModuleType:
    return load_example("benchmark8", "benchmark8")


@pytest.fixture
def ping_pong(sim: Any, load_example: Load) -> ModuleType:
    return load_example("ping_pong", "ping_pong")


def test_eight_nodes_make_5060_callbacks_a_second(sim: Any, benchmark8: ModuleType) -> None:
    nodes = benchmark8.make_nodes()
    sim.run(0, lambda: sim.now >= 2_000_000_000)
    assert len(nodes) == 8
    # To within what the run cuts off: timers whose period does not divide it.
    assert sim.callbacks == pytest.approx(2 * 5060, abs=20)
    assert sum(node.callbacks for node in nodes) == sim.callbacks


@pytest.mark.parametrize("groups", [1, 3])
def test_one_period_for_all_gives_17_callbacks_each_time(
    sim: Any, benchmark8: ModuleType, groups: int
) -> None:
    nodes = benchmark8.make_nodes(groups, period=0.001)
    sim.run(0, lambda: sim.now >= 50_000_000)
    assert len(nodes) == 8 * groups
    assert sim.callbacks == 50 * 17 * groups
    assert all(node.callbacks >= 50 for node in nodes)


def test_groups_do_not_hear_each_other(sim: Any, benchmark8: ModuleType) -> None:
    alone = [node.state for node in _after_a_while(sim, benchmark8, 1)]
    sim.__dict__.update(type(sim)().__dict__)
    assert [node.state for node in _after_a_while(sim, benchmark8, 2)][:8] == alone


def test_a_lost_message_changes_the_states(sim: Any, benchmark8: ModuleType) -> None:
    whole = [node.state for node in _after_a_while(sim, benchmark8, 1)]
    sim.__dict__.update(type(sim)().__dict__)
    publish, lost = sim.publish, []

    def lossy(topic: str, message: Any) -> None:
        if topic == "/g0/imu" and not lost:
            lost.append(message)
        else:
            publish(topic, message)

    sim.publish = lossy
    states = [node.state for node in _after_a_while(sim, benchmark8, 1)]
    by_name = dict(zip(("imu", "wheels", "camera", "filter"), states, strict=False))
    assert lost
    assert by_name["imu"] == whole[0]
    assert by_name["filter"] != whole[3]
    assert states[6] != whole[6]  # the controller, by way of the filter


def _after_a_while(sim: Any, benchmark8: ModuleType, groups: int) -> list[Any]:
    nodes: list[Any] = benchmark8.make_nodes(groups)
    sim.run(0, lambda: sim.now >= 100_000_000)
    return nodes


@pytest.mark.few(3)
@pytest.mark.parametrize("arguments", [{"groups": 0}, {"seed": 0}, {"period": 0.0}])
def test_senseless_arguments_are_refused(
    benchmark8: ModuleType, arguments: dict[str, float]
) -> None:
    with pytest.raises(ValueError, match=r"at least 1 and period above 0, are"):
        benchmark8.make_nodes(**arguments)


@pytest.mark.long
def test_xorshift_never_dies_and_never_merges(benchmark8: ModuleType) -> None:
    word = st.integers(1, 2**64 - 1)

    @settings(deadline=None)
    @given(word, word)
    def check(a: int, b: int) -> None:
        assert 0 < benchmark8.xorshift(a) < 2**64
        assert (benchmark8.xorshift(a) == benchmark8.xorshift(b)) == (a == b)

    check()


def test_xorshift64star_is_the_published_one(benchmark8: ModuleType) -> None:
    # State 1: three shifts by hand (1>>12 = 0; 1<<25; nothing left of >>27), then the multiplier.
    state = benchmark8.xorshift(1)
    assert state == (1 << 25) | 1
    assert benchmark8.scramble(state) == ((1 << 25) + 1) * 0x2545F4914F6CDD1D % 2**64


def test_ping_pong_makes_three_callbacks_per_tick(sim: Any, ping_pong: ModuleType) -> None:
    sim.parameters = {"messages": 25, "period": 0.002}
    ping, pong = ping_pong.Ping(), ping_pong.Pong()
    sim.run(0, lambda: False)
    assert (sim.callbacks, ping.answers, pong.callbacks) == (75, 25, 25)
    assert sim.now == 50_000_000
    assert sim.published[-1][0] == "/ping_pong/done"
    assert sim.published[-1][1].data == 0


def test_a_burst_takes_one_tick_and_no_time(sim: Any, ping_pong: ModuleType) -> None:
    sim.parameters = {"messages": 500, "burst": True}
    ping, pong = ping_pong.Ping(), ping_pong.Pong()
    sim.run(0, lambda: False)
    assert (sim.callbacks, ping.callbacks, pong.callbacks) == (1001, 501, 500)
    assert sim.now == 1_000_000
    assert sim.counts["/ping_pong/done"] == 1


def test_a_number_that_was_lost_is_served_again(sim: Any, ping_pong: ModuleType) -> None:
    sim.parameters = {"messages": 4, "burst": True}
    ping = ping_pong.Ping()
    sim.run(0, lambda: sim.now >= 3_000_000)  # three serves that nobody hears
    ping_pong.Pong()
    sim.run(sim.now, lambda: False)
    assert ping.answers == 4
    numbers = [message.data for topic, message in sim.published if topic == "/ping"]
    assert numbers == [1, 1, 1, 1, 2, 3, 4]


def test_the_answer_to_a_number_served_twice_counts_once(sim: Any, ping_pong: ModuleType) -> None:
    sim.parameters = {"messages": 3, "burst": True}
    ping = ping_pong.Ping()
    answer = ping_pong.UInt64
    sim.run(0, lambda: sim.now >= 1_000_000)
    for number in (1, 1, 2, 2, 3):
        sim.publish("/pong", answer(data=number))
    sim.run(sim.now, lambda: False)
    assert ping.answers == 3
    assert [m.data for topic, m in sim.published if topic == "/ping"] == [1, 2, 3]
    assert sim.counts["/ping_pong/done"] == 1
