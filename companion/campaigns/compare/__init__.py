"""`companion compare`: one mission with several control laws, presets, payloads and seeds.

`tables` has the columns. A new metric is measured in `sitl.campaigns.flights`, summarised by `aggregate.FIGURES` and shown in
`tables`. `grid` has the variants that are flown, `paper_results` the paper's results, and `plots` the pictures.
"""
