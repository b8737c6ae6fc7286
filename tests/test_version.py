"""The version stands in one place, and what repeats it agrees."""

import re

from paths import REPO

import limsim_jax as lj


def test_the_citation_file_has_the_version_of_the_package():
    assert re.search(r"^version: (.*)$", (REPO / "CITATION.cff").read_text(), re.M)[1] == lj.__version__


def test_the_changelog_begins_with_this_version():
    assert re.search(r"^## \[?([\w.]+)", (REPO / "CHANGELOG.md").read_text(), re.M)[1] == lj.__version__


def test_the_package_is_marked_as_typed():
    assert (REPO / "limsim_jax" / "py.typed").is_file()
