"""``rsltrace init``: write a first job file from bags and nodes."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rsltrace.cli.output.text_file import write_text
from rsltrace.errors import BagError, OutputError
from rsltrace.terminal import say, tell
from rsltrace.trace.model.operation import NODE_TOPICS
from rsltrace.trace.model.texts import format_duration, format_seconds, printable

if TYPE_CHECKING:
    from rsltrace.job.reading.node_source import NodeSource


_HEAD = """\
# yaml-language-server: $schema=job.schema.json
# A job of rsltrace. Editors use the schema beside it to complete and check it.
# `rsltrace check {name}` checks it, `rsltrace record {name}` runs it.
# Every key is explained in docs/jobs.md.
"""
_SCHEMA = "job.schema.json"
_PLACES = (".", "src", "scripts", "..")
_TOPICS_MAX = 3
"""Topics of every node. The nodes of a run publish their own, so a bag should not play them."""


@click.command()
@click.argument(
    "job", type=click.Path(path_type=Path, dir_okay=False), default="job.yaml", required=False
)
@click.option(
    "--from",
    "sources",
    multiple=True,
    metavar="BAG|MODULE:CLASS|FILE.py:CLASS",
    help="A bag to play, or a node to run. Repeatable.",
)
def init(job: Path, sources: tuple[str, ...]) -> None:
    """Write a first job file with comments to JOB (default job.yaml), from bags and nodes.

    The file lists the topics, types and duration of each bag, and the name and declared parameters
    of each node. Nothing is imported or run, and an existing file is never replaced. The JSON
    Schema for editors is written beside it (job.schema.json).
    """
    if ":" in job.name and job.suffix not in (".yaml", ".yml"):
        raise click.UsageError(
            f"{job} names a node, not a job file: each node has a --from of its own, "
            f"as in: rsltrace init {' '.join(f'--from {s}' for s in (*sources, job))}"
        )
    if job.exists():
        raise OutputError(f"{job} exists; name another file, or remove it")
    folder = job.parent
    bags = [
        source
        for source in sources
        if not _is_python(source) and (":" not in source or Path(source).exists())
    ]
    nodes = [_look(source, folder) for source in sources if source not in bags]
    path = _search_path(nodes, folder, guess=not sources)
    text = "".join(_job_text(job, [_bag_text(bag, folder) for bag in bags], nodes, path))
    schema = folder / _SCHEMA
    has_schema = schema.exists()
    if not has_schema:
        write_text(schema, schema_text() + "\n")
    write_text(job, text)
    from rsltrace.job import load_job

    if sources:
        load_job(job)
    if path:
        why = "the nodes are there" if nodes else "there is Python code"
        tell(f"search_path: [{', '.join(path)}], relative to {job}: {why}")
    written = f"{job}" if has_schema else f"{job} and {schema}"
    tell(f"wrote {written}; next: rsltrace check {job}")


def _is_python(source: str) -> bool:
    return source.partition(":")[0].endswith(".py")


def _look(target: str, folder: Path) -> NodeSource:
    from rsltrace.job.reading.node_source import inspect_file, inspect_target

    if _is_python(target):
        return inspect_file(target)
    places = [folder / place for place in _PLACES]
    return inspect_target(target, [place for place in places if place.is_dir()])


def _search_path(nodes: list[NodeSource], folder: Path, *, guess: bool) -> list[str]:
    """Return where modules are, if that is not only beside the job; ``guess`` without any node."""
    found = {os.path.relpath(n.folder, folder) for n in nodes if n.folder is not None}
    if guess:
        found = {place for place in ("src", "scripts") if _holds_modules(folder / place)}
        packages = (path.parent.parent for path in (folder / "src").glob("*/*/__init__.py"))
        found |= {os.path.relpath(path, folder) for path in packages}
    return [".", *sorted(found - {"."})] if found - {"."} else []


def _holds_modules(folder: Path) -> bool:
    """Whether a folder has modules, or packages that are not those of colcon."""
    inner = (path for path in folder.glob("*/*.py") if path.name != "setup.py")
    return any(folder.glob("*.py")) or any(inner)


def _job_text(
    job: Path, bags: list[str], nodes: list[NodeSource], search_path: list[str]
) -> Iterator[str]:
    yield _HEAD.format(name=job)
    # A key without a value is a mistake, so of a job of bags alone this is a comment.
    yield "\n# nodes:\n" if bags and not nodes else "\nnodes:\n"
    for node in nodes:
        yield from _node_text(node)
    if not nodes:
        start = "#   - " if bags else "  - "
        yield f"{start}node: my_package.my_module:MyNode  # module:Class of a Node\n"
        yield "#     name: another_name\n#     parameters: {rate: 10.0}\n"
        yield "#     remappings: {odom: /robot/odom}\n"
    if search_path:
        yield f"search_path: {_yaml(search_path)}  # where modules are, before Python's own path\n"
    elif not nodes:
        yield "# search_path: [., ../src]  # where modules are, before Python's own path\n"
    yield "\n"
    if bags:
        yield "bags:\n"
        yield from bags
    else:
        yield "# bags: [path/to/bag]  # recordings to play in\n"
    yield "\n"
    if bags:
        yield "# stop: {duration: 60s}  # without it, the end of the bags ends the run\n"
    else:
        yield "stop:\n  duration: 10s  # of simulated time\n"
    yield from _checks_text(nodes)
    yield "# seed: 1  # of whatever is random\n"
    yield "# record: {exclude: [/camera/*]}  # payloads to leave out; hashes are always kept\n"


def _checks_text(nodes: list[NodeSource]) -> Iterator[str]:
    """Offer checks that fit the nodes."""
    topics = list(dict.fromkeys(topic for node in nodes for topic in node.topics))
    yield "# checks:  # what has to be true of every run: docs/checks.md\n"
    yield "#   - never: log error\n"
    for topic in topics[:_TOPICS_MAX] or ["/cmd_vel"] * (not nodes):
        yield f"#   - eventually: {topic}\n"
        yield f"#   - {{rate: {topic}, at_least: 1 Hz}}\n"


def _node_text(node: NodeSource) -> Iterator[str]:
    if node.is_main:
        yield f"  - main: {node.target}  # it runs as it is, and makes its nodes itself\n"
        return
    yield f"  - node: {node.target}\n"
    if node.name:
        yield f"    name: {_yaml(node.name)}\n"
    known = {name: value for name, value in node.parameters.items() if value is not None}
    if known:
        yield "    # parameters:  # as declared in its source\n"
        yield from (f"    #   {name}: {_yaml(value)}\n" for name, value in known.items())
    others = sorted(set(node.parameters) - set(known))
    if others:
        yield f"    # more parameters: {', '.join(others)}\n"


def _yaml(value: Any) -> str:
    from rsltrace.job.documents.reference import flow

    return flow(list(value) if isinstance(value, tuple) else value)


def _bag_text(source: str, folder: Path) -> str:
    from rsltrace.run.plans.bags import never_plays
    from rsltrace.trace.recordings import open_bag

    try:
        with open_bag(source, recover=True, skip=never_plays) as bag:
            path = os.path.relpath(source, folder).replace(os.sep, "/")
            length = format_duration(bag.end_ns - bag.start_ns)
            lines = [
                f"  - path: {_yaml(path)}",
                f"    # from {format_seconds(bag.recording_start_ns)} s on, {length} long",
                *(f"    # note: {printable(note)}" for note in bag.notes),
                "    topics:",
            ]
            names = [_yaml(topic.name) for topic in bag.topics]
            width = max(map(len, names))
            heard = [topic for topic in bag.topics if topic.name not in NODE_TOPICS]
            lines += [
                f"      {'-' if topic in heard or not heard else '# -'} "
                f"{name:<{width}}  # {printable(topic.type_name)}, {topic.message_count} messages"
                for name, topic in zip(names, bag.topics, strict=True)
            ]
            if bag.skipped:
                lines.append(f"    # not played: {printable(', '.join(bag.skipped))}")
            lines += ["    # rate: 1.0", "    # remappings: {/recorded: /other}"]
            return "\n".join(lines) + "\n"
    except BagError as error:
        raise BagError(
            f"{error} (a node is named as module:Class or path/to/file.py:Class)"
        ) from None


@click.command()
def schema() -> None:
    """Print the JSON Schema (draft 2020-12) of job files.

    \b
    For completion and checks in VS Code (with Red Hat's YAML extension) and other editors, run
      rsltrace schema > job.schema.json
    and put this line at the top of the job file:
      # yaml-language-server: $schema=job.schema.json
    """
    say(schema_text())


def schema_text() -> str:
    from rsltrace.job.documents.schema import job_schema

    return json.dumps(job_schema(), indent=2)
