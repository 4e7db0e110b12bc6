"""Plants that are written as equations: formulas, declaration, model, errors over long horizons."""

import dataclasses
import json
import math
import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from helpers import rig_of, written_again

from nnap_em.errors import FormulaError, RigError
from nnap_em.estimate import identify as identification
from nnap_em.estimate.em import simulated
from nnap_em.estimate.em.build import build_system
from nnap_em.estimate.em.equations import Motion, _modes, motion, pace_of
from nnap_em.estimate.identify import begin, identify, parameter_table
from nnap_em.estimate.store import load, save
from nnap_em.explain.check import check
from nnap_em.logs.dataset import Dataset, pad
from nnap_em.logs.read import read_logs
from nnap_em.machines.systems import register_equations
from nnap_em.machines.systems.expression import parse
from nnap_em.model.effects import catalogue
from nnap_em.model.hooks import Sampling, late

HEAD = 'format = 1\nname = "r"\n'
TAIL = '[sampling]\ndt = 0.5\ninput_hold = "zero-order"\nclock = "sequence"\n'
CHAIN = """[model]
type = "equations"
inputs = { u = "V" }
states = { a = "V", b = "V" }
rates = { a = "k*u - a/ta", b = "(a - b)/tb" }
k = { mean = 1.0, std = 0.5 }
ta = { mean = 4.0, std = 2.0 }
tb = 2.0
[measurement]
columns = { y = "b" }
"""


def _rig(folder: Path, model: str = CHAIN, sampling: str = TAIL):
    return rig_of(folder, HEAD + model + sampling)


def _chain(k=1.3, ta=3.0, tb=2.0, rows=240, noise=0.01, seed=0) -> Dataset:
    """Two lags in series, exact for inputs that are held, by the matrix exponential."""
    rng, dt = np.random.default_rng(seed), 0.5
    u = np.repeat(rng.uniform(0, 2, rows // 8 + 1), 8)[:rows]
    whole = np.array([[-1 / ta, 0.0, k], [1 / tb, -1 / tb, 0.0], [0.0, 0.0, 0.0]])
    step = scipy.linalg.expm(dt * whole)
    x, out = np.array([1.0, 0.5]), []
    for one in u:
        out.append(x[1])
        x = (step @ np.append(x, one))[:2]
    y = np.array(out) + noise * rng.standard_normal(rows)
    return pad([(dt * np.arange(rows), u[:, None], y[:, None])])


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    """The chain as it is declared, before its first epoch, and its log."""
    data = _chain()
    return begin(_rig(tmp_path_factory.mktemp("chain")), data, key=jax.random.key(0)), data


@pytest.fixture(scope="module")
def fit(chain):
    """The chain fitted to that log."""
    begun, data = chain
    return identify(begun.rig, data, key=jax.random.key(0))


FORMULAS = {  # at a = 2, b = 3
    "a + b*2^2 - -b": 2 + 3 * 4 + 3,
    "2^a^2/8": 2**4 / 8,
    "sqrt(b)*exp(-a) + log(b) + abs(-a^2)": math.sqrt(3) * math.exp(-2) + math.log(3) + 4,
    "min(a, b) + max(a, b)*tanh(a)": 2 + 3 * math.tanh(2),
    "sin(a)*cos(b) + sign(a - b)": math.sin(2) * math.cos(3) - 1,
    "where(a > b, 1, 10) + where(a <= 2, 5, 7) + 1e-3*a": 15.002,
}
MISTAKES = {  # in a formula of h1 and k1: what is said of the place, and the hint
    "k1*sqrt(h3)": ("at character 9", "did you mean 'h1'"),
    "k1^2*sqr(h1)": ("at character 6", "did you mean 'sqrt'"),
    "sqrt(h1, k1)": ("at character 1", "takes 1 arguments, found 2"),
    "k1 +* h1": ("at character 5", "not a formula"),
    "__import__('os')": ("at character 1", "unknown function"),
    "h1.real": ("at character 1", "Attribute is not part of formulas"),
}


def test_a_formula_has_the_value_of_the_same_text_in_python():
    for text, value in FORMULAS.items():
        found = parse(text, ("a", "b")).of({"a": jnp.asarray(2.0), "b": jnp.asarray(3.0)})
        np.testing.assert_allclose(found, value, rtol=1e-12, err_msg=text)


def test_a_mistake_in_a_formula_has_its_place_and_a_hint():
    for text, words in MISTAKES.items():
        with pytest.raises(FormulaError) as error:
            parse(text, ("h1", "k1"))
        assert all(word in str(error.value) for word in words), str(error.value)


def test_a_root_has_no_slope_without_end_and_no_value_below_zero():
    root = lambda x: parse("sqrt(x)", ("x",)).of({"x": x})  # noqa: E731
    for x in (-1.0, 0.0):
        assert root(jnp.asarray(x)) == 0.0
        assert jax.grad(root)(jnp.asarray(x)) == 0.0


DECLARED = [  # a text of the declaration, what stands in its place, and what is said of it
    ('b = "(a - b)/tb" }', 'b = "(a - b)/tc" }', "[model.rates] b: at character 9"),
    ('b = "(a - b)/tb" }', 'b = "(a - b)/2" }', "[model] tb: no equation and no reading uses it"),
    ('{ u = "V" }', '{ u = "" }', "[model.inputs] u: missing unit"),
    ('{ y = "b" }', '{ y = "c" }', "[measurement.columns] y: at character 1"),
    ('{ y = "b" }', '["c"]', "'c' is no state; possible here: a, b"),
    ("[mea", 'open = ["c"]\n[mea', "[model] open: 'c' is no state; possible here: a, b"),
    ("[mea", "[model.unknown]\nf = { signals = ['c'], enters = 'a' }\n[mea", "'c' is no state or input"),
]


def test_a_mistake_in_the_declaration_is_named_by_file_key_and_place(tmp_path):
    for wrong, right, words in DECLARED:
        assert wrong in CHAIN
        with pytest.raises(RigError) as error:
            _rig(tmp_path, CHAIN.replace(wrong, right))
        assert str(error.value).startswith(f"{tmp_path / 'rig.toml'}: ") and words in str(error.value)


def test_a_rate_without_an_estimated_number_lacks_nothing(tmp_path):
    """b' = (a - b)/tb has a trusted one; `exact` closes others, `open` opens, and nothing stands in a constant."""
    exact = lambda text: sorted(json.loads(_rig(tmp_path, text).equations)["exact"])  # noqa: E731
    more = {"": ["b"], 'exact = ["a"]': ["a", "b"], 'open = ["b"]': [], 'exact = ["a"]\nopen = ["b"]': ["a"]}
    for line, closed in more.items():
        assert exact(CHAIN.replace("[measurement]", f"{line}\n[measurement]")) == closed
    trusted = CHAIN.replace("{ mean = 1.0, std = 0.5 }", "1.0").replace("{ mean = 4.0, std = 2.0 }", "4.0")
    assert exact(trusted) == []  # no number is estimated
    assert exact(trusted.replace("(a - b)/tb", "a - b").replace("tb = 2.0\n", "")) == ["b"]
    assert exact(CHAIN.replace("(a - b)/tb", "0").replace("tb = 2.0\n", "")) == []


def test_a_declaration_is_the_same_after_writing_it(tmp_path):
    model = CHAIN.replace("[measurement]", '[model.unknown]\nf = { signals = ["a", "u"], enters = "b" }\n[measurement]')
    model += "range = { y = [0, 10] }\n"
    rig = _rig(tmp_path, model, TAIL + "horizon = 20.0\n")
    assert written_again(rig, tmp_path) == rig
    assert rig.horizon == 20.0
    assert dict(rig.ranges) == {"y": (0.0, 10.0)}


def test_a_python_function_is_the_same_plant_as_its_text(tmp_path):
    def rate(x, u, p):
        return {"b": (x.a - x.b) / p.tb, "a": p.k * u.u - x.a / p.ta}

    names = {"states": {"a": "V", "b": "V"}, "inputs": {"u": "V"}, "parameters": ("k", "ta", "tb")}
    register_equations("test_chain", rate, **names)
    lines = [line for line in CHAIN.splitlines() if not line.startswith(("inputs", "states", "rates"))]
    text = _rig(tmp_path)
    python = _rig(tmp_path, "\n".join(lines).replace('"equations"', '"test_chain"') + "\n")
    first, second = (build_system(rig) for rig in (text, python))
    q, u, push = jnp.asarray([0.3, 0.8]), jnp.asarray([0.4]), jnp.asarray([0.1, -0.2])
    np.testing.assert_array_equal(first.slopes(q, q[:0], u, push), second.slopes(q, q[:0], u, push))
    assert python.input_columns == text.input_columns == ("u",)


def test_time_constants_are_those_of_the_eigenvalues_and_every_row_is_in_one_window(chain):
    seen = motion(chain[0].model, chain[1])
    np.testing.assert_allclose([seen.slowest, seen.fastest], [4.0, 0.5], rtol=1e-9)
    at = simulated.windows(chain[0].model, chain[1])
    assert (at.count, at.rows, at.every) == (2, 120, 1)  # 240 rows of 0.5 s, two paces of 32 s a window
    np.testing.assert_array_equal(at.row.ravel(), np.arange(240))


MODES = (
    ([[0.0, 6.0], [6.0, 0.0]], {"growth": 6.0, "unstable": ("a", "b")}),
    ([[-3.0, 0.0], [1.0, 0.1]], {"kept": ()}),  # grows by e^1 in half of the recording
    ([[0.0, 1.0], [-9.0, 0.0]], {"kept": ()}),
    ([[0.0, 1.0], [0.0, 0.0]], {"kept": ("a", "b")}),
    ([[-3.0, 0.0], [1.0, 0.0]], {"kept": ("b",)}),
)


def test_unstable_modes_and_integrators_are_those_of_the_eigenvalues():
    dt, rows = 0.05, 400
    for rate, expected in MODES:
        step = np.broadcast_to(scipy.linalg.expm(dt * np.array(rate)), (2, rows, 2, 2))
        found = _modes(("a", "b"), step, dt)
        assert set(found) == set(expected)
        for name, value in expected.items():
            assert found[name] == (pytest.approx(value, rel=1e-3) if name == "growth" else value)


def test_predictions_of_an_unstable_plant_end_when_errors_have_grown_e_fold(chain):
    rig = chain[0].rig
    none = np.zeros((0, 2))
    seen = Motion(none, none, none, 1.0, 4.0)
    assert pace_of(rig, seen, 1000) == 32.0
    assert pace_of(rig, seen._replace(kept=("a",)), 1000) == 170.0  # a third of the rows
    assert pace_of(rig, seen._replace(growth=0.2), 1000) == 5.0
    assert pace_of(rig, seen._replace(growth=2.0), 1000) == 2.0  # four rows
    assert pace_of(dataclasses.replace(rig, horizon=9.0), seen._replace(growth=0.2), 1000) == 9.0


SWING = """[model]
type = "equations"
inputs = []
states = { th = "rad", w = "rad/s" }
rates = { th = "w", w = "-g/L*sin(th) - c*w" }
g = 9.81
L = { mean = 0.5, std = 0.2 }
c = { mean = 0.1, std = 0.1 }
[measurement]
columns = { px = "960 + 640*L*sin(th)" }
noise_std = { px = 0.7 }
"""


def test_scales_are_those_of_the_readings_where_the_equations_rest(tmp_path):
    """Without input the declared pendulum hangs still; the size of its motion is that of the readings."""
    t, out, fast, length = 0.03 * np.arange(240), [], [], 0.62
    rate = lambda _, x: [x[1], -9.81 / length * np.sin(x[0]) - 0.2 * x[1]]  # noqa: E731
    for seed, start in enumerate((0.7, -0.5)):  # Runge-Kutta steps of scipy
        x = scipy.integrate.solve_ivp(rate, (0, t[-1]), [start, 0.0], t_eval=t, rtol=1e-9).y
        noise = 0.7 * np.random.default_rng(seed).standard_normal(240)
        out.append((t, np.zeros((240, 0)), (960 + 640 * length * np.sin(x[0]) + noise)[:, None]))
        fast.append(rate(0, x)[1])
    data = pad(out)
    model = begin(_rig(tmp_path, SWING, TAIL.replace("0.5", "0.03")), data, key=jax.random.key(0)).model
    size = np.exp(0.5 * np.asarray(model.log_q)) / 0.03
    assert 0.5 < size[1] / np.sqrt(np.mean(np.square(fast))) < 2
    np.testing.assert_allclose(np.asarray(model.unknown.scale), size, rtol=1e-9)
    seen = motion(model, data)
    np.testing.assert_allclose([seen.x[:, 0].min(), seen.x[:, 0].max()], [-0.6, 0.9], atol=0.4)  # L is not known


DIVIDED = CHAIN.replace("(a - b)/tb", "(a - b)/u/tb")


def test_rates_that_are_infinite_are_named_with_file_rows_input_and_mend(tmp_path):
    data = _chain()
    u = np.array(data.u)
    u[0, :, 0] = np.where(np.arange(240) % 2, 2.0, 1.0)
    u[0, 5:12] = 0.0
    rig, data = _rig(tmp_path, DIVIDED), data._replace(u=u)
    (found,) = [result for result in check(rig, data, None, key=jax.random.key(0)) if result.subject == "rates"]
    text = "the rates of b are infinite or no number in sequence 0, 7 rows from 6 to 12; u is 0 there: "
    assert found.mark == "error"
    assert text + "write max(u, 0.1) for u" in found.text
    with pytest.raises(RigError, match="sequence 0, 7 rows from 6 to 12"):
        identify(rig, data, key=jax.random.key(0))


def test_readings_at_the_ends_of_their_range_are_not_read(tmp_path):
    rig = _rig(tmp_path, CHAIN + "range = { y = [0, 1.5] }\n")
    (tmp_path / "train").mkdir()
    y = np.minimum(0.1 * np.arange(30) + 0.01 * (-1.0) ** np.arange(30), 1.5)
    rows = "\n".join(f"{0.5 * i},1,{one}" for i, one in enumerate(y))
    (tmp_path / "train" / "a.csv").write_text(f"time,u,y\n{rows}\n")
    with pytest.warns(UserWarning, match="at the end of the declared range"):
        logs = read_logs(tmp_path / "train", rig, trust=True)
    np.testing.assert_array_equal(np.isnan(np.asarray(logs.data.y)[0, :, 0]), y >= 1.5)
    assert [m.kind for m in logs.masked] == ["range"]


def test_derivatives_of_open_loop_errors_are_those_of_differences(chain):
    fitted, data = chain
    prior = fitted.m_step.prior
    begin_at = simulated.filtered(fitted.model, data)
    still = np.zeros_like(begin_at.mean)

    def errors(z, start):
        return simulated.SideBySide([fitted.model], [prior], data, begin_at).at([0], [z], [start])[0]

    here = errors(np.zeros(2), still)
    assert np.isfinite(here.error).all()
    for i, step in enumerate(1e-5 * np.eye(2)):
        slope = (errors(step, still).error - errors(-step, still).error) / 2e-5
        np.testing.assert_allclose(here.columns[..., i], -slope, rtol=1e-5, atol=1e-7)
        slope = (errors(np.zeros(2), still + step).error - errors(np.zeros(2), still - step).error) / 2e-5
        np.testing.assert_allclose(here.by_start[..., i], -slope, rtol=1e-5, atol=1e-7)


def test_a_simulation_that_runs_away_makes_no_step_singular():
    """Derivatives of 1e12 leave of the prior's 1 nothing in the sums; those of far errors do not count at all."""
    error, columns = np.full((1, 1, 40, 1), 0.1), np.ones((1, 1, 40, 1, 2))
    of = simulated.Simulated(None, None, np.zeros(2), np.zeros((1, 1, 2)), error, columns, 1e12 * columns)  # type: ignore[arg-type]
    scale, counts = np.ones((1, 1, 1, 1)), np.ones(error.shape, bool)
    for step in simulated._step(of, scale, counts, 0.0):
        assert np.isfinite(step).all()
    far = np.array(error)
    far[0, 0, 20:] = 31.0
    half = of._replace(error=error[:, :, :20], columns=columns[:, :, :20], by_start=0 * columns[:, :, :20])
    away = of._replace(error=far, by_start=0 * columns, columns=np.where(far[..., None] > 1, 1e150, columns))
    first = simulated._eliminated(half, scale, counts[:, :, :20])[0]
    variances = 0.1**2, (0.1**2 + simulated.HUBER * (2 * simulated.FARTHEST - simulated.HUBER)) / 2
    ratio = simulated._eliminated(away, scale, counts)[0][:, 0] / first[:, 0]
    np.testing.assert_allclose(ratio, variances[0] / variances[1], rtol=1e-9)


def test_the_fit_of_the_smaller_errors_is_kept(chain, fit, monkeypatch):
    """A fit to long horizons that is worse by the errors that it is fitted to is not kept."""

    def worse(fitted, data):
        model = fitted.m_step.prior.write(fitted.model, jnp.asarray([3.0, 3.0]))
        return fitted._replace(state=fitted.state._replace(best=model))

    monkeypatch.setattr(identification, "fitted_to_horizon", worse)
    table = parameter_table(identification.finished(fit, chain[1]))
    np.testing.assert_allclose([table["k"][0], table["ta"][0]], [1.3, 3.0], rtol=0.05)
    assert 0 < table["k"][1] < 0.1


def test_an_input_that_takes_time_begins_as_it_is(chain):
    system, column = chain[0].model.system, jnp.asarray(chain[1].u)[0, :, 0]
    lag = catalogue["actuator_lag"].of(2.0, channel="u")
    lagged = np.asarray(late((lag,), None, system, column[:, None], Sampling(0.5).through))[:, 0]
    keep, expected, held = np.exp(-0.5 / 2.0), [], float(column[0])
    for one in np.asarray(column):  # mean over each row of the exact response
        expected.append(one + (held - one) * 2.0 / 0.5 * (1 - keep))
        held = one + (held - one) * keep
    np.testing.assert_allclose(lagged, expected, rtol=1e-9)
    np.testing.assert_array_equal(late((lag,), None, system, jnp.full((9, 1), 3.0), Sampling(0.5).through), 3.0)


def test_identify_finds_the_parameters_and_the_hidden_state(fit, tmp_path):
    k, ta = (float(fit.model.system.values[name]) for name in ("k", "ta"))
    np.testing.assert_allclose([k, ta], [1.3, 3.0], rtol=0.03)
    save(tmp_path / "model.npz", fit)
    again = load(tmp_path / "model.npz")
    assert again.rig == fit.rig and again.model.pace == fit.model.pace
    assert eqx.tree_equal(again.model, fit.model)


TANK = """[model]
type = "equations"
inputs = ["u"]
states = ["h", "w", "s"]
rates = { h = "k*u - h", w = "0.2*(h - w)", s = "RATE" }
k = { mean = 1.0, std = 0.5 }
units = { y = "V", time = "min" }
[measurement]
columns = { y = "COLUMN" }
"""
SEEN = {  # rate of the third state, reading; result and words of `check`
    "a lag of what is read decays to it": ("w - s", "2*h", "ok", "a whole log determines 3 of 3"),
    "an integrator that is not read": ("w", "2*h", "error", "2 of 3 directions of the state; not determined: s"),
    "an integrator that is read": ("w", "s", "ok", "a whole log determines 3 of 3"),
}


@pytest.mark.parametrize("rate, column, mark, words", SEEN.values(), ids=SEEN)
def test_states_are_judged_over_whole_logs_in_the_units_of_the_plant(tmp_path, rate, column, mark, words):
    """The input rests in the first half, so that nothing moves there."""
    u = np.repeat([0.0, 0.0, 0.0, 0.0, 1.0, 0.3, 1.5, 0.2], 50)
    h = scipy.signal.lfilter([1 - np.exp(-0.5)], [1, -np.exp(-0.5)], np.append(0, u))[:-1]
    w = np.append(0, np.cumsum(h)[:-1]) * 0.1
    y = 2 * h if column == "2*h" else 0.5 * np.append(0, np.cumsum(w)[:-1])
    y = y + 0.01 * np.random.default_rng(0).standard_normal(400)
    data = pad([(0.5 * np.arange(400), u[:, None], y[:, None])])
    results = check(
        _rig(tmp_path, TANK.replace("RATE", rate).replace("COLUMN", column)), data, None, key=jax.random.key(0)
    )
    states = next(result for result in results if result.subject == "states")
    assert (states.mark, words in states.text) == (mark, True), states.text
    said = " ".join(result.text for result in results)
    assert "200 min, 400 rows" in said and "rows 0.5 min apart" in said and " V by the log" in said
    assert ("integrators: s" in said) == (rate == "w")
    assert not re.search(r"joint|torque|current| s\b(?<!: s)", said), said
