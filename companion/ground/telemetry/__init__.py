"""Telemetry records of a flight, built from its ticks: what the vehicle publishes and what a replayed log shows. Pure."""
