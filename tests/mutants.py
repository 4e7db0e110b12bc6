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
MACHINES = "test_machines.py::test_"
SENSORS = "test_sensors.py::test_"
BRANCH = f"{MACHINES}mass_and_bias_are_those_of_mujoco[branch.xml]"
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
    Mutant(
        "prior counted with every run",
        "diagnose/pooling.py",
        "1 / std**2 - shared,",
        "1 / std**2,",
        "test_compare.py::test_a_prior_that_all_runs_share_counts_once",
    ),
    Mutant(
        "spread between runs at twice its size",
        "diagnose/pooling.py",
        "- (len(value) - 1)",
        "+ (len(value) - 1)",
        "test_compare.py::test_between_two_runs_the_spread_has_a_closed_form",
    ),
    Mutant(
        "contrasts that only the network knows are tested",
        "diagnose/pooling.py",
        "variance >= LEAST_VARIANCE",
        "variance >= 0.0",
        "test_compare.py::test_contrasts_that_only_the_network_knows_are_left_out",
    ),
    Mutant(
        "changes that are not corrected for their number",
        "diagnose/compare.py",
        "test._replace(p_value=float(value)) for test, value",
        "test._replace(p_value=test.p_alone) for test, value",
        "test_compare.py::test_alarms_are_as_frequent_as_the_level_says",
    ),
    Mutant("sign of friction", "model/hooks.py", "known + torque", "known - torque", POWER),
    Mutant("sign of the input", "systems/base.py", "force[joint - 1] + u[i]", "force[joint - 1] - u[i]", POWER),
    Mutant(
        "sign of the Stribeck law",
        "model/law.py",
        "return -(level * jnp.tanh(v / self.smooth) + self.viscous * v)",
        "return level * jnp.tanh(v / self.smooth) + self.viscous * v",
        "test_law.py::test_law_limits_are_those_of_the_formula",
    ),
    Mutant(
        "a brake that pushes",
        "effects/rate.py",
        "-self.b * self.own(scene.v)",
        "self.b * self.own(scene.v)",
        "test_effects.py::test_brakes_never_add_energy[motor_back_emf]",
    ),
    Mutant(
        "rows of a block left out",
        "numerics/rows.py",
        "reshape(count * size, *a.shape[2:])[:length]",
        "reshape(count * size, *a.shape[2:])[-length:]",
        "test_rows.py::test_rows_in_blocks_are_the_rows_all_at_once",
    ),
    Mutant(
        "a kept program whatever the package says now",
        "numerics/traced.py",
        "hashlib.sha256(_surroundings() + text.getvalue())",
        "hashlib.sha256(text.getvalue())",
        "test_traced.py::test_another_text_of_the_package_makes_another",
    ),
    Mutant(
        "a kept program whatever it was made of",
        "numerics/traced.py",
        "for a in arrays], static))",
        "for a in arrays]))",
        "test_traced.py::test_what_decides_a_program_makes_another[constant]",
    ),
    Mutant(
        "what has no name is believed for most of the share",
        "diagnose/accept.py",
        "screened.candidate.start.named and worth < self.least",
        "screened.candidate.start.named and worth < self.near * self.least",
        "test_accept.py::test_what_has_no_name_is_worth_the_whole_share_after_its_refit",
    ),
    Mutant(
        "weights of the Runge-Kutta stages",
        "numerics/ode.py",
        "[1.0, 2.0, 2.0, 1.0]",
        "[1.0, 2.0, 1.0, 2.0]",
        "test_ode.py::test_linear_system_is_the_taylor_series_to_fourth_order",
    ),
    Mutant(
        "a Runge-Kutta stage at the wrong place",
        "numerics/ode.py",
        "ahead = h * jnp.asarray([0.5, 0.5, 1.0, 0.0]",
        "ahead = h * jnp.asarray([0.5, 1.0, 1.0, 0.0]",
        "test_ode.py::test_linear_system_is_the_taylor_series_to_fourth_order",
    ),
    Mutant(
        "gain of the backward pass transposed",
        "smoother/kalman.py",
        "product(gain, later.mean - predicted.mean)",
        "product(gain.T, later.mean - predicted.mean)",
        ORACLE,
    ),
    Mutant("process noise left out", "smoother/kalman.py", "+ jnp.where(active, q, 0.0)", "+ 0.0 * q", ORACLE),
    Mutant(
        "input one row late",
        "smoother/kalman.py",
        "        seq.inputs,\n        lambda state, u: linearise(model, state, u),",
        "        jnp.roll(seq.inputs, 1, axis=0),\n        lambda state, u: linearise(model, state, u),",
        SMOOTHER,
    ),
    Mutant(
        "filtered covariance not kept symmetric",
        "smoother/kalman.py",
        "return Gaussian(mean, symmetric(cov)), jnp.stack(whitened)",
        "return Gaussian(mean, cov), jnp.stack(whitened)",
        "test_kalman.py::test_covariances_stay_symmetric_and_positive",
    ),
    Mutant(
        "smoothed covariance not kept symmetric",
        "smoother/kalman.py",
        "symmetric(state.cov + product(product(gain, later.cov - predicted.cov), gain.T))",
        "state.cov + product(product(gain, later.cov - predicted.cov), gain.T)",
        "test_kalman.py::test_covariances_stay_symmetric_and_positive",
    ),
    Mutant(
        "standard deviation for a variance in R", "smoother/kalman.py", "jnp.exp(log_r)", "jnp.exp(0.5 * log_r)", ORACLE
    ),
    Mutant(
        "innovation over its variance",
        "smoother/kalman.py",
        "e / jnp.sqrt(s), 0.0",
        "e / s, 0.0",
        "test_kalman.py::test_nile_has_the_published_likelihood",
    ),
    Mutant(
        "constant of the likelihood without the number of readings",
        "smoother/kalman.py",
        "count * math.log(2 * math.pi)",
        "math.log(2 * math.pi)",
        ORACLE,
    ),
    Mutant(
        "padding moves the state",
        "smoother/kalman.py",
        "jnp.where(active, a, b), affine",
        "a, affine",
        "test_kalman.py::test_padding_changes_no_digit",
    ),
    Mutant(
        "cubature points too near",
        "smoother/kalman.py",
        "reach = math.sqrt(len(rows))",
        "reach = 1.0",
        "test_kalman.py::test_cubature_has_the_slope_and_mean_of_a_polynomial",
    ),
    Mutant(
        "lag-one covariance: spread of the pair's first",
        "smoother/gaussian.py",
        "left = cov - product(product(gain, cov_next), gain.T)",
        "left = cov",
        SMOOTHER,
    ),
    Mutant(
        "lag-one covariance: gain transposed",
        "smoother/gaussian.py",
        "product(spread_next, gain.T)",
        "product(spread_next, gain)",
        SMOOTHER,
    ),
    Mutant(
        "what is behind the horizon is read",
        "model/base.py",
        "observed & seq.valid[:, None]",
        "observed",
        "test_kalman.py::test_rows_that_are_not_valid_are_not_read",
    ),
    Mutant(
        "prior of the start hypotheses left out",
        "smoother/gaussian.py",
        "loglik(starts) + log_weight",
        "loglik(starts)",
        "test_kalman.py::test_likeliest_start_weighs_prior_and_readings",
    ),
    Mutant(
        "a missing reading taken for 0",
        "data/dataset.py",
        "observed = ~jnp.isnan(y)",
        "observed = jnp.ones_like(y, bool)",
        SMOOTHER,
    ),
    Mutant(
        "log weight of the readings missing",
        "smoother/particle/filter.py",
        "log_w + log_g(state, u, y, observed) -",
        "log_w -",
        WEIGHED,
    ),
    Mutant("old log weight missing", "smoother/particle/filter.py", "grown = log_w + log_g", "grown = log_g", WEIGHED),
    Mutant(
        "proposal not weighed out",
        "smoother/particle/filter.py",
        " - now.log_psi(x) + log_ahead",
        " + log_ahead",
        UNBIASED,
    ),
    Mutant(
        "weights kept when resampled",
        "smoother/particle/filter.py",
        "for row in f], flat, ancestors",
        "for row in f], log_w, ancestors",
        WEIGHED,
    ),
    Mutant(
        "particles see the input one row late",
        "smoother/particle/filter.py",
        "_cast((model, scale, seq.inputs, seq.y), dtype)",
        "_cast((model, scale, jnp.roll(seq.inputs, 1, axis=0), seq.y), dtype)",
        WEIGHED,
    ),
    Mutant(
        "backward weights not normalised",
        "smoother/particle/backward.py",
        "target = uniform[0] * reach[-1]",
        "target = uniform[0]",
        "test_particle.py::test_backward_step_draws_from_its_law[ExactBackward(block=5)]",
    ),
    Mutant(
        "backward draws blind to the filter's weights",
        "smoother/particle/backward.py",
        "(log_w - 0.5 * jnp.sum(f**2, axis=0))",
        "(-0.5 * jnp.sum(f**2, axis=0))",
        "test_particle.py::test_backward_step_draws_from_its_law[ExactBackward(block=5)]",
    ),
    Mutant(
        "every draw of the systematic resampling at its stratum's end",
        "smoother/particle/resampling.py",
        "(count / reach[-1]) - offset)",
        "(count / reach[-1]))",
        "test_particle.py::test_systematic_draws_are_unbiased",
    ),
    Mutant(
        "score of the process noise without its mean",
        "em/quadratic.py",
        "jnp.mean(push**2, axis=0) - expected",
        "jnp.mean(push**2, axis=0)",
        FISHER,
    ),
    Mutant(
        "score of R by standard deviation",
        "em/quadratic.py",
        "misfit / r[None] - 1.0",
        "misfit / jnp.sqrt(r)[None] - 1.0",
        FISHER,
    ),
    Mutant(
        "information blind to the filter",
        "em/quadratic.py",
        "s = s - gain[i][:, None] * j[None, :]",
        "s = s",
        DENSE_FISHER,
    ),
    Mutant(
        "sequences that are left out count", "em/mstep.py", "a.ndim - 1)), a, 0.0)", "a.ndim - 1)), a, a)", LEFT_OUT
    ),
    Mutant(
        "mean over sequences for their sum",
        "em/mstep.py",
        "jnp.sum(pick(a), axis=0), terms",
        "jnp.mean(pick(a), axis=0), terms",
        LEFT_OUT,
    ),
    Mutant(
        "M-step without its prior",
        "em/weights.py",
        "- score) + precision * (w - middle)",
        "- score)",
        RIDGE,
    ),
    Mutant(
        "prior missing from the posterior precision",
        "em/weights.py",
        "jac + jnp.diag(self.precision(w)), jac",
        "jac, jac",
        LEFT_OUT,
    ),
    Mutant(
        "error of an angle not wrapped",
        "em/predict.py",
        "error = (error + np.pi) % (2 * np.pi) - np.pi",
        "error = error % (2 * np.pi)",
        "test_predict.py::test_horizon_errors_are_plain_arithmetic",
    ),
    Mutant(
        "variance for a standard deviation in predicted kicks",
        "em/predict.py",
        "jnp.exp(0.5 * model.log_q)",
        "jnp.exp(model.log_q)",
        "test_predict.py::test_std_grows_as_the_kicks_add_up",
    ),
    Mutant(
        "nuisance not projected out of the score",
        "diagnose/screen.py",
        "Projected(score[n:] - half.T @ left,",
        "Projected(score[n:],",
        "test_screen.py::test_projection_is_least_squares",
    ),
    Mutant(
        "nuisance not projected out of the information",
        "diagnose/screen.py",
        "information[n:, n:] - half.T @ half",
        "information[n:, n:]",
        "test_screen.py::test_projection_is_least_squares",
    ),
    Mutant(
        "held-out gain on the sequences of the fit",
        "diagnose/case.py",
        ".loglik[used & ~mask]",
        ".loglik[used & mask]",
        "test_loop.py::test_held_out_gain_counts_what_was_left_out_of_the_fit",
    ),
    Mutant(
        "solution without the diagonal",
        "numerics/gaussian.py",
        "s = s - row[m] * inverse[m] *",
        "s = s - row[m] *",
        "test_gaussian.py::test_spd_solve_is_numpys[4]",
    ),
    Mutant(
        "a recording may be harmed by any share",
        "diagnose/accept.py",
        "min(folds) > -self.harm",
        "min(folds) < self.harm",
        "test_accept.py::test_a_share_is_the_smaller_one_where_recordings_agree",
    ),
    Mutant(
        "the larger of two shares",
        "diagnose/evidence.py",
        "return min(self.inside, self.left_out)",
        "return max(self.inside, self.left_out)",
        "test_accept.py::test_a_share_is_the_smaller_one_where_recordings_agree",
    ),
    Mutant(
        "a bar that readings lower",
        "diagnose/accept.py",
        "return max(self.margin, self.matters * readings)",
        "return min(self.margin, self.matters * readings)",
        "test_accept.py::test_one_step_likelihood_is_paid_for_and_certain",
    ),
    Mutant(
        "less needed on what is left out",
        "diagnose/accept.py",
        "needed = max(0.5",
        "needed = min(0.5",
        "test_accept.py::test_a_third_of_the_gain_is_seen_on_what_is_left_out",
    ),
    Mutant(
        "a refit that raises the error",
        "diagnose/accept.py",
        "gone = 1.0 - error",
        "gone = abs(1.0 - error)",
        "test_accept.py::test_a_refit_keeps_what_the_share_promised",
    ),
    Mutant(
        "what halves the error anywhere is believed at once",
        "diagnose/accept.py",
        "return self._falls(evidence.soon, self.least)",
        "return self._falls(min(evidence.soon, evidence.error), self.least)",
        "test_accept.py::test_where_a_machine_forgets_half_of_the_error_must_go_at_once",
    ),
    Mutant(
        "a fit that predicts worse is kept",
        "diagnose/grow.py",
        "loop.data, one & other) <= 1:",
        "loop.data, one & other) >= 1:",
        "test_search.py::test_a_fit_that_predicts_worse_than_what_it_began_from_is_not_kept",
    ),
    Mutant(
        "the least likely of even laws is first",
        "diagnose/look.py",
        "sorted(even, key=net, reverse=True)",
        "sorted(even, key=net)",
        "test_search.py::test_the_likeliest_of_those_that_shares_cannot_tell_is_first",
    ),
    Mutant(
        "a quiet law is refitted beyond the shares",
        "diagnose/accept.py",
        "return promise > self.loud",
        "return promise > 0",
        "test_accept.py::test_only_named_laws_that_shout_are_looked_at_beyond_the_shares",
    ),
    Mutant(
        "worth of more than was seen on what is left out",
        "diagnose/accept.py",
        "* min(1.0, share.left_out",
        "* max(1.0, share.left_out",
        "test_accept.py::test_the_worth_of_a_refit_is_what_it_removes_as_far_as_that_was_seen_on_what_is_left_out",
    ),
    Mutant(
        "rivals that explain less cannot be told",
        "diagnose/accept.py",
        "return self.worth(rival) > self.level",
        "return self.worth(rival) < self.level",
        "test_accept.py::test_a_rival_that_is_as_good_cannot_be_told",
    ),
    Mutant(
        "the larger horizon decides a ratio of errors",
        "em/multistep.py",
        "np.mean(second[first > 0] / first[first > 0])",
        "np.sum(second) / np.sum(first)",
        "test_forks.py::test_a_ratio_of_errors_is_that_of_the_sequences_used",
    ),
    Mutant(
        "held-out folds that overlap",
        "diagnose/case.py",
        "mask[index[fold::folds]] = False",
        "mask[index[fold:]] = False",
        "test_loop.py::test_held_out_gain_counts_what_was_left_out_of_the_fit",
    ),
    Mutant(
        "trimmed sum not rescaled",
        "diagnose/case.py",
        "cut : gain.size - cut]) * gain.size)",
        "cut : gain.size - cut]) * (gain.size - 2 * cut))",
        "test_search.py::test_a_sixth_is_trimmed_at_either_end",
    ),
    Mutant(
        "gains trimmed at the lower end only",
        "diagnose/case.py",
        "np.mean(gain[cut : gain.size - cut])",
        "np.mean(gain[cut:])",
        "test_search.py::test_a_sixth_is_trimmed_at_either_end",
    ),
    Mutant(
        "Wald without the prior's scale",
        "diagnose/case.py",
        "[here, here] * np.outer(std, std))",
        "[here, here])",
        "test_search.py::test_certainty_is_the_marginal_of_the_posterior",
    ),
    Mutant(
        "parameters of an effect looked for among those of the machine",
        "diagnose/hypothesis.py",
        "np.cumsum(sizes) + m_step.prior.size - sum(sizes)",
        "np.cumsum(sizes)",
        "test_search.py::test_certainty_is_the_marginal_of_the_posterior",
    ),
    Mutant(
        "the next effect dropped",
        "diagnose/hypothesis.py",
        "enumerate(self.additions) if i != place",
        "enumerate(self.additions) if i != place + 1",
        "test_search.py::test_one_of_three_effects_goes_with_its_prior_and_its_reason",
    ),
    Mutant(
        "the weakest of a kind stands for it",
        "diagnose/look.py",
        "best[key][0] < promise",
        "best[key][0] > promise",
        "test_search.py::test_the_best_of_every_kind_stands_for_it",
    ),
    Mutant(
        "a free law refitted that promises less",
        "diagnose/look.py",
        "not law(entry).named and entry[0] > top]",
        "not law(entry).named and entry[0] < top]",
        "test_search.py::test_the_close_ones_are_refitted_and_a_free_law_that_promises_more",
    ),
    Mutant(
        "a named law preferred only where it is far worse",
        "diagnose/look.py",
        "rule.worth(named[0]) > rule.near *",
        "rule.worth(named[0]) < rule.near *",
        "test_search.py::test_a_law_with_a_name_is_preferred_where_it_is_nearly_as_good",
    ),
    Mutant(
        "rest of a law at another joint",
        "diagnose/keys.py",
        "own == its and one.joint == other.joint",
        "own == its",
        "test_search.py::test_a_rest_belongs_to_the_law_of_the_same_signals_at_its_joint",
    ),
    Mutant(
        "a law takes the place of its like",
        "diagnose/keys.py",
        "jax.tree.structure(model.effects[i]) != jax.tree",
        "jax.tree.structure(model.effects[i]) == jax.tree",
        "test_look.py::test_a_function_of_each_turn_and_one_of_all_turns_are_rivals",
    ),
    Mutant(
        "a fit starts without what the screen says",
        "diagnose/propose.py",
        "float(c) * (p - start)",
        "(p - start)",
        "test_search.py::test_a_fit_starts_where_the_screen_puts_a_linear_law_and_at_the_probe_of_another",
    ),
    Mutant(
        "the most needed effect is tried without",
        "diagnose/undo.py",
        "least = int(np.argmin(losses))",
        "least = int(np.argmax(losses))",
        "test_search.py::test_the_least_needed_goes_where_a_fit_without_it_loses_nothing",
    ),
    Mutant(
        "the first law goes for the last",
        "diagnose/undo.py",
        "now.without(len(now.found) - 1)",
        "now.without(0)",
        "test_search.py::test_what_is_not_worth_it_over_the_whole_length_goes_from_the_last_on",
    ),
    Mutant(
        "the fit that is behind wins",
        "diagnose/grow.py",
        "np.nan_to_num(a.top, nan=-1e3) - np.nan_to_num(b.top, nan=-1e3)",
        "np.nan_to_num(b.top, nan=-1e3) - np.nan_to_num(a.top, nan=-1e3)",
        "test_search.py::test_one_fit_is_ahead_of_another_by_what_it_is_likelier",
    ),
    Mutant(
        "added unless believed",
        "diagnose/loop.py",
        "if verdict.believed:\n            return case",
        "if not verdict.believed:\n            return case",
        "test_search.py::test_only_what_the_rule_believes_is_added",
    ),
    Mutant(
        "likelihood believed where innovations are not white",
        "diagnose/loop.py",
        "if white_innovations(outcome.after, data):",
        "if not white_innovations(outcome.after, data):",
        "test_search.py::test_likelihood_is_believed_where_noise_is_what_the_model_says",
    ),
    Mutant(
        "programs let go below the bound",
        "numerics/programs.py",
        "if maps() <= most:",
        "if maps() > most:",
        "test_programs.py::test_programs_are_let_go_beyond_the_bound",
    ),
    Mutant(
        "folds interleaved",
        "diagnose/shares.py",
        "(order * min(FOLDS, count) // count)[:, None]",
        "(order % min(FOLDS, count))[:, None]",
        "test_forks.py::test_folds_are_neighbours_and_pieces_where_there_are_few",
    ),
    Mutant(
        "strengths fitted to the fold that judges them",
        "diagnose/shares.py",
        "fitted(gram - own, score - its)[0]",
        "fitted(gram, score)[0]",
        "test_forks.py::test_shares_are_those_of_least_squares",
    ),
    Mutant(
        "directions of a share cost nothing",
        "diagnose/shares.py",
        "(count - 1) / (count - directions - 1)",
        "(count - 1) / (count - 1)",
        "test_forks.py::test_shares_are_those_of_least_squares",
    ),
    Mutant(
        "rows that overlap count as many",
        "diagnose/shares.py",
        "max(len(e) / rows.overlap, directions + 2)",
        "max(len(e), directions + 2)",
        "test_forks.py::test_rows_that_overlap_count_for_less",
    ),
    Mutant(
        "prior of friction on its size",
        "em/shape.py",
        "(np.eye(count) - basis @ basis.T) /",
        "np.eye(count) /",
        "test_forks.py::test_friction_is_free_in_the_span_of_known_laws",
    ),
    Mutant(
        "prior of friction on its change",
        "diagnose/shares.py",
        "solve(nuisance.T @ error - pull)",
        "solve(nuisance.T @ error)",
        "test_forks.py::test_the_nuisance_is_projected_out_by_ridge_regression",
    ),
    Mutant(
        "nuisance not projected out of multi-step columns",
        "diagnose/shares.py",
        "rest = own - nuisance @ solve(nuisance.T @ own)",
        "rest = own",
        "test_forks.py::test_the_nuisance_is_projected_out_by_ridge_regression",
    ),
    Mutant(
        "robust weight not applied",
        "em/multistep.py",
        "np.where(sound, size / scale**2",
        "np.where(sound, 1 / scale**2",
        "test_forks.py::test_weights_are_one_over_the_variance_and_less_for_outliers",
    ),
    Mutant(
        "loud recordings decide alone",
        "em/multistep.py",
        "np.sqrt(whole * own)",
        "np.sqrt(whole * whole)",
        "test_forks.py::test_a_loud_recording_counts_by_the_root_of_its_loudness",
    ),
    Mutant(
        "weights of sequences that are not used",
        "em/multistep.py",
        "error = np.where(used[:, None, None, None], found.error, np.nan)",
        "error = found.error",
        "test_forks.py::test_weights_are_one_over_the_variance_and_less_for_outliers",
    ),
    Mutant(
        "ratio of errors counts unused sequences",
        "em/multistep.py",
        "before, after = before[used], after[used]",
        "before, after = before, after",
        "test_forks.py::test_a_ratio_of_errors_is_that_of_the_sequences_used",
    ),
    Mutant(
        "what runs away counts as no error",
        "em/multistep.py",
        "np.where(np.isfinite(after), after, np.inf)",
        "np.where(np.isfinite(after), after, 0.0)",
        "test_forks.py::test_a_ratio_of_errors_is_that_of_the_sequences_used",
    ),
    Mutant(
        "finish takes steps that raise the error",
        "em/multistep.py",
        "there, used) < 1 - FALLS:",
        "there, used) > 1 - FALLS:",
        "test_fit.py::test_a_gauss_newton_step_is_halved_until_the_errors_fall",
    ),
    Mutant(
        "finish takes no shorter steps",
        "em/multistep.py",
        "for share in (1.0, 0.5, 0.25):",
        "for share in (1.0,):",
        "test_fit.py::test_a_gauss_newton_step_is_halved_until_the_errors_fall",
    ),
    Mutant(
        "EM accepts a worse model",
        "em/loop.py",
        "np.nanmean(loglik - state.top) >= -0.5",
        "np.nanmean(loglik - state.top) <= 0.5",
        "test_fit.py::test_a_worse_model_is_refused_and_the_way_from_the_best_is_shorter",
    ),
    Mutant(
        "stride not shortened on retreat",
        "em/loop.py",
        "stride=state.stride / 3)",
        "stride=state.stride)",
        "test_fit.py::test_a_worse_model_is_refused_and_the_way_from_the_best_is_shorter",
    ),
    Mutant(
        "retreat to the model that was refused",
        "em/loop.py",
        "between(state.best, state.proposal, state.stride)",
        "between(state.model, state.proposal, state.stride)",
        "test_fit.py::test_a_worse_model_is_refused_and_the_way_from_the_best_is_shorter",
    ),
    Mutant(
        "lost sequences judge the next model",
        "em/loop.py",
        "top = np.where(used, loglik, np.nan)",
        "top = loglik",
        "test_fit.py::test_a_sequence_that_was_left_out_refuses_nothing",
    ),
    Mutant(
        "horizon grows every epoch",
        "em/loop.py",
        "max(0, (epoch - 1) // self.hold)",
        "max(0, epoch - 1)",
        "test_fit.py::test_a_horizon_is_held_and_grows",
    ),
    Mutant(
        "EM rests where one epoch moved little",
        "em/loop.py",
        "np.diff(state.loglik[-3:])",
        "np.diff(state.loglik[-2:])",
        "test_fit.py::test_em_rests_where_nothing_moves",
    ),
    Mutant(
        "the least likely process noise to begin with",
        "em/loop.py",
        "trials[int(np.argmax(logliks))]",
        "trials[int(np.argmin(logliks))]",
        "test_fit.py::test_the_likeliest_process_noise_is_where_it_begins",
    ),
    Mutant(
        "multi-step fit to the sequences that judge it",
        "em/identify.py",
        "used & (part != out)",
        "used",
        "test_fit.py::test_a_finish_that_only_the_fitted_sequences_like_is_left_alone",
    ),
    Mutant(
        "multi-step fit judged on its own sequences",
        "em/identify.py",
        "part == out)",
        "part != out)",
        "test_fit.py::test_a_finish_that_only_the_fitted_sequences_like_is_left_alone",
    ),
    Mutant(
        "the tight try kept whatever is likelier",
        "em/loop.py",
        "best = likeliest(jnp.stack([posterior.loglik for posterior in tries]))",
        "best = 0 * likeliest(jnp.stack([posterior.loglik for posterior in tries]))",
        "test_kalman.py::test_loosened_passes_one_by_one_give_what_they_give_together",
    ),
    Mutant(
        "columns of a stack in the wrong places",
        "diagnose/columns.py",
        "whole[:, stack.places] =",
        "whole[:, stack.places[::-1]] =",
        "test_forks.py::test_a_probe_gives_the_same_column_beside_all_others_as_alone",
    ),
    Mutant(
        "all readings must be white",
        "em/noise.py",
        "return min((third_differences",
        "return max((third_differences",
        "test_forks.py::test_one_white_reading_is_enough",
    ),
    Mutant(
        "second differences for third",
        "em/noise.py",
        "np.diff(np.asarray(y, float), 3, axis=1)",
        "np.diff(np.asarray(y, float), 2, axis=1)",
        "test_forks.py::test_white_noise_is_told_from_a_filtered_sensor",
    ),
    Mutant(
        "a refit keeps its last model",
        "diagnose/refit.py",
        "_, core, loglik, hessian, path = best",
        "_, _, loglik, hessian, path = best",
        "test_fit.py::test_a_refit_goes_back_a_third_of_the_way_and_keeps_the_best",
    ),
    Mutant(
        "a refit judged on sequences that are not used",
        "diagnose/refit.py",
        "nan=-1e6)[used])",
        "nan=-1e6))",
        "test_fit.py::test_a_refit_goes_back_a_third_of_the_way_and_keeps_the_best",
    ),
    Mutant(
        "stride of a refit not shortened",
        "diagnose/refit.py",
        "stride, path = stride / 3, best[4]",
        "stride, path = stride, best[4]",
        "test_fit.py::test_a_refit_goes_back_a_third_of_the_way_and_keeps_the_best",
    ),
    Mutant(
        "noise moves in held-out refits",
        "diagnose/refit.py",
        "m_step if noise and count",
        "m_step if count",
        "test_fit.py::test_a_refit_without_noise_gives_the_m_step_no_room_for_it",
    ),
    Mutant(
        "noise of a refit not held",
        "diagnose/refit.py",
        "count >= HELD",
        "count >= 0",
        "test_fit.py::test_a_refit_without_noise_gives_the_m_step_no_room_for_it",
    ),
    Mutant(
        "a law judged on the motions of its fit",
        "diagnose/case.py",
        "(self.question.used & half, self.question.used & ~half)",
        "(self.question.used & half, self.question.used)",
        "test_search.py::test_an_effect_is_seen_on_either_half_after_a_fit_to_the_other",
    ),
    Mutant(
        "halves that share motions",
        "diagnose/evidence.py",
        "order[i::2]",
        "order[i:]",
        "test_search.py::test_halves_share_no_motion",
    ),
    Mutant(
        "a law believed by the error inside",
        "diagnose/accept.py",
        "self._falls(evidence.unseen",
        "self._falls(evidence.error",
        "test_accept.py::test_what_the_refit_gains_has_to_be_there_on_motions_that_it_left_out",
    ),
    Mutant(
        "curvature of the weights before the finish",
        "em/identify.py",
        "hessian=info.hessian)",
        "hessian=fitted.state.hessian)",
        "test_fit.py::test_a_finish_that_helps_what_is_left_out_is_done_on_all",
    ),
    Mutant(
        "a posterior wider than its prior",
        "em/stated.py",
        "prior + half @ np.linalg",
        "half @ np.linalg",
        "test_fit.py::test_recordings_that_disagree_and_forces_unsaid_widen_a_posterior_but_not_its_prior",
    ),
    Mutant(
        "forces unsaid larger than the errors tell",
        "em/stated.py",
        "noise = np.maximum(whole -",
        "noise = np.maximum(whole - 0 *",
        "test_fit.py::test_the_size_of_forces_unsaid_is_that_which_made_the_errors",
    ),
    Mutant(
        "shape of friction pushed away from",
        "em/multistep.py",
        "score.at[nodes].add(-pull[nodes])",
        "score.at[nodes].add(pull[nodes])",
        "test_fit.py::test_a_shaped_finish_adds_the_prior_of_friction_and_nothing_to_parameters",
    ),
    Mutant(
        "innovations not masked",
        "residual/residual.py",
        "jnp.where(prepared.observed, filtered.innovation, jnp.nan)",
        "filtered.innovation",
        "test_residual.py::test_there_is_an_innovation_where_there_is_a_reading",
    ),
    Mutant(
        "Bonferroni for Holm",
        "residual/statistics.py",
        "(values.size - np.arange(values.size)) * values[order]",
        "values.size * values[order]",
        "test_residual.py::test_holm_by_hand",
    ),
    Mutant(
        "lost sequences take part in the tests",
        "residual/residual.py",
        "part[self.used] for part in self",
        "part for part in self",
        "test_residual.py::test_lost_sequences_take_no_part",
    ),
    Mutant(
        "autocovariance not over that of lag 0",
        "residual/statistics.py",
        "np.maximum(pairs, 1.0) * (pairs[0] / sums[0]), pairs",
        "np.maximum(pairs, 1.0), pairs",
        "test_residual.py::test_autoregression_fails_and_its_coefficient_is_the_size",
    ),
    Mutant(
        "score test without its half",
        "diagnose/screen.py",
        "gain = float(0.5 * np.sum",
        "gain = float(np.sum",
        "test_screen.py::test_projection_is_least_squares",
    ),
    Mutant(
        "a design that forgets the limit of torque",
        "design/signals.py",
        "np.minimum(limits.high, rest + left)",
        "rest + left + limits.high",
        "test_design.py::test_inputs_keep_to_torque_and_its_change[Chirp]",
    ),
    Mutant(
        "a design that forgets how fast torque may change",
        "design/signals.py",
        "most, out = limits.rate * (t[1] - t[0])",
        "most, out = 9 * limits.rate * (t[1] - t[0])",
        "test_design.py::test_inputs_keep_to_torque_and_its_change[Steps]",
    ),
    Mutant(
        "a design that looks at no limit of the motion",
        "design/play.py",
        "return inside & below & above",
        "return np.ones_like(inside)",
        "test_design.py::test_no_motion_of_a_design_leaves_what_the_logs_visited",
    ),
    Mutant(
        "covariance after an experiment transposed",
        "design/questions.py",
        "np.eye(len(cov)) + cov @ information",
        "np.eye(len(cov)) + information @ cov",
        "test_design.py::test_covariance_after_more_information_is_that_of_the_sum_of_precisions",
    ),
    Mutant(
        "a friction band that counts at speed alone",
        "design/questions.py",
        "np.mean(np.log(mean + 1e-30), axis=-1)",
        "np.log(mean + 1e-30)[..., 0]",
        "test_design.py::test_friction_near_rest_counts_as_much_as_all_the_rest",
    ),
    Mutant(
        "a rival that adapts nothing",
        "design/questions.py",
        "np.sqrt(np.maximum(square - adapted, 0.0))",
        "np.sqrt(np.maximum(square + adapted, 0.0))",
        "test_design.py::test_distance_of_two_models_is_that_of_their_readings_with_all_that_can_be_adapted",
    ),
    Mutant(
        "information of steps outside the data",
        "design/information.py",
        "jnp.where(here.seq.active[:, None, None], jnp.concatenate(",
        "jnp.where(~here.seq.active[:, None, None], jnp.concatenate(",
        "test_design.py::test_information_is_the_mean_square_of_the_score",
    ),
    Mutant(
        "a rival that sees no input",
        "design/information.py",
        "inputs = truth.inputs(seq)",
        "inputs = truth.inputs(seq._replace(u=0 * seq.u))",
        "test_design.py::test_a_model_is_no_distance_from_itself_and_some_from_another",
    ),
    Mutant(
        "declared limits that are not heeded",
        "design/limits.py",
        "declared.get(name, (lo, hi))",
        "(lo, hi)",
        "test_design.py::test_declared_limits_hold_and_wrong_ones_are_told",
    ),
    Mutant(
        "a bound of one number that holds one way",
        "data/limits.py",
        "low = -high",
        "low = 0.0",
        "test_design.py::test_limits_are_read_and_written",
    ),
    Mutant(
        "a command is that of the row after",
        "data/recordings/signals.py",
        'side="right") - 1, 0, signal.t.size - 1)',
        'side="right"), 0, signal.t.size - 1)',
        "test_import.py::test_held_averaged_and_integrated_signals_are_their_closed_forms",
    ),
    Mutant(
        "readings interpolated over a gap",
        "data/recordings/signals.py",
        "((width <= reach) | exact)",
        "((width <= 9 * reach) | exact)",
        "test_import.py::test_a_reading_is_interpolated_only_between_near_neighbours",
    ),
    Mutant(
        "a gap does not end a sequence",
        "data/recordings/pieces.py",
        "np.diff(signal.t) > longest)",
        "np.diff(signal.t) > 9 * longest)",
        "test_import.py::test_sequences_are_cut_at_gaps[readings]",
    ),
    Mutant(
        "sign of a delay between topics",
        "data/recordings/delays.py",
        "integrals(cause, at - shift, pair.order",
        "integrals(cause, at + shift, pair.order",
        "test_import.py::test_the_delay_of_a_duplicate_and_of_an_angle_behind_its_rate",
    ),
    Mutant(
        "alignment counted from the encapsulation",
        "data/recordings/ros2.py",
        "-(self.at - _HEAD) % width",
        "-self.at % width",
        "test_recordings.py::test_a_message_is_laid_out_as_it_was_written[padding]",
    ),
    Mutant(
        "names are no part of the form of a message",
        "data/recordings/ros2.py",
        "self.text(named=field in NAMES)",
        "self.text(named=False)",
        "test_recordings.py::test_messages_of_many_forms_on_one_topic_are_those_of_the_generic_decoder",
    ),
    Mutant(
        "header stamps that run backwards are taken",
        "data/recordings/clock.py",
        "back = np.flatnonzero(np.diff(stamp) < 0)",
        "back = np.flatnonzero(np.diff(stamp) < -1e18)",
        "test_recordings.py::test_which_clock_is_taken_and_why[backwards]",
    ),
    Mutant("gear left out", "systems/base.py", "+ u[i] * gear", "+ u[i]", f"{MACHINES}drive_is_that_of_mujocos_motors"),
    Mutant(
        "Coriolis force of a slide halved",
        "systems/recursion.py",
        "scaled(2.0, cross(spin, own))",
        "scaled(1.0, cross(spin, own))",
        BRANCH,
    ),
    Mutant(
        "a composite body about another point",
        "systems/recursion.py",
        "about(scaled(times(0.5, body.mass), place), place)",
        "about(scaled(times(0.4, body.mass), place), place)",
        BRANCH,
    ),
    Mutant(
        "an anchor left out",
        "systems/frames.py",
        "place = -turn @ np.asarray(joint.anchor)",
        "place = np.zeros(3)",
        BRANCH,
    ),
    Mutant(
        "bodies that cannot be",
        "systems/bodies.py",
        "mass = jnp.where(physical(mass, own), mass, jnp.nan)",
        "mass = jnp.asarray(mass)",
        f"{MACHINES}unphysical_bodies_have_no_numbers",
    ),
    Mutant(
        "smoothed states that a model does not widen",
        "em/predict.py",
        "path._replace(cov=path.cov + more)",
        "path._replace(cov=path.cov + 0.0 * more)",
        "test_predict.py::test_uncertain_friction_widens_what_is_smoothed_where_nothing_is_read",
    ),
    Mutant(
        "forces unsaid that move no state",
        "em/stated.py",
        "pushed = jnp.concatenate([torque, here.by_parameter, other], axis=-1)",
        "pushed = jnp.concatenate([torque, here.by_parameter, 0.0 * other], axis=-1)",
        "test_stated.py::test_forces_unsaid_move_states_as_the_same_input_does",
    ),
    Mutant(
        "friction that may peak at rest while the horizon grows",
        "em/mstep.py",
        "(jnp.asarray(1e4), jnp.asarray(1.0))",
        "(jnp.asarray(1e4), self.rough)",
        "test_mstep.py::test_symmetry_is_asked_of_every_node_only_while_the_horizon_grows",
    ),
    Mutant(
        "a step out of the physical ones",
        "systems/bodies.py",
        "jnp.where(fine, after[name], one)",
        "jnp.where(fine, after[name], after[name])",
        f"{MACHINES}a_step_of_a_whole_body_ends_at_one_that_can_be",
    ),
    Mutant(
        "a load in the middle",
        "systems/bodies.py",
        "moved = scaled(mass / total, away)",
        "moved = scaled(0.0, away)",
        f"{MACHINES}payload_is_a_point_mass_at_the_site",
    ),
    Mutant(
        "an accelerometer without what turning adds",
        "systems/sensing.py",
        "add(cross(turns, place), cross(spin, cross(spin, place)))",
        "cross(turns, place)",
        f"{SENSORS}readings_are_those_of_mujoco_under_torque_and_friction[branch]",
    ),
    Mutant(
        "a sensor in the axes of its joint",
        "systems/sensing.py",
        "transposed(product(mount.turn, sense.turn))",
        "transposed(mount.turn)",
        f"{SENSORS}readings_are_those_of_mujoco_under_torque_and_friction[branch]",
    ),
    Mutant(
        "friction that an accelerometer feels left out of the score",
        "em/quadratic.py",
        "score = score + jnp.concatenate([of_torque, of_readings])",
        "score = score + jnp.concatenate([0 * of_torque, of_readings])",
        f"{SENSORS}what_accelerometers_feel_of_friction_and_mass_counts_in_score_and_information",
    ),
    Mutant(
        "friction written back with the other sign",
        "portable/friction.py",
        "-torque * weight)",
        "torque * weight)",
        "test_written_back.py::test_coulomb_and_viscous_friction_are_read_off_a_curve",
    ),
    Mutant(
        "placebo that keeps its columns in place",
        "diagnose/shares.py",
        "np.roll(own[:count, ..., nuisance:], by, axis=0)",
        "np.roll(own[:count, ..., nuisance:], 0, axis=0)",
        "test_forks.py::test_a_placebo_keeps_a_column_s_numbers_and_loses_what_it_explains",
    ),
    Mutant(
        "suspects whatever chance does",
        "diagnose/accept.py",
        "promise >= max(self.hint, self.above * chance)",
        "promise >= self.hint",
        "test_accept.py::test_a_suspect_removes_half_of_the_bar_and_twice_what_chance_does",
    ),
)


class Outcome(NamedTuple):
    """What a run of pytest said."""

    passed: int
    failed: int
    """Or stopped by an error of its own."""
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
    return Outcome(passed, count["failures"] + count["errors"], asserted and not count["errors"], said)
