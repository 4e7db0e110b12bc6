"""Vectors and rotations of three as tuples of scalars; what is known to be 0 or 1 costs nothing.

A number of the file is a Python float, all else a JAX scalar.  Nothing is stacked: inside one compiled loop an array of
scalars is built anew for every entry that is read.  Scalars have no types to check, and to trace a machine calls their
functions a hundred thousand times.
"""

from typing import Any, no_type_check

Scalar = Any
"""A float, or a JAX scalar."""
Three = tuple[Scalar, Scalar, Scalar]
Turn = tuple[Three, Three, Three]
"""Rows."""
ZERO: Three = (0.0, 0.0, 0.0)


@no_type_check
def times(a: Scalar, b: Scalar) -> Scalar:
    """a b."""
    simple = (0.0, 1.0, -1.0)  # factors that are known before anything runs, and cost nothing
    for one, other in ((a, b), (b, a)):
        if isinstance(one, float) and one in simple:
            return 0.0 if one == 0 else other if one > 0 else -other
    return a * b


@no_type_check
def plus(a: Scalar, b: Scalar) -> Scalar:
    """a + b."""
    if isinstance(a, float) and a == 0:
        return b
    return a if isinstance(b, float) and b == 0 else a + b


@no_type_check
def minus(a: Scalar, b: Scalar) -> Scalar:
    """a - b."""
    if isinstance(b, float) and b == 0:
        return a
    return times(-1.0, b) if isinstance(a, float) and a == 0 else a - b


def add(a: Three, b: Three) -> Three:
    """a + b."""
    return plus(a[0], b[0]), plus(a[1], b[1]), plus(a[2], b[2])


def subtract(a: Three, b: Three) -> Three:
    """a - b."""
    return minus(a[0], b[0]), minus(a[1], b[1]), minus(a[2], b[2])


def scaled(s: Scalar, a: Three) -> Three:
    """s a."""
    return times(s, a[0]), times(s, a[1]), times(s, a[2])


def dot(a: Three, b: Three) -> Scalar:
    """a . b"""
    return plus(plus(times(a[0], b[0]), times(a[1], b[1])), times(a[2], b[2]))


def cross(a: Three, b: Three) -> Three:
    """a x b."""
    return (
        minus(times(a[1], b[2]), times(a[2], b[1])),
        minus(times(a[2], b[0]), times(a[0], b[2])),
        minus(times(a[0], b[1]), times(a[1], b[0])),
    )


def apply(turn: Turn, a: Three) -> Three:
    """Matrix times vector."""
    return dot(turn[0], a), dot(turn[1], a), dot(turn[2], a)


def transposed(turn: Turn) -> Turn:
    """Matrix transposed; of a rotation its inverse."""
    x, y, z = zip(*turn, strict=True)
    return x, y, z


def product(a: Turn, b: Turn) -> Turn:
    """Matrix times matrix."""
    columns = transposed(b)
    x, y, z = ((dot(row, columns[0]), dot(row, columns[1]), dot(row, columns[2])) for row in a)
    return x, y, z


def sandwich(turn: Turn, inner: Turn) -> Turn:
    """R S R' of a symmetric S, each entry once."""
    half = product(turn, inner)
    xx, xy, xz = dot(half[0], turn[0]), dot(half[0], turn[1]), dot(half[0], turn[2])
    yy, yz, zz = dot(half[1], turn[1]), dot(half[1], turn[2]), dot(half[2], turn[2])
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def summed(a: Turn, b: Turn) -> Turn:
    """Sum of two symmetric matrices, each entry once."""
    xx, xy, xz = add(a[0], b[0])
    yy, yz, zz = plus(a[1][1], b[1][1]), plus(a[1][2], b[1][2]), plus(a[2][2], b[2][2])
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


def about(h: Three, r: Three) -> Turn:
    """2 (r . h) 1 - r h' - h r': what a first moment of mass h adds to an inertia that is moved by r."""
    x, y, z = times(r[0], h[0]), times(r[1], h[1]), times(r[2], h[2])
    xy = times(-1.0, plus(times(r[0], h[1]), times(r[1], h[0])))
    xz = times(-1.0, plus(times(r[0], h[2]), times(r[2], h[0])))
    yz = times(-1.0, plus(times(r[1], h[2]), times(r[2], h[1])))
    return (times(2.0, plus(y, z)), xy, xz), (xy, times(2.0, plus(x, z)), yz), (xz, yz, times(2.0, plus(x, y)))
