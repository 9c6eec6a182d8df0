"""What a user may write down: vehicle, mission, controller and SITL world files, checked on reading."""
