"""Driver of an arm of Dynamixel servos."""

from __future__ import annotations

from companion.config.arm import Arm, Jaws
from companion.config.devices import ArmDevice, DynamixelOptions
from companion.io.arm.thread import OPEN_TIMEOUT_S, ThreadedArm
from companion.io.dynamixel.bus import ArmBus, Counts
from companion.io.dynamixel.registers import WATCHDOG_TRIPPED, Block
from companion.io.dynamixel.scale import JointScale
from companion.model.servos import WATCHDOG_ERROR
from companion.model.team import ClampCommand, ClampState
from companion.model.types import ArmState, Joints
from companion.runtime.clock import Clock


class DynamixelArm(ThreadedArm[tuple[Block, ...], Counts]):
    """The arm's Dynamixel servos in current mode behind the `Arm` protocol.

    A tripped bus watchdog is restarted and reported once as `WATCHDOG_ERROR` in `ArmState.hardware_error`; a servo with a hardware
    error of its own is not restarted.
    """

    options = DynamixelOptions
    writes_at_once = True

    def __init__(self, device: ArmDevice, arm: Arm, clock: Clock, jaws: Jaws | None = None) -> None:
        super().__init__(f"arm bus {device.port}", device.watchdog_ms, (0,) * len(arm.joints), clock)
        self._bus = ArmBus(device, arm, self._thread.stopping.is_set, jaws)
        self._clamp: ClampState | None = None
        self._scales: tuple[JointScale, ...] | None = None

    def clamp(self) -> ClampState | None:
        """Return the newest state of the clamp; None without one."""
        return self._clamp

    def command_clamp(self, command: ClampCommand | None) -> None:
        """Command the clamp: at once, or after the thread's next read if it is using the bus; never waits."""
        jaws = self._bus.jaws
        if jaws is None or command is None or command is jaws.command:
            return
        if self._bus_in_use.acquire(blocking=False):
            try:
                self._try(lambda: self._bus.command_jaws(command))
            finally:
                self._bus_in_use.release()
        else:
            jaws.command = command

    def _open_bus(self) -> None:
        self._scales = self._bus.open(OPEN_TIMEOUT_S)
        self._servos = self._bus.reports

    def _read_bus(self) -> tuple[Block, ...] | None:
        answer, jaws = self._bus.read(), self._bus.jaws
        if answer is not None and jaws is not None:
            if jaws.block is not None and (angle_rad := jaws.angle_rad) is not None:
                self._clamp = ClampState(self._clock(), angle_rad, jaws.block.hardware_error or None)
            self.problem = jaws.problem or self.problem
        return answer

    def _to_state(self, answer: tuple[Block, ...], asked_s: float) -> ArmState:
        assert self._scales is not None
        servos = list(zip(self._scales, answer, strict=True))
        return ArmState(
            stamp_s=self._clock(),
            angle_rad=tuple([scale.angle_rad(block.position_count) for scale, block in servos]),
            velocity_rad_s=tuple([scale.velocity_rad_s(block.velocity_count) for scale, block in servos]),
            torque_nm=tuple([scale.torque_nm(block.current_count) for scale, block in servos]),
            hardware_error=tuple([_errors(block) for block in answer]),
            temperature_c=tuple([float(block.temperature_c) for block in answer]),
            read_failures=0,
            written_s=self._written_s,
            asked_s=asked_s,
        )

    def _encode(self, torque_nm: Joints) -> tuple[Counts, Joints]:
        assert self._scales is not None, "the arm is not open"
        scales = self._scales
        counts = tuple([scale.current_counts(nm) for scale, nm in zip(scales, torque_nm, strict=True)])
        return counts, tuple([scale.torque_nm(count) for scale, count in zip(scales, counts, strict=True)])

    def _write_bus(self, goal: Counts) -> None:
        self._bus.write_currents(goal)

    def _restart_watchdogs(self) -> None:
        self._bus.restart_watchdogs()

    def _close_bus(self) -> None:
        self._bus.close()


def _errors(block: Block) -> int:
    to_restart = block.bus_watchdog == WATCHDOG_TRIPPED or block.is_unwatched
    return block.hardware_error | (WATCHDOG_ERROR if to_restart else 0)
