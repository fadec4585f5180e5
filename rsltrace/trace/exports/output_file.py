"""Check where an exported file is to be written, before the work begins."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from rsltrace.errors import OutputError
from rsltrace.trace.model.regular_file import not_replaceable


def check_output_file(output: Path, traces: Sequence[Path], *, force: bool, example: str) -> None:
    """Raise OutputError if ``output``, which is made from ``traces``, cannot be written.

    ``force`` allows to replace a file, but no folder, pipe or device. ``example`` is a file name.
    """
    if output.is_dir():
        raise OutputError(f"{output} is a folder; name a file, such as {output / example}")
    check_not_input(output, traces)
    if kind := not_replaceable(output):
        raise OutputError(f"{output} is {kind}; name a file, or remove it")
    if output.exists() and not force:
        raise OutputError(f"{output} exists; use --force to replace it, or another name")
    if not output.absolute().parent.is_dir():
        raise OutputError(f"the folder {output.parent} does not exist")


def check_not_input(output: Path, inputs: Iterable[Path], what: str = "trace") -> None:
    """Raise OutputError if a file that is to be written is one of those that are read: ``what``."""
    if output.exists() and any(one.exists() and output.samefile(one) for one in inputs):
        raise OutputError(f"{output} is the {what} itself; choose another name")
