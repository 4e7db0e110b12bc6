/* The common work's extended Kalman filter and RTS smoother in plain C, with derivatives by hand.
   LANES sequences go side by side through every row, so that the inner loops vectorise.
   Compile: -O3 -march=native -ffast-math, link -lmvec -lm. */

#include <math.h>

#define WIDTH 16
#define EACH for (int l = 0; l < LANES; l++)
#define ALL(i, j) for (int i = 0; i < 4; i++) for (int j = 0; j < 4; j++)

typedef float Lane[LANES];

typedef struct {
    float first[WIDTH], first_bias[WIDTH], second[WIDTH][WIDTH], second_bias[WIDTH], last[WIDTH], last_bias;
} Network;

/* Lumped constants of the arm: mass matrix, gravity, and the coupling m2 l1 lc2; then variances. */
typedef struct {
    float inertia1, inertia2, coupling, gravity1, gravity2, dt, q[4], r[2], start[4], start_variance[4];
} Model;

/* What the backward pass needs of a row, and what it leaves there. */
typedef struct {
    Lane mean[4], cov[4][4], ahead[4], ahead_cov[4][4], slope[4][4], gain[4][4];
} Row;

static void friction(const Network *net, const float *restrict v, float *restrict torque, float *restrict steep) {
    Lane hidden[WIDTH], along[WIDTH];
    for (int i = 0; i < WIDTH; i++) {
        EACH hidden[i][l] = tanhf(net->first[i] * v[l] + net->first_bias[i]);
        EACH along[i][l] = net->first[i] * (1 - hidden[i][l] * hidden[i][l]);
    }
    EACH torque[l] = net->last_bias, steep[l] = 0;
    for (int i = 0; i < WIDTH; i++) {
        Lane sum, rise = {0};
        EACH sum[l] = net->second_bias[i];
        for (int j = 0; j < WIDTH; j++)
            EACH sum[l] += net->second[i][j] * hidden[j][l], rise[l] += net->second[i][j] * along[j][l];
        EACH sum[l] = tanhf(sum[l]);
        EACH torque[l] += net->last[i] * sum[l], steep[l] += net->last[i] * (1 - sum[l] * sum[l]) * rise[l];
    }
}

/* Accelerations, and their derivatives by the four states. */
static void rate(const Model *m, const Network *nets, const Lane u, Lane x[4], Lane a[2], Lane da[2][4]) {
    Lane torque[2], steep[2], sine, cosine, sine1, cosine1, sine12, cosine12;
    for (int j = 0; j < 2; j++) friction(&nets[j], x[2 + j], torque[j], steep[j]);
    EACH sine[l] = m->coupling * sinf(x[1][l]); /* one by one: sincosf has no vector form */
    EACH cosine[l] = m->coupling * cosf(x[1][l]);
    EACH sine1[l] = m->gravity1 * sinf(x[0][l]);
    EACH cosine1[l] = m->gravity1 * cosf(x[0][l]);
    EACH sine12[l] = m->gravity2 * sinf(x[0][l] + x[1][l]);
    EACH cosine12[l] = m->gravity2 * cosf(x[0][l] + x[1][l]);
    EACH {
        const float v1 = x[2][l], v2 = x[3][l], h = sine[l], c = cosine[l];
        const float m11 = m->inertia1 + 2 * c, m12 = m->inertia2 + c, m22 = m->inertia2;
        const float inverse = 1 / (m11 * m22 - m12 * m12), w11 = m22 * inverse, w12 = -m12 * inverse, w22 = m11 * inverse;
        const float f1 = torque[0][l] - sine1[l] - sine12[l] + h * v2 * (2 * v1 + v2);
        const float f2 = u[l] + torque[1][l] - sine12[l] - h * v1 * v1;
        const float a1 = w11 * f1 + w12 * f2, a2 = w12 * f1 + w22 * f2;
        const float left[4] = {-cosine1[l] - cosine12[l], -cosine12[l] + c * v2 * (2 * v1 + v2) + h * (2 * a1 + a2),
                               steep[0][l] + 2 * h * v2, 2 * h * (v1 + v2)};
        const float right[4] = {-cosine12[l], -cosine12[l] - c * v1 * v1 + h * a1, -2 * h * v1, steep[1][l]};
        a[0][l] = a1;
        a[1][l] = a2;
        for (int s = 0; s < 4; s++) {
            da[0][s][l] = w11 * left[s] + w12 * right[s];
            da[1][s][l] = w12 * left[s] + w22 * right[s];
        }
    }
}

/* One Runge-Kutta step and its matrix of derivatives. */
static void step(const Model *m, const Network *nets, const Lane u, Lane x[4], Lane end[4], Lane slope[4][4]) {
    const float share[4] = {1.f / 6, 1.f / 3, 1.f / 3, 1.f / 6}, ahead[4] = {.5f, .5f, 1.f, 0.f};
    Lane stage[4], tangent[4][4];
    for (int i = 0; i < 4; i++) EACH stage[i][l] = end[i][l] = x[i][l];
    ALL(i, j) EACH tangent[i][j][l] = slope[i][j][l] = i == j;
    for (int k = 0; k < 4; k++) {
        Lane a[2], da[2][4], change[4], turn[4][4];
        rate(m, nets, u, stage, a, da);
        for (int i = 0; i < 2; i++) {
            EACH change[i][l] = stage[2 + i][l], change[2 + i][l] = a[i][l];
            for (int j = 0; j < 4; j++) {
                EACH turn[i][j][l] = tangent[2 + i][j][l];
                EACH turn[2 + i][j][l] = da[i][0][l] * tangent[0][j][l] + da[i][1][l] * tangent[1][j][l] +
                                         da[i][2][l] * tangent[2][j][l] + da[i][3][l] * tangent[3][j][l];
            }
        }
        for (int i = 0; i < 4; i++)
            EACH end[i][l] += m->dt * share[k] * change[i][l], stage[i][l] = x[i][l] + m->dt * ahead[k] * change[i][l];
        ALL(i, j) EACH {
            slope[i][j][l] += m->dt * share[k] * turn[i][j][l];
            tangent[i][j][l] = (i == j) + m->dt * ahead[k] * turn[i][j][l];
        }
    }
}

static void absorb(Lane mean[4], Lane cov[4][4], int at, float variance, const Lane y, float *restrict loglik) {
    Lane column[4], gain[4], error;
    for (int i = 0; i < 4; i++) EACH column[i][l] = cov[i][at][l];
    EACH {
        const float s = column[at][l] + variance, e = y[l] - mean[at][l];
        loglik[l] -= .5f * (e * e / s + logf(s) + 1.8378770664f);
        error[l] = e;
        for (int i = 0; i < 4; i++) gain[i][l] = column[i][l] / s;
    }
    for (int i = 0; i < 4; i++) EACH mean[i][l] += gain[i][l] * error[l];
    ALL(i, j) EACH cov[i][j][l] -= gain[i][l] * column[j][l];
}

static void symmetric(Lane cov[4][4]) {
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < i; j++) EACH cov[i][j][l] = cov[j][i][l] = .5f * (cov[i][j][l] + cov[j][i][l]);
}

/* out = left right, or left right^T. */
static void product(Lane left[4][4], Lane right[4][4], Lane out[4][4], int transposed) {
    ALL(i, j) {
        EACH out[i][j][l] = 0;
        for (int k = 0; k < 4; k++)
            EACH out[i][j][l] += left[i][k][l] * (transposed ? right[j][k][l] : right[k][j][l]);
    }
}

/* x cov^-1 in place of x, by Cholesky. */
static void solve(Lane cov[4][4], Lane x[4][4]) {
    Lane root[4][4];
    for (int j = 0; j < 4; j++)
        for (int i = j; i < 4; i++) {
            EACH root[i][j][l] = cov[i][j][l];
            for (int k = 0; k < j; k++) EACH root[i][j][l] -= root[i][k][l] * root[j][k][l];
            if (i == j)
                EACH root[j][j][l] = 1 / sqrtf(root[j][j][l]);
            else
                EACH root[i][j][l] *= root[j][j][l];
        }
    for (int r = 0; r < 4; r++) {
        for (int i = 0; i < 4; i++) {
            for (int k = 0; k < i; k++) EACH x[r][i][l] -= root[i][k][l] * x[r][k][l];
            EACH x[r][i][l] *= root[i][i][l];
        }
        for (int i = 3; i >= 0; i--) {
            for (int k = i + 1; k < 4; k++) EACH x[r][i][l] -= root[k][i][l] * x[r][k][l];
            EACH x[r][i][l] *= root[i][i][l];
        }
    }
}

/* Filters and smooths `count` rows: u (count, lane), y (count, 2, lane); the smoothed moments end in `rows`. */
void smooth(const Model *m, const Network *nets, const Lane *u, Lane (*y)[2], int count, Row *rows, float *loglik) {
    EACH loglik[l] = 0;
    for (int k = 0; k < count; k++) {
        Row *row = &rows[k];
        Lane carried[4][4];
        for (int i = 0; i < 4; i++) EACH row->mean[i][l] = k ? row[-1].ahead[i][l] : m->start[i];
        ALL(i, j) EACH row->cov[i][j][l] = k ? row[-1].ahead_cov[i][j][l] : i == j ? m->start_variance[i] : 0;
        for (int i = 0; i < 2; i++) absorb(row->mean, row->cov, 2 * i, m->r[i], y[k][i], loglik);
        symmetric(row->cov);
        step(m, nets, u[k], row->mean, row->ahead, row->slope);
        product(row->slope, row->cov, carried, 0);
        product(carried, row->slope, row->ahead_cov, 1);
        for (int i = 0; i < 4; i++) EACH row->ahead_cov[i][i][l] += m->q[i];
        symmetric(row->ahead_cov);
    }
    for (int k = count - 2; k >= 0; k--) {
        Row *row = &rows[k];
        Lane change[4][4], carried[4][4];
        product(row->cov, row->slope, row->gain, 1);
        solve(row->ahead_cov, row->gain);
        for (int i = 0; i < 4; i++)
            for (int j = 0; j < 4; j++)
                EACH row->mean[i][l] += row->gain[i][j][l] * (row[1].mean[j][l] - row->ahead[j][l]);
        ALL(i, j) EACH change[i][j][l] = row[1].cov[i][j][l] - row->ahead_cov[i][j][l];
        product(row->gain, change, carried, 0);
        product(carried, row->gain, change, 1);
        ALL(i, j) EACH row->cov[i][j][l] += change[i][j][l];
        symmetric(row->cov);
    }
}
