"""Goes onto the flight process's PYTHONPATH when the world is to hang it: `sitecustomize` is imported by every Python at its start."""
