"""The notebook among the examples runs from its first cell to its last, in a kernel."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

NOTEBOOK = Path(__file__).parents[2] / "examples" / "notebooks" / "traces.ipynb"


@pytest.mark.long
@pytest.mark.filterwarnings("default")  # Jupyter's own are not for us
def test_the_notebook_runs_and_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR", "IPYTHONDIR", "MPLCONFIGDIR"):
        monkeypatch.setenv(name, str(tmp_path / name))
    nbformat = pytest.importorskip("nbformat")
    client = pytest.importorskip("nbclient").NotebookClient
    pytest.importorskip("ipykernel")
    notebook: Any = nbformat.read(NOTEBOOK, as_version=4)
    resources = {"metadata": {"path": str(NOTEBOOK.parent)}}
    client(notebook, timeout=300, startup_timeout=300, resources=resources).execute()
    kinds = [set(output.get("data", ())) for c in _code(notebook) for output in c.outputs]
    assert sum("image/png" in found for found in kinds) == 3
    assert sum("text/html" in found for found in kinds) == 4  # a trace, a job, a table, a diff
    errors = [o for c in _code(notebook) for o in c.outputs if o.output_type == "stream"]
    assert errors == []


def test_the_notebook_is_kept_without_what_it_has_shown() -> None:
    """Else each run of it would be a change, and its pictures could be stale."""

    cells = [c for c in json.loads(NOTEBOOK.read_text("utf-8"))["cells"] if "outputs" in c]
    assert cells
    assert all(c["outputs"] == [] and c["execution_count"] is None for c in cells)


def _code(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]
