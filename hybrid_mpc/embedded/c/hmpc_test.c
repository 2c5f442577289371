/* Replays hmpc_vectors.h, samples and decisions of the Python controller, and compares inputs and estimates.
   Exit status 0 if all agree. */
#include <stdio.h>
#include "hmpc_math.h"
#include "hmpc_vectors.h"

static hmpc_state state; /* 8-byte numbers in the computer's own byte order; the library itself uses none */

#if HMPC_MONITOR
/* Largest relative deviation of the monitor's values from those of Python. */
static real reading_off(int k) {
  const hmpc_monitor *const m = &state.monitor;
  const real *const wanted = vector_reading[k];
  real largest = R(0.0);
  for (int i = 0; i < 1 + HMPC_CHANNELS; ++i) {
    const real found = i == 0 ? R(m->alarm) : m->value[i - 1];
    const int known = hmpc_finite(found);
    if (known != hmpc_finite(wanted[i])) return R(INFINITY);
    if (known) largest = hmpc_max(largest, hmpc_abs(found - wanted[i]) / vector_reading_size[i]);
  }
  return largest;
}
#endif

int main(void) {
#if HMPC_OUTPUT_COST
  const hmpc_goal goal = {.y = vector_goal[0], .rows = 1};
#else
  const hmpc_goal goal = {.x = vector_goal[0], .rows = 1};
#endif
  real largest = R(0.0);
  hmpc_clear(&state);
  for (int k = 0; k < VECTORS; ++k) {
#if HMPC_MODES > 0
    if (k == 0) {
      hmpc_estimate_start(&state, vector_y[k], vector_w[k]);
    } else {
      hmpc_estimate_update(&state, vector_y[k], state.u, vector_w[k]);
    }
    for (int i = 0; i < HMPC_NX; ++i)
      largest = hmpc_max(largest, hmpc_abs(state.x[i] - vector_x[k][i]) / vector_x_size[i]);
#else
    memcpy(state.x, vector_x[k], sizeof state.x);
    if (HMPC_NH > 0) memcpy(state.h, vector_h[k], sizeof state.h);
    if (HMPC_NW > 0) memcpy(state.w, vector_w[k], sizeof state.w);
#endif
#if HMPC_MONITOR
    if (k == 0) hmpc_watch_begin(&state);
    hmpc_watch(&state, vector_y[k], state.u);
    largest = hmpc_max(largest, reading_off(k));
#endif
    if (k == 0) hmpc_run_free(&state, state.u, 1);
    hmpc_decide(&state, &goal, (const real *)0);
    for (int i = 0; i < HMPC_NU; ++i) {
      largest = hmpc_max(largest, hmpc_abs(state.u[i] - vector_u[k][i]) / vector_u_size[i]);
      printf("%.17g%c", (double)state.u[i], i + 1 < HMPC_NU ? ' ' : '\n');
    }
    hmpc_prepare(&state, &goal);
  }
  fprintf(stderr, "%s: %d periods, largest deviation %.3g, at most %.3g expected; the state has %lu bytes\n",
          largest <= VECTOR_TOLERANCE ? "PASSED" : "FAILED", VECTORS, (double)largest, (double)VECTOR_TOLERANCE,
          (unsigned long)sizeof state);
  return largest <= VECTOR_TOLERANCE ? 0 : 1;
}
