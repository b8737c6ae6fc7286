"""OpenDRIVE elements as text, for small maps with known answers."""

from limsim_jax.maps.network import Network, Note

LINE = "<line/>"


def lane(number, *, width=3.5, kind="driving", links: dict[str, int] | None = None, inner=""):
    link = "".join(f'<{k} id="{v}"/>' for k, v in (links or {}).items())
    mark = "" if "<roadMark" in inner else '<roadMark sOffset="0" type="broken"/>'
    shape = "" if "<border" in inner or "<width" in inner else f'<width sOffset="0" a="{width}"/>'
    return f'<lane id="{number}" type="{kind}"><link>{link}</link>{shape}{mark}{inner}</lane>'


def section(s, left=(), right=(), center=""):
    side = lambda name, lanes: f"<{name}>{''.join(lanes)}</{name}>" if lanes else ""  # noqa: E731
    center = center or '<lane id="0" type="none"><roadMark sOffset="0" type="solid"/></lane>'
    return (
        f'<laneSection s="{s}">{side("left", left)}<center>{center}</center>'
        f"{side('right', right)}</laneSection>"
    )


def road(
    name,
    sections,
    *,
    length=100.0,
    x=0.0,
    y=0.0,
    hdg=0.0,
    shape=LINE,
    junction=-1,
    links="",
    head="",
    extra="",
    rule="",
    offsets="",
    tail="",
):
    rule = f' rule="{rule}"' if rule else ""
    geometry = f'<geometry s="0" x="{x}" y="{y}" hdg="{hdg}" length="{length}">{shape}</geometry>'
    return (
        f'<road id="{name}" length="{length}" junction="{junction}"{rule}><link>{links}</link>{head}'
        f"<planView>{geometry}</planView>{extra}<lanes>{offsets}{''.join(sections)}</lanes>{tail}</road>"
    )


def link(kind, name, contact="", element="road", more=""):
    contact = f' contactPoint="{contact}"' if contact else ""
    return f'<{kind} elementType="{element}" elementId="{name}"{contact}{more}/>'


def notes(network: Network, element: str) -> list[Note]:
    return [n for n in network.report.notes if n.element == element]


def two_way(links):
    return {"predecessor": links, "successor": links}


def document(*elements: str) -> str:
    """A whole file."""
    return f'<OpenDRIVE>\n<header revMajor="1" revMinor="7"/>\n{chr(10).join(elements)}\n</OpenDRIVE>'
