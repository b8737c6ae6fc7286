"""What drives the vehicles under test."""
