"""How long a whole period of the exported C takes: three switching filters, decision, energy monitor, preparation.

    python benchmarks/whole_period.py [--z 16 32] [--single] [--out FILE.json]

The golf robot with a GRU of random weights, N = 50, |u| bounded, on the model itself with noise in its sensor, turning
to and fro; the guard's monitor (window 0.2 s, free runs, test for freezing, detector). Processor time of the thread, so
that what else the machine does takes none of it but caches; 3,000 periods, median and 99th percentile [ms].
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import numpy as np
from parts import arguments, deployed, hybrid_step, problem, report
from steps import SIGMA_X

from hybrid_mpc import ChannelLimit, WatchLimits, make_estimator, make_monitor
from hybrid_mpc.embedded.export import write_controller
from hybrid_mpc.embedded.generate import SOURCES
from scenarios.golf_robot import scenario

PARTS = ("estimate", "decision", "monitor", "preparation")
COMPILED = ("-O3 -march=native", "-O3")
BENCH = """
#include <stdio.h>
#include <time.h>
#include "hmpc_math.h"
static hmpc_state s;
static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return 1e3 * (double)t.tv_sec + 1e-6 * (double)t.tv_nsec;
}
int main(void) {
  hmpc_real z[HMPC_LZ] = {0}, next[HMPC_LZ] = {0}, x[2][HMPC_NX] = {{R(0.6)}, {R(-0.3)}}, y[HMPC_NY], held[HMPC_NU];
  uint32_t seed = 1;
  for (int k = 0; k < 3000; ++k) {
    const hmpc_goal goal = {.x = x[k / 75 % 2], .rows = 1};
    seed = seed * 1664525u + 1013904223u;
    y[0] = z[0] + R(1e-3) * (R(seed >> 8) / R(16777216.0) - R(0.5));
    if (k == 0) {
      hmpc_start(&s, y, (hmpc_real *)0, (hmpc_real *)0, &goal);
    } else {
      memcpy(held, s.u, sizeof held);
      const double begin = now();
      hmpc_estimate_update(&s, y, held, (hmpc_real *)0);
      const double estimated = now();
      hmpc_decide(&s, &goal, held);
      const double decided = now();
      hmpc_watch(&s, y, held);
      const double watched = now();
      hmpc_prepare(&s, &goal);
      const double end = now();
      printf("%.6f %.6f %.6f %.6f\\n", estimated - begin, decided - estimated, watched - decided, end - watched);
    }
    hmpc_model(z, s.u, s.w, next);
    memcpy(z, next, sizeof z);
  }
  fprintf(stderr, "%d %d\\n", (int)s.monitor.validity, (int)s.status);
  return 0;
}
"""


def watched_controller(folder: Path, z: int, single: bool, n: int = 50, **limits) -> None:
    """The C of the golf robot with ``z`` random units, its observer and the guard's monitor."""
    model, ocp = deployed(hybrid_step(z)), problem(n, **limits)
    estimator = make_estimator(model, scenario, np.array(SIGMA_X), ocp)
    scale = (0.01, 0.01, 0.01, 0.01)
    force = ChannelLimit("force of phi", "N m", 0, 20.0, 10.0, scale, 2.0)
    power = ChannelLimit("power of the free run", "W", 1, 4.0, 2.0, scale)
    limits = WatchLimits("energy", model.dt, (force, power), (4.5e-3,), (0,), rest_speed=(0.05,))
    monitor = make_monitor(model, limits)
    write_controller(
        folder, model, ocp, estimator=estimator, safe_input=model.u0, single=single, monitor=monitor
    )


def main() -> None:
    """Time and print."""
    parser = arguments(__doc__)
    parser.add_argument("--z", type=int, nargs="+", default=[16, 32], help="hidden units")
    parser.add_argument("--single", action="store_true", help="float in place of double")
    given = parser.parse_args()
    rows = []
    for z in given.z:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            watched_controller(folder, z, given.single)
            (folder / "bench.c").write_text(BENCH)
            for options in COMPILED:
                words = ["-std=gnu11", "-ffp-contract=off", *options.split(), *SOURCES, "bench.c", "-lm"]
                subprocess.run(["cc", *words, "-o", "bench"], cwd=folder, check=True)
                told = subprocess.run([folder / "bench"], capture_output=True, text=True, check=True)
                if told.stderr.split() != ["0", "1"]:
                    raise SystemExit(f"the loop did not end with a valid reading and a solve: {told.stderr}")
                times = np.array(told.stdout.split(), dtype=float).reshape(-1, len(PARTS))
                period = times.sum(axis=1)
                row = {"z": z, "numbers": "float" if given.single else "double", "compiled": options}
                row |= {part: float(np.median(column)) for part, column in zip(PARTS, times.T, strict=True)}
                rows.append(
                    row | {"period": float(np.median(period)), "p99": float(np.quantile(period, 0.99))}
                )
    report(rows, given.out)


if __name__ == "__main__":
    main()
