"""README and docs say what is there: links, figures, commands and lists."""

import re
import subprocess
import sys
import tomllib

import pytest
from paths import REPO

from limsim_jax.maps import bundled_maps

README = (REPO / "README.md").read_text()
SITE = sorted((REPO / "docs").rglob("*.md"))
TOP = [REPO / name for name in ("README.md", "CONTRIBUTING.md", "ARCHITECTURE.md", "CHANGELOG.md")]
PROJECT = tomllib.loads((REPO / "pyproject.toml").read_text())["project"]

GENERATED = {
    *(
        f"docs/reference/{name}.md"
        for name in ("api", "cli", "experiment", "metrics", "parameters", "vehicles")
    ),
    *(f"docs/{name}.md" for name in ("architecture", "changelog", "contributing", "faq/index")),
}
"""Pages that are made when the site is built."""


def _slug(heading):
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading.replace("`", "")).strip().lower())


def _anchors(path):
    return {_slug(heading) for heading in re.findall(r"^#+ (.*)$", path.read_text(), re.M)}


def test_the_readme_fits_on_a_page():
    assert len(README.splitlines()) <= 130
    assert README.count("<!-- ci: ") == 2


def test_figures_are_those_measured():
    command = [sys.executable, str(REPO / "experiments" / "readme_tables.py"), "--check"]
    assert subprocess.run(command).returncode == 0, "run python experiments/readme_tables.py"


def test_bundled_maps_are_listed():
    text = (REPO / "docs" / "reference" / "maps.md").read_text()
    for name in bundled_maps():
        assert f"`{name}`" in text


def test_links_of_the_readme_are_absolute_and_lead_to_files():
    """So that they work on the package index as well."""
    home = PROJECT["urls"]["Homepage"]
    raw = home.replace("github.com", "raw.githubusercontent.com")
    links = re.findall(r"\]\(([^)\s]+)\)", README)
    assert any(link.endswith((".png", ".gif")) for link in links)
    for link in links:
        found = re.match(rf"(?:{home}/blob|{home}/tree|{raw})/main/([^#]*)", link)
        if found:
            assert (REPO / found[1]).exists(), link
        else:
            assert link.startswith(("https://arxiv.org/", PROJECT["urls"]["Documentation"])), link


@pytest.mark.parametrize("path", [*TOP[1:], *SITE], ids=lambda path: path.relative_to(REPO).as_posix())
def test_links_lead_to_pages_and_headings(path):
    text = re.sub(r"^```.*?^```", "", path.read_text(), flags=re.M | re.S)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith("https://"):
            continue
        target, _, anchor = link.partition("#")
        to = (path.parent / target).resolve() if target else path
        name = to.relative_to(REPO).as_posix()
        if name in GENERATED:
            continue
        if name.startswith("docs/notebooks/"):
            to = REPO / name.removeprefix("docs/")
        assert to.is_file(), f"{link} leads nowhere"
        assert not anchor or anchor in _anchors(to), f"{link}: no such heading"


def test_every_table_of_results_has_a_page():
    made = {path.stem for path in (REPO / "experiments" / "results").glob("*.md")} - {
        "vehicle_parameters",
        "behaviour_parameters",
    }
    pages = list((REPO / "docs" / "results").glob("*.md"))
    named = [re.findall(r"<!-- figures: (\w+) -->", page.read_text()) for page in pages]
    assert made <= {path.stem for path in pages}.union(*named)


def test_every_page_is_in_the_navigation():
    text = (REPO / "mkdocs.yml").read_text()
    for path in SITE:
        assert path.relative_to(REPO / "docs").as_posix() in text


def test_places_that_the_contributing_page_names_exist():
    text = (REPO / "CONTRIBUTING.md").read_text()
    table = text[text.index("## Where is what") : text.index("Paths are below")]
    rows = re.findall(r"^\| (?!X )(.*?) \| (.*?) \|$", table, re.M)
    assert len(rows) >= 20
    for _, places in rows:
        for place in re.findall(r"`(.*?)`", places):
            assert (REPO / place).exists() or (REPO / "limsim_jax" / place).exists(), place


def test_tests_that_a_page_names_exist():
    page = (REPO / "docs/results/mistakes.md").read_text()
    commands = re.findall(r"`(tests/[^`]+)`", page)
    assert len(commands) > 20
    for command in commands:
        places, _, wanted = command.partition(" -k ")
        files = [path for place in places.split() for path in sorted(REPO.glob(f"{place}/**/test_*.py"))]
        files += [REPO / place for place in places.split() if place.endswith(".py")]
        tests = re.findall(r"def (test_\w+)", "".join(path.read_text() for path in files))
        for word in wanted.strip('"').split(" or "):
            assert any(word in test for test in tests), f"{command}: no test '{word}'"


def test_the_english_is_plain():
    command = [sys.executable, ".ci/prose.py", *(str(path.relative_to(REPO)) for path in TOP), "docs"]
    found = subprocess.run(command, cwd=REPO, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout
