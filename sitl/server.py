"""The simulated world behind its wires: a scene with one machine or more, with every device behind its real protocol.

In lockstep with a flight, the world owns the time and waits for the flight (`sitl.lockstep`). On its own it follows the wall clock: if
the process falls behind by more than `CATCH_UP_S`, the world pauses instead of catching up; `slipped_s` counts the lost time.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Callable, Sequence
from typing import Any

from companion.model.launcher_messages import WorldEvent, WorldSlipped
from companion.model.types import IDENTITY_QUAT
from companion.runtime.clock import monotonic
from sitl.lockstep import CATCH_UP_S, LockstepLoop, TimeKeeper
from sitl.mocap import MocapFrame
from sitl.natnet import OTHER_BODY, OTHER_PLACE_M, BodyPose, NatNetServer
from sitl.px4.hil_link import Px4Error
from sitl.record import BarCourse
from sitl.wires import MachineWires
from sitl.world.scene import Scene
from sitl.world.state import PHYSICS_DT_S

BEFORE_S = -3600.0
"""Simulated time when a world in lockstep starts; it jumps to zero when the flight begins."""
_LEAVE_S = 30.0
SLIP_REPORTED_S = 0.1
"""A world in real time reports its pauses each time that they have grown by this much."""


class Sitl:
    """SITL server: the scene, its motion capture, and the wires of each machine.

    The first machine's configuration is that of motion capture: its rate, its delays and its faults are those of the server.

    Args:
        keeper: simulated time, for a world in lockstep; None for a world in real time.
        make_scene: makes the scene of several machines; None for the scene that the only machine makes.
    """

    def __init__(
        self,
        machines: Sequence[MachineWires],
        keeper: TimeKeeper | None = None,
        make_scene: Callable[[], Scene] | None = None,
    ) -> None:
        self._keeper = keeper
        self.machines = tuple(machines)
        self._make_scene = make_scene
        scene = None if make_scene is None else make_scene()
        for number, machine in enumerate(machines):
            machine.make_plant(scene, number)
        self.bar: BarCourse | None = None if scene is None or scene.bar is None else BarCourse()
        """What the bar that the machines carry does; None without one."""
        self._sent_frame = False
        """Whether motion capture has sent a frame in this step."""
        self.mocap: NatNetServer | None = None
        """The simulated motion capture; None while the links are not open, and if another program feeds PX4 with poses."""
        first = self.machines[0]
        other, mocap = first.config.mocap_other_id, first.vehicle.devices.mocap
        self._others = () if other is None else ((other, OTHER_BODY),)
        self._ball = mocap.ball
        """How motion capture sees the ball; None if the mission does not follow it."""
        self._bar_body = () if mocap.bar_id is None else ((mocap.bar_id, "bar"),)
        """Id and name of the bar's rigid body; empty if it has none."""
        self.slipped_s = self._slip_reported_s = 0.0
        self._origin_s = 0.0
        """World time 0 on the event loop's clock."""
        self._next_frame: asyncio.TimerHandle | None = None
        """Timer that sends a frame between two steps."""
        self._leaving = False
        self._end_s = math.inf

    @property
    def _scene(self) -> Scene:
        return self.machines[0].plant.scene

    @property
    def _t_s(self) -> float:
        return self._scene.t_s

    @property
    def _lockstep(self) -> bool:
        """Whether a real PX4 flies."""
        return any(machine.autopilot.lockstep for machine in self.machines)

    @property
    def _armed(self) -> bool:
        return any(machine.autopilot.armed for machine in self.machines)

    def _start_over(self) -> None:
        """Put the world back to its beginning, whatever the preflight took; the companion's settings in the devices stay."""
        assert self._keeper is not None
        if self._armed or not all(machine.autopilot.start_over() for machine in self.machines):
            return
        scene = None if self._make_scene is None else self._make_scene()
        for number, machine in enumerate(self.machines):
            machine.start_over(scene, number)
        if self.mocap is not None:
            self.mocap.start_over()
        if self.bar is not None:
            self.bar = BarCourse()
        self._keeper.set(0.0)

    @contextlib.asynccontextmanager
    async def wires(self) -> AsyncIterator[tuple[dict[str, dict[str, Any]], ...]]:
        """Open every link and yield the addresses of each machine in the form of a vehicle file's `devices` settings."""
        async with contextlib.AsyncExitStack() as stack:
            if not self.machines[0].vehicle.devices.mocap.external:
                self.mocap = await stack.enter_async_context(self._natnet_server())
            yield tuple([await stack.enter_async_context(machine.wires(self.mocap)) for machine in self.machines])

    def _natnet_server(self) -> NatNetServer:
        first = self.machines[0]
        ports = first.ports
        return NatNetServer(
            version=first.config.natnet_version,
            command_port=ports.mocap_command,
            data_port=ports.mocap_data,
            multicast_group=first.vehicle.devices.mocap.multicast_group if ports.multicast else None,
            bodies=(
                *((each.vehicle.devices.mocap.rigid_body_id, each.vehicle.name) for each in self.machines),
                *self._others,
                *self._ball_body,
                *self._bar_body,
            ),
            clock=asyncio.get_running_loop().time if self._keeper is None else lambda: self._t_s,
            stamps=self._server_clock_s,
        )

    @property
    def _ball_body(self) -> tuple[tuple[int, str], ...]:
        """Id and name of the ball's rigid body; empty if it has none."""
        return () if self._ball is None or self._ball.id is None else ((self._ball.id, "ball"),)

    def _server_clock_s(self) -> float:
        """Return the clock of the motion-capture server, with which `_publish` stamps frames."""
        now_s = self._t_s if self._keeper is not None else monotonic() - self._origin_s
        return self.machines[0].faults.server_clock_s(now_s) + self._ahead_s

    @property
    def _ahead_s(self) -> float:
        return 0.0 if self._lockstep else self.slipped_s

    def stop(self) -> None:
        """End `run` at the next step."""
        self._end_s = -math.inf

    def leave(self) -> None:
        """End `run` as soon as every vehicle is disarmed, or after `_LEAVE_S` if one is still armed."""
        self._leaving = True
        self._end_s = min(self._end_s, self._t_s + _LEAVE_S)

    async def run(self, on_ready: Callable[[], None] = lambda: None) -> None:
        """Run the world until `stop` or `leave` ends it; call `on_ready` once every autopilot is ready to fly.

        Raises:
            Px4Error: a real PX4 cannot be started, has ended or hangs.
        """
        try:
            async with asyncio.TaskGroup() as group:
                preparing = group.create_task(self._prepare(on_ready))
                try:
                    await (self._follow_clock() if self._keeper is None else self._in_lockstep(self._keeper))
                finally:
                    if self._next_frame is not None:
                        self._next_frame.cancel()
                preparing.cancel()
        except* Px4Error as errors:
            raise errors.exceptions[0] from None

    async def _prepare(self, on_ready: Callable[[], None]) -> None:
        await asyncio.gather(*(machine.autopilot.prepare() for machine in self.machines))
        on_ready()

    @property
    def _ends(self) -> bool:
        return self._t_s >= self._end_s or (self._leaving and not self._armed)

    async def _answered(self) -> None:
        for machine in self.machines:
            if machine.autopilot.lockstep:
                await machine.autopilot.answered()

    async def _in_lockstep(self, keeper: TimeKeeper) -> None:
        """Step, let the flight do what it does at this instant, and so on."""
        loop = asyncio.get_running_loop()
        assert isinstance(loop, LockstepLoop)
        if self._lockstep:  # threads of a real PX4 send its telemetry on the computer's clock
            keeper.limit_to_real_time()
        before_s = 0.0 if self._lockstep else BEFORE_S
        keeper.set(before_s + self._t_s)
        for machine in self.machines:
            if machine.time is not None:
                machine.time.bus = machine.bus
        with keeper.listening():
            while not self._ends:
                await self._answered()
                self._sent_frame = False
                self._step()
                for machine in self.machines:
                    if machine.force is not None:
                        machine.force.await_arrival()
                await keeper.advance(before_s + self._t_s, self._sent_frame)
                for machine in self.machines:
                    machine.take_bus()
                await loop.handle_all()
                if keeper.begins():
                    scene = self._scene
                    self._start_over()
                    before_s = before_s if self._scene is scene else 0.0

    async def _follow_clock(self) -> None:
        origin_s = self._origin_s = monotonic() - self._t_s
        while not self._ends:
            behind_s = monotonic() - origin_s - self._t_s
            if behind_s > CATCH_UP_S:
                origin_s = self._origin_s = origin_s + behind_s - CATCH_UP_S
                self.slipped_s += behind_s - CATCH_UP_S
                slip_is_news = self.slipped_s >= self._slip_reported_s + SLIP_REPORTED_S
                if slip_is_news:
                    self._slip_reported_s = self.slipped_s
                for machine in self.machines:
                    if slip_is_news:
                        machine.on_message(WorldSlipped(self.slipped_s))
                    machine.autopilot.skip(behind_s - CATCH_UP_S)
                behind_s = CATCH_UP_S
            for _ in range(int(behind_s / PHYSICS_DT_S)):
                await self._answered()
                self._step()
            ahead_s = self._t_s + PHYSICS_DT_S - (monotonic() - origin_s)
            await asyncio.sleep(max(0.0, ahead_s))

    def _step(self) -> None:
        machines, scene = self.machines, self._scene
        number = 0 if self.mocap is None else self.mocap.frame_number
        for machine in machines:
            machine.before_step(number)
        airborne = scene.bar is None and machines[0].autopilot.armed
        for machine in machines:
            machine.plant.act(machine.autopilot.armed)
        scene.step(airborne)
        for machine in machines:
            machine.sense()
        if self.bar is not None:
            self.bar.watch(scene, number)
        self._send_frames()
        for machine in machines:
            machine.after_step()
        for event in scene.take_events():
            machines[0].on_message(WorldEvent(event.kind, event.t_s))
        for machine in machines:
            machine.report_rest()

    def _send_frames(self) -> None:
        plant = self.machines[0].plant
        ahead_s = PHYSICS_DT_S - 1e-6 if self._keeper is None else 0.0
        for leaves_s, frame in plant.mocap.take_until(plant.t_s + ahead_s):
            if leaves_s <= plant.t_s:
                self._publish(frame, plant.t_s)
            else:
                loop = asyncio.get_running_loop()
                self._next_frame = loop.call_at(self._origin_s + leaves_s, self._publish, frame, leaves_s)

    def _publish(self, frame: MocapFrame, t_s: float) -> None:
        """Send a frame of the first machine's, with the bodies of the others as the cameras saw them at the same time."""
        self._sent_frame = True
        first = self.machines[0]
        if first.vision is not None:
            first.vision.publish(frame, t_s)
            return
        if self.mocap is None:
            return
        poses = [BodyPose(number, OTHER_PLACE_M, IDENTITY_QUAT) for number, _ in self._others]
        poses += [
            BodyPose(number, (*frame.markers, (0.0, 0.0, 0.0))[0], IDENTITY_QUAT, bool(frame.markers))
            for number, _ in self._ball_body
        ]
        if frame.bar is not None:
            poses += [BodyPose(number, *frame.bar) for number, _ in self._bar_body]
        for machine in self.machines:
            seen = frame if machine is first else machine.plant.mocap.take_exposed_at(frame.exposure_t_s)
            body = machine.vehicle.devices.mocap.rigid_body_id
            if seen is not None:
                poses.append(BodyPose(body, seen.position_world_m, seen.attitude_wxyz, seen.valid))
        clock, ahead_s = first.faults.server_clock_s, self._ahead_s
        sent_s = t_s - frame.network_s
        single = {"markers": frame.markers} if self._ball is not None and not self._ball_body else {}
        self.mocap.publish(clock(sent_s) + ahead_s, poses, clock(frame.exposure_t_s) + ahead_s, **single)
