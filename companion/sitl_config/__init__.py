"""Configuration of the simulated world, for the commands, the launcher, the campaigns and sitl; a flight never reads it."""
