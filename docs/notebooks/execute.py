"""Run the notebooks in this folder and store their outputs: python docs/notebooks/execute.py.

The same code gives the same bytes: no times, places or durations are stored.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbformat import NotebookNode

__all__ = ["CellExecutionError", "execute", "notebooks"]

FOLDER = Path(__file__).parent
TIME_LIMIT = 600
"""Maximum duration of one cell [s]."""
KERNEL = {"display_name": "Python 3", "language": "python", "name": "python3"}


def notebooks() -> list[Path]:
    """Return all notebooks in this folder."""
    return sorted(FOLDER.glob("*.ipynb"))


def execute(path: Path, parameters: Mapping[str, object] | None = None) -> NotebookNode:
    """Run a notebook and return it with its outputs.

    Args:
        path: The notebook; the file is not changed.
        parameters: Values that replace those in the cell tagged `parameters`.

    Raises:
        CellExecutionError: A cell fails.
    """
    notebook = nbformat.read(path, as_version=4)
    given = [f"{name} = {value!r}" for name, value in (parameters or {}).items()]
    for cell in notebook.cells:
        if "parameters" in cell.metadata.get("tags", []):
            cell.source = "\n".join([cell.source, *given])
    client = NotebookClient(notebook, timeout=TIME_LIMIT, kernel_name="python3", record_timing=False)
    client.execute(cwd=str(path.parent))
    return _without_traces(notebook)


def _without_traces(notebook: NotebookNode) -> NotebookNode:
    """Remove what depends on the machine, and join text outputs that arrived in pieces."""
    notebook.metadata = NotebookNode(kernelspec=KERNEL, language_info={"name": "python"})
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = _joined(cell.outputs)
    nbformat.validate(notebook)
    return notebook


def _joined(outputs: list[NotebookNode]) -> list[NotebookNode]:
    joined: list[NotebookNode] = []
    for output in outputs:
        before = joined[-1] if joined else None
        if before is not None and output.output_type == "stream" and before.get("name") == output.name:
            before.text += output.text
        else:
            joined.append(output)
    return joined


def main() -> int:
    """Run all notebooks, and write them back."""
    for path in notebooks():
        nbformat.write(execute(path), path)
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
