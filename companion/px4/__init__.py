"""The PX4 parameters that this project requires, and their files."""
