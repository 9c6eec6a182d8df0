"""Tools that commission a new vehicle: each measures, proposes a change to the vehicle file, and writes it only on request."""
