"""Section `computer:` of the vehicle file: the flight process on the onboard computer."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field

from companion.config.base import Model
from companion.runtime.cores import CPU_MAX

Cpu = Annotated[int, Field(ge=0, le=CPU_MAX)]


def _each_once(cpus: tuple[int, ...]) -> tuple[int, ...]:
    double = next((cpu for index, cpu in enumerate(cpus) if cpu in cpus[:index]), None)
    if double is not None:
        raise ValueError(f"expected each core once, got {double} twice in {list(cpus)}")
    return cpus


class Computer(Model):
    """The onboard computer. The preflight checks whether it has these cores, because the file is also read on other computers."""

    cpus: Annotated[tuple[Cpu, ...], AfterValidator(_each_once), Field(json_schema_extra={"uniqueItems": True})] = ()
    """Cores reserved for the flight process, numbered from 0; launcher, guardian, recorder and simulated world use the others. If it is
    empty, all processes share all cores."""
    lock_memory: bool = True
    """Whether the flight process locks its memory, if the system allows that. If false, the system may page the memory out."""
