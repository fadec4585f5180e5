"""The suite of known bugs: a folder each, with ordinary nodes, a job, and the job of the fix."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

BUGS = Path(__file__).parent / "bugs"


@dataclass(frozen=True)
class Bug:
    """A known bug.

    ``kind`` says what it is, ``search`` where it hides: in the ``order`` of what is ready at one
    moment, or in what the job draws from its seed, such as a ``delay``; between the ``lines`` of
    threads; or it takes ``faults``.
    """

    folder: Path
    kind: str
    search: str
    native: bool = True
    """Whether its checks can be watched natively."""
    fault: Mapping[str, Any] = field(default_factory=dict)
    """The fault that it takes, without when: ``{"restart": "/sensor"}``, ``{"swap": "/odom"}``."""

    @property
    def name(self) -> str:
        """The name of its folder, and of its module."""
        return self.folder.name

    @property
    def job(self) -> Path:
        """The job that has it."""
        return self.folder / "job.yaml"

    @property
    def fixed(self) -> Path:
        """The same job with the nodes put right."""
        return self.folder / "fixed.yaml"


def all_bugs() -> list[Bug]:
    """Return the suite, in order of the folders' names."""
    found = []
    for job in sorted(BUGS.glob("*/*/job.yaml")):
        about = YAML(typ="safe").load(job)["x-bug"]
        more = {key: about[key] for key in ("native", "fault") if key in about}
        found.append(Bug(job.parent, about["kind"], about["search"], **more))
    return found
