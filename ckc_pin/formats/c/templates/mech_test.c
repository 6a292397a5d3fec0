/* Compares the C code of @TITLE@ with test vectors that ckc_pin computed from Pinocchio's terms. Prints the largest
   relative difference of each quantity; the exit status is 0 if none exceeds @TEST_TOLERANCE@. */
#include <math.h>
#include <stdio.h>

#include "mech.h"
#include "mech_vectors.h"

static const char *const quantity[QUANTITIES] = {@QUANTITY_NAMES@};
static double largest[QUANTITIES];

static void compare(int which, const vector *at, const double *ours, const double *expected, int n) {
  double scale = at->scale[which];
  for (int k = 0; k < n; ++k) scale = fmax(scale, fabs(expected[k]));
  for (int k = 0; k < n; ++k) {
    const double difference = fabs(ours[k] - expected[k]) / scale;
    if (!(difference <= largest[which])) largest[which] = difference >= 0.0 ? difference : HUGE_VAL; /* NaN */
  }
}

static void compare_tree(const mech_model *model, const vector *x) {
  mech_configuration at;
  double D_tree[MECH_N * MECH_N], bias_tree[MECH_N], damping[MECH_N], h_tree[MECH_N], acceleration[MECH_N];
  double J_dot_v[MECH_SIZE(MECH_ROWS)], multipliers[MECH_SIZE(MECH_ROWS)];
  double positions[MECH_SIZE(3 * MECH_POINTS)], velocities[MECH_SIZE(3 * MECH_POINTS)];
  if (mech_configure(model, x->q_tree, &at) != MECH_OK) largest[PHI] = HUGE_VAL;
  compare(PHI, x, at.phi, x->phi, MECH_ROWS);
  compare(J, x, at.J, x->J, MECH_ROWS * MECH_N);
  mech_D_tree(model, &at, D_tree);
  compare(D_TREE, x, D_tree, x->D_tree, MECH_N * MECH_N);
  mech_bias_tree(model, &at, x->v_tree, bias_tree, J_dot_v, damping);
  compare(BIAS_TREE, x, bias_tree, x->bias_tree, MECH_N);
  compare(J_DOT_V, x, J_dot_v, x->J_dot_v, MECH_ROWS);
  compare(DAMPING, x, damping, x->damping, MECH_N);
  mech_h_tree(model, &at, h_tree);
  compare(H_TREE, x, h_tree, x->h_tree, MECH_N);
  mech_points(model, &at, x->v_tree, positions, velocities);
  compare(POSITIONS, x, positions, x->positions, 3 * MECH_POINTS);
  compare(VELOCITIES, x, velocities, x->velocities, 3 * MECH_POINTS);
  const double potential = mech_potential_energy(model, &at);
  compare(POTENTIAL, x, &potential, x->potential, 1);
  if (mech_acceleration(model, &at, x->v_tree, x->u_tree, acceleration, multipliers) != MECH_OK)
    largest[ACCELERATION] = HUGE_VAL;
  compare(ACCELERATION, x, acceleration, x->acceleration, MECH_N);
  compare(MULTIPLIERS, x, multipliers, x->multipliers, MECH_ROWS);
}

static void compare_reduced(const mech_model *model, const vector *x) {
  mech_configuration at;
  double D[MECH_D * MECH_D], C[MECH_D * MECH_D], h[MECH_D], u[MECH_D], u_tree[MECH_N], q_ddot[MECH_D];
  double v_tree[MECH_N], acceleration[MECH_N];
  if (mech_configure(model, x->guess, &at) != MECH_OK || mech_sigma(model, x->q, &at) != MECH_OK)
    largest[SIGMA] = HUGE_VAL;
  compare(SIGMA, x, at.q_tree, x->sigma, MECH_NQ);
  compare(RHO, x, at.rho, x->rho, MECH_N * MECH_D);
  mech_D(model, &at, D);
  compare(D_REDUCED, x, D, x->D_reduced, MECH_D * MECH_D);
  mech_C(model, &at, x->q_dot, C);
  compare(C_REDUCED, x, C, x->C_reduced, MECH_D * MECH_D);
  mech_h(model, &at, h);
  compare(H_REDUCED, x, h, x->h_reduced, MECH_D);
  mech_inverse_dynamics(model, &at, x->q_dot, x->q_ddot, u);
  compare(INVERSE, x, u, x->inverse, MECH_D);
  mech_motor_force(x->tau, u_tree);
  if (mech_forward_dynamics(model, &at, x->q_dot, u_tree, q_ddot) != MECH_OK) largest[FORWARD] = HUGE_VAL;
  compare(FORWARD, x, q_ddot, x->forward, MECH_D);
  mech_velocity(&at, x->q_dot, v_tree);
  mech_tree_acceleration(model, &at, v_tree, x->q_ddot, acceleration);
  compare(TREE_ACCELERATION, x, acceleration, x->tree_acceleration, MECH_N);
}

static void compare_controllers(const mech_model *model, const vector *x) {
  mech_set_point set_point = {.model = model};
  mech_tracking tracking = {.model = model};
  mech_measurement measurement;
  mech_command command;
  mech_state state;
  for (int k = 0; k < MECH_D; ++k) {
    set_point.q_d[k] = x->q_d[k];
    measurement.q[k] = x->q[k];
    measurement.q_dot[k] = x->q_dot[k];
    measurement.q_d[k] = x->q_d[k];
    measurement.q_d_dot[k] = x->q_d_dot[k];
    measurement.q_d_ddot[k] = x->q_d_ddot[k];
  }
  for (int k = 0; k < MECH_D * MECH_D; ++k) {
    set_point.K_P[k] = x->K_P[k];
    set_point.K_V[k] = x->K_V[k];
    tracking.Lambda[k] = x->Lambda[k];
    tracking.K_D[k] = x->K_D[k];
  }
  if (mech_configure(model, x->guess, &state) != MECH_OK || mech_set_point_start(&set_point, &state) != MECH_OK ||
      mech_set_point_step(&set_point, &state, &measurement, &command) != MECH_OK)
    largest[SET_POINT] = HUGE_VAL;
  compare(SET_POINT, x, command.u, x->set_point, MECH_D);
  compare(SET_POINT_TAU, x, command.tau, x->set_point_tau, MECH_MOTORS);
  if (mech_tracking_step(&tracking, &state, &measurement, &command) != MECH_OK) largest[TRACKING] = HUGE_VAL;
  compare(TRACKING, x, command.u, x->tracking, MECH_D);
}

int main(void) {
  static mech_model model;
  double worst = 0.0;
  mech_set_parameters(&model, &mech_default_parameters);
  for (int k = 0; k < VECTORS; ++k) {
    compare_tree(&model, &vectors[k]);
    compare_reduced(&model, &vectors[k]);
    if (MECH_MOTORS >= MECH_D) compare_controllers(&model, &vectors[k]);
  }
  for (int k = 0; k < QUANTITIES; ++k) {
    printf("%-14s %.1e\n", quantity[k], largest[k]);
    if (!(largest[k] <= worst)) worst = largest[k];
  }
  printf("largest relative difference at %d states: %.1e\n", VECTORS, worst);
  return worst <= @TEST_TOLERANCE@ ? 0 : 1;
}
