"""Every guide has an example, and shows the picture that it draws. Their code is run by test_documents.py."""

import json

import helpers
import pytest
from places import ROOT

for needed in ("matplotlib", "scipy", "tyro"):
    pytest.importorskip(needed, reason="the guides need the extra 'examples'")
import guide_pictures as pictures  # noqa: E402
from matplotlib.image import imread  # noqa: E402
from pictures import DATA  # noqa: E402
from PIL import Image  # noqa: E402

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
    assert {file.stem for file in pictures.FOLDER.glob("*.png")} == set(pictures.SOURCES)


def test_a_picture_shows_the_data_that_the_example_draws(monkeypatch, tmp_path):
    monkeypatch.setattr(pictures, "FOLDER", tmp_path)
    with Image.open(pictures.made("urdf")) as drawn, Image.open(DOCS / "pictures" / "urdf.png") as kept:
        new, old = (json.loads(picture.info[DATA]) for picture in (drawn, kept))
    assert len(new) == len(old) == 16  # a torque and its three terms, of four joints
    for row, expected in zip(new, old, strict=True):
        assert row == pytest.approx(expected, rel=2e-3, abs=1e-3)
