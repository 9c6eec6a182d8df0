"""`companion compare`: one mission with several control laws, presets, payloads and seeds.

`tables` has the columns. A new figure is measured in `sitl.campaigns.flights`, summarised by `aggregate.FIGURES` and shown in
`tables`. `grid` has the variants that are flown, `paper_results` the figures of the paper, and `plots` the pictures.
"""
