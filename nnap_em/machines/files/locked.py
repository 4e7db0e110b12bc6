"""A part of a machine file: joints that are held at a value, their bodies joined to those that carry them."""

from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from .spec import mujoco


class Part(NamedTuple):
    """The joints of a file that move, and the values at which others are held."""

    joints: tuple[str, ...] | None = None  # The joints that move; none given: all that are not held
    locked: Mapping[str, float] = MappingProxyType({})  # Values of joints that are held [rad or m]

    @property
    def whole(self) -> bool:
        """True where every joint of the file moves."""
        return self.joints is None and not self.locked

    def holds(self, joint: str) -> bool:
        """True for a joint that is held, at a value or where the file has it."""
        return joint in self.locked or (self.joints is not None and joint not in self.joints)


def holding(*joints: str) -> str:
    """The line of rig.toml that holds joints."""
    return f"[model] locked = {{ {', '.join(f'{joint} = 0.0' for joint in joints)} }}"


def hold(spec: Any, model: Any, part: Part, values: Mapping[str, float]) -> None:
    """Hold the joints of a spec that do not move, those of `values` there [rad or m], and join their bodies to others.

    A file with `fusestatic`, as URDF has it, has further bodies joined where no joint moves them.
    All equality constraints and tendons go: those of held joints alone are the only ones that a machine here may have.
    """
    held = {j for j in range(model.njnt) if part.holds(model.joint(j).name)}
    _pose(spec, model, held, values)
    bodies = list(spec.bodies)
    stood = {int(model.jnt_bodyid[j]) for j in held} - {int(model.jnt_bodyid[j]) for j in {*range(model.njnt)} - held}
    gone = {model.joint(j).name for j in held} | {tendon.name for tendon in spec.tendons}
    gone |= {actuator.name for actuator in spec.actuators if actuator.target in gone}
    read = mujoco().mjtObj.mjOBJ_JOINT, mujoco().mjtObj.mjOBJ_TENDON, mujoco().mjtObj.mjOBJ_ACTUATOR
    joined = {body.name for body in bodies if body.id in stood}
    for element in [
        *spec.equalities,
        *spec.tendons,
        *spec.keys,
        *(actuator for actuator in spec.actuators if actuator.target in gone),
        *(sensor for sensor in spec.sensors if sensor.objtype in read and sensor.objname in gone),
        *(pair for pair in spec.excludes if joined & {pair.bodyname1, pair.bodyname2}),
        *(list(spec.joints)[j] for j in held),
    ]:
        spec.delete(element)
    for body in bodies[1:]:
        body.fuse = spec.compiler.fusestatic or body.id in stood
    spec.fuse_static()


def _pose(spec: Any, model: Any, held: Collection[int], values: Mapping[str, float]) -> None:
    """Set bodies where held joints put them, and their other joints in the frames that they then have."""
    parser, data = mujoco(), mujoco().MjData(model)
    for name, value in values.items():
        data.joint(name).qpos[:] = value
    parser.mj_kinematics(model, data)
    places, turns = data.xpos.copy(), data.xmat.reshape(-1, 3, 3).copy()
    for i in {int(model.jnt_bodyid[j]) for j in held}:
        parent = int(model.body_parentid[i])
        model.body_pos[i] = turns[parent].T @ (places[i] - places[parent])
        parser.mju_mat2Quat(model.body_quat[i], (turns[parent].T @ turns[i]).ravel())
        for j in (j for j in range(model.njnt) if int(model.jnt_bodyid[j]) == i and j not in held):
            model.jnt_axis[j] = turns[i].T @ data.xaxis[j]
            model.jnt_pos[j] = turns[i].T @ (data.xanchor[j] - places[i])
    spec.copy_back(model)
