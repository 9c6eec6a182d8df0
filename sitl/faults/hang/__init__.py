"""Folder for the flight process's PYTHONPATH, from which Python imports `sitecustomize` when it starts."""
