"""What this project needs of PX4: its parameters, and the files that they are kept in."""
