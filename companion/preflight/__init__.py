"""What must be true before the machine may lift: seen on the wires for a few seconds, judged purely, one row per check."""
