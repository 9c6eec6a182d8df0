"""`companion faults`: flights with one fault each.

`variants` lists the faults that are flown, with sizes and durations. To add a kind of fault, define it in
`companion.sitl_config.faults` (`KINDS`) and implement its effect in `sitl.faults`. `judge` determines the outcome
of a flight and the values of its row; `campaign` makes the tables.
"""
