"""Reads an arm from a URDF file (wiki.ros.org/urdf/XML) in the form of a vehicle file's `arm.links`.

The arm is the chain of revolute and continuous joints from base to tip. Links that are fixed to each other become one. Visual and
collision elements, limits and transmissions are ignored: limits and servos are those of the vehicle file's `arm.joints`. Elements and
attributes that URDF does not define are refused, because a misspelled one would be replaced by its default.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

from companion.config.base import JOINTS_MAX
from companion.config.document import ConfigError, Data
from companion.config.explain import nearest
from companion.model.algebra import mat_mat, mat_vec, transpose
from companion.model.arm_chain import is_physical_inertia
from companion.model.frames import quat_from_euler_zyx, rotation_matrix
from companion.model.types import Mat3, Vec3

SIZE_MAX_BYTES = 1024 * 1024
LENGTH_MAX_M = 3.0
"""Largest plausible distance between joints and radius of gyration; a file in millimetres exceeds it."""
FRAME_MASS_MAX_KG = 1e-6
"""Largest mass, and inertia in kg m^2, of a link that only marks a frame; exporters write 0 or 1e-9."""
ANGLE_MAX_RAD = 2.0 * math.pi
MOVING = ("revolute", "continuous")
_WORDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "robot": (
        ("name", "version"),
        ("link", "joint", "material", "transmission", "gazebo", "ros2_control", "sensor", "mujoco"),
    ),
    "link": (("name", "type"), ("inertial", "visual", "collision", "contact", "self_collision_checking")),
    "inertial": ((), ("origin", "mass", "inertia")),
    "mass": (("value",), ()),
    "inertia": (("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), ()),
    "joint": (
        ("name", "type"),
        ("origin", "parent", "child", "axis", "mimic", "limit", "dynamics", "calibration", "safety_controller"),
    ),
    "origin": (("xyz", "rpy", "quat_xyzw"), ()),
    "parent": (("link",), ()),
    "child": (("link",), ()),
    "axis": (("xyz",), ()),
}
"""Attributes and children of the elements that are read. Children without an entry of their own are ignored with all they contain."""

_Pose = tuple[Mat3, Vec3]
"""Rotation matrix and position of a frame in another one."""
_HERE: _Pose = (((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 0.0))


@dataclass(frozen=True)
class _Element:
    tag: str
    attributes: dict[str, str]
    position: str
    """Line and column in the file."""
    children: list[_Element] = field(default_factory=list)

    def child(self, tag: str) -> _Element | None:
        return next((child for child in self.children if child.tag == tag), None)


@dataclass(frozen=True)
class _Joint:
    name: str
    kind: str
    parent: str
    child: str
    element: _Element

    def __str__(self) -> str:
        return f'joint "{self.name}"'


def read_urdf(path: Path, base: str | None, tip: str | None) -> dict[str, Data]:
    """Return `links`, `tip_m` and `tip_rpy_deg` of the arm in a URDF file, as plain data.

    Args:
        path: the file, which is named in messages as given.
        base: name of the link that is the vehicle's body; with None, the link that is no joint's child.
        tip: name of the link whose frame is the tip; with None, the link without children that is fixed to the last link.

    Raises:
        ConfigError: the file is not a URDF of a serial arm; the exception has one message, with file and line.
    """
    return _Robot(path).arm(base, tip)


class _Robot:
    """Links and joints of a URDF file."""

    def __init__(self, path: Path) -> None:
        self._shown = str(path)
        root = self._parse(self._text(path))
        if root.tag != "robot":
            self._fail(root, f"expected a <robot> element, got <{root.tag}>")
        self._root = root
        self._links: dict[str, _Element] = {}
        self._joints: dict[str, list[_Joint]] = {}
        self._check_words(root)
        for element in root.children:
            if element.tag == "link":
                name = self._attribute(element, "name")
                if name in self._links:
                    self._fail(element, f'link "{name}" is defined twice')
                self._links[name] = element
        parents: dict[str, _Joint] = {}
        for joint in map(self._joint, (element for element in root.children if element.tag == "joint")):
            if joint.child in parents:
                text = f'{joint} closes a loop: link "{joint.child}" is already the child of {parents[joint.child]}'
                self._fail(joint.element, text + "; expected a serial arm")
            parents[joint.child] = joint
            self._joints.setdefault(joint.parent, []).append(joint)
        self._roots = [name for name in self._links if name not in parents]

    def _check_words(self, element: _Element) -> None:
        """Refuse attributes and children of an element that URDF does not define; those with a namespace are extensions of others."""
        attributes, children = _WORDS[element.tag]
        for key in element.attributes:
            if key not in attributes and ":" not in key and key != "xmlns":
                known = nearest(key, list(attributes))
                hint = f"did you mean {known}?" if known else f"known: {', '.join(attributes) or 'none'}"
                self._fail(element, f"<{element.tag}>: unknown attribute {key}; {hint}")
        found = set[str]()
        for child in element.children:
            if child.tag not in children and ":" not in child.tag:
                known = nearest(child.tag, list(children))
                hint = f"did you mean <{known}>?" if known else f"known: {', '.join(children) or 'none'}"
                self._fail(child, f"<{element.tag}>: unknown element <{child.tag}>; {hint}")
            if child.tag in _WORDS:
                if child.tag in found and element.tag != "robot":
                    self._fail(child, f"<{element.tag}>: a second <{child.tag}>, expected one")
                self._check_words(child)
            found.add(child.tag)

    def arm(self, base: str | None, tip: str | None) -> dict[str, Data]:
        """See `read_urdf`."""
        for key, name in (("urdf_base", base), ("urdf_tip", tip)):
            if name is not None and name not in self._links:
                self._fail(self._root, f'{key}: there is no link "{name}"; the file has {", ".join(self._links)}')
        if base is None and len(self._roots) != 1:
            found = f"{len(self._roots)} ({', '.join(self._roots)})" if self._roots else "none (the joints form a loop)"
            self._fail(self._root, f"expected one link that is no joint's child, got {found}; urdf_base names the base")
        body = base if base is not None else self._roots[0]
        frames, moving = self._rigid(body, {body})
        seen = set(frames)
        links: list[Data] = []
        while moving:
            if len(moving) > 1:
                first, second = moving[:2]
                text = f'{second} starts a second branch beside {first}; expected a serial arm: make it "fixed"'
                self._fail(second.element, text)
            joint = moving[0]
            if len(links) == JOINTS_MAX:
                self._fail(joint.element, f"{joint} is moving joint {JOINTS_MAX + 1}; expected at most {JOINTS_MAX}")
            origin = _compose(frames[joint.parent], self._pose(joint.element))
            frames, moving = self._rigid(joint.child, seen)
            links.append(self._link(joint, origin, frames))
        if not links:
            self._fail(self._root, f'no revolute or continuous joint moves a link of the arm on "{body}"')
        last = next(iter(frames))
        if tip is None:
            leaves = [name for name in frames if name not in self._joints and name != last]
            if len(leaves) != 1:
                found = f"{len(leaves)} ({', '.join(leaves)})" if leaves else "none"
                self._fail(
                    self._links[last],
                    f'expected one link that is fixed to the last link "{last}" and marks the tip, got {found}; '
                    "add one, or name it as urdf_tip",
                )
            tip = leaves[0]
        elif tip not in frames:
            self._fail(self._links[tip], f'urdf_tip: link "{tip}" is not fixed to the last moving link, "{last}"')
        rotation, (x, y, z) = frames[tip]
        return {"links": links, "tip_m": [x, y, z], "tip_rpy_deg": list(_rpy_deg(rotation))}

    def _rigid(self, start: str, seen: set[str]) -> tuple[dict[str, _Pose], list[_Joint]]:
        """Return the frames, relative to `start`, of the links that are fixed to it, and the joints that move other links."""
        frames: dict[str, _Pose] = {start: _HERE}
        moving: list[_Joint] = []
        waiting = [start]
        while waiting:
            name = waiting.pop(0)
            for joint in self._joints.get(name, ()):
                if joint.child in seen:
                    self._fail(joint.element, f'{joint} closes a loop at link "{joint.child}"')
                seen.add(joint.child)
                if joint.element.child("mimic") is not None:
                    self._fail(joint.element, f"{joint}: <mimic> is not supported; expected a joint of its own")
                if joint.kind in MOVING:
                    moving.append(joint)
                elif joint.kind == "fixed":
                    frames[joint.child] = _compose(frames[name], self._pose(joint.element))
                    waiting.append(joint.child)
                else:
                    self._fail(joint.element, f'{joint}: expected revolute, continuous or fixed, got "{joint.kind}"')
        return frames, moving

    def _link(self, joint: _Joint, origin: _Pose, frames: dict[str, _Pose]) -> Data:
        """Return a joint and the links that it turns as one entry of `arm.links`."""
        axis_element = joint.element.child("axis")
        axis = (1.0, 0.0, 0.0) if axis_element is None else self._numbers3(axis_element, "xyz", (1.0, 0.0, 0.0))
        norm = math.hypot(*axis)
        if not norm > 1e-6:
            self._fail(axis_element or joint.element, f"{joint}: the axis is zero, expected a direction")
        parts = [part for name, frame in frames.items() if (part := self._inertial(name, frame)) is not None]
        link = self._links[joint.child]
        if not parts:
            self._fail(
                link,
                f'link "{joint.child}" moves but has no <inertial> with a mass; expected mass, centre of mass and inertia',
            )
        mass = sum(part[0] for part in parts)
        com = tuple(sum(part[0] * part[1][i] for part in parts) / mass for i in range(3))
        total = [0.0] * 6
        for part_kg, (x, y, z), ((xx, xy, xz), (_, yy, yz), (_, _, zz)) in parts:
            x, y, z = x - com[0], y - com[1], z - com[2]
            about = (
                xx + part_kg * (y * y + z * z),
                yy + part_kg * (x * x + z * z),
                zz + part_kg * (x * x + y * y),
                xy - part_kg * x * y,
                xz - part_kg * x * z,
                yz - part_kg * y * z,
            )
            total = [a + b for a, b in zip(total, about, strict=True)]
        rotation, position = origin
        return {
            "origin_m": list(position),
            "origin_rpy_deg": list(_rpy_deg(rotation)),
            "axis": [value / norm for value in axis],
            "mass_kg": mass,
            "com_m": list(com),
            "inertia_kg_m2": list(total),
        }

    def _inertial(self, name: str, frame: _Pose) -> tuple[float, Vec3, Mat3] | None:
        """Return mass, centre of mass and inertia about it of a link, in the axes of the frame to which `frame` refers; None if the
        link only marks a frame: it has no <inertial>, or one without mass.
        """
        inertial = self._links[name].child("inertial")
        if inertial is None:
            return None
        mass_element, inertia_element = inertial.child("mass"), inertial.child("inertia")
        if mass_element is None or inertia_element is None:
            self._fail(inertial, f'link "{name}": expected <mass> and <inertia> in <inertial>')
        (mass,) = self._numbers(mass_element, "value", 1)
        xx, yy, zz, xy, xz, yz = moments = [self._numbers(inertia_element, key, 1)[0] for key in _WORDS["inertia"][0]]
        if mass >= 0.0 and max(mass, *map(abs, moments)) <= FRAME_MASS_MAX_KG:
            return None
        if not mass > 0.0:
            self._fail(mass_element, f'link "{name}": expected a mass above 0 kg, got {mass:g} kg')
        inertia: Mat3 = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
        if not is_physical_inertia(inertia):
            text = f'link "{name}": expected the inertia of a rigid body (no principal moment above the sum of the other two)'
            self._fail(inertia_element, f"{text}, got ixx {xx:g}, iyy {yy:g}, izz {zz:g} kg m^2")
        gyration_m = math.sqrt((xx + yy + zz) / 2.0 / mass)
        if gyration_m > LENGTH_MAX_M:
            text = f'link "{name}": the inertia is that of {mass:g} kg at a distance of {gyration_m:g} m'
            self._fail(inertia_element, f"{text}; expected kg m^2 and kg (is the file in mm or g?)")
        rotation, com = _compose(frame, self._pose(inertial))
        return mass, com, mat_mat(rotation, mat_mat(inertia, transpose(rotation)))

    def _joint(self, element: _Element) -> _Joint:
        name, kind = self._attribute(element, "name"), self._attribute(element, "type")
        ends = []
        for tag in ("parent", "child"):
            end = element.child(tag)
            if end is None:
                self._fail(element, f'joint "{name}": missing <{tag}>')
            link = self._attribute(end, "link")
            if link not in self._links:
                self._fail(end, f'joint "{name}": there is no link "{link}"')
            ends.append(link)
        return _Joint(name, kind, ends[0], ends[1], element)

    def _pose(self, element: _Element) -> _Pose:
        """Return the pose in the element's <origin>; without one, the identity."""
        origin = element.child("origin")
        if origin is None:
            return _HERE
        position = self._numbers3(origin, "xyz", (0.0, 0.0, 0.0))
        distance_m = math.hypot(*position)
        if distance_m > LENGTH_MAX_M:
            text = f"the origin is {distance_m:g} m away; expected metres and at most {LENGTH_MAX_M:g} m"
            self._fail(origin, text + " (is the file in millimetres?)")
        roll, pitch, yaw = rpy = self._numbers3(origin, "rpy", (0.0, 0.0, 0.0))
        if max(map(abs, rpy)) > ANGLE_MAX_RAD:
            text = (
                f'<origin>: rpy: expected radians, at most 2 pi, got "{origin.attributes["rpy"]}" (is it in degrees?)'
            )
            self._fail(origin, text)
        if "quat_xyzw" not in origin.attributes:
            return rotation_matrix(quat_from_euler_zyx(roll, pitch, yaw)), position
        if "rpy" in origin.attributes:
            self._fail(origin, "<origin>: expected rpy or quat_xyzw, got both")
        x, y, z, w = self._numbers(origin, "quat_xyzw", 4)
        norm = math.hypot(x, y, z, w)
        if abs(norm - 1.0) > 0.01:
            self._fail(origin, f"<origin>: quat_xyzw: expected a quaternion of norm 1, got norm {norm:g}")
        return rotation_matrix((w / norm, x / norm, y / norm, z / norm)), position

    def _numbers3(self, element: _Element, key: str, default: Vec3) -> Vec3:
        if key not in element.attributes:
            return default
        x, y, z = self._numbers(element, key, 3)
        return (x, y, z)

    def _numbers(self, element: _Element, key: str, count: int) -> list[float]:
        text = self._attribute(element, key)
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        if len(values) != count or not all(map(math.isfinite, values)):
            expected = "a number" if count == 1 else f"{count} numbers"
            self._fail(element, f'<{element.tag}>: {key}: expected {expected}, got "{text[:60]}"')
        return values

    def _attribute(self, element: _Element, key: str) -> str:
        if key not in element.attributes:
            self._fail(element, f"<{element.tag}>: missing {key}")
        return element.attributes[key]

    def _text(self, path: Path) -> bytes:
        try:
            with path.open("rb") as file:
                text = file.read(SIZE_MAX_BYTES + 1)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            raise ConfigError(f"{self._shown}: not readable: {reason}") from None
        if len(text) > SIZE_MAX_BYTES:
            raise ConfigError(f"{self._shown}: larger than {SIZE_MAX_BYTES // 1024} KiB; expected a URDF file")
        return text

    def _parse(self, text: bytes) -> _Element:
        """Return the root element with the position of every element, which xml.etree does not keep."""
        parser = expat.ParserCreate()
        open_elements: list[_Element] = []
        roots: list[_Element] = []

        def position() -> str:
            return f"{parser.CurrentLineNumber}:{parser.CurrentColumnNumber + 1}"

        def begin(tag: str, attributes: dict[str, str]) -> None:
            if tag.startswith("xacro:"):
                self._fail(position(), f"<{tag}> is not expanded; expected plain URDF: xacro FILE > arm.urdf")
            element = _Element(tag, attributes, position())
            (open_elements[-1].children if open_elements else roots).append(element)
            open_elements.append(element)

        def doctype(*_: object) -> None:
            self._fail(position(), "expected no <!DOCTYPE>")

        parser.StartElementHandler = begin
        parser.EndElementHandler = lambda tag: open_elements.pop()
        parser.StartDoctypeDeclHandler = doctype
        try:
            parser.Parse(text, True)
        except expat.ExpatError as error:
            self._fail(f"{error.lineno}:{error.offset + 1}", f"not XML: {expat.errors.messages[error.code]}")
        except (ValueError, LookupError) as error:  # an unknown encoding
            self._fail("1:1", f"not XML: {error}")
        return roots[0]

    def _fail(self, at: _Element | str, text: str) -> NoReturn:
        """Refuse the file, given an element or line and column."""
        position = at if isinstance(at, str) else at.position
        raise ConfigError(f"{self._shown}:{position}: {text}")


def _compose(first: _Pose, second: _Pose) -> _Pose:
    """Return the pose of the second frame, given in the first, in the frame of the first pose."""
    rotation, (x, y, z) = first
    dx, dy, dz = mat_vec(rotation, second[1])
    return mat_mat(rotation, second[0]), (x + dx, y + dy, z + dz)


def _rpy_deg(rotation: Mat3) -> Iterator[float]:
    """Return roll, pitch and yaw, deg; at a pitch of 90 deg, the roll is 0."""
    (r00, r01, _), (r10, r11, _), (r20, r21, r22) = rotation
    across = math.hypot(r00, r10)
    if across > 1e-9:
        angles = (math.atan2(r21, r22), math.atan2(-r20, across), math.atan2(r10, r00))
    else:
        angles = (0.0, math.copysign(math.pi / 2, -r20), math.atan2(-r01, r11))
    return (math.degrees(angle) for angle in angles)
