"""The notebooks run from the first cell to the last, and are kept without what they print."""

import pytest
from places import ROOT

nbformat = pytest.importorskip("nbformat", reason="notebooks need the extra 'docs'")
nbclient = pytest.importorskip("nbclient", reason="notebooks need the extra 'docs'")
pytest.importorskip("ipykernel", reason="notebooks need the extra 'docs'")
for needed in ("matplotlib", "scipy"):
    pytest.importorskip(needed, reason="the notebooks need the extra 'examples'")

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
SECONDS = 300.0  # for a cell, on a machine that does other things


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def notebook(request):
    return nbformat.read(request.param, as_version=4)


def test_there_are_notebooks():
    assert [path.stem for path in NOTEBOOKS] == ["log_to_controller", "tour"]


def test_a_notebook_runs(notebook, tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    ran = nbclient.NotebookClient(notebook, timeout=SECONDS, resources={"metadata": {"path": tmp_path}}).execute()
    outputs = [output for cell in ran.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not list(tmp_path.iterdir())


def test_a_notebook_is_kept_without_outputs(notebook):
    nbformat.validate(notebook)
    assert notebook.cells[0].cell_type == "markdown" and notebook.cells[0].source.startswith("# ")
    for cell in notebook.cells:
        if cell.cell_type == "code":
            assert not cell.outputs and cell.execution_count is None
