/* Real-time iteration. Preparation: shift, linearize and condense. Feedback: embed the estimate, solve the QP and check
   the solution. Safeguards: an input in every period. */
#include "hmpc_math.h"
#include "hmpc_tables.h"
#include "hmpc_expressions.h"

enum { COST_SWEEPS = 30 }; /* of Jacobi rotations */

/* Acting inputs: the inputs plus their unmeasured disturbances. */
static void acting(const real *u, const real *d, real *v) {
  for (int i = 0; i < HMPC_NU; ++i) {
    v[i] = u[i];
    for (int j = 0; j < HMPC_ND; ++j) v[i] += disturbs_u[i][j] * d[j];
  }
}

static void disturb_state(const real *d, real *z_next) {
  for (int i = 0; i < HMPC_NX; ++i)
    for (int j = 0; j < HMPC_ND; ++j) z_next[i] += disturbs_x[i][j] * d[j];
}

void hmpc_clear(hmpc_state *s) {
  memset(s, 0, sizeof *s);
  s->steady.age = HMPC_TARGET_WAIT;
  for (int i = 0; i < HMPC_NU; ++i) s->u[i] = hmpc_clip(u_rest[i], u_min[i], u_max[i]);
  memcpy(s->x, x_rest, sizeof s->x);
  memcpy(s->w, w_rest, sizeof s->w);
  s->source = HMPC_HELD;
}

void hmpc_run_free(hmpc_state *s, const real *u, int rows) {
  hmpc_plan *const plan = &s->plan;
  real v[HMPC_NU];
  memset(plan->z[0], 0, sizeof plan->z[0]);
  memcpy(plan->z[0], s->x, sizeof s->x);
  if (HMPC_NH > 0) memcpy(plan->z[0] + HMPC_NX, s->h, sizeof s->h);
  memcpy(plan->d, s->d, sizeof plan->d);
  int fine = 1;
  for (int k = 0; k < HMPC_N; ++k) {
    const int row = k < rows ? k : rows - 1;
    for (int i = 0; i < HMPC_NU; ++i) plan->u[k][i] = hmpc_clip(u[row * HMPC_NU + i], u_min[i], u_max[i]);
    memcpy(plan->w[k], s->w, sizeof plan->w[k]);
    acting(plan->u[k], plan->d, v);
    memset(plan->z[k + 1], 0, sizeof plan->z[k + 1]);
    hmpc_model(plan->z[k], v, plan->w[k], plan->z[k + 1]);
    disturb_state(plan->d, plan->z[k + 1]);
    fine &= hmpc_all_finite(plan->z[k + 1], HMPC_NZ);
    for (int i = 0; i < HMPC_NX; ++i) fine &= plan->z[k + 1][i] >= x_usable[0][i] && plan->z[k + 1][i] <= x_usable[1][i];
  }
  for (int k = 0; k < HMPC_N && !fine; ++k) memcpy(plan->z[k + 1], plan->z[0], sizeof plan->z[0]);
  plan->cost = R(NAN);
  plan->excess = R(NAN);
  memset(plan->given_way, 0, sizeof plan->given_way);
  memset(plan->multiplier, 0, sizeof plan->multiplier);
  s->steady.steady = 0;
  s->steady.age = HMPC_TARGET_WAIT;
  s->prepared = 0;
  s->pending = 0;
}

void hmpc_load_plan(hmpc_state *s, const real *u, const real *z, const real *d, const real *w) {
  memcpy(s->plan.u, u, sizeof s->plan.u);
  for (int k = 0; k <= HMPC_N; ++k) memcpy(s->plan.z[k], z + k * HMPC_NZ, sizeof(real) * HMPC_NZ);
  if (HMPC_ND > 0) memcpy(s->plan.d, d, sizeof s->plan.d);
  if (HMPC_NW > 0) memcpy(s->plan.w, w, sizeof s->plan.w);
  memset(s->plan.multiplier, 0, sizeof s->plan.multiplier);
  s->prepared = 0;
  s->pending = 0;
}

/* ---- preparation */

static void condense(hmpc_state *s) {
  hmpc_linear *const linear = &s->linear;
  int active = 0;
  memset(s->scratch, 0, sizeof s->scratch);
  memset(linear->from_u[0], 0, sizeof linear->from_u[0]);
  for (int k = 0; k < HMPC_N; ++k) {
    real(*const before)[HMPC_LD] = s->scratch[k & 1], (*const after)[HMPC_LD] = s->scratch[~k & 1];
    const int first = block_of[k] * HMPC_NU;
    hmpc_multiply(linear->slope[k][0], HMPC_LJ, before[0], after[0], HMPC_NZ, HMPC_NZ, active, HMPC_LD);
    active = first + HMPC_NU;
    for (int i = 0; i < HMPC_NZ; ++i)
      for (int j = 0; j < HMPC_NU; ++j) after[i][first + j] += linear->slope[k][i][HMPC_LZ + j] * u_scale[j];
    memcpy(linear->from_u[k + 1], after[0], sizeof linear->from_u[k + 1]);
  }
}

/* lower triangle of hessian += factor a b'; the sum over all calls is symmetric */
static void add_product(real (*hessian)[HMPC_LD], real factor, const real *a, const real *b, int n) {
  for (int i = 0; i < n; ++i) hmpc_add(hessian[i], factor * a[i], b, i + 1);
}

#if HMPC_OUTPUT_ROWS
/* Derivative of an output of period k by the unknowns. Returns the number of unknowns it depends on. */
static int output_row(const hmpc_linear *linear, int k, int i, real *row) {
  const int first = block_of[k] * HMPC_NU;
  memset(row, 0, sizeof(real) * HMPC_LD);
  for (int j = 0; j < HMPC_NX; ++j) hmpc_add(row, output_x[i][j], linear->from_u[k][j], HMPC_NV);
  for (int j = 0; j < HMPC_NU; ++j) row[first + j] += output_u[i][j] * u_scale[j];
  return first + HMPC_NU;
}

/* Outputs of period k before the step, minus their reference. */
static void output_error(const hmpc_state *s, int k, real *error) {
  real x[HMPC_NX], v[HMPC_NU];
  for (int i = 0; i < HMPC_NX; ++i) x[i] = s->linear.z[k][i] + s->dz[k][i];
  acting(s->linear.u[k], s->d, v);
  outputs(x, v, s->linear.w[k], error);
  for (int i = 0; i < HMPC_NY; ++i) {
    for (int j = 0; j < HMPC_ND; ++j) error[i] += disturbs_y[i][j] * s->d[j];
    error[i] -= s->target.y[k][i];
  }
}
#endif

#if HMPC_STAGE_COST || HMPC_SOFT_E > 0
/* Parameters of costs and bounds in period k. */
static const real *goal_p(const hmpc_goal *goal, int k) {
  static const real none[HMPC_DIM(HMPC_NP)];
  return HMPC_NP > 0 && goal && goal->p ? goal->p + (k < goal->rows ? k : goal->rows - 1) * HMPC_NP : none;
}
#endif

#if HMPC_STAGE_COST
/* References of the outputs in period k if outputs are weighted. */
static const real *cost_y(const hmpc_state *s, int k) {
#if HMPC_OUTPUT_COST
  return s->target.y[k];
#else
  (void)s;
  (void)k;
  return (const real *)0;
#endif
}

/* Eigenvalues (diagonal of a on return) and eigenvectors (rows of v) of a symmetric matrix by Jacobi rotations.
   Source: Golub and Van Loan, Matrix Computations, 2013, section 8.5. */
static void eigen(real (*a)[HMPC_NC], real (*v)[HMPC_NC]) {
  for (int i = 0; i < HMPC_NC; ++i)
    for (int j = 0; j < HMPC_NC; ++j) v[i][j] = i == j ? R(1.0) : R(0.0);
  for (int sweep = 0; sweep < COST_SWEEPS; ++sweep) {
    int turned = 0;
    for (int i = 0; i < HMPC_NC; ++i)
      for (int j = i + 1; j < HMPC_NC; ++j) {
        const real off = a[i][j];
        /* negligible relative to both diagonal entries */
        if (!(hmpc_abs(off) > HMPC_TARGET_ROUNDING * R(0.1) * (hmpc_abs(a[i][i]) + hmpc_abs(a[j][j])))) continue;
        const real ratio = (a[j][j] - a[i][i]) / (R(2.0) * off);
        const real size = R(1.0) / (hmpc_abs(ratio) + hmpc_sqrt(R(1.0) + ratio * ratio));
        const real tangent = ratio < R(0.0) ? -size : size;
        const real c = R(1.0) / hmpc_sqrt(R(1.0) + tangent * tangent), d = c * tangent;
        for (int k = 0; k < HMPC_NC; ++k) {
          const real one = a[i][k], other = a[j][k];
          a[i][k] = c * one - d * other;
          a[j][k] = d * one + c * other;
        }
        for (int k = 0; k < HMPC_NC; ++k) {
          const real one = a[k][i], other = a[k][j], first = v[i][k], second = v[j][k];
          a[k][i] = c * one - d * other;
          a[k][j] = d * one + c * other;
          v[i][k] = c * first - d * second;
          v[j][k] = d * first + c * second;
        }
        turned = 1;
      }
    if (!turned) return;
  }
}

/* A symmetric matrix, of which the lower triangle is given: negative eigenvalues, scaled by the sizes of states and
   inputs, are set to zero. */
static void make_convex(real (*curve)[HMPC_NC]) {
  real a[HMPC_NC][HMPC_NC], v[HMPC_NC][HMPC_NC];
  for (int i = 0; i < HMPC_NC; ++i)
    for (int j = 0; j < HMPC_NC; ++j) a[i][j] = curve[i > j ? i : j][i > j ? j : i] * cost_size[i] * cost_size[j];
  if (!hmpc_all_finite(a[0], HMPC_NC * HMPC_NC)) return; /* the QP's numbers are not finite either */
  eigen(a, v);
  memset(curve, 0, sizeof a);
  for (int e = 0; e < HMPC_NC; ++e)
    for (int i = 0; i < HMPC_NC && a[e][e] > R(0.0); ++i)
      for (int j = 0; j < HMPC_NC; ++j) curve[i][j] += a[e][e] * v[e][i] * v[e][j] / (cost_size[i] * cost_size[j]);
}
#endif

#if HMPC_STAGE_COST || HMPC_BENT
/* Derivatives of state and input of period k by the unknowns. Returns the number of unknowns they depend on. */
static int stage_rows(const hmpc_linear *linear, int k, real (*rows)[HMPC_LD]) {
  const int first = block_of[k] * HMPC_NU;
  memcpy(rows, linear->from_u[k], sizeof linear->from_u[k]);
  memset(rows[HMPC_NX], 0, sizeof(real) * HMPC_NU * HMPC_LD);
  for (int j = 0; j < HMPC_NU; ++j) rows[HMPC_NX + j][first + j] = u_scale[j];
  return first + HMPC_NU;
}

/* Second derivatives by state and input of period k, as those by the unknowns. */
static void add_stage(const hmpc_linear *linear, int k, const real (*curve)[HMPC_NC], real (*hessian)[HMPC_LD]) {
  real rows[HMPC_NC][HMPC_LD];
  const int m = stage_rows(linear, k, rows);
  for (int i = 0; i < HMPC_NC; ++i) {
    real all[HMPC_LD] = {R(0.0)};
    for (int j = 0; j < HMPC_NC; ++j) hmpc_add(all, curve[i][j], rows[j], m);
    add_product(hessian, R(1.0), rows[i], all, m);
  }
}
#endif

#if HMPC_STAGE_COST
/* Derivatives of the general stage cost along the plan, with convex second derivatives. */
static void make_costs(hmpc_state *s, const hmpc_goal *goal) {
  hmpc_linear *const linear = &s->linear;
  for (int k = 0; k < HMPC_N; ++k) {
    stage_cost_slopes(linear->z[k], linear->u[k], linear->w[k], s->d, goal_p(goal, k), cost_y(s, k),
                      linear->cost_slope[k], linear->cost_curve[k][0]);
    make_convex(linear->cost_curve[k]);
  }
}

static void add_stage_gradient(const hmpc_state *s, int k, real *gradient) {
  const hmpc_linear *const linear = &s->linear;
  real rows[HMPC_NC][HMPC_LD];
  const int m = stage_rows(linear, k, rows);
  for (int i = 0; i < HMPC_NC; ++i)
    hmpc_add(gradient, linear->cost_slope[k][i] + hmpc_dot(linear->cost_curve[k][i], s->dz[k], HMPC_NX), rows[i], m);
}
#endif

static void make_hessian(hmpc_state *s) {
  hmpc_linear *const linear = &s->linear;
  hmpc_qp *const qp = &s->qp;
  real size = R(0.0);
  memset(qp->hessian, 0, sizeof qp->hessian);
  for (int k = 1; k < HMPC_N; ++k)
    for (int i = 0; i < HMPC_NX; ++i) {
      const real factor = R(2.0) * linear->weight[k][i] * q_x[i];
      if (factor < R(0.0) || factor > R(0.0))
        add_product(qp->hessian, factor, linear->from_u[k][i], linear->from_u[k][i], (block_of[k - 1] + 1) * HMPC_NU);
    }
#if HMPC_STAGE_COST
  for (int k = 0; k < HMPC_N; ++k) add_stage(linear, k, (const real(*)[HMPC_NC])linear->cost_curve[k], qp->hessian);
#endif
#if HMPC_BENT
  for (int k = 0; k < HMPC_N; ++k)
    if (linear->bends[k]) add_stage(linear, k, (const real(*)[HMPC_NC])linear->bend[k], qp->hessian);
#endif
#if HMPC_OUTPUT_ROWS
  for (int k = 0; k < HMPC_N; ++k)
    for (int i = 0; i < HMPC_NY; ++i) {
      real row[HMPC_LD];
      const int m = output_row(linear, k, i, row);
      if (q_y[i] > R(0.0)) add_product(qp->hessian, R(2.0) * q_y[i], row, row, m);
    }
#endif
  for (int i = 0; i < HMPC_NX; ++i) {
    real row[HMPC_LD] = {R(0.0)};
    for (int j = 0; j < HMPC_NX; ++j) hmpc_add(row, linear->terminal[i][j], linear->from_u[HMPC_N][j], HMPC_NV);
    add_product(qp->hessian, R(2.0), row, linear->from_u[HMPC_N][i], HMPC_NV);
  }
  for (int b = 0; b < HMPC_BLOCKS; ++b)
    for (int j = 0; j < HMPC_NU; ++j) {
      const int i = b * HMPC_NU + j;
      const real scale = u_scale[j] * u_scale[j], changes = b + 1 < HMPC_BLOCKS ? R(2.0) : R(1.0);
      qp->hessian[i][i] += R(2.0) * (r_u[j] * R(block_length[b]) + r_delta[j] * changes) * scale;
      if (b > 0) qp->hessian[i][i - HMPC_NU] -= R(2.0) * r_delta[j] * scale;
    }
  for (int i = 0; i < HMPC_NV; ++i) size = hmpc_max(size, qp->hessian[i][i]);
  qp->size = size;
  for (int i = 0; i < HMPC_NV; ++i)
    for (int j = 0; j <= i; ++j) {
      qp->hessian[i][j] /= size;
      qp->hessian[j][i] = qp->hessian[i][j];
    }
  hmpc_qp_factor(qp);
}

#if HMPC_SOFT > 0
#if HMPC_SOFT_E > 0
/* Bounded expressions of period k at (x, u), with their derivatives. */
static void make_expressions(hmpc_state *s, const real *d, const hmpc_goal *goal, int k, const real *x, const real *u) {
  hmpc_linear *const linear = &s->linear;
  real value[HMPC_SOFT_E], by_u[HMPC_SOFT_E][HMPC_NU];
  memset(by_u, 0, sizeof by_u);
  soft_expressions(x, u, linear->w[k], d, goal_p(goal, k), value, linear->by_x[k * HMPC_SOFT_E], by_u[0]);
  for (int e = 0; e < HMPC_SOFT_E; ++e) {
    const int row = k * HMPC_SOFT_E + e;
    real *const slope = s->qp.slope[row];
    linear->soft[HMPC_N * HMPC_SOFT_X + row] = value[e];
    memset(slope, 0, sizeof(real) * HMPC_LD);
    for (int i = 0; i < HMPC_NX; ++i) hmpc_add(slope, linear->by_x[row][i], linear->from_u[k][i], HMPC_NV);
    for (int j = 0; j < HMPC_NU; ++j) slope[block_of[k] * HMPC_NU + j] += by_u[e][j] * u_scale[j];
  }
}
#endif

/* Soft and hard bounds along the plan. Bounds of outputs depend on the disturbances d, bounds with parameters on the
   goal. */
static void make_soft(hmpc_state *s, const real *d, const hmpc_goal *goal) {
  hmpc_linear *const linear = &s->linear;
  for (int k = 0; k < HMPC_N; ++k) {
#if HMPC_SOFT_X > 0
    for (int i = 0; i < HMPC_SOFT_X; ++i) linear->soft[k * HMPC_SOFT_X + i] = linear->z[k + 1][soft_state[i]];
#endif
#if HMPC_SOFT_E > 0
    make_expressions(s, d, goal, k, linear->z[k], linear->u[k]);
#endif
  }
  (void)d;
  (void)goal;
}
#endif

static void set_weights(hmpc_linear *linear, const hmpc_goal *goal) {
  const real *const given = goal ? goal->weight : (const real *)0;
  for (int k = 0; k <= HMPC_N; ++k)
    for (int i = 0; i < HMPC_NX; ++i) {
      const real factor = given ? given[k * HMPC_NX + i] : R(1.0);
      linear->weight[k][i] = factor >= R(0.0) && hmpc_finite(factor) ? factor : R(NAN);
    }
  for (int i = 0; i < HMPC_NX; ++i)
    for (int j = 0; j < HMPC_NX; ++j)
      linear->terminal[i][j] =
          terminal[i][j] * hmpc_sqrt(linear->weight[HMPC_N][i]) * hmpc_sqrt(linear->weight[HMPC_N][j]);
}

/* Jacobians along linear->u, z, d, w; append: the last state is the model's prediction from the one before. */
static void linearize(hmpc_state *s, int append) {
  hmpc_linear *const linear = &s->linear;
  real v[HMPC_NU], z_next[HMPC_LZ] = {R(0.0)};
  linear->largest_defect = R(0.0);
  for (int k = 0; k < HMPC_N; ++k) {
    acting(linear->u[k], linear->d, v);
    hmpc_model_slope(linear->z[k], v, linear->w[k], z_next, linear->slope[k][0]);
    disturb_state(linear->d, z_next);
    if (append && k == HMPC_N - 1) memcpy(linear->z[HMPC_N], z_next, sizeof z_next);
    for (int i = 0; i < HMPC_NZ; ++i) {
      linear->defect[k][i] = z_next[i] - linear->z[k + 1][i];
      const real size = hmpc_abs(linear->defect[k][i]);
      if (!(size <= linear->largest_defect)) linear->largest_defect = size;
    }
  }
  condense(s);
#if HMPC_BENT
  memset(linear->bends, 0, sizeof linear->bends);
#endif
#if HMPC_STAGE_COST && !HMPC_COST_MOVES
  make_costs(s, (const hmpc_goal *)0);
#endif
#if !HMPC_COST_MOVES
  make_hessian(s);
#endif
#if HMPC_SOFT > 0 && HMPC_NP == 0
  make_soft(s, linear->d, (const hmpc_goal *)0);
#endif
  s->prepared = 1;
}

void hmpc_linearize(hmpc_state *s, const hmpc_goal *goal) {
  set_weights(&s->linear, goal);
#if HMPC_BENT
  memset(s->linear.multiplier, 0, sizeof s->linear.multiplier);
#endif
  linearize(s, 0);
}

void hmpc_prepare(hmpc_state *s, const hmpc_goal *goal) {
  hmpc_linear *const linear = &s->linear;
  hmpc_plan *const plan = &s->plan;
  hmpc_complete(s);
  for (int k = 0; k < HMPC_N; ++k) {
    const int held = block_start[block_of[k]], next = held + 1 < HMPC_N ? held + 1 : HMPC_N - 1;
    memcpy(linear->u[k], plan->u[next], sizeof linear->u[k]);
    memcpy(linear->z[k], plan->z[k + 1], sizeof linear->z[k]);
    memcpy(linear->w[k], plan->w[k + 1 < HMPC_N ? k + 1 : HMPC_N - 1], sizeof linear->w[k]);
#if HMPC_BENT
    memcpy(linear->multiplier[k], plan->multiplier[k + 1 < HMPC_N ? k + 1 : HMPC_N - 1], sizeof linear->multiplier[k]);
#endif
  }
  memcpy(linear->d, plan->d, sizeof linear->d);
  memcpy(linear->u_prev, plan->u[0], sizeof linear->u_prev);
  set_weights(linear, goal);
  linearize(s, 1);
  hmpc_qp_shift(&s->working);
}

/* ---- feedback */

/* dz of all periods from dz[0], the change of the disturbances, and the step of the inputs (NULL: none). */
static void propagate(hmpc_state *s, const real *step) {
  const hmpc_linear *const linear = &s->linear;
  real change[HMPC_DIM(HMPC_ND)], v[HMPC_NU];
  for (int j = 0; j < HMPC_ND; ++j) change[j] = s->plan.d[j] - linear->d[j];
  for (int k = 0; k < HMPC_N; ++k) {
    for (int i = 0; i < HMPC_NU; ++i) v[i] = step ? step[block_of[k] * HMPC_NU + i] * u_scale[i] : R(0.0);
    acting(v, change, v);
    for (int i = 0; i < HMPC_NZ; ++i) {
      real next = hmpc_dot(linear->slope[k][i], s->dz[k], HMPC_LZ) + linear->defect[k][i];
      for (int j = 0; j < HMPC_NU; ++j) next += linear->slope[k][i][HMPC_LZ + j] * v[j];
      s->dz[k + 1][i] = next;
    }
    disturb_state(change, s->dz[k + 1]);
  }
}

void hmpc_complete(hmpc_state *s) {
  if (!s->pending) return;
  s->pending = 0;
  propagate(s, s->qp.step);
  for (int k = 0; k <= HMPC_N; ++k)
    for (int i = 0; i < HMPC_NZ; ++i) s->plan.z[k][i] = s->linear.z[k][i] + s->dz[k][i];
}

static const real *row_of(const real *rows, int count, int k, int width) {
  return rows + (k < count ? k : count - 1) * width;
}

/* Limits of the inputs as limits of the step. If the limit of the change prevents an input from reaching tighter limits
   at once, the limits approach them as fast as that limit allows. */
static void limits_of(const hmpc_goal *goal, const real *u_prev, int k, real *low, real *high) {
  for (int i = 0; i < HMPC_NU; ++i) {
    low[i] = u_min[i];
    high[i] = u_max[i];
    if (goal && goal->u_min && goal->u_max) {
      low[i] = hmpc_clip(goal->u_min[i], u_min[i], u_max[i]);
      high[i] = hmpc_clip(goal->u_max[i], u_min[i], u_max[i]);
      if (HMPC_CHANGES) {
        const real most = R(k + 1) * du_max[i];
        low[i] = hmpc_clip(hmpc_min(low[i], u_prev[i] + most), u_min[i], u_max[i]);
        high[i] = hmpc_clip(hmpc_max(high[i], u_prev[i] - most), u_min[i], u_max[i]);
      }
    }
  }
}

static void set_bounds(hmpc_state *s, const hmpc_goal *goal) {
  const hmpc_linear *const linear = &s->linear;
  hmpc_qp *const qp = &s->qp;
  for (int b = 0; b < HMPC_BLOCKS; ++b) {
    const real *const u = linear->u[block_start[b]];
    const real *const before = b > 0 ? linear->u[block_start[b - 1]] : linear->u_prev;
    real low[HMPC_NU], high[HMPC_NU];
    limits_of(goal, linear->u_prev, b, low, high);
    for (int j = 0; j < HMPC_NU; ++j) {
      const int i = b * HMPC_NU + j;
      qp->lower[i] = (low[j] - u[j]) / u_scale[j];
      qp->upper[i] = (high[j] - u[j]) / u_scale[j];
      qp->change_lower[i] = (-du_max[j] - (u[j] - before[j])) / u_scale[j];
      qp->change_upper[i] = (du_max[j] - (u[j] - before[j])) / u_scale[j];
      if (b == 0) { /* the first change is the step of the first input */
        qp->lower[i] = hmpc_max(qp->lower[i], qp->change_lower[i]);
        qp->upper[i] = hmpc_min(qp->upper[i], qp->change_upper[i]);
        qp->change_lower[i] = -R(INFINITY);
        qp->change_upper[i] = R(INFINITY);
      }
    }
  }
}

static void set_soft(hmpc_state *s) {
#if HMPC_SOFT > 0
  const hmpc_linear *const linear = &s->linear;
#if HMPC_SOFT_X > 0
  for (int row = 0; row < HMPC_N * HMPC_SOFT_X; ++row)
    s->qp.value[row] = linear->soft[row] + s->dz[row / HMPC_SOFT_X + 1][soft_state[row % HMPC_SOFT_X]];
#endif
#if HMPC_SOFT_E > 0
  for (int row = 0; row < HMPC_N * HMPC_SOFT_E; ++row) {
    real value = linear->soft[HMPC_N * HMPC_SOFT_X + row];
    for (int i = 0; i < HMPC_NX; ++i) value += linear->by_x[row][i] * s->dz[row / HMPC_SOFT_E][i];
    s->qp.value[HMPC_N * HMPC_SOFT_X + row] = value;
  }
#endif
#else
  (void)s;
#endif
}

#if HMPC_BENT
/* State of period k of the plan with a step of the unknowns. */
static void state_at(const hmpc_state *s, const real *step, int k, real *x) {
  for (int i = 0; i < HMPC_NX; ++i)
    x[i] = s->linear.z[k][i] + s->dz[k][i] + hmpc_dot(s->linear.from_u[k][i], step, HMPC_NV);
}

/* Adds the curvature of the bounds, weighted with their multipliers, to Hessian and gradient of the QP (sequential
   convex quadratic programming). step: the curvature at s->plan, which has this step; NULL: at the linearization.
   Source: Verschueren, van Duijkeren, Quirynen, Diehl, CDC 2016. */
static void bend_qp(hmpc_state *s, const hmpc_goal *goal, const real *step) {
  hmpc_linear *const linear = &s->linear;
  hmpc_qp *const qp = &s->qp;
  int changed = step != 0;
  for (int k = 0; k < HMPC_N; ++k) {
    real x[HMPC_NX];
    changed |= linear->bends[k];
    linear->bends[k] = 0;
    for (int e = 0; e < HMPC_SOFT_E; ++e) {
      if (!soft_convex[HMPC_SOFT_X + e]) linear->multiplier[k][e] = R(0.0);
      linear->bends[k] |= linear->multiplier[k][e] < R(0.0) || linear->multiplier[k][e] > R(0.0);
    }
    if (!linear->bends[k]) continue;
    changed = 1;
    if (step) state_at(s, step, k, x);
    bounds_curvature(step ? x : linear->z[k], step ? s->plan.u[k] : linear->u[k], linear->w[k], s->d, goal_p(goal, k),
                     linear->multiplier[k], linear->bend[k][0]);
    linear->bends[k] = hmpc_all_finite(linear->bend[k][0], HMPC_NC * HMPC_NC);
  }
  if (changed) make_hessian(s);
  memcpy(qp->gradient, linear->gradient, sizeof qp->gradient);
  for (int k = 0; k < HMPC_N; ++k) {
    real rows[HMPC_NC][HMPC_LD], ahead[HMPC_NC] = {R(0.0)}; /* from the point of the curvature to the plan without step */
    if (!linear->bends[k]) continue;
    const int m = stage_rows(linear, k, rows);
    for (int i = 0; i < HMPC_NC && step; ++i) ahead[i] = -hmpc_dot(rows[i], step, m);
    for (int i = 0; i < HMPC_NX && !step; ++i) ahead[i] = s->dz[k][i];
    for (int i = 0; i < HMPC_NC; ++i) hmpc_add(qp->gradient, hmpc_dot(linear->bend[k][i], ahead, HMPC_NC), rows[i], m);
  }
  for (int i = 0; i < HMPC_NV; ++i) qp->gradient[i] /= qp->size;
}

/* Linearizes the bounded expressions anew at s->plan, which has this step. */
static void straighten(hmpc_state *s, const hmpc_goal *goal, const real *step) {
  for (int k = 0; k < HMPC_N; ++k) {
    real x[HMPC_NX];
    state_at(s, step, k, x);
    make_expressions(s, s->d, goal, k, x, s->plan.u[k]);
    for (int e = 0; e < HMPC_SOFT_E; ++e) {
      const int row = k * HMPC_SOFT_E + e, place = HMPC_N * HMPC_SOFT_X + row;
      s->qp.value[place] = s->linear.soft[place] - hmpc_dot(s->qp.slope[row], step, HMPC_NV);
    }
  }
}
#endif

/* Reference of an input: that of the set-point's steady state, else the operating point's. */
static real input_goal(const real *u_goal, int period, int input) {
  return u_goal ? u_goal[period * HMPC_NU + input] : u_rest[input];
}

#if HMPC_SOFT > 0
static real violation(int kind, real value) {
  const real beyond = hmpc_max(value - soft_upper[kind], soft_lower[kind] - value);
  return hmpc_max(R(0.0), beyond - (soft_hard[kind] ? HMPC_KEPT * soft_scale[kind] : R(0.0)));
}
#endif

/* Cost of the prepared plan with the step qp.step and the inputs s->plan.u, and its largest violations of soft and of
   hard bounds. bent: largest violation of a bound beyond that of its linearization, over its size and beyond the
   tolerance. Returns 0 if its states diverge: x_reach holds ten widths beyond their declared ranges. */
static int assess(hmpc_state *s, const hmpc_goal *goals, const real *x_goal, int rows, const real *u_goal, real *bent) {
  const hmpc_linear *const linear = &s->linear;
  const real *const step = s->qp.step;
  real total = R(0.0), error[HMPC_NX], before[HMPC_NU];
  int near = 1;
  memcpy(before, linear->u_prev, sizeof before);
  for (int k = 0; k <= HMPC_N; ++k) {
    const int m = k > 0 ? (block_of[k - 1] + 1) * HMPC_NU : 0;
    const real *const goal = row_of(x_goal, rows, k, HMPC_NX);
    for (int i = 0; i < HMPC_NX; ++i)
      error[i] = linear->z[k][i] + s->dz[k][i] + hmpc_dot(linear->from_u[k][i], step, m) - goal[i];
    for (int i = 0; i < HMPC_NX && k > 0; ++i)
      near = near && error[i] + goal[i] >= x_reach[0][i] && error[i] + goal[i] <= x_reach[1][i];
    if (k == HMPC_N) break;
#if HMPC_STAGE_COST
    real x[HMPC_NX], acts[HMPC_NU], cost;
    for (int i = 0; i < HMPC_NX; ++i) x[i] = error[i] + goal[i];
    for (int j = 0; j < HMPC_NU; ++j) acts[j] = linear->u[k][j] + step[block_of[k] * HMPC_NU + j] * u_scale[j];
    stage_cost(x, acts, linear->w[k], s->d, goal_p(goals, k), cost_y(s, k), &cost);
    total += cost;
#endif
    for (int i = 0; i < HMPC_NX; ++i) total += linear->weight[k][i] * q_x[i] * error[i] * error[i];
    for (int j = 0; j < HMPC_NU; ++j) {
      const real u = linear->u[k][j] + step[block_of[k] * HMPC_NU + j] * u_scale[j];
      const real off = u - input_goal(u_goal, k, j), change = u - before[j];
      total += r_u[j] * off * off + r_delta[j] * change * change;
      before[j] = u;
    }
  }
  for (int i = 0; i < HMPC_NX; ++i)
    for (int j = 0; j < HMPC_NX; ++j) total += error[i] * linear->terminal[i][j] * error[j];
  (void)goals;
#if HMPC_OUTPUT_ROWS
  for (int k = 0; k < HMPC_N; ++k) {
    real row[HMPC_LD], off[HMPC_NY];
    output_error(s, k, off);
    for (int i = 0; i < HMPC_NY; ++i) {
      const int m = output_row(linear, k, i, row);
      const real all = off[i] + hmpc_dot(row, step, m);
      if (q_y[i] > R(0.0)) total += q_y[i] * all * all;
    }
  }
#endif
  real excess = R(0.0);
  *bent = R(0.0);
#if HMPC_BENT
  for (int k = 0; k < HMPC_N; ++k) {
    real x[HMPC_NX];
    state_at(s, step, k, x);
    bounds_values(x, s->plan.u[k], linear->w[k], s->d, goal_p(goals, k), s->linear.actual[k]);
  }
#endif
  memset(s->plan.given_way, 0, sizeof s->plan.given_way);
#if HMPC_SOFT > 0
  for (int row = 0; row < HMPC_SOFT; ++row) {
#if HMPC_SOFT_X > 0 && HMPC_SOFT_E > 0
    const int states = row < HMPC_N * HMPC_SOFT_X;
#else
    const int states = HMPC_SOFT_X > 0;
#endif
    int kind, period;
    const real *slope;
    if (states) {
      kind = row % HMPC_DIM(HMPC_SOFT_X);
      period = row / HMPC_DIM(HMPC_SOFT_X);
      slope = linear->from_u[row / HMPC_DIM(HMPC_SOFT_X) + 1][soft_state[kind]];
    } else {
      const int e = row - HMPC_N * HMPC_SOFT_X;
      kind = HMPC_SOFT_X + e % HMPC_DIM(HMPC_SOFT_E);
      period = e / HMPC_DIM(HMPC_SOFT_E);
      slope = s->qp.slope[e];
    }
    if (period < soft_first[kind]) continue;
    const real value = s->qp.value[row] + hmpc_dot(slope, step, HMPC_NV);
    real over = violation(kind, value);
#if HMPC_BENT
    if (!states) {
      const real straight = over;
      over = violation(kind, linear->actual[period][kind - HMPC_SOFT_X]);
      const int kept = soft_hard[kind] && !(straight > R(0.0)); /* a hard bound that the QP keeps */
      if (soft_convex[kind])
        *bent = hmpc_max(*bent, (over - straight) / soft_scale[kind] - (kept ? R(0.0) : HMPC_STRAIGHT));
    }
#endif
    if (soft_hard[kind]) {
      s->plan.given_way[kind] = hmpc_max(s->plan.given_way[kind], over);
    } else {
      excess = hmpc_max(excess, over);
    }
    total += (soft_linear[kind] + R(0.5) * soft_quadratic[kind] / soft_scale[kind] * over) * over / soft_scale[kind];
  }
#endif
  s->plan.cost = total;
  s->plan.excess = excess;
  return near;
}

/* Keeps the prepared plan if there is no valid solution. */
static hmpc_status failed(hmpc_state *s, hmpc_status status) {
  const hmpc_linear *const linear = &s->linear;
  memcpy(s->plan.u, linear->u, sizeof s->plan.u);
  memcpy(s->plan.z, linear->z, sizeof s->plan.z);
  memcpy(s->plan.d, linear->d, sizeof s->plan.d);
  memcpy(s->plan.w, linear->w, sizeof s->plan.w);
  s->plan.cost = R(NAN);
  s->plan.excess = R(NAN);
  memset(s->plan.given_way, 0, sizeof s->plan.given_way);
  memset(s->plan.multiplier, 0, sizeof s->plan.multiplier);
  s->pending = 0;
  s->working.count = 0;
  return s->status = status;
}

/* References of a plan: states, inputs (NULL: the operating point's), and the number of rows of states. */
typedef struct {
  const real *x, *u;
  int rows;
} drawn_to;

/* The QP of the prepared plan for the estimate, the goal and the measured disturbances; 0 if a number is not finite. */
static int embed(hmpc_state *s, const hmpc_goal *goal, const real *w, int w_rows, drawn_to *to) {
  hmpc_linear *const linear = &s->linear;
  hmpc_qp *const qp = &s->qp;
#if HMPC_OUTPUT_COST
  const real *const u_goal = s->target.u[0], *const x_goal = s->target.x[0];
  const int rows = HMPC_N + 1;
#else
  const real *const u_goal = (const real *)0, *const x_goal = goal && goal->x ? goal->x : x_rest;
  const int rows = goal && goal->x ? goal->rows : 1;
#endif
  to->x = x_goal;
  to->u = u_goal;
  to->rows = rows;
#if HMPC_NW > 0
  int other = 0;
  real now[HMPC_NW];
  memcpy(now, s->w, sizeof now);
  for (int k = 0; k < HMPC_N; ++k) {
    if (w) {
      memcpy(now, row_of(w, w_rows, k, HMPC_NW), sizeof now);
    } else if (k > 0 && goal && goal->w && goal->w_rows > 0) {
      const real *const ahead = row_of(goal->w, goal->w_rows, k, HMPC_MEASURED);
      for (int i = 0; i < HMPC_MEASURED; ++i)
        if (hmpc_finite(ahead[i])) now[i] = ahead[i];
    }
    other |= memcmp(linear->w[k], now, sizeof now) != 0;
    memcpy(linear->w[k], now, sizeof now);
  }
  if (other) linearize(s, 0);
#else
  (void)w;
  (void)w_rows;
#endif
#if HMPC_OUTPUT_COST
  hmpc_aim(s, goal);
#endif
#if HMPC_COST_MOVES /* the cost depends on references and parameters */
  make_costs(s, goal);
  make_hessian(s);
#endif
  s->prepared = 0;
  memcpy(s->plan.d, s->d, sizeof s->plan.d);
  for (int i = 0; i < HMPC_NX; ++i) s->dz[0][i] = s->x[i] - linear->z[0][i];
  for (int i = 0; i < HMPC_NH; ++i) s->dz[0][HMPC_NX + i] = s->h[i] - linear->z[0][HMPC_NX + i];
  propagate(s, (const real *)0);
  memset(qp->gradient, 0, sizeof qp->gradient);
  for (int k = 1; k < HMPC_N; ++k) {
    const real *const x = row_of(x_goal, rows, k, HMPC_NX);
    const int m = (block_of[k - 1] + 1) * HMPC_NU;
    for (int i = 0; i < HMPC_NX; ++i)
      hmpc_add(qp->gradient, R(2.0) * linear->weight[k][i] * q_x[i] * (linear->z[k][i] + s->dz[k][i] - x[i]),
               linear->from_u[k][i], m);
  }
  const real *const last = row_of(x_goal, rows, HMPC_N, HMPC_NX);
  for (int i = 0; i < HMPC_NX; ++i) {
    real slope = R(0.0);
    for (int j = 0; j < HMPC_NX; ++j)
      slope += linear->terminal[i][j] * (linear->z[HMPC_N][j] + s->dz[HMPC_N][j] - last[j]);
    hmpc_add(qp->gradient, R(2.0) * slope, linear->from_u[HMPC_N][i], HMPC_NV);
  }
#if HMPC_STAGE_COST
  for (int k = 0; k < HMPC_N; ++k) add_stage_gradient(s, k, qp->gradient);
#endif
#if HMPC_OUTPUT_ROWS
  for (int k = 0; k < HMPC_N; ++k) {
    real row[HMPC_LD], error[HMPC_NY];
    output_error(s, k, error);
    for (int i = 0; i < HMPC_NY; ++i) {
      const int m = output_row(linear, k, i, row);
      if (q_y[i] > R(0.0)) hmpc_add(qp->gradient, R(2.0) * q_y[i] * error[i], row, m);
    }
  }
#endif
  for (int k = 0; k < HMPC_N; ++k)
    for (int j = 0; j < HMPC_NU; ++j) {
      const int i = block_of[k] * HMPC_NU + j;
      const real u = linear->u[k][j], before = k > 0 ? linear->u[k - 1][j] : linear->u_prev[j];
      const real after = k + 1 < HMPC_N ? linear->u[k + 1][j] : u;
      const real goal_u = input_goal(u_goal, k, j);
      qp->gradient[i] +=
          R(2.0) * (r_u[j] * (u - goal_u) + r_delta[j] * ((u - before) - (after - u))) * u_scale[j];
    }
#if HMPC_BENT
  memcpy(linear->gradient, qp->gradient, sizeof linear->gradient);
  bend_qp(s, goal, (const real *)0);
#else
  for (int i = 0; i < HMPC_NV; ++i) qp->gradient[i] /= qp->size;
#endif
#if HMPC_SOFT > 0 && (HMPC_SOFT_D || HMPC_NP > 0)
  if (HMPC_NP > 0 || memcmp(linear->d, s->d, sizeof linear->d) != 0) make_soft(s, s->d, goal);
#endif
  set_soft(s);
  set_bounds(s, goal);
  int fine = hmpc_all_finite(qp->gradient, HMPC_NV) && hmpc_all_finite(s->x, HMPC_NX) &&
             hmpc_all_finite(s->d, HMPC_ND) && hmpc_all_finite(s->h, HMPC_NH) && hmpc_all_finite(qp->value, HMPC_SOFT);
  for (int k = 0; k <= HMPC_N; ++k) fine = fine && hmpc_all_finite(row_of(x_goal, rows, k, HMPC_NX), HMPC_NX);
  return fine;
}

/* Inputs of the plan: those of the linearization with the QP's step. */
static void take_step(hmpc_state *s, const hmpc_goal *goal) {
  const hmpc_linear *const linear = &s->linear;
  for (int k = 0; k < HMPC_N; ++k) {
    real low[HMPC_NU], high[HMPC_NU];
    limits_of(goal, linear->u_prev, block_of[k], low, high);
    for (int j = 0; j < HMPC_NU; ++j)
      s->plan.u[k][j] =
          hmpc_clip(linear->u[k][j] + s->qp.step[block_of[k] * HMPC_NU + j] * u_scale[j], low[j], high[j]);
  }
}

/* Solves the prepared plan for the estimate and the goal; near: 0 if its states diverge. If the plan violates a curved
   bound more than its linearization, the bounds are linearized again at the plan; the cheapest plan counts. */
static hmpc_status solve_plan(hmpc_state *s, const hmpc_goal *goal, const real *w, int w_rows, int *near) {
  const hmpc_linear *const linear = &s->linear;
  drawn_to to;
  real bent;
  if (!s->prepared) hmpc_prepare(s, goal);
  if (!embed(s, goal, w, w_rows, &to)) return failed(s, HMPC_NOT_FINITE);
  hmpc_status status = hmpc_qp_solve(&s->qp, &s->working, linear);
#if HMPC_BENT
  int weighted = 0;
  for (int k = 0; k < HMPC_N; ++k) weighted |= linear->bends[k];
  if (status != HMPC_SOLVED && weighted) { /* the multipliers of the last plan may not fit any more */
    memset(s->linear.multiplier, 0, sizeof s->linear.multiplier);
    s->working.count = 0;
    bend_qp(s, goal, (const real *)0);
    status = hmpc_qp_solve(&s->qp, &s->working, linear);
  }
#endif
  if (status != HMPC_SOLVED) return failed(s, status);
  take_step(s, goal);
  *near = assess(s, goal, to.x, to.rows, to.u, &bent);
  if (!hmpc_finite(s->plan.cost)) return failed(s, HMPC_NOT_FINITE);
#if HMPC_BENT
  real best[HMPC_LD], least = s->plan.cost, kkt = s->working.kkt;
  const int corrected = bent > R(0.0);
  memcpy(best, s->qp.step, sizeof best);
  hmpc_qp_multipliers(&s->qp, &s->working, s->plan.multiplier[0]);
  memcpy(s->linear.multiplier, s->plan.multiplier, sizeof s->linear.multiplier);
  for (int again = 0; again < HMPC_CORRECTIONS && bent > R(0.0); ++again) {
    real step[HMPC_LD];
    memcpy(step, s->qp.step, sizeof step);
    bend_qp(s, goal, step);
    straighten(s, goal, step);
    status = hmpc_qp_solve(&s->qp, &s->working, linear);
    if (status != HMPC_SOLVED) {
      s->working.count = 0;
      break;
    }
    take_step(s, goal);
    (void)assess(s, goal, to.x, to.rows, to.u, &bent);
    if (!hmpc_finite(s->plan.cost)) break;
    hmpc_qp_multipliers(&s->qp, &s->working, s->linear.multiplier[0]);
    if (!(s->plan.cost < least)) continue;
    least = s->plan.cost;
    kkt = s->working.kkt;
    memcpy(best, s->qp.step, sizeof best);
    memcpy(s->plan.multiplier, s->linear.multiplier, sizeof s->plan.multiplier);
  }
  if (corrected) { /* the plan is the cheapest one */
    memcpy(s->qp.step, best, sizeof best);
    s->working.kkt = kkt;
    take_step(s, goal);
    *near = assess(s, goal, to.x, to.rows, to.u, &bent);
  }
#endif
  memcpy(s->plan.w, linear->w, sizeof s->plan.w);
#if HMPC_OUTPUT_COST
  s->steady = s->aimed;
#endif
  s->pending = 1;
  return s->status = HMPC_SOLVED;
}

hmpc_status hmpc_feedback(hmpc_state *s, const hmpc_goal *goal, const real *w, int w_rows) {
  int near = 1;
  const hmpc_status status = solve_plan(s, goal, w, w_rows, &near);
  return status == HMPC_SOLVED && !near ? failed(s, HMPC_DIVERGED) : status;
}

/* ---- safeguards */

static void saturate(const hmpc_goal *goal, const real *u, const real *held, real *to) {
  real low[HMPC_NU], high[HMPC_NU];
  limits_of(goal, held, 0, low, high);
  for (int i = 0; i < HMPC_NU; ++i) {
    const real near = HMPC_CHANGES ? hmpc_clip(u[i], held[i] - du_max[i], held[i] + du_max[i]) : u[i];
    to[i] = hmpc_clip(near, low[i], high[i]);
  }
}

#if HMPC_INPUT_BOUNDS > 0
/* Whether u keeps the hard bounds on inputs alone; way: its violations are entered there, unless NULL. */
static int admissible(const real *u, real *way) {
  real value[HMPC_INPUT_BOUNDS];
  int kept = 1;
  bounds_of_inputs(u, value);
  for (int i = 0; i < HMPC_INPUT_BOUNDS; ++i) {
    const real off = hmpc_max(value[i] - input_upper[i], input_lower[i] - value[i]);
    if (off <= R(0.0)) continue;
    kept = 0;
    if (way) way[input_kind[i]] = hmpc_max(way[input_kind[i]], off);
  }
  return kept;
}
#endif

/* Sets s->u to u within the limits and the hard bounds on inputs alone: it moves towards the held input, or towards the
   middle of the ranges, until the bounds hold. Its violations before are entered in given_way. */
static void apply(hmpc_state *s, const hmpc_goal *goal, const real *u, const real *held) {
  saturate(goal, u, held, s->u);
#if HMPC_INPUT_BOUNDS > 0
  real inside[HMPC_NU], beyond[HMPC_NU], middle[HMPC_NU];
  if (admissible(s->u, s->plan.given_way)) return;
  saturate(goal, held, held, inside);
  if (!admissible(inside, (real *)0)) saturate(goal, input_centre, held, inside);
  if (!admissible(inside, (real *)0)) return;
  memcpy(beyond, s->u, sizeof beyond);
  for (int n = 0; n < HMPC_HALVINGS; ++n) {
    for (int i = 0; i < HMPC_NU; ++i) middle[i] = R(0.5) * (inside[i] + beyond[i]);
    memcpy(admissible(middle, (real *)0) ? inside : beyond, middle, sizeof middle);
  }
  memcpy(s->u, inside, sizeof s->u);
#endif
}

/* Stabilising feedback of the prior around the steady state closest to the goal; 0 if it is not finite. */
static int fallback(hmpc_state *s, const hmpc_goal *goal, real *u) {
#if HMPC_FALLBACK_GAIN
  real best[HMPC_NU];
#if HMPC_OUTPUT_COST
  const real *const wanted = goal && goal->y ? goal->y : y_rest;
  const real *target = x_rest;
  hmpc_steady found;
  real y[HMPC_NY];
  for (int i = 0; i < HMPC_NY; ++i) y[i] = q_y[i] > R(0.0) ? wanted[i] : R(0.0);
  const int fine = hmpc_all_finite(y, HMPC_NY);
  if (fine) {
    hmpc_steady_state(s, y, s->w, &s->steady, 1, &found);
    if (found.steady) target = found.x;
    for (int i = 0; i < HMPC_NU; ++i) best[i] = found.steady ? found.u[i] : hmpc_clip(u_rest[i], u_min[i], u_max[i]);
  }
#else
  const int fine = 0;
  const real *target = goal && goal->x ? goal->x : x_rest;
  if (!hmpc_all_finite(target, HMPC_NX)) target = x_rest;
#endif
  if (!fine) {
    equilibrium(target, s->w, best);
    for (int i = 0; i < HMPC_NU; ++i)
      for (int j = 0; j < HMPC_ND; ++j) best[i] -= disturbs_u[i][j] * s->d[j];
  }
  for (int i = 0; i < HMPC_NU; ++i) {
    u[i] = best[i];
    for (int j = 0; j < HMPC_NX; ++j) u[i] -= gain[i][j] * (s->x[j] - target[j]);
    for (int j = 0; j < HMPC_DELAYED; ++j) u[i] -= gain[i][HMPC_NX + j] * (s->h[j] - best[j % HMPC_NU]);
  }
  return hmpc_all_finite(u, HMPC_NU);
#else
  (void)s;
  (void)goal;
  (void)u;
  return 0;
#endif
}

/* Input and plan without a valid solution: the input of the shifted plan if follow, else of the fallback, else the safe
   input, or the held one if no safe input is declared. */
static void without(hmpc_state *s, const hmpc_goal *goal, const real *held, int follow) {
  real u[HMPC_NU], way[HMPC_DIM(HMPC_KINDS)];
  const int known = hmpc_all_finite(s->x, HMPC_NX) && hmpc_all_finite(s->h, HMPC_NH) &&
                    hmpc_all_finite(s->d, HMPC_ND) && hmpc_all_finite(s->w, HMPC_NW);
  if (follow && hmpc_all_finite(s->plan.u[0], HMPC_NU)) {
    memcpy(u, s->plan.u[0], sizeof u);
    s->source = HMPC_PLAN;
  } else if (known && fallback(s, goal, u)) {
    s->source = HMPC_FALLBACK;
  } else {
    s->source = HMPC_SAFE_INPUT ? HMPC_SAFE : HMPC_HELD;
    memcpy(u, HMPC_SAFE_INPUT ? safe_input : held, sizeof u);
  }
  memset(s->plan.given_way, 0, sizeof s->plan.given_way);
  apply(s, goal, u, held);
  memcpy(way, s->plan.given_way, sizeof way);
  memcpy(s->plan.u[0], s->u, sizeof s->u);
  for (int k = 0; k < HMPC_N; ++k)
    for (int i = 0; i < HMPC_NU; ++i)
      if (!hmpc_finite(s->plan.u[k][i])) s->plan.u[k][i] = s->u[i];
  if (known) {
    real inputs[HMPC_N][HMPC_NU];
    memcpy(inputs, s->plan.u, sizeof inputs);
    hmpc_run_free(s, inputs[0], HMPC_N);
    memcpy(s->plan.given_way, way, sizeof way);
  }
}

void hmpc_decide(hmpc_state *s, const hmpc_goal *goal, const real *applied) {
  real held[HMPC_NU];
  for (int i = 0; i < HMPC_NU; ++i) held[i] = applied && hmpc_finite(applied[i]) ? applied[i] : s->u[i];
  if (memcmp(held, s->plan.u[0], sizeof held) != 0) {
    hmpc_complete(s);
    memcpy(s->plan.u[0], held, sizeof held);
    s->prepared = 0;
  }
  const hmpc_status status = hmpc_feedback(s, goal, (const real *)0, 0);
  if (status == HMPC_SOLVED) {
    apply(s, goal, s->plan.u[0], held);
    memcpy(s->plan.u[0], s->u, sizeof s->u);
    s->source = HMPC_MPC;
    s->age = 0;
    return;
  }
  if (s->age < 1000000) ++s->age;
  without(s, goal, held, s->age <= HMPC_MAX_AGE);
}

void hmpc_fall_back(hmpc_state *s, const hmpc_goal *goal, const real *held) {
  hmpc_complete(s);
  memmove(s->plan.u, s->plan.u + 1, sizeof s->plan.u - sizeof s->plan.u[0]);
  s->plan.cost = R(NAN);
  s->plan.excess = R(NAN);
  memset(s->plan.given_way, 0, sizeof s->plan.given_way);
  memset(s->plan.multiplier, 0, sizeof s->plan.multiplier);
  s->working.count = 0;
  s->prepared = 0;
  without(s, goal, held, 0);
  s->status = HMPC_INITIAL;
  s->age = 0;
}

void hmpc_rest(hmpc_state *s, const hmpc_goal *goal, const real *held) {
  memset(s->plan.given_way, 0, sizeof s->plan.given_way);
  apply(s, goal, safe_input, held);
  for (int k = 0; k < HMPC_N; ++k) memcpy(s->plan.u[k], s->u, sizeof s->u);
  s->prepared = 0;
  s->pending = 0;
  s->source = HMPC_SAFE;
  s->status = HMPC_INITIAL;
  s->age = 0;
}

/* Delays the plan by one period, with the held input first; the preparation shifts it back. */
static void delay_plan(hmpc_state *s, const real *held) {
  memmove(s->plan.z + 1, s->plan.z, sizeof s->plan.z - sizeof s->plan.z[0]);
  memmove(s->plan.u + 1, s->plan.u, sizeof s->plan.u - sizeof s->plan.u[0]);
  memmove(s->plan.multiplier + 1, s->plan.multiplier, sizeof s->plan.multiplier - sizeof s->plan.multiplier[0]);
  memcpy(s->plan.u[0], held, sizeof s->plan.u[0]);
  s->prepared = 0;
}

static void make_finite(real *v, int n) {
  for (int i = 0; i < n; ++i)
    if (!hmpc_finite(v[i])) v[i] = v[i] > R(0.0) ? HMPC_HUGE : v[i] < R(0.0) ? -HMPC_HUGE : R(0.0);
}

void hmpc_take_over(hmpc_state *s, const real *plan, const real *held) {
  real following[HMPC_N][HMPC_NU], x[HMPC_NX], h[HMPC_DIM(HMPC_NH)], d[HMPC_DIM(HMPC_ND)];
  memcpy(following, plan, sizeof following);
  memmove(following, following + 1, sizeof following - sizeof following[0]);
  memcpy(x, s->x, sizeof x);
  memcpy(h, s->h, sizeof h);
  memcpy(d, s->d, sizeof d);
  make_finite(s->x, HMPC_NX);
  make_finite(s->h, HMPC_NH);
  make_finite(s->d, HMPC_ND);
  hmpc_run_free(s, following[0], HMPC_N);
  memcpy(s->x, x, sizeof x);
  memcpy(s->h, h, sizeof h);
  memcpy(s->d, d, sizeof d);
  delay_plan(s, held);
  s->working.count = 0;
  s->age = 0;
}

/* Iterations of a first plan, which has no previous plan, from the inputs u with the last row held; 0 if one failed. */
static int iterate(hmpc_state *s, const hmpc_goal *goal, const real *u, int rows) {
  int near;
  s->working.count = 0;
  hmpc_run_free(s, u, rows);
  for (int i = 1; i < HMPC_FIRST; ++i) {
    delay_plan(s, s->u);
    if (solve_plan(s, goal, (const real *)0, 0, &near) != HMPC_SOLVED) return 0;
    hmpc_complete(s);
  }
  return 1;
}

#if HMPC_STARTS > 0
/* Cost of a free run of the model under the inputs u. */
static real cost_of_run(hmpc_state *s, const hmpc_goal *goal, const real *u) {
  hmpc_linear *const linear = &s->linear;
  drawn_to to;
  real bent;
  hmpc_run_free(s, u, HMPC_N);
  memcpy(linear->u, s->plan.u, sizeof linear->u);
  memcpy(linear->z, s->plan.z, sizeof linear->z);
  memcpy(linear->w, s->plan.w, sizeof linear->w);
  memcpy(linear->d, s->plan.d, sizeof linear->d);
  memcpy(linear->u_prev, s->u, sizeof linear->u_prev);
  hmpc_linearize(s, goal);
  if (!embed(s, goal, (const real *)0, 0, &to)) return R(INFINITY);
  memset(s->qp.step, 0, sizeof s->qp.step);
  assess(s, goal, to.x, to.rows, to.u, &bent);
  return hmpc_finite(s->plan.cost) ? s->plan.cost : R(INFINITY);
}
#endif

void hmpc_begin(hmpc_state *s, const real *applied, const hmpc_goal *goal) {
  for (int i = 0; i < HMPC_NU; ++i)
    s->u[i] = hmpc_clip(applied && hmpc_finite(applied[i]) ? applied[i] : u_rest[i], u_min[i], u_max[i]);
  s->source = HMPC_HELD;
  s->age = 0;
  int solved = iterate(s, goal, s->u, 1);
#if HMPC_STARTS > 0 /* the plan with the lowest cost, from the held input and from further starts */
  real best[HMPC_N][HMPC_NU], inputs[HMPC_N][HMPC_NU], least = R(INFINITY);
  for (int n = 0; n <= HMPC_STARTS; ++n) {
    if (n > 0) solved = iterate(s, goal, starts[n > 0 ? n - 1 : 0], HMPC_N);
    memcpy(inputs, s->plan.u, sizeof inputs);
    const real cost = solved ? cost_of_run(s, goal, inputs[0]) : R(INFINITY);
    if (!(cost < least)) continue;
    least = cost;
    memcpy(best, inputs, sizeof best);
  }
  solved = least < R(INFINITY);
  if (solved) hmpc_run_free(s, best[0], HMPC_N);
  s->working.count = 0;
#endif
  if (solved) {
    delay_plan(s, s->u);
  } else {
    hmpc_run_free(s, s->u, 1);
  }
  hmpc_decide(s, goal, (const real *)0);
}
