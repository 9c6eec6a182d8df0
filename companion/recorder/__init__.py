"""The inside of the recorder process: disk, log, channel."""
