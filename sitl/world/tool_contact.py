"""Contact of a machine's tip with the surfaces, and the distance of its rotors from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from companion.config.vehicle import Vehicle
from companion.model.algebra import dot
from companion.model.types import Vec3
from sitl.world.loads import Bodies
from sitl.world.state import Events
from sitl.world.surfaces import FRICTION_RATIO, THICKNESS_M, Surfaces

_CREEP_NS_M = 1e4
"""Friction force that is not enough to slide, divided by the speed with which the tip creeps. A large value lifts a sliding tip."""
APART_S = 0.05
"""Shortest time without contact after which a contact is a new touch."""
PRESSED_S, SAME_S = 2.5, 0.5
_DAMPED_KG = 1.0
"""Mass to which `damping_ratio` refers."""
_WATCH_STEPS = 5
"""Physics steps between two measurements of the rotors' distance, and between two samples of the contact force."""
_RIM_POINTS = 36
_NO_MASS_KG = 1e-4
_ROUNDING_M = 1e-6


class ToolContact:
    """The contact of one machine with the surfaces; call `step` after each physics step.

    A contact is a spring and a damper whose force MuJoCo evaluates at the end of the step (implicit Euler), which is stable at any
    stiffness. With f = -K (r + dt v + dt^2 a) - C (v + dt a) and MuJoCo's f = (-b v - k d r - a) / R follow R = 1 / (K dt^2 + C dt),
    k d = K R and b = (C + K dt) R. MuJoCo computes R = A (1 - d) / d from the impedance d and the inverse weight A of the tip's body.

    Args:
        events: where touches and surfaces that give way are reported.
    """

    def __init__(self, surfaces: Surfaces, vehicle: Vehicle, bodies: Bodies, events: Events) -> None:
        self.surfaces = surfaces
        self._bodies, self._model, self._events = bodies, bodies.model, events
        self._inverse_kg = float(bodies.model.body_invweight0[bodies.body("tip"), 0])
        tip_n_m = None if vehicle.tool is None else vehicle.tool.stiffness_n_m
        for number, placed in enumerate(surfaces.placed):
            own = placed.config.stiffness_n_m
            both = own if tip_n_m is None else own * tip_n_m / (own + tip_n_m)
            pair = bodies.model.pair(f"{bodies.prefix}surface{number}").id
            self._set_contact(pair, both, placed.config.damping_ratio)
        layout = vehicle.airframe.rotor_layout
        angles = np.linspace(0.0, 2.0 * math.pi, _RIM_POINTS, endpoint=False)
        rim = vehicle.airframe.disk_radius_m * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
        self._disks_body_m = (np.array(layout.positions_body_m)[:, None, :] + rim[None]).reshape(-1, 3)
        self._reach_m = float(np.linalg.norm(self._disks_body_m, axis=1).max())
        self.touches = 0
        """Number of touches of any surface by the tip."""
        self.touched_s: float | None = None
        """World time of the first touch; None before it."""
        self.pressed_s: float | None = None
        """World time at which the first touch that lasted for `PRESSED_S` began; None before. Interruptions of up to `SAME_S` count."""
        self._run_begin_s = -math.inf
        self.force_max_n = 0.0
        self._forces_n: list[Vec3] = []
        self.rotor_distance_m = self.rotor_distance_min_m = math.inf
        """Smallest distance of a rotor's disk from a surface, now and so far; 0 or less if a rotor touches it. That of now is measured
        where it may be the smallest so far."""
        self._last_touch_s = -math.inf
        self._step = 0

    def _set_contact(self, pair: int, stiffness_n_m: float, damping_ratio: float) -> None:
        model, dt_s, inverse_kg = self._model, float(self._model.opt.timestep), self._inverse_kg
        damping_ns_m = 2.0 * damping_ratio * math.sqrt(stiffness_n_m * _DAMPED_KG)
        r = 1.0 / (stiffness_n_m * dt_s * dt_s + damping_ns_m * dt_s)
        d = inverse_kg / (inverse_kg + r)
        model.pair_solimp[pair] = (d, d, 1.0, 0.5, 1.0)
        model.pair_solref[pair] = (-stiffness_n_m * r * d, -(damping_ns_m + stiffness_n_m * dt_s) * r * d)
        model.pair_solreffriction[pair] = (-1.0, -min(_CREEP_NS_M * r / FRICTION_RATIO, 1.0 / dt_s) * d)

    def break_tool(self) -> None:
        """Remove the rod or brush: its mass, and its tip, which touches the surfaces."""
        model = self._model
        tip = model.geom(f"{self._bodies.prefix}tip").id
        model.geom_pos[tip] = (0.0, 0.0, -100.0)
        # Otherwise MuJoCo takes the body's place for the geom's.
        model.geom_sameframe[tip] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        rod = self._bodies.body("net")
        model.body_mass[rod] = _NO_MASS_KG
        model.body_inertia[rod] *= 0.0

    def step(self, t_s: float, q: list[float], tip_m: Vec3, force_n: Vec3) -> None:
        """Watch the contact and the rotors.

        Args:
            tip_m: position of the tip, world frame.
            force_n: force of a surface on the tip, world frame.
        """
        size_n = math.sqrt(dot(force_n, force_n))
        if size_n > 0.0:
            if t_s - self._last_touch_s > APART_S:
                self.touches += 1
                self.touched_s = t_s if self.touched_s is None else self.touched_s
                self._events.report(t_s, "touched")
            if t_s - self._last_touch_s > SAME_S:
                self._run_begin_s = t_s
            if self.pressed_s is None and t_s - self._run_begin_s > PRESSED_S:
                self.pressed_s = self._run_begin_s
            self._last_touch_s = t_s
            self.force_max_n = max(self.force_max_n, size_n)
            number = self.surfaces.touched(tip_m)
            surface = self.surfaces.placed[number]
            if 0.0 < surface.config.gives_way_n < dot(force_n, surface.normal):
                self.surfaces.give_way(number)
                self._events.report(t_s, "gave_way")
            if self._step % _WATCH_STEPS == 0:
                self._forces_n.append(force_n)
        if self._step % _WATCH_STEPS == 0 and self._may_be_nearest(q):
            self._measure_rotors(q)
        self._step += 1

    def _may_be_nearest(self, q: Sequence[float]) -> bool:
        """Return whether a rotor may be nearer to a surface than ever before: its plane is not that far from the whole vehicle."""
        least_m, at_m = max(self.rotor_distance_min_m, 0.0) + self._reach_m + _ROUNDING_M, (q[0], q[1], q[2])
        return any(
            placed.local_m(at_m)[2] < least_m
            for placed, gone in zip(self.surfaces.placed, self.surfaces.gone, strict=True)
            if not gone
        )

    def _measure_rotors(self, q: Sequence[float]) -> None:
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, np.array(q[3:7]))
        points = self._disks_body_m @ rotation.reshape(3, 3).T + np.array(q[0:3])
        nearest_m = math.inf
        for placed, gone in zip(self.surfaces.placed, self.surfaces.gone, strict=True):
            if gone:
                continue
            local = (points - np.array(placed.point_m)) @ np.array(placed.axes).T
            width_m, height_m = placed.config.size_m
            half = np.array([0.5 * width_m, 0.5 * height_m, 0.5 * THICKNESS_M])
            beyond = np.abs(local + np.array([0.0, 0.0, 0.5 * THICKNESS_M])) - half
            outside_m = np.sqrt((np.maximum(beyond, 0.0) ** 2).sum(axis=1))
            nearest_m = min(nearest_m, float((outside_m + np.minimum(beyond.max(axis=1), 0.0)).min()))
        self.rotor_distance_m = nearest_m
        self.rotor_distance_min_m = min(self.rotor_distance_min_m, nearest_m)

    def _force_held_n(self) -> list[float] | None:
        """Return the median of the contact forces of more than half the largest one: without touch and release."""
        held = [force_n for force_n in self._forces_n if 2.0 * math.hypot(*force_n) > self.force_max_n]
        return np.median(held, axis=0).tolist() if held else None

    def report(self) -> dict[str, Any]:
        """Return the truth about the contact and the surfaces for `summary.json`."""
        distance_m = self.rotor_distance_min_m
        return {
            "touches": self.touches,
            "force_max_n": self.force_max_n,
            "force_held_world_n": self._force_held_n(),
            "rotor_distance_min_m": distance_m if math.isfinite(distance_m) else None,
            "surfaces": self.surfaces.report(),
        }
