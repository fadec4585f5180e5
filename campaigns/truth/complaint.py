"""What is wrong with what a diff says."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Complaint:
    """Something that ``diff`` says and that is not so. ``what`` is one of few words."""

    what: str
    text: str
