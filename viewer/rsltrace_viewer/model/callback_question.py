"""What `rsltrace why` is asked about the selected event, and what it answers."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import replace

from rsltrace.diff.why.answer import answer_lines, why
from rsltrace.diff.why.question import WITH_CALLBACK
from rsltrace.errors import TraceError
from rsltrace.fast_dataclass import dataclass
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.model.texts import printable
from rsltrace.trace.words.phrases import path_word, seconds_text
from rsltrace_viewer.model.run import Run


@dataclass(frozen=True, slots=True)
class CallbackQuestion:
    """Why a callback of ``node`` did not run in ``run`` (run b: ``other``), or ran late: ``what``
    names it, ``at_ns`` is the time asked about (None: the whole run). If nothing is wrong until
    then, it is asked about ``ran_ns``, when the callback ran."""

    run: Run
    other: bool
    node: str
    what: str
    at_ns: int | None = None
    ran_ns: int | None = None

    @property
    def command(self) -> str:
        names = (shlex.quote(self.node), shlex.quote(self.what))
        at = ""
        if self.at_ns is not None:
            at = f" --at {seconds_text(self.at_ns - self.run.start_ns)}"
        return printable(" ".join(("rsltrace why", path_word(self.run.trace.name), *names)) + at)

    def answers(self) -> Iterator[tuple[str, list[str], int | None]]:
        """Yield the command that answers, the lines of the answer, and the event to look at."""
        try:
            reason = why(self.run.trace, self.node, self.what, self.at_ns)
        except TraceError as error:
            yield self.command, [printable(str(error))], None
            return
        if self.ran_ns is not None and not reason.is_reason:
            yield from replace(self, at_ns=self.ran_ns, ran_ns=None).answers()
        else:
            yield self.command, [*answer_lines(reason)], reason.event


def question_about(
    run: Run, index: int, *, other: bool, lacking: Run | None
) -> CallbackQuestion | None:
    """Return the question about an event (``other``: of run b); if a run is ``lacking`` it, why it
    did not come there. None: it is no callback of a subscription, timer, service or client."""
    event = run.event(index)
    entity = run.entities.get(event.entity)
    if entity is None or entity.kind not in WITH_CALLBACK:
        return None
    node, at_ns = run.trace.node_of(entity).name, event.stamp_ns
    if lacking is not None:
        return CallbackQuestion(lacking, not other, node, entity.name, at_ns)
    if entity.kind is EntityKind.TIMER:
        at_ns -= 1  # what was before this call
    elif event.kind is not EventKind.RESUME and 0 <= event.cause_event < index:
        at_ns = run.stamp(event.cause_event)  # when what it received was sent
    same = [e for e in run.entities.values() if (e.node, e.name) == (entity.node, entity.name)]
    alone = sum(one.kind in WITH_CALLBACK for one in same) == 1
    name = entity.name if alone else str(entity.id)
    return CallbackQuestion(run, other, node, name, at_ns, event.stamp_ns)
