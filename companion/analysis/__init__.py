"""Evaluation of flight logs.

`log` reads a log, and `metrics` computes metrics from it. `summary` has the keys of summary.json; `companion.launcher.run` and
`companion.cli.report` fill in those that the log does not hold. `report` has the sections of report.html, `plots` the plots, and
`plot_style` their colours. `companion.recorder` writes the log.
"""
