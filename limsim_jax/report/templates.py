"""Templates of pages: Jinja files beside the modules, with every text escaped."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

_FOLDER = Path(__file__).parent


@functools.cache
def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    return Environment(
        loader=FileSystemLoader(_FOLDER, encoding="utf-8"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render(template: str, **values: Any) -> str:
    """The text of a template of this room; values are escaped unless they are `Markup`."""
    return _environment().get_template(template).render(values)


def read(name: str) -> Markup:
    """A style sheet or script of this room, as it stands."""
    from markupsafe import Markup

    return Markup((_FOLDER / name).read_text(encoding="utf-8"))
