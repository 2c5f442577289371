"""The C main program that tests a generated function."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

_TEST = """/* Evaluates {name} at {samples} samples and compares with what CasADi gave.
   cc {name}.c {name}_test.c -lm */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include "{name}.h"

#ifndef TOLERANCE
#define TOLERANCE 1e-9 /* of the largest output */
#endif

static const double inputs[{samples}][{n_in}] = {{
{inputs}
}};
static const double expected[{samples}][{n_out}] = {{
{expected}
}};

int main(void) {{
  casadi_int n_arg, n_res, n_iw, n_w, first_in[] = {{{first_in}}}, first_out[] = {{{first_out}}}, i, k;
  const casadi_real **arg;
  casadi_real **res, *w, results[{n_out}];
  casadi_int *iw;
  int wrong = 0;
  if ({name}_work(&n_arg, &n_res, &n_iw, &n_w)) return 2;
  arg = (const casadi_real **)calloc((size_t)n_arg + 1, sizeof(*arg));
  res = (casadi_real **)calloc((size_t)n_res + 1, sizeof(*res));
  iw = (casadi_int *)calloc((size_t)n_iw + 1, sizeof(*iw));
  w = (casadi_real *)calloc((size_t)n_w + 1, sizeof(*w));
  if (!arg || !res || !iw || !w) return 2;
  for (k = 0; k < {samples}; ++k) {{
    double size = 1e-300;
    for (i = 0; i < {name}_n_in(); ++i) arg[i] = inputs[k] + first_in[i];
    for (i = 0; i < {name}_n_out(); ++i) res[i] = results + first_out[i];
    if ({name}(arg, res, iw, w, 0)) return 2;
    for (i = 0; i < {used}; ++i)
      if (isfinite(expected[k][i])) size = fmax(size, fabs(expected[k][i]));
    for (i = 0; i < {used}; ++i) {{
      printf("%.17g ", results[i]);
      if (isfinite(expected[k][i]) ? !(fabs(results[i] - expected[k][i]) <= TOLERANCE * size) : isfinite(results[i]))
        wrong = 1;
    }}
    printf("\\n");
  }}
  fprintf(stderr, wrong ? "{name}: differs\\n" : "{name}: all agree\\n");
  free(arg); free(res); free(iw); free(w);
  return wrong;
}}
"""


def main_program(f: ca.Function, points: Sequence[Sequence[np.ndarray | float]]) -> str:
    """C text of a main program that evaluates ``f`` at the points and compares with CasADi.

    Args:
        f: The function, written as C beside it.
        points: Samples: for each one value for each input.
    """
    inputs, expected = [], []
    for point in points:
        held = [ca.DM(ca.project(ca.DM(v), f.sparsity_in(i))) for i, v in enumerate(point)]
        inputs.append([x for v in held for x in v.nonzeros()])
        expected.append([y for v in f.call(held) for y in v.nonzeros()])
    first_in = np.cumsum([0] + [f.nnz_in(i) for i in range(f.n_in())])
    first_out = np.cumsum([0] + [f.nnz_out(i) for i in range(f.n_out())])
    rows = {"inputs": inputs, "expected": expected}
    texts = {
        key: ",\n".join(f"  {{{', '.join(map(_literal, row or [0.0]))}}}" for row in values)
        for key, values in rows.items()
    }
    return _TEST.format(
        name=f.name(),
        samples=len(points),
        n_in=max(1, int(first_in[-1])),
        n_out=max(1, int(first_out[-1])),
        used=int(first_out[-1]),
        first_in=", ".join(map(str, first_in)),
        first_out=", ".join(map(str, first_out)),
        **texts,
    )


def _literal(x: float) -> str:
    return repr(x) if np.isfinite(x) else "NAN" if np.isnan(x) else "INFINITY" if x > 0 else "-INFINITY"
