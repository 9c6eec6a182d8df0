"""`companion tune`: finds the gains of a control law for a machine by CMA-ES in drawn laboratories.

`space` maps points to gains, `draws` has the laboratories, `search` is the search, `flights` flies it and keeps what was flown,
`result` has the results and `output` writes them.
"""
