"""Readings of sensors at a site of a machine file: exact, without noise, delay or range.

[MuJoCo's documentation, "Sensors": gyro, accelerometer, framepos]
"""

from collections.abc import Sequence

from ..machine import Sensor
from .frames import Layout, Mount
from .recursion import Motion, Pose
from .spatial import Scalar, Three, add, apply, cross, product, transposed


def seen(sensor: Sensor, layout: Layout, poses: Sequence[Pose], moving: Sequence[Motion]) -> Scalar:
    """The reading of a component [rad/s, m/s^2 or m]; `moving` as `motions` gives them."""
    base = Mount(-1, (0.0, 0.0, 0.0), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    mount = layout.mounts[sensor.body] if sensor.body >= 0 else base
    place = add(mount.place, apply(mount.turn, sensor.place))
    if sensor.kind == "framepos":
        return _outward(layout, poses, mount.joint, place)[sensor.axis]
    spin, turns, rise = moving[mount.joint]
    value = spin
    if sensor.kind == "accelerometer":
        value = add(rise, add(cross(turns, place), cross(spin, cross(spin, place))))
    return apply(transposed(product(mount.turn, sensor.turn)), value)[sensor.axis]


def _outward(layout: Layout, poses: Sequence[Pose], joint: int, place: Three) -> Three:
    """A place in the frame of a joint as one in the world [m]."""
    while joint >= 0:
        place = add(poses[joint].place, apply(poses[joint].turn, place))
        joint = layout.frames[joint].before
    return place
