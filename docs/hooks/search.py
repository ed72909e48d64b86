"""Weights of pages in the search of the site: functions and guides first, tables and registers not at all."""

from fnmatch import fnmatch

# by the first pattern that fits; 0: the page is not searched, all others have 1
WEIGHTS = {
    "tested-robots.md": 0,
    "equations.md": 0,
    "CHANGELOG.md": 0,
    "contributing.md": 0.2,
    "hard-cases.md": 0.3,
    "glossary.md": 0.5,
    "paper.md": 0.5,
    "prices.md": 0.5,
    "troubleshooting.md": 2,
    "first-steps.md": 2,
    "guides/*": 2,
    "recipes.md": 2,
    "task-space.md": 2,
    "effects/index.md": 2,
    "api/functions.md": 2,
    "api/errors.md": 1,
    "api/*": 0.5,
}


def weighted(page: str, meta: dict) -> None:
    """Give a page's metadata its weight, unless the page has one of its own."""
    weight = next((weight for pattern, weight in WEIGHTS.items() if fnmatch(page, pattern)), 1)
    meta.setdefault("search", {"boost": weight} if weight else {"exclude": True})
