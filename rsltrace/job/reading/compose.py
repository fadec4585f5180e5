"""One job from several files: ``base:`` to extend, ``include:`` to add, ``vars:`` to fill in.

What comes later has the last word: the base, then the included files in their order, then the file
itself, then ``--set``. The rules are in ``docs/jobs.md`` and in ``merge``.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from rsltrace.errors import JobError
from rsltrace.fast_dataclass import dataclass
from rsltrace.job.job import Job
from rsltrace.job.parts.field import Field
from rsltrace.job.parts.keys import shorthand_at, without_alternatives
from rsltrace.job.parts.part import JobPart
from rsltrace.job.reading.override import apply_override
from rsltrace.job.reading.substitute import JobSubstitution
from rsltrace.job.reading.yaml_source import SourcePlace, TextPosition, YamlSource, YamlValue
from rsltrace.job.values.checks import attach, check, check_names, is_plain, items, text
from rsltrace.job.values.mappings import check_path, near_path
from rsltrace.job.values.names import check_variable
from rsltrace.job.values.problem import JobProblem, Loc, ProblemCollector, describe

DEPTH_MAX = 20
_WHAT = frozenset(("node", "main", "executable", "script", "module", "launch"))
"""Keys that say what an entry of ``nodes`` is; without one it changes another file's entry."""


def _paths(value: object) -> tuple[object, ...]:
    return items(check_path)([value] if isinstance(value, str) else value)


_PATH = {"type": "string", "minLength": 1}
attach(_paths, schema={"anyOf": [_PATH, {"type": "array", "items": _PATH}]})


def _variables(value: object) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise JobProblem(f"expected a mapping of names to values, got {describe(value)}")
    check_names(value, check_variable)
    problems = ProblemCollector()
    for name, inner in value.items():
        with problems.at(name):
            if inner is None or isinstance(inner, (dict, list)):
                raise JobProblem(
                    f"a variable is text, a number, true or false, got {describe(inner)}"
                )
    problems.check()
    return value


_SCALAR = {"type": ["string", "number", "boolean"]}
_NAMES = {"pattern": check_variable.pattern}  # type: ignore[attr-defined]
attach(
    _variables,
    schema={"type": "object", "propertyNames": _NAMES, "additionalProperties": _SCALAR},
)


class CompositionKeys(JobPart):
    """The keys that say what a job file is put together from. They are gone once it is read."""

    base: Annotated[str | None, check(text(), optional=True)] = Field(
        default=None,
        description="A job file to extend. Mappings are merged key by key, entries of "
        "`nodes` by `name`; other lists replace the base's, and `null` removes "
        "a key.",
        examples=["../robot/job.yaml"],
    )
    include: Annotated[tuple[str, ...], check(_paths)] = Field(
        default=(),
        description="Job files to merge, later ones over earlier ones. Their `nodes`, `launch` "
        "and `bags` are added before this file's.",
        examples=[["sensors.yaml", "../common/recording.yaml"]],
    )
    vars: Annotated[dict[str, Any], check(_variables)] = Field(
        default_factory=dict,
        description="Values for `$(var NAME)`; `--set vars.NAME=...` overrides them. Texts "
        "may also contain `$(env NAME default)`, `$(find-pkg-share PACKAGE)`, "
        "`$(find-pkg-prefix PACKAGE)`, `$(dirname)` and `\\$(` for a plain `$(`."
        " Unquoted texts are parsed again.",
        examples=[{"robot": "husky", "rate": 50.0}],
    )


@dataclass(eq=False)
class ComposedJob:
    """A job put together: its values, its own file, and from what else it was made."""

    root: YamlValue
    source: YamlSource
    others: list[str] = field(default_factory=list)
    overrides: list[str] = field(default_factory=list)
    substituted: bool = False

    @property
    def is_plain(self) -> bool:
        """Say whether the file's text is the whole job."""
        return not (self.others or self.overrides or self.substituted)

    def header(self) -> str:
        """Return a comment that says what the job was made of."""
        lines = [f"# The effective job of {os.path.basename(self.source.name)}"]
        lines += [f"#   with {name}" for name in self.others]
        lines += [f"#   with {text}" for text in self.overrides]
        return "".join(f"{' '.join(line.splitlines())}\n" for line in lines)


def compose(
    name: str,
    read: Callable[[str], YamlSource],
    overrides: Sequence[tuple[str, str]],
    folder: str,
) -> ComposedJob:
    """Return the job of the file ``name``, which ``read`` parses, with overrides applied.

    An override is (what messages call it, ``key=value``); its paths start at ``folder``. Raises
    ``JobError``.
    """
    source = read(name)
    composed = ComposedJob(_root(source, name), source)
    early = JobSubstitution(None)
    composed.root = _with_others(composed.root, name, read, early, [], composed)
    for label, override in overrides:
        composed.root = apply_override(composed.root, label, override, folder=folder)
        composed.overrides.append(f"{label} {override}")
    values = dict(composed.root.value)
    variables = values.get("vars")
    known = variables.value if variables is not None and _is_mapping(variables) else {}
    late = JobSubstitution(known, lambda: _search_path(composed.root, JobSubstitution(known)))
    composed.root = late.tree(composed.root)
    composed.substituted = early.used or late.used or bool(variables)
    return composed


def _root(source: YamlSource, name: str) -> YamlValue:
    root = source.root
    if root is None or root.value is None:
        raise JobError("the job file is empty: it needs at least 'nodes:' or 'bags:'", where=name)
    if not isinstance(root.value, dict):
        raise root.place.error("a job is a mapping (nodes: ..., stop: ...)")
    return root


def _with_others(
    root: YamlValue,
    name: str,
    read: Callable[[str], YamlSource],
    early: JobSubstitution,
    outer: list[str],
    composed: ComposedJob,
) -> YamlValue:
    """Return the values of a file with those of its base and included files below them."""
    outer = [*outer, os.path.realpath(name)]
    values = dict(root.value)
    base, include = values.pop("base", None), values.pop("include", None)
    if base is None and include is None:
        return root
    own = replace(root, value=values)
    read_other = partial(_other, root, name, read, early, outer, composed)
    # The base is read first, so that a mistake in it is reported before one in what changes it.
    lowest = None if base is None else read_other(base, "base")
    listed = include.value if include is not None and isinstance(include.value, list) else [include]
    added = [read_other(item, "include") for item in listed if item is not None]
    over = _with_search_path(own)
    if added:
        under = added[0]
        for other in added[1:]:
            under = merge(under, other, add_up=True, strict=False)
        over = merge(under, over, add_up=True, strict=lowest is None)
    return over if lowest is None else merge(lowest, over)


def _other(
    root: YamlValue,
    name: str,
    read: Callable[[str], YamlSource],
    early: JobSubstitution,
    outer: list[str],
    composed: ComposedJob,
    item: YamlValue,
    role: str,
) -> YamlValue:
    """Return the values of a file that ``item`` of the file ``name`` refers to."""
    if not isinstance(item.value, str):
        raise item.place.error(f"{role}: expected a path, got {describe(item.value)}")
    path = str(early.tree(item).value)
    if not path.strip():
        raise item.place.error(f"{role}: expected a path, got {describe(path)}")
    full = os.path.normpath(os.path.join(root.place.source.folder or "", path))
    if os.path.realpath(full) in outer:
        raise item.place.error(
            f"{role}: {path} leads back to itself: no file can be made of itself"
        )
    if len(outer) > DEPTH_MAX:
        raise item.place.error(f"{role}: more than {DEPTH_MAX} files inside each other")
    shown = os.path.normpath(os.path.join(os.path.dirname(name), path))
    try:
        source = read(shown)
        other = _root(source, shown)
    except JobError as error:
        if error.where != shown:
            raise
        # The file itself is wrong, not something in it: the line that names it is to blame.
        message = str(error).removeprefix(f"{shown}: ")
        if not os.path.exists(shown):
            message += near_path(Path(full), path, but=os.path.basename(name))
        raise item.place.error(f"{role}: {shown}: {message}") from None
    composed.others.append(path)
    return _with_search_path(_with_others(other, shown, read, early, outer, composed))


def _search_path(root: YamlValue, substitution: JobSubstitution) -> list[Path]:
    """Return the folders of a job's ``search_path``, or the folder of its file."""
    listed = root.value.get("search_path")
    items = listed.value if listed is not None and isinstance(listed.value, list) else [listed]
    written = [item if item is not None else YamlValue(".", root.place) for item in items]
    found = [substitution.tree(item) for item in written]
    return [
        Path(item.place.source.folder or os.getcwd(), item.value)
        for item in found
        if isinstance(item.value, str)
    ]


def _with_search_path(root: YamlValue) -> YamlValue:
    """Give a file without ``search_path`` its own folder, where its modules are."""
    if "search_path" in root.value:
        return root
    place = SourcePlace(root.place.source, TextPosition(1, 1))
    return replace(
        root, value={**root.value, "search_path": YamlValue([YamlValue(".", place)], place)}
    )


def merge(
    under: YamlValue, over: YamlValue, *, add_up: bool = False, strict: bool = True, loc: Loc = ()
) -> YamlValue:
    """Return ``under`` with ``over`` laid over it.

    Mappings are merged by key, and null takes a key away. Of keys that exclude each other (the
    distributions of a delay) ``over``'s stays. ``search_path`` is the sum, ``over``'s
    first. ``nodes`` are merged by name; with ``add_up``, lists of nodes, launch files and bags
    are added up.
    Everything else is replaced. ``strict`` refuses a change to a node that is not there.
    """
    if _is_mapping(over) and is_plain(under.value):
        key = shorthand_at(Job, loc)
        if key is not None:
            under = replace(under, value={key: replace(under, key_place=under.place)})
    if _is_mapping(under) and _is_mapping(over):
        low, high = without_alternatives(under.value, over.value, Job, loc), over.value
        if loc[:1] == ("nodes",) and loc[2:] == ("parameters",):
            low, high = _flat(low), _flat(high)
        values = dict(low)
        for key, item in high.items():
            if item.value is None and key in low:
                del values[key]
            elif key in low:
                inner = (*loc, key)
                values[key] = merge(low[key], item, add_up=add_up, strict=strict, loc=inner)
            else:
                values[key] = item
        return replace(over, value=values)
    if isinstance(under.value, list) and isinstance(over.value, list):
        if loc == ("search_path",):
            return replace(over, value=over.value + under.value)
        if loc == ("nodes",):
            nodes = _merged_nodes(under.value, over.value, add_up=add_up, strict=strict)
            return replace(over, value=nodes)
        if add_up and loc in (("bags",), ("launch",)):
            return replace(over, value=under.value + over.value)
    return over


def _merged_nodes(
    under: list[YamlValue], over: list[YamlValue], *, add_up: bool, strict: bool
) -> list[YamlValue]:
    nodes = list(under)
    for item in over:
        name, space = _scalar_at(item, "name"), _scalar_at(item, "namespace")
        named = [i for i, node in enumerate(nodes) if name and _scalar_at(node, "name") == name]
        exact = [i for i in named if (_scalar_at(nodes[i], "namespace") or "/") == (space or "/")]
        says_what = _is_mapping(item) and not _WHAT.isdisjoint(item.value)
        # Without a word about the namespace, or about what it is, a name that is there once is it.
        same = named if len(named) == 1 and (space is None or not says_what) else exact
        if len(same) == 1 and not (add_up and says_what):
            merged = merge(nodes[same[0]], item, loc=("nodes", same[0]))
            if any(item.value[key].value is None for key in _WHAT if key in item.value):
                del nodes[same[0]]  # `node: null` takes the node itself away
            else:
                nodes[same[0]] = merged
        elif strict and name and not says_what:
            names = sorted({str(_scalar_at(n, "name")) for n in under if _scalar_at(n, "name")})
            there = f"there are {', '.join(names)}" if names else "none of them has a name"
            problem = "no node" if not named else "more than one node"
            raise item.value["name"].place.error(
                f"{problem} of the other files is named {name!r}, to be changed here: {there} (a "
                "new node needs 'node:', one of several a 'namespace:')"
            )
        else:
            nodes.append(item)
    return nodes


def _flat(values: dict[Any, YamlValue], prefix: str = "") -> dict[Any, YamlValue]:
    """Return parameters under dotted names, so that both ways of writing them meet."""
    flat: dict[Any, YamlValue] = {}
    for key, item in values.items():
        if not isinstance(key, str):
            flat[key] = item
        elif _is_mapping(item) and key != "ros__parameters":
            flat.update(_flat(item.value, f"{prefix}{key}."))
        else:
            flat[f"{prefix}{key}"] = item
    return flat


def _scalar_at(item: YamlValue, key: str) -> object:
    inner = item.value.get(key) if _is_mapping(item) else None
    return None if inner is None or isinstance(inner.value, (dict, list)) else inner.value


def _is_mapping(item: YamlValue | None) -> bool:
    return item is not None and isinstance(item.value, dict)
