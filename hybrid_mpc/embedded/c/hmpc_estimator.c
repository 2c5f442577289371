/* Kalman filters over state, hidden state and unmeasured disturbances, side by side, and how probable each is.

   Source: Simon, Optimal State Estimation, 2006, section 13.2; Blom and Bar-Shalom, IEEE T-AC 33 (1988). */
#include "hmpc_math.h"
#include "hmpc_tables.h"
#include "hmpc_expressions.h"

#if HMPC_MODES > 0

enum { START_LIMIT = 25 }; /* most periods at rest that the first estimate runs the hidden state through */

static void known_w(hmpc_state *s, const real *w) {
#if HMPC_NW > 0
  for (int i = 0; i < HMPC_NW && w; ++i)
    if (hmpc_finite(w[i])) s->w[i] = w[i];
#else
  (void)s;
  (void)w;
#endif
}

static int any_finite(const real *y) {
  int any = 0;
  for (int i = 0; i < HMPC_NY; ++i) any |= hmpc_finite(y[i]);
  return any;
}

static void measured(const real *z, const real *u, const real *w, real *y) {
  real v[HMPC_NU];
  for (int i = 0; i < HMPC_NU; ++i) {
    v[i] = u[i];
    for (int j = 0; j < HMPC_ND; ++j) v[i] += disturbs_u[i][j] * z[HMPC_NZ + j];
  }
  outputs(z, v, w, y);
  for (int i = 0; i < HMPC_NY; ++i)
    for (int j = 0; j < HMPC_ND; ++j) y[i] += disturbs_y[i][j] * z[HMPC_NZ + j];
}

/* One Gaussian with mean and covariance of a mixture. */
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
  if (HMPC_ND > 0) memcpy(s->d, z + HMPC_NZ, sizeof s->d);
}

/* Product of what two outputs show of the states, these in the squares of the sizes that distances count in. */
static real shown(int i, int j) {
  real sum = R(0.0);
  for (int k = 0; k < HMPC_NX; ++k) sum += output_x[i][k] * start_weight[k] * output_x[j][k];
  return sum;
}

/* Estimate at rest: the state nearest to the operating point's with these outputs. */
void hmpc_estimate_start(hmpc_state *s, const real *y, const real *w) {
  real z[HMPC_LE] = {R(0.0)}, z_next[HMPC_LZ] = {R(0.0)};
  known_w(s, w);
  memcpy(z, x_rest, sizeof s->x);
  for (int pass = 0; pass < 2; ++pass) { /* the second for what rounding left */
    real error[HMPC_NY], l[HMPC_NY][HMPC_NY];
    measured(z, u_rest, s->w, error);
    for (int i = 0; i < HMPC_NY; ++i) error[i] = hmpc_finite(y[i]) ? y[i] - error[i] : R(0.0);
    for (int i = 0; i < HMPC_NY; ++i) {
      real sum = error[i];
      for (int j = 0; j <= i; ++j) {
        const int both = hmpc_finite(y[i]) && hmpc_finite(y[j]);
        real rest = both ? shown(i, j) : i == j ? R(1.0) : R(0.0);
        for (int k = 0; k < j; ++k) rest -= l[i][k] * l[j][k];
        /* an output of states that are known exactly moves none */
        l[i][j] = i != j ? rest / l[j][j] : rest > R(0.0) ? hmpc_sqrt(rest) : R(INFINITY);
        if (j < i) sum -= l[i][j] * error[j];
      }
      error[i] = sum / l[i][i];
    }
    for (int i = HMPC_NY - 1; i >= 0; --i) {
      for (int j = i + 1; j < HMPC_NY; ++j) error[i] -= l[j][i] * error[j];
      error[i] /= l[i][i];
      for (int k = 0; k < HMPC_NX && hmpc_finite(y[i]); ++k) z[k] += error[i] * output_x[i][k] * start_weight[k];
    }
  }
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
  for (int m = 0; m < HMPC_MODES; ++m) {
    hmpc_filter *const f = &s->filter[m];
    memset(f, 0, sizeof *f);
    memcpy(f->z, z, sizeof f->z);
    for (int i = 0; i < HMPC_NE; ++i) f->p[i][i] = first_variance[m][i];
    s->probability[m] = first_probability[m];
  }
  together(s, s->probability);
}

/* One period on with the input held. */
static void predict(hmpc_state *s, const hmpc_filter *from, const real *u, int mode, hmpc_filter *to) {
  real v[HMPC_NU], next[HMPC_LZ] = {R(0.0)};
  const real *const d = from->z + HMPC_NZ;
  for (int i = 0; i < HMPC_NU; ++i) {
    v[i] = u[i];
    for (int j = 0; j < HMPC_ND; ++j) v[i] += disturbs_u[i][j] * d[j];
  }
  hmpc_model_slope(from->z, v, s->w, next, s->stage[0]);
  for (int i = 0; i < HMPC_NZ; ++i) {
    memcpy(s->transition[i], s->stage[i], sizeof(real) * HMPC_NZ);
    for (int j = 0; j < HMPC_ND; ++j) {
      real slope = i < HMPC_NX ? disturbs_x[i < HMPC_NX ? i : 0][j] : R(0.0);
      for (int k = 0; k < HMPC_NU; ++k) slope += s->stage[i][HMPC_LZ + k] * disturbs_u[k][j];
      s->transition[i][HMPC_NZ + j] = slope;
      if (i < HMPC_NX) next[i] += disturbs_x[i < HMPC_NX ? i : 0][j] * d[j];
    }
  }
  for (int i = HMPC_NZ; i < HMPC_NE; ++i) s->transition[i][i] = R(1.0);
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
    to->z[i] = i < HMPC_NZ ? next[i < HMPC_NZ ? i : 0] : from->z[i];
  }
}

/* After the sample, in Joseph form; what is not finite is left out. */
static void correct(hmpc_state *s, hmpc_filter *f, const real *y, const real *u) {
  real y_hat[HMPC_NY], step[HMPC_NE] = {R(0.0)}, size = R(0.0);
  measured(f->z, u, s->w, y_hat);
  f->nis = R(0.0);
  for (int i = 0; i < HMPC_NY; ++i) {
    real c[HMPC_NE] = {R(0.0)}, pc[HMPC_NE], kalman[HMPC_NE];
    if (!hmpc_finite(y[i])) continue;
    memcpy(c, output_x[i], sizeof s->x);
    for (int j = 0; j < HMPC_ND; ++j) c[HMPC_NZ + j] = output_d[i][j];
    for (int k = 0; k < HMPC_NE; ++k) pc[k] = hmpc_dot(f->p[k], c, HMPC_NE);
    const real variance = hmpc_dot(c, pc, HMPC_NE) + noise_y[i];
    const real error = (y[i] - y_hat[i]) - hmpc_dot(c, step, HMPC_NE);
    for (int k = 0; k < HMPC_NE; ++k) kalman[k] = pc[k] / variance;
    for (int k = 0; k < HMPC_NE; ++k) hmpc_add(f->p[k], -kalman[k], pc, HMPC_NE);
    for (int k = 0; k < HMPC_NE; ++k) {
      const real left = hmpc_dot(f->p[k], c, HMPC_NE) - noise_y[i] * kalman[k];
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
  known_w(s, w);
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
  real largest = -R(INFINITY);
  for (int j = 0; j < HMPC_MODES; ++j) {
    correct(s, &s->filter[j], y, u_prev);
    if (hmpc_finite(s->filter[j].likelihood)) largest = hmpc_max(largest, s->filter[j].likelihood);
  }
  for (int j = 0; j < HMPC_MODES; ++j) {
    const real likelihood = s->filter[j].likelihood;
    weight[j] = hmpc_finite(likelihood) ? after[j] * hmpc_exp(likelihood - largest) : R(0.0);
    sum += weight[j];
  }
  if (!(sum > R(0.0))) { /* absurd to every filter: it says nothing of the modes */
    memcpy(weight, after, sizeof weight);
    sum = R(0.0);
    for (int j = 0; j < HMPC_MODES; ++j) sum += weight[j];
  }
  for (int j = 0; j < HMPC_MODES; ++j) s->probability[j] = weight[j] / sum;
  together(s, s->probability);
}

#endif
