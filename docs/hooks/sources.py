"""Pages of the files beside docs/ that pages link to, so that every link leads somewhere without a network."""

import posixpath
import re
from collections.abc import Iterable
from pathlib import Path

from mkdocs.structure.files import File, InclusionLevel

LINK = re.compile(r"(\]\()(?![a-z]+:|#|/)([^)#\s]+)((?:#[^)\s]*)?\))")
FENCE = re.compile(r"^(```+|~~~+)[^\n]*\n.*?^\1\s*$", re.MULTILINE | re.DOTALL)
PICTURES = {".png", ".gif", ".svg", ".jpg", ".webp"}
LANGUAGES = {".py": "python", ".c": "c", ".h": "c", ".toml": "toml", ".urdf": "xml", ".xml": "xml", ".cff": "yaml"}
UNSEARCHED = "---\nsearch: { exclude: true }\nhide: [navigation]\n---\n\n"
WIDE = "---\nhide: [{}]\n---\n\n"  # what stands beside a page and is empty there leaves its place to tables
FIRST_PAGE = "README.md"  # of the repository; that of the site says the same


def linked(pages: Iterable[File], root: Path, config) -> list[File]:
    """Files of the site for all files beside docs/ that pages link to, and that those pages link to."""
    known, queue = set(), [(page.src_uri, page.content_string) for page in pages]
    found = []
    while queue:
        page, text = queue.pop()
        for target in _targets(text, page):
            if target.startswith("docs/") or target in known or not (root / target).exists() or target == FIRST_PAGE:
                continue
            known.add(target)
            if Path(target).suffix in PICTURES:
                found.append(File.generated(config, _place(target), abs_src_path=str(root / target)))
                continue
            content = _page(root / target, target)
            found.append(File.generated(config, _place(target), content=content, inclusion=InclusionLevel.NOT_IN_NAV))
            if target.endswith(".md"):
                queue.append((_place(target), content))
    return found


def with_links(markdown: str, page: str, root: Path) -> str:
    """Markdown of a page whose relative links lead to pages of the site."""

    def link(m: re.Match) -> str:
        target = _target(m[2], page)
        if not (root / target).exists():
            return m[0]
        return m[1] + posixpath.relpath(_place(target), posixpath.dirname(page) or ".") + m[3]

    parts, end = [], 0
    for fence in FENCE.finditer(markdown):
        parts += [LINK.sub(link, markdown[end : fence.start()]), fence[0]]
        end = fence.end()
    return "".join([*parts, LINK.sub(link, markdown[end:])])


def _targets(text: str, page: str) -> list[str]:
    return [_target(m[2], page) for m in LINK.finditer(FENCE.sub("", text))]


def _target(link: str, page: str) -> str:
    """Path in the repository that a page's link leads to; pages in capitals stand beside docs/."""
    folder = "" if Path(page).stem.isupper() and "/" not in page else posixpath.join("docs", posixpath.dirname(page))
    return posixpath.normpath(posixpath.join(folder, link))


def _place(target: str) -> str:
    """Path in the site of a file of the repository."""
    if target == FIRST_PAGE:
        return "index.md"
    if target.startswith("docs/"):
        return target.removeprefix("docs/")
    if target.endswith(".md"):
        return target
    return f"source/{target}" if Path(target).suffix in PICTURES else f"source/{target}.md"


def _page(path: Path, name: str) -> str:
    if path.suffix == ".md":
        text = path.read_text(encoding="utf-8")
        return WIDE.format("navigation" if "\n## " in text else "navigation, toc") + text
    if path.is_dir():
        return f"{UNSEARCHED}# {name}\n\n" + "\n".join(
            f"* `{p.name}`" for p in sorted(path.iterdir()) if p.name[0] not in "._"
        )
    kind = LANGUAGES.get(path.suffix, "text")
    text = path.read_text(encoding="utf-8")
    return f"{UNSEARCHED}# {name}\n\n````{kind}\n{text}````\n"
