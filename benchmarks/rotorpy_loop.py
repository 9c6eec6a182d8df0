"""RotorPy (PyPI `rotorpy`) flying its own multirotor with its own SE3 controller: CPU time per simulated second.

Run by `fast_loop.py`, which need not be in the same environment (`--rotorpy-python`). Prints one line of JSON; exit 3: not installed.
"""

from __future__ import annotations

import json
import sys
import time
from importlib import import_module
from importlib.metadata import version
from statistics import median
from typing import Any

RATE_HZ = 200.0
FLIGHT_S = 5.0
REPEATS = 3


def main() -> int:
    """Measure and print."""
    try:
        np = import_module("numpy")
        circle = import_module("rotorpy.trajectories.circular_traj")
        control = import_module("rotorpy.controllers.quadrotor_control")
        crazyflie = import_module("rotorpy.vehicles.crazyflie_params")
        environments = import_module("rotorpy.environments")
        multirotor = import_module("rotorpy.vehicles.multirotor")
    except ImportError as error:
        print(error, file=sys.stderr)
        return 3

    def parts() -> tuple[Any, Any, Any]:
        trajectory = circle.ThreeDCircularTraj(radius=np.array([1.0, 1.0, 0.0]))
        vehicle = multirotor.Multirotor(crazyflie.quad_params)
        # Starts on its way: what is measured is flying, not a recovery.
        vehicle.initial_state["x"] = np.array([1.0, 0.0, 0.0])
        return vehicle, control.SE3Control(crazyflie.quad_params), trajectory

    def bare() -> float:
        """Trajectory, controller, dynamics; no sensors."""
        vehicle, controller, trajectory = parts()
        state = {key: np.array(value) for key, value in vehicle.initial_state.items()}
        start = time.process_time()
        for step in range(round(FLIGHT_S * RATE_HZ)):
            t_s = step / RATE_HZ
            wanted = controller.update(t_s, state, trajectory.update(t_s))
            state = vehicle.step(state, wanted, 1.0 / RATE_HZ)
        return (time.process_time() - start) / FLIGHT_S

    def whole() -> float:
        """`Environment.run`: with IMU, motion capture and the recording of everything."""
        vehicle, controller, trajectory = parts()
        environment = environments.Environment(vehicle, controller, trajectory, sim_rate=RATE_HZ)
        start = time.process_time()
        result = environment.run(t_final=FLIGHT_S, terminate=False)
        used_s = time.process_time() - start
        flown_s = float(result["time"][-1])
        if flown_s < 0.9 * FLIGHT_S:
            raise RuntimeError(f"rotorpy's flight ended after {flown_s:.2f} s: {result['exit']}")
        return used_s / flown_s

    medians = {f"{part.__name__}_s": median(part() for _ in range(REPEATS)) for part in (bare, whole)}
    figures = {"version": version("rotorpy"), "rate_hz": RATE_HZ, **medians}
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
