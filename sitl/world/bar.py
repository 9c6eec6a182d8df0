"""The bar between two machines: it stands on feet, and their clamps hold its handles like ball joints."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from companion.model.algebra import mat_vec, plus
from companion.model.frames import quat_rotate
from companion.model.types import Quat, Vec3
from companion.phases.carry.bar import Bar as PlannedBar
from companion.sitl_config.bar import Bar as TrueBar
from sitl.world.loads import Bodies
from sitl.world.machine import Machine
from sitl.world.state import Events
from sitl.world.views import mat3_of, vec3_of

BAR: Final = "bar"
_FEET_RADIUS_M: Final = 0.01
_FEET_ALONG: Final = 0.35
"""Place of the feet along the bar, from the middle, as a fraction of its length."""
_FEET_ASIDE_M: Final = 0.12
_RADIUS_M: Final = 0.015
_DROPPED_M_S: Final = 1.0
"""Speed of impact on the floor of a bar that is dropped; it is set down with less."""
_LIFTED_M: Final = 0.02
"""Height of the bar above its stand from which it is lifted."""
_POINTS: Final = 9
"""Number of points of the bar at which its distance from rotors is judged."""


class BarSpec(NamedTuple):
    """A bar as it stands at the start."""

    planned: PlannedBar
    true: TrueBar

    @property
    def length_m(self) -> float:
        """True distance of the handles."""
        return self.planned.length_m + self.true.length_error_m


def bar_mjcf(spec: BarSpec, prefixes: tuple[str, ...]) -> tuple[str, str, str]:
    """Return the body of the bar, the contacts of its feet with the floor, and the constraint of each machine's clamp."""
    planned, true, length_m = spec.planned, spec.true, spec.length_m
    (x, y), (dx, dy) = planned.position_m, true.place_error_m
    half_yaw = 0.5 * math.radians(planned.yaw_deg + true.yaw_error_deg)
    across = true.mass_kg * length_m**2 / 12.0
    places = [(i * _FEET_ALONG * length_m, j * _FEET_ASIDE_M) for i in (-1, 1) for j in (-1, 1)]
    feet = "".join(
        f'<geom name="{BAR} foot{n}" type="sphere" size="{_FEET_RADIUS_M}" pos="{px} {py} {_FEET_RADIUS_M - planned.handle_height_m}" '
        'mass="0" contype="0" conaffinity="0"/>'
        for n, (px, py) in enumerate(places)
    )
    body = f"""
    <body name="{BAR}" pos="{x + dx} {y + dy} {planned.handle_height_m}" quat="{math.cos(half_yaw)} 0 0 {math.sin(half_yaw)}">
      <freejoint name="{BAR}"/>
      <inertial pos="{true.centre_offset_m} 0 {-0.2 * planned.handle_height_m}" mass="{true.mass_kg}"
                diaginertia="{max(0.02 * true.mass_kg, 1e-4)} {across} {across}"/>
      {feet}
    </body>"""
    pairs = "".join(
        f'<pair geom1="floor" geom2="{BAR} foot{n}" friction="0.6 0.6 0.005 0.0001 0.0001"/>'
        for n in range(len(places))
    )
    grips = "".join(
        f'<connect name="{p}clamp" body1="{p}tip" body2="{BAR}" anchor="0 0 0" active="false" solref="0.03 1"/>'
        for p in prefixes
    )
    return body, pairs, grips


class Bar:
    """The bar of a scene; call `step` after each step of the scene.

    Args:
        bodies: the model, as each machine sees it; the first machine has the left end.
        events: where grips and a fall are reported.
    """

    def __init__(
        self, spec: BarSpec, bodies: tuple[Bodies, ...], machines: tuple[Machine, ...], events: Events
    ) -> None:
        model, data = bodies[0].model, bodies[0].data
        self._model, self._data, self._machines, self._events = model, data, machines, events
        self._true, self._strength_n = spec.true, spec.true.strength_n
        body = model.body(BAR).id
        self._at, self._axes, self._quat = data.xpos[body], data.xmat[body], data.xquat[body]
        self._velocity = data.qvel[int(model.jnt_dofadr[model.joint(BAR).id]) :][:3]
        half_m = 0.5 * spec.length_m
        self._handles: tuple[Vec3, Vec3] = ((half_m, 0.0, 0.0), (-half_m, 0.0, 0.0))
        self._tips = [data.xpos[each.body("tip")] for each in bodies]
        self._clamps = [model.equality(f"{each.prefix}clamp").id for each in bodies]
        self.gripped = [False, False]
        """Whether each machine's clamp holds its handle."""
        self.closed = [False, False]
        """Whether each machine's jaws are closed; set by the machine's plant."""
        self._were_closed = [False, False]
        self.let_go_m: float | None = None
        """Largest height above its stand from which an end of the bar has fallen or was let go; None before."""
        self.lifted_s: float | None = None
        """World time at which both clamps had lifted the bar off its feet; None before."""
        self._stands_m = spec.planned.handle_height_m
        self._was_falling_m_s = 0.0

    @property
    def pose(self) -> tuple[Vec3, Quat]:
        """Pose of the middle between the handles, world frame; x points to the left end."""
        w, x, y, z = self._quat.tolist()
        return vec3_of(self._at), (w, x, y, z)

    def streamed(self, noise_m: float, noise: Vec3) -> tuple[Vec3, Quat]:
        """Return the pose that motion capture streams, given the noise of a coordinate and three unit normal values."""
        (x, y, z), attitude = self.pose
        dx, dy, dz = quat_rotate(attitude, self._true.pivot_offset_m)
        nx, ny, nz = noise
        return (x + dx + noise_m * nx, y + dy + noise_m * ny, z + dz + noise_m * nz), attitude

    def step(self, t_s: float) -> None:
        """Let each clamp take hold of its handle or let it go, and watch the bar, at world time `t_s`."""
        for number, closed in enumerate(self.closed):
            if closed and not self._were_closed[number]:
                self._take(number, t_s)
            elif self.gripped[number] and (not closed or self._slips(number)):
                self._let_go(number, t_s)
            self._were_closed[number] = closed
        if self.lifted_s is None and all(self.gripped) and float(self._at[2]) > self._stands_m + _LIFTED_M:
            self.lifted_s = t_s
        speed_m_s = -float(self._velocity[2])
        if self._was_falling_m_s > _DROPPED_M_S and speed_m_s < 0.5 * self._was_falling_m_s:
            self._events.report(t_s, "bar_dropped")
            speed_m_s = 0.0
        self._was_falling_m_s = speed_m_s
        self._watch_rotors(t_s)

    def is_near(self, number: int) -> bool:
        """Return whether a machine's handle is between its jaws."""
        return math.dist(self._handle_world_m(number), vec3_of(self._tips[number])) <= self._true.capture_m

    def _handle_world_m(self, number: int) -> Vec3:
        return plus(vec3_of(self._at), mat_vec(mat3_of(self._axes), self._handles[number]))

    def _take(self, number: int, t_s: float) -> None:
        clamp, handle = self._clamps[number], self._handles[number]
        self._model.eq_data[clamp, 0:3] = 0.0
        self._model.eq_data[clamp, 3:6] = handle
        self._data.eq_active[clamp] = 1
        self.gripped[number] = True
        self._events.report(t_s, "bar_gripped")

    def _let_go(self, number: int, t_s: float) -> None:
        self._data.eq_active[self._clamps[number]] = 0
        self.gripped[number] = False
        self.let_go_m = max(self.let_go_m or 0.0, self._handle_world_m(number)[2] - self._stands_m)
        self._events.report(t_s, "bar_let_go")

    def _slips(self, number: int) -> bool:
        force = self.pull_n(number)
        return force > self._strength_n

    def pull_n(self, number: int) -> float:
        """Return the size of the force between a clamp and its handle."""
        return math.hypot(*self.force_world_n(number))

    def force_world_n(self, number: int) -> Vec3:
        """Return the force of a clamp on its handle, world frame; 0 while it holds none."""
        d, clamp = self._data, self._clamps[number]
        of = d.efc_id[: d.ne].tolist()  # the first rows are those of equality constraints
        if of.count(clamp) != 3:
            return (0.0, 0.0, 0.0)
        row = of.index(clamp)
        x, y, z = d.efc_force[row : row + 3].tolist()
        return (-x, -y, -z)

    def _watch_rotors(self, t_s: float) -> None:
        """A bar or a rotor in a turning rotor breaks it."""
        at, axes = vec3_of(self._at), mat3_of(self._axes)
        (hx, _, _), _ = self._handles
        for n in range(_POINTS):
            along = hx * (2.0 * n / (_POINTS - 1) - 1.0)
            x, y, z = mat_vec(axes, (along, 0.0, 0.0))
            for machine in self._machines:
                machine.watch_ball(t_s, (at[0] + x, at[1] + y, at[2] + z), _RADIUS_M)
        left, right = self._machines
        left.watch_rotors_of(t_s, right)
