"""The recorder process: writes the flight's log and holds its telemetry session."""
