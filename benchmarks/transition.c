/* The common work's transition in plain C: one RK4 step of the acrobot with a 1-16-16-1 tanh network per joint.
   Particles are stored state by state, x[4][count], and taken LANES at a time, so that the inner loops vectorise.
   Compile: -O3 -march=native -ffast-math, link -lmvec -lm. */

#include <math.h>

#define LANES 64
#define WIDTH 16

typedef struct {
    float first[WIDTH], first_bias[WIDTH], second[WIDTH][WIDTH], second_bias[WIDTH], last[WIDTH], last_bias;
} Network;

/* Lumped constants of the arm: mass matrix, gravity, and the coupling m2 l1 lc2. */
typedef struct {
    float inertia1, inertia2, coupling, gravity1, gravity2, dt;
} Arm;

static void friction(const Network *net, const float *restrict v, float *restrict torque) {
    float hidden[WIDTH][LANES];
    for (int i = 0; i < WIDTH; i++)
        for (int l = 0; l < LANES; l++) hidden[i][l] = tanhf(net->first[i] * v[l] + net->first_bias[i]);
    for (int l = 0; l < LANES; l++) torque[l] = net->last_bias;
    for (int i = 0; i < WIDTH; i++) {
        float sum[LANES];
        for (int l = 0; l < LANES; l++) sum[l] = net->second_bias[i];
        for (int j = 0; j < WIDTH; j++)
            for (int l = 0; l < LANES; l++) sum[l] += net->second[i][j] * hidden[j][l];
        for (int l = 0; l < LANES; l++) torque[l] += net->last[i] * tanhf(sum[l]);
    }
}

static void rate(const Arm *arm, const Network *nets, float u, float x[4][LANES], float dx[4][LANES]) {
    float torque[2][LANES], cross[LANES];
    friction(&nets[0], x[2], torque[0]);
    friction(&nets[1], x[3], torque[1]);
    for (int l = 0; l < LANES; l++) cross[l] = arm->coupling * cosf(x[1][l]); /* apart: sincosf has no vector form */
    for (int l = 0; l < LANES; l++) {
        float v1 = x[2][l], v2 = x[3][l], h = arm->coupling * sinf(x[1][l]);
        float m11 = arm->inertia1 + 2 * cross[l], m12 = arm->inertia2 + cross[l], m22 = arm->inertia2;
        float outer = arm->gravity2 * sinf(x[0][l] + x[1][l]);
        float f1 = torque[0][l] - arm->gravity1 * sinf(x[0][l]) - outer + h * v2 * (2 * v1 + v2);
        float f2 = u + torque[1][l] - outer - h * v1 * v1;
        float inverse = 1 / (m11 * m22 - m12 * m12);
        dx[0][l] = v1;
        dx[1][l] = v2;
        dx[2][l] = (m22 * f1 - m12 * f2) * inverse;
        dx[3][l] = (m11 * f2 - m12 * f1) * inverse;
    }
}

/* Moves all particles of one sequence in place over `steps` inputs; count is a multiple of LANES. */
void propagate(const Arm *arm, const Network *nets, const float *u, int steps, float *x, int count) {
    const float share[4] = {1.f / 6, 1.f / 3, 1.f / 3, 1.f / 6}, ahead[4] = {.5f, .5f, 1.f, 0.f};
    for (int k = 0; k < steps; k++)
        for (int at = 0; at < count; at += LANES) {
            float start[4][LANES], stage[4][LANES], slope[4][LANES], end[4][LANES];
            for (int s = 0; s < 4; s++)
                for (int l = 0; l < LANES; l++) start[s][l] = stage[s][l] = end[s][l] = x[s * count + at + l];
            for (int i = 0; i < 4; i++) {
                rate(arm, nets, u[k], stage, slope);
                for (int s = 0; s < 4; s++)
                    for (int l = 0; l < LANES; l++) {
                        end[s][l] += arm->dt * share[i] * slope[s][l];
                        stage[s][l] = start[s][l] + arm->dt * ahead[i] * slope[s][l];
                    }
            }
            for (int s = 0; s < 4; s++)
                for (int l = 0; l < LANES; l++) x[s * count + at + l] = end[s][l];
        }
}
