"""Contacts of friction with memory: their numbers in words, and the hysteresis loop, each with a standard deviation."""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure

from ..diagnosis.findings import Estimate, estimates, filled
from ..diagnosis.hypothesis import covariances
from ..diagnosis.residual import Names
from ..effects import flat
from ..fit.identify import Identified
from ..model.dynamic_friction import DynamicFriction, Hysteresis, hysteresis
from ..numerics.digits import with_std
from .style import AFTER, band, head, panels, styled, symbol

CONTACT_WORDS = {
    "coulomb": "Coulomb",
    "breakaway": "breakaway",
    "stribeck_velocity": "Stribeck velocity",
    "stiffness": "presliding stiffness",
    "distance": "presliding distance",
    "damping": "presliding damping",
}
"""Words for the numbers of a contact."""


class Contact(NamedTuple):
    """A joint whose friction has memory."""

    joint: int
    parameters: dict[str, Estimate]
    loop: Hysteresis
    """Slow cycle, as wide as the presliding distance on either side."""
    std: Float[np.ndarray, " row"]
    """Standard deviation of the loop's torque [N m]."""

    @property
    def text(self) -> str:
        """The numbers in words."""
        words = (f"{CONTACT_WORDS[name]} {with_std(e.value, e.std)} {e.unit}" for name, e in self.parameters.items())
        return f"joint {self.joint}, contact: {', '.join(words)}"

    def document(self) -> dict[str, Any]:
        """The contact as report.json has it."""
        loop = {"angle": self.loop.angle, "torque": self.loop.torque, "std": self.std}
        return {"joint": self.joint, "parameters": self.parameters, "text": self.text, "hysteresis": loop}


def contacts(fitted: Identified) -> list[Contact]:
    """Contacts of a fit; standard deviations by the delta method, friction integrated out."""
    model, out = fitted.model, []
    for effect, cov in zip(model.effects, covariances(model, fitted.m_step, fitted.state.hessian), strict=True):
        parameters = estimates(effect, cov, model.system)
        contact = cast(DynamicFriction, effect)
        torque, slopes = map(np.asarray, _loop(contact, parameters["distance"].value))
        std = np.sqrt(np.maximum(np.einsum("ri,ij,rj->r", slopes, cov, slopes), 0.0))
        loop = hysteresis(contact, parameters["distance"].value)
        out.append(Contact(contact.joint, parameters, loop._replace(torque=torque), std))
    return out


@eqx.filter_jit
def _loop(effect: DynamicFriction, amplitude: float) -> tuple[Float[Array, " row"], Float[Array, "row param"]]:
    """Torque along the loop, and how it moves with the numbers of the contact."""
    torque = lambda numbers: hysteresis(cast(DynamicFriction, filled(effect, numbers)), amplitude).torque  # noqa: E731
    return torque(flat(effect)), jax.jacfwd(torque)(flat(effect))


@styled
def hysteresis_figure(entries: Sequence[Contact], names: Names) -> Figure:
    """Torque over angle of every contact, with its 90 % band."""
    figure = Figure(figsize=(max(4.4, 4.0 * len(entries)), 3.7), layout="constrained")
    axes = panels(figure, len(entries), (1.0,))[0]
    for ax, contact in zip(axes, entries, strict=True):
        angle, torque = np.asarray(contact.loop.angle), np.asarray(contact.loop.torque)
        half = len(angle) // 2 + 1
        for part in (slice(0, half), slice(half - 1, None)):
            band(ax, angle[part], torque[part], contact.std[part], AFTER, "learned")
        place = names.coordinates[contact.joint - 1]
        ax.locator_params(axis="x", nbins=5)
        ax.set_xlabel(f"{symbol(place)} about a point [{names.unit(place)}]")
        ax.set_ylabel(f"friction [{names.force_unit(contact.joint)}]")
        ax.set_title(names.joint(contact.joint).replace("j", "J", 1))
    head(figure, "Presliding", list(axes))
    return figure
