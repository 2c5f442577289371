/* Elementary functions: identical results on every processor with IEEE arithmetic if the compiler contracts no
   multiply-add (-ffp-contract=off). Source of the coefficients: Moshier, Cephes. */
#ifndef HMPC_MATH_H
#define HMPC_MATH_H

#include <math.h> /* fabs, sqrt, isfinite, and functions of a prior that are not below */
#include <stdint.h>
#include <string.h>
#include "hmpc.h"

typedef hmpc_real real;
#define R(value) ((real)(value))

#ifdef HMPC_FLOAT
#define HMPC_LIBM(name) name##f
#define HMPC_EXP_MOST R(88.0)
#define HMPC_TANH_MOST R(9.5)
#define HMPC_ANGLE_MOST R(1e4)
#else
#define HMPC_LIBM(name) name
#define HMPC_EXP_MOST R(708.0)
#define HMPC_TANH_MOST R(19.5)
#define HMPC_ANGLE_MOST R(1e8)
#endif

static inline real hmpc_abs(real x) { return HMPC_LIBM(fabs)(x); }
static inline real hmpc_sqrt(real x) { return HMPC_LIBM(sqrt)(x); }
static inline real hmpc_max(real a, real b) { return a > b ? a : b; }
static inline real hmpc_min(real a, real b) { return a < b ? a : b; }
static inline int hmpc_finite(real x) { return hmpc_abs(x) <= HMPC_HUGE; }
static inline int hmpc_all_finite(const real *v, int n) {
  int fine = 1;
  for (int i = 0; i < n; ++i) fine &= hmpc_finite(v[i]);
  return fine;
}
static inline real hmpc_clip(real x, real low, real high) { return x < low ? low : x > high ? high : x; }

static inline real hmpc_true(real x) { return x < R(0.0) || x > R(0.0) ? R(1.0) : R(0.0); }
static inline real hmpc_same(real a, real b) { return a <= b && a >= b ? R(1.0) : R(0.0); }
static inline real hmpc_if(real condition, real x) { return condition < R(0.0) || condition > R(0.0) ? x : R(0.0); }
static inline real hmpc_sign(real x) { return x > R(0.0) ? R(1.0) : x < R(0.0) ? R(-1.0) : x; }

/* tanh without a branch, so that loops become vector code: a quotient p / q at x / 32, whose argument is doubled five
   times by tanh 2a = 2 p q / (p p + q q). */
static inline real hmpc_tanh(real x) {
  const real most = HMPC_TANH_MOST, y = (x > most ? most : x < -most ? -most : x) * R(0.03125), s = y * y;
  real q = ((s * R(0.00020643827072581487) + R(0.023288647825489308)) * s + R(0.46149035758330637)) * s + R(1.0);
  real p = ((s * R(-0.00019908889888990266) + R(-0.02049678586110715)) * s + R(-0.3333333333333332)) * s;
  p = y * (q + p);
  for (int i = 0; i < 5; ++i) {
    const real product = p * q;
    q = p * p + q * q;
    p = product + product;
  }
  return p / q;
}

static inline real hmpc_power_of_two(int k) { /* k: an exponent of normal numbers */
#ifdef HMPC_FLOAT
  const uint32_t bits = (uint32_t)(k + 127) << 23;
#else
  const uint64_t bits = (uint64_t)(k + 1023) << 52;
#endif
  real value;
  memcpy(&value, &bits, sizeof value);
  return value;
}

static inline real hmpc_exp(real x) {
  if (!(x <= HMPC_EXP_MOST)) return x > R(0.0) ? R(INFINITY) : x;
  if (x < -HMPC_EXP_MOST) return R(0.0);
  const real scaled = x * R(1.4426950408889634074);
  const int k = (int)(scaled < R(0.0) ? scaled - R(0.5) : scaled + R(0.5));
  const real n = R(k), r = (x - n * R(6.93145751953125e-1)) - n * R(1.42860682030941723212e-6), s = r * r;
  const real p = r * ((R(1.26177193074810590878e-4) * s + R(3.02994407707441961300e-2)) * s + R(1.0));
  const real q =
      ((R(3.00198505138664455042e-6) * s + R(2.52448340349684104192e-3)) * s + R(2.27265548208155028766e-1)) * s +
      R(2.0);
  return (R(1.0) + R(2.0) * (p / (q - p))) * hmpc_power_of_two(k);
}

static inline real hmpc_log(real x) {
  if (!(x > R(0.0)) || x > HMPC_HUGE) return x == R(0.0) ? -R(INFINITY) : x > R(0.0) ? x : R(NAN);
  int k = 0;
  while (x > R(1.4142135623730951)) { x *= R(0.5); ++k; }
  while (x < R(0.7071067811865475)) { x *= R(2.0); --k; }
  const real f = x - R(1.0), t = f / (R(2.0) + f), s = t * t;
  real sum = R(0.0);
  for (int i = 23; i > 1; i -= 2) sum = (sum + R(1.0) / R(i)) * s;
  return R(k) * R(1.42860682030941723212e-6) + (R(2.0) * t * (R(1.0) + sum) + R(k) * R(6.93145751953125e-1));
}

/* Sine for quarter = 0, cosine for quarter = 2; NaN for angles too large to be reduced to a period. */
static inline real hmpc_turned(real x, int quarter) {
  const real size = hmpc_abs(x);
  if (!(size <= HMPC_ANGLE_MOST)) return R(NAN);
  int j = (int)(size * R(1.27323954473516268615));
  j += j & 1;
  const real y = R(j);
  const real t = ((size - y * R(7.85398125648498535156e-1)) - y * R(3.77489470793079817668e-8)) -
                 y * R(2.69515142907905952645e-15);
  const real s = t * t;
  const int octant = ((quarter ? j : (x < R(0.0) ? j + 4 : j)) + quarter) & 7;
  const real sine =
      t + t * s * (((((R(1.58962301576546568060e-10) * s - R(2.50507477628578072866e-8)) * s +
                      R(2.75573136213857245213e-6)) * s - R(1.98412698295895385996e-4)) * s +
                    R(8.33333333332211858878e-3)) * s - R(1.66666666666666307295e-1));
  const real cosine =
      R(1.0) - R(0.5) * s + s * s * (((((R(-1.13585365213876817300e-11) * s + R(2.08757008419747316778e-9)) * s -
                                        R(2.75573141792967388112e-7)) * s + R(2.48015872888517045348e-5)) * s -
                                      R(1.38888888888730564116e-3)) * s + R(4.16666666666665929218e-2));
  const real value = octant & 2 ? cosine : sine;
  return octant & 4 ? -value : value;
}
static inline real hmpc_sin(real x) { return hmpc_turned(x, 0); }
static inline real hmpc_cos(real x) { return hmpc_turned(x, 2); }

/* Sum of products in eight partial sums: vector code with the same order of additions on every processor. */
static inline real hmpc_dot(const real *a, const real *b, int n) {
  real part[8] = {R(0.0)}, rest = R(0.0);
  const int whole = n / 8 * 8;
  for (int i = 0; i < whole; i += 8)
    for (int c = 0; c < 8; ++c) part[c] += a[i + c] * b[i + c];
  for (int i = whole; i < n; ++i) rest += a[i] * b[i];
  return ((part[0] + part[4]) + (part[2] + part[6])) + ((part[1] + part[5]) + (part[3] + part[7])) + rest;
}

static inline void hmpc_add(real *to, real factor, const real *from, int n) {
  for (int i = 0; i < n; ++i) to[i] += factor * from[i];
}

/* Layer of a network: y = weight x; rows of weight have n entries. */
static inline void hmpc_layer(const real *weight, int rows, int n, const real *x, real *y) {
  for (int i = 0; i < rows; ++i) y[i] = hmpc_dot(weight + i * n, x, n);
}

/* Derivatives of y (rows of length width): weight times the derivatives of x. Of these, the nonzero entries (few,
   column) are multiplied singly, and the full rows as a whole. */
static inline void hmpc_layer_slope(const real *weight, int rows, int n, const real *by, int width, const int *few,
                                    const int *column, int fews, const int *full, int fulls, real *to) {
  for (int i = 0; i < rows; ++i) {
    real *const row = to + i * width;
    memset(row, 0, sizeof(real) * (size_t)width);
    for (int e = 0; e < fews; ++e) row[column[e]] += weight[i * n + few[e]] * by[few[e] * width + column[e]];
    for (int e = 0; e < fulls; ++e) hmpc_add(row, weight[i * n + full[e]], by + full[e] * width, width);
  }
}

/* Adds factor[e] times the derivatives of product from[e] to row at[e]; column c of a product is column onto[c] of the
   row. */
static inline void hmpc_layer_pass(const int *at, const int *from, const real *factor, int count, const real *through,
                                   int width, const int *onto, int n, real *to, int stride) {
  for (int e = 0; e < count; ++e) {
    const real *const row = through + from[e] * width;
    real *const sum = to + at[e] * stride;
    for (int c = 0; c < n; ++c) sum[onto[c]] += factor[e] * row[c];
  }
}

enum { HMPC_ROWS = 2, HMPC_COLUMNS = 8 }; /* size of the block of a product that stays in registers */

/* c = a b for the first columns, whose number is rounded up to a multiple of eight. Rows of a have length entries, rows
   of b and c have stride entries. Callers pass constants for all sizes except columns, so that it becomes vector
   code. */
static inline void hmpc_multiply(const real *restrict a, int length, const real *restrict b, real *restrict c, int rows,
                                 int inner, int columns, int stride) {
  for (int j = 0; j < columns; j += HMPC_COLUMNS) {
    int i = 0;
    for (; i + HMPC_ROWS <= rows; i += HMPC_ROWS) {
      real sum[HMPC_ROWS][HMPC_COLUMNS];
      for (int p = 0; p < HMPC_ROWS; ++p)
        for (int q = 0; q < HMPC_COLUMNS; ++q) sum[p][q] = R(0.0);
      for (int l = 0; l < inner; ++l) {
        const real *const row = b + l * stride + j;
        for (int p = 0; p < HMPC_ROWS; ++p) {
          const real factor = a[(i + p) * length + l];
          for (int q = 0; q < HMPC_COLUMNS; ++q) sum[p][q] += factor * row[q];
        }
      }
      for (int p = 0; p < HMPC_ROWS; ++p)
        for (int q = 0; q < HMPC_COLUMNS; ++q) c[(i + p) * stride + j + q] = sum[p][q];
    }
    if (rows % HMPC_ROWS) { /* last row of an odd number */
      real sum[HMPC_COLUMNS];
      for (int q = 0; q < HMPC_COLUMNS; ++q) sum[q] = R(0.0);
      for (int l = 0; l < inner; ++l) {
        const real factor = a[i * length + l];
        for (int q = 0; q < HMPC_COLUMNS; ++q) sum[q] += factor * b[l * stride + j + q];
      }
      for (int q = 0; q < HMPC_COLUMNS; ++q) c[i * stride + j + q] = sum[q];
    }
  }
}

#endif
