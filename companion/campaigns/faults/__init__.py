"""`companion faults`: flights with one fault each.

`variants` lists the faults that are flown, with sizes and durations; `sitl.faults` says how to add a kind. `judge` determines
the outcome of a flight and the values of its row; `campaign` makes the tables.
"""
