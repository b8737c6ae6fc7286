"""Adds generated pages to the site while it is built.

The Python API, the experiment file, the command line, the metrics and the vehicles come from the package;
figures come from experiments/results/; notebooks and the project's pages come from where they stand.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

REPO = Path(__file__).resolve().parents[2]
sys.path += [str(REPO), str(Path(__file__).parent)]

import reference  # noqa: E402

PROJECT = {
    "contributing.md": "CONTRIBUTING.md",
    "architecture.md": "ARCHITECTURE.md",
    "changelog.md": "CHANGELOG.md",
}
"""Pages of the site that stand at the top of the repository."""

GENERATED: dict[str, Callable[[], str]] = {
    "reference/api.md": reference.api,
    "reference/experiment.md": reference.experiment,
    "reference/cli.md": reference.command_line,
    "reference/metrics.md": reference.metrics,
    "reference/parameters.md": reference.parameters,
    "reference/vehicles.md": reference.vehicles,
    "faq/index.md": lambda: reference.questions(REPO / "docs" / "faq"),
}

_FIGURES = re.compile(r"^<!-- figures: (\w+) -->$", re.M)
_SHORT = re.compile(r"<td((?: style=[^>]*)?)>([^<]{1,40})</td>")
_LINK = re.compile(r"\]\((?!https?://|#)([^)\s]+)\)")


@event_priority(100)  # before the plugin that renders notebooks
def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add all pages that are not files of docs/."""
    for name, make in GENERATED.items():
        files.append(File.generated(config, name, content=make()))
    for name, source in PROJECT.items():
        text = (REPO / source).read_text(encoding="utf-8")
        files.append(File.generated(config, name, content=_relinked(text, config)))
    for path in sorted((REPO / "notebooks").glob("*.ipynb")):
        name = path.relative_to(REPO).as_posix()
        files.append(File(name, str(REPO), config.site_dir, config.use_directory_urls))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put the figures of an experiment where a page asks for them."""
    del page, config, files
    return _FIGURES.sub(lambda found: _figures(found[1]), markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Mark short cells of tables of figures, which stay on one line."""
    del config, files
    if not page.file.src_uri.startswith("results/"):
        return html
    return _SHORT.sub(r'<td class="short"\1>\2</td>', html)


def _figures(name: str) -> str:
    """experiments/results/NAME.md without its title, with headings one level down."""
    text = (REPO / "experiments" / "results" / f"{name}.md").read_text(encoding="utf-8")
    text = re.sub(r"\A(# .*\n+)?(Regenerate: .*\n+)?", "", text)
    return re.sub(r"^(#+) ", r"#\1 ", text, flags=re.M)


def _relinked(text: str, config: MkDocsConfig) -> str:
    """Links to files as links to the site, or to the repository."""
    pages = {source: name for name, source in PROJECT.items()}

    def link(found: re.Match[str]) -> str:
        target, hash_, anchor = found[1].partition("#")
        if target in pages:
            return f"]({pages[target]}{hash_}{anchor})"
        if target.startswith("docs/"):
            return f"]({target.removeprefix('docs/')}{hash_}{anchor})"
        return f"]({config.repo_url}/blob/main/{target}{hash_}{anchor})"

    return _LINK.sub(link, text)
