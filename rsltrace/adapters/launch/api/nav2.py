"""``nav2_common.launch``, where Nav2 is not installed: many launch files change YAML files so."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from rsltrace.adapters.launch.api.basics import (
    Condition,
    LaunchContext,
    Substitution,
    SubstitutionFailure,
    as_substitutions,
)
from rsltrace.adapters.launch.model import truth, yaml_value
from rsltrace.trace.model.regular_file import read_regular


class _FileSubstitution(Substitution):
    """Something that is made of a file."""

    def __init__(self, source_file: Any) -> None:
        self.source_file = as_substitutions(source_file)

    def _text(self, context: LaunchContext) -> str:
        path = context.text(self.source_file)
        try:
            return read_regular(Path(path)).decode()
        except OSError as error:
            raise SubstitutionFailure(f"cannot read {path}: {error.strerror}") from error

    def _tree(self, context: LaunchContext) -> dict[str, Any]:
        tree = yaml_value(self._text(context))
        if not isinstance(tree, dict):
            raise SubstitutionFailure(f"{context.text(self.source_file)} holds no YAML mapping")
        return tree


def _written(text: str) -> str:
    with tempfile.NamedTemporaryFile("w", prefix="launch_params_", delete=False) as file:
        file.write(text)
    return file.name


class RewrittenYaml(_FileSubstitution):
    """The path of a copy of a YAML file with some values changed."""

    def __init__(
        self,
        source_file: Any,
        param_rewrites: Mapping[str, Any],
        root_key: Any = None,
        key_rewrites: Mapping[str, Any] | None = None,
        value_rewrites: Mapping[str, Any] | None = None,
        convert_types: bool = False,
    ) -> None:
        super().__init__(source_file)
        self._values, self._root = dict(param_rewrites), root_key
        self._keys, self._texts = dict(key_rewrites or {}), dict(value_rewrites or {})
        self._convert = convert_types

    def perform(self, context: LaunchContext) -> str:
        tree = self._tree(context)
        texts = {old: context.text(new) for old, new in self._texts.items()}
        values = {name: context.text(value) for name, value in self._values.items()}
        keys = {name: context.text(value) for name, value in self._keys.items()}
        tree = self._changed(tree, (), values, keys, texts)
        for path, value in values.items():
            if "." in path:
                self._add(tree, path.split("."), value)
        root = None if self._root is None else context.text(self._root)
        stream = StringIO()
        YAML(typ="safe").dump({root: tree} if root else tree, stream)
        return _written(stream.getvalue())

    def _changed(
        self,
        value: Any,
        path: tuple[str, ...],
        values: Mapping[str, str],
        keys: Mapping[str, str],
        texts: Mapping[str, str],
    ) -> Any:
        if isinstance(value, dict):
            return {
                keys.get(name, name): self._changed(inner, (*path, str(name)), values, keys, texts)
                for name, inner in value.items()
            }
        if path[-1] in values:
            return self._converted(values[path[-1]])
        return self._converted(texts[value]) if isinstance(value, str) and value in texts else value

    def _add(self, tree: dict[str, Any], path: list[str], value: str) -> None:
        """Set what a dotted path names; what is on the way to it is made."""
        for name in path[:-1]:
            inner = tree.setdefault(name, {})
            if not isinstance(inner, dict):
                return
            tree = inner
        tree[path[-1]] = self._converted(value)

    def _converted(self, text: str) -> Any:
        if not self._convert:
            return text
        found = yaml_value(text)
        return found if isinstance(found, (bool, int, float)) else text


class ReplaceString(_FileSubstitution):
    """The path of a copy of a file with some texts in it replaced."""

    def __init__(
        self, source_file: Any, replacements: Mapping[str, Any], condition: Condition | None = None
    ) -> None:
        super().__init__(source_file)
        self._replacements, self._condition = dict(replacements), condition

    def perform(self, context: LaunchContext) -> str:
        """Write the copy and return its path; without it if the condition does not hold."""
        if self._condition is not None and not self._condition.evaluate(context):
            return context.text(self.source_file)
        text = self._text(context)
        for old, new in self._replacements.items():
            text = text.replace(old, context.text(new))
        return _written(text)


class HasNodeParams(_FileSubstitution):
    """``True`` if a parameter file has something for a node."""

    def __init__(self, source_file: Any, node_name: str) -> None:
        super().__init__(source_file)
        self._node_name = node_name

    def perform(self, context: LaunchContext) -> str:
        return str(self._node_name in self._tree(context))


class LaunchConfigAsBool(Substitution):
    """A launch argument as ``True`` or ``False``."""

    def __init__(self, name: str) -> None:
        self._name = name

    def perform(self, context: LaunchContext) -> str:
        value = context.launch_configurations.get(self._name, "")
        yes = value.strip().lower()
        return str(yes in ("yes", "on", "t", "y") or (yes != "" and _is_true(yes)))


def _is_true(text: str) -> bool:
    try:
        return truth(text)
    except ValueError:
        return False
