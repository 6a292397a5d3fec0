/* Co-simulation of @TITLE@: DOP853 of q and q_dot, with sigma in each stage, steps that end at events of stops, and changes
   of the independent coordinates. Included by fmu.c. */

#define STAGES @STAGES@
#define MAX_ROOT_STEPS 80
#define TIME_ROUNDING 1e-14 /* s, of events */
/* Entries of rho, in rad or sizes of the mechanism: where the independent coordinates are changed, and after it. */
#define MAX_RHO 20.0
#define GOOD_RHO 1.5
#define MAX_EXCHANGES 100

/* E. Hairer, S. P. Norsett and G. Wanner, Solving Ordinary Differential Equations I, section II.10. */
static const double DOP853_A[STAGES][STAGES] = @DOP853_A@;
static const double DOP853_B[STAGES] = @DOP853_B@;
static const double DOP853_E3[STAGES + 1] = @DOP853_E3@;
static const double DOP853_E5[STAGES + 1] = @DOP853_E5@;

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
    const int coordinate = s->at.independent[k < MECH_D ? k : k - MECH_D];
    const double size = fmax(fabs(s->y[k]), fabs(s->y_new[k]));
    const double scale = x->tolerance * (0.01 * SCALE[coordinate] + size);
    double error5 = 0.0, error3 = 0.0;
    for (int i = 0; i <= STAGES; ++i) {
      error5 += DOP853_E5[i] * s->rate[i][k];
      error3 += DOP853_E3[i] * s->rate[i][k];
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
    const double *weight = stage < STAGES ? DOP853_A[stage] : DOP853_B;
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
  for (int round = 0; round < 3; ++round)
    for (int i = 0; i < STOPS; ++i) {
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
