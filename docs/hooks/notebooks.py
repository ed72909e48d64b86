"""Notebooks as pages: their cells, and what they print if TORCHDQ_NOTEBOOKS=run is set."""

import os
import sys
import textwrap
from pathlib import Path

import nbformat

SECONDS = 120.0  # of one cell
COLUMNS = 88  # of what a cell prints


def page(path: Path) -> str:
    """Markdown of a notebook."""
    notebook = nbformat.read(path, as_version=4)
    if os.environ.get("TORCHDQ_NOTEBOOKS") == "run":
        from nbclient import NotebookClient

        print(f"running {path.name}, a minute or less ...", file=sys.stderr, flush=True)
        NotebookClient(notebook, timeout=SECONDS, kernel_name="python3").execute()
    parts = [part for cell in notebook.cells for part in _parts(cell)]
    first, rest = parts[0].partition("\n")[::2]  # its title
    return "\n\n".join([first, f"[This page as a notebook]({path.name})", rest.strip(), *parts[1:]])


def _parts(cell) -> list[str]:
    if cell.cell_type == "markdown":
        return [cell.source]
    shown = [_shown(output, cell.metadata) for output in cell.get("outputs", [])]
    return [f"```python\n{cell.source}\n```", *filter(None, shown)]


def _shown(output, metadata) -> str:
    """Text, picture or nothing; the alternative text of a picture is in the metadata of its cell."""
    if output.output_type == "stream":
        lines = "\n".join(textwrap.fill(line, COLUMNS) for line in output.text.rstrip().split("\n"))
        return f"```text\n{lines}\n```" if output.name == "stdout" else ""
    data = output.get("data", {})
    if svg := data.get("image/svg+xml"):
        return svg[svg.index("<svg") :]
    if png := data.get("image/png"):
        return f"![{metadata['alt']}](data:image/png;base64,{png.strip().replace(chr(10), '')})"
    text = data.get("text/plain", "")
    return f"```text\n{text}\n```" if text else ""
