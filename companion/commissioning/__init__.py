"""Tools that bring a machine from a box of parts to its first flight: each finds out, proposes, and writes only when asked."""
