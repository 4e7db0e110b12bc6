/* Covariances are S S' with S lower triangular: rounding cannot make one negative.
   [Arasaratnam & Haykin 2009, IEEE Trans. Autom. Control 54(6), for cubature by square roots; Bierman 1977,
   "Factorization Methods for Discrete Sequential Estimation", sec. V.3, for an update that keeps S triangular] */

/* S of the sum of squares of the rows of w, by Householder reflections; `columns` are of use. */
static void triangle(real w[N][3 * N + 1], int columns, real s[N][N])
{
    for (int i = 0; i < N; i++) {
        real square = 0, norm, first, scale;
        for (int k = i; k < columns; k++) square += w[i][k] * w[i][k];
        norm = SQRT(square);
        for (int k = 0; k < N; k++) s[i][k] = k < i ? w[i][k] : 0;
        if (!(norm > 0)) continue;
        first = w[i][i] > 0 ? w[i][i] + norm : w[i][i] - norm;
        scale = 1 / (norm * FABS(first));
        for (int j = i + 1; j < N; j++) {
            real along = w[j][i] * first;
            for (int k = i + 1; k < columns; k++) along += w[j][k] * w[i][k];
            along *= scale;
            w[j][i] -= along * first;
            for (int k = i + 1; k < columns; k++) w[j][k] -= along * w[i][k];
            if (w[i][i] > 0) w[j][i] = -w[j][i];
        }
        s[i][i] = norm;
    }
}

/* States one row later, by Runge-Kutta steps; points are the last axis, so that a compiler with vectors may use them. */
static void transition(const real *in, real x[N][2 * N])
{
    static const real ahead[4] = {(real)0.5, (real)0.5, 1, 0}, share[4] = {1, 2, 2, 1};
    const real h = (real)(DT / SUBSTEPS);
#if SMOOTH
    static const real when[4] = {0, (real)0.5, (real)0.5, 1};
    real now[ROW];
    for (int i = 0; i < ROW; i++) now[i] = in[i];
#else
    const real *now = in;
#endif
    for (int n = 0; n < SUBSTEPS; n++) {
        real at[N][2 * N], start[N][2 * N], slope[N][2 * N];
        for (int i = 0; i < N; i++)
            for (int j = 0; j < 2 * N; j++) at[i][j] = start[i][j] = x[i][j];
        for (int stage = 0; stage < 4; stage++) {
            const real forward = h * ahead[stage], part = h / 6 * share[stage];
#if SMOOTH
            const real s = (n + when[stage]) / SUBSTEPS;
            for (int i = 0; i < D; i++) now[i] = in[i] + s * (in[COURSE + i] - (1 - s) / 2 * in[COURSE + D + i]);
#endif
            rate((const real (*)[2 * N])at, now, slope);
            for (int i = 0; i < N; i++)
                for (int j = 0; j < 2 * N; j++) {
                    at[i][j] = start[i][j] + forward * slope[i][j];
                    x[i][j] += part * slope[i][j];
                }
        }
    }
}

/* One branch a row later, by cubature: the points are opposite pairs along the columns of the root. */
static void predict(const real *in, nnap_branch *b)
{
    real x[N][2 * N], w[N][3 * N + 1], reach = SQRT((real)N);
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++) {
            x[i][j] = b->mean[i] + reach * b->root[i][j];
            x[i][N + j] = b->mean[i] - reach * b->root[i][j];
        }
    transition(in, x);
    for (int i = 0; i < N; i++) {
        real sum = 0;
        for (int j = 0; j < N; j++) sum += x[i][j] + x[i][N + j];
        b->mean[i] = sum / (2 * N);
        for (int j = 0; j < N; j++) {
            w[i][j] = (x[i][j] - x[i][N + j]) / (2 * reach);
            w[i][N + j] = ((x[i][j] + x[i][N + j]) / 2 - b->mean[i]) / reach;
            w[i][2 * N + j] = i == j ? kick[i] : 0;
        }
    }
    triangle(w, 3 * N, b->root);
}

/* Gain times the variance of the innovation, and that variance, of a reading with slopes h and noise variance r;
   the covariance after it where `keep` is 0. */
static real update(const real h[N], real r, int keep, real root[N][N], real along[N])
{
    real f[N], sum = r;
    for (int j = 0; j < N; j++) {
        f[j] = along[j] = 0;
        for (int i = j; i < N; i++) f[j] += root[i][j] * h[i];
    }
    for (int k = N - 1; k >= 0; k--) {
        const real before = sum;
        sum += f[k] * f[k];
        const real shrink = SQRT(before / sum), take = f[k] / SQRT(sum * before);
        for (int i = k; i < N; i++) {
            const real old = root[i][k];
            if (!keep) root[i][k] = old * shrink - along[i] * take;
            along[i] += f[k] * old;
        }
    }
    return sum;
}

/* A branch after the readings that `use` has, the others aside; `innovation` gets those of them. */
static void absorb(const real *in, const real y[M], const int use[M], real gate, nnap_branch *b)
{
    real value[M + M * N], about[N], along[N];
    reading(b->mean, in, value);
    for (int i = 0; i < N; i++) about[i] = b->mean[i];
    for (int i = 0; i < M; i++) {
        real *h = value + M + i * N, e, r = noise[i] * noise[i], s, white;
        if (!use[i]) continue;
        e = y[i] - value[i];
        for (int k = 0; k < N; k++) e -= h[k] * (b->mean[k] - about[k]);
        s = update(h, r, 1, b->root, along);
        white = e / SQRT(s);
        b->innovation[i] = white;
        b->log_weight -= (LOG(s) + (FABS(white) < gate ? white * white : gate * gate)) / 2;
        if (!(FABS(white) <= gate)) continue;
        update(h, r, 0, b->root, along);
        for (int k = 0; k < N; k++) b->mean[k] += along[k] / s * e;
    }
}

static int likeliest(const nnap_state *s)
{
    int best = 0;
    for (int k = 1; k < s->live; k++)
        if (s->branch[k].log_weight > s->branch[best].log_weight) best = k;
    return best;
}

static int sound(const nnap_branch *b)
{
    int good = isfinite(b->log_weight) != 0;
    for (int i = 0; i < N; i++) {
        good = good && FABS(b->mean[i]) < FAR_AWAY;
        for (int j = 0; j <= i; j++) good = good && FABS(b->root[i][j]) < FAR_AWAY;
    }
    return good;
}

static void alone(nnap_state *s, const real mean[N], const real root[N][N])
{
    s->live = 1;
    s->branch[0].log_weight = 0;
    for (int i = 0; i < M; i++) s->branch[0].innovation[i] = 0;
    for (int i = 0; i < N; i++) {
        s->branch[0].mean[i] = mean[i];
        for (int j = 0; j < N; j++) s->branch[0].root[i][j] = root[i][j];
    }
}

#if BRANCHES > 1
static real variance(const nnap_branch *b, int i)
{
    real sum = 0;
    for (int j = 0; j <= i; j++) sum += b->root[i][j] * b->root[i][j];
    return sum;
}

static real log_det(real root[N][N])
{
    real sum = 0;
    for (int i = 0; i < N; i++) sum += 2 * LOG(root[i][i]);
    return sum;
}

/* Two branches as one of their moments; half of the bound on the change of the mixture [Runnalls 2007, eq. 16]. */
static real joined(const nnap_branch *a, const nnap_branch *b, real most, nnap_branch *both)
{
    nnap_branch one = *a, other = *b;
    const real wa = EXP(a->log_weight - most), wb = EXP(b->log_weight - most), share = wa / (wa + wb);
    real w[N][3 * N + 1];
    *both = wa >= wb ? one : other;
    for (int i = 0; i < N; i++) {
        both->mean[i] = share * one.mean[i] + (1 - share) * other.mean[i];
        for (int j = 0; j < N; j++) {
            w[i][j] = SQRT(share) * one.root[i][j];
            w[i][N + j] = SQRT(1 - share) * other.root[i][j];
        }
        w[i][2 * N] = SQRT(share * (1 - share)) * (one.mean[i] - other.mean[i]);
    }
    triangle(w, 2 * N + 1, both->root);
    both->log_weight = most + LOG(wa + wb);
    return (wa + wb) * log_det(both->root) - wa * log_det(one.root) - wb * log_det(other.root);
}

/* The likeliest of the branches that are wide along an angle becomes three; two become one where there is no room. */
static void part(nnap_state *s)
{
    const real narrow = (real)4 / 9, noise = narrow / (1 - narrow), reach = SQRT(3 * (1 - narrow));
    const real top = s->branch[likeliest(s)].log_weight;
    int which = -1, angle = 0, left = 0;
    for (int k = 0; k < s->live; k++)
        if (EXP(s->branch[k].log_weight - top) > 0 && sound(&s->branch[k])) s->branch[left++] = s->branch[k];
    s->live = left;
    for (int k = 0; k < s->live; k++) {
        real widest = 0;
        for (int a = 0; a < ANGLES; a++) widest = FMAX(widest, variance(&s->branch[k], angles[a]));
        if (widest > WIDE * WIDE && (which < 0 || s->branch[k].log_weight > s->branch[which].log_weight)) which = k;
    }
    if (which < 0) return;
    nnap_branch *middle = &s->branch[which], *low = &s->branch[s->live], *high = &s->branch[s->live + 1];
    for (int a = 1; a < ANGLES; a++)
        if (variance(middle, angles[a]) > variance(middle, angles[angle])) angle = a;
    real h[N] = {0}, along[N];
    h[angles[angle]] = 1;
    const real var = variance(middle, angles[angle]);
    update(h, noise * var, 0, middle->root, along);
    *low = *high = *middle;
    middle->log_weight += LOG((real)2 / 3);
    low->log_weight = high->log_weight = low->log_weight - LOG((real)6);
    for (int i = 0; i < N; i++) {
        low->mean[i] -= reach * along[i] / SQRT(var);
        high->mean[i] += reach * along[i] / SQRT(var);
    }
    for (s->live += 2; s->live > BRANCHES; s->live--) {
        const real most = s->branch[likeliest(s)].log_weight;
        int first = 0, second = 1;
        real least = INFINITY;
        nnap_branch both;
        for (int i = 0; i < s->live; i++)
            for (int j = i + 1; j < s->live; j++) {
                const real bound = joined(&s->branch[i], &s->branch[j], most, &both);
                if (bound < least) least = bound, first = i, second = j;
            }
        joined(&s->branch[first], &s->branch[second], most, &s->branch[first]);
        s->branch[second] = s->branch[s->live - 1];
    }
}

/* Branches end that have lost, or are the likeliest one. */
static void prune(nnap_state *s)
{
    nnap_branch best = s->branch[likeliest(s)];
    real share = 0;
    int left = 0, place = likeliest(s);
    for (int k = 0; k < s->live; k++) {
        const nnap_branch *b = &s->branch[k];
        int twin = k != place;
        for (int i = 0; i < N && twin; i++) {
            const real std = SQRT(variance(&best, i));
            twin = FABS(b->mean[i] - best.mean[i]) < TWIN * std && FABS(SQRT(variance(b, i)) - std) < TWIN * std;
        }
        if (twin) share += EXP(b->log_weight - best.log_weight);
        if (!twin && b->log_weight >= best.log_weight + LOG_LEAST) {
            if (k == place) place = left;
            s->branch[left++] = *b;
        }
    }
    s->live = left;
    s->branch[place].log_weight += LOG(1 + share);
}
#endif

/* Estimate, test and flags of a row whose branches are done. */
static void report(nnap_state *s, int best)
{
    real sum = 0;
    for (int k = 0; k < s->live; k++) sum += EXP(s->branch[k].log_weight - s->branch[best].log_weight);
    s->weight = 1 / sum;
    for (int i = 0; i < N; i++) {
        real square = 0;
        for (int j = 0; j <= i; j++) square += s->branch[best].root[i][j] * s->branch[best].root[i][j];
        s->mean[i] = s->branch[best].mean[i];
        s->std[i] = SQRT(square);
    }
    const real top = s->branch[best].log_weight;
    for (int k = 0; k < s->live; k++) s->branch[k].log_weight -= top;
}

/* One row: inputs held since the row before, or where these go on those of the row; readings. */
int nnap_step(nnap_state *s, const real *u, const real *y)
{
    const int first = s->age < -0.5 * DT;
    const real gate = s->rows < SETTLING ? INFINITY : GATE;
    const int takes = SMOOTH || !first;
    real in[ROW] = {0}, out[MEMORY + D + 1], value[M];
    int flags = 0, now[M], before[M], waiting = 0, count = 0, beyond = 0, best;
#if SMOOTH
    for (int i = 0; i < SCALES; i++) in[2 * D + 2 + i] = s->u[D + i];
#endif
    for (int i = 0; i < COLUMNS && takes; i++) {
        if (isfinite(u[i])) s->u[i] = u[i];
        else flags |= nnap_NO_INPUT;
    }
    for (int i = 0; i < M; i++) {
        const int read = isfinite(y[i]) != 0;
        if (!read) flags |= nnap_MISSING;
        before[i] = isfinite(s->late[i]) != 0;
        now[i] = read && !waits[i];
        value[i] = read ? y[i] : 0;
        waiting += before[i];
        count += now[i] + before[i];
    }
    for (int i = 0; i < D; i++) in[i] = in[D + i] = s->fed[i];
    if (takes) {
        const real begins = SMOOTH ? first : s->age < 0.5 * DT;
        commands(s->memory, s->u, &begins, out);
        for (int i = 0; i < MEMORY; i++) s->memory[i] = out[i];
        for (int i = 0; i < D; i++) s->fed[i] = out[MEMORY + i];
    }
#if SMOOTH
    for (int i = 0; i < D; i++) {
        in[COURSE + i] = s->fed[i] - in[i];
        if (s->age > 0.5 * DT) in[COURSE + D + i] = in[COURSE + i] - in[i] + s->past[i];
        s->past[i] = in[i];
    }
#else
    for (int i = 0; i < D; i++) in[i] = s->fed[i];
    for (int i = 0; i < SCALES; i++) in[2 * D + 2 + i] = s->u[D + i];
#endif
    in[2 * D] = (real)(s->time + 0.5 * DT);
    in[2 * D + 1] = (real)s->age;
    for (int k = 0; k < s->live; k++) {
        nnap_branch *b = &s->branch[k];
        for (int i = 0; i < M; i++) b->innovation[i] = 0;
        if (waiting) absorb(in, s->late, before, gate, b);
        if (!first) predict(in, b);
    }
    s->time += DT;
    s->age += DT;
    for (int i = 0; i < D; i++) in[D + i] = in[i], in[i] = s->fed[i];
#if SMOOTH
    for (int i = 0; i < SCALES; i++) in[2 * D + 2 + i] = s->u[D + i];
#endif
    in[2 * D] = (real)(s->time + 0.5 * DT);
    in[2 * D + 1] = (real)s->age;
    for (int k = 0; k < s->live; k++) {
        nnap_branch *b = &s->branch[k];
        absorb(in, value, now, gate, b);
        if (!isfinite(b->log_weight)) b->log_weight = -INFINITY;
    }
    best = likeliest(s);
    real sum = 0;
    for (int i = 0; i < M; i++) {
        const real square = s->branch[best].innovation[i] * s->branch[best].innovation[i];
        sum += square < GATE * GATE ? square : GATE * GATE;
        beyond = beyond || square > gate * gate;
        s->innovation[i] = s->branch[best].innovation[i];
        s->late[i] = isfinite(y[i]) && waits[i] ? y[i] : NAN;
    }
    if (count) s->misfit += FORGET * (sum / count - s->misfit);
    s->rows = s->rows < SETTLING ? s->rows + 1 : SETTLING;
    if (!(s->misfit < DIVERGED) || !sound(&s->branch[best])) {
        flags |= nnap_RESTARTED;
        alone(s, again_mean, again_root);
        absorb(in, value, now, INFINITY, &s->branch[0]);
        s->branch[0].log_weight = 0;
        for (int i = 0; i < M; i++) s->innovation[i] = 0;
        if (!sound(&s->branch[0])) alone(s, again_mean, again_root);
        s->misfit = 1;
        s->rows = 1;
        beyond = 0;
    }
#if BRANCHES > 1
    part(s);
    prune(s);
#endif
    best = likeliest(s);
    report(s, best);
    return flags | (beyond ? nnap_OUTLIER : 0) | (s->live > 1 ? nnap_AMBIGUOUS : 0);
}

void nnap_start(nnap_state *s, double time)
{
    alone(s, start_mean, start_root);
    for (int i = 0; i < MEMORY; i++) s->memory[i] = 0;
    for (int i = 0; i < COLUMNS; i++) s->u[i] = 0;
    for (int i = 0; i < D; i++) s->fed[i] = s->past[i] = 0;
    for (int i = 0; i < M; i++) s->late[i] = NAN;
    s->time = time - DT;
    s->age = -DT;
    s->rows = 0;
    s->misfit = 1;
    for (int i = 0; i < M; i++) s->innovation[i] = 0;
    report(s, 0);
}

void nnap_covariance(const nnap_state *s, real *cov)
{
    const nnap_branch *b = &s->branch[likeliest(s)];
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++) {
            cov[i * N + j] = 0;
            for (int k = 0; k <= (i < j ? i : j); k++) cov[i * N + j] += b->root[i][k] * b->root[j][k];
        }
}
