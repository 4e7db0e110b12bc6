"""Places of the core broken on purpose, each with the test that must turn red.

`mutation.py` runs them.
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
    test: str
    """In tests/."""
    text: str = ""
    """There exactly once."""
    instead: str = ""


def _mutants(table: str) -> tuple[Mutant, ...]:
    """Mutants of a table: `# file`, `## test`, then each with its lines marked `-` and those instead marked `+`."""
    file, test, mutants = "", "", []
    for line in table.strip().splitlines():
        mark, _, rest = line.partition(" ")
        if mark == "#":
            file = rest
        elif mark == "##":
            test = rest
        elif mark == "-":
            mutants[-1] = mutants[-1]._replace(text=f"{mutants[-1].text}\n{rest}".removeprefix("\n"))
        elif mark == "+":
            mutants[-1] = mutants[-1]._replace(instead=f"{mutants[-1].instead}\n{rest}".removeprefix("\n"))
        else:
            mutants.append(Mutant(line, file, test))
    return tuple(mutants)


MUTANTS = _mutants("""
# model/effects/actuator.py
## test_observer.py::test_the_same_numbers_as_the_filter[a late input, a spring, a biased, late sensor]
share of a late command
- (1 - rows + late) * line[0] + (rows - late) * line[min(rows, 1)]
+ (rows - late) * line[0] + (1 - rows + late) * line[min(rows, 1)]
# estimate/observer.py
## test_observer.py::test_an_input_that_is_no_number_is_the_one_before
input that is no number taken as none
- jnp.where(sound, u, state.u)
+ jnp.where(sound, u, 0.0)
# estimate/smoother/kalman.py
## test_observer.py::test_outliers_are_gated_and_change_nothing
outliers absorbed
- observed[i] & (e * e <= gate * gate * s)
+ observed[i]
## test_kalman.py::test_time_varying_system_agrees_with_statsmodels
gain of the backward pass transposed
- product(gain, later.mean - predicted.mean)
+ product(gain.T, later.mean - predicted.mean)
process noise left out
- + jnp.where(active, q, 0.0)
+ + 0.0 * q
standard deviation for a variance in R
- jnp.exp(log_r)
+ jnp.exp(0.5 * log_r)
constant of the likelihood without the number of readings
- count * math.log(2 * math.pi)
+ math.log(2 * math.pi)
innovation over its variance
- e / jnp.sqrt(s), 0.0
+ e / s, 0.0
## test_kalman.py::test_smoothers_equal_the_dense_joint_for_every_pattern_of_missing_readings[tangent]
input one row late
- start, seq, seq.inputs, affine_at
+ start, seq, jnp.roll(seq.inputs, 1, axis=0), affine_at
padding moves the state
- jnp.where(active, a, b), affine
+ a, affine
## test_kalman.py::test_covariances_stay_symmetric_and_positive
filtered covariance not kept symmetric
- return Gaussian(mean, symmetric(cov)), jnp.stack(whitened)
+ return Gaussian(mean, cov), jnp.stack(whitened)
smoothed covariance not kept symmetric
- symmetric(state.cov + product(product(gain, later.cov - predicted.cov), gain.T))
+ state.cov + product(product(gain, later.cov - predicted.cov), gain.T)
## test_kalman.py::test_cubature_has_the_slope_and_mean_of_a_polynomial
cubature points too near
- reach = math.sqrt(len(rows))
+ reach = 1.0
# machines/systems/arm.py
## test_systems.py::test_mass_and_bias_are_lagranges_equations[acrobot]
sign of the Coriolis torque
- gravity1 - h * v[1]
+ gravity1 + h * v[1]
sign of the centrifugal torque
- gravity2 + h * v[0]
+ gravity2 - h * v[0]
rotor not geared
- rotor = self.gr**2 * self.Ir
+ rotor = self.gr * self.Ir
# machines/systems/pendulum.py
## test_systems.py::test_mass_and_bias_are_lagranges_equations[pendulum]
gravity of the pendulum for the cosine
- self.m * self.g * self.lc * sin(q)
+ self.m * self.g * self.lc * cos(q)
# explain/compare/pooling.py
## test_compare.py::test_a_prior_that_all_runs_share_counts_once
prior counted with every run
- 1 / std**2 - shared,
+ 1 / std**2,
## test_compare.py::test_contrasts_that_only_the_network_knows_are_left_out
contrasts that only the network knows are tested
- variance >= LEAST_VARIANCE
+ variance >= 0.0
## test_compare.py::test_errors_of_fits_that_differ_are_widened_to_the_difference
errors are widened by the square of their ratio
- np.sqrt(max(1.0, test.statistic / max(test.freedom, 1)))
+ max(1.0, test.statistic / max(test.freedom, 1))
# explain/compare/compare.py
## test_compare.py::test_alarms_are_as_frequent_as_the_level_says
changes that are not corrected for their number
- q.test._replace(p_value=float(next(p)))
+ q.test
# model/hooks.py
## test_systems.py::test_energy_changes_by_the_work_of_the_input[slide]
sign of friction
- known + torque
+ known - torque
# machines/systems/plant.py
## test_systems.py::test_energy_changes_by_the_work_of_the_input[slide]
sign of the input
- force[joint - 1] + u[i]
+ force[joint - 1] - u[i]
## test_machines.py::test_drive_is_that_of_mujocos_motors
gear left out
- + u[i] * gear
+ + u[i]
# model/law.py
## test_law.py::test_law_limits_are_those_of_the_formula
sign of the Stribeck law
- return -(level * jnp.tanh(v / self.smooth) + self.viscous * v)
+ return level * jnp.tanh(v / self.smooth) + self.viscous * v
# model/effects/friction.py
## test_effects.py::test_accelerates_as_the_independent_simulator_says[motor_back_emf]
a brake that pushes
- -self.b * self.own(scene.v)
+ self.b * self.own(scene.v)
# base/random.py
## test_numerics.py::test_normals_are_normal_and_independent
normal numbers of one sign
- jnp.where(b & jnp.uint32(1), radius, -radius) * cosine
+ radius * cosine
# base/rows.py
## test_numerics.py::test_rows_in_blocks_are_the_rows_all_at_once
rows of a block left out
- reshape(count * size, *a.shape[2:])[:length]
+ reshape(count * size, *a.shape[2:])[-length:]
# base/traced.py
## test_traced.py::test_what_decides_a_program_makes_another[text of the package]
a kept program whatever the package says now
- digest(surroundings(), function,
+ digest(function,
## test_traced.py::test_what_decides_a_program_makes_another[constant]
a kept program whatever it was made of
- jax.tree.map(mesh, static), name
+ name
# base/ode.py
## test_ode.py::test_linear_system_is_the_taylor_series_to_fourth_order
weights of the Runge-Kutta stages
- [-4 / 3, 1 / 3, 2 / 3, 1 / 3]
+ [-4 / 3, 1 / 3, 1 / 3, 2 / 3]
a Runge-Kutta stage at the wrong place
- ahead = h * jnp.asarray([1 / 2, 1 / 2, 1.0, 1 / 6]
+ ahead = h * jnp.asarray([1 / 2, 1.0, 1.0, 1 / 6]
# estimate/smoother/kalman.py
## test_kalman.py::test_smoothers_equal_the_dense_joint_for_every_pattern_of_missing_readings[tangent]
lag-one covariance: spread of the pair's first
- left = cov - product(product(gain, cov_next), gain.T)
+ left = cov
lag-one covariance: gain transposed
- product(later, gain.T)
+ product(later, gain)
# model/base.py
## test_kalman.py::test_smoothers_equal_the_dense_joint_for_every_pattern_of_missing_readings[tangent]
what is behind the horizon is read
- observed & seq.valid[:, None]
+ observed
# estimate/smoother/start.py
## test_kalman.py::test_likeliest_start_weighs_prior_and_readings
prior of the start hypotheses left out
- .loglik)(starts) + log_weight
+ .loglik)(starts)
# estimate/em/loop.py
## test_mixture.py::test_the_likelier_side_is_the_one_of_the_grid
no sequence is too wide for one Gaussian
- <= second.wide
+ <= 99 * second.wide
## test_fit.py::test_a_model_is_judged_by_its_likelihood[worse: back, and a third of the way from the best]
EM accepts a worse model
- np.nanmean(loglik - state.top) >= -0.5
+ np.nanmean(loglik - state.top) <= 0.5
stride not shortened on retreat
- stride=state.stride / 3)
+ stride=state.stride)
retreat to the model that was refused
- between(state.best, state.proposal, state.stride)
+ between(state.model, state.proposal, state.stride)
## test_fit.py::test_a_fall_along_its_own_path_is_judged_along_the_path_of_the_step
a rise along one path counts, however small
- - abs(np.mean((best - state.top)[both])))
+ )
## test_fit.py::test_a_fall_is_judged_once_more_with_all_rows_in_sight_only
a second look at short horizons, where a fall is cheap
- if kept is not None and used.any():
+ if used.any():
paths of short horizons are kept
- kept = path if seen == longest and
+ kept = path if
## test_fit.py::test_a_model_is_judged_by_its_likelihood[worse where it was left out]
lost sequences judge the next model
- top = np.where(used, loglik, np.nan)
+ top = loglik
## test_fit.py::test_a_horizon_is_held_and_grows
horizon grows every epoch
- max(0, (epoch - 1) // self.hold)
+ max(0, epoch - 1)
## test_fit.py::test_em_rests_where_nothing_moves
EM rests where one epoch moved little
- np.diff(state.loglik[-3:])
+ np.diff(state.loglik[-2:])
## test_fit.py::test_the_likeliest_process_noise_is_where_it_begins
the least likely process noise to begin with
- trials[int(np.argmax(logliks))]
+ trials[int(np.argmin(logliks))]
## test_kalman.py::test_loosened_passes_one_by_one_give_what_they_give_together
the tight try kept whatever is likelier
- best = likeliest(jnp.stack([posterior.loglik for posterior in tries]))
+ best = 0 * likeliest(jnp.stack([posterior.loglik for posterior in tries]))
## test_mixture.py::test_what_is_narrow_keeps_its_numbers_and_else_the_likelier_of_both_paths_is_taken
a path of the mixture is taken that is less likely than the first
- np.flatnonzero(np.asarray(second.loglik) > np.nan_to_num(np.asarray(loglik), nan=-np.inf, neginf=-np.inf))
+ np.flatnonzero(np.asarray(second.loglik) > -np.inf)
# estimate/smoother/mixture.py
## test_mixture.py::test_split_and_merge_keep_weight_mean_and_covariance
parts of a split as wide as the whole
- cov[which] - (1 - NARROW**2)
+ cov[which] - 0 * (1 - NARROW**2)
## test_mixture.py::test_a_branch_goes_back_from_place_to_place
ancestor at the place of its descendant
- before = source[place]
+ before = place
# logs/dataset.py
## test_kalman.py::test_smoothers_equal_the_dense_joint_for_every_pattern_of_missing_readings[tangent]
a missing reading taken for 0
- observed = ~jnp.isnan(y)
+ observed = jnp.ones_like(y, bool)
# estimate/smoother/particle/filter.py
## test_particle.py::test_weights_of_the_blind_filter_by_hand
log weight of the readings missing
- log_w + log_g(state, u, y, observed) -
+ log_w -
old log weight missing
- grown = log_w + log_g
+ grown = log_g
weights kept when resampled
- for row in f], flat, ancestors
+ for row in f], log_w, ancestors
particles see the input one row late
- _cast((model, scale, seq.inputs, seq.y), dtype)
+ _cast((model, scale, jnp.roll(seq.inputs, 1, axis=0), seq.y), dtype)
## test_particle.py::test_trajectories_and_likelihood_are_those_of_the_exact_smoother[guided]
proposal not weighed out
-  - present.log_psi(x) + log_ahead
+  + log_ahead
# estimate/smoother/particle/backward.py
## test_particle.py::test_backward_step_draws_from_its_law
backward weights not normalised
- target = uniform * reach[-1]
+ target = uniform
backward draws blind to the filter's weights
- (log_w - 0.5 * jnp.sum(f**2, axis=0))
+ (-0.5 * jnp.sum(f**2, axis=0))
# estimate/smoother/particle/filter.py
## test_particle.py::test_systematic_draws_are_unbiased
every draw of the systematic resampling at its stratum's end
- (count / reach[-1]) - offset)
+ (count / reach[-1]))
# estimate/em/quadratic.py
## test_mstep.py::test_score_is_the_gradient_of_the_likelihood
score of the process noise without its mean
- jnp.mean(push**2, axis=0) - expected
+ jnp.mean(push**2, axis=0)
score of R by standard deviation
- misfit / r[None] - 1.0
+ misfit / jnp.sqrt(r)[None] - 1.0
## test_mstep.py::test_information_is_the_dense_fisher_information
information blind to the filter
- s = s - gain[i][:, None] * j[None, :]
+ s = s
## test_sensors.py::test_what_accelerometers_feel_of_friction_and_mass_counts_in_score_and_information
friction that an accelerometer feels left out of the score
- score = score + jnp.concatenate([of_torque, of_readings])
+ score = score + jnp.concatenate([0 * of_torque, of_readings])
# estimate/em/mstep.py
## test_mstep.py::test_sequences_that_are_not_used_have_no_weight
sequences that are left out count
- a.ndim - 1)), a, 0.0)
+ a.ndim - 1)), a, a)
mean over sequences for their sum
- jnp.sum(pick(a), axis=0), terms
+ jnp.mean(pick(a), axis=0), terms
## test_mstep.py::test_symmetry_is_asked_of_every_node_only_while_the_horizon_grows
friction that may peak at rest while the horizon grows
- (jnp.asarray(1e4), jnp.asarray(1.0))
+ (jnp.asarray(1e4), self.symmetry_std)
## test_em.py::test_order_of_sequences_does_not_matter_and_garbage_is_left_out
garbage counts
- xp.maximum(0.5, 5 * spread)
+ xp.maximum(1e9, 5 * spread)
# estimate/em/weights.py
## test_mstep.py::test_fit_of_parameters_is_ridge_regression_within_their_bounds
M-step without its prior
- - score) + precision * (w - middle)
+ - score)
## test_mstep.py::test_sequences_that_are_not_used_have_no_weight
prior missing from the posterior precision
- return maps + jnp.diag(jnp.concatenate([jnp.zeros(size, maps.dtype), jnp.ones(more, maps.dtype)]))
+ return maps
# estimate/predict.py
## test_predict.py::test_horizon_errors_are_plain_arithmetic
error of an angle not wrapped
- error = (error + np.pi) % (2 * np.pi) - np.pi
+ error = error % (2 * np.pi)
## test_predict.py::test_std_grows_as_the_kicks_add_up
variance for a standard deviation in predicted kicks
- jnp.exp(0.5 * model.log_q)
+ jnp.exp(model.log_q)
## test_predict.py::test_uncertain_friction_widens_what_is_predicted_and_what_is_smoothed_where_nothing_is_read
smoothed states that a model does not widen
- path._replace(cov=path.cov + model_cov)
+ path._replace(cov=path.cov + 0.0 * model_cov)
# base/gaussian.py
## test_numerics.py::test_spd_solve_is_numpys[4]
solution without the diagonal
- s = s - row[m] * inverse[m] *
+ s = s - row[m] *
# estimate/em/multistep.py
## test_multistep.py::test_errors_are_those_of_the_model_run_alone
errors of the reading a row before
- at(known, starts[None] + ages[:, None])
+ at(known, starts[None] + ages[:, None] - 1)
## test_multistep.py::test_a_ratio_of_errors_is_that_of_the_sequences_used
the larger horizon decides a ratio of errors
- np.mean(second[first > 0] / first[first > 0])
+ np.sum(second) / np.sum(first)
ratio of errors counts unused sequences
- before, after = before[used], after[used]
+ before, after = before, after
what runs away counts as no error
- np.where(np.isfinite(after), after, np.inf)
+ np.where(np.isfinite(after), after, 0.0)
## test_multistep.py::test_weights_are_one_over_the_variance_and_less_for_outliers
robust weight not applied
- np.where(sound, size / scale**2
+ np.where(sound, 1 / scale**2
weights of sequences that are not used
- error = np.where(used[:, None, None, None], predictions.error, np.nan)
+ error = predictions.error
## test_multistep.py::test_a_loud_recording_counts_by_the_root_of_its_loudness
loud recordings decide alone
- np.sqrt(whole * single)
+ np.sqrt(whole * whole + 0 * single)
## test_fit.py::test_a_gauss_newton_step[a step is halved until the errors fall]
finish takes steps that raise the error
- trial_error, used) < 1 - LEAST_FALL:
+ trial_error, used) > 1 - LEAST_FALL:
finish takes no shorter steps
- for share in (1.0, 0.5, 0.25):
+ for share in (1.0,):
## test_fit.py::test_a_shaped_finish_adds_the_prior_of_friction_and_nothing_to_parameters
shape of friction pushed away from
- score[nodes] -= pull[nodes]
+ score[nodes] += pull[nodes]
## test_stated.py::test_forces_unsaid_move_states_as_the_same_input_does
forces unsaid that move no state
- [torque, linear.by_parameter, moved], axis=-1)
+ [torque, linear.by_parameter, 0.0 * moved], axis=-1)
# explain/diagnosis/hypothesis.py
## test_search.py::test_certainty_is_the_marginal_of_the_posterior
parameters of an effect looked for among those of the machine
- np.cumsum(sizes) + of.prior.size - sum(sizes)
+ np.cumsum(sizes)
## test_search.py::test_one_of_three_effects_goes_with_its_prior_and_its_reason
the next effect dropped
- enumerate(self.additions) if i != place
+ enumerate(self.additions) if i != place + 1
# explain/diagnosis/keys.py
## test_search.py::test_a_rest_belongs_to_the_law_of_the_same_signals_at_its_joint
rest of a law at another joint
- inside and free.joint == law.joint and
+ inside and
## test_search.py::test_a_function_of_each_turn_and_one_of_all_turns_are_rivals
a law takes the place of its like
- jax.tree.structure(model.effects[i]) != jax.tree
+ jax.tree.structure(model.effects[i]) == jax.tree
## test_search.py::test_a_round[a law at its other joint]
a law is stated at the first place
- plain(one) == plain(other)
+ plain(one) != plain(other)
# explain/diagnosis/propose.py
## test_search.py::test_a_fit_starts_where_the_screen_puts_a_linear_law_and_at_the_probe_of_another
a fit starts without what the screen says
- float(c) * (p - start)
+ (p - start)
# base/programs.py
## test_programs.py::test_programs_are_released_beyond_the_bound
programs let go below the bound
- if maps() <= most:
+ if maps() > most:
# estimate/em/weights.py
## test_multistep.py::test_friction_is_free_in_the_span_of_known_laws
prior of friction on its size
- others @ others.T /
+ np.eye(count) /
# estimate/identify.py
## test_fit.py::test_a_finish[that only the fitted sequences like]
multi-step fit to the sequences that judge it
- used & (part != out)
+ used
multi-step fit judged on its own sequences
- part == out)
+ part != out)
## test_fit.py::test_a_finish[that helps what is left out]
curvature of the weights before the finish
- hessian=info.hessian, top=top)
+ hessian=fitted.state.hessian, top=top)
# explain/diagnosis/columns.py
## test_multistep.py::test_a_probe_gives_the_same_column_beside_all_others_as_alone
columns of a stack in the wrong places
- full[:, index] =
+ full[:, index[::-1]] =
# estimate/em/readings.py
## test_multistep.py::test_all_measured_coordinates_must_be_white_or_where_none_is_measured_one_reading
one white coordinate is enough
- return max(coordinates or
+ return min(coordinates or
second differences for third
- np.diff(np.asarray(y, float), 3, axis=1)
+ np.diff(np.asarray(y, float), 2, axis=1)
# explain/diagnosis/refit.py
## test_fit.py::test_a_refit_goes_back_a_third_of_the_way_and_keeps_the_best
a refit keeps its last model
- _, core, path = best
+ _, _, path = best
a refit judged on sequences that are not used
- nan=-1e6)[used])
+ nan=-1e6))
stride of a refit not shortened
- stride, path = stride / 3, best[2]
+ stride, path = stride, best[2]
## test_fit.py::test_a_refit_goes_back_a_third_of_the_way_and_keeps_the_best
noise of a refit not held
- count >= NOISE_HELD_PASSES
+ count >= 0
# estimate/em/stated.py
## test_fit.py::test_recordings_that_disagree_and_forces_unsaid_widen_a_posterior_but_not_its_prior
a posterior wider than its prior
- prior + half @ np.linalg
+ half @ np.linalg
## test_fit.py::test_the_size_of_forces_unsaid_is_that_which_made_the_errors
forces unsaid larger than the errors tell
- noise = np.maximum(whole -
+ noise = np.maximum(whole - 0 *
# explain/diagnosis/residual.py
## test_residual.py::test_a_known_force_comes_back_within_its_standard_deviation_with_that_of_an_effect_and_without
force of the effects with the wrong sign
- change + by_effects[None]
+ change - by_effects[None]
## test_residual.py::test_there_is_an_innovation_where_there_is_a_reading
innovations not masked
- jnp.where(prepared.observed, filtered.innovation, jnp.nan)
+ filtered.innovation
## test_residual.py::test_lost_sequences_take_no_part
lost sequences take part in the tests
- part[self.used] for part in self
+ part for part in self
# explain/diagnosis/statistics.py
## test_residual.py::test_holm_by_hand
Bonferroni for Holm
- (values.size - np.arange(values.size)) * values[order]
+ values.size * values[order]
## test_residual.py::test_autoregression_fails_and_its_coefficient_is_the_size
autocovariance not over that of lag 0
- np.maximum(pairs, 1.0) * (pairs[0] / sums[0]), pairs
+ np.maximum(pairs, 1.0), pairs
# explain/design/signals.py
## test_design.py::test_inputs_keep_to_torque_and_its_change
a design that forgets the limit of torque
- np.minimum(limits.high, rest + left)
+ rest + left + limits.high
## test_design.py::test_inputs_keep_to_torque_and_its_change
a design that forgets how fast torque may change
- most, out = limits.rate * (t[1] - t[0])
+ most, out = 9 * limits.rate * (t[1] - t[0])
# explain/design/play.py
## test_design.py::test_a_motion_is_allowed_that_stays_inside_its_limits_by_more_than_its_spread
a design that looks at no limit of the motion
- return inside & below & above
+ return np.ones_like(inside)
# explain/design/criteria.py
## test_design.py::test_covariance_after_more_information_is_that_of_the_sum_of_precisions
covariance after an experiment transposed
- np.eye(len(cov)) + cov @ information
+ np.eye(len(cov)) + information @ cov
## test_design.py::test_friction_near_rest_counts_as_much_as_all_the_rest
a friction band that counts at speed alone
- np.mean(np.log(mean + 1e-30), axis=-1)
+ np.log(mean + 1e-30)[..., 0]
# explain/design/information.py
## test_design.py::test_information_along_the_logs_is_the_curvature_of_their_fit
information of steps outside the data
- jnp.where(linear.seq.active[:, None, None], jnp.concatenate(
+ jnp.where(~linear.seq.active[:, None, None], jnp.concatenate(
# explain/design/limits.py
## test_design.py::test_declared_limits_hold_and_wrong_ones_are_told
declared limits that are not heeded
- declared.get(name, (lo, hi))
+ (lo, hi)
# machines/limits.py
## test_design.py::test_limits_are_read_and_written_and_wrong_ones_refused
a bound of one number that holds one way
- low = -high
+ low = 0.0
# logs/importing/signals.py
## test_import.py::test_the_mean_of_a_held_signal_is_that_of_its_values_on_a_fine_grid
a command is that of the row after
- side="right") - 1, 0, signal.t.size - 1)
+ side="right"), 0, signal.t.size - 1)
## test_counters.py::test_nothing_is_interpolated_across_a_jump
readings interpolated across the jump of a counter
- (~across & (near | (width <= SLOW * dt)))
+ (near | (width <= SLOW * dt))
## test_import.py::test_a_reading_is_interpolated_only_between_near_neighbours
readings interpolated over a gap
- (near | (width <= SLOW * dt))) | exact
+ (near | (width <= 9 * SLOW * dt))) | exact
# logs/held.py
## test_held.py::test_an_encoder_holds_nothing
an encoder that creeps taken for a held one
- quanta * float
+ 0.1 * float
# logs/counters.py
## test_counters.py::test_what_machines_do_is_no_counter
motion against the jump on one side taken for a counter
- (way * before > moved) & (way * after > moved)
+ (way * before > moved) | (way * after > moved)
# logs/rough.py
## test_rough.py::test_one_count_of_an_encoder_is_no_spike_of_its_rate
a count of an encoder taken for a spike of its rate
- 2 * resolution(
+ 0 * resolution(
## test_rough.py::test_a_late_and_a_saturated_sensor_are_found
a stop taken on the wrong side of its limit
- np.max(sign * inside if
+ np.max(-sign * inside if
# estimate/em/build.py
## test_check.py::test_a_machine_at_one_speed_has_come_to_it_within_a_sequence
acceleration held against a speed
- np.maximum(acceleration, least)
+ np.maximum(acceleration, speed)
## test_start.py::test_an_angle_that_is_read_late_has_hypotheses
an angle that is read late has no hypotheses
- scales.speed[joint] * late <= MOVED
+ scales.speed[joint] * late <= math.inf
# logs/importing/signals.py
## test_import.py::test_sequences_are_cut_at_gaps[readings]
a gap does not end a sequence
- np.diff(signal.t) > signal.longest)
+ np.diff(signal.t) > 9 * signal.longest)
# logs/importing/objects.py
## test_recordings.py::test_messages_of_many_forms_on_one_topic_are_read_by_the_names_in_each
names of the first message are those of all
- return _places(tuple(found))
+ return _places(("a", "b"))
# logs/importing/bags.py
## test_recordings.py::test_bags_of_ros_1_and_2_are_read[1-a.bag]
nanoseconds of a stamp left out
- stamp[1].astype(np.int64)
+ 0 * stamp[1].astype(np.int64)
# logs/importing/clock.py
## test_recordings.py::test_which_clock_is_taken_and_why[backwards]
header stamps that run backwards are taken
- np.sum(np.diff(used) < 0)
+ np.sum(np.diff(used) < -1e18)
## test_clocks.py::test_which_times_are_of_one_clock
fewer rows are left out than are no sequence
- few = size <= 50
+ few = size < 50
# logs/formats.py
## test_clocks.py::test_fields_are_named_by_their_lines
a short row is named by the line after
- return refuse(self.path, f"line {self.at[k]}"
+ return refuse(self.path, f"line {self.at[k] + 1}"
a field is named by the line before
- f"line {self.at[k]}, column {name!r}"
+ f"line {self.at[k] - 1}, column {name!r}"
# logs/importing/text_file.py
## test_dialects.py::test_a_plain_csv_file_is_none_of_another_dialect
a name that stands twice is no other dialect
- odd = len(set(names)) < len(names) or any(
+ odd = any(
# machines/systems/recursion.py
## test_machines.py::test_mass_bias_and_acceleration_are_those_of_mujoco[branch.xml]
Coriolis force of a slide halved
- scaled(2.0, cross(spin, velocity))
+ scaled(1.0, cross(spin, velocity))
a composite body about another point
- about(scaled(times(0.5, body.mass), place), place)
+ about(scaled(times(0.4, body.mass), place), place)
# machines/systems/frames.py
## test_machines.py::test_mass_bias_and_acceleration_are_those_of_mujoco[branch.xml]
an anchor left out
- place = -turn @ np.asarray(joint.anchor)
+ place = np.zeros(3)
# machines/systems/bodies.py
## test_machines.py::test_unphysical_bodies_have_no_numbers
bodies that cannot be
- mass = jnp.where(physical(mass, tensor), mass, jnp.nan)
+ mass = jnp.asarray(mass)
## test_machines.py::test_a_step_of_a_whole_body_ends_at_one_that_can_be
a step out of the physical ones
- jnp.where(fine, after[name], one)
+ jnp.where(fine, after[name], after[name])
## test_machines.py::test_a_payload_of_any_mass_and_centre_moves_the_machine_as_in_mujoco
a load in the middle
- add(scaled(mass, spot.point), moment)
+ moment
# machines/systems/sensing.py
## test_sensors.py::test_readings_are_those_of_mujoco_under_torque_and_friction
an accelerometer without what turning adds
- add(cross(turns, place), cross(spin, cross(spin, place)))
+ cross(turns, place)
a sensor in the axes of its joint
- transposed(product(mount.turn, sensor.turn))
+ transposed(mount.turn)
# machines/table.py
## test_rig.py::test_every_mistake_is_named_at_once
mistakes after the first left unsaid
- mistakes[str(error)] = error
+ mistakes.setdefault("", error)
## test_rig.py::test_a_name_of_any_letters_comes_back[joint 1 [rad]]
a bracket lost from a name
- re.ASCII) else toml_text(name)
+ re.ASCII) else toml_text(name.strip("]"))
# logs/draft/draft.py
## test_draft.py::test_columns_with_other_names_or_units_are_mapped[from 0]
joints counted from 0 taken as they are
- shift = {of.kind == "input" for _, _, of in every if of.number == 0}
+ shift = set[bool]()
## test_draft.py::test_the_clock_of_a_log_is_read_or_asked_for[session]
a clock that runs on taken for one from 0
- since = 1e-9 * origin if
+ since = 0.0 if
# machines/files/mjcf.py
## test_servos.py::test_servos_of_files_give_the_force_of_mujoco
damping of a servo left out
- return "position", {"kp": kp, "kd": kd, **extras}
+ return "position", {"kp": kp, "kd": 0.0, **extras}
## test_machines.py::test_a_draft_holds_joints_that_move_no_mass_and_couplings_that_no_log_has
a follower held at zero
- leader: 0.0, name: law(0.0)}
+ leader: 0.0, name: 0.0}
# machines/files/spec.py
## test_written_back.py::test_a_written_file_is_that_of_its_owner
a machine's file written with MuJoCo's own six digits
- DIGITS = 15
+ DIGITS = 6
# machines/files/locked.py
## test_locked.py::test_mass_and_bias_are_those_of_the_whole_with_joints_held[a tree]
a held body placed along the axes of the world
- turns[parent].T @ (places[i] - places[parent])
+ places[i] - places[parent]
# output/export/unroll.py
## test_unroll.py::test_compiled_c_has_the_numbers_of_jax[where]
branches of a choice in C the other way round
- ("{0} ? {2} : {1}",
+ ("{0} ? {1} : {2}",
# output/export/placement.py
## test_played.py::test_a_law_in_the_file_accelerates_as_in_the_library[torsional_spring]
a spring written with the other sign
- -float(law.slope)
+ float(law.slope)
# output/export/urdf.py
## test_written_back.py::test_a_urdf_file_is_written_again_with_the_numbers_of_the_fit[whole]
half of a body's change written to its link of a URDF file
- own += change
+ own += 0.5 * change
# output/export/friction.py
## test_written_back.py::test_coulomb_and_viscous_friction_are_read_off_a_curve
friction written back with the other sign
- nearest(v, torque,
+ nearest(v, -torque,
# explain/diagnosis/screen.py
## test_shares.py::test_the_nuisance_is_projected_out_by_ridge_regression
nuisance not projected out of the error
- error -= nuisance @ cho_solve(factor, nuisance.T @ error - pull)
+ error -= 0 * nuisance @ cho_solve(factor, nuisance.T @ error - pull)
nuisance not projected out of the columns
- left -= nuisance @ cho_solve(factor, nuisance.T @ left)
+ left -= 0.0
a prior that draws the change to zero
- nuisance.T @ error - pull)
+ nuisance.T @ error)
## test_search.py::test_a_round[a law within twice the chance level]
chance does not raise the bar
- return max(self.floor, CHANCE * self.chance)
+ return self.floor
## test_shares.py::test_what_happens_at_one_moment_of_every_recording_is_no_law
folds are blocks of time
- np.stack([sums.left_out(fold == f) for f in np.unique(fold)], axis=1)
+ np.stack([sums.left_out(block == f) for f in np.unique(fold)], axis=1)
## test_shares.py::test_shares_are_those_of_least_squares
a fit to the part that is left out
- self._solved(self.score[~cells].sum(axis=0), self.gram[~cells].sum(axis=0))
+ self._solved(self.score[cells].sum(axis=0), self.gram[cells].sum(axis=0))
## test_shares.py::test_a_part_with_hardly_any_error_is_harmed_by_what_that_is_of_an_average_one
a part that holds little decides
- np.where(out < 0, np.maximum(held, held.mean()), held)
+ held
## test_shares.py::test_errors_that_overlap_count_for_less
errors that overlap count in full
- np.maximum(len(rows.error) / rows.overlap, directions + 2)
+ np.maximum(len(rows.error), directions + 2)
## test_shares.py::test_the_placebo_of_a_constant_explains_nothing
the placebo of a constant keeps its meaning
- moved[:by] *= -1
+ moved[:by] *= 1
# explain/diagnosis/verdict.py
## test_verdict.py::test_the_smaller_share_counts
the larger of two shares
- return min(self.inside, self.left_out)
+ return max(self.inside, self.left_out)
## test_verdict.py::test_a_refit_vetoes_what_is_impossible_or_small
a refit that removes next to nothing
- return share >= KEEP * floor
+ return share >= 0
## test_verdict.py::test_a_later_law_removes_much_of_what_is_left_and_something_of_the_first_error
a later law removes the floor of the first error, however little is left
- MULTI_STEP / math.sqrt(
+ MULTI_STEP / float(
## test_verdict.py::test_a_remainder_comes_before_a_named_law_and_that_before_a_free_one
free laws before named ones
- NAMED ** (1 + complexity)
+ NAMED
## test_verdict.py::test_a_suspect_removes_half_of_the_floor_and_twice_what_chance_does
a suspect within what chance does
- max(SUSPECT * floor, CHANCE * chance)
+ SUSPECT * floor
## test_search.py::test_a_round[another cause that is not]
a bump is a ripple
- if value >= EQUIVALENT * max(values)]
+ if value >= 0.6 * max(values)]
# explain/diagnosis/screen.py
## test_search.py::test_a_round[a law that friction can stand for]
a column of the nuisance is a candidate
- return self.survived >= SURVIVES and
+ return
# explain/diagnosis/context.py
## test_search.py::test_a_search_begins_at_the_whole_length_unless_most_sequences_are_lost_there
a search with a hidden joint begins where friction has taken the law
- else growing[-1:]), longest]
+ else ()), longest]
## test_search.py::test_the_fit_of_the_least_error_is_kept_the_likelier_of_near_ones_and_none_that_predicts_worse
a fit that predicts worse is kept
- if min(left) > 1:
+ if min(left) < 0:
the worst of two fits is kept
- return int(np.argmin(left))
+ return int(np.argmax(left))
## test_search.py::test_one_fit_is_likelier_than_another_where_most_sequences_are
the fit that is behind wins
- np.nan_to_num(a, nan=-1e3) - np.nan_to_num(b, nan=-1e3)
+ np.nan_to_num(b, nan=-1e3) - np.nan_to_num(a, nan=-1e3)
# explain/diagnosis/rounds.py
## test_search.py::test_a_round[a function where they have not]
a free function is a change whatever the errors
- law.named or context.functions
+ True
## test_search.py::test_a_round[a refit removes less]
the first law that a refit leaves is accepted
- > EXCEEDS * _largest(
+ > 0 * _largest(
## test_search.py::test_a_round[even after the refit too]
the weakest of even laws leads
- simplest(worths, _complexities(admissible, model), values)
+ simplest(worths, _complexities(admissible, model), [-value for value in values])
## test_search.py::test_a_round[the best of a kind]
the weakest of a kind stands for it
- best[key].rank < screened.rank
+ best[key].rank > screened.rank
## test_search.py::test_a_round[another cause explaining the same]
laws of one cause leave the question open
- of_best.isdisjoint(of_one)
+ not of_best.isdisjoint(of_one)
## test_search.py::test_suspects_are_near_the_best_and_over_chance_with_named_laws_first
free suspects before named ones
- near.sort(key=lambda s: not s.candidate.start.named)
+ near.sort(key=lambda s: s.candidate.start.named)
# explain/diagnosis/search.py
## test_search.py::test_laws_go_without_which_too_little_is_lost_the_least_first
the most needed law is tried without
- least = int(np.argmin(lost))
+ least = int(np.argmax(lost))
# explain/diagnosis/verdict.py
## test_verdict.py::test_of_few_recordings_a_standard_deviation_is_hardly_known
two recordings are as sure as many
- max(recordings - 1, 1)
+ math.inf
# explain/diagnosis/rounds.py
## test_search.py::test_a_named_law_gives_way_to_a_remainder_that_explains_the_larger_part
a law stays beside any remainder
- form is None and 0 in even(
+ form is None and 0 not in even(
# explain/diagnosis/search.py
## test_search.py::test_a_search_keeps_what_was_accepted_before[a matrix is singular in the second round]
a round that fails loses what was found
- yield case
+ yield Progress(case.hypothesis)
# explain/diagnosis/trial.py
## test_search.py::test_the_start_of_a_law_whose_step_removes_most_is_refitted
the worst start of a law
- return max(begun, key
+ return min(begun, key
## test_search.py::test_a_refit_that_errs_more_than_its_start_is_not_kept
a refit that errs more is kept
- band=0) <= 1 else
+ band=0) <= 9 else
## test_loop.py::test_a_spring_is_named_and_sized_and_other_recordings_compile_nothing
what a refit leaves counts as what it removes
- removed = 1 - ratio(
+ removed = ratio(
# explain/diagnosis/rounds.py
## test_search.py::test_a_round[another start]
a law from one start
- near = [s for s in same if s.share.least >= EQUIVALENT * law.share.least]
+ near = [law]
## test_search.py::test_a_round[a refit shows what is left]
forms of a law that remove nearly all explain the same
- admissible, reductions(values), model
+ admissible, values, model
# model/effects/base.py
## test_inputs.py::test_what_is_not_seen_to_repeat_has_no_periods
a bump is a cogging
- >= 3 * np.pi
+ >= 2 * np.pi
# model/effects/friction.py
## test_inputs.py::test_what_is_not_seen_to_repeat_has_no_periods
friction by angle need not repeat
- return self.repeats(self.n, around)
+ return True
## test_inputs.py::test_dry_friction_at_an_angle_is_one_free_function_against_the_motion
a form that is known has a price
- return self.axis.names
+ return self.inputs_named()
# explain/diagnosis/keys.py
## test_inputs.py::test_dry_friction_at_an_angle_is_one_free_function_against_the_motion
dry friction stands for a brake
- and law.dry >= free.dry
+ and True
# explain/diagnosis/propose.py
## test_inputs.py::test_a_joint_is_seen_where_it_moves
rest is seen
- np.nanpercentile(moving,
+ np.nanpercentile(mean[:, :dof],
# explain/diagnosis/backward.py
## test_search.py::test_a_law_of_a_rate_is_judged_by_that_reading_too
a law of a rate is judged by the coordinates alone
- every.append((0, (own,)))
+ every.append((0, ()))
# explain/diagnosis/screen.py
## test_shares.py::test_recordings_of_one_motion_are_left_out_together
recordings of one motion are evidence of each other
- if difference < REPEATS * square:
+ if difference < 0 * square:
## test_shares.py::test_folds_are_neighbours_and_pieces_where_there_are_few
folds interleaved
- (order * min(MOTION_PARTS, count) // count)
+ (order % min(MOTION_PARTS, count))
# explain/diagnosis/diagnose.py
## test_search.py::test_declared_numbers_are_held_where_all_is_read_and_released_at_the_end
numbers that were held are held more at the end
- rule.prior.std / HELD, rule.prior.std
+ rule.prior.std * HELD, rule.prior.std
## test_search.py::test_states_are_smoothed_and_predicted_by_the_branches_that_a_search_leaves_out
branches of a hidden angle lost by a search
- (fit._replace(smoother=CubatureSmoother(fit.bank)) for
+ (fit for
# explain/diagnosis/equations.py
## test_equation_laws.py::test_of_two_laws_the_share_that_is_lost_without_each_decides
a law of equations is lost with all others
- 1 - whole / left(one, search.fit(one, [((), ())]).get(0))
+ 1 - left(one, search.fit(one, [((), ())]).get(0)) / whole
## test_equation_laws.py::test_a_strength_that_is_not_determined_is_refused
a strength of equations that is not determined
- certainty(*each) >= DETERMINED for
+ certainty(*each) >= 0 for
## test_equation_laws.py::test_noise_of_readings_is_no_room_for_laws
a fast signal counts as noise of a reading
- np.min(every, axis=0)
+ np.min(every[1:], axis=0)
## test_equation_laws.py::test_laws_that_make_a_reading_worse_at_some_age_are_refused
a law of equations may make a reading worse
- .mean(axis=0) >= AGREE
+ .mean(axis=0) > 1
## test_equation_laws.py::test_each_law_of_a_pair_is_tried_in_the_place_of_the_other
laws that explain less than a law of equations take its place
- case.sound and explained(case) >= EQUIVALENT * explained(best)
+ case.sound and explained(case) >= 0.8 * explained(best)
# estimate/known.py
## test_changed.py::test_a_fit_from_a_fit_is_that_of_all_logs
the declared prior counts again after a fit
- / hold**2 - jnp.diag(jnp.asarray(own))
+ / hold**2
# estimate/em/equations.py
## test_equations.py::test_unstable_modes_and_integrators_are_those_of_the_eigenvalues
growth of half a recording over the whole one
- "growth": grown / (half * dt)
+ "growth": grown / (2 * half * dt)
# estimate/em/simulated.py
## test_equations.py::test_a_simulation_that_runs_away_makes_no_step_singular
slopes of simulations that have run away
- np.abs(of.error) < FARTHEST * scale
+ np.isfinite(of.error)
# estimate/identify.py
## test_equations.py::test_the_fit_of_the_smaller_errors_is_kept
the fit to long horizons kept in any case
- if costs[0] < costs[1]:
+ if False:
""")


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
