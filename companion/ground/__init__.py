"""What vehicle and ground station share: messages, their topics, signed commands; and the ground station itself."""
