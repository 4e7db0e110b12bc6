/* Observer of $rig: written by nnap_em $version.
   SI units, a row every $dt s.  States: $states.
   Inputs u, $held: $columns.
   Readings y; NaN is none: $measured.

   nnap_start(&s, time), then in every row flags = nnap_step(&s, u, y); a row without readings is one of NaN.
   s.mean and s.std are the estimate, s.innovation the readings minus their prediction over the standard deviation,
   s.misfit the mean of their squares (1 where the model is right), s.weight the probability of this branch. */
#ifndef NNAP_H
#define NNAP_H

enum { $sizes };
/* A reading is no number; one is beyond $gate standard deviations and not read; an input is no number and
   the one before holds; the estimate diverged and starts anew; several branches are left. */
enum { nnap_MISSING = 1, nnap_OUTLIER = 2, nnap_NO_INPUT = 4, nnap_RESTARTED = 8, nnap_AMBIGUOUS = 16 };

typedef $real nnap_real;
typedef struct {
    nnap_real mean[NNAP_STATES], root[NNAP_STATES][NNAP_STATES], log_weight;
    nnap_real innovation[NNAP_READINGS];
} nnap_branch;
typedef struct {
    nnap_real mean[NNAP_STATES], std[NNAP_STATES], innovation[NNAP_READINGS], late[NNAP_READINGS];
    nnap_real u[NNAP_INPUTS + !NNAP_INPUTS], misfit, weight, memory[$memory], fed[$drives], past[$drives];
    double time, age;
    int rows, live;
    nnap_branch branch[NNAP_BRANCHES + 2];
} nnap_state;

void nnap_start(nnap_state *s, double time);
int nnap_step(nnap_state *s, const nnap_real *u, const nnap_real *y);
void nnap_covariance(const nnap_state *s, nnap_real *covariance);

#endif
