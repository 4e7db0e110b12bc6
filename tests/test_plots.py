"""Figures of machines with 1 to 7 joints: everything is drawn, with its unit, in a size that can be read."""

import io
import re

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import right_residual

from nnap_em.data.dataset import Dataset
from nnap_em.data.logs import Logs
from nnap_em.diagnosis.residual import Names, Residual
from nnap_em.effects.base import Curve
from nnap_em.fit.identify import FrictionTable
from nnap_em.fit.predict import GIVEN, Prediction
from nnap_em.report.diagnosis import _prediction_pictures
from nnap_em.report.fit_plots import effect_figure, error_figure, friction_figure, prediction_figure, screen_figure
from nnap_em.report.page import picture
from nnap_em.report.residual_plots import innovation_figure, residual_figure

SEQUENCES, ROWS, DT = 8, 200, 0.01


def _names(dof: int) -> Names:
    """A machine whose last joint slides; all positions and rates are read."""
    angles = (*(True,) * (dof - 1), False)
    coordinates = tuple(f"theta{j + 1}" if angle else f"x{j + 1}" for j, angle in enumerate(angles))
    rates = tuple(f"d{name}" for name in coordinates)
    return Names(coordinates, rates, angles, ("u",), (dof,), coordinates + rates)


def _residual(dof: int, seed: int = 0, **changes) -> Residual:
    return right_residual(seed, (SEQUENCES, ROWS), dof, 2 * dof, **changes)


def _table(dof: int) -> FrictionTable:
    v = jnp.tile(jnp.linspace(-3, 3, 51)[None], (dof, 1))
    return FrictionTable(v, -v, jnp.tile(1e-4 * jnp.eye(51)[None], (dof, 1, 1)), dof * (("rad/s", "N m"),))


@pytest.fixture(scope="module", params=(1, 7))
def drawn(request):
    """The number of joints, and all figures that have a panel for each."""
    dof = request.param
    names, residual, table = _names(dof), _residual(dof), _table(dof)
    pair = residual.state[0], np.ones((ROWS, 2 * dof))
    visited = list(residual.state[..., dof:].reshape(-1, dof).T)
    values = {name: [0.1, 1.0] for name in names.measured}
    error = {"horizons_s": [0.1, 1.0], "before": values, "after": values}
    both = {"before": pair, "after": pair}
    lost = _residual(dof, used=np.arange(SEQUENCES) > 0)
    return dof, {
        "residual": residual_figure(lost, names, _residual(dof, 1)),
        "innovation": innovation_figure(lost, names, residual),  # the two may follow different sequences
        "error": error_figure(error, names),
        "friction": friction_figure({"before": table, "after": table}, names, visited),
        "prediction": prediction_figure(residual.t[0], residual.state[0], names, both, 1.0),
    }


def test_the_longest_test_sequences_are_those_to_choose_from(monkeypatch):
    """The five longest of eight are kept, longest first, and of these as many as a page has room for."""
    residual, names = _residual(1), _names(1)
    length = np.asarray([50, 200, 60, 70, 80, 90, 40, 100])
    valid = np.arange(ROWS) < length[:, None]
    data = Dataset(residual.t, residual.u, residual.state, valid)
    files = tuple(f"{n}.csv" for n in length)
    prediction = Prediction(jnp.asarray(residual.state), jnp.ones_like(residual.state), jnp.asarray(valid))

    def choices(some: int) -> list:
        logs = Logs(files[:some], Dataset(*(a[:some] for a in data)), ())
        return list(_prediction_pictures({"before": prediction}, names, logs, GIVEN))

    pictures = choices(len(files))
    assert [picture.choice for picture in pictures] == ["200.csv", "100.csv", "90.csv", "80.csv", "70.csv"]
    assert [alone.choice for alone in choices(1)] == [""]
    room = sum(len(picture.image) for picture in pictures[:2]) + 1
    monkeypatch.setattr("nnap_em.report.diagnosis.PICTURE_BYTES", room)
    assert [picture.choice for picture in choices(3)] == ["200.csv", "60.csv"]


def test_a_rounded_drawing_is_smaller_and_in_the_same_places():
    """Coordinates of all paths within half a hundredth of a point; what scales them is untouched."""
    residual, names = _residual(1), _names(1)
    pair = residual.state[0], np.ones((ROWS, 2))
    figure = prediction_figure(residual.t[0], residual.state[0], names, {"before": pair}, 1.0)
    image = io.BytesIO()
    figure.savefig(image, format="svg")
    drawn = picture("error", "", "", figure)
    plain, rounded = image.getvalue(), drawn.image
    assert f'width="{0.75 * drawn.width:g}pt"'.encode() in plain
    paths, scales = (re.compile(rb'(?s)\b%s="([^"]*)"' % name) for name in (b"d", b"transform"))
    for a, b in zip(paths.findall(plain), paths.findall(rounded), strict=True):
        numbers = (np.asarray(re.findall(rb"-?\d+\.?\d*", d), float) for d in (a, b))
        np.testing.assert_allclose(*numbers, atol=0.0100001)
    assert scales.findall(plain) == scales.findall(rounded) and len(rounded) < 0.9 * len(plain)


def test_every_figure_can_be_read_whatever_the_number_of_joints(drawn):
    dof, figures = drawn
    for name, figure in figures.items():
        width, height = figure.get_size_inches()
        assert width <= 12 and height <= 18, name
        figure.draw_without_rendering()
        filled = [ax for ax in figure.axes if ax.lines]
        panels = [ax.get_window_extent().size / figure.dpi for ax in filled]
        assert min(w for w, _ in panels) > 0.9 and min(h for _, h in panels) > 0.5, name
    assert sum(bool(ax.lines) for ax in figures["prediction"].axes) == 2 * dof


def test_axes_name_joints_and_have_the_units_of_the_machine(drawn):
    dof, figures = drawn
    said = {name: "\n".join(ax.get_ylabel() + ax.get_xlabel() for ax in f.axes) for name, f in figures.items()}
    for name in ("residual", "friction"):
        assert "[N]" in said[name] and ("[N m]" in said[name]) == (dof > 1)
    assert (f"joint {dof}\n" in said["residual"]) == (dof > 1)
    assert f"velocity dx{dof} [m/s]" in said["friction"]
    assert f"x{dof} [m]" in said["prediction"]
    assert "rms error [m/s]" in said["error"]
    if dof > 1:
        assert "θ₁ [rad]" in said["prediction"] and "velocity ω₁ [rad/s]" in said["friction"]


def test_the_cause_of_a_force_has_the_largest_share():
    residual = _residual(2)
    force = residual.force.copy()
    force[..., 0] = 0.3 * force[..., 0] + 2 * np.sin(3 * residual.state[..., 0])
    figure = residual_figure(residual._replace(force=force), _names(2), _residual(2, 1))
    shares = {ax.get_xlabel(): float(ax.get_title(loc="right").split()[0]) for ax in figure.axes[:6] if ax.get_xlabel()}
    best = max(shares, key=lambda name: shares[name])
    assert best.startswith("θ₁") and shares[best] > 80
    assert all("[" in name for name in shares)


def test_of_many_joints_the_likeliest_causes_are_drawn():
    residual = _residual(7)
    force = residual.force.copy()
    force[..., 3] += 4 * np.sin(3 * residual.state[..., 5])
    figure = residual_figure(residual._replace(force=force), _names(7))
    row = [ax for ax in figure.axes[12:16]]
    assert "joint 4" in row[0].get_ylabel() and row[0].get_xlabel().startswith("θ₆")


def test_few_sequences_what_was_found_and_what_nobody_knows_can_be_drawn():
    few = [residual_figure(_residual(2, used=np.arange(SEQUENCES) < used), _names(2), bins=6) for used in (0, 1)]
    for figure in few:
        assert any(np.isfinite(line.get_ydata()).any() for line in figure.axes[0].get_lines()[:1])
    v = np.linspace(-3, 3, 51)
    learned = effect_figure(Curve("theta1 + theta2", "rad", 2, "N m", True, v, v**2, 0.1 + 0 * v))
    assert (learned.axes[0].get_xlabel(), learned.axes[0].get_ylabel()) == ("θ₁ + θ₂ [rad]", "force at joint 2 [N m]")
    nobody = error_figure({"horizons_s": [0.1, 1.0], "fit": {"theta1": [None, None]}}, _names(2))
    screened = screen_figure([("a spring", 30.0), ("a delay", -2.0)], chosen="a spring")
    for figure in (learned, nobody, screened, screen_figure([])):
        image = io.BytesIO()
        figure.savefig(image, format="png", dpi=40)
        assert image.getvalue().startswith(b"\x89PNG")
