"""Evaluation of flight logs.

`log` reads a log, and `metrics` computes metrics from it. `summary` builds summary.json; `companion.launcher.run` and
`companion.cli.report` fill in the values that are not in the log. `report` writes report.html, `plots` draws its plots, and
`plot_style` defines their colours. `companion.recorder` writes the log.
"""
