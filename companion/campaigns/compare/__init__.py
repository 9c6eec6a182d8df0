"""`companion compare`: one mission with several control laws, presets, payloads and seeds.

`grid` defines the variants that are flown, `paper_results` contains the paper's results, `tables` defines the columns, and `plots`
draws the pictures. To add a metric, measure it in `sitl.campaigns.flights`, add it to `aggregate.FIGURES` and show it in `tables`.
"""
