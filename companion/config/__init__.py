"""Configuration files of the user: vehicle, mission, controller and SITL world, checked on reading."""
