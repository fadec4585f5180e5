"""Writes into a wheel of which version it is: a checkout only knows what its next release is."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

_TEXT = '"""The version of this build."""\n\n__version__ = {version!r}\n'


class VersionOfTheBuild(BuildHookInterface):  # type: ignore[misc]
    """Replaces ``rsltrace/_version.py`` in wheels; editable installs keep the checkout's."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the file, of a folder that lasts as long as the build."""
        if self.target_name != "wheel" or version == "editable":
            return
        self._folder = TemporaryDirectory()
        made = Path(self._folder.name) / "_version.py"
        made.write_text(_TEXT.format(version=self.metadata.version), encoding="utf-8")
        build_data["force_include"][str(made)] = "rsltrace/_version.py"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Take the folder away."""
        if hasattr(self, "_folder"):
            self._folder.cleanup()
