"""Folder on the flight process's PYTHONPATH, so that Python imports `sitecustomize` at its start."""
