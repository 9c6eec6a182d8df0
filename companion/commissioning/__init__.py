"""Tools that commission a new machine: each measures, proposes a change of the vehicle file, and writes it only when asked."""
