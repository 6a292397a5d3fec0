/* Tracking control of @TITLE@ at 1 kHz for a second, simulated. On a robot, `measure` reads the encoders and `command.tau`
   goes to the motors; the simulation at the end of the loop falls away. */
#include <math.h>
#include <stdio.h>

#include "mech.h"

#define PERIOD 1e-3 /* s */
#define SAMPLES 1000
#define STEPS 10 /* of the simulation in a period */

static mech_model model;
static mech_motion plant;
static mech_state state;
static mech_tracking controller;
static double middle[MECH_D];

static void measure(double t, mech_measurement *measurement) {
  const double amplitude = 0.05 * @STEP@;
  for (int k = 0; k < MECH_D; ++k) {
    measurement->q[k] = plant.at.q_tree[mech_q_places[k]];
    measurement->q_dot[k] = plant.q_dot[k];
    measurement->q_d[k] = middle[k] + amplitude * (1.0 - cos(t));
    measurement->q_d_dot[k] = amplitude * sin(t);
    measurement->q_d_ddot[k] = amplitude * cos(t);
  }
}

int main(void) {
  mech_measurement measurement;
  mech_command command;
  mech_set_parameters(&model, &mech_default_parameters);
  mech_status status = mech_configure(&model, mech_assembled, &plant.at);
  if (status != MECH_OK) return printf("not assembled: status %d\n", (int)status), 1;
  state = plant.at;
  controller.model = &model;
  mech_D(&model, &plant.at, controller.K_D); /* gains in proportion to the inertia: r decays at 20/s */
  for (int k = 0; k < MECH_D * MECH_D; ++k) controller.K_D[k] *= 20.0;
  for (int k = 0; k < MECH_D; ++k) {
    middle[k] = plant.at.q_tree[mech_q_places[k]];
    controller.Lambda[k + MECH_D * k] = 10.0;
  }
  for (int sample = 0; sample < SAMPLES; ++sample) {
    measure(sample * PERIOD, &measurement);
    status = mech_tracking_step(&controller, &state, &measurement, &command);
    for (int k = 0; k < STEPS && status == MECH_OK; ++k)
      status = mech_advance(&model, &plant, command.tau, PERIOD / STEPS);
    if (status != MECH_OK) return printf("stopped at sample %d: status %d\n", sample, (int)status), 1;
  }
  measure(SAMPLES * PERIOD, &measurement);
  for (int k = 0; k < MECH_D; ++k)
    printf("q[%d] = %.6f, desired %.6f\n", k, measurement.q[k], measurement.q_d[k]);
  return 0;
}
