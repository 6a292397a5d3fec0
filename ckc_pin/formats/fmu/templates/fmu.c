/* The FMU of @TITLE@, the same for both versions of the standard: variables, initialization, derivatives, outputs and
   model exchange. Written by ckc_pin @VERSION@ (ckc export --to fmu). */
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
#define ASSEMBLY_PIECES 64
#define STOP_TOLERANCE 1e-9 /* rad, or sizes of the mechanism: a joint this close to its stop is at it */

static const char IDENTITY[] = "@IDENTITY@"; /* of the model description */
static const double START[] = @START@;       /* configuration q_tree of the scene's start */
static const double START_RATES[] = @START_RATES@;
static const int STATE[] = @STATE@; /* places of q in v_tree, in the order of the model description */

/* Stops: places of their coordinate in v_tree and in q_tree, 1 for the upper one or -1, position, restitution, and the
   holding force that counts as zero. */
static const int STOPPED[] = @STOPPED@, STOPPED_PLACE[] = @STOPPED_PLACE@, SIDE[] = @SIDE@;
static const double STOP[] = @STOP@, RESTITUTION[] = @RESTITUTION@, NO_FORCE[] = @NO_FORCE@;

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

#include "directional_derivatives.c"

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

#include "co_simulation.c"
