/* Stops of @TITLE@: impacts as generalized reflections, and the choice of the stops on which joints rest, by Gauss's
   principle. It is the law of ckc_pin's page on dry friction and stops, without friction. Included by fmu.c. */

#define MAX_ROUNDS 4000        /* of reflections; a projection follows */
#define REFLECTION_ROUNDING 1e-10
#define RATE_ROUNDING 1e-11    /* relative to the fastest coordinate */
#define MIN_RISE 1e-10         /* of a bounce; rad, or sizes of the mechanism */
#define EVENT_OFFSET 1e-12     /* rad, or sizes of the mechanism */
#define STOP_OFFSET_FACTOR 4.0 /* smallest rise of a bounce, relative to the joint's distance from its stop */
#define ACCELERATION_ROUNDING 1e-9

/* Minimize x^T A x / 2 + b^T x, where x[i] >= 0 unless is_free[i], by the method of Lawson and Hanson. The numbers of b
   and of A's diagonal are about one. Return 0 if A is singular. */
static int minimize(const double *A, const double *b, const int *is_free, int m, double *x) {
  double matrix[STOP_SIZE * STOP_SIZE], trial[STOP_SIZE];
  int is_passive[STOP_SIZE], passive[STOP_SIZE] = {0}, pivot[STOP_SIZE], needs_step = 0;
  for (int i = 0; i < m; ++i) {
    x[i] = 0.0;
    is_passive[i] = is_free[i];
    needs_step |= is_free[i];
  }
  for (int iteration = 0; iteration < 20 * (m + 1); ++iteration) {
    if (!needs_step) {
      int entering = -1;
      double lowest = -1e-12;
      for (int i = 0; i < m; ++i) {
        double gradient = b[i];
        for (int j = 0; j < m; ++j) gradient += A[i + m * j] * x[j];
        if (is_passive[i] || gradient >= lowest) continue;
        lowest = gradient;
        entering = i;
      }
      if (entering < 0) return 1;
      is_passive[entering] = 1;
    }
    int n = 0, leaving = -1;
    double part = 1.0;
    for (int i = 0; i < m; ++i)
      if (is_passive[i]) passive[n++] = i;
    for (int i = 0; i < n; ++i) {
      trial[i] = -b[passive[i]];
      for (int j = 0; j < n; ++j) matrix[i + n * j] = A[passive[i] + m * passive[j]];
    }
    if (!factorize(matrix, pivot, n)) return 0;
    solve(matrix, pivot, n, trial);
    for (int i = 0; i < n; ++i) {
      const int k = passive[i];
      if (is_free[k] || trial[i] > 0.0) continue;
      const double ratio = x[k] > 0.0 ? x[k] / (x[k] - trial[i]) : 0.0;
      if (leaving >= 0 && ratio >= part) continue;
      part = ratio;
      leaving = k;
    }
    for (int i = 0; i < n; ++i) x[passive[i]] += part * (trial[i] - x[passive[i]]);
    needs_step = leaving >= 0;
    if (needs_step) {
      is_passive[leaving] = 0;
      x[leaving] = 0.0;
    }
  }
  return 0;
}

/* An impact at the stops of a contact. Rates of distances are scaled so that A has a unit diagonal. */
typedef struct {
  int m;
  double A[STOP_SIZE * STOP_SIZE], scale[STOP_SIZE], rate[STOP_SIZE], restitution[STOP_SIZE], rest[STOP_SIZE];
  double bounce[STOP_SIZE]; /* slower bounces are suppressed */
  double impulse[STOP_SIZE];
} impact;

/* Scale a contact's matrix. */
static void scale_contact(const contact *c, double *scale, double *A) {
  const int m = c->count;
  for (int i = 0; i < m; ++i) scale[i] = 1.0 / sqrt(c->A[i + m * i]);
  for (int j = 0; j < m; ++j)
    for (int i = 0; i < m; ++i) A[i + m * j] = scale[i] * c->A[i + m * j] * scale[j];
}

/* Reflect the stops that are listed, with impulses that are not negative unless `is_free`. */
static int reflect(impact *x, const int *which, int count, const int *is_free, double restitution) {
  double A[STOP_SIZE * STOP_SIZE] = {0.0}, b[STOP_SIZE] = {0.0}, before[STOP_SIZE], impulse[STOP_SIZE], size = 0.0;
  for (int i = 0; i < count; ++i) size = fmax(size, fabs(before[i] = x->rate[which[i]]));
  for (int j = 0; j < count; ++j) {
    b[j] = before[j] / size;
    for (int i = 0; i < count; ++i) A[i + count * j] = x->A[which[i] + x->m * which[j]];
  }
  if (!minimize(A, b, is_free, count, impulse)) return 0;
  for (int j = 0; j < count; ++j) {
    impulse[j] *= (1.0 + restitution) * size;
    for (int i = 0; i < x->m; ++i) x->rate[i] += x->A[i + x->m * which[j]] * impulse[j];
    x->impulse[which[j]] += impulse[j] * x->scale[which[j]];
  }
  for (int i = 0; i < count; ++i)
    if (fabs(x->rate[which[i]] + restitution * before[i]) <= REFLECTION_ROUNDING * size)
      x->rate[which[i]] = -restitution * before[i];
  return 1;
}

static double restitution_of(const impact *x, int i) {
  return -x->restitution[i] * x->rate[i] > x->bounce[i] ? x->restitution[i] : 0.0;
}

/* Resolve an impact in rounds. A rate is zero afterwards where a joint rests on its stop. */
static int resolve_impact(impact *x) {
  int which[STOP_SIZE], is_free[STOP_SIZE];
  for (int round = 0; round < MAX_ROUNDS; ++round) {
    double e = HUGE_VAL;
    int count = 0;
    for (int i = 0; i < x->m; ++i) {
      is_free[i] = 0;
      if (x->rate[i] < -x->rest[i]) e = fmin(e, restitution_of(x, i));
    }
    if (e > 1.0) break;
    for (int i = 0; i < x->m; ++i) {
      const int takes_part = x->rate[i] < -x->rest[i] ? restitution_of(x, i) <= e
                                                      : x->rate[i] <= x->rest[i] && (e <= 0.0 || x->restitution[i] <= 0.0);
      if (takes_part) which[count++] = i;
    }
    if (!reflect(x, which, count, is_free, e)) return 0;
  }
  for (int attempt = 0; attempt < 3; ++attempt) {
    int is_needed = 0;
    for (int i = 0; i < x->m; ++i) {
      which[i] = i;
      is_needed |= x->rate[i] < -x->rest[i] || (x->rate[i] > x->rest[i] && x->rate[i] <= x->bounce[i]);
      is_free[i] = x->rate[i] >= -x->rest[i] && x->rate[i] <= x->bounce[i];
    }
    if (is_needed && !reflect(x, which, x->m, is_free, 0.0)) return 0;
  }
  for (int i = 0; i < x->m; ++i)
    if (x->rate[i] <= x->rest[i]) x->rate[i] = 0.0;
  return 1;
}

/* The distance from a stop, or the force of the stop if a joint rests on it. A state event is where it becomes negative.
   In model exchange it is positive after an impact, so that the importer sees the change of its sign at the next one. */
static double find_margin(const fmu *x, const mech_configuration *at, const double *holding, int i) {
  if (x->is_touching[i]) return holding[i] + NO_FORCE[i];
  return find_gap(at, i) + (x->is_model_exchange ? EVENT_OFFSET * SCALE[STOPPED[i]] : 0.0);
}

/* Move joints out of the stops that `is_near` selects, as far as the importer's solver has moved them into these. */
static mech_status push_out(fmu *x, const int *is_near) {
  double D_tree[MECH_N * MECH_N], D[MECH_D * MECH_D], step[MECH_N] = {0.0}, size = 0.0;
  double A[STOP_SIZE * STOP_SIZE], scale[STOP_SIZE], b[STOP_SIZE] = {0.0}, distance[STOP_SIZE];
  const int none[STOP_SIZE] = {0};
  int pivot[MECH_D];
  contact c;
  const mech_status status = factorize_inertia(x, &x->at, D_tree, D, pivot);
  if (status != MECH_OK) return status;
  find_responses(&x->at, D_tree, D, pivot, is_near, &c);
  scale_contact(&c, scale, A);
  for (int j = 0; j < c.count; ++j) size = fmax(size, fabs(b[j] = scale[j] * find_gap(&x->at, c.which[j])));
  for (int j = 0; j < c.count; ++j) b[j] /= fmax(size, DBL_MIN);
  if (!minimize(A, b, none, c.count, distance)) return (mech_status)DEPENDENT_STOPS;
  for (int j = 0; j < c.count; ++j) distance[j] *= size * scale[j];
  push(&x->at, &c, distance, step);
  for (int k = 0; k < JOINTS; ++k) x->values[POSITION + JOINT[k][1]] += step[JOINT[k][1]];
  x->has_derivatives = 0;
  return fmu_differentiate(x);
}

/* Resolve an impact of joints at the stops that `is_near` selects, and select those on which joints rest. `held` are
   the accelerations before the impact, with the forces of the stops. */
static mech_status resolve_stops(fmu *x, const double *held, int *is_near) {
  double v_tree[MECH_N], q_dot[MECH_D], D_tree[MECH_N * MECH_N], D[MECH_D * MECH_D], fastest = 0.0;
  int pivot[MECH_D];
  contact c;
  impact hit;
  mech_status status = factorize_inertia(x, &x->at, D_tree, D, pivot);
  if (status != MECH_OK) return status;
  find_responses(&x->at, D_tree, D, pivot, is_near, &c);
  independent_rates(x, q_dot);
  mech_velocity(&x->at, q_dot, v_tree);
  for (int k = 0; k < MECH_N; ++k) fastest = fmax(fastest, fabs(v_tree[k]) / SCALE[k]);
  const double min_rise = fmax(MIN_RISE, 0.01 * x->tolerance);
  memset(&hit, 0, sizeof hit);
  hit.m = c.count;
  scale_contact(&c, hit.scale, hit.A);
  for (int j = 0; j < c.count; ++j) {
    const int i = c.which[j];
    const double size = SCALE[STOPPED[i]];
    const double returns = -fmin(gap_rate(x->values + ACCELERATION, i), gap_rate(held, i));
    const double rise = fmax(min_rise * size, STOP_OFFSET_FACTOR * fabs(find_gap(&x->at, i)));
    hit.rate[j] = hit.scale[j] * gap_rate(v_tree, i);
    hit.restitution[j] = RESTITUTION[i];
    hit.rest[j] = hit.scale[j] * RATE_ROUNDING * fastest * size;
    hit.bounce[j] = fmax(hit.rest[j], hit.scale[j] * sqrt(2.0 * fmax(returns, 0.0) * rise));
  }
  if (!resolve_impact(&hit)) return (mech_status)DEPENDENT_STOPS;
  push(&x->at, &c, hit.impulse, v_tree);
  for (int k = 0; k < MECH_D; ++k) x->values[RATE + x->at.independent[k]] = v_tree[x->at.independent[k]];
  for (int i = 0; i < STOPS; ++i) is_near[i] = 0;
  for (int j = 0; j < c.count; ++j) is_near[c.which[j]] = hit.rate[j] <= 0.0;
  x->has_derivatives = 0;
  return MECH_OK;
}

/* Choose the stops that hold joints, among those on which joints rest, and put these joints exactly there. */
static mech_status choose_holding(fmu *x, const int *is_resting, const int *pulls) {
  double D_tree[MECH_N * MECH_N], D[MECH_D * MECH_D], v_tree[MECH_N], q_dot[MECH_D], step[MECH_N] = {0.0};
  double A[STOP_SIZE * STOP_SIZE], scale[STOP_SIZE], b[STOP_SIZE] = {0.0}, force[STOP_SIZE], size = 0.0;
  const int none[STOP_SIZE] = {0};
  int pivot[MECH_D];
  contact c;
  mech_status status = factorize_inertia(x, &x->at, D_tree, D, pivot);
  if (status != MECH_OK) return status;
  find_responses(&x->at, D_tree, D, pivot, is_resting, &c);
  independent_rates(x, q_dot);
  mech_velocity(&x->at, q_dot, v_tree);
  for (int j = 0; j < c.count; ++j) b[j] = find_gap(&x->at, c.which[j]);
  status = hold(&c, b, force);
  if (status != MECH_OK) return status;
  push(&x->at, &c, force, step);
  for (int j = 0; j < c.count; ++j) b[j] = gap_rate(v_tree, c.which[j]);
  status = hold(&c, b, force);
  if (status != MECH_OK) return status;
  push(&x->at, &c, force, v_tree);
  for (int k = 0; k < JOINTS; ++k) x->values[POSITION + JOINT[k][1]] += step[JOINT[k][1]];
  for (int k = 0; k < MECH_D; ++k) x->values[RATE + x->at.independent[k]] = v_tree[x->at.independent[k]];
  x->has_derivatives = 0;
  status = fmu_differentiate(x);
  if (status != MECH_OK) return status;
  scale_contact(&c, scale, A);
  for (int j = 0; j < c.count; ++j)
    size = fmax(size, fabs(b[j] = scale[j] * gap_rate(x->values + ACCELERATION, c.which[j])));
  for (int j = 0; j < c.count; ++j) b[j] /= fmax(size, DBL_MIN);
  if (!minimize(A, b, none, c.count, force)) return (mech_status)DEPENDENT_STOPS;
  for (int j = 0; j < c.count; ++j) {
    const int i = c.which[j];
    double acceleration = b[j];
    for (int k = 0; k < c.count; ++k) acceleration += A[j + c.count * k] * force[k];
    x->is_touching[i] = acceleration <= ACCELERATION_ROUNDING && !(pulls[i] && force[j] <= ACCELERATION_ROUNDING);
  }
  x->has_derivatives = 0;
  return fmu_differentiate(x);
}

/* Update velocities and contacts at an event: an impact, a joint that leaves its stop, or a change of inputs. */
static mech_status update_stops(fmu *x) {
  const double at_stop = x->is_model_exchange ? STOP_TOLERANCE : EVENT_OFFSET;
  double held[MECH_N], fastest = 0.0;
  int is_near[STOP_SIZE], pulls[STOP_SIZE], is_lost[STOP_SIZE], any = 0, approaches = 0;
  mech_status status = fmu_differentiate(x);
  if (status != MECH_OK || STOPS == 0) return status;
  memcpy(held, x->values + ACCELERATION, sizeof held);
  for (int k = 0; k < MECH_N; ++k) fastest = fmax(fastest, fabs(x->values[RATE + k]) / SCALE[k]);
  for (int i = 0; i < STOPS; ++i) {
    const double size = SCALE[STOPPED[i]], rate = gap_rate(x->values + RATE, i);
    const double slow = RATE_ROUNDING * fastest * size;
    is_near[i] = x->is_touching[i] || find_gap(&x->at, i) <= at_stop * size + RATE_ROUNDING * fabs(rate);
    pulls[i] = x->is_touching[i] && x->holding[i] < 0.0;
    /* A joint that leaves its stop cannot be beyond it: the importer's solver does not resolve the bounce, which ends. */
    is_lost[i] = x->is_model_exchange && find_margin(x, &x->at, x->holding, i) < 0.0;
    approaches |= is_near[i] && !x->is_touching[i] && rate < -slow;
    any |= is_near[i];
  }
  if (!any) return MECH_OK;
  if (x->is_model_exchange) status = push_out(x, is_near);
  if (status != MECH_OK) return status;
  if (approaches) {
    memset(x->is_touching, 0, sizeof x->is_touching);
    x->has_derivatives = 0;
    status = fmu_differentiate(x);
    if (status == MECH_OK) status = resolve_stops(x, held, is_near);
  } else {
    for (int i = 0; i < STOPS; ++i)
      is_near[i] &= x->is_touching[i] || is_lost[i] ||
                    gap_rate(x->values + RATE, i) <= RATE_ROUNDING * fastest * SCALE[STOPPED[i]];
    memset(x->is_touching, 0, sizeof x->is_touching);
    x->has_derivatives = 0;
  }
  return status == MECH_OK ? choose_holding(x, is_near, pulls) : status;
}
