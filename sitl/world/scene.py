"""A scene: one MuJoCo model with its machines, the surfaces, the payload and the clock."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco

from sitl.world.bar import Bar, BarSpec, bar_mjcf
from sitl.world.loads import Bodies, Loads
from sitl.world.machine import Machine
from sitl.world.model import mjcf, prefix_of
from sitl.world.payload import Payload
from sitl.world.start import MachineSpec
from sitl.world.state import PHYSICS_DT_S, Events, WorldEvent
from sitl.world.surfaces import Surfaces


class Scene:
    """The physics: set the commands of each machine (`Machine.command`), then call `step`, which advances it by `PHYSICS_DT_S`.

    The objects are those of the first machine's configuration: the surfaces, which every tip can touch, and the payload, which is
    thrown to the first machine. Machines do not collide with each other.

    Args:
        machines: at least one machine.
        bar: the bar that the two machines carry; None if there is none.
    """

    def __init__(self, machines: Sequence[MachineSpec], bar: BarSpec | None = None) -> None:
        first = machines[0]
        shared = {"surfaces": first.config.surfaces}
        machines = (first, *(each._replace(config=each.config.model_copy(update=shared)) for each in machines[1:]))
        prefixes = tuple(prefix_of(number) for number in range(len(machines)))
        parts = ("", "", "") if bar is None else bar_mjcf(bar, prefixes)
        model = mujoco.MjModel.from_xml_string(mjcf([each[:2] for each in machines], PHYSICS_DT_S, parts))
        self.model, self.data = model, mujoco.MjData(model)
        self.loads, self._events = Loads(self.data), Events()
        self.surfaces = Surfaces(first.config, model) if first.config.surfaces else None
        bodies = tuple(Bodies(model, self.data, self.loads, prefix) for prefix in prefixes)
        self.machines = tuple(
            Machine(spec, each, self._events, self.surfaces) for spec, each in zip(machines, bodies, strict=True)
        )
        mujoco.mj_forward(model, self.data)
        self.payload = Payload(self.machines[0], bodies[0], first.vehicle, first.config, self._events)
        self.bar = None if bar is None else Bar(bar, bodies, self.machines, self._events)
        self.t_s = 0.0

    def step(self, airborne: bool = True) -> None:
        """Advance by one physics step.

        Args:
            airborne: whether a payload may be thrown.

        Raises:
            FloatingPointError: the world has become unstable.
        """
        bag = self.payload.bag
        if bag is None:
            self.loads.write()
            mujoco.mj_step(self.model, self.data)
        elif bag.step(self.machines[0].q, self.t_s):
            self._events.report(self.t_s, "bounced_out")
        if self.data.time <= self.t_s:  # MuJoCo begins again when an acceleration is no number
            raise FloatingPointError(
                f"the simulated world became unstable at {self.t_s:.3f} s: acceleration without bound"
            )
        self.t_s = t_s = self.data.time
        for machine in self.machines:
            machine.read()
            machine.watch_contact(t_s)
        self.payload.step(t_s, airborne)
        if (ball := self.payload.flying) is not None:
            for machine in self.machines:
                machine.watch_ball(t_s, *ball)
        if self.bar is not None:
            self.bar.step(t_s)
        for machine in self.machines:
            machine.watch_crash(t_s)

    def take_events(self) -> list[WorldEvent]:
        """Return and clear the events since the last call."""
        return self._events.take()
