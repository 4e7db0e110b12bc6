"""Laws that MuJoCo has no element for, as a control callback: the part that is the same for every machine."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np


class Laws(NamedTuple):
    """The laws of one machine, in SI units."""

    coordinates: tuple[str, ...]
    """Names of the joints, in the order of q, v and torque."""
    motors: tuple[str, ...]
    """Names of the actuators, in the order of the command."""
    driven: tuple[int, ...]
    """Place of the joint of each motor among the coordinates."""
    units: tuple[float, ...]
    """Command of the fit for a unit of each motor's control."""
    measured: tuple[str, ...]
    """Names of the readings."""
    command: Callable[..., Any]
    """The command that reaches each motor."""
    torque: Callable[..., Any]
    """Generalised force that the laws add at q, v, the torque of the motors and the time."""
    reading: Callable[..., Any]
    """The readings that sensors show of true values."""


class Actuator:
    """The laws on one MuJoCo model: install it by `mujoco.set_mjcb_control`, and write controls to `command`.

    It sets `data.ctrl` of the motors and `data.qfrc_applied` of the joints before every step.
    """

    def __init__(self, model: Any, laws: Laws, clock: float = 0.0) -> None:
        joints = [model.joint(name) for name in laws.coordinates]
        self.laws, self.clock = laws, clock
        """`clock`: time on the clock of the fit at which the simulation begins [s]."""
        self.position = np.array([int(np.ravel(joint.qposadr)[0]) for joint in joints], int)
        self.rate = np.array([int(np.ravel(joint.dofadr)[0]) for joint in joints], int)
        self.motors = np.array([model.actuator(name).id for name in laws.motors], int)
        self.controls = np.array([int(model.actuator_ctrladr[i]) for i in self.motors], int)
        self.units = np.array(laws.units, float)
        self.command = np.zeros(len(laws.motors))
        """Controls of the motors, in the order of the file."""

    def __call__(self, model: Any, data: Any) -> None:
        """Set the controls and the torques of one step."""
        reaches = np.stack([np.asarray(x, float) for x in (*self.laws.command(tuple(self.command * self.units)), 0.0)])
        data.ctrl[self.controls] = reaches[:-1] / self.units
        q, v = data.qpos[self.position], data.qvel[self.rate]
        data.qfrc_applied[self.rate] = self.torque(q, v, self.drive(model, data), data.time + self.clock)

    def torque(self, q: np.ndarray, v: np.ndarray, drive: np.ndarray, time: float) -> np.ndarray:
        """Generalised force of the laws at every joint [N m, or N on a slide]."""
        return np.array([float(x) for x in self.laws.torque(tuple(q), tuple(v), tuple(drive), (time,))])

    def reading(self, true: np.ndarray) -> np.ndarray:
        """Readings of the sensors `measured` for their true values."""
        return np.array([float(x) for x in self.laws.reading(tuple(true))])

    def drive(self, model: Any, data: Any) -> np.ndarray:
        """Torque of the motors at every joint; that of the step before for a motor with a state or a delay."""
        out = np.zeros(len(self.laws.coordinates))
        for i, place in zip(self.motors, self.laws.driven, strict=True):
            at = model.actuator_ctrladr[i]
            force = data.actuator_force[model.actuator_outadr[i]]
            if not model.actuator_actnum[i] and not model.actuator_delay[i]:
                low, high = model.actuator_ctrlrange[at] if model.actuator_ctrllimited[at] else (-np.inf, np.inf)
                force = model.actuator_gainprm[i, 0] * np.clip(data.ctrl[at], low, high)
            out[place] += model.actuator_gear[i, 0] * force
        return out
