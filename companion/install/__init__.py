"""`companion install`: set up the vehicle's computer, or undo the installation.

templates.py  contents of the installed files
adapters.py   USB serial adapters that are plugged in, from /sys
plan.py       settings -> files and commands; pure
state.py      content of a path: read, write, compare
record.py     /var/lib/companion/installed.json: content before and after the installation
apply.py      install and undo
"""
