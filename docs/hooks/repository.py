"""Address of the repository: that of its origin, so that it is written nowhere and right in every copy.

    python docs/hooks/repository.py v0.1.0

writes it, before a release, into the metadata and into the links of the README, which an index shows without the files
beside it.
"""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
WEB = re.compile(r"(?:https://(?:[^@/]+@)?|ssh://git@|git@)([\w.-]+)[/:]([\w./-]+?)(?:\.git)?/?")
LINK = re.compile(r"(!?)(\[[^\]]*\]\()(?![a-z]+:|#)([^)]+\))")


def address(origin: str) -> str | None:
    """Page of a repository in the web; None: its origin is not there."""
    found = WEB.fullmatch(origin)
    return found and f"https://{found[1]}/{found[2]}"


def here(root: Path = ROOT) -> str | None:
    """Page of this repository; None: it has no origin in the web."""
    order = ["git", "config", "--get", "remote.origin.url"]
    try:
        return address(subprocess.run(order, cwd=root, capture_output=True, text=True).stdout.strip())
    except OSError:  # no git
        return None


def absolute(readme: str, page: str, tag: str) -> str:
    """README whose links lead to the files of a tag."""
    return LINK.sub(lambda m: f"{m[1]}{m[2]}{page}/{'raw' if m[1] else 'blob'}/{tag}/{m[3]}", readme)


def urls(page: str, tag: str) -> str:
    """Table `project.urls` of the metadata."""
    return f"""
[project.urls]
Source = "{page}"
Documentation = "{page}/blob/{tag}/docs/index.md"
Changelog = "{page}/blob/{tag}/CHANGELOG.md"
Issues = "{page}/issues"
"""


def main(tag: str, root: Path = ROOT) -> None:
    """Write the addresses of a tag."""
    page = here(root)
    if page is None:
        sys.exit("this checkout has no origin in the web: git remote add origin https://...")
    readme, project = root / "README.md", root / "pyproject.toml"
    readme.write_text(absolute(readme.read_text(encoding="utf-8"), page, tag), encoding="utf-8")
    project.write_text(project.read_text(encoding="utf-8") + urls(page, tag), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1])
