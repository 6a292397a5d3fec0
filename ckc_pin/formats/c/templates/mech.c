#include "mech.h"

#include <math.h>

@TABLES@

/* Places of q and z in v_tree. An FMU changes them. */
#ifdef MECH_CHARTS
#define Q_OF(at) (at)->independent
#define Z_OF(at) (at)->dependent
#else
#define Q_OF(at) INDEPENDENT
#define Z_OF(at) DEPENDENT
#endif

/* --- terms of the tree and of the loops, as straight-line code --- */

@FUNCTIONS@
/* --- linear algebra: small dense systems by elimination with partial pivoting --- */

#define SMALLEST_PIVOT @SMALLEST_PIVOT@ /* of the largest pivot: below it a matrix is singular */

static int factorize(double *a, int *pivot, int n) {
  double largest = 0.0, smallest = HUGE_VAL;
  for (int k = 0; k < n; ++k) pivot[k] = k;
  for (int k = 0; k < n; ++k) {
    int best = k;
    for (int i = k + 1; i < n; ++i)
      if (fabs(a[i + n * k]) > fabs(a[best + n * k])) best = i;
    const double size = fabs(a[best + n * k]);
    if (!(size > 0.0)) return 0; /* also NaN */
    largest = fmax(largest, size);
    smallest = fmin(smallest, size);
    pivot[k] = best;
    for (int j = 0; j < n && best != k; ++j) {
      const double moved = a[k + n * j];
      a[k + n * j] = a[best + n * j];
      a[best + n * j] = moved;
    }
    for (int i = k + 1; i < n; ++i) a[i + n * k] /= a[k + n * k];
    for (int j = k + 1; j < n; ++j)
      for (int i = k + 1; i < n; ++i) a[i + n * j] -= a[i + n * k] * a[k + n * j];
  }
  return n == 0 || (smallest > SMALLEST_PIVOT * largest && largest < HUGE_VAL);
}

static void solve(const double *a, const int *pivot, int n, double *b) {
  for (int k = 0; k < n; ++k) {
    const double moved = b[pivot[k]];
    b[pivot[k]] = b[k];
    b[k] = moved;
  }
  for (int k = 0; k < n; ++k)
    for (int i = k + 1; i < n; ++i) b[i] -= a[i + n * k] * b[k];
  for (int k = n - 1; k >= 0; --k) {
    b[k] /= a[k + n * k];
    for (int i = 0; i < k; ++i) b[i] -= a[i + n * k] * b[k];
  }
}

static void solve_transposed(const double *a, const int *pivot, int n, double *b) {
  for (int k = 0; k < n; ++k) {
    for (int i = 0; i < k; ++i) b[k] -= a[i + n * k] * b[i];
    b[k] /= a[k + n * k];
  }
  for (int k = n - 1; k >= 0; --k)
    for (int i = k + 1; i < n; ++i) b[k] -= a[i + n * k] * b[i];
  for (int k = n - 1; k >= 0; --k) {
    const double moved = b[pivot[k]];
    b[pivot[k]] = b[k];
    b[k] = moved;
  }
}

/* y = a x, or y = a^T x, of a matrix with these rows and columns */
static void multiply(const double *a, const double *x, double *y, int rows, int columns) {
  for (int i = 0; i < rows; ++i) y[i] = 0.0;
  for (int k = 0; k < columns; ++k)
    for (int i = 0; i < rows; ++i) y[i] += a[i + rows * k] * x[k];
}

static void multiply_transposed(const double *a, const double *x, double *y, int rows, int columns) {
  for (int k = 0; k < columns; ++k) {
    y[k] = 0.0;
    for (int i = 0; i < rows; ++i) y[k] += a[i + rows * k] * x[i];
  }
}

static int is_finite(const double *x, int n) {
  double sum = 0.0;
  for (int k = 0; k < n; ++k) sum += 0.0 * x[k];
  return sum == 0.0;
}

/* --- model and configurations --- */

void mech_set_parameters(mech_model *model, const mech_parameters *parameters) {
  const double own[] = {@OWN@};
  code_numbers(own, model->numbers);
}

/* Evaluate phi and J, and factorize phi_z. */
static mech_status evaluate_loops(const mech_model *model, mech_configuration *at) {
  for (int k = 0; k < ANGLES; ++k) {
    at->trig[ANGLE[k]] = cos(at->q_tree[ANGLE[k]]);
    at->trig[MECH_NQ + ANGLE[k]] = sin(at->q_tree[ANGLE[k]]);
  }
  code_place(at->q_tree, at->trig, model->numbers, at->phi, at->J);
  if (!is_finite(at->phi, MECH_ROWS)) return MECH_NOT_FINITE;
  for (int k = 0; k < MECH_Z; ++k)
    for (int i = 0; i < MECH_Z; ++i) at->phi_z[i + MECH_Z * k] = at->J[KEPT[i] + MECH_ROWS * Z_OF(at)[k]];
  return factorize(at->phi_z, at->pivot, MECH_Z) ? MECH_OK : MECH_SINGULAR;
}

/* Return in `z` the solution of phi_z z = -rows. */
static void close_rows(const mech_configuration *at, const double *rows, double *z) {
  for (int i = 0; i < MECH_Z; ++i) z[i] = -rows[KEPT[i]];
  solve(at->phi_z, at->pivot, MECH_Z, z);
}

static void compute_rho(mech_configuration *at) {
  for (int k = 0; k < MECH_D; ++k) {
    double z[MECH_SIZE(MECH_Z)], *column = at->rho + MECH_N * k;
    close_rows(at, at->J + MECH_ROWS * Q_OF(at)[k], z);
    for (int i = 0; i < MECH_D; ++i) column[Q_OF(at)[i]] = 0.0;
    column[Q_OF(at)[k]] = 1.0;
    for (int i = 0; i < MECH_Z; ++i) column[Z_OF(at)[i]] = z[i];
  }
}

/* Rotate s by the quaternion r (x, y, z, w). */
static void rotate(const double *r, const double *s, double *rotated) {
  const double x = r[0], y = r[1], z = r[2], w = r[3];
  const double a = 2.0 * (y * s[2] - z * s[1]), b = 2.0 * (z * s[0] - x * s[2]), c = 2.0 * (x * s[1] - y * s[0]);
  rotated[0] = s[0] + w * a + y * c - z * b;
  rotated[1] = s[1] + w * b + z * a - x * c;
  rotated[2] = s[2] + w * c + x * b - y * a;
}

/* Move the configuration by a tangent step. A free root moves along its own axes. */
static void move(double *q_tree, const double *step) {
  for (int k = 0; k < JOINTS; ++k) q_tree[JOINT[k][0]] += step[JOINT[k][1]];
  for (int k = 0; k < ROOTS; ++k) {
    double *p = q_tree + ROOT[k][0], *r = p + 3, shift[3];
    const double *s = step + ROOT[k][1];
    const double x = r[0], y = r[1], z = r[2], w = r[3];
    const double u = 0.5 * s[3], v = 0.5 * s[4], t = 0.5 * s[5];
    rotate(r, s, shift);
    for (int i = 0; i < 3; ++i) p[i] += shift[i];
    r[0] = x + w * u + y * t - z * v;
    r[1] = y + w * v + z * u - x * t;
    r[2] = z + w * t + x * v - y * u;
    r[3] = w - x * u - y * v - z * t;
    const double norm = sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2] + r[3] * r[3]);
    for (int i = 0; i < 4; ++i) r[i] /= norm;
  }
}

mech_status mech_configure(const mech_model *model, const double *q_tree, mech_configuration *at) {
  for (int k = 0; k < MECH_NQ; ++k) at->q_tree[k] = q_tree[k];
  const mech_status status = evaluate_loops(model, at);
  if (status == MECH_OK) compute_rho(at);
  return status;
}

/* Rounding of large coordinates, such as those of a crank after many turns, increases the tolerance. */
static double tolerance(const double *q_tree) {
  double largest = 0.0;
  for (int k = 0; k < JOINTS; ++k) largest = fmax(largest, fabs(q_tree[JOINT[k][0]]) / SCALE[JOINT[k][1]]);
  return MECH_TOLERANCE * fmin(fmax(1.0, largest / @LARGE_COORDINATE@), @MAX_TOLERANCE_FACTOR@);
}

mech_status mech_sigma(const mech_model *model, const double *q, mech_configuration *at) {
  double dq[MECH_D], step[MECH_N], previous = HUGE_VAL;
  if (!is_finite(q, MECH_D)) return MECH_NOT_FINITE;
  for (int k = 0; k < MECH_D; ++k) dq[k] = q[k] - at->q_tree[PLACE[Q_OF(at)[k]]];
  multiply(at->rho, dq, step, MECH_N, MECH_D);
  for (int iteration = 0;; ++iteration) {
    double longest = 0.0, size = 0.0, z[MECH_SIZE(MECH_Z)];
    for (int k = 0; k < MECH_Z; ++k) longest = fmax(longest, fabs(step[Z_OF(at)[k]]) / SCALE[Z_OF(at)[k]]);
    if (!(longest <= MECH_MAX_STEP)) return MECH_NOT_CLOSED;
    move(at->q_tree, step);
    for (int k = 0; k < MECH_D; ++k) at->q_tree[PLACE[Q_OF(at)[k]]] = q[k];
    const mech_status status = evaluate_loops(model, at);
    if (status != MECH_OK) return status;
    for (int i = 0; i < MECH_Z; ++i) size = fmax(size, fabs(at->phi[KEPT[i]]));
    if (size <= tolerance(at->q_tree)) break;
    if (!(size <= 0.5 * previous) || iteration == MECH_MAX_ITERATIONS) return MECH_NOT_CLOSED;
    previous = size;
    close_rows(at, at->phi, z);
    for (int k = 0; k < MECH_D; ++k) step[Q_OF(at)[k]] = 0.0;
    for (int k = 0; k < MECH_Z; ++k) step[Z_OF(at)[k]] = z[k];
  }
  compute_rho(at);
  return MECH_OK;
}

mech_status mech_move(const mech_model *model, const double *q, mech_configuration *at) {
  double start[MECH_D], waypoint[MECH_D];
  for (int k = 0; k < MECH_D; ++k) start[k] = at->q_tree[PLACE[Q_OF(at)[k]]];
  for (int piece = 1; piece <= MECH_PIECES; ++piece) {
    const double rest = (double)(MECH_PIECES - piece) / MECH_PIECES;
    for (int k = 0; k < MECH_D; ++k) waypoint[k] = q[k] - rest * (q[k] - start[k]);
    const mech_status status = mech_sigma(model, waypoint, at);
    if (status != MECH_OK) return status;
  }
  return MECH_OK;
}

/* --- terms --- */

void mech_velocity(const mech_configuration *at, const double *q_dot, double *v_tree) {
  multiply(at->rho, q_dot, v_tree, MECH_N, MECH_D);
}

void mech_tree_acceleration(const mech_model *model, const mech_configuration *at, const double *v_tree,
                            const double *q_ddot, double *acceleration) {
  double bias_tree[MECH_N], damping[MECH_N], J_dot_v[MECH_SIZE(MECH_ROWS)], z[MECH_SIZE(MECH_Z)];
  mech_bias_tree(model, at, v_tree, bias_tree, J_dot_v, damping);
  close_rows(at, J_dot_v, z);
  multiply(at->rho, q_ddot, acceleration, MECH_N, MECH_D);
  for (int k = 0; k < MECH_Z; ++k) acceleration[Z_OF(at)[k]] += z[k];
}

void mech_points(const mech_model *model, const mech_configuration *at, const double *v_tree, double *positions,
                 double *velocities) {
  code_points(at->q_tree, at->trig, v_tree, model->numbers, positions, velocities);
}

void mech_D_tree(const mech_model *model, const mech_configuration *at, double *D_tree) {
  code_inertia(at->q_tree, at->trig, model->numbers, D_tree);
}

void mech_bias_tree(const mech_model *model, const mech_configuration *at, const double *v_tree, double *bias_tree,
                    double *J_dot_v, double *damping) {
  code_bias(at->q_tree, at->trig, v_tree, model->numbers, bias_tree, J_dot_v, damping);
}

void mech_h_tree(const mech_model *model, const mech_configuration *at, double *h_tree) {
  code_rest(at->q_tree, at->trig, model->numbers, h_tree);
}

double mech_potential_energy(const mech_model *model, const mech_configuration *at) {
  double energy;
  code_potential_energy(at->q_tree, at->trig, model->numbers, &energy);
  return energy;
}

/* D = rho^T D' rho */
static void project_inertia(const mech_configuration *at, const double *D_tree, double *D) {
  double column[MECH_N];
  for (int k = 0; k < MECH_D; ++k) {
    multiply(D_tree, at->rho + MECH_N * k, column, MECH_N, MECH_N);
    multiply_transposed(at->rho, column, D + MECH_D * k, MECH_N, MECH_D);
  }
}

void mech_D(const mech_model *model, const mech_configuration *at, double *D) {
  double D_tree[MECH_N * MECH_N];
  mech_D_tree(model, at, D_tree);
  project_inertia(at, D_tree, D);
}

/* Force on the tree D' (rho a + rho_dot x) + C' rho x at the velocity q_dot. Its projection by rho^T is D a + C x. */
static void inertial_force(const mech_model *model, const mech_configuration *at, const double *D_tree,
                           const double *q_dot, const double *x, const double *a, double *force) {
  double v_tree[MECH_N], x_tree[MECH_N], acceleration[MECH_N];
  double velocity_force[MECH_N], J_dot_x[MECH_SIZE(MECH_ROWS)], z[MECH_SIZE(MECH_Z)];
  mech_velocity(at, q_dot, v_tree);
  mech_velocity(at, x, x_tree);
  mech_velocity(at, a, acceleration);
  code_bilinear(at->q_tree, at->trig, v_tree, x_tree, model->numbers, velocity_force, J_dot_x);
  close_rows(at, J_dot_x, z);
  for (int k = 0; k < MECH_Z; ++k) acceleration[Z_OF(at)[k]] += z[k];
  multiply(D_tree, acceleration, force, MECH_N, MECH_N);
  for (int k = 0; k < MECH_N; ++k) force[k] += velocity_force[k];
}

void mech_C(const mech_model *model, const mech_configuration *at, const double *q_dot, double *C) {
  double D_tree[MECH_N * MECH_N], force[MECH_N];
  const double none[MECH_D] = {0.0};
  mech_D_tree(model, at, D_tree);
  for (int k = 0; k < MECH_D; ++k) {
    double unit[MECH_D] = {0.0};
    unit[k] = 1.0;
    inertial_force(model, at, D_tree, q_dot, unit, none, force);
    multiply_transposed(at->rho, force, C + MECH_D * k, MECH_N, MECH_D);
  }
}

void mech_h(const mech_model *model, const mech_configuration *at, double *h) {
  double h_tree[MECH_N];
  mech_h_tree(model, at, h_tree);
  multiply_transposed(at->rho, h_tree, h, MECH_N, MECH_D);
}

/* --- dynamics --- */

/* Solve D' acceleration = force + J^T multipliers for the multipliers. */
static void solve_multipliers(const mech_model *model, const mech_configuration *at, const double *force,
                              const double *acceleration, double *multipliers) {
  double D_tree[MECH_N * MECH_N], inertial[MECH_N], z[MECH_SIZE(MECH_Z)];
  mech_D_tree(model, at, D_tree);
  multiply(D_tree, acceleration, inertial, MECH_N, MECH_N);
  for (int k = 0; k < MECH_Z; ++k) z[k] = inertial[Z_OF(at)[k]] - force[Z_OF(at)[k]];
  solve_transposed(at->phi_z, at->pivot, MECH_Z, z);
  for (int i = 0; i < MECH_ROWS; ++i) multipliers[i] = 0.0;
  for (int k = 0; k < MECH_Z; ++k) multipliers[KEPT[k]] = z[k];
}

void mech_multipliers(const mech_model *model, const mech_configuration *at, const double *v_tree,
                      const double *u_tree, const double *acceleration, double *multipliers) {
  double force[MECH_N], bias_tree[MECH_N], damping[MECH_N], J_dot_v[MECH_SIZE(MECH_ROWS)];
  mech_bias_tree(model, at, v_tree, bias_tree, J_dot_v, damping);
  for (int k = 0; k < MECH_N; ++k) force[k] = u_tree[k] + damping[k] - bias_tree[k];
  solve_multipliers(model, at, force, acceleration, multipliers);
}

mech_status mech_acceleration(const mech_model *model, const mech_configuration *at, const double *v_tree,
                              const double *u_tree, double *acceleration, double *multipliers) {
  double accuracy;
  const double correction[MECH_SIZE(MECH_ROWS)] = {0.0};
  code_acceleration(at->q_tree, at->trig, v_tree, u_tree, correction, model->numbers, acceleration, &accuracy);
  mech_multipliers(model, at, v_tree, u_tree, acceleration, multipliers);
  if (!is_finite(acceleration, MECH_N)) return MECH_NOT_FINITE;
  return accuracy > 0.0 ? MECH_OK : MECH_INACCURATE;
}

/* u = D a + C x + h less the force of dampers at the velocity q_dot if `damped`. */
static void reduced_force(const mech_model *model, const mech_configuration *at, const double *D_tree,
                          const double *q_dot, const double *x, const double *a, int damped, double *u) {
  double force[MECH_N], h_tree[MECH_N];
  inertial_force(model, at, D_tree, q_dot, x, a, force);
  mech_h_tree(model, at, h_tree);
  for (int k = 0; k < MECH_N; ++k) force[k] += h_tree[k];
  if (damped) {
    double v_tree[MECH_N], J_dot_v[MECH_SIZE(MECH_ROWS)], damping[MECH_N];
    mech_velocity(at, q_dot, v_tree);
    mech_bias_tree(model, at, v_tree, h_tree, J_dot_v, damping);
    for (int k = 0; k < MECH_N; ++k) force[k] -= damping[k];
  }
  multiply_transposed(at->rho, force, u, MECH_N, MECH_D);
}

void mech_motor_force(const double *tau, double *u_tree) {
  multiply_transposed(TRANSMISSION, tau, u_tree, MECH_MOTORS, MECH_N);
}

mech_status mech_forward_dynamics(const mech_model *model, const mech_configuration *at, const double *q_dot,
                                  const double *u_tree, double *q_ddot) {
  double D_tree[MECH_N * MECH_N], D[MECH_D * MECH_D], force[MECH_D];
  const double none[MECH_D] = {0.0};
  int pivot[MECH_D];
  mech_D_tree(model, at, D_tree);
  reduced_force(model, at, D_tree, q_dot, q_dot, none, 1, force);
  multiply_transposed(at->rho, u_tree, q_ddot, MECH_N, MECH_D);
  for (int k = 0; k < MECH_D; ++k) q_ddot[k] -= force[k];
  project_inertia(at, D_tree, D);
  if (!factorize(D, pivot, MECH_D)) return MECH_SINGULAR;
  solve(D, pivot, MECH_D, q_ddot);
  return is_finite(q_ddot, MECH_D) ? MECH_OK : MECH_NOT_FINITE;
}

void mech_inverse_dynamics(const mech_model *model, const mech_configuration *at, const double *q_dot,
                           const double *q_ddot, double *u) {
  double D_tree[MECH_N * MECH_N];
  mech_D_tree(model, at, D_tree);
  reduced_force(model, at, D_tree, q_dot, q_dot, q_ddot, 1, u);
}

void mech_limit_torques(double *tau) {
  for (int k = 0; k < MECH_MOTORS; ++k) tau[k] = fmin(fmax(tau[k], LOWEST_TAU[k]), HIGHEST_TAU[k]);
}

mech_status mech_motor_torques(const mech_configuration *at, const double *u, double *tau) {
#if MECH_MOTORS < MECH_D
  (void)at, (void)u, (void)tau;
  return MECH_UNDRIVEN;
#else
  /* u = (G rho)^T tau. As many motors as freedoms: one solution. More: tau = G rho y with (G rho)^T G rho y = u. */
  double drive[MECH_MOTORS * MECH_D], matrix[MECH_D * MECH_D], y[MECH_D];
  int pivot[MECH_D];
  for (int k = 0; k < MECH_D; ++k) {
    multiply(TRANSMISSION, at->rho + MECH_N * k, drive + MECH_MOTORS * k, MECH_MOTORS, MECH_N);
    y[k] = u[k];
  }
  for (int k = 0; k < MECH_D; ++k)
    for (int i = 0; i < MECH_D; ++i) {
#if MECH_MOTORS == MECH_D
      matrix[i + MECH_D * k] = drive[k + MECH_MOTORS * i];
#else
      matrix[i + MECH_D * k] = 0.0;
      for (int j = 0; j < MECH_MOTORS; ++j)
        matrix[i + MECH_D * k] += drive[j + MECH_MOTORS * i] * drive[j + MECH_MOTORS * k];
#endif
    }
  if (!factorize(matrix, pivot, MECH_D)) return MECH_UNDRIVEN;
  solve(matrix, pivot, MECH_D, y);
#if MECH_MOTORS == MECH_D
  for (int k = 0; k < MECH_D; ++k) tau[k] = y[k];
#else
  multiply(drive, y, tau, MECH_MOTORS, MECH_D);
#endif
  mech_limit_torques(tau);
  return is_finite(y, MECH_D) ? MECH_OK : MECH_NOT_FINITE;
#endif
}

/* --- simulation of the reduced model --- */

mech_status mech_advance(const mech_model *model, mech_motion *motion, const double *tau, double step) {
  static const double part[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0 / 6, 1.0 / 3, 1.0 / 3, 1.0 / 6};
  mech_configuration at = motion->at;
  double u_tree[MECH_N], q[MECH_D], q_dot[MECH_D], q_ddot[MECH_D], dq[MECH_D] = {0.0}, dv[MECH_D] = {0.0};
  mech_status status;
  mech_motor_force(tau, u_tree);
  for (int k = 0; k < MECH_D; ++k) q_dot[k] = motion->q_dot[k];
  for (int stage = 0; stage < 4; ++stage) {
    if (stage > 0) {
      for (int k = 0; k < MECH_D; ++k) {
        q[k] = motion->at.q_tree[PLACE[Q_OF(&motion->at)[k]]] + part[stage] * step * q_dot[k];
        q_dot[k] = motion->q_dot[k] + part[stage] * step * q_ddot[k];
      }
      status = mech_sigma(model, q, &at);
      if (status != MECH_OK) return status;
    }
    status = mech_forward_dynamics(model, &at, q_dot, u_tree, q_ddot);
    if (status != MECH_OK) return status;
    for (int k = 0; k < MECH_D; ++k) {
      dq[k] += weight[stage] * step * q_dot[k];
      dv[k] += weight[stage] * step * q_ddot[k];
    }
  }
  for (int k = 0; k < MECH_D; ++k) q[k] = motion->at.q_tree[PLACE[Q_OF(&motion->at)[k]]] + dq[k];
  status = mech_sigma(model, q, &at);
  if (status != MECH_OK) return status;
  motion->at = at;
  for (int k = 0; k < MECH_D; ++k) motion->q_dot[k] += dv[k];
  return MECH_OK;
}

/* --- controllers --- */

mech_status mech_set_point_start(mech_set_point *controller, const mech_configuration *start) {
  mech_configuration at = *start;
  const mech_status status = mech_move(controller->model, controller->q_d, &at);
  if (status == MECH_OK) mech_h(controller->model, &at, controller->h_d);
  return status;
}

/* Move the state to the measured q. */
static mech_status observe(const mech_model *model, const mech_state *state, const mech_measurement *measurement,
                           mech_configuration *at, mech_command *command) {
  for (int k = 0; k < MECH_D; ++k) command->u[k] = 0.0;
  for (int k = 0; k < MECH_MOTORS; ++k) command->tau[k] = 0.0;
  *at = *state;
  return mech_sigma(model, measurement->q, at);
}

/* Share u among the motors, and accept the state. */
static mech_status act(const double *u, const mech_configuration *at, mech_state *state, mech_command *command) {
  if (!is_finite(u, MECH_D)) return MECH_NOT_FINITE;
  const mech_status status = mech_motor_torques(at, u, command->tau);
  if (status != MECH_OK) {
    for (int k = 0; k < MECH_MOTORS; ++k) command->tau[k] = 0.0;
    return status;
  }
  for (int k = 0; k < MECH_D; ++k) command->u[k] = u[k];
  *state = *at;
  return MECH_OK;
}

mech_status mech_set_point_step(const mech_set_point *controller, mech_state *state,
                                const mech_measurement *measurement, mech_command *command) {
  mech_configuration at;
  double u[MECH_D];
  const mech_status status = observe(controller->model, state, measurement, &at, command);
  if (status != MECH_OK) return status;
  for (int i = 0; i < MECH_D; ++i) {
    u[i] = controller->h_d[i];
    for (int k = 0; k < MECH_D; ++k)
      u[i] -= controller->K_P[i + MECH_D * k] * (measurement->q[k] - controller->q_d[k]) +
              controller->K_V[i + MECH_D * k] * measurement->q_dot[k];
  }
  return act(u, &at, state, command);
}

mech_status mech_tracking_step(const mech_tracking *controller, mech_state *state, const mech_measurement *measurement,
                               mech_command *command) {
  mech_configuration at;
  double D_tree[MECH_N * MECH_N], v[MECH_D], a[MECH_D], u[MECH_D];
  const mech_status status = observe(controller->model, state, measurement, &at, command);
  if (status != MECH_OK) return status;
  for (int i = 0; i < MECH_D; ++i) {
    v[i] = measurement->q_d_dot[i];
    a[i] = measurement->q_d_ddot[i];
    for (int k = 0; k < MECH_D; ++k) {
      const double gain = controller->Lambda[i + MECH_D * k];
      v[i] -= gain * (measurement->q[k] - measurement->q_d[k]);
      a[i] -= gain * (measurement->q_dot[k] - measurement->q_d_dot[k]);
    }
  }
  mech_D_tree(controller->model, &at, D_tree);
  reduced_force(controller->model, &at, D_tree, measurement->q_dot, v, a, 0, u);
  for (int i = 0; i < MECH_D; ++i)
    for (int k = 0; k < MECH_D; ++k) u[i] -= controller->K_D[i + MECH_D * k] * (measurement->q_dot[k] - v[k]);
  return act(u, &at, state, command);
}
