/* Prints results of exported C code at its test vectors with all digits, a line each. With an argument it prints the
   median, the 99th percentile and the maximum of the time of a controlled step instead, in ns, and the size of a
   controller's variables in bytes. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "mech_vectors.h"

#define SAMPLES 20000
#define WARM_UP 1000 /* samples that are not measured */
#define PERIOD 1e-3 /* s */

static mech_model model;

static void print(const double *x, int n) {
  for (int k = 0; k < n; ++k) printf("%.17g ", x[k]);
  printf("\n");
}

static void print_results(const vector *x) {
  static mech_configuration at;
  double acceleration[MECH_N], multipliers[MECH_SIZE(MECH_ROWS)], D[MECH_D * MECH_D], C[MECH_D * MECH_D], h[MECH_D];
  double u_tree[MECH_N], q_ddot[MECH_D], u[MECH_D];
  int status = (int)mech_configure(&model, x->q_tree, &at);
  status |= (int)mech_acceleration(&model, &at, x->v_tree, x->u_tree, acceleration, multipliers);
  print(acceleration, MECH_N);
  print(multipliers, MECH_ROWS);
  status |= (int)mech_configure(&model, x->guess, &at) | (int)mech_sigma(&model, x->q, &at);
  print(at.q_tree, MECH_NQ);
  print(at.rho, MECH_N * MECH_D);
  mech_D(&model, &at, D);
  mech_C(&model, &at, x->q_dot, C);
  mech_h(&model, &at, h);
  print(D, MECH_D * MECH_D);
  print(C, MECH_D * MECH_D);
  print(h, MECH_D);
  mech_motor_force(x->tau, u_tree);
  status |= (int)mech_forward_dynamics(&model, &at, x->q_dot, u_tree, q_ddot);
  mech_inverse_dynamics(&model, &at, x->q_dot, x->q_ddot, u);
  print(q_ddot, MECH_D);
  print(u, MECH_D);
  printf("%d\n", status);
}

static int compare(const void *a, const void *b) {
  const double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

/* Time tracking control along a swing of 0.1 rad or sizes of the mechanism, as in main.c. */
static int measure(void) {
  static mech_state state;
  static mech_tracking controller;
  static double times[SAMPLES];
  mech_measurement measurement;
  mech_command command;
  double middle[MECH_D];
  mech_status status = mech_configure(&model, mech_assembled, &state);
  controller.model = &model;
  for (int k = 0; k < MECH_D; ++k) {
    middle[k] = mech_assembled[mech_q_places[k]];
    controller.Lambda[k + MECH_D * k] = controller.K_D[k + MECH_D * k] = 10.0;
  }
  for (int sample = -WARM_UP; sample < SAMPLES && status == MECH_OK; ++sample) {
    const double t = sample * PERIOD, amplitude = 0.05 * @STEP@;
    struct timespec start, end;
    for (int k = 0; k < MECH_D; ++k) {
      measurement.q[k] = measurement.q_d[k] = middle[k] + amplitude * (cos((double)k) - cos(3.0 * t + k));
      measurement.q_dot[k] = measurement.q_d_dot[k] = 3.0 * amplitude * sin(3.0 * t + k);
      measurement.q_d_ddot[k] = 9.0 * amplitude * cos(3.0 * t + k);
    }
    clock_gettime(CLOCK_MONOTONIC, &start);
    status = mech_tracking_step(&controller, &state, &measurement, &command);
    clock_gettime(CLOCK_MONOTONIC, &end);
    if (sample < 0) continue;
    times[sample] = 1e9 * (double)(end.tv_sec - start.tv_sec) + (double)(end.tv_nsec - start.tv_nsec);
  }
  qsort(times, SAMPLES, sizeof *times, compare);
  printf("%g %g %g ", times[SAMPLES / 2], times[SAMPLES / 100 * 99], times[SAMPLES - 1]);
  printf("%zu\n", sizeof model + sizeof state + sizeof controller + sizeof measurement + sizeof command);
  return (int)status;
}

int main(int count, char **arguments) {
  (void)arguments;
  mech_set_parameters(&model, &mech_default_parameters);
  if (count > 1) return measure();
  for (int k = 0; k < VECTORS; ++k) print_results(&vectors[k]);
  return 0;
}
