"""The report as text, of any comparison."""

from __future__ import annotations

from collections.abc import Sequence

from rsltrace.diff.facts.evidence import Setting
from rsltrace.diff.facts.remarks import MoreDivergences, Remark
from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report.line import (
    BLANK,
    HEIGHT,
    NOTHING,
    Line,
    Piece,
    Section,
    Style,
    cut,
    fitted,
    head_lines,
    in_columns,
    line,
    next_section,
    notes_section,
    wrapped,
)
from rsltrace.diff.result import BagDiff, ComparedRun, Diff, Divergence
from rsltrace.diff.sentences.runs import ALL_HINT, recordings_sentence, remark_text
from rsltrace.diff.sentences.values import setting_name
from rsltrace.trace.model.texts import contrasting_texts, format_seconds, printable
from rsltrace.trace.words.phrases import as_sentence, seconds_text

# The report of two traces as a person reads it: verdict first, on one screen.


_ALIKE_SHOWN = 12
_NARROW = 70


def trace_report(
    diff: Diff, options: DiffOptions, width: int = 100, height: int = HEIGHT
) -> list[Line]:
    """Return the report of two traces, at most ``height`` lines unless ``options.everything``."""
    head = _head(diff, width)
    hidden = any(map(_is_hint, diff.remarks))
    # First what else to know of the comparison: that the jobs are different ones, or a file cut.
    before = notes_section([remark_text(one) for one in diff.remarks if not _is_hint(one)], width)
    if diff.native is not None:
        from rsltrace.diff.report.bag_text import native_sections

        found = native_sections(diff.native, options, width)
        return fitted(head, [before, *found], None if options.everything else height)
    if not diff.divergences:  # identical, cut, or of different jobs
        return fitted(head, [before, _settings(diff, width)], None)
    # Most runs are identical: their report loads no more than this.
    from rsltrace.diff.report.divergence import CONTEXT, divergence_sections

    first, *others = diff.divergences
    shown = diff.shown or first
    sections = [
        before,
        *divergence_sections(shown, width, options),
        _afterwards(diff, width),
        _settings(diff, width),
    ]
    if not options.everything:
        # Whoever asks for a longer context wants to see it.
        height += 2 * max(options.context - CONTEXT, 0)
        return fitted(head, [*sections, _next(shown, len(others), width, hidden=hidden)], height)
    lines = fitted(head, [*sections, _next(shown, 0, width)], None)
    for number, other in enumerate(others, start=2):
        lines += [
            BLANK,
            line((f"independent divergence {number}: {other.verdict.value}", Style.TITLE)),
        ]
        lines += wrapped(as_sentence(other.sentence), width, style=Style.BAD)
        lines += fitted(
            [], [*divergence_sections(other, width, options), _next(other, 0, width)], None
        )
    return lines


def _is_hint(remark: Remark) -> bool:
    return isinstance(remark, MoreDivergences) and not remark.all_shown


def _head(diff: Diff, width: int) -> list[Line]:
    agree = f"the first {diff.agreeing} events agree"
    if diff.agreeing < 2:
        agree = "the first event agrees" if diff.agreeing else "the first events already differ"
    if diff.agrees_until_cut and not diff.agreeing:
        agree = "no event could be compared"
    verdict = "" if diff.identical else f"{diff.verdict.value}; {agree}"
    if diff.native is not None:
        verdict = f"{diff.verdict.value}; times and fields named stamp are not compared"
    verdict += "; this is the first effect" if diff.effect is not None else ""
    sides = [_facts(side, width) for side in (diff.a, diff.b)]
    same = diff.native is not None and diff.within_tolerance
    good = diff.identical or same or (diff.agrees_until_cut and not diff.failed)
    lines = head_lines(diff.sentence, sides, verdict, width, good=good)
    return lines + ([] if diff.identical or diff.native else _tolerance(diff, width))


def _tolerance(diff: Diff, width: int) -> list[Line]:
    if diff.tolerance is None:
        return []
    if diff.within_tolerance:
        tolerated = any(topic.tolerated for topic in diff.tolerance.topics)
        how = "within tolerance" if tolerated else "except for ignored fields"
        text = f"equal {how}, not identical: the digests differ"
    else:
        said = printable(recordings_sentence(diff.tolerance, "the messages"))
        text = f"not within tolerance: {said}"
    return wrapped(f"  {text}", width, style=Style.TITLE, indent="    ")


def _facts(side: ComparedRun, width: int) -> list[Piece]:
    narrow = width < _NARROW
    time = seconds_text(side.end_ns) if narrow else format_seconds(side.end_ns)
    ended = side.stop_reason or ("" if side.complete else "truncated")
    return [
        (printable(side.path), ""),
        (f"{side.events} events", ""),
        (f"{time} s", ""),
        (side.digest if narrow else f"digest {side.digest}" if side.digest else "native", ""),
        (printable(ended), Style.FAINT),
    ]


def _afterwards(diff: Diff, width: int) -> Section:
    if not diff.counts:
        return NOTHING
    total = [
        sum(getattr(count, name) for count in diff.counts)
        for name in ("matching", "differing", "only_a", "only_b")
    ]
    text = (
        f"after it, up to event {diff.aligned_to[0]} of a and {diff.aligned_to[1]} of b: "
        f"{total[0]} events match, {total[1]} differ, {total[2]} only in a, {total[3]} only in b"
    )
    if diff.resync_index is not None:
        a, b = diff.resync_index
        text += f"; the runs agree again from event {a} of a and {b} of b"
    rows = wrapped(text, width, indent="  ")
    least = len(rows)
    worst = sorted(diff.counts, key=lambda c: c.differing + c.only_a + c.only_b, reverse=True)
    for count in worst:
        diverged = count.differing + count.only_a + count.only_b
        if diverged:
            of = diverged + count.matching
            entity = printable(str(count.entity))
            rows.append(cut(line(f"  {diverged} of {of} differ  {entity}"), width))
    return Section((), rows, least, "entities", least, rank=9, fixed=least)


def _settings(diff: Diff, width: int) -> Section:
    if not diff.settings:
        return NOTHING
    title: Piece = ("settings that differ", Style.TITLE)
    room = max((width - 40) // 2, 16)
    table = [
        [
            (printable(setting_name(setting)), ""),
            (a, Style.SIDE_A),
            ("|", Style.FAINT),
            (b, Style.SIDE_B),
        ]
        for setting in diff.settings
        for a, b in [_values(setting, room)]
    ]
    rows = in_columns(table, widest=max(room, 34))
    told = 8 if diff.shown is not None and diff.shown.settings else 4
    if len(rows) == 1:
        alone = line(title, ": ", *rows[0][1:])
        if sum(len(text) for text, _ in alone) <= width:
            return Section((), [alone], 1, "settings", rank=told)
    shown: list[Line] = []
    for row, (place, a, _, b) in zip(rows, table, strict=True):
        if sum(len(text) for text, _ in row) <= width:
            shown.append(row)
        else:  # what differs must not be cut off
            shown += [cut(line("  ", place), width)]
            shown += [line("    ", a, ("  |  ", Style.FAINT), b)]
    return Section(line(title), shown, 2, "lines", rank=told)


def _values(setting: Setting, room: int) -> tuple[str, str]:
    """Return both values in ``room`` characters each: of long ones, what differs."""
    a, b = ("-" if v is None else v.strip() for v in (setting.a, setting.b))
    return contrasting_texts(a, b, room, before=_ALIKE_SHOWN)


def _next(found: Divergence, others: int, width: int, *, hidden: bool = False) -> Section:
    count = f"more than {others}" if hidden else str(others)
    word = "divergence" if count == "1" else "divergences"
    more = [f"{count} more independent {word}: {ALL_HINT}"] if others else []
    return next_section(found.next_step, *more, width=width)


def report_lines(
    diff: Diff | BagDiff | Sequence[Diff | BagDiff],
    options: DiffOptions,
    *,
    width: int = 100,
    height: int = HEIGHT,
) -> list[Line]:
    """Return the report for people as lines of styled pieces (see ``report.line``).

    ``width`` and ``height`` are those of the screen it is to fit.
    """
    if isinstance(diff, Diff):
        return trace_report(diff, options, width, height)
    if not isinstance(diff, Sequence):
        from rsltrace.diff.report.bag_text import bag_report

        return bag_report(diff, options, width, height)
    if len(diff) == 1:
        return report_lines(diff[0], options, width=width, height=height)
    from rsltrace.diff.report.several import several_report

    return several_report(diff)
