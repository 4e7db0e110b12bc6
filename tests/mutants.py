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
    Mutant(
        "share of a late command",
        "effects/actuator.py",
        "(1 - rows + late) * line[0] + (rows - late) * line[min(rows, 1)]",
        "(rows - late) * line[0] + (1 - rows + late) * line[min(rows, 1)]",
        "test_observer.py::test_the_same_numbers_as_the_filter[a late input-cubature]",
    ),
    Mutant(
        "input that is no number taken as none",
        "fit/observer.py",
        "jnp.where(sound, u, state.u)",
        "jnp.where(sound, u, 0.0)",
        "test_observer.py::test_an_input_that_is_no_number_is_the_one_before",
    ),
    Mutant(
        "outliers absorbed",
        "smoother/kalman.py",
        "observed[i] & (e * e <= gate * gate * s)",
        "observed[i]",
        "test_observer.py::test_outliers_are_gated_and_change_nothing",
    ),
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
        "comparison/pooling.py",
        "1 / std**2 - shared,",
        "1 / std**2,",
        "test_compare.py::test_a_prior_that_all_runs_share_counts_once",
    ),
    Mutant(
        "spread between runs at twice its size",
        "comparison/pooling.py",
        "- (len(value) - 1)",
        "+ (len(value) - 1)",
        "test_compare.py::test_between_two_runs_the_spread_has_a_closed_form",
    ),
    Mutant(
        "contrasts that only the network knows are tested",
        "comparison/pooling.py",
        "variance >= LEAST_VARIANCE",
        "variance >= 0.0",
        "test_compare.py::test_contrasts_that_only_the_network_knows_are_left_out",
    ),
    Mutant(
        "changes that are not corrected for their number",
        "comparison/compare.py",
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
        "digest(_surroundings(), function,",
        "digest(function,",
        "test_traced.py::test_another_text_of_the_package_makes_another",
    ),
    Mutant(
        "a kept program whatever it was made of",
        "numerics/traced.py",
        "jax.tree.map(mesh, static), name",
        "name",
        "test_traced.py::test_what_decides_a_program_makes_another[constant]",
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
        "smoother/linear.py",
        "left = cov - product(product(gain, cov_next), gain.T)",
        "left = cov",
        SMOOTHER,
    ),
    Mutant(
        "lag-one covariance: gain transposed",
        "smoother/linear.py",
        "product(later, gain.T)",
        "product(later, gain)",
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
        "smoother/start.py",
        ".loglik)(starts) + log_weight",
        ".loglik)(starts)",
        "test_kalman.py::test_likeliest_start_weighs_prior_and_readings",
    ),
    Mutant(
        "no sequence is too wide for one Gaussian",
        "em/loop.py",
        "<= second.wide",
        "<= 99 * second.wide",
        "test_mixture.py::test_the_likelier_side_is_the_one_of_the_grid",
    ),
    Mutant(
        "parts of a split as wide as the whole",
        "smoother/mixture.py",
        "cov[which] - (1 - NARROW**2)",
        "cov[which] - 0 * (1 - NARROW**2)",
        "test_mixture.py::test_split_and_merge_keep_weight_mean_and_covariance",
    ),
    Mutant(
        "ancestor at the place of its descendant",
        "smoother/mixture.py",
        "before = source[place]",
        "before = place",
        "test_mixture.py::test_an_affine_model_has_one_posterior_whatever_is_split",
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
        " - present.log_psi(x) + log_ahead",
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
        "target = uniform * reach[-1]",
        "target = uniform",
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
        "return self.symmetry(unknown, w) + own",
        "return self.symmetry(unknown, w)",
        LEFT_OUT,
    ),
    Mutant(
        "error of an angle not wrapped",
        "fit/predict.py",
        "error = (error + np.pi) % (2 * np.pi) - np.pi",
        "error = error % (2 * np.pi)",
        "test_predict.py::test_horizon_errors_are_plain_arithmetic",
    ),
    Mutant(
        "variance for a standard deviation in predicted kicks",
        "fit/predict.py",
        "jnp.exp(0.5 * model.log_q)",
        "jnp.exp(model.log_q)",
        "test_predict.py::test_std_grows_as_the_kicks_add_up",
    ),
    Mutant(
        "solution without the diagonal",
        "numerics/gaussian.py",
        "s = s - row[m] * inverse[m] *",
        "s = s - row[m] *",
        "test_gaussian.py::test_spd_solve_is_numpys[4]",
    ),
    Mutant(
        "the larger horizon decides a ratio of errors",
        "em/multistep.py",
        "np.mean(second[first > 0] / first[first > 0])",
        "np.sum(second) / np.sum(first)",
        "test_forks.py::test_a_ratio_of_errors_is_that_of_the_sequences_used",
    ),
    Mutant(
        "parameters of an effect looked for among those of the machine",
        "diagnosis/hypothesis.py",
        "np.cumsum(sizes) + m_step.prior.size - sum(sizes)",
        "np.cumsum(sizes)",
        "test_search.py::test_certainty_is_the_marginal_of_the_posterior",
    ),
    Mutant(
        "the next effect dropped",
        "diagnosis/hypothesis.py",
        "enumerate(self.additions) if i != place",
        "enumerate(self.additions) if i != place + 1",
        "test_search.py::test_one_of_three_effects_goes_with_its_prior_and_its_reason",
    ),
    Mutant(
        "rest of a law at another joint",
        "diagnosis/keys.py",
        "first == second and one.joint == other.joint",
        "first == second",
        "test_search.py::test_a_rest_belongs_to_the_law_of_the_same_signals_at_its_joint",
    ),
    Mutant(
        "a law takes the place of its like",
        "diagnosis/keys.py",
        "jax.tree.structure(model.effects[i]) != jax.tree",
        "jax.tree.structure(model.effects[i]) == jax.tree",
        "test_search.py::test_a_function_of_each_turn_and_one_of_all_turns_are_rivals",
    ),
    Mutant(
        "a fit starts without what the screen says",
        "diagnosis/propose.py",
        "float(c) * (p - start)",
        "(p - start)",
        "test_search.py::test_a_fit_starts_where_the_screen_puts_a_linear_law_and_at_the_probe_of_another",
    ),
    Mutant(
        "programs let go below the bound",
        "numerics/programs.py",
        "if maps() <= most:",
        "if maps() > most:",
        "test_programs.py::test_programs_are_released_beyond_the_bound",
    ),
    Mutant(
        "prior of friction on its size",
        "em/shape.py",
        "others @ others.T /",
        "np.eye(count) /",
        "test_forks.py::test_friction_is_free_in_the_span_of_known_laws",
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
        "np.sqrt(whole * single)",
        "np.sqrt(whole * whole + 0 * single)",
        "test_forks.py::test_a_loud_recording_counts_by_the_root_of_its_loudness",
    ),
    Mutant(
        "weights of sequences that are not used",
        "em/multistep.py",
        "error = np.where(used[:, None, None, None], predictions.error, np.nan)",
        "error = predictions.error",
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
        "trial_error, used) < 1 - LEAST_FALL:",
        "trial_error, used) > 1 - LEAST_FALL:",
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
        "fit/identify.py",
        "used & (part != out)",
        "used",
        "test_fit.py::test_a_finish_that_only_the_fitted_sequences_like_is_left_alone",
    ),
    Mutant(
        "multi-step fit judged on its own sequences",
        "fit/identify.py",
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
        "diagnosis/columns.py",
        "full[:, stack.places] =",
        "full[:, stack.places[::-1]] =",
        "test_forks.py::test_a_probe_gives_the_same_column_beside_all_others_as_alone",
    ),
    Mutant(
        "one white coordinate is enough",
        "em/noise.py",
        "return max(coordinates or",
        "return min(coordinates or",
        "test_forks.py::test_all_measured_coordinates_must_be_white_or_where_none_is_measured_one_reading",
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
        "diagnosis/refit.py",
        "_, core, loglik, hessian, path = best",
        "_, _, loglik, hessian, path = best",
        "test_fit.py::test_a_refit_goes_back_a_third_of_the_way_and_keeps_the_best",
    ),
    Mutant(
        "a refit judged on sequences that are not used",
        "diagnosis/refit.py",
        "nan=-1e6)[used])",
        "nan=-1e6))",
        "test_fit.py::test_a_refit_goes_back_a_third_of_the_way_and_keeps_the_best",
    ),
    Mutant(
        "stride of a refit not shortened",
        "diagnosis/refit.py",
        "stride, path = stride / 3, best[4]",
        "stride, path = stride, best[4]",
        "test_fit.py::test_a_refit_goes_back_a_third_of_the_way_and_keeps_the_best",
    ),
    Mutant(
        "noise of a refit not held",
        "diagnosis/refit.py",
        "count >= NOISE_HELD_PASSES",
        "count >= 0",
        "test_fit.py::test_a_refit_holds_the_noise_in_its_first_passes",
    ),
    Mutant(
        "curvature of the weights before the finish",
        "fit/identify.py",
        "hessian=info.hessian, top=top)",
        "hessian=fitted.state.hessian, top=top)",
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
        "diagnosis/residual.py",
        "jnp.where(prepared.observed, filtered.innovation, jnp.nan)",
        "filtered.innovation",
        "test_residual.py::test_there_is_an_innovation_where_there_is_a_reading",
    ),
    Mutant(
        "Bonferroni for Holm",
        "diagnosis/statistics.py",
        "(values.size - np.arange(values.size)) * values[order]",
        "values.size * values[order]",
        "test_residual.py::test_holm_by_hand",
    ),
    Mutant(
        "lost sequences take part in the tests",
        "diagnosis/residual.py",
        "part[self.used] for part in self",
        "part for part in self",
        "test_residual.py::test_lost_sequences_take_no_part",
    ),
    Mutant(
        "autocovariance not over that of lag 0",
        "diagnosis/statistics.py",
        "np.maximum(pairs, 1.0) * (pairs[0] / sums[0]), pairs",
        "np.maximum(pairs, 1.0), pairs",
        "test_residual.py::test_autoregression_fails_and_its_coefficient_is_the_size",
    ),
    Mutant(
        "a design that forgets the limit of torque",
        "experiment/signals.py",
        "np.minimum(limits.high, rest + left)",
        "rest + left + limits.high",
        "test_design.py::test_inputs_keep_to_torque_and_its_change[Chirp]",
    ),
    Mutant(
        "a design that forgets how fast torque may change",
        "experiment/signals.py",
        "most, out = limits.rate * (t[1] - t[0])",
        "most, out = 9 * limits.rate * (t[1] - t[0])",
        "test_design.py::test_inputs_keep_to_torque_and_its_change[Steps]",
    ),
    Mutant(
        "a design that looks at no limit of the motion",
        "experiment/play.py",
        "return inside & below & above",
        "return np.ones_like(inside)",
        "test_design.py::test_a_motion_is_allowed_that_stays_inside_its_limits_by_more_than_its_spread",
    ),
    Mutant(
        "covariance after an experiment transposed",
        "experiment/criteria.py",
        "np.eye(len(cov)) + cov @ information",
        "np.eye(len(cov)) + information @ cov",
        "test_design.py::test_covariance_after_more_information_is_that_of_the_sum_of_precisions",
    ),
    Mutant(
        "a friction band that counts at speed alone",
        "experiment/criteria.py",
        "np.mean(np.log(mean + 1e-30), axis=-1)",
        "np.log(mean + 1e-30)[..., 0]",
        "test_design.py::test_friction_near_rest_counts_as_much_as_all_the_rest",
    ),
    Mutant(
        "a rival that adapts nothing",
        "experiment/criteria.py",
        "np.sqrt(np.maximum(square - adapted, 0.0))",
        "np.sqrt(np.maximum(square + adapted, 0.0))",
        "test_design.py::test_distance_of_two_models_is_that_of_their_readings_with_all_that_can_be_adapted",
    ),
    Mutant(
        "information of steps outside the data",
        "experiment/information.py",
        "jnp.where(linear.seq.active[:, None, None], jnp.concatenate(",
        "jnp.where(~linear.seq.active[:, None, None], jnp.concatenate(",
        "test_design.py::test_information_is_the_mean_square_of_the_score",
    ),
    Mutant(
        "a rival that sees no input",
        "experiment/information.py",
        "inputs = truth.inputs(seq)",
        "inputs = truth.inputs(seq._replace(u=0 * seq.u))",
        "test_design.py::test_a_model_is_no_distance_from_itself_and_some_from_another",
    ),
    Mutant(
        "declared limits that are not heeded",
        "experiment/limits.py",
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
        "import_/signals.py",
        'side="right") - 1, 0, signal.t.size - 1)',
        'side="right"), 0, signal.t.size - 1)',
        "test_import.py::test_held_averaged_and_integrated_signals_are_their_closed_forms",
    ),
    Mutant(
        "readings interpolated across the jump of a counter",
        "import_/signals.py",
        "((~across & ",
        "((",
        "test_counters.py::test_nothing_is_interpolated_across_a_jump",
    ),
    Mutant(
        "an encoder that creeps taken for a held one",
        "data/held.py",
        "_QUANTA * float",
        "0.1 * float",
        "test_held.py::test_an_encoder_holds_nothing",
    ),
    Mutant(
        "a spike that comes back taken for a counter",
        "data/counters.py",
        "(before & after)[alone]",
        "(before | after)[alone]",
        "test_counters.py::test_what_machines_do_is_no_counter",
    ),
    Mutant(
        "acceleration held against a speed",
        "em/build.py",
        "np.maximum(acceleration, least)",
        "np.maximum(acceleration, speed)",
        "test_check.py::test_a_machine_at_one_speed_has_come_to_it_within_a_sequence",
    ),
    Mutant(
        "readings interpolated over a gap",
        "import_/signals.py",
        "(width <= reach)) | exact",
        "(width <= 9 * reach)) | exact",
        "test_import.py::test_a_reading_is_interpolated_only_between_near_neighbours",
    ),
    Mutant(
        "a gap does not end a sequence",
        "import_/segments.py",
        "np.diff(signal.t) > signal.longest)",
        "np.diff(signal.t) > 9 * signal.longest)",
        "test_import.py::test_sequences_are_cut_at_gaps[readings]",
    ),
    Mutant(
        "sign of a delay between topics",
        "import_/delays.py",
        "integrals(cause, at - shift, pair.order",
        "integrals(cause, at + shift, pair.order",
        "test_import.py::test_the_delay_of_a_duplicate_and_of_an_angle_behind_its_rate",
    ),
    Mutant(
        "alignment counted from the encapsulation",
        "import_/ros2.py",
        "-(self.at - _HEAD) % width",
        "-self.at % width",
        "test_recordings.py::test_a_message_is_laid_out_as_it_was_written[padding]",
    ),
    Mutant(
        "names are no part of the form of a message",
        "import_/ros2.py",
        "self.text(named=field in NAMES)",
        "self.text(named=False)",
        "test_recordings.py::test_messages_of_many_forms_on_one_topic_are_those_of_the_generic_decoder",
    ),
    Mutant(
        "header stamps that run backwards are taken",
        "import_/clock.py",
        "back = np.flatnonzero(np.diff(stamp) < 0)",
        "back = np.flatnonzero(np.diff(stamp) < -1e18)",
        "test_recordings.py::test_which_clock_is_taken_and_why[backwards]",
    ),
    Mutant("gear left out", "systems/base.py", "+ u[i] * gear", "+ u[i]", f"{MACHINES}drive_is_that_of_mujocos_motors"),
    Mutant(
        "Coriolis force of a slide halved",
        "systems/recursion.py",
        "scaled(2.0, cross(spin, velocity))",
        "scaled(1.0, cross(spin, velocity))",
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
        "mass = jnp.where(physical(mass, tensor), mass, jnp.nan)",
        "mass = jnp.asarray(mass)",
        f"{MACHINES}unphysical_bodies_have_no_numbers",
    ),
    Mutant(
        "smoothed states that a model does not widen",
        "fit/predict.py",
        "path._replace(cov=path.cov + model_cov)",
        "path._replace(cov=path.cov + 0.0 * model_cov)",
        "test_predict.py::test_uncertain_friction_widens_what_is_smoothed_where_nothing_is_read",
    ),
    Mutant(
        "forces unsaid that move no state",
        "em/multistep.py",
        "[torque, linear.by_parameter, moved], axis=-1)",
        "[torque, linear.by_parameter, 0.0 * moved], axis=-1)",
        "test_stated.py::test_forces_unsaid_move_states_as_the_same_input_does",
    ),
    Mutant(
        "friction that may peak at rest while the horizon grows",
        "em/mstep.py",
        "(jnp.asarray(1e4), jnp.asarray(1.0))",
        "(jnp.asarray(1e4), self.symmetry_std)",
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
        "add(scaled(mass, spot.point), moment)",
        "moment",
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
        "transposed(product(mount.turn, sensor.turn))",
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
        "a machine's file written with MuJoCo's own six digits",
        "machines/spec.py",
        "DIGITS = 15",
        "DIGITS = 6",
        "test_written_back.py::test_a_written_file_is_that_of_its_owner",
    ),
    Mutant(
        "a held body placed along the axes of the world",
        "machines/locked.py",
        "turns[parent].T @ (places[i] - places[parent])",
        "places[i] - places[parent]",
        "test_locked.py::test_mass_and_bias_are_those_of_the_whole_with_joints_held[a tree]",
    ),
    Mutant(
        "friction written back with the other sign",
        "export/friction.py",
        "nearest(v, torque,",
        "nearest(v, -torque,",
        "test_written_back.py::test_coulomb_and_viscous_friction_are_read_off_a_curve",
    ),
    Mutant(
        "nuisance not projected out of the error",
        "diagnosis/screen.py",
        "error -= nuisance @ cho_solve(factor, nuisance.T @ error - pull)",
        "error -= 0 * nuisance @ cho_solve(factor, nuisance.T @ error - pull)",
        "test_shares.py::test_the_nuisance_is_projected_out_by_ridge_regression",
    ),
    Mutant(
        "nuisance not projected out of the columns",
        "diagnosis/screen.py",
        "left -= nuisance @ cho_solve(factor, nuisance.T @ left)",
        "left -= 0.0",
        "test_shares.py::test_the_nuisance_is_projected_out_by_ridge_regression",
    ),
    Mutant(
        "a prior that draws the change to zero",
        "diagnosis/screen.py",
        "nuisance.T @ error - pull)",
        "nuisance.T @ error)",
        "test_shares.py::test_the_nuisance_is_projected_out_by_ridge_regression",
    ),
    Mutant(
        "a recording may be harmed by any share",
        "diagnosis/verdict.py",
        "min(folds) > -HARM * floor",
        "min(folds) < HARM * floor",
        "test_verdict.py::test_the_error_falls_on_most_parts_and_rises_on_none_by_much",
    ),
    Mutant(
        "the larger of two shares",
        "diagnosis/verdict.py",
        "return min(self.inside, self.left_out)",
        "return max(self.inside, self.left_out)",
        "test_verdict.py::test_the_smaller_share_counts",
    ),
    Mutant(
        "a floor that readings lower",
        "diagnosis/verdict.py",
        "return max(self.share, 2 * self.nats",
        "return min(self.share, 2 * self.nats",
        "test_verdict.py::test_what_counts_of_a_one_step_error_is_twelve_nats_and_two_thousandths_of_a_nat_a_reading",
    ),
    Mutant(
        "a refit that removes next to nothing",
        "diagnosis/verdict.py",
        "return share >= KEEP * floor",
        "return share >= 0",
        "test_verdict.py::test_a_refit_vetoes_what_is_impossible_uncertain_or_small",
    ),
    Mutant(
        "an amplitude that is not determined",
        "diagnosis/verdict.py",
        "if not amplitude > DETERMINED:",
        "if amplitude > DETERMINED:",
        "test_verdict.py::test_a_refit_vetoes_what_is_impossible_uncertain_or_small",
    ),
    Mutant(
        "free laws before named ones",
        "diagnosis/verdict.py",
        "NAMED ** (1 + complexity)",
        "NAMED",
        "test_verdict.py::test_a_remainder_comes_before_a_named_law_and_that_before_a_free_one",
    ),
    Mutant(
        "chance does not raise the bar",
        "diagnosis/screen.py",
        "return max(self.floor, CHANCE * self.chance)",
        "return self.floor",
        "test_rounds.py::test_a_law_is_accepted_from_the_floor_and_from_twice_the_chance_level_on",
    ),
    Mutant(
        "a suspect within what chance does",
        "diagnosis/verdict.py",
        "max(SUSPECT * floor, CHANCE * chance)",
        "SUSPECT * floor",
        "test_verdict.py::test_a_suspect_removes_half_of_the_floor_and_twice_what_chance_does",
    ),
    Mutant(
        "a fit that predicts worse is kept",
        "diagnosis/context.py",
        "    if min(left) <= 1:",
        "    if min(left) >= 1:",
        "test_search.py::test_a_fit_that_predicts_worse_than_what_it_began_from_is_not_kept",
    ),
    Mutant(
        "trimmed sum not rescaled",
        "diagnosis/context.py",
        "cut : gain.size - cut]) * gain.size)",
        "cut : gain.size - cut]) * (gain.size - 2 * cut))",
        "test_search.py::test_a_sixth_is_trimmed_at_either_end",
    ),
    Mutant(
        "the fit that is behind wins",
        "diagnosis/context.py",
        "np.nan_to_num(a, nan=-1e3) - np.nan_to_num(b, nan=-1e3)",
        "np.nan_to_num(b, nan=-1e3) - np.nan_to_num(a, nan=-1e3)",
        "test_search.py::test_one_fit_is_ahead_of_another_by_what_it_is_likelier",
    ),
    Mutant(
        "the least likely of even laws is first",
        "diagnosis/rounds.py",
        "return case.gain - PRICE",
        "return -case.gain - PRICE",
        "test_rounds.py::test_refits_decide_between_laws_that_the_screen_cannot_tell_apart",
    ),
    Mutant(
        "a bump is a ripple",
        "diagnosis/verdict.py",
        "if value >= EQUIVALENT * max(values)]",
        "if value >= 0.6 * max(values)]",
        "test_rounds.py::test_a_named_law_is_preferred_to_the_function_that_contains_it_where_it_reaches_nine_tenths",
    ),
    Mutant(
        "the weakest of a kind stands for it",
        "diagnosis/rounds.py",
        "best[key].rank < screened.rank",
        "best[key].rank > screened.rank",
        "test_rounds.py::test_the_best_of_every_kind_stands_for_it",
    ),
    Mutant(
        "laws of one cause leave the question open",
        "diagnosis/rounds.py",
        "of_best.isdisjoint(of_one)",
        "not of_best.isdisjoint(of_one)",
        "test_rounds.py::test_laws_of_other_causes_that_explain_the_same_leave_the_question_open",
    ),
    Mutant(
        "free suspects before named ones",
        "diagnosis/rounds.py",
        "near.sort(key=lambda s: not s.candidate.start.named)",
        "near.sort(key=lambda s: s.candidate.start.named)",
        "test_rounds.py::test_suspects_are_near_the_best_and_over_chance_with_named_laws_first",
    ),
    Mutant(
        "recordings against a law are those for it",
        "diagnosis/rounds.py",
        "held[folds < 0]",
        "held[folds > 0]",
        "test_rounds.py::test_a_law_on_which_recordings_disagree_is_told_with_those_against_it",
    ),
    Mutant(
        "the most needed law is tried without",
        "diagnosis/backward.py",
        "np.argmin([one.lost for one in reduced])",
        "np.argmax([one.lost for one in reduced])",
        "test_search.py::test_a_law_goes_without_which_too_little_is_lost",
    ),
    Mutant(
        "a law stays beside any remainder",
        "diagnosis/search.py",
        "form is None and 0 in even(",
        "form is None and 0 not in even(",
        "test_search.py::test_a_named_law_gives_way_to_a_remainder_that_explains_the_larger_part",
    ),
    Mutant(
        "one-step errors decide where innovations are not white",
        "diagnosis/search.py",
        "if white and complete and white_innovations(_outcome(before, hypothesis, state), data):",
        "if white and complete:",
        "test_search.py::test_one_step_errors_come_last_and_where_noise_is_what_the_model_says",
    ),
    Mutant(
        "a worse law takes the place of another",
        "diagnosis/backward.py",
        "if lead > 1:",
        "if lead < 1:",
        "test_search.py::test_what_explains_clearly_more_takes_the_place_of_a_law",
    ),
    Mutant(
        "a law is stated at the first place",
        "diagnosis/keys.py",
        "plain(one) == plain(other)",
        "plain(one) != plain(other)",
        "test_rounds.py::test_the_same_law_at_every_other_place_is_refitted_beside_the_one_that_leads",
    ),
    Mutant(
        "a refit without a look",
        "diagnosis/trial.py",
        "if loss.multi_step and not needed(foreseen,",
        "if loss.multi_step and needed(foreseen,",
        "test_rounds.py::test_a_law_whose_step_removes_nothing_is_not_refitted",
    ),
    Mutant(
        "a refit stated under the rule of its passes",
        "diagnosis/refit.py",
        "hessian + late - early",
        "hessian",
        "test_fit.py::test_a_refit_goes_back_a_third_of_the_way_and_keeps_the_best",
    ),
    Mutant(
        "a column of the nuisance is a candidate",
        "diagnosis/verdict.py",
        "and survived >= SURVIVES",
        "and survived >= 0",
        "test_verdict.py::test_a_law_far_beyond_its_prior_or_within_the_span_of_the_nuisance_is_none",
    ),
    Mutant(
        "an angle that is read late has no hypotheses",
        "em/build.py",
        "scales.speed[joint] * late <= MOVED",
        "scales.speed[joint] * late <= math.inf",
        "test_start.py::test_an_angle_that_is_read_late_has_hypotheses",
    ),
    Mutant(
        "a path of the mixture is taken that is less likely than the first",
        "em/loop.py",
        "known = second.loglik > jnp.where(jnp.isnan(loglik), -jnp.inf, loglik)",
        "known = second.loglik > -jnp.inf",
        "test_mixture.py::test_the_likelier_of_both_paths_is_taken",
    ),
    Mutant(
        "external disturbances sought in white noise",
        "diagnosis/search.py",
        "    if white:\n",
        "    if not white:\n",
        "test_search.py::test_one_step_errors_come_last_and_where_noise_is_what_the_model_says",
    ),
    Mutant(
        "the gain of a lost sequence counts",
        "diagnosis/losses.py",
        "fit.used & np.isfinite(gain)",
        "fit.used",
        "test_search.py::test_the_one_step_error_that_a_fit_removes_is_twice_its_gain_over_the_readings",
    ),
    Mutant(
        "folds are blocks of time",
        "diagnosis/screen.py",
        "np.stack([sums.left_out(fold == f) for f in np.unique(fold)], axis=1)",
        "np.stack([sums.left_out(block == f) for f in np.unique(fold)], axis=1)",
        "test_shares.py::test_what_happens_at_one_moment_of_every_recording_is_no_law",
    ),
    Mutant(
        "a fit to the part that is left out",
        "diagnosis/screen.py",
        "self._solved(self.score[~cells].sum(axis=0), self.gram[~cells].sum(axis=0))",
        "self._solved(self.score[cells].sum(axis=0), self.gram[cells].sum(axis=0))",
        "test_shares.py::test_shares_are_those_of_least_squares",
    ),
    Mutant(
        "a part that holds little decides",
        "diagnosis/screen.py",
        "np.where(out < 0, np.maximum(held, held.mean()), held)",
        "held",
        "test_shares.py::test_a_part_with_hardly_any_error_is_harmed_by_what_that_is_of_an_average_one",
    ),
    Mutant(
        "errors that overlap count in full",
        "diagnosis/screen.py",
        "np.maximum(len(rows.error) / rows.overlap, directions[indices] + 2)",
        "np.maximum(len(rows.error), directions[indices] + 2)",
        "test_shares.py::test_errors_that_overlap_count_for_less",
    ),
    Mutant(
        "the placebo of a constant keeps its meaning",
        "diagnosis/screen.py",
        "        moved[:by] *= -1\n",
        "",
        "test_shares.py::test_the_placebo_of_a_constant_explains_nothing",
    ),
    Mutant(
        "recordings of one motion are evidence of each other",
        "diagnosis/folds.py",
        "if difference < REPEATS * square:",
        "if difference < 0 * square:",
        "test_shares.py::test_recordings_of_one_motion_are_left_out_together",
    ),
    Mutant(
        "folds interleaved",
        "diagnosis/folds.py",
        "(order * min(MOTION_PARTS, count) // count)",
        "(order % min(MOTION_PARTS, count))",
        "test_shares.py::test_folds_are_neighbours_and_pieces_where_there_are_few",
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
