"""Laws that equations may lack, unknown terms, and the search for them."""

import dataclasses
import json
import math
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import chain_rig, rig_of

from nnap_em.base.deadline import TimeUp
from nnap_em.estimate.em.equations import free_term, motion
from nnap_em.estimate.em.prior import ParameterPrior
from nnap_em.estimate.em.simulated import Simulated, Windows
from nnap_em.estimate.identify import begin, identify
from nnap_em.explain.diagnosis import equations
from nnap_em.explain.diagnosis.equations import FOLDS, Case, by_simulation, folds
from nnap_em.explain.diagnosis.hypothesis import Evidence, declared
from nnap_em.explain.diagnosis.search import Progress, search
from nnap_em.logs.dataset import pad
from nnap_em.machines.systems import Equations
from nnap_em.model.effects import Candidate, OperatingPoint, SensorEffect, catalogue
from nnap_em.model.effects.equations import UnknownTerm, lean, numbered
from nnap_em.model.state_space import Inputs
from nnap_em.output.report.document import unknown_terms as reported_terms
from nnap_em.output.report.fit_plots import term_figure

PLANT = {
    "states": {"a": "m", "b": "m"}, "inputs": {"u": "V"}, "rates": {"a": "u - a", "b": "k*a - b"}, "readings": {},
    "parameters": ["k"], "terms": {}, "enters": {}, "units": {}, "function": "",
}  # fmt: skip
SYSTEM = Equations({"k": jnp.ones(())}, json.dumps(PLANT))


def _pushes(effect, a=2.0, b=0.5, u=3.0):
    q, inputs, none = jnp.asarray([a, b]), jnp.asarray([u]), jnp.zeros(2)
    scene = OperatingPoint(SYSTEM, q, q[:0], none, jnp.zeros(()), none, None, inputs)  # type: ignore[arg-type]
    return np.asarray(effect.force(scene, jnp.zeros(0)))


LAWS = {
    "constant_flow": (("a", (), None), [0.3, 0.0]),
    "linear_flow": (("b", ("a",), None), [0.0, 0.3 * 2.0]),
    "square_flow": (("b", ("a",), None), [0.0, 0.3 * 4.0]),
    "cubic_flow": (("b", ("a",), None), [0.0, 0.3 * 8.0]),
    "power_flow": (("b", ("a",), None), [0.0, 0.3 * 2.0**1.2]),
    "product_flow": (("a", ("b", "u"), None), [0.3 * 0.5 * 3.0, 0.0]),
    "threshold_flow": (("b", ("a",), None), [0.0, 0.3 * (2.0 - 1.2)]),
    "exchange": (("a", ("a", "b"), "b"), [-0.3 * 1.5, 0.3 * 1.5]),
    "transfer": (("a", ("a",), "b"), [-0.3 * 0.8, 0.7 * 0.3 * 0.8]),
    "ceiling": (("a", ("a",), None), [-0.3 * 1.0, 0.0]),
    "overflow": (("a", ("a",), "b"), [-0.3 * 1.0, 0.7 * 0.3 * 1.0]),
}


def test_a_law_pushes_as_its_formula_says():
    for name, ((port, reads, to), expected) in LAWS.items():
        share = 1.0 if name == "exchange" else 0.7
        law = catalogue[name](strength=0.3, level=1.2, share=share, edge=1e-3, channel=port, reads=reads, to=to)
        np.testing.assert_allclose(_pushes(law), expected, rtol=1e-12, err_msg=name)
        below = dataclasses.replace(law, level=jnp.asarray(2.5))
        assert np.abs(_pushes(below)).max() < 1e-100 or "level" not in law.reports


def test_laws_of_inputs_and_readings_are_the_same_in_the_form_of_all():
    """Gain, bias, dead zone and limit of u beside each other; scale, bias and bend of b; other places stay."""
    laws = [catalogue[name].of(0.4, channel="u") for name in ("motor_gain", "input_bias", "dead_zone", "saturation")]
    laws += [catalogue[name].of(0.4, channel="b") for name in ("sensor_scale", "sensor_bias")]
    laws.append(catalogue["sensor_bend"].of(0.4, 2.0, channel="b", range=4.0))
    for law in laws:
        form = lean(law, SYSTEM)
        for value in (-1.7, 0.1, 3.0):
            if law.channel == "u":
                assert form.at_drive({"channel": "u"}, 0).drive(jnp.asarray(value)) == pytest.approx(law.drive(value))
            else:
                for index, expected in ((0, value), (1, law.reading(value, None))):
                    read = form.at_reading("", index).reading(jnp.asarray(value), None)
                    assert read == pytest.approx(float(expected))
        np.testing.assert_array_equal(_pushes(form), [0.0, 0.0])
        moved = dataclasses.replace(form, strength=jnp.asarray(0.7))
        assert float(next(iter(jax.tree.leaves(numbered(law, moved))))) == pytest.approx(0.7)


def test_laws_of_time_are_the_same_in_the_form_of_all():
    """Delay and lag of u."""
    u = jnp.asarray([0.0, 1.0, 3.0, 2.0, 2.0, -1.0])
    for name in ("input_delay", "actuator_lag"):
        law = catalogue[name].of(0.7, channel="u")
        late = lean(law, SYSTEM).at_drive({"channel": "u"}, 0).input(u, 0.5)
        np.testing.assert_allclose(late, law.input(u, 0.5), rtol=1e-12)


def test_a_parameter_that_varies_pushes_as_the_equations_with_another_one():
    law = catalogue["varying_parameter"](slope=0.3, middle=1.0, channel="k", reads=("u",))  # k = 1 + 0.3 (3 - 1)
    np.testing.assert_allclose(_pushes(law), [0.0, 0.6 * 2.0], rtol=1e-12)


def test_units_of_a_law_are_those_of_its_port_and_signals():
    for name, reads, unit in (
        ("linear_flow", ("b",), "1/s"),
        ("product_flow", ("b", "u"), "m/s/(m V)"),
        ("power_flow", ("u",), "m/s/(V)^power"),
    ):
        law = catalogue[name](strength=0.1, channel="a", reads=reads)
        assert law.units_on(SYSTEM)["strength"] == unit
    slow = Equations({}, json.dumps(PLANT | {"units": {"time": "min"}}))
    units = catalogue["linear_flow"](strength=0.1, channel="a", reads=("b",)).units_on(slow)
    assert units == {"strength": "1/min", "level": "m", "share": "-", "power": "-"}
    assert catalogue["input_delay"].of(0.7, channel="u").units_on(slow) == {"delay": "min"}


def test_a_bent_sensor_reads_a_curve():
    bend = catalogue["sensor_bend"](jnp.asarray(0.2), jnp.asarray(1.0), 4.0, channel="a")
    np.testing.assert_allclose(bend.reading(jnp.asarray(3.0), lambda delay: jnp.nan), 3.0 + 0.2 * 4.0 / 4.0)


def test_a_reading_is_in_one_part_or_determines_a_start():
    at = Windows(2, 50, 1, 10)
    masks = np.stack(folds(at, 2))
    assert masks.shape == (FOLDS, 2, 2, 50, 1)
    np.testing.assert_array_equal(masks.sum(axis=0)[..., 0], (at.row % 50 >= 10)[None].repeat(2, axis=0))
    for part in masks[..., 0]:  # blocks of 25 rows
        blocks = {int(row) // 25 for sequence in part for row in at.row[sequence]}
        assert blocks <= {0, 1, 2, 3}
    assert not (masks[0] & masks[1]).any()


ERROR = np.random.default_rng(0).choice([-1.0, 1.0], (1, 1, 100, 1))
ERROR[0, 0, 1::2] = -ERROR[0, 0, ::2]  # neighbours never alike: all are independent


def _case(left, numbers, share, error=ERROR):
    law = catalogue["linear_flow" if numbers == 1 else "threshold_flow"]
    start = law(strength=0.0, channel="a", reads=("a",))
    none = np.zeros((*error.shape, 0))
    of = Simulated(None, None, np.zeros(0), np.zeros((1, 1, 0)), error, none, none)  # type: ignore[arg-type]
    return Case((Candidate(start, (), start),), of, 0.0, share=share, left=left)


def test_of_laws_as_likely_that_of_fewer_numbers_is_chosen():
    """100 independent errors: 5 nat are a tenth of the squared error; of one, nine tenths of the best share decide."""
    for left, numbers in ((1.05, 1), (1.15, 2)):
        cases = [_case(1.0, 2, 0.9), _case(left, 1, 0.89)]
        assert equations._chosen(cases)[0].numbers == numbers
    for share, numbers in ((0.46, 1), (0.44, 2)):
        cases = [_case(0.5, 2, 0.5, np.ones((1, 1, 100, 1))), _case(0.55, 1, share, np.ones((1, 1, 100, 1)))]
        assert equations._chosen(cases)[0].numbers == numbers


def test_a_strength_that_is_not_determined_is_refused():
    """100 independent errors of size one, three of whose precision and the prior of one determine it to a half."""
    for strength, determined in ((0.95, False), (1.05, True)):
        law, start = (catalogue["linear_flow"](strength=x, channel="a", reads=("a",)) for x in (strength, 0.0))
        case = _case(1.0, 1, 0.9)
        columns = np.stack([np.full(ERROR.shape, np.sqrt(0.03)), *2 * [np.zeros(ERROR.shape)]], axis=-1)
        model, prior = SimpleNamespace(effects=(law.lean(SYSTEM),)), ParameterPrior((), jnp.zeros(3), jnp.ones(3))
        of = case.of._replace(model=model, prior=prior, z=np.zeros(3), columns=columns)
        assert equations._certain(case._replace(of=of, laws=(Candidate(start, (law,), start),))) == determined


def test_noise_of_readings_is_no_room_for_laws():
    """Room is the share of a sine beside unit noise; at nine rows a period EM's noise alone shows it."""
    rng, row, data = np.random.default_rng(0), np.arange(400), _logs(0.0)
    for amplitude, period, em, room in ((0.0, 126, 9.0, 0.0), (2.0, 126, 9.0, 2 / 3), (2.0, 9, 1.0, 2 / 3)):
        error = rng.standard_normal((1, 1, 400, 1)) + amplitude * np.sin(2 * np.pi * row / period)[:, None]
        before = SimpleNamespace(model=SimpleNamespace(log_r=np.log([em])))
        data = data._replace(y=10 * jnp.asarray(error[0]))
        search = equations.Search(before, data, print, (), ())  # type: ignore[arg-type]
        out = search._replace(scale=np.sqrt(np.mean(error**2)))
        np.testing.assert_allclose(out.room(_case(1.0, 1, 0.5, error).of), room, atol=0.12)


def test_laws_that_make_a_reading_worse_at_some_age_are_refused():
    """Two readings at three ages on four parts; one error of twelve rises, to more than twice its square."""
    before = np.ones((4, 3, 2))
    after = 0.5 * before
    assert not equations.worsens(before, after)
    for rise, parts, worse in ((2.1, 4, True), (2.5, 3, True), (1.9, 4, False), (9.0, 2, False)):
        after[:, 1, 1] = np.where(np.arange(4) < parts, rise, 0.999)
        assert equations.worsens(before, after) == worse


def test_each_law_of_a_pair_is_tried_in_the_place_of_the_other():
    """Rivals of a pair have another law in the place of one, and explain nine tenths of what it does."""
    names, key = ("linear_flow", "square_flow", "cubic_flow"), equations.key_of
    flows = [catalogue[name](strength=0.0, channel="a", reads=("a",)) for name in names]
    laws = [Candidate(law, (), law) for law in (*flows, catalogue["motor_gain"].of(0.0, channel="u"))]
    left = {(0, 3): 40.0, (1, 3): 45.0, (2, 3): 47.0, (0, 1): 60.0, (0, 2): 40.0}
    cost = {frozenset(key(laws[i].start) for i in pair): cost for pair, cost in left.items()}

    def fitted(*some: Candidate) -> Case:
        left = cost.get(frozenset(key(law.start) for law in some), 90.0)
        model = SimpleNamespace(effects=tuple(lean(law.start, SYSTEM) for law in some))
        return Case(some, _case(1.0, 1, 0.5).of._replace(model=model, z=np.array([left])), left)

    cases = [fitted(law) for law in laws[:3]]
    screened = lambda bare, every, most: sorted((fitted(*some) for some, _ in every), key=lambda c: c.loss)  # noqa: E731
    search = SimpleNamespace(screened=screened, loss=lambda of: float(of.z[0]))
    rivals = equations._rivals(search, None, fitted(laws[0], laws[3]), cases, 100.0)  # type: ignore[arg-type]
    assert [case.loss for case in rivals] == [40.0, 45.0]  # explained: 60, 55 and, too little, 53 and 40 of 60


def test_laws_that_explain_the_same_are_told_apart_by_what_they_leave_beside_a_second_one():
    """100 independent errors: beside a cubic flow one leaves 40, the other 42 of 100, the same, or 46."""
    key = equations.key_of
    names = "linear_flow", "square_flow", "cubic_flow"
    laws = [
        Candidate(law, (law,), law) for law in (catalogue[n](strength=0.0, channel="a", reads=("a",)) for n in names)
    ]
    for other, told in ((42.0, 2), (46.0, 1)):
        ahead = {frozenset(key(laws[i].start) for i in (k, 2)): left for k, left in ((1, 40.0), (0, other))}

        def fitted(*some: Candidate, ahead=ahead) -> Case:
            model = SimpleNamespace(effects=tuple(lean(law.start, SYSTEM) for law in some))
            left = ahead.get(frozenset(key(law.start) for law in some), 90.0)
            return Case(some, _case(1.0, 1, 0.5).of._replace(model=model), left, left=left)

        screened = lambda bare, every, most, fitted=fitted: [fitted(*some) for some, _ in every]  # noqa: E731
        search = SimpleNamespace(screened=screened, judged=lambda bare, cases, null: cases, every=laws)
        cases = [fitted(law) for law in laws]
        left = equations._ahead(search, None, cases[:2], cases, None)  # type: ignore[arg-type]
        assert [case.keys for case in left] == [(key(laws[i].start),) for i in (1, 0)][:told]


def test_what_is_as_good_in_the_place_of_a_law_is_told():
    one, two, three = (catalogue[name] for name in ("linear_flow", "square_flow", "motor_gain"))
    a, b = (kind(strength=0.0, channel="a", reads=("a",)) for kind in (one, two))
    c, of = three.of(0.0, channel="u"), _case(1.0, 1, 0.9)
    sets = (a, c), (c, b), (b,), (a, b)
    cases = [of._replace(laws=tuple(Candidate(law, (), law) for law in laws)) for laws in sets]
    key = equations.key_of
    assert equations._in_place_of(key(a), cases[0], cases) == (key(b),)
    assert equations._in_place_of(key(c), cases[0], cases) == (key(b),)
    readings = Equations({}, json.dumps(PLANT | {"readings": {"y": "a", "z": "2*b"}}))
    bias = of._replace(laws=(Candidate(catalogue["sensor_bias"].of(0.0, channel="y"), (), c),))
    assert cases[0].places(readings) == {"a", "u"} and bias.places(readings) == {"y", "a"}
    law = catalogue["varying_parameter"](slope=0.0, middle=1.0, channel="k", reads=("u",))
    assert of._replace(laws=(Candidate(law, (), law),)).places(readings) == {"k", "u", "b", "a"}


def test_the_common_form_of_a_free_function_is_the_same_function():
    basis = np.random.default_rng(0).standard_normal((7, 25))
    term = UnknownTerm(jnp.arange(7.0), basis, np.zeros(2), np.full(2, 4.0), channel="b", reads=("b", "u"))
    form = term.lean(SYSTEM)
    np.testing.assert_allclose(_pushes(form), _pushes(term), rtol=1e-12)
    np.testing.assert_array_equal(numbered(term, form).weights, term.weights)


def test_the_table_of_an_unknown_term_has_its_values_and_their_spread():
    """Values are those of the function, the spread that of functions of drawn weights: four standard errors."""
    rng = np.random.default_rng(0)
    basis, half = rng.standard_normal((5, 25)), 0.1 * rng.standard_normal((5, 5))
    term = UnknownTerm(jnp.arange(5.0), basis, np.zeros(2), np.full(2, 4.0), channel="b", reads=("b", "u"))
    places, value, std = term.table(half @ half.T)
    assert places.shape == (81, 2)
    np.testing.assert_array_equal([places.min(axis=0), places.max(axis=0)], [[0.0] * 2, [4.0] * 2])
    at = np.asarray(jax.vmap(term.grid)(jnp.asarray(places))) @ basis.T
    np.testing.assert_allclose(value, at @ np.arange(5.0), rtol=1e-9, atol=1e-9)
    drawn = at @ half @ rng.standard_normal((5, 4000))
    np.testing.assert_allclose(std, np.std(drawn, axis=1), rtol=4 / np.sqrt(2 * 4000))


# --- with logs


def _rig(folder: Path, unknown: str = ""):
    return rig_of(folder, chain_rig('y = "b", z = "a"', unknown))


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    """The chain without the flow that acts in its log, as declared, and that log."""
    data = _logs(0.25, 160)
    return begin(_rig(tmp_path_factory.mktemp("chain")), data, key=jax.random.key(0)), data


def _logs(coupling: float, rows: int = 400, noise: float = 0.02):
    """Euler steps of a millisecond of the declared equations, and a flow in proportion to b^2 out of a."""
    rng, dt = np.random.default_rng(1), 0.5
    u = np.repeat(rng.uniform(0, 2, rows // 10 + 1), 10)[:rows]
    a, b, out = 1.0, 1.0, []
    for one in u:
        out.append((b, a))
        for _ in range(500):
            a, b = a + dt / 500 * (1.2 * one - a / 3.5 - coupling * b * b), b + dt / 500 * (a - b) / 2
    y = np.array(out) + noise * rng.standard_normal((rows, 2))
    return pad([(dt * np.arange(rows), u[:, None], y)])


def test_an_unknown_term_does_not_compete_with_the_parameters(chain):
    """The changes of the rates by its basis, along the motion, are orthogonal to those by the parameters."""
    model = chain[0].model
    seen = motion(model, chain[1])
    term = free_term(model.system, seen, ("k", "ta"), "a", ("a", "u"), seen.x.min(axis=0), seen.x.max(axis=0))
    values = jnp.asarray(np.stack([seen.x[:, 0], seen.u[:, 0]], axis=1))
    basis = np.asarray(jax.vmap(term.grid)(values)) @ np.asarray(term.basis).T
    slopes = np.stack([seen.u[:, 0], seen.x[:, 0] / 16.0], axis=1)  # of k u - a / ta at ta = 4
    size = np.linalg.norm(basis, axis=0)[:, None] * np.linalg.norm(slopes, axis=0)[None]
    assert np.abs(basis.T @ slopes / np.maximum(size, 1e-9)).max() < 1e-6
    assert term.weights.shape == (25 - 2,)


def test_a_declared_unknown_term_is_part_of_the_model(chain, tmp_path):
    rig = _rig(tmp_path, '[model.unknown]\nf = { signals = ["b"], enters = "a" }')
    fitted = begin(rig, chain[1], key=jax.random.key(0))
    (term,) = fitted.model.effects
    assert (term.channel, term.reads, term.label) == ("a", ("b",), "f")
    assert fitted.m_step.prior.names == ("k", "ta", "0.weights")
    one = dataclasses.replace(term, weights=jnp.ones_like(term.weights))
    moved = dataclasses.replace(fitted.model, effects=(one,))
    x, u = jnp.asarray([1.0, 1.0]), Inputs.held(jnp.asarray([1.0]))
    rate = lambda model: np.asarray(model.rate(x, u, jnp.zeros(2)))  # noqa: E731
    added = float(np.sum(np.asarray(term.basis) @ np.asarray(term.grid(x[1:]))))
    np.testing.assert_allclose(rate(moved) - rate(fitted.model), [added, 0.0], rtol=1e-9)
    (table,) = reported_terms(fitted)
    assert (table["name"], table["enters"], table["signals"], table["unit"]) == ("f", "a", {"b": "V"}, "V/s")
    assert len(table["value"]) == len(table["std"]) == 17 and min(table["std"]) > 0
    assert [ax.get_xlabel() + ax.get_ylabel() for ax in term_figure(table).axes] == ["b [V]f [V/s]"]


def _searched(before, data, end=math.inf):
    log = lambda text: None  # noqa: E731
    return search(by_simulation(before, data, log), Progress(declared(before)), before, log, end)


@pytest.mark.slow  # fast: test_a_search_that_fails_late_or_is_out_of_time_keeps_what_it_has
@pytest.mark.parametrize(("coupling", "names"), [(0.25, {("a", ("b",))}), (0.0, set())], ids=["planted", "nothing"])
def test_a_missing_flow_is_named_and_nothing_where_nothing_is_missing(tmp_path, coupling, names, monkeypatch):
    monkeypatch.setattr(equations, "PARTNERS", 4)  # 6 pairs in place of 120
    data = _logs(coupling)
    before = identify(_rig(tmp_path), data, key=jax.random.key(0))
    closed = _searched(before, data)
    assert {(effect.channel, effect.reads) for effect in closed.after.model.effects} == names


def test_a_search_that_fails_late_or_is_out_of_time_keeps_what_it_has(chain, monkeypatch):
    """Fits of sensors are singular, fits of two laws are out of time: the flow that was found first is reported."""
    (before, data), whole = chain, equations.simulated.fit_all
    monkeypatch.setattr(equations, "PARTNERS", 2)  # one pair in place of 120
    few = {name: catalogue[name] for name in ("square_flow", "sensor_bend")}
    monkeypatch.setattr(equations, "catalogue", few)

    def failing(models, *rest, **options):
        if len(models[0].effects) > 1:
            raise TimeUp
        if any(isinstance(effect, SensorEffect) for effect in models[0].effects):
            raise np.linalg.LinAlgError("Singular matrix")
        return whole(models, *rest, **options)

    monkeypatch.setattr(equations.simulated, "fit_all", failing)
    monkeypatch.setattr(equations, "free_functions", lambda *_: [])
    closed = _searched(before, data)
    assert [(effect.channel, effect.reads) for effect in closed.after.model.effects] == [("a", ("b",))]
    monkeypatch.setattr(equations.simulated, "fit_all", whole)
    late = _searched(before, data, end=0.0)
    assert (late.complete, late.after.model.effects, len(late.steps)) == (False, (), 1)


def test_of_two_laws_the_share_that_is_lost_without_each_decides(chain):
    """The flow b^2 out of a is in the log, another in proportion to b is not; a law of the declaration stays."""
    (before, data), hypothesis = chain, declared(chain[0])
    for name, strength in (("square_flow", -0.25), ("linear_flow", 0.001)):
        laws = catalogue[name].candidates(equations.around_of(before, data))
        law = next(c for c in laws if (c.start.channel, c.start.reads) == ("a", ("b",)))
        effect = dataclasses.replace(law.start, strength=jnp.asarray(strength))
        hypothesis = hypothesis.plus(effect, law, Evidence(share=0.5, candidate=law))
    square, linear = by_simulation(before, data, lambda text: None).lost(hypothesis)
    assert square > 0.5 and abs(linear) < 0.05
