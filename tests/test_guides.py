"""The pages for newcomers: code runs, messages are those that are raised, pictures are those of the examples."""

import doctest
import re
from pathlib import Path
from shutil import copy

import helpers
import pytest

for needed in ("matplotlib", "scipy", "tyro"):
    pytest.importorskip(needed, reason="the guides need the extra 'examples'")
import guide_pictures as pictures  # noqa: E402
from matplotlib.image import imread  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
GUIDES = sorted((DOCS / "guides").glob("*.md"))
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
one_thread = helpers.one_thread


@pytest.fixture
def at_home(tmp_path, monkeypatch):
    """Folder of a reader who has the arm of the examples."""
    copy(ROOT / "examples" / "arm.urdf", tmp_path)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    "path", [DOCS / "index.md", *GUIDES, DOCS / "conventions.md"], ids=lambda path: path.relative_to(DOCS).as_posix()
)
def test_code_runs_and_says_what_the_page_shows(path, at_home):
    text, known = path.read_text(encoding="utf-8"), {"__name__": "page"}
    shown = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    for match in FENCE.finditer(text):
        language, code = match.groups()
        line = text.count("\n", 0, match.start()) + 1
        if language == "python":
            exec(compile("\n" * line + code, str(path), "exec"), known)
        elif language == "pycon":
            block = doctest.DocTestParser().get_doctest(code, known, path.name, str(path), line)
            assert block.examples
            shown.run(block, clear_globs=False)
            known.update(block.globs)
        else:
            assert language in ("sh", "text"), f"{path.name}, line {line}: a block of {language or 'no language'}"
    assert not shown.failures, f"{shown.failures} results differ from those on the page, see above"


def test_every_guide_has_its_example_and_its_picture():
    assert [path.stem for path in GUIDES] == sorted(pictures.SOURCES)
    for path in GUIDES:
        text, source = path.read_text(encoding="utf-8"), pictures.SOURCES[path.stem]
        assert f"](../../examples/{source.example}.py)" in text
        assert (ROOT / "examples" / f"{source.example}.py").exists()
        assert f"](../pictures/{path.stem}.png)" in text
        file = pictures.FOLDER / f"{path.stem}.png"
        assert file.stat().st_size < 150_000
        picture = imread(file)[..., :3]
        assert picture.shape[1] >= 900 and picture.std() > 0.03
        for heading in ("## Common mistakes", "## What next"):
            assert heading in text
    assert {file.stem for file in pictures.FOLDER.iterdir()} == set(pictures.SOURCES)


def test_a_picture_is_what_the_example_draws(monkeypatch, tmp_path):
    monkeypatch.setattr(pictures, "FOLDER", tmp_path)
    drawn = imread(pictures.made("urdf"))
    kept = imread(DOCS / "pictures" / "urdf.png")
    assert drawn.shape == kept.shape and abs(drawn - kept).mean() < 0.01
