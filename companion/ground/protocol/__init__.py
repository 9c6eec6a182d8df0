"""What a vehicle and its ground stations share: messages, operator keys, signed commands, the MQTT connection."""
