"""The companion's own types of mission phases: one module each, and a folder for those that touch a surface.

A module holds everything of its type: keys, plan, checks before take-off, behaviour in the air, and what it expects of the flight. The
interface is `companion.mission.phase.Phase`; the entry points in pyproject.toml name the classes. Nothing outside names a type.
"""
