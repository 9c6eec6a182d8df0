"""Two vehicles carry a bar between them (`companion team`): each flies `grip`, `carry` and `release`, at one end of it."""
