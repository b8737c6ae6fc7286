"""Catalogs: entries of other files, with parameters of their own.

A catalog lies in the folder of the scenario or below it: absolute paths and paths with `..` are refused. A
`root` that the user names allows other folders within it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from limsim_jax.scenarios.openscenario.expressions import Value
from limsim_jax.scenarios.openscenario.parameters import read_declarations, settle
from limsim_jax.scenarios.openscenario.source import Node, Source

KINDS = (
    "Vehicle",
    "Controller",
    "Pedestrian",
    "MiscObject",
    "Environment",
    "Maneuver",
    "Trajectory",
    "Route",
)
MOST_FILES = 500
"""Files of a catalog folder that are looked at."""


def inside(node: Node, name: str, what: str, root: Path | None = None) -> Path:
    """A path within the folder of the scenario, or within `root`.

    Raises:
      OpenScenarioError: it is absolute or leads out of the folder.
    """
    text = name.replace("\\", "/")
    folder = node.source.path.parent
    if text.startswith("/") or ":" in text or "\0" in text:
        raise node.error(f"{what} '{name}' is absolute; a path from the folder of the scenario is expected")
    path = folder / text
    if root is None and ".." in PurePosixPath(text).parts:
        raise node.error(f"{what} '{name}' is outside the folder of the scenario; allow it by a root")
    if not path.resolve().is_relative_to((folder if root is None else root).resolve()):
        raise node.error(
            f"{what} '{name}' leads out of {'the folder of the scenario' if root is None else root}"
        )
    return path


class Catalogs:
    """The catalogs that a scenario names; files are read when an entry is first wanted."""

    def __init__(self, root: Node, *, lenient: bool, within: Path | None = None) -> None:
        self.lenient, self.within = lenient, within
        self.owner = root.source
        self._folders: dict[str, tuple[Node, str]] = {}
        self._found: dict[Path, dict[str, Node]] = {}
        block = root.optional("CatalogLocations")
        for one in [] if block is None else block.every():
            kind = one.tag.removesuffix("Catalog")
            if kind not in KINDS:
                raise one.error(f"unknown catalog; known are {', '.join(f'{x}Catalog' for x in KINDS)}")
            directory = one.child("Directory")
            self._folders[kind] = directory, directory.text("path")

    def _files(self, kinds: tuple[str, ...]) -> dict[str, list[Node]]:
        """`<Catalog>` elements by name, of the folders for these kinds of entries."""
        named: dict[Path, Node] = {}
        for kind in kinds:
            node, name = self._folders.get(kind, (None, ""))
            if node is not None and name:
                named.setdefault(inside(node, name, "catalog folder", self.within), node)
        found: dict[str, list[Node]] = {}
        for folder, node in named.items():
            if folder not in self._found:
                self._found[folder] = self._read(folder, node)
            for name, catalog in self._found[folder].items():
                found.setdefault(name, []).append(catalog)
        return found

    def _read(self, folder: Path, node: Node) -> dict[str, Node]:
        if folder.is_dir():
            files = sorted(x for x in folder.iterdir() if x.suffix.lower() == ".xosc" and x.is_file())
        else:
            files = [folder] if folder.is_file() else []
        if len(files) > MOST_FILES:
            raise node.error(f"catalog folder '{folder}' has {len(files)} files; at most {MOST_FILES}")
        found: dict[str, Node] = {}
        for path in files:
            source = Source(path, lenient=self.lenient)
            root = source.root()
            for element in root.element:
                if element.tag == "Catalog":
                    catalog = source.node(element, {})
                    found.setdefault(catalog.text("name"), catalog)
                    found.setdefault(path.stem, catalog)  # files are also named by their file
        return found

    def entry(self, reference: Node, *kinds: str) -> Node:
        """The element that a `<CatalogReference>` names, with its parameters.

        Raises:
          OpenScenarioError: there is none, or it is of another kind.
        """
        catalog_name, name = reference.text("catalogName"), reference.text("entryName")
        given: dict[str, Value] = {}
        block = reference.optional("ParameterAssignments")
        for one in [] if block is None else block.children("ParameterAssignment"):
            given[one.raw("parameterRef").removeprefix("$")] = one.value("value")
        catalogs = self._files(kinds)
        if catalog_name not in catalogs:
            catalogs |= self._files(tuple(x for x in KINDS if x not in kinds))
        if catalog_name not in catalogs:
            known = ", ".join(sorted(catalogs)) or "none in the folders of this scenario"
            raise reference.error(f"unknown catalog '{catalog_name}'; known are {known}")
        entries = [(c, x) for c in catalogs[catalog_name] for x in c.element if x.tag in kinds]
        found = [(c, x) for c, x in entries if x.get("name") == name]
        if not found:
            known = ", ".join(str(x.get("name")) for _, x in entries)
            known = known or f"none of its entries is a {' or '.join(kinds)}"
            raise reference.error(f"catalog '{catalog_name}' has no entry '{name}'; known are {known}")
        catalog, element = found[0]
        node = catalog.source.node(element, {})
        return node if node.tag in ("Controller", "Environment") else with_parameters(node, given)

    def notes_and_check(self, node: Node) -> None:
        """After an entry was read: refuse what no reader asked for, and hand notes on."""
        if node.source is not self.owner:
            node.source.check(node)
            self.owner.notes.update(node.source.notes)


def with_parameters(node: Node, given: Mapping[str, Value]) -> Node:
    """An element with the parameters that it declares."""
    declared = read_declarations(node)
    unknown = [x for x in given if x not in {one.name for one in declared}]
    if unknown:
        node.source.note(f"{node.tag} '{node.element.get('name')}': parameter '{unknown[0]}' is not declared")
    return node.scoped(settle(declared, given, node.scope))
