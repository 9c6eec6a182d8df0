"""A real PX4 as the autopilot of the simulated world. This module starts PX4, configures it over MAVLink, restarts it, flies it in
lockstep and stops it.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import Any

from companion.config.airframe import Airframe
from companion.px4.versions import varies
from companion.sitl_config.faults import FaultKind
from companion.sitl_config.world import World as WorldConfig
from sitl.autopilot.backend import AutopilotBackend, Observation
from sitl.autopilot.modes import NavState
from sitl.autopilot.params import Value
from sitl.autopilot.types import Battery, FaultTarget, ImuSample, RotorCommands
from sitl.px4.control_link import ControlLink, Version, same
from sitl.px4.hil_link import HilSensors, Px4Error, SimulatorLink
from sitl.px4.parameter_file import restore, stored
from sitl.px4.parameters import BEFORE_BOOT, parameters
from sitl.px4.process import (
    HOW_TO_GET_IT,
    Installation,
    Instance,
    Px4Process,
    abandoned_instance,
    find,
    how_to_start_it,
)
from sitl.px4.relay import Relay
from sitl.udp import Address
from sitl.world.machine import Machine

BOOT_DEADLINE_S = 30.0
END_DEADLINE_S = 6.0
BY_HAND_DEADLINE_S = 10.0
"""Deadline for the connection of a PX4 that was started by hand, which retries twice per millisecond."""
USER_DEADLINE_S = 300.0
SAMPLE_S = 0.004
BATTERY_PERIOD_S = 0.1
STUB_ONLY_FAULTS: Mapping[FaultKind, str] = {
    "autopilot_reboot": "restarts PX4 in the middle of a step",
    "offboard_refused": "makes PX4 refuse a mode",
    "arming_refused": "makes PX4 refuse to arm",
    "kill_switch": "engages a switch of the pilot's radio",
    "battery_sag": "changes what PX4's power module measures",
}
"""Faults that only the stub can simulate, each with the reason."""
_LINK_FAULTS: frozenset[FaultKind] = frozenset({"link_loss", "link_delay"})

Progress = Callable[[str], None]


def refuse_stub_only_settings(config: WorldConfig) -> None:
    """Reject a world that only the stub can simulate; called before a real PX4 is started.

    Raises:
        Px4Error: the world has such a fault, or its battery does not start full although the effect `battery` is off.
    """
    for fault in config.faults:
        if fault.kind in STUB_ONLY_FAULTS and not (fault.kind == "battery_sag" and config.battery.on):
            raise Px4Error(
                f"world.faults: {fault.kind} {STUB_ONLY_FAULTS[fault.kind]}, which only the stub can simulate; run with --sitl"
            )
    if config.battery_start != 1.0 and not config.battery.on:
        raise Px4Error(
            f"world.battery_start: expected 1.0 with a real PX4, because PX4's own battery simulator starts full, found "
            f"{config.battery_start:g}; set world.battery.on, or run with --sitl"
        )


class RealPx4(AutopilotBackend):
    """One PX4 for one flight.

    Args:
        folder: folder for PX4's parameters, logs and output.
        progress: called with each progress message, one line for the user.

    Raises:
        Px4Error: the world needs the stub, PX4_SITL does not name a program, or no instance number is free.
    """

    lockstep = True
    refuses_offboard = refuses_arming = kill_switch = False

    def __init__(self, airframe: Airframe, config: WorldConfig, folder: Path, progress: Progress) -> None:
        refuse_stub_only_settings(config)
        self._airframe = airframe
        self._config = config
        self._folder = folder
        self._progress = progress
        self._installation: Installation | None = find()
        self._instance = Instance.claim()
        self._link = SimulatorLink(self._instance.simulator, HilSensors(config.seed), airframe.rotor_layout.count)
        self._control = ControlLink(self._instance, airframe.battery_cells)
        self._relay = Relay(self._instance) if any(f.kind in _LINK_FAULTS for f in config.faults) else None
        self._process: Px4Process | None = None
        self._version: Version | None = None
        self._imu: ImuSample | None = None
        self._next_battery_s = 0.0
        self._flies = False
        """Whether preparation is over; from then on, a disconnection of PX4 is an error."""

    @property
    def number(self) -> int:
        """Instance number of PX4."""
        return self._instance.number

    @property
    def armed(self) -> bool:
        """Whether PX4 is armed, according to the newest HIL_ACTUATOR_CONTROLS."""
        return self._link.armed

    @property
    def vision_address(self) -> Address:
        """Address of the gimbal link, which nothing else uses."""
        return self._instance.gimbal_address

    @property
    def fault_target(self) -> FaultTarget:
        """This object, for the one fault that a real PX4 can have; `refuse_stub_only_settings` has rejected the others."""
        return self

    def reboot(self, for_s: float) -> None:
        """Reject the fault; never called (`refuse_stub_only_settings`)."""
        raise Px4Error("world.faults: autopilot_reboot needs the stub; run with --sitl")

    def pilot_sets_mode(self, state: NavState) -> None:
        """Change the mode as a ground station does."""
        self._control.request_mode(state)

    def attach(self, machine: Machine) -> None:
        """Set the machine that PX4's simulated sensors measure."""
        self._machine = machine

    @contextlib.asynccontextmanager
    async def wires(self) -> AsyncIterator[str]:
        """Open the simulator and control links, start PX4 if one is installed, and yield the companion's address; stop it on exit."""
        async with contextlib.AsyncExitStack() as stack:
            stack.callback(self._instance.close)
            await stack.enter_async_context(self._link)
            await stack.enter_async_context(self._control)
            address = f"udpin://127.0.0.1:{self._instance.onboard_port}"
            if self._relay is not None:
                address = await stack.enter_async_context(self._relay.opened())
            stack.push_async_callback(self._end)
            if self._installation is not None:
                self._start(BEFORE_BOOT)
            yield address

    def _start(self, settings: Mapping[str, Value]) -> None:
        assert self._installation is not None
        self._process = Px4Process(self._installation, self._instance, self._folder, settings)

    async def prepare(self) -> None:
        """Wait for PX4 to boot, set the vehicle's parameters, restart PX4 if any changed, and check them again.

        Raises:
            Px4Error: PX4 did not connect, or did not keep its parameters.
        """
        if self._process is None:
            self._progress(
                f"px4 was not found; waiting up to {BY_HAND_DEADLINE_S:g} s on TCP {self._link.port} for a PX4 that is started by "
                f"hand with {how_to_start_it(self.number)}"
            )
        await self._boot(BOOT_DEADLINE_S if self._process is not None else BY_HAND_DEADLINE_S)
        self._version = await self._control.version()
        self._progress(f"PX4 {self._version}, instance {self.number}: setting its parameters")
        wanted = parameters(self._airframe, self._config, self._machine.hover_command)
        changed = await self._write_parameters(wanted)
        if changed:
            await self._restart(changed)
            left = await self._write_parameters(wanted)
            if left:
                fix = f"see {self._folder}" if self._process is not None else "start PX4 in the same folder both times"
                raise Px4Error(
                    f"PX4: expected the parameters to survive a restart, found {', '.join(left)} changed; {fix}"
                )
        await self._write_parameters(self._config.overridden_px4_params())
        await self._control.request_mode_stream()
        self._flies = True

    async def _boot(self, deadline_s: float) -> None:
        """Wait until PX4 answers samples: `deadline_s` to connect, then `BOOT_DEADLINE_S` to boot; raises Px4Error."""
        found, end_s = "no connection", time.monotonic() + deadline_s
        while not await self._link.await_lockstep(0.2):
            if self._process is not None and not self._process.running:
                raise Px4Error(self._process.exit_summary())
            if self._link.connected and found == "no connection":
                found, deadline_s = "no answer to the simulated sensors", BOOT_DEADLINE_S
                end_s = time.monotonic() + deadline_s
            if time.monotonic() > end_s:
                how = f"see {self._process.log}" if self._process is not None else self._how()
                raise Px4Error(
                    f"PX4: expected PX4 on TCP {self._link.port} within {deadline_s:g} s, found {found}; {how}"
                )
        await self._control.await_heartbeat()

    def _how(self) -> str:
        if (number := abandoned_instance()) is not None:
            return (
                f"instance {number} runs without a simulator: one that has flown must be started again, because its clock cannot go "
                f"back; stop it, start it with {how_to_start_it(number)} and run this command again"
            )
        return f"{HOW_TO_GET_IT}; or start PX4 by hand with {how_to_start_it(self.number)} and run this command again"

    async def _write_parameters(self, wanted: Mapping[str, Value]) -> dict[str, Value]:
        """Write the parameters that differ from the wanted values and return those that were written, in PX4's types."""
        have = await self._control.read(wanted)
        asked = self._config.px4_params
        absent = [name for name in wanted if name not in have and (name in asked or not varies(name))]
        if absent:
            raise Px4Error(
                f"PX4 {self._version}: expected the parameter {absent[0]}, found no parameter with this name"
                + (f" (nor {', '.join(absent[1:])})" if absent[1:] else "")
            )
        typed = {name: _as_type_of(have[name], value) for name, value in wanted.items() if name in have}
        different = {name: value for name, value in typed.items() if not same(value, have[name])}
        if different:
            await self._control.write(different)
            await self._control.save()
        return different

    async def _restart(self, changed: Mapping[str, Value]) -> None:
        """Restart PX4 in the same folder, or ask the user to restart it."""
        if self._process is None:
            self._progress(
                "the vehicle's parameters are set and take effect after a restart of PX4: stop PX4 "
                "and start it again in the same folder, where it stores them"
            )
            if not await self._link.await_disconnect(USER_DEADLINE_S):
                raise Px4Error(f"PX4: expected a restart within {USER_DEADLINE_S:g} s, found PX4 still running")
        else:
            store = await stored(self._folder, changed)
            self._process.terminate()
            await self._process.await_end(END_DEADLINE_S)  # the world and PX4's clock are stepped during the wait
            self._process.kill()
            restore(self._folder, store)
            await self._link.await_disconnect(1.0)
            self._start({})
        await self._boot(BOOT_DEADLINE_S if self._process is not None else USER_DEADLINE_S)

    def sense(self, imu: ImuSample) -> None:
        """Send HIL_SENSOR with this IMU sample and the magnetic field at the present true attitude."""
        self._imu = imu
        q = self._machine.q
        self._link.send(imu, (q[3], q[4], q[5], q[6]))

    async def answered(self) -> None:
        """Wait for the HIL_ACTUATOR_CONTROLS that answers the newest sample.

        Raises:
            Px4Error: PX4 has ended, or has stopped answering.
        """
        if self._link.pending:
            await self._link.answered()
        if self._flies and not self._link.connected:
            raise Px4Error(await self._exit_summary())

    async def _exit_summary(self) -> str:
        if self._process is None:
            return "PX4: expected PX4 to run until the end of the flight, found that it has closed its simulator link"
        await self._process.await_end(1.0)
        return self._process.exit_summary()

    def step(self, imu: ImuSample) -> RotorCommands:
        """Return the rotor commands of PX4's newest answer."""
        del imu
        return self._link.rotors

    def pump(self, t_s: float, battery: Battery) -> None:
        """Send the battery's state if its effect is on; otherwise PX4 simulates one. It streams its telemetry by itself."""
        if self._config.battery.on and t_s >= self._next_battery_s:
            self._next_battery_s = t_s + BATTERY_PERIOD_S
            self._control.send_battery(battery)

    def set_link(self, down: bool, delay_s: float) -> None:
        """Apply link faults to the relay."""
        if self._relay is not None:
            self._relay.down, self._relay.delay_s = down, delay_s

    def observe(self) -> Observation:
        """Return PX4's mode; the other fields are None, because only PX4's own log shows its inputs."""
        return Observation(None, None, self._control.nav_state)

    def about(self) -> dict[str, Any]:
        """Return the kind, version, build, instance number, number of unanswered samples and clock origin of this PX4."""
        version = self._version
        return {
            "kind": "px4",
            "version": None if version is None else version.release,
            "build": None if version is None else version.build,
            "instance": self.number,
            "unanswered": self._link.unanswered,
            "clock_begun_s": self._link.clock_begun_s,
        }

    async def _end(self) -> None:
        """Stop the PX4 that was started here. It receives samples until it has ended, because they drive its clock."""
        self._flies = False
        process, imu = self._process, self._imu
        if process is None:
            return
        if imu is None:
            process.kill()
            return
        if self._link.armed:
            self._control.force_disarm()
        t_s, end_s = imu.t_s, time.monotonic() + END_DEADLINE_S
        process.terminate()
        while process.running and time.monotonic() < end_s:
            t_s += SAMPLE_S
            self.sense(imu._replace(t_s=t_s))
            await asyncio.sleep(SAMPLE_S)
        process.kill()


def _as_type_of(known: Value, value: Value) -> Value:
    return int(value) if isinstance(known, int) else float(value)
