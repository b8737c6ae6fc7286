"""The XML reader: attributes, faults, and the count of what is left out."""

import pytest

from limsim_jax.maps.network import Action, ImportReport, MapError
from limsim_jax.maps.xml import XmlReader, root_name

TEXT = b"""<m:root xmlns:m="urn:x" version=" 1.4 ">
  <!-- a comment -->
  <item id="a" size="2.5" count="3" on="yes" side="l" empty="" odd="x"
    ><part><at> 7 </at><at2>nan</at2></part></item>
  <m:item id="b" other="1"/>
  <rest/>
</m:root>"""


def parsed() -> tuple[XmlReader, list]:
    xml = XmlReader("file.xml")
    return xml, list(xml.parse(TEXT, "root", "net"))


def test_attributes_have_types_and_defaults():
    xml, (a, b, _) = parsed()
    assert xml.text(a.getparent(), "version") == "1.4"
    assert (xml.text(a, "id"), xml.text(a, "none", None), xml.text(a, "none", "z")) == ("a", None, "z")
    assert (xml.number(a, "size"), xml.number(a, "none", None), xml.number(a, "empty", 4.0)) == (
        2.5,
        None,
        4.0,
    )
    count = xml.integer(a, "count")
    assert count == 3 and isinstance(count, int) and xml.integer(b, "count", None) is None
    assert xml.flag(a, "on") and not xml.flag(b, "on") and xml.flag(b, "on", True)
    assert xml.choice(a, "side", {"l": 1, "r": 2}) == 1
    assert xml.content(a, "part/at") == 7.0


@pytest.mark.parametrize(
    ("read", "reason"),
    [
        (lambda xml, a: xml.text(a, "none"), "attribute 'none' is missing"),
        (lambda xml, a: xml.number(a, "empty"), "attribute 'empty' is missing"),
        (lambda xml, a: xml.number(a, "odd"), "attribute 'odd' is 'x', not a finite number"),
        (lambda xml, a: xml.number(a, "size", minimum=3.0), "attribute 'size' is '2.5', below 3"),
        (lambda xml, a: xml.integer(a, "size"), "attribute 'size' is '2.5', not a whole number"),
        (lambda xml, a: xml.flag(a, "count"), "attribute 'count' is '3', not a truth value"),
        (lambda xml, a: xml.choice(a, "odd", {"l": 1, "r": 2}), "attribute 'odd' is 'x', none of l r"),
        (lambda xml, a: xml.content(a, "part/none"), "<part/none> is missing"),
        (lambda xml, a: xml.content(a, "part/at2"), "<part/at2> is 'nan', not a finite number"),
    ],
)
def test_faults_name_file_line_element_and_reason(read, reason):
    xml, (a, *_) = parsed()
    with pytest.raises(MapError) as caught:
        read(xml, a)
    assert str(caught.value) == f"file.xml:4: <item a>: {reason}"


def test_children_are_those_of_the_whole_tree():
    whole = [(child.tag, child.get("id"), len(child)) for child in parsed()[1]]
    one_by_one = [
        (child.tag, child.get("id"), len(child)) for _, child in XmlReader("file.xml").children(TEXT, "root")
    ]
    assert one_by_one == whole == [("item", "a", 1), ("item", "b", 0), ("rest", None, 0)]
    assert root_name(TEXT, "file.xml") == "root"


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"<other/>", "file.xml:1: the root element is <other>, not <root> or <net>"),
        (b"<root>", "not well-formed XML"),
        (b'<!DOCTYPE root [<!ENTITY x "y">]><root/>', "declares XML entities"),
        (b'<!DOCTYPE root SYSTEM "x.dtd"><root><a>&x;</a></root>', "entity reference '&x;'"),
    ],
)
def test_refused_documents(data, reason):
    with pytest.raises(MapError) as caught:
        XmlReader("file.xml").parse(data, "root", "net")
    assert reason in str(caught.value)
    with pytest.raises(MapError) as caught:
        list(XmlReader("file.xml").children(data, "root", "net"))
    assert reason in str(caught.value)


def test_what_is_left_out_is_counted_once_per_kind():
    xml, (a, b, rest) = parsed()
    for item in (a, b):
        xml.text(item, "id")
        xml.ignore_unasked(item)
    xml.ignore_children(a, "at")
    xml.ignore(rest, "not needed")
    assert xml.unasked(b) == {"other": "1"}
    report = ImportReport()
    xml.ignored.summarise(report)
    ignored = {kind: count for (kind, action), count in report.counts.items() if action is Action.IGNORED}
    names = ("size", "count", "on", "side", "empty", "odd", "other")
    assert ignored == {"item/part": 1, "root/rest": 1, **{f"item@{name}": 1 for name in names}}
    assert "ignored      line 6: root/rest <rest>: not needed; 1 in the file, the first here" in map(
        str, report.notes
    )
