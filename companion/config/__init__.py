"""The user's configuration files for vehicle, mission, controller and simulated world, which are checked when they are read."""
