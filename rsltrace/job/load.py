"""From a job file to a ``Job``: every mistake becomes an error with file, line and column."""

from __future__ import annotations

import os
from pathlib import Path

from pydantic import ValidationError

from rsltrace.errors import JobError
from rsltrace.job.job import Job
from rsltrace.job.part import FROM_FILE
from rsltrace.job.problems import Problem, format_loc, problems_of, unknown_key
from rsltrace.job.yaml_source import Mark, YamlSource, parse_yaml

SIZE_MAX = 16 << 20
"""A job file of more bytes is something else."""


def load_job(path: str | os.PathLike[str]) -> Job:
    """Return the job in the YAML file ``path``; relative paths in it start at its folder.

    Imports neither rclpy nor user code. Raises ``JobError`` with ``file:line:column``, the line
    itself and what is expected; several mistakes are reported together, in the order of the file.
    """
    name = os.fspath(path)
    source = parse_yaml(_read(Path(name)), name)
    if source.value is None:
        raise JobError("the job file is empty: it needs at least 'nodes:' or 'bags:'", where=name)
    if not isinstance(source.value, dict):
        raise source.error("a job is a mapping (nodes: ..., stop: ...)", source.mark(()))

    file_keys = [
        field.alias or name for name, field in Job.model_fields.items() if not field.exclude
    ]
    values: dict[str, object] = {}
    problems: list[Problem] = []
    for key, value in source.value.items():
        if key in file_keys:
            values[key] = value
        else:
            problems.append(unknown_key(key, file_keys, ()))
    values["base_dir"] = os.path.dirname(os.path.abspath(name))
    values["source_name"] = name
    values["source_text"] = source.text
    try:
        job = Job.model_validate(values, context=FROM_FILE)
    except ValidationError as error:
        problems += problems_of(error, Job)
    if problems:
        raise _job_error(source, problems)
    return job


def _read(path: Path) -> str:
    name = str(path)
    try:
        with path.open("rb") as file:
            data = file.read(SIZE_MAX + 1)
    except FileNotFoundError:
        raise JobError("there is no such job file", where=name) from None
    except IsADirectoryError:
        inside = path / "job.yaml"
        advice = f"name the job file in it: {inside}" if inside.is_file() else "name a job file"
        raise JobError(f"this is a folder; {advice}", where=name) from None
    except OSError as error:
        raise JobError(f"cannot read the job file: {error.strerror}", where=name) from None
    if len(data) > SIZE_MAX:
        raise JobError(f"larger than {SIZE_MAX >> 20} MiB: this is not a job file", where=name)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        good = data[: error.start].decode("utf-8-sig", "replace")
        line, column = good.count("\n") + 1, len(good) - good.rfind("\n")
        raise JobError(
            f"not UTF-8: byte 0x{data[error.start]:02x}; save the file as UTF-8 text",
            where=f"{name}:{line}:{column}",
        ) from None


def _job_error(source: YamlSource, problems: list[Problem]) -> JobError:
    """Return one error that tells all problems, the first in the file first."""
    placed: list[tuple[Mark, str]] = sorted(
        ((source.mark(p.loc, at_key=p.at_key), p.message) for p in problems),
        key=lambda item: (item[0].line, item[0].column),
    )
    text = ""
    for mark, message in placed:
        head = f"\n{source.where(mark)}: " if text else ""
        text += f"{head}{message}{source.excerpt(mark)}"
    return JobError(text, where=source.where(placed[0][0]))


def locate(job: Job, loc: tuple[str | int, ...]) -> str:
    """Return where in its file a part of a job stands: ``job.yaml:3:11``.

    For mistakes that show only when the run begins. A job built in Python has no lines; its parts
    are named instead: ``<python>: nodes[0].node``.
    """
    if job.given_text is None:
        return f"{job.source_name}: {format_loc(loc)}"
    source = parse_yaml(job.given_text, job.source_name)
    return source.where(source.mark(loc))
