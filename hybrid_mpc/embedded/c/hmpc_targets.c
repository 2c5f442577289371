/* Target calculator: the steady state z = F(z, u, w, d) whose outputs are the set-point, or as close to it as limits
   and bounds allow. Of several equally good inputs it takes that closest to the operating point's. Gauss-Newton method
   in the null space of the steady-state equations, with an active set for the bounds. All loops end after a fixed
   number of rounds.

   Source: Rawlings, Mayne, Diehl, Model Predictive Control, 2017, section 1.5; Nocedal, Wright, Numerical Optimization,
   2006, section 15.6; Golub and Van Loan, Matrix Computations, 2013, sections 5.4 and 5.5. */
#include "hmpc_math.h"
#include "hmpc_tables.h"
#include "hmpc_expressions.h"

#if HMPC_OUTPUT_COST

#if HMPC_CURVED /* derivatives of the outputs at a point */
#define OUTPUT_X(at) ((at)->by_x)
#define OUTPUT_U(at) ((at)->by_u)
#else
#define OUTPUT_X(at) output_x
#define OUTPUT_U(at) output_u
#endif

enum {
  NT = HMPC_NT,
  HALVINGS = 10, /* of a step that does not reduce the merit */
  SWEEPS = 30,   /* of Jacobi rotations */
  ROUNDS = 10 * HMPC_TARGET_ROWS,
  ROWS = HMPC_NZ + HMPC_NY,
  PLAIN = 0, /* second derivatives in a step: none, */
  CURVED,    /* of the deviation: where a set-point beyond reach is closest, an output may turn, */
  LEANING    /* of the distance from the operating point, at the set-point */
};

/* Residual, outputs and derivatives at v. */
static void look(const hmpc_state *s, const real *v, const real *goal, const real *w, hmpc_point *p) {
  real acts[HMPC_NU], z[HMPC_LZ] = {R(0.0)}, next[HMPC_LZ] = {R(0.0)}, off = R(0.0);
  memcpy(p->v, v, sizeof p->v);
  memcpy(z, v, sizeof(real) * HMPC_NZ);
  for (int i = 0; i < HMPC_NU; ++i) {
    acts[i] = v[HMPC_NZ + i];
    for (int j = 0; j < HMPC_ND; ++j) acts[i] += disturbs_u[i][j] * s->search.d[j];
  }
  hmpc_model_slope(z, acts, w, next, p->slope[0]);
  for (int i = 0; i < HMPC_NX; ++i)
    for (int j = 0; j < HMPC_ND; ++j) next[i] += disturbs_x[i][j] * s->search.d[j];
  p->lacks = R(0.0);
  for (int i = 0; i < HMPC_NZ; ++i) {
    p->rest[i] = next[i] - v[i];
    p->lacks += hmpc_abs(p->rest[i] / target_scale[i]);
  }
#if HMPC_CURVED
  output_slopes(z, acts, w, p->y, p->by_x[0], p->by_u[0]);
#else
  outputs(z, acts, w, p->y);
#endif
  for (int i = 0; i < HMPC_NY; ++i) {
    for (int j = 0; j < HMPC_ND; ++j) p->y[i] += disturbs_y[i][j] * s->search.d[j];
    if (q_y[i] > R(0.0)) off += target_root[i] * target_root[i] * (p->y[i] - goal[i]) * (p->y[i] - goal[i]);
  }
  p->off = hmpc_sqrt(off);
}

/* Function that a descent reduces, with the weight of the residual; infinite if a value is not finite. */
static real merit(const hmpc_point *p, real weight) {
  const real found = weight * p->lacks + p->off;
  return hmpc_finite(found) ? found : R(INFINITY);
}

/* Weighted deviation of the outputs from the set-point after a step, to first order. */
static real deviation(const hmpc_point *p, const real *step, const real *goal) {
  real off = R(0.0);
  for (int i = 0; i < HMPC_NY; ++i) {
    real y = p->y[i];
    if (!(q_y[i] > R(0.0))) continue;
    for (int j = 0; j < HMPC_NX; ++j) y += OUTPUT_X(p)[i][j] * step[j];
    for (int j = 0; j < HMPC_NU; ++j) y += OUTPUT_U(p)[i][j] * step[HMPC_NZ + j];
    off += target_root[i] * target_root[i] * (y - goal[i]) * (y - goal[i]);
  }
  return hmpc_sqrt(off);
}

#if HMPC_NH > 0
/* Solves a x = b in place by elimination with row exchanges; 0 if a is singular. Rows of a have NT entries. */
static int solve(real (*a)[NT], real *b, int n) {
  for (int k = 0; k < n; ++k) {
    int pivot = k;
    for (int i = k + 1; i < n; ++i)
      if (hmpc_abs(a[i][k]) > hmpc_abs(a[pivot][k])) pivot = i;
    if (!(hmpc_abs(a[pivot][k]) > R(0.0))) return 0;
    if (pivot != k) {
      const real kept = b[k];
      b[k] = b[pivot];
      b[pivot] = kept;
      for (int j = k; j < n; ++j) {
        const real entry = a[k][j];
        a[k][j] = a[pivot][j];
        a[pivot][j] = entry;
      }
    }
    for (int i = k + 1; i < n; ++i) {
      const real factor = a[i][k] / a[k][k];
      b[i] -= factor * b[k];
      for (int j = k + 1; j < n; ++j) a[i][j] -= factor * a[k][j];
    }
  }
  for (int i = n - 1; i >= 0; --i) {
    for (int j = i + 1; j < n; ++j) b[i] -= a[i][j] * b[j];
    b[i] /= a[i][i];
  }
  return 1;
}
#endif

/* The point v with its hidden state moved to rest under its state and input, or v itself if its merit is lower. */
static void settle(hmpc_state *s, const real *v, const real *goal, const real *w, hmpc_point *to) {
  look(s, v, goal, w, to);
#if HMPC_NH > 0
  hmpc_search *const work = &s->search;
  work->settled = *to;
  for (int round = 0; round < HMPC_TARGET_SETTLING; ++round) {
    hmpc_point *const at = &work->settled;
    real move[HMPC_NH], most = R(0.0), there[NT];
    const real *const size = target_scale + HMPC_NX;
    for (int i = 0; i < HMPC_NH; ++i) {
      move[i] = -at->rest[HMPC_NX + i] / size[i];
      most = hmpc_max(most, hmpc_abs(move[i]));
      for (int j = 0; j < HMPC_NH; ++j)
        work->a[i][j] = (at->slope[HMPC_NX + i][HMPC_NX + j] - (i == j ? R(1.0) : R(0.0))) * size[j] / size[i];
    }
    if (!hmpc_all_finite(at->rest, HMPC_NZ) || most < HMPC_TARGET_STEADY) break;
    if (!solve(work->a, move, HMPC_NH)) return;
    memcpy(there, at->v, sizeof there);
    for (int i = 0; i < HMPC_NH; ++i) there[HMPC_NX + i] += size[i] * move[i];
    look(s, there, goal, w, at);
  }
  if (merit(&work->settled, HMPC_TARGET_LEAST_WEIGHT) < merit(to, HMPC_TARGET_LEAST_WEIGHT)) *to = work->settled;
#endif
}

/* Householder factors of work->a with row exchanges, the largest row first: a = (l, 0) q'. l has as many columns as the
   rank and is stored in work->a before each row's reflector; order: original number of each row. */
static int factorize(hmpc_search *work, int rows, int *order) {
  real first = R(0.0);
  int rank = 0;
  for (int i = 0; i < rows; ++i) order[i] = i;
  for (int k = 0; k < rows && k < NT; ++k, ++rank) {
    int best = k;
    real largest = R(-1.0);
    for (int i = k; i < rows; ++i) {
      const real size = hmpc_dot(work->a[i] + k, work->a[i] + k, NT - k);
      if (size > largest) {
        largest = size;
        best = i;
      }
    }
    const real size = hmpc_sqrt(hmpc_max(largest, R(0.0)));
    if (k == 0) first = size;
    if (!(size > HMPC_TARGET_RANK * first)) break;
    if (best != k) {
      const int kept = order[k];
      real row[NT];
      order[k] = order[best];
      order[best] = kept;
      memcpy(row, work->a[k], sizeof row);
      memcpy(work->a[k], work->a[best], sizeof row);
      memcpy(work->a[best], row, sizeof row);
    }
    real *const v = work->a[k];
    const real diagonal = v[k] > R(0.0) ? -size : size;
    v[k] -= diagonal; /* the reflector 1 - v v' / half, with |v[k]| of at least size */
    work->half[k] = R(0.5) * hmpc_dot(v + k, v + k, NT - k);
    work->diagonal[k] = diagonal;
    for (int i = k + 1; i < rows; ++i)
      hmpc_add(work->a[i] + k, -hmpc_dot(v + k, work->a[i] + k, NT - k) / work->half[k], v + k, NT - k);
  }
  return rank;
}

/* x = q x */
static void rotate(const hmpc_search *work, int rank, real *x) {
  for (int k = rank - 1; k >= 0; --k)
    hmpc_add(x + k, -hmpc_dot(work->a[k] + k, x + k, NT - k) / work->half[k], work->a[k] + k, NT - k);
}

/* Least-squares solution x of a x = b with the smallest norm, from the factors. */
static void shortest(hmpc_search *work, int rank, const int *order, const real *b, real *x) {
  const int left = HMPC_NZ - rank;
  real lacks[HMPC_NZ];
  memset(x, 0, sizeof(real) * NT);
  if (left > 0) { /* rows that depend on earlier ones: k = l2 l1^-1, and w = b1 + k' (1 + k k')^-1 (b2 - k b1) */
    for (int i = 0; i < left; ++i) {
      real *const row = work->a[rank + i];
      for (int j = rank - 1; j >= 0; --j) {
        for (int m = j + 1; m < rank; ++m) row[j] -= row[m] * work->a[m][j];
        row[j] /= work->diagonal[j];
      }
      lacks[i] = b[order[rank + i]];
      for (int j = 0; j < rank; ++j) lacks[i] -= row[j] * b[order[j]];
    }
    for (int i = 0; i < left; ++i)
      for (int j = 0; j <= i; ++j) {
        const real entry = hmpc_dot(work->a[rank + i], work->a[rank + j], rank) + (i == j ? R(1.0) : R(0.0));
        const real rest = entry - hmpc_dot(work->h[i], work->h[j], j);
        work->h[i][j] = i == j ? hmpc_sqrt(rest) : rest / work->h[j][j];
      }
    for (int i = 0; i < left; ++i) lacks[i] = (lacks[i] - hmpc_dot(work->h[i], lacks, i)) / work->h[i][i];
    for (int i = left - 1; i >= 0; --i) {
      for (int j = i + 1; j < left; ++j) lacks[i] -= work->h[j][i] * lacks[j];
      lacks[i] /= work->h[i][i];
    }
  }
  for (int i = 0; i < rank; ++i) {
    real value = b[order[i]];
    for (int j = 0; j < left; ++j) value += work->a[rank + j][i] * lacks[j];
    x[i] = (value - hmpc_dot(work->a[i], x, i)) / work->diagonal[i];
  }
  rotate(work, rank, x);
}

/* Makes rows of n entries orthogonal by rotations; their norms are the singular values. */
static void orthogonal(real (*rows)[NT], int count, int n) {
  for (int sweep = 0; sweep < SWEEPS; ++sweep) {
    int turned = 0;
    for (int i = 0; i < count; ++i)
      for (int j = i + 1; j < count; ++j) {
        const real a = hmpc_dot(rows[i], rows[i], n), b = hmpc_dot(rows[j], rows[j], n);
        const real both = hmpc_dot(rows[i], rows[j], n);
        if (!(hmpc_abs(both) > HMPC_TARGET_ROUNDING * hmpc_sqrt(a) * hmpc_sqrt(b))) continue;
        const real ratio = (b - a) / (R(2.0) * both);
        const real tangent = R(1.0) / (hmpc_abs(ratio) + hmpc_sqrt(R(1.0) + ratio * ratio));
        const real c = R(1.0) / hmpc_sqrt(R(1.0) + tangent * tangent), d = ratio < R(0.0) ? -c * tangent : c * tangent;
        for (int k = 0; k < n; ++k) {
          const real x = rows[i][k], y = rows[j][k];
          rows[i][k] = c * x - d * y;
          rows[j][k] = d * x + c * y;
        }
        turned = 1;
      }
    if (!turned) return;
  }
}

/* Adds the bound row eta <= end to the QP in the m unknowns eta, scaled to norm 1; 0 if no eta keeps it. */
static int bound(hmpc_search *work, int m, int sign, real end, int *count) {
  real *const row = work->bound[*count];
  const real size = hmpc_sqrt(hmpc_dot(row, row, m));
  if (!hmpc_finite(end)) return 1;
  if (!(size > R(0.0))) return end >= R(0.0);
  for (int k = 0; k < m; ++k) row[k] *= R(sign) / size;
  work->end[*count] = end / size;
  ++*count;
  return 1;
}

/* Adds both bounds of the scaled value now + row eta. */
static int bounds(hmpc_search *work, int m, const real *row, real now, real low, real high, int *count) {
  memcpy(work->bound[*count], row, sizeof(real) * (size_t)m);
  if (!bound(work, m, 1, high - now, count)) return 0;
  memcpy(work->bound[*count], row, sizeof(real) * (size_t)m);
  return bound(work, m, -1, now - low, count);
}

/* min 1/2 e'he + g'e with bound e <= end: the point closest to the unconstrained minimum in L' e, where h = L L'. Dual
   method of Goldfarb and Idnani, whose small systems are solved again in each round. 0 without a solution. */
static int least_squares(hmpc_search *work, int m, const real *g, int count, real *eta) {
  int active[NT + 1], n = 0;
  real multiplier[NT + 1] = {R(0.0)}, share[NT], start[NT], y[NT];
  for (int i = 0; i < m; ++i)
    for (int j = 0; j <= i; ++j) { /* L in place */
      const real rest = work->h[i][j] - hmpc_dot(work->h[i], work->h[j], j);
      if (i == j && !(rest > R(0.0) && rest <= HMPC_HUGE)) return 0;
      work->h[i][j] = i == j ? hmpc_sqrt(rest) : rest / work->h[j][j];
    }
  for (int i = 0; i < m; ++i) start[i] = (-g[i] - hmpc_dot(work->h[i], start, i)) / work->h[i][i];
  for (int r = 0; r < count; ++r)
    for (int i = 0; i < m; ++i)
      work->seen[r][i] = (work->bound[r][i] - hmpc_dot(work->h[i], work->seen[r], i)) / work->h[i][i];
  for (int round = 0;; ++round) {
    memcpy(y, start, sizeof y);
    for (int k = 0; k < n; ++k) hmpc_add(y, -multiplier[k], work->seen[active[k]], m);
    real largest = HMPC_TARGET_VIOLATED;
    int worst = -1;
    for (int r = 0; r < count; ++r) {
      int inside = 0;
      for (int k = 0; k < n; ++k) inside |= active[k] == r;
      const real over = hmpc_dot(work->seen[r], y, m) - work->end[r];
      if (!inside && over > largest) {
        largest = over;
        worst = r;
      }
    }
    if (worst < 0) break;
    if (round == ROUNDS) return 0;
    const real *const own = work->seen[worst];
    real given = R(0.0);
    for (int step = 0;; ++step) { /* its multiplier increases until it is kept; others at zero leave */
      real rate = hmpc_dot(own, own, m);
      const real size = rate;
      for (int i = 0; i < n; ++i) {
        for (int j = 0; j <= i; ++j) {
          const real product = hmpc_dot(work->seen[active[i]], work->seen[active[j]], m);
          const real rest = product - hmpc_dot(work->gram[i], work->gram[j], j);
          work->gram[i][j] = i == j ? hmpc_sqrt(hmpc_max(rest, R(1e-30))) : rest / work->gram[j][j];
        }
        share[i] = hmpc_dot(work->seen[active[i]], own, m) - hmpc_dot(work->gram[i], share, i);
        share[i] /= work->gram[i][i];
        rate -= share[i] * share[i];
      }
      for (int i = n - 1; i >= 0; --i) {
        for (int j = i + 1; j < n; ++j) share[i] -= work->gram[j][i] * share[j];
        share[i] /= work->gram[i][i];
      }
      memcpy(y, start, sizeof y);
      for (int k = 0; k < n; ++k) hmpc_add(y, -multiplier[k], work->seen[active[k]], m);
      hmpc_add(y, -given, own, m);
      const real over = hmpc_max(hmpc_dot(own, y, m) - work->end[worst], R(0.0));
      real length = n < m && rate > HMPC_DEPENDENT * size ? over / rate : HMPC_HUGE;
      int leaves = -1;
      for (int k = 0; k < n; ++k)
        if (share[k] > R(0.0) && multiplier[k] / share[k] < length) {
          length = multiplier[k] / share[k];
          leaves = k;
        }
      if (!(length < HMPC_HUGE) || step > count) return 0;
      for (int k = 0; k < n; ++k) multiplier[k] -= length * share[k];
      given += length;
      if (leaves < 0) break;
      --n;
      for (int k = leaves; k < n; ++k) {
        active[k] = active[k + 1];
        multiplier[k] = multiplier[k + 1];
      }
    }
    active[n] = worst;
    multiplier[n] = given;
    ++n;
  }
  for (int i = m - 1; i >= 0; --i) {
    eta[i] = y[i];
    for (int j = i + 1; j < m; ++j) eta[i] -= work->h[j][i] * eta[j];
    eta[i] /= work->h[i][i];
  }
  return 1;
}

/* Scaled Jacobian of the steady-state equations at work->at, in work->a. */
static void slopes_of_rest(hmpc_search *work) {
  const hmpc_point *const at = &work->at;
  for (int i = 0; i < HMPC_NZ; ++i) {
    for (int j = 0; j < HMPC_NZ; ++j)
      work->a[i][j] = (at->slope[i][j] - (i == j ? R(1.0) : R(0.0))) * target_scale[j] / target_heed[i];
    for (int j = 0; j < HMPC_NU; ++j)
      work->a[i][HMPC_NZ + j] = at->slope[i][HMPC_LZ + j] * target_scale[HMPC_NZ + j] / target_heed[i];
  }
}

/* Scaled derivative of output i by the unknown j. */
static real slope_of_output(const hmpc_point *p, int i, int j) {
  (void)p;
  if (j < HMPC_NX) return OUTPUT_X(p)[i][j] * target_scale[j];
  return j < HMPC_NZ ? R(0.0) : OUTPUT_U(p)[i][j - HMPC_NZ] * target_scale[j];
}

/* Whether the unknown j is at a bound, where it has a multiplier of its own. */
static int at_bound(const hmpc_point *p, int j) {
  const real near = HMPC_TARGET_NEAR * target_scale[j];
  if (j >= HMPC_NX && j < HMPC_NZ) return 0;
  const real low = j < HMPC_NX ? target_x_range[j][0] : u_min[j - HMPC_NZ];
  const real high = j < HMPC_NX ? target_x_range[j][1] : u_max[j - HMPC_NZ];
  return !(p->v[j] - low > near && high - p->v[j] > near);
}

/* Multipliers at work->at: of the equations and, if leaning, of the weighted outputs, so that the slope of the distance
   from the operating point vanishes; else of the equations, so that the slope of the outputs' deviation vanishes. */
static void multipliers(hmpc_search *work, const real *goal, int leaning, real *to) {
  const hmpc_point *const at = &work->at;
  real b[NT] = {R(0.0)};
  int order[ROWS], rows = HMPC_NZ;
  slopes_of_rest(work);
  memset(to, 0, sizeof(real) * ROWS);
  for (int i = 0; i < HMPC_NY; ++i)
    if (q_y[i] > R(0.0)) {
      to[rows] = leaning ? R(0.0) : target_root[i] * (at->y[i] - goal[i]);
      for (int j = 0; j < NT; ++j) work->a[rows][j] = target_root[i] * slope_of_output(at, i, j);
      ++rows;
    }
  for (int j = 0; j < NT; ++j) {
    const int held = at_bound(at, j);
    for (int i = 0; i < rows && held; ++i) work->a[i][j] = R(0.0);
    for (int i = HMPC_NZ; i < rows; ++i) b[j] -= to[i] * work->a[i][j];
    if (leaning && !held && j >= HMPC_NZ) b[j] = (u_rest[j - HMPC_NZ] - at->v[j]) / target_scale[j];
  }
  const int rank = factorize(work, leaning ? rows : HMPC_NZ, order);
  for (int k = 0; k < rank; ++k)
    hmpc_add(b + k, -hmpc_dot(work->a[k] + k, b + k, NT - k) / work->half[k], work->a[k] + k, NT - k);
  for (int i = rank - 1; i >= 0; --i) {
    real value = b[i];
    for (int j = i + 1; j < rank; ++j) value -= work->a[j][i] * to[order[j]];
    to[order[i]] = value / work->diagonal[i];
  }
}

/* Second derivatives of the Lagrangian with the multipliers pull along the m directions work->along, in work->bend, and
   their product with the step onto the steady states, by differences of Jacobians. */
static void bend(hmpc_state *s, const real *goal, const real *w, const real *pull, int m, const real *onto,
                 real *turned) {
  hmpc_search *const work = &s->search;
  const hmpc_point *const at = &work->at, *const aside = &work->settled;
  const real far = hmpc_sqrt(hmpc_dot(onto, onto, NT)) + R(1e-30);
  for (int k = 0; k <= m; ++k) {
    real v[NT], change[NT];
    for (int j = 0; j < NT; ++j)
      v[j] = at->v[j] + HMPC_TARGET_ASIDE * (k < m ? work->along[k][j] : onto[j] / far) * target_scale[j];
    look(s, v, goal, w, &work->settled);
    for (int j = 0; j < NT; ++j) {
      const int column = j < HMPC_NZ ? j : HMPC_LZ + j - HMPC_NZ;
      int row = HMPC_NZ;
      change[j] = R(0.0);
      for (int i = 0; i < HMPC_NZ; ++i)
        change[j] += pull[i] * (aside->slope[i][column] - at->slope[i][column]) * target_scale[j] / target_heed[i];
      for (int i = 0; i < HMPC_NY; ++i)
        if (q_y[i] > R(0.0))
          change[j] += pull[row++] * target_root[i] * (slope_of_output(aside, i, j) - slope_of_output(at, i, j));
      change[j] /= HMPC_TARGET_ASIDE;
    }
    for (int l = 0; l < m; ++l) {
      if (k < m) work->bend[k][l] = hmpc_dot(work->along[l], change, NT);
      if (k == m) turned[l] = far * hmpc_dot(work->along[l], change, NT);
    }
  }
  for (int k = 0; k < m; ++k)
    for (int l = 0; l < k; ++l) work->bend[k][l] = work->bend[l][k] = R(0.5) * (work->bend[k][l] + work->bend[l][k]);
}

/* Norm of the first m rows of work->bend. */
static real bend_norm(const hmpc_search *work, int m) {
  real sum = R(0.0);
  for (int k = 0; k < m; ++k) sum += hmpc_dot(work->bend[k], work->bend[k], m);
  return hmpc_sqrt(sum);
}

/* Whether the first m rows of work->h are positive definite. */
static int definite(hmpc_search *work, int m) {
  for (int i = 0; i < m; ++i)
    for (int j = 0; j <= i; ++j) {
      const real rest = work->h[i][j] - hmpc_dot(work->gram[i], work->gram[j], j);
      if (i == j && !(rest > R(0.0))) return 0;
      work->gram[i][j] = i == j ? hmpc_sqrt(rest) : rest / work->gram[j][j];
    }
  return 1;
}

/* Adds factor times work->bend to work->h, and more until that is positive definite: first against leaving bounds. */
static void add_bend(hmpc_search *work, int m, real factor) {
  const real norm = factor * bend_norm(work, m);
  real row[NT];
  for (int k = 0; k < m; ++k) hmpc_add(work->h[k], factor, work->bend[k], m);
  const int convex = definite(work, m);
  for (int j = 0; j < NT && !convex; ++j) {
    if (!at_bound(&work->at, j)) continue;
    for (int k = 0; k < m; ++k) row[k] = work->along[k][j];
    const real length = hmpc_dot(row, row, m);
    for (int k = 0; k < m && length > R(0.0); ++k)
      hmpc_add(work->h[k], HMPC_TARGET_STIFF * norm * row[k] / length, row, m);
  }
  const int enough = convex || definite(work, m);
  for (int k = 0; k < m && !enough; ++k) work->h[k][k] += R(2.0) * norm;
}

/* Removes the directions that the outputs determine from a row. */
static void unseen(const hmpc_search *work, int m, int tracked, real size, real *row) {
  for (int i = 0; i < tracked; ++i) { /* orthogonal */
    const real *const seen = work->turned[i];
    const real length = hmpc_dot(seen, seen, m);
    if (hmpc_sqrt(length) > HMPC_TARGET_RANK * size) hmpc_add(row, -hmpc_dot(row, seen, m) / length, seen, m);
  }
}

/* Gauss-Newton step at work->at; 0 if its QP has no solution. mode: which second derivatives along the steady states it
   has. */
static int newton(hmpc_state *s, const real *goal, const real *w, int bounded, int mode, real *step) {
  hmpc_search *const work = &s->search;
  const hmpc_point *const at = &work->at;
  const real *const u = at->v + HMPC_NZ;
  real pull[ROWS], turned[NT] = {R(0.0)};
  real onto[NT], sees[HMPC_NY][NT] = {{R(0.0)}}, error[HMPC_NY], g[NT], row[NT], eta[NT];
  real trace = R(0.0), size = R(1e-30);
  int order[HMPC_NZ], tracked = 0, count = 0;
  if (mode != PLAIN) multipliers(work, goal, mode == LEANING, pull);
  slopes_of_rest(work);
  for (int i = 0; i < HMPC_NZ; ++i) {
    if (!hmpc_all_finite(work->a[i], NT) || !hmpc_finite(at->rest[i])) return 0;
    row[i] = -at->rest[i] / target_heed[i];
  }
  const int rank = factorize(work, HMPC_NZ, order), m = NT - rank;
  shortest(work, rank, order, row, onto); /* step onto the steady states */
  for (int k = 0; k < m; ++k) {           /* directions along them */
    memset(work->along[k], 0, sizeof work->along[k]);
    work->along[k][rank + k] = R(1.0);
    rotate(work, rank, work->along[k]);
  }
  for (int i = 0; i < HMPC_NY; ++i) {
    if (!(q_y[i] > R(0.0))) continue;
    for (int j = 0; j < NT; ++j) row[j] = slope_of_output(at, i, j);
    for (int k = 0; k < m; ++k) sees[tracked][k] = target_root[i] * hmpc_dot(row, work->along[k], NT);
    error[tracked] = target_root[i] * (goal[i] - at->y[i] - hmpc_dot(row, onto, NT));
    ++tracked;
  }
  memcpy(work->turned, sees, sizeof sees);
  orthogonal(work->turned, tracked, m);
  for (int i = 0; i < tracked; ++i) size = hmpc_max(size, hmpc_sqrt(hmpc_dot(work->turned[i], work->turned[i], m)));
  work->answer = R(0.0); /* negative if outputs react to inputs opposite to the operating point */
  for (int i = 0; i < tracked; ++i)
    for (int k = 0; k < m; ++k)
      work->answer += sees[i][k] * hmpc_dot(target_slopes[i], work->along[k] + HMPC_NZ, HMPC_NU);
  memset(work->h, 0, sizeof work->h);
  memset(g, 0, sizeof g);
  if (mode != PLAIN) bend(s, goal, w, pull, m, onto, turned);
  const real whole = mode == CURVED ? hmpc_sqrt(size * size + bend_norm(work, m)) : size;
  const real factor = R(1.0) / whole / whole;
  for (int i = 0; i < tracked; ++i) {
    for (int k = 0; k < m; ++k) {
      g[k] -= sees[i][k] * error[i] * factor;
      hmpc_add(work->h[k], sees[i][k] * factor, sees[i], m);
    }
  }
  if (mode == CURVED) {
    for (int k = 0; k < m; ++k) g[k] += turned[k] * factor;
    add_bend(work, m, factor);
  }
  for (int j = 0; j < HMPC_NU; ++j) { /* directions that the outputs do not determine: towards u_rest */
    const real far = (u_rest[j] - u[j]) / target_scale[HMPC_NZ + j] - onto[HMPC_NZ + j];
    for (int k = 0; k < m; ++k) row[k] = work->along[k][HMPC_NZ + j];
    unseen(work, m, tracked, size, row);
    for (int k = 0; k < m; ++k) {
      g[k] -= HMPC_TARGET_FREE * row[k] * far;
      hmpc_add(work->h[k], HMPC_TARGET_FREE * row[k], row, m);
    }
  }
  if (mode == LEANING) {
    for (int side = 0; side < 2; ++side) /* both sides of a symmetric matrix */
      for (int k = 0; k < m; ++k) {
        unseen(work, m, tracked, size, work->bend[k]);
        for (int l = 0; l < k; ++l) {
          const real kept = work->bend[k][l];
          work->bend[k][l] = work->bend[l][k];
          work->bend[l][k] = kept;
        }
      }
    unseen(work, m, tracked, size, turned);
    for (int k = 0; k < m; ++k) g[k] += HMPC_TARGET_FREE * turned[k];
    add_bend(work, m, HMPC_TARGET_FREE);
  }
  for (int k = 0; k < m; ++k) trace += work->h[k][k];
  for (int k = 0; k < m; ++k) work->h[k][k] += HMPC_TARGET_DAMPING * trace + R(0.01) * HMPC_TARGET_DAMPING;
  for (int k = 0; k < m; ++k)
    if (!hmpc_all_finite(work->h[k], m) || !hmpc_finite(g[k])) return 0;
  for (int j = 0; j < HMPC_NU; ++j) {
    const real scale = target_scale[HMPC_NZ + j];
    for (int k = 0; k < m; ++k) row[k] = work->along[k][HMPC_NZ + j];
    if (!bounds(work, m, row, u[j] / scale + onto[HMPC_NZ + j], u_min[j] / scale, u_max[j] / scale, &count)) return 0;
  }
  for (int j = 0; j < HMPC_NX && bounded; ++j) {
    const real scale = target_scale[j], *const range = target_x_range[j];
    for (int k = 0; k < m; ++k) row[k] = work->along[k][j];
    if (!bounds(work, m, row, at->v[j] / scale + onto[j], range[0] / scale, range[1] / scale, &count)) return 0;
  }
  for (int i = 0; i < HMPC_NY && bounded; ++i) {
    real slope[NT];
    for (int j = 0; j < NT; ++j) slope[j] = slope_of_output(at, i, j);
    for (int k = 0; k < m; ++k) row[k] = hmpc_dot(slope, work->along[k], NT);
    const real now = at->y[i] + hmpc_dot(slope, onto, NT);
    if (!bounds(work, m, row, now, target_y_range[i][0], target_y_range[i][1], &count)) return 0;
  }
  if (!least_squares(work, m, g, count, eta)) return 0;
  for (int k = 0; k < m; ++k) hmpc_add(onto, eta[k], work->along[k], NT);
  for (int i = 0; i < NT; ++i) step[i] = onto[i] * target_scale[i];
  return hmpc_all_finite(step, NT);
}

/* The unknowns v of a steady state. */
static void place(const hmpc_steady *from, real *v) {
  memcpy(v, from->x, sizeof from->x);
  if (HMPC_NH > 0) memcpy(v + HMPC_NX, from->h, sizeof(real) * HMPC_NH);
  memcpy(v + HMPC_NZ, from->u, sizeof from->u);
}

/* Gauss-Newton method from v; bounded: within the bounds of states and outputs; firm: ends as soon as its end is not
   sure. Second derivatives of the deviation are used from the start (CURVED) or once a whole step fails, those of the
   distance from the operating
   point once steps at the set-point do not contract. */
static void descend(hmpc_state *s, const real *v, const real *goal, const real *w, int bounded, int firm,
                    int mode, hmpc_descent *found) {
  hmpc_search *const work = &s->search;
  hmpc_point *const at = &work->at, *const after = &work->after;
  real step[NT], there[NT], before = HMPC_HUGE, off = R(0.0), apart = R(0.0);
  real lacks[HMPC_TARGET_ITERATIONS + 1], offs[HMPC_TARGET_ITERATIONS + 1];
  real weight = HMPC_TARGET_LEAST_WEIGHT;
  int done = 0, sure = 1, near = 0, tracked = 0, n = 0;
  for (int i = 0; i < HMPC_NY; ++i) tracked += q_y[i] > R(0.0);
  look(s, v, goal, w, at);
  lacks[0] = at->lacks;
  offs[0] = at->off;
  for (int k = 1; k <= HMPC_TARGET_ITERATIONS; ++k) {
    real size = R(0.0), share = R(1.0), from;
    if ((firm && !sure) || !newton(s, goal, w, bounded, mode, step)) break;
    for (int i = 0; i < NT; ++i) size = hmpc_max(size, hmpc_abs(step[i] / target_scale[i]));
    if (size <= HMPC_TARGET_STEADY) {
      done = at->lacks <= HMPC_TARGET_STILL;
      break;
    }
    const int spare = HMPC_NU > tracked && mode != LEANING && at->lacks <= HMPC_TARGET_STILL &&
                      at->off <= HMPC_TARGET_REACHED; /* inputs that set-points do not determine */
    if (spare && size > HMPC_TARGET_CONTRACTS * before) {
      mode = LEANING; /* the same point again */
      near = size < HMPC_TARGET_NEAR;
      work->good = *at;
      before = HMPC_HUGE;
      continue;
    }
    if (mode == LEANING) {
      if (!(size <= HMPC_TARGET_CONTRACTS * before)) break;
      before = size;
      for (int i = 0; i < NT; ++i) there[i] = at->v[i] + step[i];
      settle(s, there, goal, w, after);
      *at = *after;
      continue;
    }
    const real last = before;
    before = size;
    /* exact penalty: the step must reduce the merit to first order */
    if (at->lacks > HMPC_TARGET_STILL)
      weight = hmpc_max(weight, R(2.0) * (deviation(at, step, goal) - at->off) / at->lacks);
    from = merit(at, weight);
    for (int i = 0; i < NT; ++i) there[i] = at->v[i] + step[i];
    settle(s, there, goal, w, after);
    if (!(merit(after, weight) < from) && !(size < HMPC_TARGET_NEAR)) {
      /* watchdog: on a curved branch a step has an error of second order, which the next step corrects */
      const real answer = work->answer;
      real second[NT], again = R(0.0);
      work->kept = *at;
      *at = *after;
      if (newton(s, goal, w, bounded, mode, second)) {
        for (int i = 0; i < NT; ++i) again = hmpc_max(again, hmpc_abs(second[i] / target_scale[i]));
        for (int i = 0; i < NT; ++i) there[i] = at->v[i] + second[i];
        settle(s, there, goal, w, after);
        if (merit(after, weight) < from) {
          if (!(again < HMPC_TARGET_NEAR || again <= HMPC_TARGET_CONTRACTS * size)) sure = 0;
          before = again;
        }
      }
      *at = work->kept;
      work->answer = answer;
    }
    if (!(merit(after, weight) < from) && !(size < HMPC_TARGET_NEAR) && at->off > HMPC_TARGET_REACHED && mode == PLAIN) {
      mode = CURVED; /* the same point again */
      before = last;
      continue;
    }
    if (!(size < HMPC_TARGET_NEAR || size <= HMPC_TARGET_CONTRACTS * last)) sure = 0;
    /* where an output turns, the merit is flat, and rounding hides what the last steps gain */
    const int flat = mode == CURVED && size < HMPC_TARGET_NEAR && size <= HMPC_TARGET_CONTRACTS * last;
    for (int half = 0; half < HALVINGS && !flat && !(merit(after, weight) < from); ++half) {
      share *= R(0.5);
      for (int i = 0; i < NT; ++i) there[i] = at->v[i] + share * step[i];
      settle(s, there, goal, w, after);
      if (!(size < HMPC_TARGET_NEAR)) sure = 0;
    }
    if (!flat && !(merit(after, weight) < from)) { /* only rounding errors remain, or there is no progress */
      done = !spare && size < HMPC_TARGET_NEAR && at->lacks <= HMPC_TARGET_STILL;
      if (!spare) break;
      mode = LEANING;
      near = size < HMPC_TARGET_NEAR;
      work->good = *at;
      before = HMPC_HUGE;
      continue;
    }
    *at = *after;
    lacks[++n] = at->lacks;
    offs[n] = at->off;
    size = R(0.0);
    for (int i = 0; i < NT; ++i) size = hmpc_max(size, hmpc_abs((at->v[i] - v[i]) / target_scale[i]));
    if (size > HMPC_TARGET_AWAY) break;
    if (n < HMPC_TARGET_WITHIN) continue;
    if (at->lacks > hmpc_max(HMPC_TARGET_STALLED * lacks[n - HMPC_TARGET_WITHIN], HMPC_TARGET_STILL) &&
        merit(at, weight) >
            HMPC_TARGET_CREEPS * (weight * lacks[n - HMPC_TARGET_WITHIN] + offs[n - HMPC_TARGET_WITHIN]))
      break;
  }
  if (mode == LEANING && !done) { /* the set-point is reached, farther from the operating point */
    *at = work->good;
    done = 1;
    sure = sure && near;
  }
  for (int i = 0; i < HMPC_NY; ++i)
    if (q_y[i] > R(0.0)) off = hmpc_max(off, target_root[i] * hmpc_abs(at->y[i] - goal[i]));
  for (int i = 0; i < HMPC_NX; ++i) {
    const real far = (at->v[i] - x_rest[i]) / target_scale[i];
    apart += far * far;
  }
  for (int j = 0; j < HMPC_NU; ++j) {
    const real far = (at->v[HMPC_NZ + j] - u_rest[j]) / target_scale[HMPC_NZ + j];
    apart += far * far;
  }
  memcpy(found->v, at->v, sizeof found->v);
  memcpy(found->at.x, at->v, sizeof found->at.x);
  if (HMPC_NH > 0) memcpy(found->at.h, at->v + HMPC_NX, sizeof(real) * HMPC_NH);
  for (int j = 0; j < HMPC_NU; ++j) found->at.u[j] = hmpc_clip(at->v[HMPC_NZ + j], u_min[j], u_max[j]);
  memcpy(found->at.y, at->y, sizeof found->at.y);
  found->at.steady = done;
  found->at.reached = done && off <= HMPC_TARGET_REACHED;
  found->off = off;
  found->distance = apart;
  found->sure = done && sure;
  found->lost = done && off > HMPC_TARGET_REACHED && work->answer < target_flat[0];
}

/* Follows the steady states of set-points on the line to y, in parts in which Newton's method contracts. It starts at
   the steady state v under the present disturbances; with v = NULL at the operating point or the end of its run, with
   disturbances that grow from none. Returns whether y was reached; sure = 0: any steady states on the line are
   valid. */
static int follow(hmpc_state *s, const real *v, const real *y, const real *w, int sure, hmpc_descent *found) {
  hmpc_search *const work = &s->search;
  real begun[HMPC_NY], towards[HMPC_NY], at[NT], done = R(0.0), part = R(HMPC_TARGET_FOLLOWED);
  int arrived = 0;
  memcpy(at, v ? v : target_starts[HMPC_TARGET_NEAREST], sizeof at);
  memcpy(begun, target_begun, sizeof begun);
  memcpy(work->w, w, sizeof(real) * HMPC_NW);
  if (v) {
    look(s, v, y, w, &work->at);
    memcpy(begun, work->at.y, sizeof begun);
  }
  for (int tried = 0; tried < HMPC_TARGET_PARTS && part >= R(HMPC_TARGET_LEAST_PART) && !arrived; ++tried) {
    const real to = done + part < R(1.0) ? done + part : R(1.0);
    for (int j = 0; j < HMPC_ND && !v; ++j) work->d[j] = to * s->d[j];
    for (int j = 0; j < HMPC_NW && !v; ++j) work->w[j] = w_rest[j] + to * (w[j] - w_rest[j]);
    for (int i = 0; i < HMPC_NY; ++i) towards[i] = begun[i] + to * (y[i] - begun[i]);
    descend(s, at, towards, work->w, 1, sure, PLAIN, found);
    if (found->at.steady && (found->sure || !sure)) {
      arrived = to >= R(1.0);
      memcpy(at, found->v, sizeof at);
      done = to;
      part *= R(2.0);
    } else {
      part *= R(0.25);
    }
  }
  memcpy(work->d, s->d, sizeof(real) * HMPC_ND);
  return arrived;
}

/* Of n descents, the one whose steady state is closest to the set-point; of equally close ones, that closest to the
   operating point. Sure ones have priority. -1 if none ended at a steady state. */
static int best(const hmpc_search *work, int n) {
  int some = 0, chosen = -1;
  real least = HMPC_HUGE;
  for (int k = 0; k < n; ++k) some |= work->tried[k].sure;
  for (int k = 0; k < n; ++k)
    if (work->tried[k].at.steady && (work->tried[k].sure || !some)) least = hmpc_min(least, work->tried[k].off);
  least = hmpc_max(least * (R(1.0) + HMPC_TARGET_EQUAL), HMPC_TARGET_REACHED);
  for (int k = 0; k < n; ++k) {
    const hmpc_descent *const one = &work->tried[k];
    if (!one->at.steady || !(one->sure || !some) || !(one->off <= least)) continue;
    if (chosen < 0 || one->distance < work->tried[chosen].distance) chosen = k;
  }
  return chosen;
}

/* The search of hmpc_steady_state; recent: start is the result of a search for the same set-point, and not long ago it
   was searched from several starts. Returns whether it was now. */
static int search(hmpc_state *s, const hmpc_real *y, const hmpc_real *w, const hmpc_steady *start, int wide,
                  int recent, hmpc_steady *found) {
  hmpc_search *const work = &s->search;
  hmpc_descent trial;
  const int known = start && start->steady ? 1 : 0;
  real first[NT];
  int n = 0, turns = 0;
  /* an input within its limits beyond reach of the set-point: there an output turns */
  for (int j = 0; j < HMPC_NU && known; ++j) {
    const real near = HMPC_TARGET_NEAR * target_scale[HMPC_NZ + j];
    turns |= !start->reached && start->u[j] > u_min[j] + near && start->u[j] < u_max[j] - near;
  }
  wide = wide && (known || !recent);
  memcpy(work->d, s->d, sizeof(real) * HMPC_ND);
  memcpy(first, target_starts[0], sizeof first);
  if (known) place(start, first);
  if (known || !wide) {
    descend(s, first, y, w, 1, 0, turns ? CURVED : PLAIN, &work->tried[0]);
    n = 1;
    if (work->tried[0].lost && known) {
      descend(s, target_starts[0], y, w, 1, 0, PLAIN, &trial);
      if (trial.at.steady && trial.off < work->tried[0].off) work->tried[0] = trial;
    }
    *found = work->tried[0].at;
    if (work->tried[0].sure || (found->steady && (recent || !wide))) return 0;
  }
  if (wide) {
    for (int own = 0; own <= known; ++own) {
      if (!follow(s, own ? first : NULL, y, w, 1, &work->tried[n])) continue;
      if (!work->tried[n].lost) {
        *found = work->tried[n].at;
        return wide;
      }
      ++n;
    }
    for (int k = 0; k < HMPC_TARGET_STARTS; ++k) descend(s, target_starts[k], y, w, 1, 0, PLAIN, &work->tried[n++]);
    const int chosen = best(work, n);
    if (chosen >= 0 || follow(s, known ? first : NULL, y, w, 0, &trial)) {
      *found = chosen >= 0 ? work->tried[chosen].at : trial.at;
      return wide;
    }
  }
  *found = work->tried[0].at;
  for (int k = 0; k <= (wide && known); ++k) {
    descend(s, k ? target_starts[0] : first, y, w, 0, 0, PLAIN, &trial);
    if (trial.at.steady) {
      *found = trial.at;
      return wide;
    }
  }
  return wide;
}

/* Steady state for outputs y; weighted outputs are finite. The search has the order of Targets.at in Python. If no
   steady state keeps the bounds of states and outputs, it is searched without them. */
void hmpc_steady_state(hmpc_state *s, const hmpc_real *y, const hmpc_real *w, const hmpc_steady *start, int wide,
                       hmpc_steady *found) {
  int again = start != NULL, age = HMPC_TARGET_WAIT;
  for (int i = 0; i < HMPC_NY && again; ++i)
    if (q_y[i] > R(0.0)) again = y[i] <= start->goal[i] && y[i] >= start->goal[i];
  if (again && start->age + 1 < age) age = start->age + 1;
  if (search(s, y, w, start, wide, age < HMPC_TARGET_WAIT, found)) age = 0;
  memcpy(found->goal, y, sizeof found->goal);
  found->age = age;
}


static void set_target(hmpc_target *to, int k, const real *x, const real *u, const real *y) {
  memcpy(to->x[k], x, sizeof to->x[k]);
  memcpy(to->y[k], y, sizeof to->y[k]);
  if (k < HMPC_N) memcpy(to->u[k], u, sizeof to->u[k]);
}

/* Without measured disturbances, w has one empty row. */
#define W_OF(period) (HMPC_NW > 0 ? (period) : 0)

/* References of states, inputs and outputs over the horizon, under the measured disturbances s->linear.w: a steady
   state for each change of the preview. If it changes more than HMPC_TARGET_KNOTS times, steady states of that many
   rows are interpolated. */
void hmpc_aim(hmpc_state *s, const hmpc_goal *goal) {
  hmpc_target *const to = &s->target;
  const real(*const w)[HMPC_DIM(HMPC_NW)] = s->linear.w;
  const int rows = goal && goal->y ? goal->rows : 1;
  const real *const given = goal && goal->y ? goal->y : y_rest;
  hmpc_steady start = s->steady, found;
  real x[HMPC_TARGET_KNOTS][HMPC_NX], u[HMPC_TARGET_KNOTS][HMPC_NU], off[HMPC_TARGET_KNOTS][HMPC_NY];
  int knots[HMPC_TARGET_KNOTS + 1] = {0}, count = 1, wide = 1, fine = hmpc_all_finite(s->d, HMPC_ND);
  for (int k = 0; k <= HMPC_N; ++k) {
    const int last = k < HMPC_N ? k : HMPC_N - 1, other = last > 0 ? last - 1 : 0;
    const real *const row = given + (k < rows ? k : rows - 1) * HMPC_NY;
    int changes = k > 0 && k < HMPC_N && HMPC_NW > 0 && memcmp(w[W_OF(last)], w[W_OF(other)], sizeof(real) * HMPC_NW) != 0;
    for (int i = 0; i < HMPC_NY; ++i) {
      to->y[k][i] = q_y[i] > R(0.0) ? row[i] : R(0.0);
      fine &= hmpc_finite(to->y[k][i]);
      if (k > 0) changes |= to->y[k][i] < to->y[k - 1][i] || to->y[k][i] > to->y[k - 1][i];
    }
    fine &= hmpc_all_finite(w[W_OF(last)], HMPC_NW);
    if (changes && count <= HMPC_TARGET_KNOTS) knots[count < HMPC_TARGET_KNOTS ? count : HMPC_TARGET_KNOTS] = k;
    if (changes && count <= HMPC_TARGET_KNOTS) ++count;
  }
  if (!fine) {
    for (int k = 0; k <= HMPC_N; ++k)
      for (int i = 0; i < HMPC_NX; ++i) to->x[k][i] = R(NAN);
    for (int k = 0; k < HMPC_N; ++k) memcpy(to->u[k], u_rest, sizeof to->u[k]);
    return;
  }
  const int often = count > HMPC_TARGET_KNOTS;
  if (often) count = HMPC_TARGET_KNOTS;
  for (int n = 0; n < count; ++n) {
    const int k = knots[n] = often ? target_knots[n] : knots[n];
    hmpc_steady_state(s, to->y[k], w[W_OF(k < HMPC_N ? k : HMPC_N - 1)], &start, wide, &found);
    wide = found.steady; /* without a steady state, the rest of the horizon is searched less widely */
    if (found.steady) start = found;
    if (n == 0) s->aimed = found;
    for (int i = 0; i < HMPC_NX; ++i) x[n][i] = found.steady ? found.x[i] : x_rest[i];
    for (int i = 0; i < HMPC_NU; ++i) u[n][i] = found.steady ? found.u[i] : hmpc_clip(u_rest[i], u_min[i], u_max[i]);
    for (int i = 0; i < HMPC_NY; ++i)
      off[n][i] = q_y[i] > R(0.0) && found.steady && !found.reached ? found.y[i] - to->y[k][i] : R(0.0);
  }
  for (int k = 0, n = 0; k <= HMPC_N; ++k) {
    real x_k[HMPC_NX], u_k[HMPC_NU], y_k[HMPC_NY];
    while (n + 1 < count && knots[n + 1] <= k) ++n;
    const int next = often && n + 1 < count ? n + 1 : n;
    const real share = next > n ? R(k - knots[n]) / R(knots[next] - knots[n]) : R(0.0);
    for (int i = 0; i < HMPC_NX; ++i) x_k[i] = x[n][i] + share * (x[next][i] - x[n][i]);
    for (int i = 0; i < HMPC_NU; ++i) u_k[i] = u[n][i] + share * (u[next][i] - u[n][i]);
    for (int i = 0; i < HMPC_NY; ++i) y_k[i] = to->y[k][i] + (off[n][i] + share * (off[next][i] - off[n][i]));
    set_target(to, k, x_k, u_k, y_k);
  }
}

#endif
