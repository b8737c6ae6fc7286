"""The version stands in one place, and what repeats it agrees."""

import re

from paths import REPO

import limsim_jax as lj


def first(pattern: str, file: str) -> str:
    found = re.search(pattern, (REPO / file).read_text(), re.M)
    assert found is not None, file
    return found[1]


def test_the_citation_file_has_the_version_of_the_package():
    assert first(r"^version: (.*)$", "CITATION.cff") == lj.__version__


def test_the_changelog_begins_with_this_version():
    assert first(r"^## \[?([\w.]+)", "CHANGELOG.md") == lj.__version__


def test_the_package_is_marked_as_typed():
    assert (REPO / "limsim_jax" / "py.typed").is_file()
