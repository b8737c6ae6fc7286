"""Kinds of key moments: one table for episodes, reports and replays."""

from limsim_jax.metrics import moments
from limsim_jax.metrics.blame import Responsibility


def test_every_party_of_a_contact_has_words():
    names = {party.name.lower() for party in Responsibility if party is not Responsibility.NONE}
    assert names == set(moments.RESPONSIBLE)


def test_kinds_have_words_and_values_have_units():
    assert moments.ORDER[:2] == ("policy_failed", "contact")
    assert moments.words("near_miss") == "near miss" and moments.words("my_own") == "my own"
    assert moments.value_text("contact", 3.21) == "delta-v 3.2 m/s"
    assert moments.value_text("off_road", 0.5) == ""
    assert moments.value_text("my_own", 0.12345) == "0.123"
