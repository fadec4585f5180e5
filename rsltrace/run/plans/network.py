"""From a job's ``delay:`` to the plan of a network: models, files read, times made absolute."""

from __future__ import annotations

from rsltrace.job import Job
from rsltrace.job.parts.delay import DelaySpec
from rsltrace.job.parts.distribution import DistributionSpec
from rsltrace.job.reading.delay_files import read_rslcpp, read_samples, read_series
from rsltrace.simulation.chance.channel import Burst, Model, Outage
from rsltrace.simulation.chance.distribution import (
    Constant,
    Distribution,
    Empirical,
    Gamma,
    Lognormal,
    Normal,
    Samples,
    Series,
    Uniform,
)
from rsltrace.simulation.chance.network import LinkRule, NameRule, NetworkPlan, OutageRule


def network_plan(job: Job, start_ns: int) -> NetworkPlan | None:
    """Return the plan of a job's delays, or None if it has none.

    :raises JobError: if a file of delays is wrong.
    """
    delay = job.delay
    if delay is None:
        return None
    return NetworkPlan(
        links=tuple(
            LinkRule(spec.topic, spec.sender, spec.receiver, model_of(job, spec))
            for spec in delay.links
        ),
        topics=tuple(NameRule(name, model_of(job, s)) for name, s in delay.topics.items()),
        table=_table(job, delay.file),
        services=tuple(NameRule(name, model_of(job, s)) for name, s in delay.services.items()),
        default=None if delay.default is None else model_of(job, delay.default),
        outages=tuple(
            OutageRule(*spec.what, Outage(start_ns + spec.from_ns, start_ns + spec.to_ns))
            for spec in delay.outages
        ),
        seed=job.seed,
        start_ns=start_ns,
    )


def _table(job: Job, file: str | None) -> tuple[NameRule, ...]:
    if file is None:
        return ()
    name = job.shown(file)
    rows = read_rslcpp(job.resolve(file), name)
    return tuple(
        NameRule(topic, model_of(job, spec), f"{name}:{line}")
        for topic, (line, spec) in rows.items()
    )


def model_of(job: Job, spec: DelaySpec) -> Model:
    """Return the model that a job describes."""
    burst = spec.burst
    return Model(
        delay=distribution_of(job, spec) if spec.kinds() else None,
        drop=spec.drop,
        burst=None
        if burst is None
        else Burst(burst.good_to_bad, burst.bad_to_good, burst.loss_bad, burst.loss_good),
        duplicate=spec.duplicate,
        keep_order=spec.keep_order,
        retransmit_ns=spec.retransmit_ns,
    )


def distribution_of(job: Job, spec: DistributionSpec) -> Distribution:
    """Return the distribution that a job describes; files are read."""
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
            return Samples(read_samples(samples, path, name))
        return Samples(samples.values_ns or ())
    if spec.empirical is not None:
        values, percent = spec.empirical.values_ns, spec.empirical.percent
        if percent is None:
            percent = tuple(100 * index / (len(values) - 1) for index in range(len(values)))
        return Empirical(percent, values)
    series = spec.series
    assert series is not None
    if series.file is not None:
        path, name = job.resolve(series.file), job.shown(series.file)
        return Series(read_series(series, path, name), series.steps)
    return Series(series.points or (), series.steps)
