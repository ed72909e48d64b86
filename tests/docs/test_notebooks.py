"""The notebooks run from the first cell to the last, and are kept without what they print."""

import re

import pytest
from places import ROOT

nbformat = pytest.importorskip("nbformat", reason="notebooks need the extra 'docs'")
plt = pytest.importorskip("matplotlib.pyplot", reason="the notebooks need the extra 'examples'")
pytest.importorskip("scipy", reason="the notebooks need the extra 'examples'")

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
BACKEND = "auto"


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def notebook(request):
    return nbformat.read(request.param, as_version=4)


def test_there_are_notebooks():
    assert [path.stem for path in NOTEBOOKS] == ["log_to_controller", "tour"]


def test_a_notebook_runs(notebook, tmp_path, monkeypatch):
    """Cells are plain Python, without a kernel; the site is built from what a kernel makes of them."""
    monkeypatch.chdir(tmp_path)
    known = {"__name__": "__main__"}
    for k, cell in enumerate(notebook.cells):
        if cell.cell_type == "code":
            exec(compile(cell.source, f"cell {k}", "exec"), known)
    assert plt.get_fignums()
    plt.close("all")
    assert not list(tmp_path.iterdir())


def test_a_cell_that_draws_has_an_alternative_text_for_its_picture(notebook):
    """It is in the metadata of the cell, and the page needs it."""
    for cell in notebook.cells:
        drawn = cell.cell_type == "code" and re.search(r"plt\.(figure|subplots)\(|plot_torques\(", cell.source)
        assert bool(drawn) == ("alt" in cell.metadata)
        assert not drawn or len(cell.metadata["alt"].split()) > 5


def test_a_notebook_is_kept_without_outputs(notebook):
    nbformat.validate(notebook)
    assert notebook.cells[0].cell_type == "markdown" and notebook.cells[0].source.startswith("# ")
    for cell in notebook.cells:
        if cell.cell_type == "code":
            assert not cell.outputs and cell.execution_count is None
