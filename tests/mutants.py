"""Places of the core broken on purpose, each with the test that must turn red.

`tests/test_mutants.py` runs some of them, `benchmarks/mutation.py` all.
"""

import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple

from shell import ENVIRONMENT, ROOT


class Mutant(NamedTuple):
    """One place."""

    what: str
    file: str
    """In the package."""
    text: str
    """There exactly once."""
    instead: str
    test: str
    """In tests/."""


ORACLE = "test_kalman.py::test_every_pattern_of_missing_readings"
SMOOTHER = "test_kalman.py::test_smoothers_equal_the_dense_joint_for_every_pattern_of_missing_readings[tangent]"
LAGRANGE = "test_systems.py::test_mass_and_bias_are_lagranges_equations[acrobot]"
POWER = "test_systems.py::test_energy_changes_by_the_work_of_the_input[slide]"
UNBIASED = "test_particle.py::test_likelihood_is_unbiased[guided]"
WEIGHED = "test_particle.py::test_weights_of_the_blind_filter_by_hand"
FISHER = "test_mstep.py::test_score_is_the_gradient_of_the_likelihood[slide]"
DENSE_FISHER = "test_mstep.py::test_information_is_the_dense_fisher_information"
RIDGE = "test_mstep.py::test_fit_of_parameters_alone_is_ridge_regression"
LEFT_OUT = "test_mstep.py::test_sequences_that_are_not_used_have_no_weight"

MUTANTS = (
    Mutant("sign of the Coriolis torque", "systems/arm.py", "gravity1 - h * v[1]", "gravity1 + h * v[1]", LAGRANGE),
    Mutant("sign of the centrifugal torque", "systems/arm.py", "gravity2 + h * v[0]", "gravity2 - h * v[0]", LAGRANGE),
    Mutant(
        "rotor not geared",
        "systems/arm.py",
        "rotor = self.gr**2 * self.Ir",
        "rotor = self.gr * self.Ir",
        LAGRANGE,
    ),
    Mutant(
        "gravity of the pendulum for the cosine",
        "systems/pendulum.py",
        "self.m * self.g * self.lc * sin(q)",
        "self.m * self.g * self.lc * cos(q)",
        LAGRANGE.replace("acrobot", "pendulum"),
    ),
    Mutant("sign of friction", "model.py", "total + torque", "total - torque", POWER),
    Mutant("sign of the input", "systems/base.py", "force[joint - 1] + u[i]", "force[joint - 1] - u[i]", POWER),
    Mutant(
        "sign of the Stribeck law",
        "law.py",
        "return -(level * jnp.tanh(v / self.smooth) + self.viscous * v)",
        "return level * jnp.tanh(v / self.smooth) + self.viscous * v",
        "test_law.py::test_law_limits_are_those_of_the_formula",
    ),
    Mutant(
        "a brake that pushes",
        "effects/rate.py",
        "-self.b * scene.v",
        "self.b * scene.v",
        "test_effects.py::test_brakes_never_add_energy[motor_back_emf]",
    ),
    Mutant(
        "weights of the Runge-Kutta stages",
        "ode.py",
        "[1.0, 2.0, 2.0, 1.0]",
        "[1.0, 2.0, 1.0, 2.0]",
        "test_ode.py::test_linear_system_is_the_taylor_series_to_fourth_order",
    ),
    Mutant(
        "a Runge-Kutta stage at the wrong place",
        "ode.py",
        "ahead = h * jnp.asarray([0.5, 0.5, 1.0, 0.0]",
        "ahead = h * jnp.asarray([0.5, 1.0, 1.0, 0.0]",
        "test_ode.py::test_linear_system_is_the_taylor_series_to_fourth_order",
    ),
    Mutant(
        "gain of the backward pass transposed",
        "kalman.py",
        "product(gain, later.mean - predicted.mean)",
        "product(gain.T, later.mean - predicted.mean)",
        ORACLE,
    ),
    Mutant("process noise left out", "kalman.py", "+ jnp.where(active, q, 0.0)", "+ 0.0 * q", ORACLE),
    Mutant(
        "input one row late",
        "kalman.py",
        "        u,\n        lambda state, u: linearise(model, state, u),",
        "        jnp.roll(u, 1, axis=0),\n        lambda state, u: linearise(model, state, u),",
        SMOOTHER,
    ),
    Mutant(
        "filtered covariance not kept symmetric",
        "kalman.py",
        "return Gaussian(mean, symmetric(cov)), jnp.stack(whitened)",
        "return Gaussian(mean, cov), jnp.stack(whitened)",
        "test_kalman.py::test_covariances_stay_symmetric_and_positive",
    ),
    Mutant(
        "smoothed covariance not kept symmetric",
        "kalman.py",
        "symmetric(state.cov + product(product(gain, later.cov - predicted.cov), gain.T))",
        "state.cov + product(product(gain, later.cov - predicted.cov), gain.T)",
        "test_kalman.py::test_covariances_stay_symmetric_and_positive",
    ),
    Mutant("standard deviation for a variance in R", "kalman.py", "jnp.exp(log_r)", "jnp.exp(0.5 * log_r)", ORACLE),
    Mutant(
        "innovation over its variance",
        "kalman.py",
        "e / jnp.sqrt(s), 0.0",
        "e / s, 0.0",
        "test_kalman.py::test_nile_has_the_published_likelihood",
    ),
    Mutant(
        "constant of the likelihood without the number of readings",
        "kalman.py",
        "count * math.log(2 * math.pi)",
        "math.log(2 * math.pi)",
        ORACLE,
    ),
    Mutant(
        "padding moves the state",
        "kalman.py",
        "jnp.where(active, a, b), affine",
        "a, affine",
        "test_kalman.py::test_padding_changes_no_digit",
    ),
    Mutant(
        "cubature points too near",
        "kalman.py",
        "reach = math.sqrt(len(rows))",
        "reach = 1.0",
        "test_kalman.py::test_cubature_has_the_slope_and_mean_of_a_polynomial",
    ),
    Mutant(
        "lag-one covariance: spread of the pair's first",
        "smoother.py",
        "left = cov - product(product(gain, cov_next), gain.T)",
        "left = cov",
        SMOOTHER,
    ),
    Mutant(
        "lag-one covariance: gain transposed",
        "smoother.py",
        "product(spread_next, gain.T)",
        "product(spread_next, gain)",
        SMOOTHER,
    ),
    Mutant(
        "what is behind the horizon is read",
        "smoother.py",
        "        observed = observed & seq.valid[:, None]\n        u, active",
        "        u, active",
        "test_kalman.py::test_rows_that_are_not_valid_are_not_read",
    ),
    Mutant(
        "prior of the start hypotheses left out",
        "smoother.py",
        "(starts) + log_weight",
        "(starts)",
        "test_kalman.py::test_likeliest_start_weighs_prior_and_readings",
    ),
    Mutant(
        "a missing reading taken for 0",
        "data.py",
        "observed = ~jnp.isnan(y)",
        "observed = jnp.ones_like(y, bool)",
        SMOOTHER,
    ),
    Mutant(
        "log weight of the readings missing",
        "particle.py",
        "log_w + log_g(state, u, y, observed) -",
        "log_w -",
        WEIGHED,
    ),
    Mutant("old log weight missing", "particle.py", "grown = log_w + log_g", "grown = log_g", WEIGHED),
    Mutant("proposal not weighed out", "particle.py", " - now.log_psi(x) + log_ahead", " + log_ahead", UNBIASED),
    Mutant(
        "weights kept when resampled",
        "particle.py",
        "for row in f], flat, ancestors",
        "for row in f], log_w, ancestors",
        WEIGHED,
    ),
    Mutant(
        "particles see the input one row late",
        "particle.py",
        "_cast((model, scale, model.inputs(seq), y), dtype)",
        "_cast((model, scale, jnp.roll(model.inputs(seq), 1, axis=0), y), dtype)",
        WEIGHED,
    ),
    Mutant(
        "backward weights not normalised",
        "particle.py",
        "target = uniform[0] * reach[-1]",
        "target = uniform[0]",
        "test_particle.py::test_backward_step_draws_from_its_law[ExactBackward(block=5)]",
    ),
    Mutant(
        "backward draws blind to the filter's weights",
        "particle.py",
        "(log_w - 0.5 * jnp.sum(f**2, axis=0))",
        "(-0.5 * jnp.sum(f**2, axis=0))",
        "test_particle.py::test_backward_step_draws_from_its_law[ExactBackward(block=5)]",
    ),
    Mutant(
        "every draw of the systematic resampling at its stratum's end",
        "particle.py",
        "(count / reach[-1]) - offset)",
        "(count / reach[-1]))",
        "test_particle.py::test_systematic_draws_are_unbiased",
    ),
    Mutant(
        "score of the process noise without its mean",
        "mstep.py",
        "jnp.mean(push**2, axis=0) - expected",
        "jnp.mean(push**2, axis=0)",
        FISHER,
    ),
    Mutant(
        "score of R by standard deviation",
        "mstep.py",
        "misfit / r[None] - 1.0",
        "misfit / jnp.sqrt(r)[None] - 1.0",
        FISHER,
    ),
    Mutant(
        "information blind to the filter", "mstep.py", "s = s - gain[i][:, None] * j[None, :]", "s = s", DENSE_FISHER
    ),
    Mutant("sequences that are left out count", "mstep.py", "a.ndim - 1)), a, 0.0)", "a.ndim - 1)), a, a)", LEFT_OUT),
    Mutant(
        "mean over sequences for their sum",
        "mstep.py",
        "jnp.sum(pick(a), axis=0), terms",
        "jnp.mean(pick(a), axis=0), terms",
        LEFT_OUT,
    ),
    Mutant(
        "M-step without its prior",
        "mstep.py",
        "- score) + precision * (w - middle)",
        "- score)",
        RIDGE,
    ),
    Mutant(
        "prior missing from the posterior precision",
        "mstep.py",
        "jac + jnp.diag(self.precision(w)), jac",
        "jac, jac",
        LEFT_OUT,
    ),
    Mutant(
        "error of an angle not wrapped",
        "predict.py",
        "error = (error + np.pi) % (2 * np.pi) - np.pi",
        "error = error % (2 * np.pi)",
        "test_predict.py::test_horizon_errors_are_plain_arithmetic",
    ),
    Mutant(
        "variance for a standard deviation in predicted kicks",
        "predict.py",
        "jnp.exp(0.5 * model.log_q)",
        "jnp.exp(model.log_q)",
        "test_predict.py::test_std_grows_as_the_kicks_add_up",
    ),
    Mutant(
        "nuisance not projected out of the score",
        "screen.py",
        "Projected(score[n:] - half.T @ left,",
        "Projected(score[n:],",
        "test_screen.py::test_projection_is_least_squares",
    ),
    Mutant(
        "nuisance not projected out of the information",
        "screen.py",
        "information[n:, n:] - half.T @ half",
        "information[n:, n:]",
        "test_screen.py::test_projection_is_least_squares",
    ),
    Mutant(
        "held-out gain on the sequences of the fit",
        "look.py",
        ".loglik[used & ~mask]",
        ".loglik[used & mask]",
        "test_loop.py::test_held_out_gain_counts_what_was_left_out_of_the_fit",
    ),
    Mutant(
        "solution without the diagonal",
        "gaussian.py",
        "s = s - row[m] * inverse[m] *",
        "s = s - row[m] *",
        "test_gaussian.py::test_spd_solve_is_numpys[4]",
    ),
)


class Outcome(NamedTuple):
    """What a run of pytest said."""

    passed: int
    failed: int
    asserted: bool
    """Whether every failure is that of an assertion; a program that cannot even run proves nothing."""
    said: str


def copy(folder: Path, mutant: Mutant | None = None) -> Path:
    """The package and its tests in `folder`, changed in one place."""
    for part in ("nnap_em", "tests", "examples", "benchmarks"):
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    (ROOT / ".cache").mkdir(exist_ok=True)
    (folder / ".cache").symlink_to(ROOT / ".cache")  # compiled programs
    if mutant is not None:
        path = folder / "nnap_em" / mutant.file
        text = path.read_text()
        assert text.count(mutant.text) == 1, f"{mutant.file} has {text.count(mutant.text)} times {mutant.text!r}"
        path.write_text(text.replace(mutant.text, mutant.instead))
    return folder


def run(folder: Path, *tests: str) -> Outcome:
    """Some tests of a copy, in a process of their own."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist"]
    command += ["--junitxml", str(folder / "found.xml"), *(str(folder / "tests" / test) for test in tests)]
    environment = ENVIRONMENT | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    environment = {k: v for k, v in environment.items() if not k.startswith("PYTEST_")}
    found = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=570)
    said = found.stdout + found.stderr
    if not (folder / "found.xml").exists():
        return Outcome(0, 0, False, said)
    suite = next(ElementTree.parse(folder / "found.xml").iter("testsuite"))
    count = {name: int(suite.attrib[name]) for name in ("tests", "failures", "errors", "skipped")}
    failures = [node.attrib["message"] for node in suite.iter("failure")]
    asserted = bool(failures) and all(m.lstrip().startswith(("AssertionError", "assert ")) for m in failures)
    passed = count["tests"] - count["failures"] - count["errors"] - count["skipped"]
    return Outcome(passed, count["failures"], asserted and not count["errors"], said)
