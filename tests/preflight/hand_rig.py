"""The hand test against the simulated machine and its hand, without wires."""

from __future__ import annotations

from collections.abc import Iterator

from companion.model.frames import (
    attitude_enu_flu_from_ned_frd,
    attitude_ned_frd_from_enu_flu,
    enu_from_ned,
    flu_from_frd,
    ned_from_enu,
)
from companion.model.types import MocapPose, VehicleState
from companion.preflight.hand_test.steps import HandSample
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.autopilot.autopilot import Px4Stub
from sitl.autopilot.cascade import Cascade, gains_from_params
from sitl.autopilot.estimator import Estimator
from sitl.autopilot.params import Params
from sitl.plant import Plant
from sitl.servo.drive import ServoDrive
from sitl.world.start import start_of
from tests.support import CATCH

TICK_S = 0.005


def world(*overrides: str) -> SitlConfig:
    """The catch mission's machine with its world set otherwise, nothing thrown, a hand that begins after 4 s."""
    words = ["world.payload_kg=0", "world.handling_t_s=4", *(f"world.{text}" for text in overrides)]
    return load_sitl(CATCH, overrides=words)


class Standing:
    """Machine, PX4 stub and motion capture; what the companion would hear of them every 5 ms."""

    def __init__(self, config: SitlConfig) -> None:
        self.config = config
        start = config.mission.start
        params = Params()
        self.px4 = Px4Stub(params, Estimator(), Cascade(gains_from_params(params)))
        pose = start_of(start.position_m, start.yaw_deg, start.arm_deg)
        drives = [ServoDrive() for _ in config.vehicle.arm.joints]
        self.plant = Plant(config.vehicle, config.world, self.px4, drives, pose)
        self._pose: MocapPose | None = None

    def samples(self, until_s: float) -> Iterator[HandSample]:
        """As `companion.preflight.hand_test.command` takes them."""
        tick = 0
        while self.plant.t_s < until_s:
            tick += 1
            while self.plant.t_s < tick * TICK_S - 1e-9:
                self.plant.step(False)
                for frame in self.plant.mocap.take():
                    t_s, p, q = self.plant.t_s, frame.position_world_m, frame.attitude_wxyz
                    self._pose = MocapPose(
                        stamp_s=t_s,
                        latency_s=t_s - frame.exposure_t_s,
                        frame_number=frame.number,
                        position_world_m=p,
                        attitude_wxyz=q,
                        tracking_valid=frame.valid,
                        marker_error_m=0.0002,
                    )
                    self.px4.on_vision(t_s, ned_from_enu(p), attitude_ned_frd_from_enu_flu(q))
            yield HandSample(self.plant.t_s, self._pose, self._vehicle(), False)

    def _vehicle(self) -> VehicleState | None:
        estimate, t_s = self.px4.estimate, self.plant.t_s
        if estimate is None:
            return None
        return VehicleState(
            position_stamp_s=t_s,
            attitude_stamp_s=t_s,
            imu_stamp_s=t_s,
            position_world_m=enu_from_ned(estimate.position_ned_m),
            velocity_world_m_s=enu_from_ned(estimate.velocity_ned_m_s),
            attitude_wxyz=attitude_enu_flu_from_ned_frd(estimate.attitude_ned_frd),
            angular_rate_body_rad_s=flu_from_frd(estimate.rates_frd_rad_s),
            specific_force_body_m_s2=flu_from_frd(estimate.accel_frd_m_s2),
        )
