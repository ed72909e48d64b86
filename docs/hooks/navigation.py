"""Nav of the site."""

from pathlib import Path


def of_pages(nav: list, docs: Path) -> list:
    """Nav in which `folder/*.md` stands for the pages of a folder that no other entry names, in the order of names."""
    named = {page for page in _pages(nav) if "*" not in page}
    return _expanded(nav, docs, named)


def _pages(nav) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    return [page for entry in (nav.values() if isinstance(nav, dict) else nav) for page in _pages(entry)]


def _expanded(nav: list, docs: Path, named: set[str]) -> list:
    found = []
    for entry in nav:
        title, target = next(iter(entry.items())) if isinstance(entry, dict) else (None, entry)
        if isinstance(target, list):
            pages = _expanded(target, docs, named)
        elif "*" in target:
            matching = sorted(docs.glob(target))
            pages = [p.relative_to(docs).with_suffix(".md").as_posix() for p in matching]  # notebooks become pages
            pages = [page for page in pages if page not in named]
        else:
            found.append(entry)
            continue
        if title is None:
            found += pages
        elif pages:
            found.append({title: pages})
    return found
