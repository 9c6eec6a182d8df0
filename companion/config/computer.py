"""Section `computer:` of the vehicle file: what the flight process may have of the computer on board."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field

from companion.config.base import Model
from companion.runtime.cores import CPU_MAX

Cpu = Annotated[int, Field(ge=0, le=CPU_MAX)]


def _each_once(cpus: tuple[int, ...]) -> tuple[int, ...]:
    double = next((cpu for index, cpu in enumerate(cpus) if cpu in cpus[:index]), None)
    if double is not None:
        raise ValueError(f"each core once, got {double} twice in {list(cpus)}")
    return cpus


class Computer(Model):
    """The computer on board; whether it has these cores is a row of the preflight, because the file is read elsewhere, too."""

    cpus: Annotated[tuple[Cpu, ...], AfterValidator(_each_once), Field(json_schema_extra={"uniqueItems": True})] = ()
    """Cores of the flight process, numbered from 0; launcher, guardian, recorder and simulated world keep off them. Empty: all share
    all."""
    lock_memory: bool = True
    """Keep the flight process in memory, where that is permitted; false: the system may drop and reload its pages."""
