"""Pictures of the guides in docs/pictures: each is drawn by the example of its guide, and scaled down.

python examples/guide_pictures.py             # all of them
python examples/guide_pictures.py urdf log    # those of some guides
"""

import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from pictures import DATA
from PIL import Image
from PIL.PngImagePlugin import PngInfo

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "pictures"
WIDTH, COLOURS = 1200, 128  # of a picture


class Source(NamedTuple):
    """Example of a guide, without `.py`, and the picture it draws."""

    example: str
    picture: str


SOURCES = {
    "urdf": Source("20_own_urdf", "own_urdf.png"),
    "log": Source("17_log_with_torques", "log_with_torques.png"),
    "policy": Source("11_through_the_simulation", "through_the_simulation.png"),
    "million": Source("05_environment", "reach.png"),
    "legs": Source("24_on_feet", "on_feet.png"),
    "hands": Source("33_hand", "hand.png"),
    "loops": Source("37_linkage", "linkage.png"),
    "plan": Source("38_plan", "plan.png"),
    "controller": Source("15_real_time", "real_time.png"),
    "paper": Source("10_paper_figures", "paper_torques.png"),
}


def made(guide: str) -> Path:
    """Picture of a guide, drawn by its example."""
    source, target = SOURCES[guide], FOLDER / f"{guide}.png"
    example = import_module(source.example)
    with tempfile.TemporaryDirectory() as folder:
        example.main(example.Args(out=Path(folder)))
        with Image.open(Path(folder, source.picture)) as drawn:
            picture, data = drawn.convert("RGB"), PngInfo()
            if DATA in drawn.info:
                data.add_text(DATA, drawn.info[DATA])
    picture.thumbnail((WIDTH, WIDTH), Image.Resampling.LANCZOS)
    FOLDER.mkdir(exist_ok=True)
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(target, optimize=True, pnginfo=data)
    return target


if __name__ == "__main__":
    unknown = set(sys.argv[1:]) - set(SOURCES)
    if unknown:
        sys.exit(f"there is no guide {', '.join(sorted(unknown))}; there are {', '.join(SOURCES)}")
    for guide in sys.argv[1:] or SOURCES:
        print(f"{guide}: {SOURCES[guide].example} ...", flush=True)
        path = made(guide)
        print(f"{guide}: {path.relative_to(ROOT)}, {path.stat().st_size / 1000:.0f} kB", flush=True)
