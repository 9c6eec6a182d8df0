"""`companion faults`: flights with one fault each.

`variants` lists the faults that are flown, with sizes and durations. A new kind of fault begins in `companion.sitl_config.faults`
(`FaultKind` and `KINDS`), and its effect is in `sitl.faults`. `judge` has the outcome of a flight and the columns of its row;
`campaign` has the tables.
"""
