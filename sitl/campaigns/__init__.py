"""Flies the flights of campaigns in the fast loop. `companion compare`, `robustness`, `faults` and `tune` start
`python -m sitl.campaigns`.

Standard input contains the job, one line of JSON, and stays open; when it closes, the campaign ends. The keys of the job are:

* `campaign`: compare, robustness, faults or tune.
* `configs`: effective configurations (`SitlConfig`).
* `flights`: one mapping per flight. `variant` is the index of its configuration; the other keys depend on the campaign.
* `jobs`: number of processes; null for one per core.
* `scheduler`: address of a Dask scheduler on whose workers the flights run; null for this computer.
* `batches`: whether further lines follow, each with the `flights` of one batch, which is flown before the next line is read.

Standard output has a line of JSON for each flight that ends, {"type": "flight", "index", "row", "wall_s"}, or
{"type": "error", "text", "bad_input"} and exit code 1 if the campaign cannot continue.

The row of a flight depends only on its configuration, not on the computer or on other flights.
"""
