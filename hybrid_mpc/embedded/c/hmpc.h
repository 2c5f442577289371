/* A model predictive controller with its estimator: no heap, no globals, static sizes.

   A period, as hybrid_mpc's Loop has it:

     hmpc_start(&s, y, w, NULL, &goal)   once, while the machine rests; s.u is the first input
     every period: write s.u; hmpc_finish(&s, &goal) while it acts; hmpc_step(&s, y, w, NULL, &goal)

   hmpc_finish is where the monitor looks, if there is one: s.monitor.alarm. A guard acts on it in the next hmpc_step.

   Numbers never stop it: s.u is within its limits whatever samples, references and the model say.
   All matrices are row by row. Everything of a controller is in one hmpc_state. */
#ifndef HMPC_H
#define HMPC_H

#include "hmpc_config.h" /* sizes, and the type hmpc_real */
#if HMPC_BACKUP
#include "hmpb.h" /* the guard's second controller: the same functions and types, named hmpb_ */
#endif

#define HMPC_DIM(n) ((n) > 0 ? (n) : 1) /* C has no empty arrays */
#define HMPC_ROUND(n) (((n) + 7) / 8 * 8)
#define HMPC_NZ (HMPC_NX + HMPC_NH)          /* state and hidden state */
#define HMPC_NV (HMPC_BLOCKS * HMPC_NU)      /* unknowns of the QP: inputs of the move blocks */
#define HMPC_LD HMPC_ROUND(HMPC_NV)          /* length of a row over the unknowns */
#define HMPC_LZ HMPC_ROUND(HMPC_NZ)          /* length of a row over z, the rest zero */
#define HMPC_LJ (HMPC_LZ + HMPC_NU)          /* row of a stage's Jacobian: by z, then by u */
#define HMPC_SOFT (HMPC_N * (HMPC_SOFT_X + HMPC_SOFT_E)) /* rows of these bounds: a period's states, then expressions */
#define HMPC_KINDS (HMPC_SOFT_X + HMPC_SOFT_E) /* bounds besides the inputs', soft and hard */
#define HMPC_MOST (HMPC_NV + HMPC_SOFT)      /* most active bounds */
#define HMPC_NE (HMPC_NZ + HMPC_ND)          /* what the estimator estimates: x, h, d */
#define HMPC_LE HMPC_ROUND(HMPC_NE)
#define HMPC_NT (HMPC_NZ + HMPC_NU)          /* unknowns of a steady state: z, u */
#define HMPC_NC (HMPC_NX + HMPC_NU)          /* what a stage cost is one of: x, u */
#define HMPC_NQ (HMPC_NX / 2)                /* positions of a machine whose energy is watched */
#define HMPC_ENERGY 1                        /* values of HMPC_MONITOR; 0: none */
#define HMPC_RESIDUALS 2
#define HMPC_TARGET_ROWS (2 * (HMPC_NX + HMPC_NU + HMPC_NY)) /* its bounds */

typedef enum {
  HMPC_INITIAL,    /* a first plan, not optimised */
  HMPC_SOLVED,     /* the QP was solved and its solution checked */
  HMPC_NOT_FINITE, /* estimate, reference, model or plan hold a value that is not finite */
  HMPC_INFEASIBLE, /* the solution violates an input bound or the limit of its change */
  HMPC_INACCURATE  /* the solution fails the KKT check, or the iterations ended */
} hmpc_status;

typedef enum {
  HMPC_MPC,      /* the checked solution */
  HMPC_PLAN,     /* the previous plan, shifted: the solve failed */
  HMPC_FALLBACK, /* the stabilising feedback on the prior: the plan is used up */
  HMPC_SAFE,     /* the declared safe input */
  HMPC_HELD      /* the last input: no safe input is declared; or none was decided yet */
} hmpc_source;

/* What a plan is to follow. Rows are periods from now on, the last one holds; NULL: the operating point, factors 1,
   the problem's own limits. */
typedef struct {
  const hmpc_real *x;      /* reference of the states, rows of HMPC_NX; where outputs are weighed it does not matter */
  const hmpc_real *y;      /* where outputs are weighed (HMPC_OUTPUT_COST): theirs, rows of HMPC_NY */
  const hmpc_real *p;      /* what bounds and costs that move depend on, rows of HMPC_NP; NULL: zero */
  int rows;                /* of x or y, and of p */
  const hmpc_real *weight; /* factors on the states' weights, HMPC_N + 1 rows of HMPC_NX */
  const hmpc_real *u_min;  /* tighter limits of the inputs, HMPC_NU */
  const hmpc_real *u_max;
  const hmpc_real *w;      /* forecast of the measured disturbances, rows of HMPC_NW; what is not finite is as in the row
                              before, the first row as it was measured. NULL: those measured last hold */
  int w_rows;
} hmpc_goal;

/* A steady state. */
typedef struct {
  hmpc_real x[HMPC_NX], h[HMPC_DIM(HMPC_NH)], u[HMPC_NU], y[HMPC_NY];
  int reached; /* outputs that are weighed are the set-point's; 0: the nearest that limits and bounds allow */
  int steady;  /* 0: none was found, and the operating point is held */
} hmpc_steady;

/* The working set of the QP, and the Cholesky factor of its rows' products. */
typedef struct {
  int count;
  int id[HMPC_MOST];            /* bounds, see hmpc_qp.c */
  int beyond[HMPC_MOST];        /* a soft bound whose slack is in use */
  hmpc_real multiplier[HMPC_MOST];
  hmpc_real row[HMPC_MOST][HMPC_LD];
  hmpc_real factor[HMPC_MOST * (HMPC_MOST + 1) / 2];
  int iterations;
  hmpc_real kkt;
} hmpc_working;

/* min 1/2 s'Hs + g's over scaled input steps s. */
typedef struct {
  hmpc_real hessian[HMPC_NV][HMPC_LD];
  hmpc_real lower_factor[HMPC_NV][HMPC_LD]; /* L, of which H = L L' */
  hmpc_real inverse[HMPC_NV][HMPC_LD]; /* of L, transposed: row i is L^-1 e_i */
  hmpc_real size;                      /* what H was divided by */
  int definite;
  hmpc_real gradient[HMPC_LD];
  hmpc_real lower[HMPC_LD], upper[HMPC_LD], change_lower[HMPC_LD], change_upper[HMPC_LD];
  int strict;                          /* hard bounds do not give way */
  hmpc_real value[HMPC_DIM(HMPC_SOFT)];                  /* soft bounds: values without a step, */
  hmpc_real slope[HMPC_DIM(HMPC_SOFT_E) * HMPC_N][HMPC_LD]; /* and derivatives of those that are expressions */
  hmpc_real step[HMPC_LD];
} hmpc_qp;

/* What is linearized along the plan, shifted by one period. */
typedef struct {
  hmpc_real u[HMPC_N][HMPC_NU], z[HMPC_N + 1][HMPC_LZ], d[HMPC_DIM(HMPC_ND)], w[HMPC_N][HMPC_DIM(HMPC_NW)];
  hmpc_real u_prev[HMPC_NU];
  hmpc_real slope[HMPC_N][HMPC_NZ][HMPC_LJ], defect[HMPC_N][HMPC_LZ];
  hmpc_real from_u[HMPC_N + 1][HMPC_NX][HMPC_LD]; /* of the states by the scaled unknowns */
  hmpc_real weight[HMPC_N + 1][HMPC_NX], terminal[HMPC_NX][HMPC_NX];
  hmpc_real by_x[HMPC_DIM(HMPC_SOFT_E) * HMPC_N][HMPC_NX]; /* of soft expressions */
  hmpc_real soft[HMPC_DIM(HMPC_SOFT)];
#if HMPC_STAGE_COST
  hmpc_real cost_slope[HMPC_N][HMPC_NC], cost_curve[HMPC_N][HMPC_NC][HMPC_NC]; /* of costs that are no squares */
#endif
  hmpc_real largest_defect;
} hmpc_linear;

typedef struct {
  hmpc_real u[HMPC_N][HMPC_NU], z[HMPC_N + 1][HMPC_LZ], d[HMPC_DIM(HMPC_ND)], w[HMPC_N][HMPC_DIM(HMPC_NW)];
  hmpc_real cost, excess;                   /* excess: largest violation of a soft bound */
  hmpc_real given_way[HMPC_DIM(HMPC_KINDS)]; /* of each hard bound: largest violation, 0 if it is kept; hmpc_config.h
                                                says which is which */
} hmpc_plan;

#if HMPC_OUTPUT_COST
/* References over the horizon. */
typedef struct {
  hmpc_real x[HMPC_N + 1][HMPC_NX], u[HMPC_N][HMPC_NU], y[HMPC_N + 1][HMPC_NY];
} hmpc_target;

/* A point of the search for a steady state: v = (z, u), F(z, u) - z and the model's Jacobian, outputs; how far it is
   from a steady state, and what a descent lowers. */
typedef struct {
  hmpc_real v[HMPC_NT], rest[HMPC_NZ], slope[HMPC_NZ][HMPC_LJ], y[HMPC_NY], lacks, merit;
#if HMPC_CURVED
  hmpc_real by_x[HMPC_NY][HMPC_NX], by_u[HMPC_NY][HMPC_NU]; /* of the outputs, which are not linear */
#endif
} hmpc_point;

/* Where a descent ended: how far outputs are off in tolerated deviations, how far states and inputs are from the operating
   point, whether another rounding ends there too, whether it missed where outputs do not answer to inputs. */
typedef struct {
  hmpc_steady at;
  hmpc_real v[HMPC_NT], off, distance;
  int sure, lost;
} hmpc_descent;

/* Its memory, see hmpc_targets.c; d are the disturbances under which it searches. */
typedef struct {
  hmpc_point at, after, settled, kept;
  hmpc_descent tried[HMPC_TARGET_STARTS + 3];
  hmpc_real d[HMPC_DIM(HMPC_ND)], w[HMPC_DIM(HMPC_NW)];
  hmpc_real a[HMPC_NZ][HMPC_NT], half[HMPC_NZ], diagonal[HMPC_NZ], along[HMPC_NT][HMPC_NT], turned[HMPC_NY][HMPC_NT];
  hmpc_real h[HMPC_NT][HMPC_NT], gram[HMPC_NT][HMPC_NT];
  hmpc_real bound[HMPC_TARGET_ROWS][HMPC_NT], end[HMPC_TARGET_ROWS], seen[HMPC_TARGET_ROWS][HMPC_NT], answer;
} hmpc_search;
#endif

#if HMPC_MODES > 0
typedef struct {
  hmpc_real z[HMPC_LE];
  hmpc_real p[HMPC_NE][HMPC_LE]; /* covariance */
  hmpc_real nis, likelihood;
} hmpc_filter;
#endif

#if HMPC_MONITOR
typedef enum {
  HMPC_VALID,         /* the reading is a number */
  HMPC_WARM_UP,       /* its window was not full yet */
  HMPC_MISSING,       /* a sample or an input in the window was missing */
  HMPC_NOT_A_READING  /* all was there, and still it is no number: model or estimator is at fault */
} hmpc_validity;
#endif

#if HMPC_MONITOR == HMPC_ENERGY
/* A free run of the model: z, its latest positions, sums of energy, squared speed and squared input, periods left. */
typedef struct {
  hmpc_real z[HMPC_LZ], q[HMPC_WINDOW][HMPC_NQ], sum[3];
  int left;
} hmpc_free_run;
#endif

#if HMPC_MONITOR
/* The monitor: its last reading, see hybrid_mpc's Reading; then what it remembers. Channels of the energy: violation,
   forces, power of the free run; of residuals: outputs, balances, measured disturbances, free runs of the outputs. */
typedef struct {
  int alarm; /* a limit is exceeded, a sensor frozen, or the monitor blind */
  int frozen, blind;
  hmpc_validity validity;
  hmpc_real value[HMPC_CHANNELS], share; /* share: largest level over its threshold */
  hmpc_real travel[HMPC_NY];             /* how far outputs were predicted to move since their sensors last moved */
  int stuck[HMPC_NY];                    /* sensors that are frozen */
#if HMPC_LIMITS > 0
  hmpc_real level[HMPC_LIMITS];
  int on[HMPC_LIMITS]; /* limits that are exceeded */
  /* its own: sums upwards and downwards, latest values */
  hmpc_real up[HMPC_LIMITS], down[HMPC_LIMITS], recent[HMPC_LONGEST][HMPC_CHANNELS];
  int newest, counted;
#endif
  /* its own */
  hmpc_real z[HMPC_LZ], w[HMPC_DIM(HMPC_NW)];
  int repeats[HMPC_NY], seen, invalid;
#if HMPC_MONITOR == HMPC_ENERGY
  hmpc_real y[HMPC_WINDOW][HMPC_NQ], row[HMPC_WINDOW - 1][2 * HMPC_NQ + HMPC_NU + HMPC_NW];
  hmpc_real ahead[HMPC_NQ], pushed_speed[HMPC_NQ], pushed[HMPC_NQ], before[HMPC_NU];
  hmpc_free_run run[2];
  int whole;
#else
  hmpc_real y[HMPC_NY], run[2][HMPC_LZ], run_d[2][HMPC_DIM(HMPC_ND)];
  int age[2];
#endif
} hmpc_monitor;
#endif

#if HMPC_GUARD
typedef enum { HMPC_NORMAL, HMPC_LIMITED, HMPC_BACKED_UP, HMPC_FALLING_BACK, HMPC_RESTING } hmpc_mode;
typedef enum {
  HMPC_QUIET_AGAIN,  /* no alarm for long enough */
  HMPC_SENSOR,       /* a sensor repeats itself while motion is predicted */
  HMPC_MODEL,        /* the model does not describe the machine */
  HMPC_BLIND         /* the monitor has no valid reading */
} hmpc_reason;
typedef enum { HMPC_CONTROLLER, HMPC_BACKUP_PLANS, HMPC_NOBODY } hmpc_planner;

/* The guard: the mode that decides, the one of the next period and why; times in periods. */
typedef struct {
  hmpc_mode mode, wanted;
  hmpc_reason why;
  int since, since_alarm, since_frozen; /* periods */
  int row;                              /* from the first alarm of a row to the last one */
  hmpc_planner planner;                 /* whose plan the last one is */
} hmpc_guard;
#endif

typedef struct {
  /* to be read */
  hmpc_real u[HMPC_NU]; /* the input to apply */
  hmpc_status status;   /* how the last solve ended */
  hmpc_source source;   /* where u came from */
  int age;              /* periods since the last successful solve */
  hmpc_real x[HMPC_NX], h[HMPC_DIM(HMPC_NH)], d[HMPC_DIM(HMPC_ND)], w[HMPC_DIM(HMPC_NW)]; /* the estimate */
  hmpc_plan plan;
  hmpc_steady steady; /* where outputs are weighed: what holds the first row of their reference */
#if HMPC_MONITOR
  hmpc_monitor monitor; /* what hmpc_finish saw last */
#endif
#if HMPC_GUARD
  hmpc_guard guard;
#endif
#if HMPC_BACKUP
  hmpb_state backup; /* its estimate and plan; u, status, source and age are above, whoever decides */
#endif
  /* its own */
  int prepared, pending;
#if HMPC_MONITOR
  int watched; /* the monitor has seen this period */
  hmpc_real sample[HMPC_NY], acted[HMPC_NU];
#endif
  hmpc_linear linear;
  hmpc_qp qp;
  hmpc_working working;
  hmpc_real dz[HMPC_N + 1][HMPC_LZ], scratch[2][HMPC_NZ][HMPC_LD];
#if HMPC_OUTPUT_COST
  hmpc_steady aimed;
  hmpc_target target;
  hmpc_search search;
#endif
#if HMPC_MODES > 0
  hmpc_filter filter[HMPC_MODES], predicted[HMPC_MODES], mixed;
  hmpc_real probability[HMPC_MODES];
  hmpc_real transition[HMPC_NE][HMPC_LE], product[HMPC_NE][HMPC_LE], stage[HMPC_NZ][HMPC_LJ];
#endif
} hmpc_state;

#if HMPC_MODES > 0
/* Begin: first estimate, first plan (which may take its time), first input. y: outputs, what is not finite is missing;
   w: measured disturbances, NULL or not finite: the last ones; applied: the input that acted until now, NULL: the
   operating point's, in hmpc_step the one decided last. */
void hmpc_start(hmpc_state *s, const hmpc_real *y, const hmpc_real *w, const hmpc_real *applied, const hmpc_goal *goal);
void hmpc_step(hmpc_state *s, const hmpc_real *y, const hmpc_real *w, const hmpc_real *applied, const hmpc_goal *goal);
/* The monitor, the guard's next mode, and the part of the next step that needs no sample; hmpc_step does it if nobody
   did. Of the goal it takes the weights. */
void hmpc_finish(hmpc_state *s, const hmpc_goal *goal);

#if HMPC_MONITOR
/* The monitor alone, on the sample y, the input that acted before it, and the estimate in s->x, h, d, w. */
void hmpc_watch_begin(hmpc_state *s);
void hmpc_watch(hmpc_state *s, const hmpc_real *y, const hmpc_real *u_prev);
#endif

/* The estimator alone: s->x, h, d, w. */
void hmpc_estimate_start(hmpc_state *s, const hmpc_real *y, const hmpc_real *w);
void hmpc_estimate_update(hmpc_state *s, const hmpc_real *y, const hmpc_real *u_prev, const hmpc_real *w);
#endif

/* The controller alone, on an estimate in s->x, h, d, w. */
void hmpc_clear(hmpc_state *s);
void hmpc_run_free(hmpc_state *s, const hmpc_real *u, int rows); /* plan: the model on inputs u, the last row holds */
void hmpc_prepare(hmpc_state *s, const hmpc_goal *goal);         /* shift the plan, linearize, condense */
void hmpc_linearize(hmpc_state *s, const hmpc_goal *goal);       /* at s->linear as it is */
void hmpc_load_plan(hmpc_state *s, const hmpc_real *u, const hmpc_real *z, const hmpc_real *d, const hmpc_real *w);
hmpc_status hmpc_feedback(hmpc_state *s, const hmpc_goal *goal, const hmpc_real *w, int w_rows); /* w NULL: s->w held */
void hmpc_complete(hmpc_state *s); /* hidden states of the plan; hmpc_prepare calls it */
void hmpc_begin(hmpc_state *s, const hmpc_real *applied, const hmpc_goal *goal); /* the first plan and input */
void hmpc_decide(hmpc_state *s, const hmpc_goal *goal, const hmpc_real *applied); /* s->u */

/* What a guard needs: another controller's plan, HMPC_N rows, taken over one period later; the stabilising feedback in
   place of a solve; the safe input. */
void hmpc_take_over(hmpc_state *s, const hmpc_real *plan, const hmpc_real *held);
void hmpc_fall_back(hmpc_state *s, const hmpc_goal *goal, const hmpc_real *held);
void hmpc_rest(hmpc_state *s, const hmpc_goal *goal, const hmpc_real *held);

#if HMPC_OUTPUT_COST
/* The steady state for a set-point of outputs under measured disturbances w and s->d; start: where to begin, or NULL;
   wide: whether to begin elsewhere, too. */
void hmpc_steady_state(hmpc_state *s, const hmpc_real *y, const hmpc_real *w, const hmpc_steady *start, int wide,
                       hmpc_steady *found);
void hmpc_aim(hmpc_state *s, const hmpc_goal *goal); /* s->target, for the measured disturbances of s->linear */
#endif

/* The model: a period, and its Jacobian (HMPC_NZ rows of HMPC_LJ; entries that are always zero are not written). */
void hmpc_model(const hmpc_real *z, const hmpc_real *u, const hmpc_real *w, hmpc_real *z_next);
void hmpc_model_slope(const hmpc_real *z, const hmpc_real *u, const hmpc_real *w, hmpc_real *z_next, hmpc_real *slope);

#if HMPC_RATES
void hmpc_rates(const hmpc_real *z, const hmpc_real *u, const hmpc_real *w, hmpc_real *xdot); /* of x at an instant */
#endif

hmpc_status hmpc_qp_solve(hmpc_qp *qp, hmpc_working *w, const hmpc_linear *linear);
void hmpc_qp_factor(hmpc_qp *qp);
void hmpc_qp_shift(hmpc_working *w);
#ifndef HMPC_N
#error "hmpc_config.h lacks the sizes"
#endif
#endif
