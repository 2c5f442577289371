/* Kalman filters of state, hidden state, tracked parameters and unmeasured disturbances, one for each mode, with the
   modes' probabilities.

   A tracked parameter is a slow state theta, its deviation from the fitted value; for everything behind the filters its
   value is one of the last measured disturbances, s->w[HMPC_MEASURED] and following.

   Source: Simon, Optimal State Estimation, 2006, section 13.2; Blom and Bar-Shalom, IEEE T-AC 33 (1988). */
#include "hmpc_math.h"
#include "hmpc_tables.h"
#include "hmpc_expressions.h"

#if HMPC_MODES > 0

enum {
  START_LIMIT = 25, /* maximum periods at rest that the first estimate simulates for the hidden state */
  START_ROUNDS = 20,
  START_HALVINGS = 60, /* of a step that does not reduce the error */
  START_SWEEPS = 30    /* of Jacobi rotations */
};

#if HMPC_TURNS
/* A value moved by whole periods to the one nearest to another; with an infinite period it stays. */
static real nearest_turn(real value, real to, real period) {
  const real turns = HMPC_LIBM(rint)((value - to) / period);
  return hmpc_finite(turns) && hmpc_abs(turns) > R(0.0) ? value - turns * period : value;
}
#endif

static void known_w(hmpc_state *s, const real *w, int first) {
#if HMPC_NW > 0
  for (int i = 0; i < HMPC_MEASURED && w; ++i)
    if (hmpc_finite(w[i])) {
#if HMPC_TURNS
      s->w[i] = first ? w[i] : nearest_turn(w[i], s->w[i], w_period[i]);
#else
      s->w[i] = w[i];
#endif
    }
#else
  (void)s;
  (void)w;
#endif
  (void)first;
}

static int any_finite(const real *y) {
  int any = 0;
  for (int i = 0; i < HMPC_NY; ++i) any |= hmpc_finite(y[i]);
  return any;
}

/* Outputs of an estimate and their derivatives by it. */
static void measured(const real *z, const real *u, const real *w, real *y, real (*slope)[HMPC_NE]) {
  real v[HMPC_NU];
  for (int i = 0; i < HMPC_NU; ++i) {
    v[i] = u[i];
    for (int j = 0; j < HMPC_ND; ++j) v[i] += disturbs_u[i][j] * z[HMPC_AT_D + j];
  }
  memset(slope, 0, sizeof(real) * HMPC_NY * HMPC_NE);
#if HMPC_CURVED
  real by_x[HMPC_NY][HMPC_NX], by_u[HMPC_NY][HMPC_NU];
  output_slopes(z, v, w, y, by_x[0], by_u[0]);
  for (int i = 0; i < HMPC_NY; ++i) {
    memcpy(slope[i], by_x[i], sizeof by_x[i]);
    for (int j = 0; j < HMPC_ND; ++j) {
      slope[i][HMPC_AT_D + j] = disturbs_y[i][j];
      for (int k = 0; k < HMPC_NU; ++k) slope[i][HMPC_AT_D + j] += by_u[i][k] * disturbs_u[k][j];
    }
  }
#else
  outputs(z, v, w, y);
  for (int i = 0; i < HMPC_NY; ++i) {
    memcpy(slope[i], output_x[i], sizeof output_x[i]);
    for (int j = 0; j < HMPC_ND; ++j) slope[i][HMPC_AT_D + j] = output_d[i][j];
  }
#endif
  for (int i = 0; i < HMPC_NY; ++i)
    for (int j = 0; j < HMPC_ND; ++j) y[i] += disturbs_y[i][j] * z[HMPC_AT_D + j];
}

/* Gaussian with the mean and covariance of a mixture. */
static void mix(const hmpc_filter *filters, const real *share, hmpc_filter *to) {
  memset(to, 0, sizeof *to);
  for (int m = 0; m < HMPC_MODES; ++m) hmpc_add(to->z, share[m], filters[m].z, HMPC_NE);
  for (int m = 0; m < HMPC_MODES; ++m) {
    real off[HMPC_NE];
    if (!(share[m] > R(0.0))) continue;
    for (int i = 0; i < HMPC_NE; ++i) off[i] = filters[m].z[i] - to->z[i];
    for (int i = 0; i < HMPC_NE; ++i) {
      const real factor = share[m] * off[i];
      for (int j = 0; j < HMPC_NE; ++j) to->p[i][j] += share[m] * filters[m].p[i][j] + factor * off[j];
    }
  }
}

static void together(hmpc_state *s, const real *share) {
  real z[HMPC_NE] = {R(0.0)};
  for (int m = 0; m < HMPC_MODES; ++m) hmpc_add(z, share[m], s->filter[m].z, HMPC_NE);
  memcpy(s->x, z, sizeof s->x);
  if (HMPC_NH > 0) memcpy(s->h, z + HMPC_NX, sizeof s->h);
  if (HMPC_ND > 0) memcpy(s->d, z + HMPC_AT_D, sizeof s->d);
#if HMPC_TRACKED > 0
  real by_theta[HMPC_TRACKED];
  tracked_values(z + HMPC_NZ, s->w + HMPC_MEASURED, by_theta);
#endif
}

/* Least-squares step x of rows x = error with the smallest norm. Rotations make the rows orthogonal and also rotate the
   errors; dependent rows shrink to rounding errors. */
static void start_step(real (*rows)[HMPC_NX], real *error, real *x) {
  real largest = R(0.0);
  for (int sweep = 0; sweep < START_SWEEPS; ++sweep) {
    int turned = 0;
    for (int i = 0; i < HMPC_NY; ++i)
      for (int j = i + 1; j < HMPC_NY; ++j) {
        const real a = hmpc_dot(rows[i], rows[i], HMPC_NX), b = hmpc_dot(rows[j], rows[j], HMPC_NX);
        const real both = hmpc_dot(rows[i], rows[j], HMPC_NX);
        if (!(hmpc_abs(both) > HMPC_TARGET_ROUNDING * hmpc_sqrt(a) * hmpc_sqrt(b))) continue;
        const real ratio = (b - a) / (R(2.0) * both);
        const real tangent = R(1.0) / (hmpc_abs(ratio) + hmpc_sqrt(R(1.0) + ratio * ratio));
        const real c = R(1.0) / hmpc_sqrt(R(1.0) + tangent * tangent), d = ratio < R(0.0) ? -c * tangent : c * tangent;
        for (int k = 0; k < HMPC_NX; ++k) {
          const real one = rows[i][k], other = rows[j][k];
          rows[i][k] = c * one - d * other;
          rows[j][k] = d * one + c * other;
        }
        const real one = error[i], other = error[j];
        error[i] = c * one - d * other;
        error[j] = d * one + c * other;
        turned = 1;
      }
    if (!turned) break;
  }
  for (int i = 0; i < HMPC_NY; ++i) largest = hmpc_max(largest, hmpc_dot(rows[i], rows[i], HMPC_NX));
  for (int k = 0; k < HMPC_NX; ++k) x[k] = R(0.0);
  for (int i = 0; i < HMPC_NY; ++i) {
    const real size = hmpc_dot(rows[i], rows[i], HMPC_NX);
    if (hmpc_sqrt(size) > HMPC_START_DEPENDENT * hmpc_sqrt(largest)) hmpc_add(x, error[i] / size, rows[i], HMPC_NX);
  }
}

/* Errors of the outputs at x in standard deviations of the sensors, and their derivatives by the states in units of
   start_size. Returns the sum of the squared errors. */
static real start_lacks(const real *x, const real *y, const real *w, int mode, real *error, real (*rows)[HMPC_NX]) {
  real y_hat[HMPC_NY], sum = R(0.0);
#if HMPC_CURVED
  real by_x[HMPC_NY][HMPC_NX], by_u[HMPC_NY][HMPC_NU];
  output_slopes(x, u_rest, w, y_hat, by_x[0], by_u[0]);
#else
  const real(*const by_x)[HMPC_NX] = output_x;
  outputs(x, u_rest, w, y_hat);
#endif
  for (int i = 0; i < HMPC_NY; ++i) {
    const int seen = hmpc_finite(y[i]);
    const real sigma = hmpc_sqrt(noise_y[mode][i]);
    error[i] = seen ? (y[i] - y_hat[i]) / sigma : R(0.0);
    sum += error[i] * error[i];
    for (int k = 0; k < HMPC_NX; ++k) rows[i][k] = seen ? by_x[i][k] * start_size[mode][k] / sigma : R(0.0);
  }
  return sum;
}

/* Moves x to a state with the outputs y by Newton's method; whole = 0: a step was shortened. Returns the remaining sum
   of squared errors. One step suffices if the outputs are linear in the state. */
static real start_newton(real *x, const real *y, const real *w, int mode, int *whole) {
  real error[HMPC_NY], rows[HMPC_NY][HMPC_NX], after[HMPC_NY], there[HMPC_NY][HMPC_NX], step[HMPC_NX], moved[HMPC_NX];
  real size = start_lacks(x, y, w, mode, error, rows), share = R(1.0), less = R(0.0);
  *whole = 1;
  for (int round = 0; round < START_ROUNDS; ++round) {
    real most = R(0.0);
    for (int i = 0; i < HMPC_NY; ++i)
      if (!(hmpc_abs(error[i]) <= most)) most = hmpc_abs(error[i]);
    if (!hmpc_all_finite(rows[0], HMPC_NY * HMPC_NX) || most < HMPC_START_EXACT) break;
    start_step(rows, error, step);
    int halving = 0;
    for (share = R(1.0); halving < START_HALVINGS; ++halving, share *= R(0.5)) {
      for (int k = 0; k < HMPC_NX; ++k) moved[k] = x[k] + start_size[mode][k] * step[k] * share;
      less = start_lacks(moved, y, w, mode, after, there);
      if (less < size) break;
      if (size < HMPC_START_FITS) return size; /* only rounding errors remain */
      *whole = 0;
    }
    if (halving == START_HALVINGS) break;
    memcpy(x, moved, sizeof moved);
    memcpy(error, after, sizeof error);
    memcpy(rows, there, sizeof rows);
    size = less;
  }
  return hmpc_finite(size) ? size : HMPC_HUGE;
}

/* The state closest to the operating point with the finite outputs of y. If Newton's method from the operating point
   fails or shortens a step, it also starts one standard deviation from the operating point in each state. */
static void start_fitting(const real *y, const real *w, int mode, real *x) {
  enum { TRIED = 2 * HMPC_NX + 1 };
  real found[TRIED][HMPC_NX], size[TRIED], least = HMPC_HUGE, nearest = R(INFINITY);
  int whole;
  for (int n = 0; n < TRIED; ++n) {
    memcpy(found[n], x_rest, sizeof found[n]);
    if (n > 0) {
      const int k = (n - 1) % HMPC_NX;
      found[n][k] += n <= HMPC_NX ? hmpc_sqrt(first_variance[mode][k]) : -hmpc_sqrt(first_variance[mode][k]);
    }
    size[n] = start_newton(found[n], y, w, mode, &whole);
    if (n == 0 && whole && size[0] < HMPC_START_FITS) {
      memcpy(x, found[0], sizeof found[0]);
      return;
    }
    least = hmpc_min(least, size[n]);
  }
  const real most = hmpc_max(least * (R(1.0) + HMPC_START_EXACT), HMPC_START_FITS);
  memcpy(x, x_rest, sizeof found[0]);
  for (int n = 0; n < TRIED; ++n) {
    real distance = R(0.0);
    for (int k = 0; k < HMPC_NX; ++k) {
      const real scale = start_size[mode][k] > R(0.0) ? start_size[mode][k] : R(1.0);
      distance += (found[n][k] - x_rest[k]) / scale * ((found[n][k] - x_rest[k]) / scale);
    }
    if (!(size[n] <= most) || !(distance < nearest)) continue;
    nearest = distance;
    memcpy(x, found[n], sizeof found[n]);
  }
}

/* (x, h, theta, d) at rest: the state that fits the outputs, and the hidden state after a simulation at rest. */
static void start_at(const hmpc_state *s, const real *y, int mode, real *z) {
  real z_next[HMPC_LZ] = {R(0.0)};
  memset(z, 0, sizeof(real) * HMPC_LE);
  start_fitting(y, s->w, mode, z);
  for (int i = 0; i < HMPC_DELAYED; ++i) z[HMPC_NX + i] = u_rest[i % HMPC_NU];
  for (int k = 0; k < START_LIMIT && HMPC_NH > 0; ++k) {
    real moved = R(0.0);
    hmpc_model(z, u_rest, s->w, z_next);
    for (int i = HMPC_NX; i < HMPC_NZ; ++i) {
      moved = hmpc_max(moved, hmpc_abs(z_next[i] - z[i]));
      z[i] = z_next[i];
    }
    if (!(moved > R(1e-10))) break;
  }
}

/* Estimate at rest: the state closest to the operating point with these outputs. */
void hmpc_estimate_start(hmpc_state *s, const real *y, const real *w) {
  real z[HMPC_LE];
  known_w(s, w, 1);
  for (int i = HMPC_MEASURED; i < HMPC_NW; ++i) s->w[i] = w_rest[i]; /* the fitted values, theta = 0 */
#if HMPC_TURNS
  memcpy(s->y, y, sizeof s->y);
#endif
  for (int m = 0; m < HMPC_MODES; ++m) {
    hmpc_filter *const f = &s->filter[m];
    if (m < HMPC_START_MODES) start_at(s, y, m, z); /* the other modes start equally */
    memset(f, 0, sizeof *f);
    memcpy(f->z, z, sizeof f->z);
    for (int i = 0; i < HMPC_NE; ++i) f->p[i][i] = first_variance[m][i];
    s->probability[m] = first_probability[m];
  }
  together(s, s->probability);
}

/* Prediction over one period with the input held. */
static void predict(hmpc_state *s, const hmpc_filter *from, const real *u, int mode, hmpc_filter *to) {
  real v[HMPC_NU], next[HMPC_LZ] = {R(0.0)};
  const real *const d = from->z + HMPC_AT_D;
#if HMPC_TRACKED > 0
  real w[HMPC_NW], by_theta[HMPC_TRACKED]; /* with this mode's parameters, and their derivatives */
  memcpy(w, s->w, sizeof w);
  tracked_values(from->z + HMPC_NZ, w + HMPC_MEASURED, by_theta);
#else
  const real *const w = s->w;
#endif
  for (int i = 0; i < HMPC_NU; ++i) {
    v[i] = u[i];
    for (int j = 0; j < HMPC_ND; ++j) v[i] += disturbs_u[i][j] * d[j];
  }
  hmpc_model_slope(from->z, v, w, next, s->stage[0]);
  for (int i = 0; i < HMPC_NZ; ++i) {
    memcpy(s->transition[i], s->stage[i], sizeof(real) * HMPC_NZ);
    for (int j = 0; j < HMPC_ND; ++j) {
      real slope = i < HMPC_NX ? disturbs_x[i < HMPC_NX ? i : 0][j] : R(0.0);
      for (int k = 0; k < HMPC_NU; ++k) slope += s->stage[i][HMPC_LZ + k] * disturbs_u[k][j];
      s->transition[i][HMPC_AT_D + j] = slope;
      if (i < HMPC_NX) next[i] += disturbs_x[i < HMPC_NX ? i : 0][j] * d[j];
    }
#if HMPC_TRACKED > 0
    for (int j = 0; j < HMPC_TRACKED; ++j)
      s->transition[i][HMPC_NZ + j] = s->stage[i][HMPC_LZ + HMPC_NU + j] * by_theta[j];
#endif
  }
  for (int i = HMPC_NZ; i < HMPC_NE; ++i) s->transition[i][i] = decay[i - HMPC_NZ]; /* 1 for d */
  hmpc_multiply(s->transition[0], HMPC_LE, from->p[0], s->product[0], HMPC_NE, HMPC_NE, HMPC_NE, HMPC_LE);
  for (int i = 0; i < HMPC_NE; ++i)
    for (int j = 0; j < i; ++j) {
      const real kept = s->product[i][j];
      s->product[i][j] = s->product[j][i];
      s->product[j][i] = kept;
    }
  hmpc_multiply(s->transition[0], HMPC_LE, s->product[0], to->p[0], HMPC_NE, HMPC_NE, HMPC_NE, HMPC_LE);
  for (int i = 0; i < HMPC_NE; ++i) {
    to->p[i][i] += noise[mode][i];
    to->z[i] = i < HMPC_NZ ? next[i < HMPC_NZ ? i : 0] : s->transition[i][i] * from->z[i];
  }
}

/* Correction by the sample in Joseph form; non-finite outputs are left out. */
static void correct(hmpc_state *s, hmpc_filter *f, const real *y, const real *u, int mode) {
  real y_hat[HMPC_NY], slope[HMPC_NY][HMPC_NE], step[HMPC_NE] = {R(0.0)}, size = R(0.0);
  const real *const noise_of = noise_y[mode];
  measured(f->z, u, s->w, y_hat, slope);
  f->nis = R(0.0);
  for (int i = 0; i < HMPC_NY; ++i) {
    real pc[HMPC_NE], kalman[HMPC_NE];
    const real *const c = slope[i];
    if (!hmpc_finite(y[i])) continue;
    for (int k = 0; k < HMPC_NE; ++k) pc[k] = hmpc_dot(f->p[k], c, HMPC_NE);
    const real variance = hmpc_dot(c, pc, HMPC_NE) + noise_of[i];
    const real error = (y[i] - y_hat[i]) - hmpc_dot(c, step, HMPC_NE);
    for (int k = 0; k < HMPC_NE; ++k) kalman[k] = pc[k] / variance;
    for (int k = 0; k < HMPC_NE; ++k) hmpc_add(f->p[k], -kalman[k], pc, HMPC_NE);
    for (int k = 0; k < HMPC_NE; ++k) {
      const real left = hmpc_dot(f->p[k], c, HMPC_NE) - noise_of[i] * kalman[k];
      hmpc_add(f->p[k], -left, kalman, HMPC_NE);
      step[k] += kalman[k] * error;
    }
    f->nis += error / variance * error;
    size += hmpc_log(variance);
  }
  hmpc_add(f->z, R(1.0), step, HMPC_NE);
  for (int k = 0; k < HMPC_NE; ++k)
    for (int j = 0; j < k; ++j) f->p[k][j] = f->p[j][k] = R(0.5) * (f->p[k][j] + f->p[j][k]);
  f->likelihood = R(-0.5) * (f->nis + size);
}

static int lost(const hmpc_filter *f, int mode) {
  real sum = R(0.0);
  int far = 0;
  for (int i = 0; i < HMPC_NE; ++i) {
    far |= !hmpc_finite(f->z[i]);
    far |= !(f->p[i][i] <= lost_variance[mode][i]);
    sum += f->p[i][i];
  }
  return far || !hmpc_finite(sum);
}

void hmpc_estimate_update(hmpc_state *s, const real *y, const real *u_prev, const real *w) {
  real share[HMPC_MODES][HMPC_MODES], after[HMPC_MODES], weight[HMPC_MODES], sum = R(0.0);
  for (int j = 0; j < HMPC_MODES; ++j) {
    real column[HMPC_MODES], total = R(0.0);
    after[j] = R(0.0);
    for (int i = 0; i < HMPC_MODES; ++i) {
      column[i] = s->probability[i] * switches[i][j];
      after[j] += column[i];
    }
    for (int i = 0; i < HMPC_MODES; ++i) {
      column[i] /= after[j] > R(0.0) ? after[j] : R(1.0);
      if (column[i] < R(HMPC_NEGLIGIBLE)) column[i] = R(0.0);
      total += column[i];
    }
    for (int i = 0; i < HMPC_MODES; ++i) share[j][i] = column[i] / total;
  }
  for (int j = 0; j < HMPC_MODES; ++j) {
    if (after[j] > R(0.0)) {
      mix(s->filter, share[j], &s->mixed);
      predict(s, &s->mixed, u_prev, j, &s->predicted[j]);
    } else {
      predict(s, &s->filter[j], u_prev, j, &s->predicted[j]);
    }
  }
  memcpy(s->filter, s->predicted, sizeof s->filter);
  known_w(s, w, 0);
#if HMPC_TURNS
  memcpy(s->y, y, sizeof s->y);
#endif
  if (!any_finite(y)) {
    memcpy(s->probability, after, sizeof after);
    together(s, after);
    return;
  }
  int any_lost = 0;
  for (int j = 0; j < HMPC_MODES; ++j) any_lost |= lost(&s->filter[j], j);
  if (any_lost) {
    hmpc_estimate_start(s, y, (const real *)0);
    return;
  }
#if HMPC_TURNS
  /* one sample for all filters: periodic outputs nearest to the mean prediction */
  real mean[HMPC_NY] = {R(0.0)};
  for (int j = 0; j < HMPC_MODES; ++j) {
    real y_hat[HMPC_NY], slope[HMPC_NY][HMPC_NE];
    measured(s->filter[j].z, u_prev, s->w, y_hat, slope);
    hmpc_add(mean, after[j], y_hat, HMPC_NY);
  }
  for (int i = 0; i < HMPC_NY; ++i) s->y[i] = nearest_turn(y[i], mean[i], y_period[i]);
  y = s->y;
#endif
  real largest = -R(INFINITY);
  for (int j = 0; j < HMPC_MODES; ++j) {
    correct(s, &s->filter[j], y, u_prev, j);
    if (hmpc_finite(s->filter[j].likelihood)) largest = hmpc_max(largest, s->filter[j].likelihood);
  }
  for (int j = 0; j < HMPC_MODES; ++j) {
    const real likelihood = s->filter[j].likelihood;
    weight[j] = hmpc_finite(likelihood) ? after[j] * hmpc_exp(likelihood - largest) : R(0.0);
    sum += weight[j];
  }
  if (!(sum > R(0.0))) { /* implausible for every filter: no information on the modes */
    memcpy(weight, after, sizeof weight);
    sum = R(0.0);
    for (int j = 0; j < HMPC_MODES; ++j) sum += weight[j];
  }
  for (int j = 0; j < HMPC_MODES; ++j) s->probability[j] = weight[j] / sum;
  together(s, s->probability);
}

#endif
