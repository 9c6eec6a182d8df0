"""`companion hover fit` on the real log of a flight: flown in the fast loop, written by the recorder, read by the command."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import pytest

from companion.analysis.hover_fit import HoverFit, VoltageSlope
from companion.analysis.log import FlightLog
from companion.cli.hover import jsonable, lines
from companion.config.yaml_strict import read_document
from companion.model.exit_codes import EXIT_BAD_INPUT
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import log_of
from sitl.fast.loop import FastFlight
from tests.analysis.recorded import record
from tests.commands import companion, refused

ERROR = 0.05
"""Of the hover thrust that was flown with."""


@pytest.fixture(scope="module")
def flown(short_start: None) -> tuple[FlightLog, float]:
    """A flight, and the true hover thrust of its world."""
    flight = FastFlight(load_sitl("configs/missions/catch.yaml", overrides=(f"world.hover_thrust_error={ERROR}",)))
    truth = flight.plant.machine.hover_command
    return log_of(flight.config, flight.run(until_mission_s=9.0), None), truth


@pytest.fixture(scope="module")
def recorded(flown: tuple[FlightLog, float], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(flown[0], tmp_path_factory.mktemp("hover") / "flight.mcap")


def test_it_prints_the_truth_and_what_to_write_into_the_vehicle_file(
    flown: tuple[FlightLog, float], recorded: Path, tmp_path: Path
) -> None:
    out = companion("hover", "fit", recorded).out
    value = re.search(r"^hover thrust +(0\.\d{4}) ± (0\.\d{4}) \(standard error\), from (\d+\.\d) s", out)
    assert value is not None, out
    assert float(value[1]) == pytest.approx(flown[1], rel=0.005)
    assert 0.0 < float(value[2]) < 0.002
    assert float(value[3]) > 5.0
    began = re.search(r"^value at the start 0\.\d{4}, \+(\d\.\d\d) % of the fitted value$", out, re.M)
    assert began is not None, out
    assert float(began[1]) == pytest.approx(100 * ERROR, abs=0.5)
    assert "V or more needed to fit a slope" in out
    patch = tmp_path / "patch.yaml"
    patch.write_text(out[out.index("#") :], encoding="utf-8")
    assert patch.read_text(encoding="utf-8").startswith("# configs/vehicles/tarot650_2r.yaml\n")
    assert read_document(patch).data == {"airframe": {"hover_thrust": float(value[1])}}


def test_the_value_that_it_gives_is_one_that_flies(recorded: Path) -> None:
    """As JSON; the patch is a value that the vehicle file takes."""
    told: dict[str, Any] = json.loads(companion("hover", "fit", recorded, "--json").out)
    assert set(told) == set(
        jsonable(
            HoverFit(
                hover_thrust=0.5,
                standard_error=0.0,
                used_s=2.0,
                configured=None,
                last_estimate=None,
                voltage_mean_v=None,
                voltage_span_v=None,
                slope=None,
            )
        )
    )
    value = told["patch"]["airframe"]["hover_thrust"]
    config = load_sitl("configs/missions/catch.yaml", overrides=(f"vehicle.airframe.hover_thrust={value}",))
    assert config.vehicle.airframe.hover_thrust == value == round(told["hover_thrust"], 4)
    assert told["configured_error"] == pytest.approx(ERROR, abs=0.005)
    assert told["slope_per_v"] is None


def test_a_log_that_never_hovered_and_a_file_that_is_no_log_are_refused_in_one_line(
    flown: tuple[FlightLog, float], tmp_path: Path
) -> None:
    log = flown[0]
    ground = sum(o.mission_t_s == 0.0 for o in log.outputs)
    short = dataclasses.replace(
        log, inputs=log.inputs[:ground], outputs=log.outputs[:ground], sent=log.sent[:ground], closed=True
    )
    text = tmp_path / "notes.txt"
    text.write_text("thirty characters and then some", encoding="utf-8")
    for path, reason in (
        (record(short, tmp_path / "short.mcap"), "0.0 s of steady flight, expected 2 s or more"),
        (text, "not an MCAP file"),
        (tmp_path / "absent.mcap", "No such file"),
    ):
        line = refused(EXIT_BAD_INPUT, "hover", "fit", path)
        assert line.startswith(f"{path}: ") and reason in line


def test_a_slope_is_reported_with_the_voltage_that_the_value_holds_for() -> None:
    fit = HoverFit(
        hover_thrust=0.4912,
        standard_error=0.0003,
        used_s=31.2,
        configured=0.5,
        last_estimate=0.492,
        voltage_mean_v=15.62,
        voltage_span_v=1.4,
        slope=VoltageSlope(-0.021, 0.0008),
    )
    told = lines(fit, "my_vehicle.yaml")
    assert told[0] == "hover thrust      0.4912 ± 0.0003 (standard error) at 15.62 V, from 31.2 s of steady flight"
    assert told[1] == "value at the start 0.5000, +1.79 % of the fitted value"
    assert told[3].endswith("15.62 V on average, changed by 1.40 V; slope -0.0210 ± 0.0008 per V")
    assert told[-3:] == ["# my_vehicle.yaml", "airframe:", "  hover_thrust: 0.4912"]
    assert jsonable(fit)["slope_per_v"] == -0.021
