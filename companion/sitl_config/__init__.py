"""Configuration of the simulated world, used by the commands, the launcher, the campaigns and sitl, but never by a flight."""
