"""PX4's parameters that this project requires, and their files."""
