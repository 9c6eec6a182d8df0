"""The ground segment: the protocol over MQTT, telemetry records, the ground station and the broker's setup."""
