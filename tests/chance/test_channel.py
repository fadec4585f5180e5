"""A link: losses against theory, order, retransmission, outages; and links that leave each other
alone."""

from __future__ import annotations

import math
from itertools import groupby, pairwise
from statistics import fmean
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from rsltrace.simulation.chance.channel import (
    LOST_BURST,
    LOST_DROP,
    LOST_OUTAGE,
    BurstLoss,
    LinkChannel,
    LinkModel,
    LinkOutage,
    LinkRule,
    NameRule,
    NetworkPlan,
    OutageRule,
)
from rsltrace.simulation.chance.distribution import Constant, Distribution, Gamma, Normal, Uniform
from tests.tiers import cases

N = 100_000
MS = 1_000_000
S = 1_000_000_000


def channel(model: LinkModel, *, reliable: bool = False, **options: Any) -> LinkChannel:
    return LinkChannel(model, seed=5, name="link", start_ns=0, reliable=reliable, **options)


def sent(link: LinkChannel, count: int = N, period_ns: int = MS) -> list[int]:
    return [link.transmit(i * period_ns) for i in range(count)]


def share(hits: int, probability: float) -> bool:
    return abs(hits / N - probability) < 4 * math.sqrt(probability * (1 - probability) / N)


def test_drops_are_as_frequent_as_asked_and_independent() -> None:
    losses = [code == LOST_DROP for code in sent(channel(LinkModel(drop=0.2)))]
    assert share(sum(losses), 0.2)
    both = sum(x and y for x, y in pairwise(losses))
    assert share(both, 0.04)


def test_bursts_follow_gilbert_and_elliott() -> None:
    p, r = 0.02, 0.2
    losses = [code == LOST_BURST for code in sent(channel(LinkModel(burst=BurstLoss(p, r))))]
    bad = p / (p + r)
    memory = 1 - p - r
    # The variance of a mean of a correlated chain is larger by (1 + memory) / (1 - memory).
    inflated = math.sqrt(bad * (1 - bad) / N * (1 + memory) / (1 - memory))
    assert abs(sum(losses) / N - bad) < 4 * inflated
    lengths = [len(list(run)) for lost, run in groupby(losses) if lost]
    spread = math.sqrt((1 - r) / r**2 / len(lengths))
    assert abs(fmean(lengths) - 1 / r) < 4 * spread
    gaps = [len(list(run)) for lost, run in groupby(losses) if not lost]
    assert abs(fmean(gaps) - 1 / p) < 4 * math.sqrt((1 - p) / p**2 / len(gaps))
    mean = fmean(losses)
    for lag in (1, 2, 5):
        pairs = zip(losses, losses[lag:], strict=False)
        covariance = fmean((x - mean) * (y - mean) for x, y in pairs)
        assert abs(covariance / (mean * (1 - mean)) - memory**lag) < 0.03


def test_bursts_may_lose_only_a_part() -> None:
    burst = BurstLoss(0.1, 0.1, loss_bad=0.5, loss_good=0.02)
    lost = sum(code == LOST_BURST for code in sent(channel(LinkModel(burst=burst))))
    assert abs(lost / N - (0.5 * 0.5 + 0.5 * 0.02)) < 0.01


def test_duplicates_are_as_frequent_as_asked() -> None:
    link = channel(LinkModel(delay=Uniform(0, 9), duplicate=0.1))
    twice = 0
    for i in range(N):
        link.transmit(i * MS)
        twice += link.duplicate_ns >= 0
    assert share(twice, 0.1)


def test_no_message_overtakes_another_unless_it_may() -> None:
    delay = Uniform(0, 50 * MS)
    ordered = [i * MS + d for i, d in enumerate(sent(channel(LinkModel(delay=delay)), 1000))]
    assert ordered == sorted(ordered)
    free = [
        i * MS + d
        for i, d in enumerate(sent(channel(LinkModel(delay=delay, keep_order=False)), 1000))
    ]
    assert free != sorted(free)
    assert all(late >= early for late, early in zip(ordered, free, strict=True))


def test_a_second_copy_keeps_the_order_too() -> None:
    model = LinkModel(delay=Uniform(0, 50 * MS), duplicate=0.3, drop=0.1)
    for reliable in (False, True):
        link = channel(model, reliable=reliable)
        arrivals, copies = [], 0
        for i in range(2000):
            delay_ns = link.transmit(i * MS)
            if delay_ns >= 0:
                arrivals.append(i * MS + delay_ns)
                if link.duplicate_ns >= 0:
                    arrivals.append(i * MS + link.duplicate_ns)
                    copies += 1
        assert copies > 400
        assert arrivals == sorted(arrivals)


def test_a_reliable_link_sends_again_what_it_loses() -> None:
    model = LinkModel(delay=Constant(MS), drop=0.25, retransmit_ns=10 * MS, keep_order=False)
    delays = sent(channel(model, reliable=True))
    assert min(delays) == MS
    for losses in range(4):  # geometric
        assert share(delays.count(MS + losses * 10 * MS), 0.75 * 0.25**losses)
    assert channel(LinkModel(drop=1.0), reliable=True).transmit(0) == LOST_DROP  # gives up


def test_outages_lose_what_is_best_effort_and_hold_what_is_reliable() -> None:
    outages = (LinkOutage(10 * MS, 20 * MS), LinkOutage(20 * MS, 25 * MS))
    model = LinkModel(delay=Constant(MS))
    link = channel(model, outages=outages)
    assert [link.transmit(t * MS) for t in (9, 10, 19, 24)] == [MS, *[LOST_OUTAGE] * 3]
    assert link.transmit(25 * MS) == MS
    link = channel(model, outages=outages, reliable=True)
    assert link.transmit(9 * MS) == MS
    assert link.held_until_ns == -1
    assert link.transmit(15 * MS) == 11 * MS
    assert link.held_until_ns == 25 * MS


# -- which model a link has, and that no link disturbs another -----------------------------------

NODES = st.sampled_from(["/a", "/b", "/c", "/ns/d"])
TOPICS = st.sampled_from(["/t", "/u", "/ns/v"])
LINKS = st.tuples(TOPICS, NODES, NODES)
DELAYS: list[Distribution] = [Uniform(0, 10**9), Normal(5 * MS, MS), Gamma(2.0, MS)]
MODELS = st.builds(
    LinkModel,
    delay=st.sampled_from(DELAYS),
    drop=st.sampled_from([0.0, 0.3]),
    keep_order=st.booleans(),
)


def plan_of(links: dict[tuple[str, str, str], LinkModel]) -> NetworkPlan:
    rules = tuple(LinkRule(*names, model) for names, model in links.items())
    return NetworkPlan(links=rules, seed=3)


def drawn(plan: NetworkPlan, links: list[tuple[str, str, str]]) -> dict[object, list[int]]:
    """Send over all links in turns, as a run does, and return what each has drawn."""
    channels = {
        names: plan.topic_channel(names[0], (names[1], 0), (names[2], 0), reliable=False)
        for names in links
    }
    found: dict[object, list[int]] = {names: [] for names in links}
    for i in range(6):
        for names, link in channels.items():
            if link is not None:
                found[names].append(link.transmit(i * MS))
    return found


@settings(max_examples=cases(30, 200), deadline=None)
@given(st.dictionaries(LINKS, MODELS, min_size=2, max_size=8), LINKS, MODELS, st.data())
def test_adding_removing_or_renaming_a_link_leaves_all_others_as_they_were(
    links: dict[tuple[str, str, str], LinkModel],
    other: tuple[str, str, str],
    model: LinkModel,
    data: Any,
) -> None:
    before = drawn(plan_of(links), list(links))
    victim = data.draw(st.sampled_from(sorted(links)))
    removed = {names: m for names, m in links.items() if names != victim}
    added = {other: model, **links}
    renamed = {other if names == victim else names: m for names, m in links.items()}
    for changed in (removed, added, renamed):
        after = drawn(plan_of(changed), list(changed))
        for names in links:
            if names in changed and changed[names] == links[names] and names not in (victim, other):
                assert after[names] == before[names]


def test_requests_never_arrive_twice_nor_wait_for_a_copy() -> None:
    models = [LinkModel(Uniform(0, 50 * MS), duplicate=share) for share in (0.0, 0.9)]
    links = [
        NetworkPlan(default=model).service_channel("/s", ("/n", 0), ("/m", 0), "request")
        for model in models
    ]
    plain, twice = ([link.transmit(i * MS) for i in range(100)] for link in links if link)
    assert twice == plain
    assert all(link is not None and link.duplicate_ns == -1 for link in links)


def test_the_most_precise_rule_counts() -> None:
    plan = NetworkPlan(
        links=(LinkRule("/t", "*", "/slow", LinkModel(Constant(1))),),
        topics=(NameRule("/*", LinkModel(Constant(2))), NameRule("/t", LinkModel(Constant(3)))),
        services=(NameRule("/s", LinkModel(Constant(4))),),
        default=LinkModel(Constant(5)),
    )

    def delay(topic: str, receiver: str) -> int:
        link = plan.topic_channel(topic, ("/n", 0), (receiver, 0), reliable=True)
        assert link is not None
        return link.transmit(0)

    assert delay("/t", "/slow") == 1
    assert delay("/t", "/n") == 3
    assert delay("/u", "/n") == 2
    service = plan.service_channel("/s", ("/n", 0), ("/m", 0), "request")
    other = plan.service_channel("/x", ("/n", 0), ("/m", 0), "request")
    assert service is not None
    assert other is not None
    assert (service.transmit(0), other.transmit(0)) == (4, 5)
    assert NetworkPlan().topic_channel("/t", ("/n", 0), ("/m", 0), reliable=True) is None
    only_default = NetworkPlan(default=LinkModel(Constant(5)))
    quiet = only_default.topic_channel("/rosout", ("/n", 0), ("/m", 0), reliable=True)
    assert quiet is None


def test_outages_find_topics_services_and_nodes() -> None:
    cut = LinkOutage(0, S)
    plan = NetworkPlan(
        outages=(
            OutageRule("topic", "/t", cut),
            OutageRule("node", "/deaf", cut),
            OutageRule("service", "/s", cut),
        )
    )

    def dead(topic: str, sender: str, receiver: str) -> bool:
        link = plan.topic_channel(topic, (sender, 0), (receiver, 0), reliable=False)
        return link is not None and link.transmit(5) == LOST_OUTAGE

    assert dead("/t", "/a", "/b")
    assert dead("/u", "/deaf", "/b")
    assert dead("/u", "/a", "/deaf")
    assert not dead("/u", "/a", "/b")
    assert plan.service_channel("/x", ("/a", 0), ("/b", 0), "request") is None
    response = plan.service_channel("/s", ("/a", 0), ("/b", 0), "response")
    assert response is not None
    assert response.transmit(5) == S - 5


def test_losses_leave_the_delays_of_what_arrives_alone() -> None:
    delay = Normal(5 * MS, 2 * MS)
    plain = sent(channel(LinkModel(delay, keep_order=False)), 2000)
    troubles: list[tuple[LinkModel, dict[str, Any]]] = [
        (LinkModel(delay, keep_order=False, drop=0.3), {}),
        (LinkModel(delay, keep_order=False, burst=BurstLoss(0.1, 0.2)), {}),
        (LinkModel(delay, keep_order=False), {"outages": (LinkOutage(100 * MS, 900 * MS),)}),
        (LinkModel(delay, keep_order=False, duplicate=0.3), {}),
    ]
    for model, options in troubles:
        pairs = list(zip(plain, sent(channel(model, **options), 2000), strict=True))
        arrived = [(first, second) for first, second in pairs if second >= 0]
        assert len(arrived) > 1000
        assert all(first == second for first, second in arrived)
