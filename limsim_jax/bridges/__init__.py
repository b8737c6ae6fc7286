"""Other simulators, other libraries' environments, other tools' formats."""
