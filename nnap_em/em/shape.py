"""Prior knowledge of friction: its shape, not its size."""

import numpy as np

from ..model.state_space import StateSpaceModel
from .weights import Weights


def friction_prior(model: StateSpaceModel, weights: Weights) -> tuple[np.ndarray, np.ndarray]:
    """Precision and pull of phi: the total map free in the span of known laws, the rest small, parameters as declared.

    A prior on its size would bind strong Coulomb friction; one on its change would leave half an effect inside the map.
    """
    nodes, size = np.asarray(weights.nodes), weights.nodes.size + weights.prior.size
    value = np.asarray(weights.phi(model.unknown, weights.read(model)))
    if weights.known is not None:
        precision, goal = weights.prior_precision(model.unknown), weights.known.terms(size)[1]
        return np.asarray(precision), np.asarray(precision @ value - goal)
    precision, pull = np.zeros((size, size)), np.zeros(size)
    count = nodes.shape[1]
    # Rms of a friction map beside the span of known laws, over that of the map; 0.03 to 0.3 gave the same answers
    rest = 0.1
    # Knees of the Coulomb and Stribeck laws that friction is free in, over the largest speed
    knees = (0.003, 0.01, 0.03, 0.1, 0.3)
    for j, v in enumerate(nodes):
        joint = slice(j * count, (j + 1) * count)
        top = np.abs(v).max()
        laws = np.stack([v / top, *(np.tanh(v / (r * top)) for r in knees)], axis=1)
        others = np.linalg.svd(laws)[0][:, laws.shape[1] :]  # what no sum of known laws can be
        beside = others @ others.T / (rest * np.sqrt(np.mean(value[joint] ** 2)) + 1e-12) ** 2
        precision[joint, joint] = beside + (1e-9 * np.trace(beside) / count + 1e-12) * np.eye(count)
        pull[joint] = beside @ value[joint]
    parameters = slice(nodes.size, size)
    precision[parameters, parameters] = np.eye(weights.prior.size)
    pull[parameters] = value[parameters]
    return precision, pull
