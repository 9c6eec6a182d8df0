"""A simulated plant or a scene on its own, for tests of what it does and measures."""

from __future__ import annotations

from collections.abc import Sequence

from companion.config.vehicle import Vehicle
from companion.model.types import Joints, Vec2, Vec4
from companion.sitl_config.loader import SitlConfig
from companion.sitl_config.world import World as WorldConfig
from sitl.autopilot.types import ImuSample
from sitl.plant import Plant
from sitl.servo.drive import ServoDrive
from sitl.world.scene import Scene
from sitl.world.start import MachineSpec, Start, start_of
from sitl.world.state import PHYSICS_DT_S


class FixedRotors:
    """An autopilot that gives every rotor the same command all the time."""

    def __init__(self, commands: Vec4 = (0.0, 0.0, 0.0, 0.0)) -> None:
        self._commands = commands

    def step(self, imu: ImuSample) -> Vec4:
        return self._commands


class OneMachine(Scene):
    """A scene with one machine."""

    def __init__(
        self, vehicle: Vehicle, config: WorldConfig, position_m: Vec2, yaw_rad: float, arm_rad: Joints
    ) -> None:
        super().__init__([MachineSpec(vehicle, config, Start(position_m, yaw_rad, arm_rad))])
        self.machine = self.machines[0]

    def fly(self, rotors: Sequence[float], torques_nm: Joints, airborne: bool = True, *, drag: bool = True) -> None:
        """Advance by one step with these commands of the machine."""
        self.machine.command(rotors, torques_nm, drag=drag)
        self.step(airborne)


def run(world: OneMachine, time_s: float, *, drag: bool = True) -> None:
    """Let a world run with its rotors and motors off."""
    machine = world.machine
    for _ in range(round(time_s / PHYSICS_DT_S)):
        world.fly((0.0,) * machine.rotor_count, (0.0,) * len(machine.layout.joint_q), False, drag=drag)


def act(world: OneMachine) -> None:
    """Let the only effect of the machine act once, on the state as it is."""
    (effect,), machine = world.machine.effects, world.machine
    effect.apply(machine.rotor_thrust_n, machine.q, machine.v)
    world.loads.write()


def load(world: OneMachine, body: str) -> list[float]:
    """Return the force and torque that effects put on a body."""
    values: list[float] = world.data.xfrc_applied[world.model.body(body).id].tolist()
    return values


def plant_of(config: SitlConfig, commands: Vec4 = (0.0, 0.0, 0.0, 0.0), *, between_steps: bool = False) -> Plant:
    """Return the plant of this world at the start of its mission."""
    start = config.mission.start
    where = start_of(start.position_m, start.yaw_deg, start.arm_deg)
    drives = [ServoDrive() for _ in config.vehicle.arm.joints]
    return Plant(config.vehicle, config.world, FixedRotors(commands), drives, where, between_steps=between_steps)
