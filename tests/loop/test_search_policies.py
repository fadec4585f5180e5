"""Policies of a search: departures say what they cannot do, and PCT keeps its promise."""

from __future__ import annotations

import pytest

from rsltrace.errors import RunError
from rsltrace.simulation.chance.stream import RandomStream
from rsltrace.simulation.loop.policy import (
    Candidate,
    ChoicePoint,
    Departure,
    Departures,
    Pct,
    pct_bound,
)

THREADS, EVENTS = 4, 3


def candidate(number: int) -> Candidate:
    return Candidate(f"/n{number}", "/topic", "subscription", number + 1, None, (), None)


def order_of(policy: Departures | Pct, lengths: list[int]) -> list[int]:
    """Run entities with so many events each; return whose turn it was."""
    left, order = list(lengths), []
    while any(left):
        ready = [number for number, count in enumerate(left) if count]
        chosen = policy.choose([candidate(number) for number in ready], ChoicePoint(0, len(order)))
        left[ready[chosen]] -= 1
        order.append(ready[chosen])
    return order


def test_departures_are_all_there_is_beside_the_plain_order() -> None:
    plain = Departures([])
    assert order_of(plain, [2, 2]) == [0, 0, 1, 1]
    assert plain.choices == 2  # where one is left there is no choice
    assert order_of(Departures([Departure(1, 1, "/n1 /topic")]), [2, 2]) == [0, 1, 0, 1]
    assert Departures([Departure(5, 1)]).unmet() == [5]


@pytest.mark.parametrize("departure", [Departure(1, 2), Departure(1, 1, "/n0 /topic")])
def test_a_departure_that_cannot_be_is_an_error(departure: Departure) -> None:
    with pytest.raises(RunError, match=r"choice 1 cannot be candidate .*0: /n0 /topic, 1: /n1"):
        order_of(Departures([departure]), [2, 2])


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_pct_meets_orders_no_less_often_than_it_promises(depth: int) -> None:
    """So many times, an event of one of two entities has to come before one of the other."""
    lengths = [EVENTS] * THREADS
    choices = (THREADS - 1) * EVENTS
    first, second = THREADS - 1, 0
    constraints = [
        ((first, 0), (second, 0)),
        ((second, 0), (first, 1)),
        ((first, 1), (second, 1)),
    ][:depth]

    def is_met(order: list[int]) -> bool:
        place = {}
        for index, who in enumerate(order):
            place[who, sum(other == who for other in order[:index])] = index
        return all(place[one] < place[other] for one, other in constraints)

    runs = {1: 300, 2: 600, 3: 2_000}[depth]
    orders = (
        order_of(Pct(RandomStream(seed, "pct"), depth, choices), lengths) for seed in range(runs)
    )
    met = sum(map(is_met, orders))
    bound = pct_bound(THREADS, choices, depth)
    deviation = (runs * bound * (1 - bound)) ** 0.5
    assert met >= runs * bound - 3 * deviation
    assert met < runs  # it is not always so
