/* The FMU of @TITLE@, the same for both versions of the standard: variables, initialization, derivatives, outputs and
   co-simulation. Written by ckc_pin @VERSION@ (ckc export --to fmu). */
#include <float.h>
#include <stdlib.h>
#include <string.h>

#include "mech.c"

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
  VARIABLES
};

#define IS_SPF @IS_SPF@ /* model exchange by eq. 8, whose states are all coordinates and q_dot; otherwise q and q_dot */
enum { STATES = IS_SPF ? MECH_N + MECH_D : 2 * MECH_D };
enum { ASSEMBLY_PIECES = 64, STAGES = @STAGES@ };

static const char IDENTITY[] = "@IDENTITY@"; /* of the model description */
static const double START[] = @START@;       /* configuration q_tree of the scene's start */
static const double START_RATES[] = @START_RATES@;

/* DOP853: E. Hairer, S. P. Norsett and G. Wanner, Solving Ordinary Differential Equations I, section II.10. */
static const double A[STAGES][STAGES] = @A@;
static const double B[STAGES] = @B@;
static const double E3[STAGES + 1] = @E3@, E5[STAGES + 1] = @E5@;

static const char *const REASON[] = {
    "no error",
    "the loops cannot be closed: the coordinates are out of reach, or a step is too long",
    "phi_z is singular: the independent coordinates do not determine the configuration",
    "a value is not a finite number",
    "the step size of the integration became too small",
    "the motors cannot produce every u",
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
  x->tolerance = @RTOL@;
  x->step = 1e-3;
  x->is_initializing = 1;
}

static void read_joint_positions(fmu *x) {
  for (int k = 0; k < JOINTS; ++k) x->values[POSITION + JOINT[k][1]] = x->at.q_tree[JOINT[k][0]];
}

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
  for (int k = 0; k < MECH_D; ++k) q_dot[k] = x->values[RATE + INDEPENDENT[k]];
}

/* Move the configuration to the states. */
static mech_status follow_states(fmu *x) {
  mech_configuration at = x->at;
  mech_status status;
  if (IS_SPF && x->is_model_exchange) {
    double q_tree[MECH_NQ];
    memcpy(q_tree, at.q_tree, sizeof q_tree);
    for (int k = 0; k < JOINTS; ++k) q_tree[JOINT[k][0]] = x->values[POSITION + JOINT[k][1]];
    status = mech_configure(&x->model, q_tree, &at);
  } else {
    double q[MECH_D];
    for (int k = 0; k < MECH_D; ++k) q[k] = x->values[POSITION + INDEPENDENT[k]];
    status = mech_sigma(&x->model, q, &at);
    if (status != MECH_OK) {
      at = x->at;
      status = mech_move(&x->model, q, &at);
    }
  }
  if (status == MECH_OK) x->at = at;
  return status;
}

/* Compute rates and accelerations of the states, by eq. 6 or eq. 8. */
static mech_status fmu_differentiate(fmu *x) {
  double u_tree[MECH_N], q_dot[MECH_D], q_ddot[MECH_D];
  mech_status status = fmu_assemble(x);
  if (status != MECH_OK || x->has_derivatives) return status;
  status = follow_states(x);
  if (status != MECH_OK) return status;
  independent_rates(x, q_dot);
  input_force(x, u_tree);
  status = mech_forward_dynamics(&x->model, &x->at, q_dot, u_tree, q_ddot);
  if (status != MECH_OK) return status;
  mech_velocity(&x->at, q_dot, x->values + RATE);
  if (IS_SPF && x->is_model_exchange) {
    double z_dot[MECH_SIZE(MECH_Z)];
    close_rows(&x->at, x->at.phi, z_dot);
    for (int k = 0; k < MECH_Z; ++k) x->values[RATE + DEPENDENT[k]] += z_dot[k] / x->values[EPSILON];
  }
  for (int k = 0; k < MECH_D; ++k) x->values[ACCELERATION + INDEPENDENT[k]] = q_ddot[k];
  x->has_derivatives = 1;
  x->has_outputs = 0;
  return MECH_OK;
}

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
  double *const values = x->values, q_dot[MECH_D], q_ddot[MECH_D], v_tree[MECH_N], u_tree[MECH_N];
  double D_tree[MECH_N * MECH_N], momentum[MECH_N];
  const mech_status status = fmu_differentiate(x);
  if (status != MECH_OK || x->has_outputs) return status;
  independent_rates(x, q_dot);
  input_force(x, u_tree);
  mech_velocity(&x->at, q_dot, v_tree);
  for (int k = 0; k < MECH_D; ++k) q_ddot[k] = values[ACCELERATION + INDEPENDENT[k]];
  mech_tree_acceleration(&x->model, &x->at, v_tree, q_ddot, values + ACCELERATION);
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

static const char *set_value(fmu *x, unsigned reference, double value) {
  const int is_input = (int)reference >= TORQUE && (int)reference < POSITION;
  if (!is_input && !is_start_value(reference)) return "only inputs, parameters and start values can be set";
  if (!is_input && !x->is_initializing) return "parameters and start values can only be set before the end of initialization";
  if (!(fabs(value) <= DBL_MAX)) return REASON[MECH_NOT_FINITE];
  x->values[reference] = value;
  if (!is_input) x->is_assembled = 0;
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
  if (k >= positions) return RATE + INDEPENDENT[k - positions];
  return IS_SPF ? POSITION + k : POSITION + INDEPENDENT[k];
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

static mech_status fmu_get_derivatives(fmu *x, double *derivatives) {
  const mech_status status = fmu_differentiate(x);
  for (int k = 0; k < STATES; ++k) derivatives[k] = x->values[state_place(k) + MECH_N];
  return status;
}

/* --- co-simulation: DOP853 of q and q_dot, with sigma in each stage --- */

static mech_status reduced_rate(const fmu *x, const double *u_tree, const double *y, mech_configuration *at,
                                double *rate) {
  for (int k = 0; k < MECH_D; ++k) rate[k] = y[MECH_D + k];
  const mech_status status = mech_sigma(&x->model, y, at);
  return status == MECH_OK ? mech_forward_dynamics(&x->model, at, y + MECH_D, u_tree, rate + MECH_D) : status;
}

/* Return the error of a step relative to its tolerance. */
static double relative_error(const fmu *x, double h, double rate[STAGES + 1][2 * MECH_D], const double *y,
                             const double *y_new) {
  double square5 = 0.0, square3 = 0.0;
  for (int k = 0; k < 2 * MECH_D; ++k) {
    double error5 = 0.0, error3 = 0.0;
    const double size = fmax(fabs(y[k]), fabs(y_new[k]));
    const double scale = x->tolerance * (0.01 * SCALE[INDEPENDENT[k % MECH_D]] + size);
    for (int i = 0; i <= STAGES; ++i) {
      error5 += E5[i] * rate[i][k];
      error3 += E3[i] * rate[i][k];
    }
    square5 += error5 * error5 / (scale * scale);
    square3 += error3 * error3 / (scale * scale);
  }
  if (square5 == 0.0 && square3 == 0.0) return 0.0;
  return h * square5 / sqrt((square5 + 0.01 * square3) * 2.0 * MECH_D);
}

/* Try a step, with rate[0] known. */
static mech_status try_step(const fmu *x, const double *u_tree, double h, double rate[STAGES + 1][2 * MECH_D],
                            const double *y, double *y_new, mech_configuration *at) {
  for (int stage = 1; stage <= STAGES; ++stage) {
    const double *weight = stage < STAGES ? A[stage] : B;
    for (int k = 0; k < 2 * MECH_D; ++k) {
      y_new[k] = 0.0;
      for (int i = 0; i < stage; ++i) y_new[k] += weight[i] * rate[i][k];
      y_new[k] = y[k] + h * y_new[k];
    }
    const mech_status status = reduced_rate(x, u_tree, y_new, at, rate[stage]);
    if (status != MECH_OK) return status;
  }
  return MECH_OK;
}

/* Advance to a time under constant inputs. After another status than MECH_OK, the motion is as before. */
static mech_status fmu_advance(fmu *x, double end) {
  double u_tree[MECH_N], y[2 * MECH_D], y_new[2 * MECH_D], rate[STAGES + 1][2 * MECH_D];
  double t = x->values[TIME], step = x->step;
  const double smallest = 16.0 * DBL_EPSILON * fmax(fabs(t), fabs(end));
  mech_status status = fmu_assemble(x);
  if (status != MECH_OK) return status;
  mech_configuration at = x->at;
  input_force(x, u_tree);
  for (int k = 0; k < MECH_D; ++k) y[k] = x->values[POSITION + INDEPENDENT[k]];
  independent_rates(x, y + MECH_D);
  status = reduced_rate(x, u_tree, y, &at, rate[0]);
  if (status != MECH_OK) return status;
  for (int is_rejected = 0; end - t > smallest;) {
    const double h = fmin(step, end - t);
    mech_configuration at_new = at;
    status = try_step(x, u_tree, h, rate, y, y_new, &at_new);
    const double error = status == MECH_OK ? relative_error(x, h, rate, y, y_new) : HUGE_VAL;
    const double factor = error == 0.0 ? 10.0 : 0.9 * pow(error, -1.0 / 8.0);
    if (error < 1.0) {
      const double next = h * fmin(is_rejected ? 1.0 : 10.0, factor);
      t = h < end - t ? t + h : end;
      step = t < end ? next : fmax(step, next); /* the last step may be shorter than its error asks for */
      memcpy(y, y_new, sizeof y);
      memcpy(rate[0], rate[STAGES], sizeof rate[0]);
      at = at_new;
      is_rejected = 0;
    } else {
      step = h * fmax(0.2, factor);
      is_rejected = 1;
      if (!(step > smallest)) return status != MECH_OK ? status : MECH_INACCURATE;
    }
  }
  for (int k = 0; k < MECH_D; ++k) x->values[RATE + INDEPENDENT[k]] = y[MECH_D + k];
  x->at = at;
  read_joint_positions(x);
  x->step = step;
  x->values[TIME] = end;
  x->has_derivatives = 0;
  return MECH_OK;
}
