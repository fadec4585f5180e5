"""Golden files: texts that are in the repository, to be read by a person when they change.

``pytest --update-golden`` writes them anew instead of comparing with them; review their diff.
"""

from __future__ import annotations

from pathlib import Path

update = False
"""Set by ``--update-golden`` (``conftest.py``)."""


def check_golden(path: Path, text: str) -> None:
    """Compare a text with a golden file, or write the file."""
    if update:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    assert path.exists(), f"{path} is missing; pytest --update-golden writes it"
    assert text == path.read_text(encoding="utf-8"), f"pytest --update-golden writes {path} anew"
