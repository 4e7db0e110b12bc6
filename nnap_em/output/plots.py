"""Figures of a fit for a notebook; `figure.axes` are there to be changed.

Reports of the commands have more of them, in `nnap_em.output.report`.
"""

import jax
from jaxtyping import PRNGKeyArray
from matplotlib.figure import Figure

from ..estimate.identify import Identified, friction_table
from ..estimate.predict import predict
from ..explain.diagnosis.residual import names_of
from ..explain.diagnosis.residual import residual as residual_of
from ..logs.dataset import Dataset
from .report.fit_plots import friction_figure, prediction_figure
from .report.residual_plots import residual_figure

__all__ = ["friction", "prediction", "residual"]


def friction(fitted: Identified) -> Figure:
    """Draw the friction of every joint over the velocities of the logs, with its band.

    Args:
        fitted: the model, of a machine with joints.

    Returns:
        The figure, a panel for each joint.

    Example:
        >>> from nnap_em.output import plots
        >>> len(plots.friction(fit).axes)
        1
    """
    table = friction_table(fitted, fitted.m_step.weights(fitted.model).nodes)
    return friction_figure({"learned": table}, names_of(fitted))


def prediction(fitted: Identified, data: Dataset, given: float, *, key: PRNGKeyArray, sequence: int = 0) -> Figure:
    """Draw a sequence predicted from its first readings.

    Args:
        fitted: the model.
        data: sequences.
        given: time from the first row on whose readings are used [s].
        key: random key of the sample paths.
        sequence: the one to be drawn, counted from 0.

    Returns:
        The figure, a panel for each state: its mean, its band of two standard deviations and its readings.

    Example:
        >>> from nnap_em.output import plots
        >>> len(plots.prediction(fit, test, 0.5, key=key).axes)
        2
    """
    one = jax.tree.map(lambda a: a[sequence : sequence + 1], data)
    return prediction_figure({"fit": predict(fitted, one, given, key=key)}, one, names_of(fitted), given)


def residual(fitted: Identified, data: Dataset) -> Figure:
    """Draw the force that the model lacks on logs against everything that may cause it.

    Args:
        fitted: the model, of a machine with joints.
        data: sequences.

    Returns:
        The figure, a row of panels for each joint, headed by the share of variance that its cause accounts for.

    Example:
        >>> from nnap_em.output import plots
        >>> len(plots.residual(fit, test).axes) > 1
        True
    """
    return residual_figure(residual_of(fitted, data), names_of(fitted))


def __dir__() -> list[str]:
    return __all__
