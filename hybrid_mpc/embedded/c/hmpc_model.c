/* One period of the model and its Jacobian: scalar code of the prior, and a GRU, whose Jacobian consists of constant
   matrices with scaled rows. */
#include "hmpc_math.h"
#include "hmpc_expressions.h"

#if HMPC_UNITS > 0
typedef struct {
  real next[HMPC_UNITS];
  real g[HMPC_UNITS], a[HMPC_UNITS], b[HMPC_UNITS], br[HMPC_UNITS], keep[HMPC_UNITS]; /* factors of the rows */
} cell;

/* y = bias + columns x, eight sums at a time. */
static inline void affine(const real (*columns)[HMPC_GATES], const real *bias, const real *x, int n, real *y) {
  for (int i = 0; i < HMPC_GATES; i += 8) {
    real sum[8];
    for (int c = 0; c < 8; ++c) sum[c] = bias[i + c];
    for (int j = 0; j < n; ++j)
      for (int c = 0; c < 8; ++c) sum[c] += columns[j][i + c] * x[j];
    for (int c = 0; c < 8; ++c) y[i + c] = sum[c];
  }
}

static void gru(const real *seen, const real *h, cell *c) {
  real from_input[HMPC_GATES], from_hidden[HMPC_GATES], sums[4][HMPC_UNITS];
  affine(input_columns, input_bias, seen, HMPC_FEATURES, from_input);
  affine(hidden_columns, hidden_bias, h, HMPC_UNITS, from_hidden);
  for (int k = 0; k < 2; ++k)
    for (int i = 0; i < HMPC_UNITS; ++i)
      sums[k][i] = R(0.5) * (from_input[k * HMPC_UNITS + i] + from_hidden[k * HMPC_UNITS + i]);
  for (int i = 0; i < HMPC_UNITS; ++i) {
    sums[2][i] = from_input[2 * HMPC_UNITS + i];
    sums[3][i] = from_hidden[2 * HMPC_UNITS + i];
  }
  for (int i = 0; i < HMPC_UNITS; ++i) sums[0][i] = R(0.5) + R(0.5) * hmpc_tanh(sums[0][i]);
  for (int i = 0; i < HMPC_UNITS; ++i) sums[1][i] = R(0.5) + R(0.5) * hmpc_tanh(sums[1][i]);
  for (int i = 0; i < HMPC_UNITS; ++i) sums[2][i] = hmpc_tanh(sums[2][i] + sums[0][i] * sums[3][i]);
  for (int i = 0; i < HMPC_UNITS; ++i) {
    const real r = sums[0][i], z = sums[1][i], n = sums[2][i], q = sums[3][i];
    c->next[i] = n + z * (h[i] - n);
    c->a[i] = (h[i] - n) * z * (R(1.0) - z);
    c->b[i] = (R(1.0) - n * n) * (R(1.0) - z);
    c->g[i] = c->b[i] * q * r * (R(1.0) - r);
    c->br[i] = c->b[i] * r;
    c->keep[i] = z;
  }
}
#endif

#if HMPC_UNITS > 0
/* Linear combinations of the new hidden state that the scalar code uses. */
static void reduce(const real *units, real *out) {
  for (int k = 0; k < HMPC_HEAD; ++k) out[k] = hmpc_dot(head[k], units, HMPC_UNITS);
}
#endif

void hmpc_model(const real *z, const real *u, const real *w, real *z_next) {
#if HMPC_UNITS > 0
  cell c;
  real seen[HMPC_FEATURES], out[HMPC_DIM(HMPC_HEAD)];
  model_before(z, u, w, seen);
  gru(seen, z + HMPC_HIDDEN, &c);
  reduce(c.next, out);
  model_after(z, u, w, out, z_next);
  memcpy(z_next + HMPC_HIDDEN_NEXT, c.next, sizeof c.next);
#elif HMPC_PRODUCTS > 0
  real m[HMPC_PRODUCTS];
  layers(z, u, w, m);
  model_after(z, u, w, m, z_next);
#else
  model_after(z, u, w, (const real *)0, z_next);
#endif
}

void hmpc_model_slope(const real *z, const real *u, const real *w, real *z_next, real *slope) {
#if HMPC_UNITS > 0
  cell c;
  real seen[HMPC_FEATURES], by_v[HMPC_DIM(HMPC_SEEN_SLOPES)], out[HMPC_DIM(HMPC_HEAD)];
  real by_out[HMPC_DIM(HMPC_CORRECTED)][HMPC_DIM(HMPC_HEAD)], through[HMPC_DIM(HMPC_HEAD)][HMPC_LJ];
  model_before_slope(z, u, w, seen, by_v);
  gru(seen, z + HMPC_HIDDEN, &c);
  memset(through, 0, sizeof through);
  for (int i = 0; i < HMPC_UNITS; ++i) {
    real *const row = slope + (HMPC_HIDDEN_NEXT + i) * HMPC_LJ, *const by_h = row + HMPC_HIDDEN;
    const real *const reset = hidden_weight[i], *const update = hidden_weight[HMPC_UNITS + i],
                     *const candidate = hidden_weight[2 * HMPC_UNITS + i];
    const real g = c.g[i], a = c.a[i], br = c.br[i];
    memset(row, 0, sizeof(real) * HMPC_LJ);
    for (int j = 0; j < HMPC_UNITS; ++j) by_h[j] = g * reset[j] + a * update[j] + br * candidate[j];
    by_h[i] += c.keep[i];
  }
  for (int i = 0; i < HMPC_UNITS; ++i) {
    real *const row = slope + (HMPC_HIDDEN_NEXT + i) * HMPC_LJ;
    for (int k = 0; k < HMPC_SEEN_SLOPES; ++k) {
      const int f = seen_row[k];
      row[seen_column[k]] += (c.g[i] * input_weight[i][f] + c.a[i] * input_weight[HMPC_UNITS + i][f] +
                              c.b[i] * input_weight[2 * HMPC_UNITS + i][f]) * by_v[k];
    }
  }
  for (int i = 0; i < HMPC_UNITS; ++i)
    for (int k = 0; k < HMPC_HEAD; ++k)
      hmpc_add(through[k], head[k][i], slope + (HMPC_HIDDEN_NEXT + i) * HMPC_LJ, HMPC_LJ);
  reduce(c.next, out);
  model_after_slope(z, u, w, out, z_next, slope, &by_out[0][0]);
  memcpy(z_next + HMPC_HIDDEN_NEXT, c.next, sizeof c.next);
  for (int k = 0; k < HMPC_CORRECTED; ++k)
    for (int i = 0; i < HMPC_HEAD; ++i) hmpc_add(slope + corrected[k] * HMPC_LJ, by_out[k][i], through[i], HMPC_LJ);
#elif HMPC_PRODUCTS > 0
  real m[HMPC_PRODUCTS], through[HMPC_DIM(HMPC_THROUGH)], by_out[HMPC_DIM(HMPC_PASSED)];
  layers_slope(z, u, w, m, through);
  model_after_slope(z, u, w, m, z_next, slope, by_out);
  layers_after(by_out, through, slope);
#else
  model_after_slope(z, u, w, (const real *)0, z_next, slope, (real *)0);
#endif
}

#if HMPC_RATES
void hmpc_rates(const real *z, const real *u, const real *w, real *xdot) {
#if HMPC_RATE_HEAD > 0
  cell c;
  real seen[HMPC_FEATURES], out[HMPC_RATE_HEAD];
  rates_before(z, u, w, seen);
  gru(seen, z + HMPC_HIDDEN, &c);
  for (int k = 0; k < HMPC_RATE_HEAD; ++k) out[k] = hmpc_dot(rate_head[k], c.next, HMPC_UNITS);
  rates_after(z, u, w, out, xdot);
#elif HMPC_RATE_PRODUCTS > 0
  real m[HMPC_RATE_PRODUCTS];
  rate_layers(z, u, w, m);
  rates_after(z, u, w, m, xdot);
#else
  rates_after(z, u, w, (const real *)0, xdot);
#endif
}
#endif
