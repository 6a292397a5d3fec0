/* The FMU of @TITLE@, the same for both versions of the standard: variables, initialization, derivatives, outputs and
   co-simulation. Written by ckc_pin @VERSION@ (ckc export --to fmu). */
#include <float.h>
#include <stdlib.h>
#include <string.h>

#define MECH_CHARTS
#include "mech.c"

enum { STOPS = @STOPS@ };
#define STOP_SIZE MECH_SIZE(STOPS)

/* Value references: places of the variables in `values`. */
enum {
  TIME = 0,
  PARAMETER,
  EPSILON = PARAMETER + MECH_PARAMETERS,
  TORQUE,
  FORCE = TORQUE + MECH_MOTORS,
  POSITION = FORCE + MECH_N,
  RATE = POSITION + MECH_N,
  ACCELERATION = RATE + MECH_N,
  MULTIPLIER = ACCELERATION + MECH_N,
  POINT = MULTIPLIER + MECH_ROWS,
  POINT_RATE = POINT + 3 * MECH_POINTS,
  KINETIC = POINT_RATE + 3 * MECH_POINTS,
  POTENTIAL,
  TOTAL,
  RESIDUAL,
  INDICATOR,
  VARIABLES = INDICATOR + STOPS
};

#define IS_SPF @IS_SPF@ /* model exchange by eq. 8, whose states are all coordinates and q_dot; otherwise q and q_dot */
enum { STATES = IS_SPF ? MECH_N + MECH_D : 2 * MECH_D };
enum { ASSEMBLY_PIECES = 64, STAGES = @STAGES@ };
#define MAX_ROOT_STEPS 80
/* Entries of rho, in rad or sizes of the mechanism: where co-simulation changes the independent coordinates, and after it. */
#define MAX_RHO 20.0
#define GOOD_RHO 1.5
#define MAX_EXCHANGES 100
#define TIME_ROUNDING 1e-14    /* s, of events in co-simulation */
#define STOP_TOLERANCE 1e-9 /* rad, or sizes of the mechanism: a joint this close to its stop is at it */

static const char IDENTITY[] = "@IDENTITY@"; /* of the model description */
static const double START[] = @START@;       /* configuration q_tree of the scene's start */
static const double START_RATES[] = @START_RATES@;
static const int STATE[] = @STATE@; /* places of q in v_tree, in the order of the model description */

/* Stops: places of their coordinate in v_tree and in q_tree, 1 for the upper one or -1, position, restitution, and the
   holding force that counts as zero. */
static const int STOPPED[] = @STOPPED@, STOPPED_PLACE[] = @STOPPED_PLACE@, SIDE[] = @SIDE@;
static const double STOP[] = @STOP@, RESTITUTION[] = @RESTITUTION@, NO_FORCE[] = @NO_FORCE@;

/* DOP853: E. Hairer, S. P. Norsett and G. Wanner, Solving Ordinary Differential Equations I, section II.10. */
static const double A[STAGES][STAGES] = @A@;
static const double B[STAGES] = @B@;
static const double E3[STAGES + 1] = @E3@, E5[STAGES + 1] = @E5@;

/* More statuses of the functions below. */
enum { BEYOND_STOP = MECH_UNDRIVEN + 1, DEPENDENT_STOPS, STEP_TOO_SMALL };

static const char *const REASON[] = {
    "no error",
    "the loops cannot be closed: coordinates or parameters are out of reach, or a step is too long",
    "phi_z is singular: the independent coordinates do not determine the configuration; export the scene with others",
    "a value is not a finite number",
    "elimination lost accuracy",
    "the motors cannot produce every u",
    "a joint is beyond its stop: choose start values within the stops",
    "joints that only move together touch several stops at once: remove all of these stops but one",
    "the step size of the integration became too small",
};

/* All that an instance remembers. A copy of it is the FMU's state. */
typedef struct {
  mech_model model;
  mech_configuration at; /* from which Newton's method starts */
  double values[VARIABLES];
  double tolerance;    /* relative, of co-simulation */
  double step;         /* s, that the next step of co-simulation tries */
  int is_model_exchange;
  int is_initializing; /* parameters and start values can be set */
  int is_assembled, has_derivatives, has_outputs;
  int is_touching[STOP_SIZE]; /* whether a joint rests on its stop */
  double holding[STOP_SIZE];  /* force of a stop, in the direction away from it */
} fmu;

static void fmu_reset(fmu *x, int is_model_exchange) {
  memset(x, 0, sizeof *x);
  x->is_model_exchange = is_model_exchange;
  memcpy(x->values + PARAMETER, &mech_default_parameters, MECH_PARAMETERS * sizeof(double));
  x->values[EPSILON] = @EPSILON@;
  for (int k = 0; k < MECH_D; ++k) {
    x->values[POSITION + INDEPENDENT[k]] = START[mech_q_places[k]];
    x->values[RATE + INDEPENDENT[k]] = START_RATES[k];
  }
  memcpy(x->at.independent, INDEPENDENT, sizeof x->at.independent);
  memcpy(x->at.dependent, DEPENDENT, MECH_Z * sizeof *DEPENDENT);
  x->tolerance = @RTOL@;
  x->step = 1e-3;
  x->is_initializing = 1;
}

static void read_joint_positions(fmu *x) {
  for (int k = 0; k < JOINTS; ++k) x->values[POSITION + JOINT[k][1]] = x->at.q_tree[JOINT[k][0]];
}

/* Distance of a joint from a stop. */
static double find_gap(const mech_configuration *at, int i) { return SIDE[i] * (STOP[i] - at->q_tree[STOPPED_PLACE[i]]); }

/* The rate of a distance from a stop at rates of the coordinates. */
static double gap_rate(const double *rates, int i) { return -SIDE[i] * rates[STOPPED[i]]; }

/* Assemble: move parameters and independent coordinates from the scene's start to their start values. */
static mech_status fmu_assemble(fmu *x) {
  if (x->is_assembled) return MECH_OK;
  mech_set_parameters(&x->model, &mech_default_parameters);
  mech_status status = mech_configure(&x->model, START, &x->at);
  for (int piece = 1; piece <= ASSEMBLY_PIECES && status == MECH_OK; ++piece) {
    const double rest = (double)(ASSEMBLY_PIECES - piece) / ASSEMBLY_PIECES;
    double numbers[MECH_PARAMETERS], q[MECH_D];
    mech_parameters parameters;
    memcpy(numbers, &mech_default_parameters, sizeof numbers);
    for (int k = 0; k < MECH_PARAMETERS; ++k) {
      const double value = x->values[PARAMETER + k];
      numbers[k] = value - rest * (value - numbers[k]);
    }
    memcpy(&parameters, numbers, sizeof parameters);
    mech_set_parameters(&x->model, &parameters);
    for (int k = 0; k < MECH_D; ++k) {
      const double value = x->values[POSITION + INDEPENDENT[k]];
      q[k] = value - rest * (value - START[mech_q_places[k]]);
    }
    status = mech_sigma(&x->model, q, &x->at);
  }
  if (status != MECH_OK) return status;
  for (int i = 0; i < STOPS; ++i) {
    if (find_gap(&x->at, i) < -STOP_TOLERANCE * SCALE[STOPPED[i]]) return (mech_status)BEYOND_STOP;
    x->is_touching[i] = 0;
  }
  read_joint_positions(x);
  x->is_assembled = 1;
  return MECH_OK;
}

/* The force on the tree of all inputs. */
static void input_force(const fmu *x, double *u_tree) {
  double tau[MECH_SIZE(MECH_MOTORS)];
  for (int k = 0; k < MECH_MOTORS; ++k) tau[k] = x->values[TORQUE + k];
  mech_limit_torques(tau);
  mech_motor_force(tau, u_tree);
  for (int k = 0; k < MECH_N; ++k) u_tree[k] += x->values[FORCE + k];
}

static void independent_rates(const fmu *x, double *q_dot) {
  for (int k = 0; k < MECH_D; ++k) q_dot[k] = x->values[RATE + x->at.independent[k]];
}

static int integrates_spf(const fmu *x) { return IS_SPF && x->is_model_exchange; }

/* Move the configuration to the states. */
static mech_status follow_states(fmu *x) {
  mech_configuration at = x->at;
  mech_status status;
  if (integrates_spf(x)) {
    double q_tree[MECH_NQ];
    memcpy(q_tree, at.q_tree, sizeof q_tree);
    for (int k = 0; k < JOINTS; ++k) q_tree[JOINT[k][0]] = x->values[POSITION + JOINT[k][1]];
    status = mech_configure(&x->model, q_tree, &at);
  } else {
    double q[MECH_D];
    for (int k = 0; k < MECH_D; ++k) q[k] = x->values[POSITION + at.independent[k]];
    status = mech_sigma(&x->model, q, &at);
    if (status != MECH_OK) {
      at = x->at;
      status = mech_move(&x->model, q, &at);
    }
  }
  if (status == MECH_OK) x->at = at;
  return status;
}

/* Stops that act together: their responses in q_ddot to unit forces, and the accelerations of the distances A. */
typedef struct {
  int count, which[STOP_SIZE];
  double response[STOP_SIZE][MECH_D], A[STOP_SIZE * STOP_SIZE];
} contact;

/* Compute the responses of the stops that `is_member` selects, without joints that the loops block. */
static void find_responses(const mech_configuration *at, const double *D_tree, const double *D, const int *pivot,
                           const int *is_member, contact *c) {
  double row[STOP_SIZE][MECH_D];
  c->count = 0;
  for (int i = 0; i < STOPS; ++i) {
    double *response = c->response[c->count], mobility = 0.0;
    if (!is_member[i]) continue;
    for (int k = 0; k < MECH_D; ++k) row[c->count][k] = response[k] = gap_rate(at->rho + MECH_N * k, i);
    solve(D, pivot, MECH_D, response);
    for (int k = 0; k < MECH_D; ++k) mobility += row[c->count][k] * response[k];
    if (mobility * D_tree[STOPPED[i] + MECH_N * STOPPED[i]] > 1e-12) c->which[c->count++] = i;
  }
  for (int j = 0; j < c->count; ++j) multiply_transposed(row[0], c->response[j], c->A + c->count * j, MECH_D, c->count);
}

/* Solve A x = -b for impulses or forces x that make the rates b of a contact's distances zero. */
static mech_status hold(const contact *c, const double *b, double *x) {
  double A[STOP_SIZE * STOP_SIZE];
  int pivot[STOP_SIZE];
  for (int i = 0; i < c->count * c->count; ++i) A[i] = c->A[i];
  for (int i = 0; i < c->count; ++i) x[i] = -b[i];
  if (!factorize(A, pivot, c->count)) return (mech_status)DEPENDENT_STOPS;
  solve(A, pivot, c->count, x);
  return MECH_OK;
}

/* Add to rates of the tree what impulses or forces x at the stops do. */
static void push(const mech_configuration *at, const contact *c, const double *x, double *rates) {
  double q_rates[MECH_D] = {0.0}, change[MECH_N];
  for (int i = 0; i < c->count; ++i)
    for (int k = 0; k < MECH_D; ++k) q_rates[k] += x[i] * c->response[i][k];
  multiply(at->rho, q_rates, change, MECH_N, MECH_D);
  for (int k = 0; k < MECH_N; ++k) rates[k] += change[k];
}

static mech_status factorize_inertia(const fmu *x, const mech_configuration *at, double *D_tree, double *D, int *pivot) {
  mech_D_tree(&x->model, at, D_tree);
  project_inertia(at, D_tree, D);
  return factorize(D, pivot, MECH_D) ? MECH_OK : MECH_SINGULAR;
}

/* Solve D' a = force + J^T multipliers for an acceleration a whose part without q_ddot is z. The forces of the stops
   on which joints rest are `holding`, and are added to `force`. */
static mech_status project_acceleration(const fmu *x, const mech_configuration *at, double *force, const double *z,
                                        double *a, double *holding) {
  double D_tree[MECH_N * MECH_N], D[MECH_D * MECH_D], rest[MECH_N], q_ddot[MECH_D];
  double b[STOP_SIZE], forces[STOP_SIZE];
  int pivot[MECH_D];
  contact c;
  mech_status status = factorize_inertia(x, at, D_tree, D, pivot);
  if (status != MECH_OK) return status;
  memset(a, 0, MECH_N * sizeof *a);
  for (int k = 0; k < MECH_Z; ++k) a[at->dependent[k]] = z[k];
  multiply(D_tree, a, rest, MECH_N, MECH_N);
  for (int k = 0; k < MECH_N; ++k) rest[k] = force[k] - rest[k];
  multiply_transposed(at->rho, rest, q_ddot, MECH_N, MECH_D);
  solve(D, pivot, MECH_D, q_ddot);
  multiply(at->rho, q_ddot, rest, MECH_N, MECH_D);
  for (int k = 0; k < MECH_N; ++k) a[k] += rest[k];
  find_responses(at, D_tree, D, pivot, x->is_touching, &c);
  for (int i = 0; i < c.count; ++i) b[i] = gap_rate(a, c.which[i]);
  status = hold(&c, b, forces);
  if (status != MECH_OK) return status;
  push(at, &c, forces, a);
  for (int i = 0; i < STOPS; ++i) holding[i] = 0.0;
  for (int i = 0; i < c.count; ++i) {
    holding[c.which[i]] = forces[i];
    force[STOPPED[c.which[i]]] -= SIDE[c.which[i]] * forces[i];
  }
  return is_finite(a, MECH_N) ? MECH_OK : MECH_NOT_FINITE;
}

/* The acceleration dv'/dt of eq. 6 at the velocity q_dot under the force u_tree. */
static mech_status accelerate(const fmu *x, const mech_configuration *at, const double *q_dot, const double *u_tree,
                              double *a, double *holding) {
  double v_tree[MECH_N], force[MECH_N], bias_tree[MECH_N], damping[MECH_N];
  double J_dot_v[MECH_SIZE(MECH_ROWS)], z[MECH_SIZE(MECH_Z)];
  mech_velocity(at, q_dot, v_tree);
  mech_bias_tree(&x->model, at, v_tree, bias_tree, J_dot_v, damping);
  for (int k = 0; k < MECH_N; ++k) force[k] = u_tree[k] + damping[k] - bias_tree[k];
  close_rows(at, J_dot_v, z);
  return project_acceleration(x, at, force, z, a, holding);
}

/* Compute rates and accelerations of the states, by eq. 6 or eq. 8. */
static mech_status fmu_differentiate(fmu *x) {
  double u_tree[MECH_N], q_dot[MECH_D];
  mech_status status = fmu_assemble(x);
  if (status != MECH_OK || x->has_derivatives) return status;
  status = follow_states(x);
  if (status != MECH_OK) return status;
  independent_rates(x, q_dot);
  input_force(x, u_tree);
  status = accelerate(x, &x->at, q_dot, u_tree, x->values + ACCELERATION, x->holding);
  if (status != MECH_OK) return status;
  mech_velocity(&x->at, q_dot, x->values + RATE);
  if (integrates_spf(x)) {
    double z_dot[MECH_SIZE(MECH_Z)];
    close_rows(&x->at, x->at.phi, z_dot);
    for (int k = 0; k < MECH_Z; ++k) x->values[RATE + x->at.dependent[k]] += z_dot[k] / x->values[EPSILON];
  }
  x->has_derivatives = 1;
  x->has_outputs = 0;
  return MECH_OK;
}

#include "stops.c"

/* Position and rotation vector of a free root. */
static void locate_root(const double *p, double *location) {
  const double *r = p + 3, sign = r[3] < 0.0 ? -1.0 : 1.0;
  const double sine = sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2]), cosine = fabs(r[3]);
  const double scale = sign * (sine > 0.0 ? 2.0 * atan2(sine, cosine) / sine : 2.0);
  for (int i = 0; i < 3; ++i) {
    location[i] = p[i];
    location[3 + i] = scale * r[i];
  }
}

static mech_status fmu_compute_outputs(fmu *x) {
  double *const values = x->values, q_dot[MECH_D], v_tree[MECH_N], u_tree[MECH_N];
  double D_tree[MECH_N * MECH_N], momentum[MECH_N];
  const mech_status status = fmu_differentiate(x);
  if (status != MECH_OK || x->has_outputs) return status;
  independent_rates(x, q_dot);
  input_force(x, u_tree);
  mech_velocity(&x->at, q_dot, v_tree);
  for (int i = 0; i < STOPS; ++i) {
    u_tree[STOPPED[i]] -= SIDE[i] * x->holding[i];
    values[INDICATOR + i] = find_margin(x, &x->at, x->holding, i);
  }
  mech_multipliers(&x->model, &x->at, v_tree, u_tree, values + ACCELERATION, values + MULTIPLIER);
  mech_points(&x->model, &x->at, values + RATE, values + POINT, values + POINT_RATE);
  read_joint_positions(x);
  for (int k = 0; k < ROOTS; ++k) locate_root(x->at.q_tree + ROOT[k][0], values + POSITION + ROOT[k][1]);
  mech_D_tree(&x->model, &x->at, D_tree);
  multiply(D_tree, v_tree, momentum, MECH_N, MECH_N);
  values[KINETIC] = 0.0;
  for (int k = 0; k < MECH_N; ++k) values[KINETIC] += 0.5 * v_tree[k] * momentum[k];
  values[POTENTIAL] = mech_potential_energy(&x->model, &x->at);
  values[TOTAL] = values[KINETIC] + values[POTENTIAL];
  values[RESIDUAL] = 0.0;
  for (int k = 0; k < MECH_ROWS; ++k) values[RESIDUAL] = fmax(values[RESIDUAL], fabs(x->at.phi[k]));
  x->has_outputs = 1;
  return MECH_OK;
}

/* --- directional derivatives --- */

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

/* --- values by reference --- */

static int is_start_value(unsigned reference) {
  for (int k = 0; k < MECH_D; ++k)
    if ((int)reference == POSITION + INDEPENDENT[k] || (int)reference == RATE + INDEPENDENT[k]) return 1;
  return (int)reference >= PARAMETER && (int)reference <= EPSILON;
}

/* The functions below that return a text return NULL, or why they failed. */

static int is_input(unsigned reference) { return (int)reference >= TORQUE && (int)reference < POSITION; }

static const char *set_value(fmu *x, unsigned reference, double value) {
  if (!is_input(reference) && !is_start_value(reference)) return "only inputs, parameters and start values can be set";
  if (!is_input(reference) && !x->is_initializing) return "parameters and start values can only be set before the end of initialization";
  if (!(fabs(value) <= DBL_MAX)) return REASON[MECH_NOT_FINITE];
  if (reference == EPSILON && value <= 0.0) return "epsilon must be positive";
  x->values[reference] = value;
  if (!is_input(reference)) x->is_assembled = 0;
  x->has_derivatives = 0;
  return NULL;
}

static const char *get_value(fmu *x, unsigned reference, double *value) {
  mech_status status = MECH_OK;
  if (reference >= VARIABLES) return "there is no variable with this value reference";
  if ((int)reference >= POSITION && !(x->is_initializing && is_start_value(reference))) status = fmu_compute_outputs(x);
  *value = x->values[reference];
  return status == MECH_OK ? NULL : REASON[status];
}

static const char *fmu_set(fmu *x, const unsigned *references, size_t n, const double *values) {
  const char *reason = NULL;
  for (size_t k = 0; k < n && reason == NULL; ++k) reason = set_value(x, references[k], values[k]);
  return reason;
}

static const char *fmu_get(fmu *x, const unsigned *references, size_t n, double *values) {
  const char *reason = NULL;
  for (size_t k = 0; k < n && reason == NULL; ++k) reason = get_value(x, references[k], &values[k]);
  return reason;
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

/* --- copies of the FMU's state --- */

static const char *fmu_copy(const void *state, void **copy) {
  if (*copy == NULL) *copy = malloc(sizeof(fmu));
  if (*copy == NULL) return "there is no memory for the state";
  memcpy(*copy, state, sizeof(fmu));
  return NULL;
}

static void fmu_free_copy(void **copy) {
  if (copy == NULL) return;
  free(*copy);
  *copy = NULL;
}

static const char *fmu_serialize(const void *copy, void *bytes, size_t size) {
  if (size < sizeof(fmu)) return "the buffer is smaller than the state";
  memcpy(bytes, copy, sizeof(fmu));
  return NULL;
}

static const char *fmu_deserialize(const void *bytes, size_t size, void **copy) {
  return size < sizeof(fmu) ? "these bytes are not a state of this FMU" : fmu_copy(bytes, copy);
}

/* --- model exchange --- */

/* Place of a state in `values`: positions, of q or of all coordinates, then q_dot. Its derivative is MECH_N places on. */
static int state_place(int k) {
  const int positions = STATES - MECH_D;
  if (k >= positions) return RATE + STATE[k - positions];
  return IS_SPF ? POSITION + k : POSITION + STATE[k];
}

static const char WRONG_NUMBER[] = "wrong number of states";

static const char *fmu_get_states(const fmu *x, double *states, size_t n) {
  if (n != STATES) return WRONG_NUMBER;
  for (int k = 0; k < STATES; ++k) states[k] = x->values[state_place(k)];
  return NULL;
}

static const char *fmu_set_states(fmu *x, const double *states, size_t n) {
  if (n != STATES) return WRONG_NUMBER;
  for (int k = 0; k < STATES; ++k) x->values[state_place(k)] = states[k];
  x->has_derivatives = 0;
  return NULL;
}

static mech_status fmu_get_indicators(fmu *x, double *indicators) {
  const mech_status status = fmu_differentiate(x);
  for (int i = 0; i < STOPS; ++i) indicators[i] = find_margin(x, &x->at, x->holding, i);
  return status;
}

static mech_status fmu_get_derivatives(fmu *x, double *derivatives) {
  const mech_status status = fmu_differentiate(x);
  for (int k = 0; k < STATES; ++k) derivatives[k] = x->values[state_place(k) + MECH_N];
  return status;
}

/* --- co-simulation: DOP853 of q and q_dot, with sigma in each stage --- */

static mech_status reduced_rate(const fmu *x, const double *u_tree, const double *y, mech_configuration *at,
                                double *rate, double *holding) {
  double a[MECH_N];
  mech_status status = mech_sigma(&x->model, y, at);
  if (status == MECH_OK) status = accelerate(x, at, y + MECH_D, u_tree, a, holding);
  if (status != MECH_OK) return status;
  for (int k = 0; k < MECH_D; ++k) {
    rate[k] = y[MECH_D + k];
    rate[MECH_D + k] = a[at->independent[k]];
  }
  return MECH_OK;
}

/* A step of co-simulation: of the motion y from `at` to y_new at `at_new`. */
typedef struct {
  double u_tree[MECH_N], y[2 * MECH_D], y_new[2 * MECH_D], rate[STAGES + 1][2 * MECH_D];
  double holding[STOP_SIZE], holding_new[STOP_SIZE];
  mech_configuration at, at_new;
} motion;

/* Return the error of a step relative to its tolerance. */
static double relative_error(const fmu *x, const motion *s, double h) {
  double square5 = 0.0, square3 = 0.0;
  for (int k = 0; k < 2 * MECH_D; ++k) {
    double error5 = 0.0, error3 = 0.0;
    const double size = fmax(fabs(s->y[k]), fabs(s->y_new[k]));
    const double scale = x->tolerance * (0.01 * SCALE[s->at.independent[k % MECH_D]] + size);
    for (int i = 0; i <= STAGES; ++i) {
      error5 += E5[i] * s->rate[i][k];
      error3 += E3[i] * s->rate[i][k];
    }
    square5 += error5 * error5 / (scale * scale);
    square3 += error3 * error3 / (scale * scale);
  }
  if (square5 == 0.0 && square3 == 0.0) return 0.0;
  return h * square5 / sqrt((square5 + 0.01 * square3) * 2.0 * MECH_D);
}

/* Try a step, with rate[0] known. */
static mech_status try_step(const fmu *x, motion *s, double h) {
  s->at_new = s->at;
  for (int stage = 1; stage <= STAGES; ++stage) {
    const double *weight = stage < STAGES ? A[stage] : B;
    for (int k = 0; k < 2 * MECH_D; ++k) {
      double sum = 0.0;
      for (int i = 0; i < stage; ++i) sum += weight[i] * s->rate[i][k];
      s->y_new[k] = s->y[k] + h * sum;
    }
    const mech_status status = reduced_rate(x, s->u_tree, s->y_new, &s->at_new, s->rate[stage], s->holding_new);
    if (status != MECH_OK) return status;
  }
  return MECH_OK;
}

/* At the end of a tried step: the margin of a stop, or the rate of a joint's distance from it. */
static double end_margin(const fmu *x, const motion *s, int i, int is_rate) {
  double rates[MECH_N];
  if (!is_rate) return find_margin(x, &s->at_new, s->holding_new, i);
  mech_velocity(&s->at_new, s->y_new + MECH_D, rates);
  return gap_rate(rates, i);
}

/* Shorten a step to where a margin changes its sign, by the Illinois variant of the secant method. */
static mech_status find_zero(const fmu *x, motion *s, int i, int is_rate, double before, double *h) {
  double low = 0.0, high = *h, f_low = before, f_high = end_margin(x, s, i, is_rate);
  int side = 0;
  for (int k = 0; k < MAX_ROOT_STEPS && high - low > TIME_ROUNDING + DBL_EPSILON * high; ++k) {
    double h_new = high - f_high * (high - low) / (f_high - f_low);
    if (!(h_new > low && h_new < high) || k % 4 == 3) h_new = 0.5 * (low + high);
    const mech_status status = try_step(x, s, h_new);
    if (status != MECH_OK) return status;
    const double f = end_margin(x, s, i, is_rate);
    if ((f > 0.0) == (before > 0.0)) {
      if (side == 1) f_high *= 0.5;
      low = h_new, f_low = f, side = 1;
    } else {
      if (side == -1) f_low *= 0.5;
      high = h_new, f_high = f, side = -1;
    }
  }
  *h = high;
  return try_step(x, s, high);
}

/* Shorten a step so that it ends where a joint reaches or leaves its stop. `has_event` is -1 if a joint leaves its stop
   and returns within the step, which must be tried again with half the size. */
static mech_status limit_step(const fmu *x, motion *s, double *h, int *has_event) {
  int is_found[STOP_SIZE] = {0}, is_checked[STOP_SIZE] = {0};
  double v_tree[MECH_N];
  mech_velocity(&s->at, s->y + MECH_D, v_tree);
  *has_event = 0;
  for (int k = 0; k < 3 * STOPS; ++k) {
    const int i = k % MECH_SIZE(STOPS);
    const double before = find_margin(x, &s->at, s->holding, i), rate = gap_rate(v_tree, i), whole = *h;
    mech_status status = MECH_OK;
    if (!x->is_touching[i] && !is_checked[i] && end_margin(x, s, i, 0) >= 0.0 && rate < 0.0 &&
        end_margin(x, s, i, 1) > 0.0) { /* a turning point may be beyond the stop */
      is_checked[i] = 1;
      status = find_zero(x, s, i, 1, rate, h);
      if (status == MECH_OK && end_margin(x, s, i, 0) >= 0.0) status = try_step(x, s, *h = whole);
    }
    if (status != MECH_OK) return status;
    if (is_found[i] || end_margin(x, s, i, 0) >= 0.0) continue;
    if (!x->is_touching[i] && before <= 1e-3 * MIN_RISE * SCALE[STOPPED[i]]) return *has_event = -1, MECH_OK;
    status = find_zero(x, s, i, 0, before, h);
    if (status != MECH_OK) return status;
    is_found[i] = *has_event = 1;
  }
  return MECH_OK;
}

static void store_motion(fmu *x, const motion *s) {
  x->at = s->at;
  for (int k = 0; k < MECH_D; ++k) {
    x->values[POSITION + s->at.independent[k]] = s->y[k];
    x->values[RATE + s->at.independent[k]] = s->y[MECH_D + k];
  }
  x->has_derivatives = 0;
}

/* Begin at the FMU's motion, after an update of its stops. */
static mech_status begin_motion(fmu *x, motion *s) {
  const mech_status status = update_stops(x);
  if (status != MECH_OK) return status;
  s->at = x->at;
  for (int k = 0; k < MECH_D; ++k) s->y[k] = x->values[POSITION + s->at.independent[k]];
  independent_rates(x, s->y + MECH_D);
  return reduced_rate(x, s->u_tree, s->y, &s->at, s->rate[0], s->holding);
}

static int is_joint(int coordinate) {
  for (int k = 0; k < JOINTS; ++k)
    if (JOINT[k][1] == coordinate) return 1;
  return 0;
}

/* Where a dependent coordinate moves much faster than the independent ones, phi_z is nearly singular: exchange two of them,
   until all entries of rho are small. Only joints become independent. */
static mech_status change_chart(const fmu *x, motion *s) {
  mech_configuration *const at = &s->at;
  double v_tree[MECH_N], limit = MAX_RHO;
  mech_velocity(at, s->y + MECH_D, v_tree);
  for (int exchange = 0; exchange < MAX_EXCHANGES; ++exchange) {
    int *entering = NULL, *leaving = NULL;
    for (int i = 0; i < MECH_Z; ++i)
      for (int k = 0; k < MECH_D; ++k) {
        const int z = at->dependent[i], q = at->independent[k];
        const double size = fabs(at->rho[z + MECH_N * k]) * SCALE[q] / SCALE[z];
        if (!(size > limit) || !is_joint(z)) continue;
        limit = size;
        entering = &at->dependent[i];
        leaving = &at->independent[k];
      }
    if (entering == NULL) break;
    const int place = *entering;
    *entering = *leaving;
    *leaving = place;
    const mech_status status = evaluate_loops(&x->model, at);
    if (status != MECH_OK) return status;
    compute_rho(at);
    limit = GOOD_RHO;
  }
  if (limit >= MAX_RHO) return MECH_OK;
  for (int k = 0; k < MECH_D; ++k) {
    s->y[k] = at->q_tree[PLACE[at->independent[k]]];
    s->y[MECH_D + k] = v_tree[at->independent[k]];
  }
  return reduced_rate(x, s->u_tree, s->y, at, s->rate[0], s->holding);
}

static mech_status advance(fmu *x, double end) {
  motion s;
  double t = x->values[TIME], step = x->step;
  const double smallest = 16.0 * DBL_EPSILON * fmax(fabs(t), fabs(end));
  mech_status status = fmu_assemble(x);
  if (status != MECH_OK) return status;
  input_force(x, s.u_tree);
  status = begin_motion(x, &s);
  if (status != MECH_OK) return status;
  for (int is_rejected = 0; end - t > smallest;) {
    int has_event = 0;
    double h = fmin(step, end - t);
    status = try_step(x, &s, h);
    const double error = status == MECH_OK ? relative_error(x, &s, h) : HUGE_VAL;
    double factor = error == 0.0 ? 10.0 : 0.9 * pow(error, -1.0 / 8.0);
    const double next = h * fmin(is_rejected ? 1.0 : 10.0, factor);
    const int is_last = !(h < end - t);
    if (error < 1.0) status = limit_step(x, &s, &h, &has_event);
    if (error < 1.0 && status == MECH_OK && has_event >= 0) {
      t = is_last && !has_event ? end : t + h;
      step = has_event ? step : is_last ? fmax(step, next) : next; /* the last step may be shorter than its error asks for */
      memcpy(s.y, s.y_new, sizeof s.y);
      memcpy(s.rate[0], s.rate[STAGES], sizeof s.rate[0]);
      memcpy(s.holding, s.holding_new, sizeof s.holding);
      s.at = s.at_new;
      is_rejected = 0;
      status = change_chart(x, &s);
      if (status == MECH_OK && has_event) {
        store_motion(x, &s);
        status = begin_motion(x, &s);
      }
      if (status != MECH_OK) return status;
    } else {
      if (error < 1.0) factor = 0.5;
      step = h * fmax(0.2, factor);
      is_rejected = 1;
      if (!(step > smallest)) return status != MECH_OK ? status : (mech_status)STEP_TOO_SMALL;
    }
  }
  store_motion(x, &s);
  read_joint_positions(x);
  x->step = step;
  x->values[TIME] = end;
  return MECH_OK;
}

/* Advance to a time under constant inputs. After another status than MECH_OK, the motion is as before. */
static mech_status fmu_advance(fmu *x, double end) {
  const fmu before = *x;
  const mech_status status = advance(x, end);
  if (status != MECH_OK) *x = before;
  return status;
}
