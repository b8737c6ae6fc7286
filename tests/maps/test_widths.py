"""Where lanes are wide enough: tapers over one lane section or several."""

from small_xodr import lane, link, road, section

from limsim_jax.maps.widths import usable, without_blind_changes


def opening(width):
    """A lane number -2 whose width is a cubic of its section."""
    return "".join(f'<width sOffset="{s}" a="{a}" b="{b}"/>' for s, a, b in width)


def test_lane_counts_from_where_it_is_wide(read):
    network = read(
        road("1", [section(0, right=[lane(-1), lane(-2, inner=opening([(0, 0, 0.07), (50, 3.5, 0)]))])])
    )
    begin, end = usable(network)["1_0_-2"]
    assert abs(begin - 2.7 / 0.07) < 1.0 and end == network.lanes["1_0_-2"].length
    assert usable(network)["1_0_-1"] == (0.0, 100.0)


def test_taper_over_two_sections(read):
    """The first section of the taper is nowhere wide enough; the second counts from where it is."""
    first = lane(-2, inner=opening([(0, 0, 0.03)]), links={"successor": -2})
    second = lane(-2, inner=opening([(0, 1.2, 0.05)]), links={"predecessor": -2, "successor": -2})
    third = lane(-2, links={"predecessor": -2})
    slow = '<speed sOffset="0" max="9"/>'  # sections of equal lanes would be one
    goes_on = {"predecessor": -1, "successor": -1}
    network = read(
        road(
            "1",
            [
                section(0, right=[lane(-1, links={"successor": -1}), first]),
                section(40, right=[lane(-1, links=goes_on, inner=slow), second]),
                section(90, right=[lane(-1, links={"predecessor": -1}), third]),
            ],
            length=150.0,
        )
    )  # fmt: skip
    found = usable(network)
    outer = sorted(name for name in found if name.endswith("_-2"))
    length = network.lanes[outer[0]].length
    assert found[outer[0]] == (length, 0.0), "no place for a car"
    begin, end = found[outer[1]]
    assert abs(begin - (2.7 - 1.2) / 0.05) < 1.0 and end == network.lanes[outer[1]].length
    assert found[outer[2]][0] == 0.0


def test_roads_that_are_narrow_as_a_whole_are_driven(read):
    first = road("1", [section(0, right=[lane(-1, width=2.0)])], links=link("successor", "2", "start"))
    second = road("2", [section(0, right=[lane(-1, width=2.4)])], x=100.0)
    found = usable(read(first, second))
    assert found == {"1_0_-1": (0.0, 100.0), "2_0_-1": (0.0, 100.0)}


def test_no_change_to_a_lane_that_opens_where_the_own_lane_has_ended(read):
    """Lane -2 closes and -3 opens: it matters where whether a vehicle can change over."""
    for begins, possible in ((60.0, False), (0.0, True)):
        closing = lane(-2, inner=opening([(0, 3.5, 0.0), (20, 3.5, -0.07)]))
        other = lane(-3, inner=opening([(0, 0, 0.0), (begins, 0, 3.5 / 30), (begins + 30, 3.5, 0)]))
        network = read(road("1", [section(0, right=[lane(-1), closing, other])]))
        assert usable(network)["1_0_-2"][1] < 35
        found = without_blind_changes(network).lanes
        assert found["1_0_-2"].may_change_right == possible
        assert found["1_0_-3"].may_change_left and found["1_0_-1"].may_change_right, "the other way they can"
