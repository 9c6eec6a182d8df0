"""Sums and products of vectors and 3x3 matrices that are tuples of floats, in a fixed order of summation."""

from __future__ import annotations

from companion.model.types import Mat3, Vec3


def plus(a: Vec3, b: Vec3) -> Vec3:
    """Return a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def minus(a: Vec3, b: Vec3) -> Vec3:
    """Return a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def scaled(v: Vec3, k: float) -> Vec3:
    """Return the vector v multiplied by the number k."""
    return (k * v[0], k * v[1], k * v[2])


def dot(a: Vec3, b: Vec3) -> float:
    """Return a' b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vec3, b: Vec3) -> Vec3:
    """Return a x b."""
    ax, ay, az = a
    bx, by, bz = b
    return (ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


def across(v: Vec3, direction: Vec3) -> Vec3:
    """Return the part of a vector perpendicular to a direction, a unit vector."""
    along = dot(v, direction)
    (x, y, z), (nx, ny, nz) = v, direction
    return (x - along * nx, y - along * ny, z - along * nz)


def mat_vec(m: Mat3, v: Vec3) -> Vec3:
    """Return M v."""
    (a, b, c), (d, e, f), (g, h, i) = m
    x, y, z = v
    return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)


def vec_mat(v: Vec3, m: Mat3) -> Vec3:
    """Return v' M."""
    (a, b, c), (d, e, f), (g, h, i) = m
    x, y, z = v
    return (a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z)


def mat_mat(m: Mat3, n: Mat3) -> Mat3:
    """Return M N."""
    return (vec_mat(m[0], n), vec_mat(m[1], n), vec_mat(m[2], n))


def transpose(m: Mat3) -> Mat3:
    """Return M'."""
    (a, b, c), (d, e, f), (g, h, i) = m
    return ((a, d, g), (b, e, h), (c, f, i))
