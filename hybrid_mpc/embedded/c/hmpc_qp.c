/* Dense dual active-set solver for the condensed QP. The multipliers of the working set move towards the values that
   keep its bounds exactly. A bound whose multiplier reaches zero leaves; the bound with the largest violation joins. A
   soft bound has the exact penalty l s + r s s / 2 of its slack s: it acts as a hard bound up to the multiplier l, and
   is relaxed beyond it. A hard bound has a very large penalty. If one is relaxed, the QP is solved again with hard
   bounds that are never relaxed; that solution is used if it exists.

   Bounds, all as a's <= b, by number: upper and lower limits of the unknowns; upper and lower limits of their changes;
   upper and lower soft bounds.

   Source: Goldfarb and Idnani, Math. Programming 27 (1983); Arnstroem, Bemporad, Axehill, IEEE TAC 67 (2022). */
#include "hmpc_math.h"
#include "hmpc_tables.h"

enum {
  UPPER = 0,
  LOWER = HMPC_NV,
  CHANGE_UPPER = 2 * HMPC_NV,
  CHANGE_LOWER = 3 * HMPC_NV,
  SOFT_UPPER = 4 * HMPC_NV,
  SOFT_LOWER = SOFT_UPPER + HMPC_SOFT,
  SOFT_STATES = HMPC_N * HMPC_SOFT_X
};

/* A soft row: its kind (index of its scale and limits) and its derivative. */
static const real *soft_row(const hmpc_qp *qp, const hmpc_linear *linear, int row, int *kind) {
#if HMPC_SOFT_X > 0
  if (row < SOFT_STATES) {
    *kind = row % HMPC_SOFT_X;
    return linear->from_u[row / HMPC_SOFT_X + 1][soft_state[*kind]];
  }
#endif
#if HMPC_SOFT_E > 0
  (void)linear;
  *kind = HMPC_SOFT_X + (row - SOFT_STATES) % HMPC_SOFT_E;
  return qp->slope[row - SOFT_STATES];
#else
  *kind = 0;
  (void)qp;
  (void)row;
  return linear->from_u[0][0];
#endif
}

#if HMPC_SOFT > 0
static int soft_kind(int row) {
#if HMPC_SOFT_E > 0
  if (row >= SOFT_STATES) return HMPC_SOFT_X + (row - SOFT_STATES) % HMPC_SOFT_E;
#endif
  return row % HMPC_DIM(HMPC_SOFT_X);
}

/* Whether a row's bounds apply in its period: hard bounds apply from the first period that an input can affect. */
static int holds(int row) {
#if HMPC_SOFT_E > 0
  if (row >= SOFT_STATES) return (row - SOFT_STATES) / HMPC_SOFT_E >= soft_first[soft_kind(row)];
#endif
  return row / HMPC_DIM(HMPC_SOFT_X) >= soft_first[soft_kind(row)];
}
#endif

static int soft_of(int id) { return id < SOFT_UPPER ? -1 : (id - SOFT_UPPER) % HMPC_DIM(HMPC_SOFT); }

/* Multiplier from which a bound is relaxed, and its slack for each unit of the multiplier beyond. */
static real penalty(const hmpc_qp *qp, int id, real *yields) {
#if HMPC_SOFT > 0
  if (id >= SOFT_UPPER) {
    const int kind = soft_kind(soft_of(id));
    if (qp->strict && soft_hard[kind]) {
      *yields = R(0.0);
      return HMPC_HUGE;
    }
    *yields = qp->size / soft_quadratic[kind];
    return soft_linear[kind] / qp->size;
  }
#else
  (void)qp;
  (void)id;
#endif
  *yields = R(0.0);
  return HMPC_HUGE;
}

static real limit(const hmpc_qp *qp, int id) {
  if (id < LOWER) return qp->upper[id];
  if (id < CHANGE_UPPER) return -qp->lower[id - LOWER];
  if (id < CHANGE_LOWER) return qp->change_upper[id - CHANGE_UPPER];
  if (id < SOFT_UPPER) return -qp->change_lower[id - CHANGE_LOWER];
#if HMPC_SOFT > 0
  const int row = soft_of(id), kind = soft_kind(row);
  if (!holds(row)) return R(INFINITY);
  return id < SOFT_LOWER ? (soft_upper[kind] - qp->value[row]) / soft_scale[kind]
                         : (qp->value[row] - soft_lower[kind]) / soft_scale[kind];
#else
  return R(0.0);
#endif
}

/* to += factor a */
static void add_bound(const hmpc_qp *qp, const hmpc_linear *linear, int id, real factor, real *to) {
  if (id < CHANGE_UPPER) {
    to[id < LOWER ? id : id - LOWER] += id < LOWER ? factor : -factor;
  } else if (id < SOFT_UPPER) {
    const int i = id < CHANGE_LOWER ? id - CHANGE_UPPER : id - CHANGE_LOWER;
    const real signed_factor = id < CHANGE_LOWER ? factor : -factor;
    to[i] += signed_factor;
    if (i >= HMPC_NU) to[i - HMPC_NU] -= signed_factor;
  } else {
    int kind;
    const real *const slope = soft_row(qp, linear, soft_of(id), &kind);
    hmpc_add(to, (id < SOFT_LOWER ? factor : -factor) / soft_scale[kind], slope, HMPC_NV);
  }
}

static real bounded(const hmpc_qp *qp, const hmpc_linear *linear, int id, const real *s) {
  if (id < LOWER) return s[id];
  if (id < CHANGE_UPPER) return -s[id - LOWER];
  if (id < SOFT_UPPER) {
    const int i = id < CHANGE_LOWER ? id - CHANGE_UPPER : id - CHANGE_LOWER;
    const real change = i >= HMPC_NU ? s[i] - s[i - HMPC_NU] : s[i];
    return id < CHANGE_LOWER ? change : -change;
  }
  int kind;
  const real *const slope = soft_row(qp, linear, soft_of(id), &kind);
  const real value = hmpc_dot(slope, s, HMPC_NV) / soft_scale[kind];
  return id < SOFT_LOWER ? value : -value;
}

/* L^-1 a, where L L' is the Hessian. */
static void transformed(const hmpc_qp *qp, const hmpc_linear *linear, int id, real *row) {
  real a[HMPC_LD] = {R(0.0)};
  add_bound(qp, linear, id, R(1.0), a);
  memset(row, 0, sizeof(real) * HMPC_LD);
  for (int i = 0; i < HMPC_NV; ++i)
    if (a[i] < R(0.0) || a[i] > R(0.0)) hmpc_add(row + i, a[i], qp->inverse[i] + i, HMPC_NV - i);
}

/* Cholesky factor of the Hessian and its inverse. */
void hmpc_qp_factor(hmpc_qp *qp) {
  real(*const l)[HMPC_LD] = qp->lower_factor;
  qp->definite = 0;
  for (int i = 0; i < HMPC_NV; ++i)
    for (int j = 0; j <= i; ++j) {
      const real rest = qp->hessian[i][j] - hmpc_dot(l[i], l[j], j);
      if (j < i) {
        l[i][j] = rest / l[j][j];
      } else {
        if (!(rest > R(0.0) && rest <= HMPC_HUGE)) return;
        l[i][i] = hmpc_sqrt(rest);
      }
    }
  for (int i = 0; i < HMPC_NV; ++i) {
    real *const row = qp->inverse[i];
    memset(row, 0, sizeof(real) * HMPC_LD);
    row[i] = R(1.0) / l[i][i];
    for (int j = i + 1; j < HMPC_NV; ++j) row[j] = -hmpc_dot(l[j] + i, row + i, j - i) / l[j][j];
  }
  qp->definite = 1;
}

static real *factor_row(hmpc_working *w, int i) { return w->factor + i * (i + 1) / 2; }

/* factor x = b, in place */
static void forward(hmpc_working *w, int n, real *b) {
  for (int i = 0; i < n; ++i) b[i] = (b[i] - hmpc_dot(factor_row(w, i), b, i)) / factor_row(w, i)[i];
}

/* factor' x = b, in place */
static void backward(hmpc_working *w, int n, real *b) {
  for (int i = n - 1; i >= 0; --i) {
    b[i] /= factor_row(w, i)[i];
    hmpc_add(b, -b[i], factor_row(w, i), i);
  }
}

/* Adds bound w->count, whose number, row and multiplier are set, to the working set. 0 if it depends on the others:
   then the row of the factor is L^-1 of its products with them. */
static int join(const hmpc_qp *qp, hmpc_working *w) {
  const int n = w->count;
  real *const row = factor_row(w, n), yields;
  (void)penalty(qp, w->id[n], &yields);
  const real own = hmpc_dot(w->row[n], w->row[n], HMPC_NV);
  for (int i = 0; i < n; ++i) row[i] = hmpc_dot(w->row[i], w->row[n], HMPC_NV);
  forward(w, n, row);
  const real rest = own + (w->beyond[n] ? yields : R(0.0)) - hmpc_dot(row, row, n);
  if (!(rest > HMPC_DEPENDENT * own)) return 0;
  row[n] = hmpc_sqrt(rest);
  w->count = n + 1;
  return 1;
}

/* Removes bound i from the working set; later bounds move up, also one that waits to join. */
static void leave(hmpc_working *w, int i, int waiting) {
  const int n = w->count;
  real column[HMPC_MOST];
  for (int k = i + 1; k < n; ++k) column[k] = factor_row(w, k)[i];
  for (int k = i + 1; k < n; ++k) {
    real *const from = factor_row(w, k), *const to = factor_row(w, k - 1);
    memmove(to, from, sizeof(real) * (size_t)i);
    memmove(to + i, from + i + 1, sizeof(real) * (size_t)(k - i));
  }
  /* Rank-one update of the remaining factor by the removed column. */
  for (int k = i + 1; k < n; ++k) {
    real *const pivot = factor_row(w, k - 1) + (k - 1);
    const real old = *pivot, x = column[k], now = hmpc_sqrt(old * old + x * x);
    const real c = now / old, s = x / old;
    *pivot = now;
    for (int j = k + 1; j < n; ++j) {
      real *const entry = factor_row(w, j - 1) + (k - 1);
      *entry = (*entry + s * column[j]) / c;
      column[j] = c * column[j] - s * *entry;
    }
  }
  const int last = n + waiting;
  for (int k = i + 1; k < last; ++k) {
    w->id[k - 1] = w->id[k];
    w->beyond[k - 1] = w->beyond[k];
    w->multiplier[k - 1] = w->multiplier[k];
    memcpy(w->row[k - 1], w->row[k], sizeof(real) * HMPC_LD);
  }
  w->count = n - 1;
}

/* Switches a soft bound of the working set between kept and relaxed. */
static void turn(const hmpc_qp *qp, hmpc_working *w, int i, int waiting) {
  const int id = w->id[i], beyond = !w->beyond[i], n = w->count;
  real row[HMPC_LD], multiplier = w->multiplier[i], kept_row[HMPC_LD] = {R(0.0)}, kept = R(0.0);
  int kept_id = 0, kept_beyond = 0;
  memcpy(row, w->row[i], sizeof row);
  if (waiting) {
    kept_id = w->id[n];
    kept_beyond = w->beyond[n];
    kept = w->multiplier[n];
    memcpy(kept_row, w->row[n], sizeof kept_row);
  }
  leave(w, i, 0);
  w->id[n - 1] = id;
  w->beyond[n - 1] = beyond;
  w->multiplier[n - 1] = multiplier;
  memcpy(w->row[n - 1], row, sizeof row);
  if (join(qp, w) == 0 && waiting == 0) return; /* it depends on the others and is left out: they take its multiplier */
  if (waiting) {
    const int at = w->count;
    w->id[at] = kept_id;
    w->beyond[at] = kept_beyond;
    w->multiplier[at] = kept;
    memcpy(w->row[at], kept_row, sizeof kept_row);
  }
}

/* Largest share of the step, up to 1, that keeps the multipliers within their ranges; who: the bound that limits it, or
   -1. */
static real way(const hmpc_qp *qp, const hmpc_working *w, const real *move, int *who) {
  real most = R(1.0);
  *who = -1;
  for (int i = 0; i < w->count; ++i) {
    real yields, low = R(0.0), high;
    const real from = penalty(qp, w->id[i], &yields);
    high = from;
    if (w->beyond[i]) {
      low = from;
      high = HMPC_HUGE;
    }
    const real after = w->multiplier[i] + move[i];
    real share = most;
    if (after < low && move[i] < R(0.0)) share = (low - w->multiplier[i]) / move[i];
    if (after > high && move[i] > R(0.0)) share = (high - w->multiplier[i]) / move[i];
    if (share < most) {
      most = hmpc_max(share, R(0.0));
      *who = i;
    }
  }
  return most;
}

/* A multiplier has reached the end of its range: at zero its bound leaves, at its penalty a soft bound is relaxed. */
static void stop(const hmpc_qp *qp, hmpc_working *w, int i, int up, int waiting) {
  real yields;
  const real from = penalty(qp, w->id[i], &yields);
  if (!up && !(w->beyond[i] && from > R(0.0))) {
    leave(w, i, waiting);
    return;
  }
  w->multiplier[i] = from;
  turn(qp, w, i, waiting);
}

/* y = -(L^-1 g + sum of multiplier row) and s = L^-T y */
static void primal(const hmpc_qp *qp, const hmpc_working *w, const real *start, real *y, real *s) {
  for (int i = 0; i < HMPC_LD; ++i) y[i] = -start[i];
  for (int k = 0; k < w->count; ++k) hmpc_add(y, -w->multiplier[k], w->row[k], HMPC_NV);
  for (int i = 0; i < HMPC_NV; ++i) s[i] = hmpc_dot(qp->inverse[i] + i, y + i, HMPC_NV - i);
}

#if HMPC_SOFT > 0
/* Violation up to which a soft row counts as kept: a distance of the unknowns, but at least rounding errors. */
static real kept(const real *slope, int kind, real end, real within) {
  const real norm = hmpc_sqrt(hmpc_dot(slope, slope, HMPC_NV)) / soft_scale[kind];
  return within * hmpc_clip(norm, HMPC_LEAST_SHARE, R(1.0)) + HMPC_ROUNDING * hmpc_abs(end);
}
#endif

/* The bound with the largest violation, or -1. */
static int worst(const hmpc_qp *qp, const hmpc_linear *linear, const hmpc_working *w, const real *s, real *by) {
  unsigned char inside[SOFT_LOWER + HMPC_DIM(HMPC_SOFT)] = {0};
  int found = -1;
  real largest = R(1e3);
  for (int k = 0; k < w->count; ++k) {
    inside[w->id[k]] = 1;
    largest = hmpc_max(largest, w->multiplier[k]);
  }
  /* rounding errors increase with the multipliers */
  const real within = hmpc_min(HMPC_VIOLATED * R(1e-3) * largest, R(0.1) * HMPC_KEPT);
  *by = within;
  for (int i = 0; i < HMPC_NV; ++i) {
    const real before = i >= HMPC_NU ? s[i - HMPC_NU] : R(0.0);
    const real over[4] = {s[i] - qp->upper[i], qp->lower[i] - s[i], (s[i] - before) - qp->change_upper[i],
                          qp->change_lower[i] - (s[i] - before)};
    const int first = HMPC_CHANGES ? 4 : 2;
    for (int k = 0; k < first; ++k)
      if (over[k] > *by && !inside[k * HMPC_NV + i]) {
        *by = over[k];
        found = k * HMPC_NV + i;
      }
  }
#if HMPC_SOFT > 0
  if (found < 0) *by = R(0.0);
  for (int row = 0; row < HMPC_SOFT; ++row) {
    int kind;
    const real *const slope = soft_row(qp, linear, row, &kind);
    const real moved = hmpc_dot(slope, s, HMPC_NV) / soft_scale[kind];
    for (int side = 0; side < 2; ++side) {
      const int id = (side ? SOFT_LOWER : SOFT_UPPER) + row;
      const real end = limit(qp, id), over = (side ? -moved : moved) - end;
      if (over > *by && !inside[id] && over > kept(slope, kind, end, within)) {
        *by = over;
        found = id;
      }
    }
  }
#else
  (void)linear;
#endif
  return found;
}

/* KKT residual relative to the gradient, and the largest violation of a bound. */
static hmpc_status checked(const hmpc_qp *qp, const hmpc_linear *linear, hmpc_working *w, const real *s) {
  real rest[HMPC_LD] = {R(0.0)}, by, largest = R(0.0), size = R(1.0), violation = R(0.0);
  for (int i = 0; i < HMPC_NV; ++i) rest[i] = hmpc_dot(qp->hessian[i], s, HMPC_NV) + qp->gradient[i];
  for (int k = 0; k < w->count; ++k) {
    real yields;
    const real from = penalty(qp, w->id[k], &yields);
    const real slack = w->beyond[k] ? (w->multiplier[k] - from) * yields : R(0.0);
    const real room = limit(qp, w->id[k]) + slack - bounded(qp, linear, w->id[k], s);
    add_bound(qp, linear, w->id[k], w->multiplier[k], rest);
    if (!(w->multiplier[k] >= R(0.0))) largest = hmpc_max(largest, -w->multiplier[k]);
    largest = hmpc_max(largest, hmpc_min(hmpc_abs(w->multiplier[k]), hmpc_abs(room)));
    if (!(from < HMPC_HUGE)) violation = hmpc_max(violation, -room); /* a relaxed soft bound is no violation */
  }
  if (worst(qp, linear, w, s, &by) >= 0) violation = hmpc_max(violation, by);
  real sum = R(0.0); /* NaN if any value is NaN */
  for (int i = 0; i < HMPC_NV; ++i) {
    largest = hmpc_max(largest, hmpc_abs(rest[i]));
    size = hmpc_max(size, hmpc_abs(qp->gradient[i]));
    sum += rest[i] + s[i];
  }
  w->kkt = largest / size;
  if (!hmpc_finite(sum) || !hmpc_finite(w->kkt) || !hmpc_finite(violation)) return HMPC_NOT_FINITE;
  if (violation > HMPC_BOUND_TOLERANCE) return HMPC_INFEASIBLE;
  return w->kkt <= HMPC_KKT_TOLERANCE ? HMPC_SOLVED : HMPC_INACCURATE;
}

/* Multipliers that keep the working set's bounds exactly, minus the present ones. */
static void towards(const hmpc_qp *qp, hmpc_working *w, const real *y, real *move) {
  for (int k = 0; k < w->count; ++k) {
    real yields;
    const real from = penalty(qp, w->id[k], &yields);
    const real slack = w->beyond[k] ? (w->multiplier[k] - from) * yields : R(0.0);
    move[k] = hmpc_dot(w->row[k], y, HMPC_NV) - limit(qp, w->id[k]) - slack;
  }
  forward(w, w->count, move);
  backward(w, w->count, move);
}

/* Refines the solution, because the sum of large multipliers keeps the working set's bounds inexactly. */
static void polish(const hmpc_qp *qp, hmpc_working *w, real *y, real *s) {
  real move[HMPC_MOST];
  for (int round = 0; round < 2; ++round) {
    towards(qp, w, y, move);
    for (int k = 0; k < w->count; ++k) {
      w->multiplier[k] += move[k];
      hmpc_add(y, -move[k], w->row[k], HMPC_NV);
    }
  }
  for (int i = 0; i < HMPC_NV; ++i) s[i] = hmpc_dot(qp->inverse[i] + i, y + i, HMPC_NV - i);
}

/* Warm start from the previous working set and multipliers: bounds that are finite and independent; any multipliers of
   zero or more are a valid start. */
static void warm(const hmpc_qp *qp, const hmpc_linear *linear, hmpc_working *w) {
  const int n = w->count;
  w->count = 0;
  for (int k = 0; k < n; ++k) {
    const int at = w->count, id = w->id[k];
    real yields;
    const real from = penalty(qp, id, &yields);
    const real given = hmpc_max(w->multiplier[k], R(0.0));
    if (!hmpc_finite(limit(qp, id))) continue;
    w->id[at] = id;
    w->beyond[at] = given >= from;
    w->multiplier[at] = given;
    transformed(qp, linear, id, w->row[at]);
    (void)join(qp, w);
  }
}

static hmpc_status solved(hmpc_qp *qp, hmpc_working *w, const hmpc_linear *linear) {
  real start[HMPC_LD] = {R(0.0)}, y[HMPC_LD], move[HMPC_MOST];
  w->iterations = 0;
  w->kkt = R(NAN);
  if (!qp->definite) return HMPC_NOT_FINITE;
  for (int i = 0; i < HMPC_NV; ++i) hmpc_add(start + i, qp->gradient[i], qp->inverse[i] + i, HMPC_NV - i);
  warm(qp, linear, w);
  int refined = 0;
  while (w->iterations < HMPC_QP_CAP) {
    int who;
    ++w->iterations;
    primal(qp, w, start, y, qp->step);
    towards(qp, w, y, move);
    const real share = way(qp, w, move, &who);
    for (int k = 0; k < w->count; ++k) w->multiplier[k] += share * move[k];
    if (who >= 0) {
      stop(qp, w, who, move[who] > R(0.0), 0);
      refined = 0;
      continue;
    }
    primal(qp, w, start, y, qp->step);
    real by;
    const int id = worst(qp, linear, w, qp->step, &by);
    if (id < 0 && refined) {
      polish(qp, w, y, qp->step);
      return checked(qp, linear, w, qp->step);
    }
    refined = id < 0; /* one more iteration against rounding errors */
    if (refined) continue;
    if (w->count == HMPC_MOST) break;
    int at = w->count;
    w->id[at] = id;
    w->multiplier[at] = R(0.0);
    real yields;
    w->beyond[at] = !(penalty(qp, id, &yields) > R(0.0));
    transformed(qp, linear, id, w->row[at]);
    while (!join(qp, w)) { /* it depends on the others: all multipliers change, the point stays */
      at = w->count;
      real row[HMPC_MOST];
      memcpy(row, factor_row(w, at), sizeof(real) * (size_t)at);
      backward(w, at, row);
      real most = HMPC_HUGE;
      int first = -1, up = 0;
      const real from_own = penalty(qp, w->id[at], &yields);
      const real own = w->beyond[at] ? HMPC_HUGE : from_own - w->multiplier[at];
      if (++w->iterations >= HMPC_QP_CAP) {
        w->count = 0;
        return HMPC_INACCURATE;
      }
      for (int k = 0; k < at; ++k) {
        real other;
        const real from = penalty(qp, w->id[k], &other), low = w->beyond[k] ? from : R(0.0);
        real far = HMPC_HUGE;
        if (row[k] > R(0.0)) far = (w->multiplier[k] - low) / row[k];
        if (row[k] < R(0.0) && !w->beyond[k] && from < HMPC_HUGE) far = (from - w->multiplier[k]) / -row[k];
        if (far < most) {
          most = far;
          first = k;
          up = row[k] < R(0.0);
        }
      }
      if (id >= SOFT_UPPER && own < most) { /* it is relaxed first */
        for (int k = 0; k < at; ++k) w->multiplier[k] -= own * row[k];
        w->multiplier[at] += own;
        w->beyond[at] = 1;
      } else {
        if (first < 0) {
          w->count = 0;
          return HMPC_INFEASIBLE;
        }
        for (int k = 0; k < at; ++k) w->multiplier[k] -= most * row[k];
        w->multiplier[at] += most;
        stop(qp, w, first, up, 1);
      }
    }
  }
  w->count = 0;
  return HMPC_INACCURATE;
}

hmpc_status hmpc_qp_solve(hmpc_qp *qp, hmpc_working *w, const hmpc_linear *linear) {
  qp->strict = 0;
  const hmpc_status status = solved(qp, w, linear);
#if HMPC_HARD > 0
  real step[HMPC_LD], multiplier[HMPC_MOST];
  int id[HMPC_MOST], give_way = status != HMPC_SOLVED;
  const int count = w->count;
  const real kkt = w->kkt;
  for (int k = 0; k < count; ++k) {
    id[k] = w->id[k];
    multiplier[k] = w->multiplier[k];
    give_way |= w->beyond[k] && id[k] >= SOFT_UPPER && soft_hard[soft_kind(soft_of(id[k]))];
  }
  if (!give_way) return status;
  memcpy(step, qp->step, sizeof step);
  qp->strict = 1;
  if (solved(qp, w, linear) == HMPC_SOLVED) return HMPC_SOLVED;
  memcpy(qp->step, step, sizeof step);
  for (int k = 0; k < count; ++k) { /* warm start of the next solve */
    w->id[k] = id[k];
    w->multiplier[k] = multiplier[k];
  }
  w->count = count;
  w->kkt = kkt;
#endif
  return status;
}

#if HMPC_BENT
void hmpc_qp_multipliers(const hmpc_qp *qp, const hmpc_working *w, real *to) {
  memset(to, 0, sizeof(real) * HMPC_N * HMPC_SOFT_E);
  for (int k = 0; k < w->count; ++k) {
    const int row = soft_of(w->id[k]);
    if (row < SOFT_STATES) continue;
    to[row - SOFT_STATES] = (w->id[k] < SOFT_LOWER ? qp->size : -qp->size) * w->multiplier[k] / soft_scale[soft_kind(row)];
  }
}
#endif

/* Shifts the working set by one period. */
void hmpc_qp_shift(hmpc_working *w) {
  int n = 0;
  for (int k = 0; k < w->count; ++k) {
    int id = w->id[k];
    const int soft = soft_of(id);
    int by = HMPC_BLOCKS == HMPC_N ? HMPC_NU : 0, place = soft < 0 ? id % HMPC_NV : soft;
    if (soft >= SOFT_STATES) {
      by = HMPC_SOFT_E;
      place = soft - SOFT_STATES;
    } else if (soft >= 0) {
      by = HMPC_SOFT_X;
    }
    if (place < by) continue;
    id -= by;
    w->id[n] = id;
    w->multiplier[n] = w->multiplier[k];
    ++n;
  }
  w->count = n;
}
