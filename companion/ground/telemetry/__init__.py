"""Telemetry records of a flight, built from its ticks, for publication and for the replay of a log. Pure."""
