"""Make the delay and clock models of a job: files are read, times made absolute."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from rsltrace.adapters.rclpy.node_clocks import ClockRule
from rsltrace.job import Job, locate
from rsltrace.job.values.problem import Loc
from rsltrace.simulation.chance.channel import (
    BurstLoss,
    LinkModel,
    LinkOutage,
    LinkRule,
    NameRule,
    NetworkPlan,
    OutageRule,
)
from rsltrace.simulation.chance.distribution import (
    Constant,
    Distribution,
    Empirical,
    Gamma,
    Lognormal,
    MeasuredSamples,
    Normal,
    TimeSeries,
    Uniform,
)
from rsltrace.simulation.chance.stream import ClockModel
from rsltrace.trace.model.texts import format_duration

if TYPE_CHECKING:
    from rsltrace.job.parts.delay import DelaySpec
    from rsltrace.job.parts.distribution import DistributionSpec


def clock_rules(job: Job) -> tuple[ClockRule, ...]:
    """Return the rules for the nodes' clocks; the first match counts."""
    found = []
    for spec in job.clocks:
        random = spec.random_jumps
        model = ClockModel(
            offset_ns=spec.offset_ns,
            drift=spec.drift(),
            jumps=tuple((jump.at_ns, jump.by_ns) for jump in spec.jumps),
            random_every_ns=0 if random is None else random.every_ns,
            random_most_ns=0 if random is None else random.most_ns,
        )
        found.append(ClockRule(spec.node, model, spec.advances, spec.source == "topic"))
    return tuple(found)


def clock_notes(job: Job, start_ns: int) -> Iterator[str]:
    """Yield the clocks that would show times before 0."""
    for index, spec in enumerate(job.clocks):
        wrong_ns = spec.offset_ns
        settings: list[tuple[Loc, int]] = [(("clocks", index, "offset"), start_ns + wrong_ns)]
        for number, jump in enumerate(spec.jumps):
            wrong_ns += jump.by_ns
            place: Loc = ("clocks", index, "jumps", number, "by")
            settings.append((place, start_ns + jump.at_ns + wrong_ns))
        for loc, shown_ns in settings:
            if shown_ns < 0:
                yield (
                    f"{locate(job, loc)}: this clock would show times before 0, which ROS does "
                    f"not have: it shows 0 for {format_duration(-shown_ns)}; give the job a later "
                    "'start:'"
                )
                break


def network_plan(job: Job, start_ns: int) -> NetworkPlan | None:
    """Return the plan of a job's delays, or None.

    :raises JobError: a file of delays is wrong.
    """
    delay = job.delay
    if delay is None:
        return None
    return NetworkPlan(
        links=tuple(
            LinkRule(spec.topic, spec.sender, spec.receiver, link_model(job, spec))
            for spec in delay.links
        ),
        topics=tuple(NameRule(name, link_model(job, s)) for name, s in delay.topics.items()),
        table=_table(job, delay.file),
        services=tuple(NameRule(name, link_model(job, s)) for name, s in delay.services.items()),
        default=None if delay.default is None else link_model(job, delay.default),
        outages=tuple(
            OutageRule(*spec.what, LinkOutage(start_ns + spec.from_ns, start_ns + spec.to_ns))
            for spec in delay.outages
        ),
        seed=job.seed,
        start_ns=start_ns,
    )


def _table(job: Job, file: str | None) -> tuple[NameRule, ...]:
    if file is None:
        return ()
    from rsltrace.job.reading.delay_files import read_rslcpp

    name = job.shown(file)
    rows = read_rslcpp(job.resolve(file), name)
    return tuple(
        NameRule(topic, link_model(job, spec), f"{name}:{line}")
        for topic, (line, spec) in rows.items()
    )


def link_model(job: Job, spec: DelaySpec) -> LinkModel:
    burst = spec.burst
    return LinkModel(
        delay=make_distribution(job, spec) if spec.kinds() else None,
        drop=spec.drop,
        burst=None
        if burst is None
        else BurstLoss(burst.good_to_bad, burst.bad_to_good, burst.loss_bad, burst.loss_good),
        duplicate=spec.duplicate,
        keep_order=spec.keep_order,
        retransmit_ns=spec.retransmit_ns,
    )


def make_distribution(job: Job, spec: DistributionSpec) -> Distribution:
    """Return the distribution of a job's spec; reads files."""
    from rsltrace.job.reading.delay_files import read_samples, read_series

    if spec.constant_ns is not None:
        return Constant(spec.constant_ns)
    if spec.uniform is not None:
        return Uniform(spec.uniform.min_ns, spec.uniform.max_ns)
    if spec.normal is not None:
        return Normal(spec.normal.mean_ns, spec.normal.sd_ns)
    if spec.lognormal is not None:
        lognormal = spec.lognormal
        if lognormal.mean_ns is not None and lognormal.sd_ns is not None:
            return Lognormal.of_moments(lognormal.mean_ns, lognormal.sd_ns)
        assert lognormal.median_ns is not None
        assert lognormal.sigma is not None
        return Lognormal(lognormal.median_ns, lognormal.sigma)
    if spec.gamma is not None:
        gamma = spec.gamma
        if gamma.mean_ns is not None and gamma.sd_ns is not None:
            return Gamma.of_moments(gamma.mean_ns, gamma.sd_ns)
        assert gamma.shape is not None
        assert gamma.scale_ns is not None
        return Gamma(gamma.shape, gamma.scale_ns)
    if spec.samples is not None:
        samples = spec.samples
        if samples.file is not None:
            path, name = job.resolve(samples.file), job.shown(samples.file)
            return MeasuredSamples(read_samples(samples, path, name))
        return MeasuredSamples(samples.values_ns or ())
    if spec.empirical is not None:
        values, percent = spec.empirical.values_ns, spec.empirical.percent
        if percent is None:
            percent = tuple(100 * index / (len(values) - 1) for index in range(len(values)))
        return Empirical(percent, values)
    series = spec.series
    assert series is not None
    if series.file is not None:
        path, name = job.resolve(series.file), job.shown(series.file)
        return TimeSeries(read_series(series, path, name), series.steps)
    return TimeSeries(series.points or (), series.steps)
