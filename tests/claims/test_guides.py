"""Every guide has an example, and shows the picture that it draws. Their code is run by test_documents.py."""

import helpers
import pytest
from places import ROOT

for needed in ("matplotlib", "scipy", "tyro"):
    pytest.importorskip(needed, reason="the guides need the extra 'examples'")
import guide_pictures as pictures  # noqa: E402
from matplotlib.image import imread  # noqa: E402

DOCS = ROOT / "docs"
GUIDES = sorted((DOCS / "guides").glob("*.md"))
one_thread = helpers.one_thread


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
