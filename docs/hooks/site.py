"""Hooks of mkdocs: formulas as MathML, bars in tables, links to files beside docs/, pages of a folder in the nav."""

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from mkdocs.structure.files import File

import bars
import mathml
import navigation
import notebooks
import repository
import search
import sources

ROOT = Path(__file__).resolve().parents[2]


def on_config(config):
    """The nav with the pages that are there, formulas as an extension of Markdown, and a link to the repository.

    There is no page for wrong addresses, whose links would have to know where the site lies.
    """
    config.theme.static_templates.discard("404.html")
    config.nav = navigation.of_pages(config.nav, Path(config.docs_dir))
    config.markdown_extensions.append(mathml.Formulas())
    config.repo_url, config.repo_name = repository.here(ROOT), "Sources"
    return config


def on_files(files, config):
    """The pages, one for each notebook, and one for each file of the repository that a page links to."""
    found = [file for file in files if file.src_uri.endswith(".ipynb")]
    with ThreadPoolExecutor() as pool:
        for notebook, page in zip(found, pool.map(notebooks.page, [Path(x.abs_src_path) for x in found]), strict=True):
            files.append(File.generated(config, notebook.src_uri.replace(".ipynb", ".md"), content=page))
    for file in sources.linked(files.documentation_pages(), ROOT, config):
        files.append(file)
    return files


def on_page_markdown(markdown, page, config, files):
    """Markdown of a page whose links to files beside docs/ lead to their pages, and its weight in the search."""
    search.weighted(page.file.src_uri, page.meta)
    if sys.stderr.isatty():
        print(f"\r{page.file.src_uri:<78}", end="\r", file=sys.stderr, flush=True)
    return sources.with_links(markdown, page.file.src_uri, ROOT)


def on_page_content(html, page, config, files):
    """Page whose tables have bars beside their ratios."""
    return bars.drawn(html)
