"""Touches from outside: found where something pushed once, and nowhere else."""

import numpy as np

from nnap_em.explain.diagnosis.interventions import Intervention, disturbances
from nnap_em.explain.diagnosis.residual import Names, Residual
from nnap_em.output.report.diagnosis import _disturbance
from nnap_em.output.report.page import page

DT = 0.01
NAMES = Names(("x",), ("dx",), (False,), ("u",), (1,), ("x", "dx"))
LEAST = np.asarray([0.01])


def _left(law=lambda x, v: 0.0 * x, push=0.0, seed=0, sequences=5, rows=501, noise=0.3):
    """What is left of a swing that all recordings repeat, pushed once: 1.5 to 1.8 s of the third."""
    rng = np.random.default_rng(seed)
    t = np.tile(DT * np.arange(rows), (sequences, 1))
    phase = rng.uniform(0, 6, (sequences, 1))
    x, v = np.sin(2 * t + phase), 2 * np.cos(2 * t + phase)
    bump = np.where((t > 1.5) & (t < 1.8) & (np.arange(sequences)[:, None] == 2), push, 0.0)
    force = law(x, v) + bump + noise * rng.standard_normal(t.shape)
    force[:, -1] = np.nan
    state, one = np.stack([x, v], axis=-1), np.ones((sequences, rows, 2))
    valid = np.ones(t.shape, bool)
    u = np.sin(2 * t + phase)[..., None]
    forces = 2 * (force[..., None], one[..., :1])
    return Residual(0 * one, *forces, state, state, u, t, valid, valid.all(axis=1))


def test_a_push_is_found_with_its_time_sign_and_size():
    (disturbance,) = disturbances(_left(push=-1.0), NAMES, DT, LEAST)
    assert (disturbance.sequence, disturbance.joint, disturbance.unit) == (2, 1, "N")
    assert abs(disturbance.from_s - 1.5) < 0.1 and abs(disturbance.to_s - 1.8) < 0.1
    assert abs(disturbance.size + 1.0) < 0.3 and 0 < disturbance.std < 0.25
    (disturbance,) = disturbances(_left(lambda x, v: -1.0 * x, push=3.0), NAMES, DT, LEAST)  # beside a law
    assert disturbance.sequence == 2 and abs(disturbance.from_s - 1.5) < 0.1 and disturbance.size > 0


def test_what_all_recordings_repeat_and_one_that_differs_all_the_time_are_no_touch():
    """100 s of each: a false one in 300 s would be seen once in three runs, and none is."""
    bump, ends = lambda x, v: 3.0 * np.exp(-(((x - 0.6) / 0.15) ** 2)), lambda x, v: np.sign(v) * (np.abs(x) > 0.9)
    for seed in range(4):
        for law in (bump, ends):
            assert disturbances(_left(law, seed=seed), NAMES, DT, LEAST) == ()
    left = _left()
    force = left.force.copy()
    force[3] += 2.0
    assert disturbances(left._replace(force=force), NAMES, DT, LEAST) == ()


def test_padding_and_what_is_too_small_to_matter():
    left = _left(push=1.0)
    padded = [np.pad(a, [(0, 0), (0, 40), *[(0, 0)] * (a.ndim - 2)], constant_values=9.0) for a in left[:-2]]
    valid = np.pad(left.valid, [(0, 0), (0, 40)])
    assert disturbances(Residual(*padded, valid, left.used), NAMES, DT, LEAST) == disturbances(left, NAMES, DT, LEAST)
    assert disturbances(left, NAMES, DT, np.asarray([5.0])) == ()


def test_the_report_names_the_file():
    entry = _disturbance(Intervention(1, 1, 120, 150, 1.2, 1.5, -0.6, 0.1, "N m"), ("a.csv", "b.csv"))
    assert entry == {"file": "b.csv", "joint": 1, "from": 1.2, "to": 1.5, "size": -0.6, "std": 0.1, "unit": "N m"}
    text = page({"effects": [], "interventions": [entry]})
    assert all(word in text for word in ("External disturbances", "train/b.csv", "−0.60 ± 0.10 N m"))
