"""Measured times as ``delay:``, ``execution:`` and ``executors:`` of a job."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from io import StringIO
from typing import Any

import numpy as np
import numpy.typing as npt

from rsltrace.checks.latency.instances import Durations
from rsltrace.job import Job
from rsltrace.native.fit.measurement import CallbackDurations, LinkTimes, NativeTimes
from rsltrace.native.fit.models import FEW, DurationModel, as_job_has_it, model_of, series_of
from rsltrace.trace.model.texts import counted, format_duration, format_seconds, printable

_UNITS = ((1_000_000_000, "s"), (1_000_000, "ms"), (1_000, "us"))
TABLES, DISTRIBUTIONS, SERIES = ("tables", "distributions", "series")
OWN_POLICY = "priority"
"""What native executors go by whose priorities are those of the job's own policy."""
_TAIL_NS = 500_000
_TAIL_SHARE = 0.1
_TIED = 0.3
"""From this correlation of each time with the one before on, they hang together."""


@dataclass(frozen=True, slots=True)
class Fit:
    """What was measured, with a model each; links and callbacks without a duration have none."""

    links: tuple[tuple[LinkTimes, DurationModel], ...]
    executions: tuple[tuple[CallbackDurations, DurationModel], ...]
    measured: NativeTimes


def fit(measured: NativeTimes, how: str = TABLES) -> Fit:
    """Return models of the measured times: ``tables``, ``distributions`` or ``series``.

    :raises SetupError: of ``distributions``, if SciPy is missing.
    """

    def model(since: Durations, durations: Durations) -> DurationModel:
        if how == SERIES:
            return series_of(since, durations)
        return model_of(durations, family=how == DISTRIBUTIONS)

    links = [(one, model(one.since, one.delays)) for one in measured.links if len(one.delays)]
    executions = [(one, model(one.since, one.busy)) for one in measured.executions]
    return Fit(tuple(links), tuple(executions), measured)


def with_files(fit: Fit, folder: str) -> tuple[Fit, dict[str, str]]:
    """Return a fit whose series are in files of a folder, and these: names and texts."""
    texts: dict[str, str] = {}

    def placed(model: DurationModel, what: str) -> DurationModel:
        if not model.points:
            return model
        name = f"{folder}/{len(texts) + 1}.csv"
        rows = (f"{format_seconds(at)},{format_seconds(took)}\n" for at, took in model.points)
        texts[name] = f"s since the start,{printable(what).replace(',', ' ')} in s\n{''.join(rows)}"
        return replace(model, values={**model.values, "file": name})

    links = tuple((one, placed(model, f"delay of {one}")) for one, model in fit.links)
    executions = tuple(
        (one, placed(model, f"execution of {one.node}: {one.entity}"))
        for one, model in fit.executions
    )
    return Fit(links, executions, fit.measured), texts


def fitted_job(fit: Fit, job: Job, base: str, head: str, settings: Mapping[str, Any]) -> str:
    """Return the text of a job that is ``base`` (a path) with the measured times.

    ``job`` is the one that ``base`` names; ``head`` are the lines of a comment. ``settings`` are
    what else was said of the run, as a job file says it.
    """
    own = {key: value for key, value in settings.items() if key not in _replaced(fit)}
    values: dict[str, Any] = {"base": base, **own, "delay": _delay(fit, job)}
    execution = {
        "entities": [
            {"node": one.node, "entity": one.entity, **as_job_has_it(model, time_text)}
            for one, model in fit.executions
        ]
    }
    if job.execution is not None:
        execution = {**_without(job.execution, "default", "nodes"), **execution}
    values["execution"] = execution
    executors: Any = [
        {"nodes": list(one.nodes), "workers": one.threads}
        for one in fit.measured.executors
        if len(one.nodes) > 1 or one.threads > 1
    ]
    if executors or job.executors is not None:
        values["executors"] = executors or "per_node"
    policy = fit.measured.policy
    if policy != OWN_POLICY and (policy is not None or job.policy is not None):
        values["policy"] = policy or "fifo"
    return "".join(f"# {line}\n" for line in head.splitlines()) + _yaml(values)


def _delay(fit: Fit, job: Job) -> dict[str, Any]:
    links: list[dict[str, Any]] = []
    services: dict[str, Any] = {}
    for link, model in sorted(fit.links, key=lambda pair: pair[0].sender is None):
        said = as_job_has_it(model, time_text)
        if link.is_service:
            services[link.topic] = said
        else:
            sender = {} if link.sender is None else {"from": link.sender}
            links.append({"topic": link.topic, **sender, "to": link.receiver, **said})
    found: dict[str, Any] = {}
    if job.delay is not None:
        found = _without(job.delay, "default", "topics", "links", "services", "outages", "file")
    if links:
        found["links"] = links
    if services:
        found["services"] = services
    return found


def _without(part: Any, *keys: str) -> dict[str, Any]:
    """Return what takes away the keys that a part of the base has."""
    return {key: None for key in keys if getattr(part, key)}


def time_text(time_ns: int) -> str:
    """Return a time as a job file says it: ``4.81ms``."""
    for scale, unit in _UNITS:
        if time_ns >= scale:
            return f"{time_ns / scale:.15g}{unit}"
    return f"{time_ns}ns"


def _yaml(values: dict[str, Any]) -> str:
    from ruamel.yaml import YAML
    from ruamel.yaml.comments import CommentedMap, CommentedSeq
    from ruamel.yaml.representer import RoundTripRepresenter

    def laid_out(value: Any) -> Any:
        """Put what holds nothing but texts and numbers into one line."""
        made: Any
        if isinstance(value, dict):
            made = CommentedMap((key, laid_out(inner)) for key, inner in value.items())
        elif isinstance(value, list):
            made = CommentedSeq(map(laid_out, value))
        else:
            return value
        inner = value.values() if isinstance(value, dict) else value
        if not any(isinstance(one, (dict, list)) for one in inner):
            made.fa.set_flow_style()
        return made

    class NullRepresenter(RoundTripRepresenter):
        """Writes ``null`` where YAML would have nothing."""

    NullRepresenter.add_representer(
        type(None), lambda dumper, _: dumper.represent_scalar("tag:yaml.org,2002:null", "null")
    )
    yaml = YAML()
    yaml.width = 100
    yaml.indent(mapping=2, sequence=4, offset=2)
    yaml.Representer = NullRepresenter
    stream = StringIO()
    yaml.dump(laid_out(values), stream)
    return stream.getvalue()


def notes(fit: Fit, job: Job) -> Iterator[str]:
    """Yield what somebody should know who takes the simulation for the robot."""
    found = fit.measured
    if found.steps:
        yield f"the system clock was set {found.steps} times: what was on its way then is left out"
    for link in found.links:
        yield from _of_link(link)
    if found.unknown:
        yield (
            f"of {found.unknown} messages nobody knows who sent them (a process that was not "
            "observed, or one that had ended)"
        )
    for one in found.executions:
        yield from _of_execution(one)
    counts = [len(one.delays) for one in found.links] + [len(one.busy) for one in found.executions]
    if few := sum(0 < count < FEW for count in counts):
        yield (
            f"{few} of the {len(counts)} delays and execution times were measured fewer than {FEW} "
            "times, which says little of the tail"
        )
    tied = [(one.tied, one) for one, model in fit.executions if not model.points]
    for by, one in tied:
        if len(one.busy) >= FEW and by > _TIED:
            yield (
                f"{one.node}: {one.kind} {one.entity}: its times hang together (correlation with "
                f"the one before {by:.2f}), those of the simulation do not (--as series)"
            )
    for node, entity in found.idle:
        yield f"{node}: the callback of {entity} never ran: it takes no time in the simulation"
    if found.tasks:
        yield f"{found.tasks} tasks: a job cannot say how long they take, in the simulation nothing"
    replaced = [key for key in _replaced(fit) if getattr(job, key) is not None]
    if replaced:
        yield f"in place of the job's own {', '.join(replaced)}, which have no effect natively"


def _replaced(fit: Fit) -> tuple[str, ...]:
    """Return what of a job had no effect natively: in its place comes what was measured."""
    parts = ("delay", "execution", "executors")
    return parts if fit.measured.policy == OWN_POLICY else (*parts, "policy")


def _of_link(link: LinkTimes) -> Iterator[str]:
    if link.negative:
        yield (
            f"{link}: {link.negative} messages were received before they were sent, so clocks "
            "disagree; these are left out"
        )
    if link.history:
        yield (
            f"{link}: left out {counted(link.history, 'message')} sent before the subscription "
            "was created (history of a late joiner)"
        )
    if not len(link.delays):
        yield f"{link}: no delay is known; it is without delay"
    if link.missing:
        yield (
            f"{link}: {counted(link.missing, 'message')} did not arrive, lost or pushed out of a "
            "queue; the fitted job loses none on the way (see drop: in docs/delays.md)"
        )


def _of_execution(one: CallbackDurations) -> Iterator[str]:
    name = f"{one.node}: {one.kind} {one.entity}"
    count = len(one.busy)
    if one.parts:
        yield (
            f"{name}: {one.parts} of {count} runs awaited something, and the simulation takes time "
            "for the part before that only"
        )
    if one.cut:
        yield f"{name}: {one.cut} runs took so long that only their first part is known"
    median = sorted(one.busy.tolist())[count // 2]
    if one.tail_ns > max(_TAIL_NS, _TAIL_SHARE * median):
        yield (
            f"{name}: what it sends leaves {format_duration(one.tail_ns)} (median) before its end, "
            "in the simulation at its end"
        )


# What was measured and what a simulation draws, as a picture: shares of values below a time.

Numbers = npt.NDArray[np.float64]
_COLUMNS = 3
_INCHES = (4.2, 2.8)
_PANELS_MAX = 60
_POINTS_MAX = 2_000
_MS = 1e6
_WIDE = 5
"""From so many medians to the longest on, the axis is logarithmic."""


def picture_of(fit: Fit, title: str) -> Any:
    """Return a panel for each link and each callback, up to 60, those with the most values first,
    as a figure of matplotlib's."""
    from matplotlib.figure import Figure

    panels = sorted(_panels(fit), key=lambda panel: -len(panel[1]))[:_PANELS_MAX]
    panels.sort(key=lambda panel: panel[0])
    rows = -(-len(panels) // _COLUMNS) or 1
    width, height = _INCHES
    figure = Figure(figsize=(width * _COLUMNS, height * rows + 0.6), layout="constrained")
    figure.suptitle(printable(f"{os.path.basename(title)}: measured, and what a simulation draws"))
    for place, (name, durations, model) in enumerate(panels):
        axes = figure.add_subplot(rows, _COLUMNS, place + 1)
        for values, label, line in (
            (durations, f"measured ({len(durations)})", "-"),
            (model.draws(), f"{model.kind}, D {model.distance:.3f}", "--"),
        ):
            x, y = _shares(values)
            axes.plot(x, y, line, label=label, drawstyle="steps-post")
        if model.draws().min() > 0 and durations.max() > _WIDE * np.median(durations):
            axes.set_xscale("log")
        axes.set_title(_plain(name), fontsize=8)
        axes.set_xlabel("ms", fontsize=8)
        axes.tick_params(labelsize=7)
        axes.set_ylim(0, 100)
        axes.set_ylabel("% below", fontsize=8)
        axes.legend(fontsize=7, loc="lower right")
    return figure


def _panels(fit: Fit) -> Iterator[tuple[str, Durations, DurationModel]]:
    for link, model in fit.links:
        yield f"delay  {link}", link.delays, model
    for one, model in fit.executions:
        yield f"execution  {one.node}: {one.kind} {one.entity}", one.busy, model


def _plain(name: str) -> str:
    """Return a name without what matplotlib takes for mathematics."""
    return printable(name).replace("$", r"\$")


def _shares(values: Durations) -> tuple[Numbers, Numbers]:
    """Return times in ms, and the percentage of values that do not exceed each."""
    places = np.unique(np.linspace(0, len(values) - 1, min(len(values), _POINTS_MAX)).astype(int))
    return np.sort(values)[places] / _MS, (places + 1) * 100 / len(values)
