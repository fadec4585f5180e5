"""``launch.launch_description_sources``: where an included launch file is."""

from __future__ import annotations

import importlib.util
from importlib.machinery import SourceFileLoader
from types import ModuleType
from typing import Any

from rsltrace.adapters.launch.api.basics import LaunchDescription, Substitution


class LaunchDescriptionSource:
    """A launch description that is there, or the place of a launch file."""

    def __init__(
        self,
        launch_description: LaunchDescription | None = None,
        location: Any = "<script>",
        method: str = "unspecified mechanism from a script",
    ) -> None:
        self.description = launch_description
        self.place = location

    @property
    def location(self) -> str:
        """The place, as far as it is known before the launch file is read."""
        place = self.place
        if isinstance(place, Substitution):
            return place.describe()
        parts = [place] if isinstance(place, str) or not hasattr(place, "__iter__") else place
        return "".join(p.describe() if isinstance(p, Substitution) else str(p) for p in parts)


class AnyLaunchDescriptionSource(LaunchDescriptionSource):
    """A launch file of any kind."""

    def __init__(self, launch_file_path: Any) -> None:
        super().__init__(location=launch_file_path)


class PythonLaunchDescriptionSource(AnyLaunchDescriptionSource):
    """A launch file in Python."""


class FrontendLaunchDescriptionSource(AnyLaunchDescriptionSource):
    """A launch file in XML or YAML."""


class XMLLaunchDescriptionSource(AnyLaunchDescriptionSource):
    """A launch file in XML."""


class YAMLLaunchDescriptionSource(AnyLaunchDescriptionSource):
    """A launch file in YAML."""


def load_python_launch_file_as_module(python_launch_file_path: str) -> ModuleType:
    """Run a launch file and return it as a module."""
    loader = SourceFileLoader("python_launch_file", python_launch_file_path)
    spec = importlib.util.spec_from_loader(loader.name, loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


def get_launch_description_from_python_launch_file(
    python_launch_file_path: str,
) -> LaunchDescription:
    """Return what a launch file describes.

    :raises ValueError: if it has no ``generate_launch_description``.
    """
    module = load_python_launch_file_as_module(python_launch_file_path)
    if not hasattr(module, "generate_launch_description"):
        raise ValueError("there is no function generate_launch_description() in the launch file")
    found: LaunchDescription = module.generate_launch_description()
    return found
