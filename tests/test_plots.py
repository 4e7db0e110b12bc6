"""Figures of machines with 1 and 3 joints: everything is drawn, with its unit, in a size that can be read."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import right_residual

from nnap_em.estimate.identify import FrictionTable
from nnap_em.estimate.predict import Prediction
from nnap_em.explain.diagnosis.residual import Names, Residual
from nnap_em.logs.dataset import Dataset
from nnap_em.model.effects.base import Curve
from nnap_em.output.report.fit_plots import effect_figure, error_figure, friction_figure, prediction_figure
from nnap_em.output.report.html import picture
from nnap_em.output.report.residual_plots import innovation_figure, residual_figure

SEQUENCES, ROWS = 8, 200


def _names(dof: int) -> Names:
    """A machine whose last joint slides; all positions and rates are read."""
    angles = (*(True,) * (dof - 1), False)
    coordinates = tuple(f"theta{j + 1}" if angle else f"x{j + 1}" for j, angle in enumerate(angles))
    rates = tuple(f"d{name}" for name in coordinates)
    return Names(coordinates, rates, angles, ("u",), (dof,), coordinates + rates)


def _residual(dof: int, seed: int = 0, **changes) -> Residual:
    return right_residual(seed, (SEQUENCES, ROWS), dof, 2 * dof, **changes)


@pytest.mark.parametrize("dof", (1, 3))
def test_every_figure_can_be_read_and_its_axes_have_the_units_of_the_machine(dof):
    names, residual, v = _names(dof), _residual(dof), jnp.tile(jnp.linspace(-3, 3, 51)[None], (dof, 1))
    table = FrictionTable(v, -v, jnp.tile(1e-4 * jnp.eye(51)[None], (dof, 1, 1)), dof * (("rad/s", "N m"),))
    visited = list(residual.state[..., dof:].reshape(-1, dof).T)
    values = {name: [0.1, 1.0] for name in names.measured}
    prediction = Prediction(jnp.asarray(residual.state), jnp.ones_like(residual.state), jnp.asarray(residual.valid))
    data = Dataset(residual.t, residual.u, residual.state, residual.valid)
    lost = _residual(dof, used=np.arange(SEQUENCES) > 0)
    figures = {
        "residual": residual_figure(lost, names, _residual(dof, 1)),
        "innovation": innovation_figure(lost, names, residual),  # the two may follow different sequences
        "error": error_figure({"horizons_s": [0.1, 1.0], "before": values, "after": values}, names),
        "friction": friction_figure({"before": table, "after": table}, names, visited),
        "prediction": prediction_figure({"before": prediction, "after": prediction}, data, names, 1.0, 3),
    }
    for name, figure in figures.items():
        width, height = figure.get_size_inches()
        assert width <= 12 and height <= 18, name
        figure.draw_without_rendering()
        panels = [ax.get_window_extent().size / figure.dpi for ax in figure.axes if ax.lines]
        assert min(w for w, _ in panels) > 0.9 and min(h for _, h in panels) > 0.5, name
        assert figure.legends, name
    panels = [ax for ax in figures["prediction"].axes if ax.lines]
    assert len(panels) == 2 * dof
    for line in panels[0].lines[:3]:  # predictions and readings
        np.testing.assert_array_equal(line.get_ydata(), residual.state[3, :, 0])
    labels = {name: "\n".join(ax.get_ylabel() + ax.get_xlabel() for ax in f.axes) for name, f in figures.items()}
    for name in ("residual", "friction"):
        assert "[N]" in labels[name] and ("[N m]" in labels[name]) == (dof > 1)
    assert (f"joint {dof}\n" in labels["residual"]) == (dof > 1)
    assert f"velocity dx{dof} [m/s]" in labels["friction"] and f"x{dof} [m]" in labels["prediction"]
    assert "rms error [m/s]" in labels["error"]
    assert dof == 1 or ("θ₁ [rad]" in labels["prediction"] and "velocity ω₁ [rad/s]" in labels["friction"])


def test_the_cause_of_a_force_has_the_largest_share():
    """An angle that makes turns is wrapped to one: a force of period 2 pi / 3 goes with it, whatever the turn."""
    residual = _residual(2)
    for angle, label in ((residual.state[..., 0], "θ₁ [rad]"), (9 * residual.state[..., 0], "θ₁ wrapped [rad]")):
        state, force = residual.state.copy(), residual.force.copy()
        state[..., 0], force[..., 0] = angle, 0.3 * force[..., 0] + 2 * np.sin(3 * angle)
        figure = residual_figure(residual._replace(state=state, force=force), _names(2), _residual(2, 1))
        top = [ax for ax in figure.axes[: len(figure.axes) // 2] if ax.get_xlabel()]
        shares = {ax.get_xlabel(): float(ax.get_title(loc="right").split()[0]) for ax in top}
        best = max(shares, key=lambda name: shares[name])
        assert best == label and shares[best] > 80 and all("[" in name for name in shares)


def test_few_sequences_what_was_found_and_what_nobody_knows_can_be_drawn():
    for used in (0, 1):
        figure = residual_figure(_residual(2, used=np.arange(SEQUENCES) < used), _names(2), bins=6)
        assert any(np.isfinite(line.get_ydata()).any() for line in figure.axes[0].get_lines()[:1])
    v = np.linspace(-3, 3, 51)
    learned = effect_figure(Curve("theta1 + theta2", "rad", 2, "N m", True, v, v**2, 0.1 + 0 * v))
    assert (learned.axes[0].get_xlabel(), learned.axes[0].get_ylabel()) == ("θ₁ + θ₂ [rad]", "force at joint 2 [N m]")
    nobody = error_figure({"horizons_s": [0.1, 1.0], "fit": {"theta1": [None, None]}}, _names(2))
    for figure in (learned, nobody):
        drawn = picture("found", "", "", figure)
        assert drawn.image.startswith(b"<?xml") and drawn.width == 96 * figure.get_size_inches()[0]
