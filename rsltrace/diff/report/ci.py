"""Diffs for continuous integration: JUnit XML and GitHub's annotations."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

from rsltrace.diff.options import DiffOptions
from rsltrace.diff.report.line import plain_text
from rsltrace.diff.report.text import report_lines
from rsltrace.diff.result import BagDiff, Diff
from rsltrace.trace.model.texts import printable
from rsltrace.trace.words.phrases import as_sentence

_NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def junit(
    diffs: Sequence[Diff | BagDiff], options: DiffOptions, errors: Mapping[str, str] | None = None
) -> str:
    """Return a JUnit test suite with one test case per comparison, and one for each of ``errors``:
    what could not be compared, and why."""
    errors = errors or {}
    failures = sum(diff.failed for diff in diffs)
    tests = len(diffs) + len(errors)
    counts = f'tests="{tests}" failures="{failures}" errors="{len(errors)}" skipped="0"'
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', f"<testsuites {counts}>"]
    lines.append(f'  <testsuite name="rsltrace diff" {counts}>')
    for diff in diffs:
        name = _attribute(f"{diff.b.path} agrees with {diff.a.path}")
        lines.append(f'    <testcase classname="rsltrace.diff" name={name}>')
        report = _xml(plain_text(report_lines(diff, options)))
        if diff.failed:
            lines.append(
                f"      <failure type={_attribute(diff.verdict.value)} "
                f"message={_attribute(_message(diff))}>{report}</failure>"
            )
        else:
            lines.append(f"      <system-out>{report}</system-out>")
        lines.append("    </testcase>")
    for what, why in errors.items():
        lines.append(f'    <testcase classname="rsltrace.diff" name={_attribute(what)}>')
        lines.append(f"      <error message={_attribute(why)}>{_xml(why)}</error>")
        lines.append("    </testcase>")
    lines += ["  </testsuite>", "</testsuites>"]
    return "\n".join(lines) + "\n"


def github(
    diffs: Sequence[Diff | BagDiff], options: DiffOptions, errors: Mapping[str, str] | None = None
) -> str:
    """Return workflow commands: an error per comparison that failed or could not be made, a notice
    per other one."""
    lines = []
    for diff in diffs:
        level = "error" if diff.failed else "notice"
        how = "diverges from" if diff.diverged else "compared with"
        title = f"rsltrace: {diff.b.path} {how} {diff.a.path}: {diff.verdict.value}"
        text = plain_text(report_lines(diff, options)) if diff.failed else _message(diff)
        place = f"{_place(diff)},title={command_property(printable(title))}"
        lines.append(f"::{level} {place}::{command_data(text)}")
        if isinstance(diff, Diff):
            for setting in diff.settings:
                if setting.line:
                    change = f"{_side(setting.a)} became {_side(setting.b)}"
                    place = f"file={command_property(printable(setting.name))},line={setting.line}"
                    lines.append(
                        f"::notice {place},title=rsltrace%3A job differs::{command_data(change)}"
                    )
    for what, why in (errors or {}).items():
        title = command_property(printable(f"rsltrace: cannot check that {what}"))
        lines.append(f"::error title={title}::{command_data(why)}")
    return "".join(f"{row}\n" for row in lines)


def _place(diff: Diff | BagDiff) -> str:
    """Return what an annotation points to: the line that sent what differs first, or the function
    that ran where two runs diverge, if it is here, or else the file that was compared."""
    found = diff.shown if isinstance(diff, Diff) else None
    views = () if found is None else (found.b, found.a)
    sent = [one.code[0] for one in found.messages[:1] if len(one.code) == 1] if found else []
    for code in (*sent, *(view.code for view in views if view is not None)):
        name, _, number = code.rpartition(":")
        if Path(name).is_file():
            return f"file={command_property(printable(name))},line={number}"
    return f"file={command_property(printable(diff.a.path))}"


def _message(diff: Diff | BagDiff) -> str:
    tolerated = isinstance(diff, Diff) and diff.within_tolerance
    return as_sentence(diff.sentence) + (
        " Equal within tolerance, not identical." if tolerated else ""
    )


def _side(text: str | None) -> str:
    return "nothing" if text is None else printable(text.strip())


def _xml(text: str) -> str:
    return escape(_NOT_IN_XML.sub("\ufffd", text))


def _attribute(text: str) -> str:
    return quoteattr(_NOT_IN_XML.sub("\ufffd", printable(text)))


def command_data(text: str) -> str:
    """Return text as the message of a workflow command."""
    return text.rstrip("\n").replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def command_property(text: str) -> str:
    """Return text as a property of a workflow command."""
    return command_data(text).replace(":", "%3A").replace(",", "%2C")
