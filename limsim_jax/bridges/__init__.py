"""Worlds beside other simulators, in other libraries' shapes, and in other tools' formats."""
