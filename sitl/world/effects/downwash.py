"""Force of the rotors' wakes on the links of the arm, the net and the payload.

A wake develops and contracts according to momentum theory: z rotor radii below the disk, the velocity is the induced velocity in hover,
sqrt(T / (2 rho A)), times 1 + z / sqrt(1 + z^2), and the area shrinks by continuity. Turbulence blurs the wake's edge but conserves its
momentum; the momenta of all wakes add (Reichardt's hypothesis for free turbulence). The cross-section is approximated by a square
of the same area, whose blurred profile is a product of error functions. All dynamic pressures are proportional to thrust, and the
density of the air cancels. The flow turns aside above the floor. The component of the flow across a link's axis loads the link at its
middle (cross-flow principle, Hoerner 1965); the whole flow loads net and payload at their centres of mass.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from companion.config.arm_chain import chain_of, without_tool
from companion.config.vehicle import Vehicle
from companion.model.algebra import mat_vec, vec_mat
from companion.model.rotors import RotorLayout
from companion.model.types import Mat3, Vec3
from companion.sitl_config.world import World
from sitl.world.effects.rotors import Thrusts
from sitl.world.loads import EFFECT_PERIOD_S, Bodies
from sitl.world.ornstein_uhlenbeck import OrnsteinUhlenbeck
from sitl.world.views import mat3_of, vec3_of

_NOISE = 14
_ROOT_HALF: Final = math.sqrt(0.5)


class Wakes:
    """Time-averaged dynamic pressure below the rotors."""

    def __init__(self, layout: RotorLayout, radius_m: float, spread: float) -> None:
        self._radius_m, self._spread = radius_m, spread
        self._across_m = list(dict.fromkeys(y for _, y, _ in layout.positions_body_m))
        rows: dict[float, list[tuple[int, int]]] = {}
        for i, (x, y, _) in enumerate(layout.positions_body_m):
            rows.setdefault(x, []).append((i, self._across_m.index(y)))
        self._rows: list[tuple[float, list[tuple[int, int]]]] = list(rows.items())
        """Position along x and, of each rotor there, its index and that of its position along y."""

    def pressure_pa(self, thrust_n: Thrusts, point_m: Vec3, blur_m: float = 0.0) -> float:
        """Return the mean dynamic pressure at a point in Pa.

        Args:
            thrust_n: thrust of each rotor, in PX4's order.
            point_m: position relative to the point on the body's z axis at the height of the rotors, body FLU.
            blur_m: size of the area over which the pressure is averaged, as a standard deviation along x and y.
        """
        x, y, z = point_m
        if z >= 0.0:
            return 0.0
        radius_m, spread_m = self._radius_m, self._spread * z
        depth = -z / radius_m
        developed = 0.5 + 0.5 * depth / math.sqrt(1.0 + depth * depth)
        area_m2 = math.pi * radius_m * radius_m * 0.5 / developed
        half_m = 0.5 * math.sqrt(area_m2)
        per_m = _ROOT_HALF / math.sqrt(spread_m * spread_m + blur_m * blur_m)
        across = [_smeared(y - to, half_m, per_m) for to in self._across_m]
        inside_n = 0.0
        for to, row in self._rows:
            row_n = 0.0
            for rotor, at in row:
                row_n += thrust_n[rotor] * across[at]
            inside_n += _smeared(x - to, half_m, per_m) * row_n
        return 0.5 * developed * inside_n / area_m2


def _smeared(x_m: float, half_m: float, per_m: float) -> float:
    """Return the value (0 to 1) at `x_m` of the profile of a strip from -`half_m` to `half_m` with blurred edges."""
    return 0.5 * (math.erf((x_m + half_m) * per_m) - math.erf((x_m - half_m) * per_m))


def _links_of(vehicle: Vehicle) -> list[tuple[int, Vec3, float]]:
    """Return number, direction (from joint to end, own frame) and length, m, of each link of more than zero length."""
    chain, found = chain_of(without_tool(vehicle)), []
    for number in range(1, len(chain.links) + 1):
        x, y, z = chain.links[number].position_m if number < len(chain.links) else chain.tip_m
        length_m = math.hypot(x, y, z)
        if length_m > 0.0:
            found.append((number, (x / length_m, y / length_m, z / length_m), length_m))
    return found


class Downwash:
    """The forces of the rotors' wakes.

    Args:
        bodies: the model of the scene; the wakes load the arm and the net of the machine, and the payload.
    """

    def __init__(self, world: World, vehicle: Vehicle, bodies: Bodies) -> None:
        model, data, self._loads, prefix = bodies
        config, rotor_radius_m, payload_radius_m = world.downwash, world.rotors.radius_m, world.payload_radius_m
        self._cause = f"{prefix}downwash"
        self._config, self._seed, self._intensity = config, world.seed, config.turbulence_intensity
        layout = vehicle.airframe.rotor_layout
        self._wakes, self._height_m = Wakes(layout, rotor_radius_m, config.spread), layout.height_m
        self._radius_m = rotor_radius_m
        base = bodies.body("base")
        self._base_position, self._base_axes = data.xpos[base], data.xmat[base]
        area = config.link_drag_coefficient * config.link_width_m
        links = _links_of(vehicle)
        indices = [bodies.body(f"link{number}") for number, _, _ in links]
        self._links = tuple(
            (body, data.xpos[body], data.xmat[body], data.xipos[body], direction, 0.5 * length_m, area * length_m)
            for body, (_, direction, length_m) in zip(indices, links, strict=True)
        )
        names = {model.body(k).name: k for k in range(model.nbody)}
        payload_m2 = config.payload_drag_coefficient * math.pi * payload_radius_m**2
        compact = [(f"{prefix}net", config.net_drag_area_m2, vehicle.tip_radius_m)] if vehicle.has_net else []
        compact.append(("payload", payload_m2, payload_radius_m))
        self._compact = tuple(
            (names[name], data.xipos[names[name]], area_m2, radius_m / 2.0)
            for name, area_m2, radius_m in compact
            if name in names
        )
        self.restart_noise()

    def restart_noise(self) -> None:
        """Restart the noise sequence."""
        self._turbulence = OrnsteinUhlenbeck(
            len(self._links) + 1, self._config.correlation_time_s, EFFECT_PERIOD_S, self._seed, _NOISE
        )

    def apply(self, thrust_n: Thrusts, q: Sequence[float], v: Sequence[float]) -> None:
        """Set the wakes' forces on links, net and payload."""
        gusts = self._turbulence.step()
        origin = vec3_of(self._base_position)
        axes = mat3_of(self._base_axes)
        (_, _, zx), (_, _, zy), (_, _, zz) = axes
        intensity = self._intensity
        *link_flows, flow = [(-zx + intensity * x, -zy + intensity * y, -zz + intensity * z) for x, y, z in gusts]
        for (body, joint, matrix, centre, direction, half_m, area_m2), (ux, uy, uz) in zip(
            self._links, link_flows, strict=True
        ):
            ex, ey, ez = mat_vec(mat3_of(matrix), direction)
            x, y, z = vec3_of(joint)
            cx, cy, cz = vec3_of(centre)
            x, y, z = x + half_m * ex, y + half_m * ey, z + half_m * ez
            along = ux * ex + uy * ey + uz * ez
            nx, ny, nz = ux - along * ex, uy - along * ey, uz - along * ez
            k = (
                area_m2
                * self._pressure_pa(thrust_n, origin, axes, (x, y, z), 0.0)
                * math.sqrt(nx * nx + ny * ny + nz * nz)
            )
            fx, fy, fz = k * nx, k * ny, k * nz
            rx, ry, rz = x - cx, y - cy, z - cz
            torque = (ry * fz - rz * fy, rz * fx - rx * fz, rx * fy - ry * fx)
            self._loads.set(body, self._cause, (fx, fy, fz), torque)
        ux, uy, uz = flow
        speed = math.sqrt(ux * ux + uy * uy + uz * uz)
        for body, centre, area_m2, blur_m in self._compact:
            x, y, z = vec3_of(centre)
            k = area_m2 * speed * self._pressure_pa(thrust_n, origin, axes, (x, y, z), blur_m)
            self._loads.set(body, self._cause, (k * ux, k * uy, k * uz))

    def _pressure_pa(self, thrust_n: Thrusts, origin: Vec3, axes: Mat3, point: Vec3, blur_m: float) -> float:
        """Return the mean dynamic pressure in Pa at a point in the world frame; it falls to zero over the last rotor radius above
        the floor.
        """
        px, py, pz = point
        x, y, z = px - origin[0], py - origin[1], pz - origin[2]
        bx, by, bz = vec_mat((x, y, z), axes)
        body = (bx, by, bz - self._height_m)
        near = min(1.0, max(0.0, pz / self._radius_m))
        return near * near * self._wakes.pressure_pa(thrust_n, body, blur_m)
