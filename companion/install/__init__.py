"""What `companion install` puts on the vehicle's computer, and takes away again.

texts.py      the files' contents
adapters.py   USB serial adapters that are plugged in, from /sys
plan.py       settings -> files and commands; pure
state.py      what stands at a path: read, write, put back
record.py     /var/lib/companion/installed.json: what stood there before, and what was put there
apply.py      install and undo
"""
