/* Directional derivatives of @TITLE@'s outputs by inputs and states: eqs. 1, 6 and 8, differentiated at their solution.
   Included by fmu.c. */

/* The change of rates x with J x = -decay phi, for a step of the configuration and changes of the independent rates. */
static void change_rates(const fmu *x, const double *rates, double decay, const double *step, const double *q_dot_change,
                         double *changes) {
  const mech_configuration *at = &x->at;
  double row[MECH_SIZE(MECH_Z)], phi_change[MECH_SIZE(MECH_ROWS)];
  code_loop_rate_change(at->q_tree, at->trig, rates, step, x->model.numbers, row);
  multiply(at->J, step, phi_change, MECH_ROWS, MECH_N);
  for (int k = 0; k < MECH_Z; ++k) row[k] = -row[k] - decay * phi_change[KEPT[k]];
  solve(at->phi_z, at->pivot, MECH_Z, row);
  multiply(at->rho, q_dot_change, changes, MECH_N, MECH_D);
  for (int k = 0; k < MECH_Z; ++k) changes[at->dependent[k]] += row[k];
}

/* The change of a free root's position and rotation vector by a step along its own axes. */
static void change_location(const double *p, const double *step, double *change) {
  double location[6], once[3], twice[3];
  locate_root(p, location);
  rotate(p + 3, step, change);
  const double *r = location + 3, *s = step + 3;
  const double angle = sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2]);
  const double factor = angle > 0.0 ? (1.0 - 0.5 * angle / tan(0.5 * angle)) / (angle * angle) : 0.0;
  for (int i = 0; i < 3; ++i) once[i] = r[(i + 1) % 3] * s[(i + 2) % 3] - r[(i + 2) % 3] * s[(i + 1) % 3];
  for (int i = 0; i < 3; ++i) twice[i] = r[(i + 1) % 3] * once[(i + 2) % 3] - r[(i + 2) % 3] * once[(i + 1) % 3];
  for (int i = 0; i < 3; ++i) change[3 + i] = s[i] + 0.5 * once[i] + factor * twice[i];
}

/* The changes of all outputs with those of inputs and states in `change`, by differentiation of eqs. 1, 6 and 8. */
static mech_status change_outputs(const fmu *x, double *change) {
  const mech_configuration *at = &x->at;
  const double *values = x->values, *numbers = x->model.numbers;
  double q_dot[MECH_D], q_change[MECH_D], q_dot_change[MECH_D], step[MECH_N], tau[MECH_SIZE(MECH_MOTORS)];
  double v_tree[MECH_N], v_change[MECH_N], rate_change[MECH_N], residual[MECH_N + MECH_Z], force[MECH_N];
  double kept[MECH_SIZE(MECH_Z)], z[MECH_SIZE(MECH_Z)], phi_change[MECH_SIZE(MECH_ROWS)], holding[STOP_SIZE];
  for (int k = 0; k < MECH_D; ++k) {
    q_change[k] = change[POSITION + at->independent[k]];
    q_dot_change[k] = change[RATE + at->independent[k]];
  }
  multiply(at->rho, q_change, step, MECH_N, MECH_D);
  if (integrates_spf(x)) memcpy(step, change + POSITION, sizeof step);
  independent_rates(x, q_dot);
  mech_velocity(at, q_dot, v_tree);
  change_rates(x, v_tree, 0.0, step, q_dot_change, v_change);
  memcpy(rate_change, v_change, sizeof rate_change);
  if (integrates_spf(x)) change_rates(x, values + RATE, 1.0 / values[EPSILON], step, q_dot_change, rate_change);
  for (int k = 0; k < MECH_MOTORS; ++k) {
    const double torque = values[TORQUE + k];
    tau[k] = torque >= LOWEST_TAU[k] && torque <= HIGHEST_TAU[k] ? change[TORQUE + k] : 0.0;
  }
  mech_motor_force(tau, force);
  for (int k = 0; k < MECH_Z; ++k) kept[k] = values[MULTIPLIER + KEPT[k]];
  code_residual_change(at->q_tree, at->trig, v_tree, values + ACCELERATION, kept, step, v_change, numbers, residual);
  for (int k = 0; k < MECH_N; ++k) force[k] += change[FORCE + k] - residual[k];
  for (int k = 0; k < MECH_Z; ++k) z[k] = -residual[MECH_N + k];
  solve(at->phi_z, at->pivot, MECH_Z, z);
  const mech_status status = project_acceleration(x, at, force, z, change + ACCELERATION, holding);
  if (status != MECH_OK) return status;
  for (int i = 0; i < STOPS; ++i) change[INDICATOR + i] = x->is_touching[i] ? holding[i] : gap_rate(step, i);
  solve_multipliers(&x->model, at, force, change + ACCELERATION, change + MULTIPLIER);
  memcpy(change + RATE, rate_change, sizeof rate_change);
  code_point_changes(at->q_tree, at->trig, values + RATE, step, rate_change, numbers, change + POINT,
                     change + POINT_RATE);
  for (int k = 0; k < JOINTS; ++k) change[POSITION + JOINT[k][1]] = step[JOINT[k][1]];
  for (int k = 0; k < ROOTS; ++k)
    change_location(at->q_tree + ROOT[k][0], step + ROOT[k][1], change + POSITION + ROOT[k][1]);
  code_energy_changes(at->q_tree, at->trig, v_tree, step, v_change, numbers, change + KINETIC, change + POTENTIAL);
  change[TOTAL] = change[KINETIC] + change[POTENTIAL];
  multiply(at->J, step, phi_change, MECH_ROWS, MECH_N);
  for (int k = 0; k < MECH_ROWS; ++k)
    if (fabs(at->phi[k]) == values[RESIDUAL]) change[RESIDUAL] = at->phi[k] < 0.0 ? -phi_change[k] : phi_change[k];
  return is_finite(change, VARIABLES) ? MECH_OK : MECH_NOT_FINITE;
}

static int is_state(const fmu *x, int reference) {
  for (int k = 0; k < MECH_D; ++k)
    if (reference == POSITION + x->at.independent[k] || reference == RATE + x->at.independent[k]) return 1;
  return integrates_spf(x) && reference >= POSITION && reference < RATE;
}

/* Directional derivatives of outputs and of the states' derivatives by inputs and states. */
static const char *fmu_get_changes(fmu *x, const unsigned *unknowns, size_t n, const unsigned *knowns, size_t m,
                                   const double *seed, double *derivatives) {
  double change[VARIABLES] = {0.0};
  mech_status status = fmu_compute_outputs(x);
  for (size_t k = 0; k < m; ++k) {
    if (!is_input(knowns[k]) && !is_state(x, (int)knowns[k])) return "directional derivatives are by inputs and states";
    change[knowns[k]] += seed[k];
  }
  if (status == MECH_OK) status = change_outputs(x, change);
  if (status != MECH_OK) return REASON[status];
  for (size_t k = 0; k < n; ++k) {
    if ((int)unknowns[k] < POSITION || unknowns[k] >= VARIABLES) return "directional derivatives are of outputs";
    derivatives[k] = change[unknowns[k]];
  }
  return NULL;
}
