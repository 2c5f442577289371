/* A period of the loop: estimate and decide; then the monitor, the guard's next mode, and the part of the next solve
   that needs no sample. */
#include "hmpc_math.h"
#include "hmpc_tables.h"

#if HMPC_MODES > 0

#if HMPC_GUARD
enum { LONG_AGO = 1000000000 };

/* periods + more, at most LONG_AGO. */
static int later(int periods, int more) { return periods < LONG_AGO - more ? periods + more : LONG_AGO; }

static void guard_begin(hmpc_state *s) {
  hmpc_guard *const g = &s->guard;
  memset(g, 0, sizeof *g);
  g->since_alarm = LONG_AGO;
  g->since_frozen = LONG_AGO;
}

/* Mode of the next period, from the monitor's reading. */
static void guard_watched(hmpc_state *s) {
  hmpc_guard *const g = &s->guard;
  const hmpc_monitor *const m = &s->monitor;
  if (m->alarm) {
    g->row = g->since_alarm >= HMPC_QUIET ? 0 : later(g->row, g->since_alarm);
    g->since_alarm = 0;
  }
  if (m->frozen) g->since_frozen = 0;
  const int on = g->since_alarm == 0 || g->since_alarm < HMPC_QUIET;
  if (g->since_frozen == 0 || g->since_frozen < HMPC_QUIET) {
    g->wanted = (hmpc_mode)HMPC_ON_SENSOR;
    g->why = HMPC_SENSOR;
  } else if (on && g->row >= HMPC_PATIENCE) {
    g->wanted = (hmpc_mode)HMPC_ON_MODEL;
    g->why = m->blind ? HMPC_BLIND : HMPC_MODEL;
  } else {
    g->wanted = HMPC_NORMAL;
    g->why = HMPC_QUIET_AGAIN;
  }
  if (g->wanted < g->mode && g->since < HMPC_DWELL) g->wanted = g->mode;
}

/* New period: the wanted mode begins. */
static void guard_measured(hmpc_guard *g) {
  g->since = later(g->since, 1);
  g->since_alarm = later(g->since_alarm, 1);
  g->since_frozen = later(g->since_frozen, 1);
  if (g->wanted != g->mode) {
    g->mode = g->wanted;
    g->since = 0;
  }
}

/* The goal within the guard's limits. */
static hmpc_goal guarded_goal(const hmpc_guard *g, const hmpc_goal *goal, real *low, real *high) {
  hmpc_goal own = {0};
  if (goal) own = *goal;
#if HMPC_GUARD_LIMITS
  if (g->mode != HMPC_NORMAL) {
    for (int i = 0; i < HMPC_NU; ++i) {
      const int given = goal && goal->u_min && goal->u_max;
      low[i] = given ? hmpc_clip(goal->u_min[i], guard_u_min[i], guard_u_max[i]) : guard_u_min[i];
      high[i] = given ? hmpc_clip(goal->u_max[i], guard_u_min[i], guard_u_max[i]) : guard_u_max[i];
    }
    own.u_min = low;
    own.u_max = high;
  }
#else
  (void)g;
  (void)low;
  (void)high;
#endif
  return own;
}

#if HMPC_BACKUP
static hmpb_goal backup_goal(const hmpc_goal *goal) {
  hmpb_goal own = {0};
  if (goal) {
    own.x = goal->x;
    own.y = goal->y;
    own.p = goal->p;
    own.rows = goal->rows;
    own.weight = goal->weight;
    own.u_min = goal->u_min;
    own.u_max = goal->u_max;
    own.w = goal->w;
    own.w_rows = goal->w_rows;
  }
  return own;
}
#endif

/* Input of the mode's controller; a controller that did not compute the last plan takes it over. */
static void guard_decide(hmpc_state *s, const hmpc_goal *given, const real *held) {
  hmpc_guard *const g = &s->guard;
  real low[HMPC_NU], high[HMPC_NU];
  const hmpc_goal goal = guarded_goal(g, given, low, high);
  if (g->mode == HMPC_RESTING) {
    hmpc_rest(s, &goal, held);
    g->planner = HMPC_NOBODY;
    return;
  }
#if HMPC_BACKUP
  hmpb_state *const b = &s->backup;
  if (g->mode == HMPC_BACKED_UP) {
    const hmpb_goal own = backup_goal(&goal);
    if (g->planner != HMPC_BACKUP_PLANS) hmpb_take_over(b, s->plan.u[0], held);
    g->planner = HMPC_BACKUP_PLANS;
    hmpb_decide(b, &own, held);
    for (int i = 0; i < HMPC_NU; ++i) s->u[i] = b->u[i];
    s->status = (hmpc_status)b->status;
    s->source = (hmpc_source)b->source;
    s->age = b->age;
    return;
  }
  const real *const plan = g->planner == HMPC_BACKUP_PLANS ? b->plan.u[0] : s->plan.u[0];
#else
  const real *const plan = s->plan.u[0];
#endif
  if (g->planner != HMPC_CONTROLLER) hmpc_take_over(s, plan, held);
  g->planner = HMPC_CONTROLLER;
  if (g->mode == HMPC_FALLING_BACK) {
    hmpc_fall_back(s, &goal, held);
  } else {
    hmpc_decide(s, &goal, held);
  }
}
#endif

/* The monitor's reading and the guard's next mode, once for each period. */
static void watched(hmpc_state *s) {
#if HMPC_MONITOR
  if (s->watched) return;
  hmpc_watch(s, s->sample, s->acted);
  s->watched = 1;
#if HMPC_GUARD
  guard_watched(s);
#endif
#else
  (void)s;
#endif
}

static void sampled(hmpc_state *s, const real *y, const real *held) {
#if HMPC_MONITOR
#if HMPC_TURNS
  y = s->y;
#endif
  memcpy(s->sample, y, sizeof s->sample);
  memcpy(s->acted, held, sizeof s->acted);
  s->watched = 0;
#else
  (void)s;
  (void)y;
  (void)held;
#endif
}

void hmpc_start(hmpc_state *s, const real *y, const real *w, const real *applied, const hmpc_goal *goal) {
  real held[HMPC_NU];
  hmpc_clear(s);
  for (int i = 0; i < HMPC_NU; ++i)
    held[i] = hmpc_clip(applied && hmpc_finite(applied[i]) ? applied[i] : u_rest[i], u_min[i], u_max[i]);
  hmpc_estimate_start(s, y, w);
#if HMPC_MONITOR
  hmpc_watch_begin(s);
#endif
#if HMPC_GUARD
  guard_begin(s);
#endif
#if HMPC_BACKUP
  hmpb_clear(&s->backup);
  hmpb_estimate_start(&s->backup, y, w);
#endif
  sampled(s, y, held);
  hmpc_begin(s, held, goal);
}

void hmpc_step(hmpc_state *s, const real *y, const real *w, const real *applied, const hmpc_goal *goal) {
  real held[HMPC_NU];
  watched(s);
  for (int i = 0; i < HMPC_NU; ++i) held[i] = applied && hmpc_finite(applied[i]) ? applied[i] : s->u[i];
  hmpc_estimate_update(s, y, held, w);
  sampled(s, y, held);
#if HMPC_GUARD
  guard_measured(&s->guard);
#if HMPC_BACKUP
  hmpb_estimate_update(&s->backup, y, held, w);
#endif
  guard_decide(s, goal, held);
#else
  hmpc_decide(s, goal, held);
#endif
}

void hmpc_finish(hmpc_state *s, const hmpc_goal *goal) {
  watched(s);
#if HMPC_GUARD
  const hmpc_guard *const g = &s->guard;
  if (g->wanted == HMPC_RESTING || g->wanted == HMPC_FALLING_BACK) return;
#if HMPC_BACKUP
  if (g->wanted == HMPC_BACKED_UP) {
    const hmpb_goal own = backup_goal(goal);
    if (g->planner == HMPC_BACKUP_PLANS && !s->backup.prepared) hmpb_prepare(&s->backup, &own);
    return;
  }
#endif
  if (g->planner != HMPC_CONTROLLER) return;
#endif
  if (!s->prepared) hmpc_prepare(s, goal);
}

#endif
