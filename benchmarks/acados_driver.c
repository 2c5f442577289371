/* Times real-time iterations in C, for acados.py: hybrid-mpc's generated C and, with WITH_ACADOS, acados' solvers
   through its C interface.

     acados_driver RECORDS RESULTS ROUNDS SOLVER...

   RECORDS is a file of STEPS records (below). Each solver takes every record, in order, ROUNDS times, by turns. A
   solver is "native" or MODEL,QP,N2,MODE,WARM,RIC: MODEL exported or casadi; QP partial, full or daqp; N2 the horizon
   of partial condensing; MODE of HPIPM; WARM the warm start; RIC 1 condenses by a Riccati recursion.

   Each solve writes a line of RESULTS: index of the solver, record, processor time [s] of the preparation, of the
   feedback and of what remains of the period, largest difference of an input from the plan in the record, status (0:
   solved).

   All solvers linearize along the plan of the record, shifted by a period, and get the state of the record. Handing
   over plan and state is not timed: it takes acados some hundred calls, which a program would avoid. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "case.h" /* generated: N, NX, NH, BOUNDED, STEPS, and the problem's numbers */
#include "hmpc.h"

enum { Z = NX + NH, STATES = Z + 1, COSTS = NX + 2 };

typedef struct {
  double u[N];         /* the last plan: inputs, */
  double z[N + 1][Z];  /* and states with hidden states */
  double appended[Z];  /* the last state of the shifted plan */
  double state[Z];     /* the measured one */
  double answer[N];    /* the inputs that the controller in Python finds */
} record;

typedef struct {
  void *self;
  void (*load)(void *self, const record *at);
  void (*prepare)(void *self);
  void (*measure)(void *self, const record *at);
  int (*feedback)(void *self);
  void (*complete)(void *self);
  void (*inputs)(void *self, double *u);
} solver;

static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void fail(const char *what) {
  fprintf(stderr, "%s\n", what);
  exit(1);
}

/* ---- hybrid-mpc's generated C */

static hmpc_state native __attribute__((aligned(64)));
static const hmpc_goal native_goal = {.x = reference, .rows = 1};

static void native_load(void *self, const record *at) {
  static const double nothing[HMPC_DIM(HMPC_ND) + HMPC_N * HMPC_DIM(HMPC_NW)];
  hmpc_load_plan(self, at->u, at->z[0], nothing, nothing);
}
static void native_prepare(void *self) { hmpc_prepare(self, &native_goal); }
static void native_measure(void *self, const record *at) {
  hmpc_state *const s = self;
  memcpy(s->x, at->state, sizeof s->x);
  memcpy(s->h, at->state + NX, sizeof(double) * NH);
}
static int native_feedback(void *self) { return hmpc_feedback(self, &native_goal, NULL, 0) != HMPC_SOLVED; }
static void native_complete(void *self) { hmpc_complete(self); }
static void native_inputs(void *self, double *u) {
  const hmpc_state *const s = self;
  memcpy(u, s->plan.u, sizeof(double) * N);
}

static solver make_native(void) {
  hmpc_clear(&native);
  return (solver){&native,         native_load,     native_prepare, native_measure,
                  native_feedback, native_complete, native_inputs};
}

/* ---- acados */

#ifdef WITH_ACADOS
#include "acados_c/external_function_interface.h"
#include "acados_c/ocp_nlp_interface.h"

enum { PREPARATION_PHASE = 1, FEEDBACK_PHASE = 2 };

typedef struct {
  ocp_nlp_config *config;
  ocp_nlp_dims *dims;
  ocp_nlp_in *in;
  ocp_nlp_out *out;
  void *options;
  ocp_nlp_solver *solver;
  external_function_casadi step, slope; /* one for all stages: their work memory stays in the cache */
} acados;

/* The C that CasADi wrote of a function (model.c, made by acados.py). */
#define DECLARE(name)                                                        \
  int name(const double **, double **, int *, double *, void *);             \
  int name##_work(int *, int *, int *, int *);                               \
  const int *name##_sparsity_in(int), *name##_sparsity_out(int);             \
  int name##_n_in(void), name##_n_out(void);
#define USE(function, name)                                                  \
  do {                                                                       \
    external_function_opts given;                                            \
    external_function_opts_set_to_default(&given);                           \
    (function)->casadi_fun = name, (function)->casadi_work = name##_work;    \
    (function)->casadi_sparsity_in = name##_sparsity_in;                     \
    (function)->casadi_sparsity_out = name##_sparsity_out;                   \
    (function)->casadi_n_in = name##_n_in, (function)->casadi_n_out = name##_n_out; \
    external_function_casadi_create(function, &given);                       \
  } while (0)
DECLARE(next_state)
DECLARE(exported_slope)
DECLARE(casadi_slope)

static void acados_load(void *self, const record *at) {
  acados *const a = self;
  double held = at->u[0];
  for (int k = 0; k <= N; k++) {
    double x[STATES], u = at->u[k + 1 < N ? k + 1 : N - 1];
    memcpy(x, k < N ? at->z[k + 1] : at->appended, sizeof(double) * Z);
    x[Z] = held;
    ocp_nlp_out_set(a->config, a->dims, a->out, a->in, k, "x", x);
    if (k < N) ocp_nlp_out_set(a->config, a->dims, a->out, a->in, k, "u", &u);
    held = u;
  }
}
static void phase(acados *a, int which) { ocp_nlp_solver_opts_set(a->config, a->options, "rti_phase", &which); }
static void acados_prepare(void *self) {
  acados *const a = self;
  phase(a, PREPARATION_PHASE);
  ocp_nlp_solve(a->solver, a->in, a->out);
}
static void acados_measure(void *self, const record *at) {
  acados *const a = self;
  double x[STATES];
  memcpy(x, at->state, sizeof at->state);
  x[Z] = at->u[0];
  ocp_nlp_constraints_model_set(a->config, a->dims, a->in, a->out, 0, "lbx", x);
  ocp_nlp_constraints_model_set(a->config, a->dims, a->in, a->out, 0, "ubx", x);
}
static int acados_feedback(void *self) {
  acados *const a = self;
  phase(a, FEEDBACK_PHASE);
  return ocp_nlp_solve(a->solver, a->in, a->out);
}
static void acados_complete(void *self) { (void)self; } /* its feedback has the states too */
static void acados_inputs(void *self, double *u) {
  acados *const a = self;
  for (int k = 0; k < N; k++) ocp_nlp_out_get(a->config, a->dims, a->out, k, "u", &u[k]);
}

static void set_dims(acados *a) {
  int nx[N + 1], nu[N + 1], none[N + 1], ns[N + 1];
  int one = 1, states = STATES, bounded = BOUNDED, costs = COSTS, end = NX;
  for (int k = 0; k <= N; k++) nx[k] = STATES, nu[k] = k < N, none[k] = 0, ns[k] = k > 0 ? BOUNDED : 0;
  ocp_nlp_dims_set_opt_vars(a->config, a->dims, "nx", nx);
  ocp_nlp_dims_set_opt_vars(a->config, a->dims, "nu", nu);
  ocp_nlp_dims_set_opt_vars(a->config, a->dims, "nz", none);
  ocp_nlp_dims_set_opt_vars(a->config, a->dims, "ns", ns);
  ocp_nlp_dims_set_opt_vars(a->config, a->dims, "np", none);
  for (int k = 0; k <= N; k++) {
    ocp_nlp_dims_set_constraints(a->config, a->dims, k, "nbx", k == 0 ? &states : &bounded);
    ocp_nlp_dims_set_constraints(a->config, a->dims, k, "nbu", k < N ? &one : &none[0]);
    ocp_nlp_dims_set_constraints(a->config, a->dims, k, "nsbx", k == 0 ? &none[0] : &bounded);
    if (k == 0) ocp_nlp_dims_set_constraints(a->config, a->dims, k, "nbxe", &states); /* known: no unknowns of the QP */
    ocp_nlp_dims_set_cost(a->config, a->dims, k, "ny", k < N ? &costs : &end);
  }
}

static void set_cost(acados *a, int k, const char *name, const double *value) {
  ocp_nlp_cost_model_set(a->config, a->dims, a->in, k, name, (void *)value);
}
static void set_bound(acados *a, int k, const char *name, const void *value) {
  ocp_nlp_constraints_model_set(a->config, a->dims, a->in, a->out, k, name, (void *)value);
}

static void set_problem(acados *a) {
  static const int input[1] = {0};
  static const double unit = 1.0;
  int all[STATES], soft[BOUNDED + 1];
  for (int i = 0; i < STATES; i++) all[i] = i;
  for (int i = 0; i < BOUNDED; i++) soft[i] = i;
  for (int k = 0; k <= N; k++) {
    const int end = k == N;
    if (!end) {
      double period = dt;
      ocp_nlp_in_set(a->config, a->dims, a->in, k, "Ts", &period);
      ocp_nlp_dynamics_model_set(a->config, a->dims, a->in, k, "disc_dyn_fun", &a->step);
      ocp_nlp_dynamics_model_set(a->config, a->dims, a->in, k, "disc_dyn_fun_jac", &a->slope);
      set_cost(a, k, "Vu", vu);
      set_bound(a, k, "idxbu", input);
      set_bound(a, k, "lbu", u_min);
      set_bound(a, k, "ubu", u_max);
    }
    set_cost(a, k, "scaling", end ? &unit : &dt);
    set_cost(a, k, "Vx", end ? vx_e : vx);
    set_cost(a, k, "W", end ? w_e : w);
    set_cost(a, k, "yref", end ? y_ref_e : y_ref);
    if (k == 0) {
      set_bound(a, k, "idxbx", all);
      set_bound(a, k, "idxbxe", all);
    } else if (BOUNDED > 0) {
      set_bound(a, k, "idxbx", bounded);
      set_bound(a, k, "lbx", x_min);
      set_bound(a, k, "ubx", x_max);
      set_bound(a, k, "idxsbx", soft);
      set_cost(a, k, "zl", end ? linear_e : linear);
      set_cost(a, k, "zu", end ? linear_e : linear);
      set_cost(a, k, "Zl", end ? quadratic_e : quadratic);
      set_cost(a, k, "Zu", end ? quadratic_e : quadratic);
    }
  }
}

static void set_option(acados *a, const char *name, const void *value) {
  ocp_nlp_solver_opts_set(a->config, a->options, name, (void *)value);
}

static solver make_acados(const char *words) {
  char model[16], qp[16], mode[16];
  int n2, warm, ric;
  if (sscanf(words, "%15[a-z],%15[a-z],%d,%15[A-Z],%d,%d", model, qp, &n2, mode, &warm, &ric) != 6) fail(words);
  const int partial = !strcmp(qp, "partial"), daqp = !strcmp(qp, "daqp");
  acados *const a = calloc(1, sizeof *a);
  ocp_nlp_plan_t *const plan = ocp_nlp_plan_create(N);
  plan->nlp_solver = SQP_RTI;
  plan->ocp_qp_solver_plan.qp_solver =
      partial ? PARTIAL_CONDENSING_HPIPM : daqp ? FULL_CONDENSING_DAQP : FULL_CONDENSING_HPIPM;
  plan->relaxed_ocp_qp_solver_plan.qp_solver = plan->ocp_qp_solver_plan.qp_solver;
  for (int k = 0; k <= N; k++) plan->nlp_cost[k] = LINEAR_LS, plan->nlp_constraints[k] = BGH;
  for (int k = 0; k < N; k++) {
    plan->nlp_dynamics[k] = DISCRETE_MODEL;
    plan->sim_solver_plan[k].sim_solver = INVALID_SIM_SOLVER;
  }
  plan->regularization = NO_REGULARIZE;
  plan->globalization = FIXED_STEP;
  a->config = ocp_nlp_config_create(*plan);
  ocp_nlp_plan_destroy(plan);
  a->dims = ocp_nlp_dims_create(a->config);
  set_dims(a);
  a->options = ocp_nlp_solver_opts_create(a->config, a->dims);
  const int iterations = 200;
  if (partial) set_option(a, "qp_cond_N", &n2);
  if (!daqp) set_option(a, "qp_hpipm_mode", mode); /* first: it resets the other ones */
  set_option(a, "qp_cond_ric_alg", &ric);
  set_option(a, "qp_warm_start", &warm);
  set_option(a, "qp_iter_max", &iterations);
  set_option(a, "qp_tol_stat", &tolerance);
  set_option(a, "qp_tol_eq", &tolerance);
  set_option(a, "qp_tol_ineq", &tolerance);
  set_option(a, "qp_tol_comp", &tolerance);
  a->out = ocp_nlp_out_create(a->config, a->dims);
  a->in = ocp_nlp_in_create(a->config, a->dims);
  USE(&a->step, next_state);
  if (!strcmp(model, "casadi"))
    USE(&a->slope, casadi_slope);
  else
    USE(&a->slope, exported_slope);
  set_problem(a);
  a->solver = ocp_nlp_solver_create(a->config, a->dims, a->options, a->in);
  if (ocp_nlp_precompute(a->solver, a->in, a->out)) fail("acados: the precomputation failed");
  return (solver){a, acados_load, acados_prepare, acados_measure, acados_feedback, acados_complete, acados_inputs};
}
#else
static solver make_acados(const char *words) {
  fail(words);
  return make_native();
}
#endif

/* ---- */

static void solve(const solver *s, int index, int step, const record *at, FILE *results) {
  double u[N], largest = 0.0;
  s->load(s->self, at);
  const double start = now();
  s->prepare(s->self);
  const double prepared = now();
  s->measure(s->self, at);
  const double measured = now();
  const int status = s->feedback(s->self);
  const double fed = now();
  s->complete(s->self);
  const double end = now();
  s->inputs(s->self, u);
  for (int k = 0; k < N; k++) {
    const double difference = fabs(u[k] - at->answer[k]);
    if (!(difference <= largest)) largest = difference;
  }
  fprintf(results, "%d %d %.9g %.9g %.9g %.17g %d\n", index, step, prepared - start, fed - measured, end - fed, largest,
          status);
}

int main(int count, char **words) {
  static record records[STEPS];
  static solver solvers[64];
  const int given = count - 4;
  if (given < 1 || given > 64) fail("acados_driver RECORDS RESULTS ROUNDS SOLVER...");
  FILE *const file = fopen(words[1], "rb"), *const results = fopen(words[2], "w");
  if (!file || fread(records, sizeof *records, STEPS, file) != STEPS) fail("no records");
  if (!results) fail("no place for results");
  fclose(file);
  for (int i = 0; i < given; i++)
    solvers[i] = strcmp(words[i + 4], "native") ? make_acados(words[i + 4]) : make_native();
  for (int round = 0; round < atoi(words[3]); round++)
    for (int i = 0; i < given; i++)
      for (int k = 0; k < STEPS; k++) solve(&solvers[i], i, k, &records[k], results);
  return fclose(results) != 0;
}
