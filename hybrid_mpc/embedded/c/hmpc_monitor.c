/* The monitor: channels compare the model with the machine, and a detector compares each channel with its limits. The
   channels are either the energy balance (mechanical machines with measured positions) or the residuals of outputs and
   balances (any machine). */
#include "hmpc_math.h"
#include "hmpc_tables.h"
#include "hmpc_expressions.h"

#if HMPC_MONITOR

static int more_seen(int seen, int most) { return seen < most ? seen + 1 : most; }

/* Stores the estimate for the next period. */
static void remember(const hmpc_state *s, real *z, real *w) {
  memset(z, 0, sizeof(real) * HMPC_LZ);
  memcpy(z, s->x, sizeof s->x);
  if (HMPC_NH > 0) memcpy(z + HMPC_NX, s->h, sizeof s->h);
  if (HMPC_NW > 0) memcpy(w, s->w, sizeof s->w);
}

static void forget(real *v, int n) {
  for (int i = 0; i < n; ++i) v[i] = R(NAN);
}

static int is_number(real a) { return a <= R(0.0) || a > R(0.0); }

static int all_equal(const real *a, const real *b, int n) {
  int same = 1;
  for (int i = 0; i < n; ++i) same &= a[i] <= b[i] && a[i] >= b[i];
  return same;
}

#if HMPC_LIMITS > 0
/* Mean of the finite ones of a channel's last values; NaN if fewer than half are finite. */
static real mean_of(const hmpc_monitor *m, int channel, int length) {
  real total = R(0.0);
  int count = 0, k = m->newest;
  for (int i = 0; i < length; ++i) {
    const real value = m->recent[k][channel];
    if (hmpc_finite(value)) {
      total += value;
      ++count;
    }
    k = k > 0 ? k - 1 : HMPC_LONGEST - 1;
  }
  return 2 * count >= length ? total / R(count > 0 ? count : 1) : R(NAN);
}

/* A value in nominal standard deviations. */
static real scaled(const hmpc_monitor *m, int limit, real (*terms)[HMPC_DIM(HMPC_TERMS)]) {
  const int c = limit_channel[limit];
#if HMPC_TERMS > 0
  real variance = R(0.0);
  for (int j = 0; j < HMPC_TERMS; ++j) variance += limit_scale[limit][j] * terms[c][j];
  return m->value[c] / hmpc_sqrt(variance);
#else
  (void)terms;
  return m->value[c];
#endif
}
#endif

/* Levels of all limits, alarms and frozen sensors from the channels' values; terms: terms of their variances. */
static void detect(hmpc_monitor *m, real (*terms)[HMPC_DIM(HMPC_TERMS)], int settled, const int *inside) {
  m->alarm = m->frozen = 0;
  m->share = R(NAN);
#if HMPC_LIMITS > 0
  m->share = R(0.0);
  m->newest = m->newest + 1 < HMPC_LONGEST ? m->newest + 1 : 0;
  forget(m->recent[m->newest], HMPC_CHANNELS);
  if (settled) {
    memcpy(m->recent[m->newest], m->value, sizeof m->value);
    m->counted = more_seen(m->counted, HMPC_LONGEST);
  }
  for (int i = 0; i < HMPC_LIMITS; ++i) {
    const real most = HMPC_SUM_CAP * limit_threshold[i];
    if (limit_length[i] > 1) {
      m->level[i] = m->counted < limit_length[i] ? R(NAN) : mean_of(m, limit_channel[i], limit_length[i]);
    } else {
      const real z = scaled(m, i, terms);
      if (limit_length[i] == 1) {
        m->level[i] = is_number(z) ? z : R(0.0);
      } else {
        if (is_number(z)) {
          m->up[i] = hmpc_clip(m->up[i] + z - limit_drift[i], R(0.0), most);
          m->down[i] = hmpc_clip(m->down[i] - z - limit_drift[i], R(0.0), most);
        }
        m->level[i] = hmpc_max(m->up[i], m->down[i]);
      }
    }
    const real size = is_number(m->level[i]) ? hmpc_abs(m->level[i]) : R(0.0);
    m->on[i] = size > (m->on[i] ? limit_release[i] : limit_threshold[i]);
    m->share = hmpc_max(m->share, size / limit_threshold[i]);
    m->alarm |= m->on[i];
  }
#else
  (void)terms;
  (void)settled;
#endif
  for (int i = 0; i < HMPC_NY; ++i) {
    m->stuck[i] = inside[i] && hmpc_abs(m->travel[i]) > frozen_travel[i] && m->repeats[i] > frozen_repeats[i];
    m->frozen |= m->stuck[i];
  }
}

/* Last step of a period: sets blind if there was no valid reading for too long. */
static void judge(hmpc_monitor *m, hmpc_validity validity) {
  m->validity = validity;
  m->invalid = validity == HMPC_VALID ? 0 : more_seen(m->invalid, HMPC_BLIND_AFTER + 1);
  m->blind = m->invalid > HMPC_BLIND_AFTER;
  m->alarm = m->alarm || m->frozen || m->blind;
}
#endif

#if HMPC_MONITOR == HMPC_ENERGY

enum { NQ = HMPC_NQ, GIVEN = HMPC_NU + HMPC_NW, AT_DV = 0, AT_DP = NQ, AT_GIVEN = 2 * NQ };

void hmpc_watch_begin(hmpc_state *s) {
  hmpc_monitor *const m = &s->monitor;
  memset(m, 0, sizeof *m);
  forget(m->z, HMPC_NZ);
  memcpy(m->w, w_rest, sizeof m->w);
  forget(m->y[0], HMPC_WINDOW * NQ);
  forget(m->row[0], (HMPC_WINDOW - 1) * (AT_GIVEN + GIVEN));
#if HMPC_LIMITS > 0
  forget(m->recent[0], HMPC_LONGEST * HMPC_CHANNELS);
#endif
  for (int k = 0; k < 2; ++k) {
    forget(m->run[k].z, HMPC_NZ);
    forget(m->run[k].q[0], HMPC_WINDOW * NQ);
    forget(m->run[k].sum, 3);
    m->run[k].left = k == 0 ? 1 : HMPC_FREE_RUN / 2 + 1;
  }
}

/* Accelerations of the model in slow motion at the position of z: mean of both directions, deceleration by dry friction
   and damping (slowed), and the acceleration that dry friction can hold at rest (jump). */
static void near_rest(const real *z, const real *u, const real *w, real *mean, real *slowed, real *jump) {
  real at[HMPC_LZ], rate[4][HMPC_NX];
  memcpy(at, z, sizeof at);
  for (int k = 0; k < 4; ++k) { /* both directions, at the rest speed and at twice the rest speed */
    for (int i = 0; i < NQ; ++i)
      at[NQ + i] = (k % 2 ? R(1.0) : R(-1.0)) * (k < 2 ? rest_speed[i] : R(2.0) * rest_speed[i]);
    hmpc_rates(at, u, w, rate[k]);
  }
  for (int i = 0; i < NQ; ++i) {
    mean[i] = R(0.5) * (rate[0][NQ + i] + rate[1][NQ + i]);
    slowed[i] = R(0.5) * (rate[0][NQ + i] - rate[1][NQ + i]);
    jump[i] = R(2.0) * slowed[i] - R(0.5) * (rate[2][NQ + i] - rate[3][NQ + i]);
  }
}

/* Force that the model does not explain; near rest, reduced by the force that dry friction can hold. */
static void residual_force(const real *z, const real *u, const real *w, const real *measured, const real *model,
                           real *force) {
  real error[HMPC_NQ], off[HMPC_NQ], slowest = R(INFINITY);
  for (int i = 0; i < NQ; ++i) {
    error[i] = measured[i] - model[i];
    slowest = hmpc_min(hmpc_abs(z[NQ + i]) / rest_speed[i], slowest);
  }
  watched_force(z, u, w, error, force);
  if (slowest >= R(2.0)) return;
  real mean[HMPC_NQ], slowed[HMPC_NQ], jump[HMPC_NQ], friction[HMPC_NQ], damping[HMPC_NQ], held[HMPC_NQ];
  near_rest(z, u, w, mean, slowed, jump);
  watched_force(z, u, w, jump, friction);
  watched_force(z, u, w, slowed, damping);
  for (int i = 0; i < NQ; ++i) off[i] = measured[i] - mean[i];
  watched_force(z, u, w, off, held);
  for (int i = 0; i < NQ; ++i) {
    const real speed = z[NQ + i];
    friction[i] = hmpc_max(friction[i], R(0.0));
    held[i] += (damping[i] - friction[i]) * speed / rest_speed[i];
    held[i] = hmpc_sign(held[i]) * hmpc_max(hmpc_abs(held[i]) - friction[i], R(0.0));
    const real near = hmpc_max(hmpc_min(R(2.0) - hmpc_abs(speed) / rest_speed[i], R(1.0)), R(0.0));
    force[i] = near * held[i] + (R(1.0) - near) * force[i];
  }
}

/* Speed and travel that the input should have caused since the measured positions last changed. */
static void push(hmpc_monitor *m, int still, const real *u) {
  const real *acting = u;
  int known = still, strong = 0;
  if (HMPC_DELAYED > 0) acting = m->z + HMPC_NX; /* the oldest delayed input acts now */
  for (int i = 0; i < HMPC_NU; ++i) known &= hmpc_abs(m->before[i]) < R(INFINITY);
  if (!known) memcpy(m->before, acting, sizeof m->before);
  for (int i = 0; i < HMPC_NU; ++i)
    strong |= hmpc_abs(acting[i] - m->before[i]) - HMPC_HELD_SHARE * input_span[i] > R(0.0);
  strong &= still;
  real alone[HMPC_NQ] = {R(0.0)}, jump[HMPC_NQ] = {R(0.0)}, earlier[HMPC_NQ] = {R(0.0)};
  if (strong) {
    real slowed[HMPC_NQ];
    near_rest(m->z, m->before, m->w, earlier, slowed, jump);
    near_rest(m->z, acting, m->w, alone, slowed, jump);
  }
  for (int i = 0; i < NQ; ++i) {
    real speed = R(0.0), travel = R(0.0);
    if (strong) {
      const real change = alone[i] - earlier[i];
      const real beyond =
          hmpc_sign(alone[i]) * hmpc_max(hmpc_abs(alone[i]) - hmpc_max(jump[i], R(0.0)), R(0.0));
      const real both = hmpc_sign(beyond) * hmpc_min(hmpc_abs(change), hmpc_abs(beyond));
      speed = m->pushed_speed[i] + HMPC_DT * (both * (beyond * change > R(0.0) ? R(1.0) : R(0.0)));
    }
    if (still) travel = m->pushed[i] + HMPC_DT * hmpc_abs(speed);
    m->pushed_speed[i] = hmpc_abs(speed) < R(INFINITY) ? speed : R(0.0);
    m->pushed[i] = hmpc_abs(travel) < R(INFINITY) ? travel : R(0.0);
  }
}

static void polynomial(const real (*q)[HMPC_NQ], const real *newest, real *position, real *speed, real *acceleration) {
  for (int i = 0; i < NQ; ++i) {
    position[i] = speed[i] = acceleration[i] = R(0.0);
    for (int k = 0; k < HMPC_WINDOW; ++k) {
      const real value = q[k][i] - newest[i];
      position[i] += value * fit_position[k];
      speed[i] += value * fit_speed[k];
      acceleration[i] += value * fit_acceleration[k];
    }
  }
}

/* Energy balance at a position, speed and acceleration. */
static real balance(const real *state, const real *acceleration, const real *given) {
  real rate[HMPC_NX], value;
  for (int i = 0; i < NQ; ++i) {
    rate[i] = state[NQ + i];
    rate[NQ + i] = acceleration[i];
  }
  watched_energy(state, rate, given, given + HMPC_NU, &value);
  return value;
}

#if HMPC_FREE_RUN > 0
/* Ended free runs start again at the estimate of the previous period. */
static void begin_runs(hmpc_monitor *m) {
  for (int k = 0; k < 2; ++k) {
    hmpc_free_run *const run = &m->run[k];
    if (run->left > 1) {
      --run->left;
      continue;
    }
    forget(run->q[0], HMPC_WINDOW * NQ);
    memcpy(run->z, m->z, sizeof run->z);
    memcpy(run->q[HMPC_WINDOW - 1], m->z, sizeof run->q[0]);
    memset(run->sum, 0, sizeof run->sum);
    run->left = hmpc_all_finite(m->z, HMPC_NX) ? HMPC_FREE_RUN : 1; /* otherwise it starts at the next sample */
  }
}

/* Free run over one period; adds the deviation of its energy balance from the measured one. */
static void go_on(hmpc_free_run *run, const real *u, const real *w, const real *given, const real *speed,
                  real measured) {
  real next[HMPC_LZ] = {R(0.0)}, state[HMPC_NX] = {R(0.0)}, acceleration[HMPC_NQ] = {R(0.0)}, v2 = R(0.0), u2 = R(0.0);
  static const real none[HMPC_NQ];
  hmpc_model(run->z, u, w, next);
  memcpy(run->z, next, sizeof next);
  memmove(run->q, run->q + 1, sizeof run->q - sizeof run->q[0]);
  memcpy(run->q[HMPC_WINDOW - 1], next, sizeof run->q[0]);
  if (run->left > HMPC_FREE_RUN - HMPC_WINDOW + 2) return; /* its window is not yet full */
  polynomial((const real(*)[HMPC_NQ])run->q, none, state, state + NQ, acceleration);
  for (int i = 0; i < NQ; ++i) v2 += speed[i] * speed[i];
  for (int i = 0; i < HMPC_NU; ++i) u2 += given[i] * given[i];
  run->sum[0] += HMPC_DT * (balance(state, acceleration, given) - measured);
  run->sum[1] += HMPC_DT * v2;
  run->sum[2] += HMPC_DT * u2;
}
#endif

void hmpc_watch(hmpc_state *s, const real *y, const real *u_prev) {
  hmpc_monitor *const m = &s->monitor;
  real next[HMPC_LZ] = {R(0.0)}, *row = m->row[HMPC_WINDOW - 2];
  const real *const before = m->y[HMPC_WINDOW - 1];
  /* prediction from the estimate of the previous period */
  hmpc_model(m->z, u_prev, m->w, next);
  const int still = all_equal(y, before, HMPC_NQ);
  for (int i = 0; i < NQ; ++i) {
    const real moved = next[i] - m->z[i];
    const real ahead = m->ahead[i] + moved * (hmpc_abs(moved) > rest_speed[i] * HMPC_DT ? R(1.0) : R(0.0));
    m->ahead[i] = all_equal(y + i, before + i, 1) && hmpc_abs(ahead) < R(INFINITY) ? ahead : R(0.0);
  }
  push(m, still, u_prev);
  memmove(m->row, m->row + 1, sizeof m->row - sizeof m->row[0]);
  for (int i = 0; i < NQ; ++i) {
    row[AT_DV + i] = next[NQ + i] - m->z[NQ + i];
    row[AT_DP + i] = next[i] - m->z[i] - HMPC_DT * m->z[NQ + i];
  }
  memcpy(row + AT_GIVEN, u_prev, sizeof(real) * HMPC_NU);
  if (HMPC_NW > 0) memcpy(row + AT_GIVEN + HMPC_NU, m->w, sizeof m->w);
  memmove(m->y, m->y + 1, sizeof m->y - sizeof m->y[0]);
  memcpy(m->y[HMPC_WINDOW - 1], y, sizeof m->y[0]);
  /* values at the centre of the window */
  real at[HMPC_LZ], measured[HMPC_NQ], model[HMPC_NQ] = {R(0.0)}, given[HMPC_DIM(GIVEN)] = {R(0.0)};
  memcpy(at, m->z, sizeof at);
  polynomial((const real(*)[HMPC_NQ])m->y, y, at, at + NQ, measured);
  for (int i = 0; i < NQ; ++i) at[i] += y[i];
  for (int k = 0; k < HMPC_WINDOW - 1; ++k) {
    for (int i = 0; i < NQ; ++i)
      model[i] += m->row[k][AT_DV + i] * kernel_speed[k] - m->row[k][AT_DP + i] * kernel_position[k];
    for (int i = 0; i < GIVEN; ++i) given[i] += m->row[k][AT_GIVEN + i] * kernel_mean[k];
  }
  real terms[HMPC_CHANNELS][HMPC_DIM(HMPC_TERMS)], *const force = m->value + 1;
  int inside[HMPC_NQ];
  const real measured_balance = balance(at, measured, given);
  m->value[0] = hmpc_abs(balance(at, model, given) - measured_balance);
  residual_force(at, given, given + HMPC_NU, measured, model, force);
  forget(terms[0], HMPC_CHANNELS * HMPC_TERMS);
  real v2 = R(0.0), u2 = R(0.0), slow = R(0.0);
  for (int i = 0; i < NQ; ++i) {
    const real v = at[NQ + i];
    v2 += v * v;
    slow += v * v / (rest_speed[i] * rest_speed[i]);
  }
  for (int i = 0; i < HMPC_NU; ++i) u2 += given[i] * given[i];
  for (int i = 0; i < NQ; ++i) {
    real *const own = terms[1 + i];
    own[0] = R(1.0);
    own[1] = v2;
    own[2] = u2;
    own[3] = R(1.0) / (R(1.0) + slow);
    m->travel[i] = m->pushed[i] > hmpc_abs(m->ahead[i]) ? m->pushed[i] : m->ahead[i];
    m->repeats[i] = inside[i] = 1;
  }
#if HMPC_FREE_RUN > 0
  begin_runs(m);
  for (int k = 0; k < 2; ++k) go_on(&m->run[k], u_prev, m->w, given, at + NQ, measured_balance);
  int which = m->run[0].left <= m->run[1].left ? 0 : 1;
  if (!is_number(m->run[which].sum[0])) which = 1 - which; /* NaN: not started */
  const real *const older = m->run[which].sum;
  const real time = R(HMPC_FREE_RUN - HMPC_WINDOW + 3 - m->run[which].left) * HMPC_DT;
  m->value[1 + NQ] = R(NAN);
  if (time >= HMPC_SHORTEST) {
    real *const own = terms[1 + NQ];
    m->value[1 + NQ] = older[0] / time;
    own[0] = R(1.0);
    own[1] = older[1] / time;
    own[2] = older[2] / time;
    own[3] = R(1.0) / time;
  }
#endif
  detect(m, terms, 1, inside);
  /* validity of the reading */
  const int missing =
      !hmpc_all_finite(y, HMPC_NY) || (m->seen > 0 && !hmpc_all_finite(u_prev, HMPC_NU));
  m->seen = more_seen(m->seen, HMPC_WINDOW);
  m->whole = missing ? 0 : more_seen(m->whole, HMPC_WINDOW);
  judge(m, hmpc_all_finite(m->value, 1 + NQ) ? HMPC_VALID
           : m->seen < HMPC_WINDOW           ? HMPC_WARM_UP
           : m->whole < HMPC_WINDOW          ? HMPC_MISSING
                                             : HMPC_NOT_A_READING);
  remember(s, m->z, m->w);
}

#elif HMPC_MONITOR == HMPC_RESIDUALS

enum { FIRST_W = HMPC_NY + HMPC_BALANCES, FIRST_FREE = FIRST_W + HMPC_NW };

void hmpc_watch_begin(hmpc_state *s) {
  hmpc_monitor *const m = &s->monitor;
  memset(m, 0, sizeof *m);
  forget(m->z, HMPC_NZ);
  forget(m->w, HMPC_NW);
  forget(m->y, HMPC_NY);
#if HMPC_LIMITS > 0
  forget(m->recent[0], HMPC_LONGEST * HMPC_CHANNELS);
#endif
  for (int k = 0; k < 2; ++k) {
    forget(m->run[k], HMPC_NZ);
    forget(m->run_d[k], HMPC_ND);
    m->age[k] = -HMPC_SETTLING - k * HMPC_FREE_RUN / 2;
  }
}

/* Free run over one period, and the measured outputs minus its outputs. */
static void go_on(const hmpc_monitor *m, const real *u, const real *y, int k, real *next, real *error) {
  real acting[HMPC_NU];
  const real *const d = m->run_d[k];
  for (int i = 0; i < HMPC_NU; ++i) {
    acting[i] = u[i];
    for (int j = 0; j < HMPC_ND; ++j) acting[i] += disturbs_u[i][j] * d[j];
  }
  memset(next, 0, sizeof(real) * HMPC_LZ);
  hmpc_model(m->run[k], acting, m->w, next);
  for (int i = 0; i < HMPC_NX; ++i)
    for (int j = 0; j < HMPC_ND; ++j) next[i] += disturbs_x[i][j] * d[j];
  outputs(next, acting, m->w, error);
  for (int i = 0; i < HMPC_NY; ++i) {
    error[i] = y[i] - error[i];
    for (int j = 0; j < HMPC_ND; ++j) error[i] -= disturbs_y[i][j] * d[j];
  }
}

/* Error of the older free run. Free runs that ended or diverged start again at the estimate. */
static void run_free(hmpc_state *s, const real *u, const real *y, real *error) {
  hmpc_monitor *const m = &s->monitor;
  real next[HMPC_LZ], own[HMPC_NY];
  const int first = m->age[0] >= m->age[1] ? 0 : 1; /* the older free run */
  forget(error, HMPC_NY);
  for (int k = 0; k < 2; ++k) {
    go_on(m, u, y, k, next, own);
    if (k == first && m->age[k] >= 0) memcpy(error, own, sizeof own);
    memcpy(m->run[k], next, sizeof next);
  }
  for (int k = 0; k < 2; ++k) {
    int now = m->age[k] + 1;
    const int lost = now > 0 && !(hmpc_all_finite(m->run[k], HMPC_NZ) && hmpc_all_finite(m->run_d[k], HMPC_ND));
    if (now == 0 || now >= HMPC_FREE_RUN || lost) {
      memset(m->run[k], 0, sizeof m->run[k]);
      memcpy(m->run[k], s->x, sizeof s->x);
      if (HMPC_NH > 0) memcpy(m->run[k] + HMPC_NX, s->h, sizeof s->h);
      if (HMPC_ND > 0) memcpy(m->run_d[k], s->d, sizeof s->d);
      now = hmpc_all_finite(m->run[k], HMPC_NZ) && hmpc_all_finite(m->run_d[k], HMPC_ND) ? 0 : -1;
    }
    m->age[k] = now;
  }
}

void hmpc_watch(hmpc_state *s, const real *y, const real *u_prev) {
  hmpc_monitor *const m = &s->monitor;
  real next[HMPC_LZ] = {R(0.0)}, predicted[HMPC_NY], last[HMPC_NY], rate[HMPC_NX], moved[HMPC_NY];
  /* prediction from the estimate of the previous period */
  hmpc_model(m->z, u_prev, m->w, next);
  outputs(next, u_prev, m->w, predicted);
  outputs(m->z, u_prev, m->w, last);
  for (int i = 0; i < HMPC_NX; ++i) rate[i] = (s->x[i] - next[i]) / HMPC_DT;
  for (int i = 0; i < HMPC_NY; ++i) {
    m->value[i] = y[i] - predicted[i];
    moved[i] = predicted[i] - last[i];
  }
#if HMPC_BALANCES > 0
  watched_balances(m->z, rate, u_prev, m->w, m->value + HMPC_NY);
#else
  (void)rate;
#endif
  for (int i = 0; i < HMPC_NW; ++i) m->value[FIRST_W + i] = s->w[i] - w_rest[i];
  run_free(s, u_prev, y, m->value + FIRST_FREE);
  for (int i = 0; i < HMPC_CHANNELS; ++i)
    if (!hmpc_finite(m->value[i])) m->value[i] = R(NAN);
  m->seen = more_seen(m->seen, HMPC_SETTLING + 2);
  const int settled = m->seen > HMPC_SETTLING;
  int inside[HMPC_NY];
  for (int i = 0; i < HMPC_NY; ++i) {
    const int still = all_equal(y + i, m->y + i, 1) && hmpc_finite(moved[i]) && settled;
    m->travel[i] = still ? m->travel[i] + moved[i] : R(0.0);
    m->repeats[i] = still ? more_seen(m->repeats[i], HMPC_REPEATS) : 0;
    inside[i] = y[i] > sensor_end[0][i] && y[i] < sensor_end[1][i];
  }
  detect(m, (real(*)[HMPC_DIM(HMPC_TERMS)])0, settled, inside);
  /* validity of the reading */
  const int missing = !(hmpc_all_finite(y, HMPC_NY) && hmpc_all_finite(u_prev, HMPC_NU));
  judge(m, hmpc_all_finite(m->value, FIRST_FREE) ? HMPC_VALID
           : m->seen < 2                         ? HMPC_WARM_UP
           : missing                             ? HMPC_MISSING
                                                 : HMPC_NOT_A_READING);
  remember(s, m->z, m->w);
  memcpy(m->y, y, sizeof m->y);
}

#endif
