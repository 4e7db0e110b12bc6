"""The paper's acrobot and the other built-in machines with their experiments, and the parts of its model."""

from .em.loop import EMState, Schedule
from .model.friction import FrictionNetwork
from .model.simulate import Experiment, examples, paper_experiment, paper_model
from .model.state_space import StateSpaceModel

__all__ = ["EMState", "Experiment", "FrictionNetwork", "Schedule", "StateSpaceModel"]
__all__ += ["examples", "paper_experiment", "paper_model"]
