/* A model predictive controller with its estimator: no heap, no global variables, static sizes.

   Order of a period, as in Loop of hybrid_mpc:

     hmpc_start(&s, y, w, NULL, &goal)   once, with the machine at rest; s.u is the first input
     every period: write s.u; hmpc_finish(&s, &goal) while s.u acts; hmpc_step(&s, y, w, NULL, &goal)

   hmpc_finish runs the monitor, if there is one: s.monitor.alarm. A guard reacts in the next hmpc_step.

   s.u is within its limits for any samples, references and values of the model.
   All matrices are row-major. One hmpc_state holds all data of a controller. */
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
#define HMPC_LZ HMPC_ROUND(HMPC_NZ)          /* length of a row over z, padded with zeros */
#define HMPC_MEASURED (HMPC_NW - HMPC_TRACKED) /* measured disturbances; tracked parameters follow them in w */
#define HMPC_LJ (HMPC_LZ + HMPC_NU + HMPC_TRACKED) /* length of a row of a stage's Jacobian: by z, u, tracked parameters */
#define HMPC_SOFT (HMPC_N * (HMPC_SOFT_X + HMPC_SOFT_E)) /* rows of soft and hard bounds: states, then expressions */
#define HMPC_KINDS (HMPC_SOFT_X + HMPC_SOFT_E) /* soft and hard bounds of a period, without the inputs' limits */
#define HMPC_MOST (HMPC_NV + HMPC_SOFT)      /* maximum number of active bounds */
#define HMPC_AT_D (HMPC_NZ + HMPC_TRACKED)   /* place of d among the estimated states */
#define HMPC_NE (HMPC_AT_D + HMPC_ND)        /* estimated states: x, h, deviations of tracked parameters, d */
#define HMPC_LE HMPC_ROUND(HMPC_NE)
#define HMPC_NT (HMPC_NZ + HMPC_NU)          /* unknowns of a steady state: z, u */
#define HMPC_NC (HMPC_NX + HMPC_NU)          /* arguments of a stage cost: x, u */
#define HMPC_NQ (HMPC_NX / 2)                /* positions of a mechanical machine */
#define HMPC_ENERGY 1                        /* values of HMPC_MONITOR; 0: no monitor */
#define HMPC_RESIDUALS 2
#define HMPC_TARGET_ROWS (2 * (HMPC_NX + HMPC_NU + HMPC_NY)) /* bounds of a steady state */

typedef enum {
  HMPC_INITIAL,    /* an initial plan without optimization */
  HMPC_SOLVED,     /* the QP was solved and its solution checked */
  HMPC_NOT_FINITE, /* estimate, reference, model or plan hold a value that is not finite */
  HMPC_INFEASIBLE, /* the solution violates an input limit or the limit of an input change */
  HMPC_INACCURATE, /* the solution fails the KKT check, or the iteration limit was reached */
  HMPC_DIVERGED    /* the plan leaves the declared range of a state by more than ten times its width */
} hmpc_status;

typedef enum {
  HMPC_MPC,      /* the checked solution */
  HMPC_PLAN,     /* the previous plan, shifted: the solve failed */
  HMPC_FALLBACK, /* the stabilising feedback on the prior: the plan is too old */
  HMPC_SAFE,     /* the declared safe input */
  HMPC_HELD      /* the last input: no safe input is declared, or there was no decision yet */
} hmpc_source;

/* Goal of a plan. Rows are periods from now on; the last row holds until the end of the horizon. NULL: the operating
   point, factors of 1, the limits of the problem. */
typedef struct {
  const hmpc_real *x;      /* reference of the states, rows of HMPC_NX; unused if outputs have weights */
  const hmpc_real *y;      /* reference of the outputs if they have weights (HMPC_OUTPUT_COST), rows of HMPC_NY */
  const hmpc_real *p;      /* parameters of bounds and costs, rows of HMPC_NP; NULL: zero */
  int rows;                /* rows of x or y, and of p */
  const hmpc_real *weight; /* factors on the states' weights, HMPC_N + 1 rows of HMPC_NX */
  const hmpc_real *u_min;  /* tighter limits of the inputs, HMPC_NU */
  const hmpc_real *u_max;
  const hmpc_real *w;      /* forecast of the measured disturbances, rows of HMPC_MEASURED; a value that is not finite
                              repeats the row before (in the first row the measured value). NULL: the measured values
                              hold */
  int w_rows;
} hmpc_goal;

/* A steady state. */
typedef struct {
  hmpc_real x[HMPC_NX], h[HMPC_DIM(HMPC_NH)], u[HMPC_NU], y[HMPC_NY];
  int reached; /* 1: the outputs equal the set-point; 0: the nearest outputs that limits and bounds allow */
  int steady;  /* 0: no steady state was found, the operating point is used */
  hmpc_real goal[HMPC_NY]; /* set-point that it was searched for */
  int age;                 /* searches for it since the last one from several starts */
} hmpc_steady;

/* The working set of the QP, and the Cholesky factor of the products of its rows. */
typedef struct {
  int count;
  int id[HMPC_MOST];            /* bounds, see hmpc_qp.c */
  int beyond[HMPC_MOST];        /* 1: relaxed bound (its slack is positive) */
  hmpc_real multiplier[HMPC_MOST];
  hmpc_real row[HMPC_MOST][HMPC_LD];
  hmpc_real factor[HMPC_MOST * (HMPC_MOST + 1) / 2];
  int iterations;
  hmpc_real kkt;
} hmpc_working;

/* min 1/2 s'Hs + g's over scaled input steps s. */
typedef struct {
  hmpc_real hessian[HMPC_NV][HMPC_LD];
  hmpc_real lower_factor[HMPC_NV][HMPC_LD]; /* L with H = L L' */
  hmpc_real inverse[HMPC_NV][HMPC_LD]; /* inverse of L, transposed: row i is L^-1 e_i */
  hmpc_real size;                      /* scale by which H was divided */
  int definite;
  hmpc_real gradient[HMPC_LD];
  hmpc_real lower[HMPC_LD], upper[HMPC_LD], change_lower[HMPC_LD], change_upper[HMPC_LD];
  int strict;                          /* 1: hard bounds must not be relaxed */
  hmpc_real value[HMPC_DIM(HMPC_SOFT)];                  /* soft and hard bounds: values at s = 0, */
  hmpc_real slope[HMPC_DIM(HMPC_SOFT_E) * HMPC_N][HMPC_LD]; /* and derivatives of bounded expressions */
  hmpc_real step[HMPC_LD];
} hmpc_qp;

/* Linearization along the plan, shifted by one period. */
typedef struct {
  hmpc_real u[HMPC_N][HMPC_NU], z[HMPC_N + 1][HMPC_LZ], d[HMPC_DIM(HMPC_ND)], w[HMPC_N][HMPC_DIM(HMPC_NW)];
  hmpc_real u_prev[HMPC_NU];
  hmpc_real slope[HMPC_N][HMPC_NZ][HMPC_LJ], defect[HMPC_N][HMPC_LZ];
  hmpc_real from_u[HMPC_N + 1][HMPC_NX][HMPC_LD]; /* derivatives of the states by the scaled unknowns */
  hmpc_real weight[HMPC_N + 1][HMPC_NX], terminal[HMPC_NX][HMPC_NX];
  hmpc_real by_x[HMPC_DIM(HMPC_SOFT_E) * HMPC_N][HMPC_NX]; /* derivatives of bounded expressions */
  hmpc_real soft[HMPC_DIM(HMPC_SOFT)];
#if HMPC_STAGE_COST
  hmpc_real cost_slope[HMPC_N][HMPC_NC], cost_curve[HMPC_N][HMPC_NC][HMPC_NC]; /* of nonquadratic costs */
#endif
#if HMPC_BENT
  hmpc_real multiplier[HMPC_N][HMPC_SOFT_E];   /* of the bounded expressions, and their weighted curvature */
  int bends[HMPC_N];                           /* periods with such a curvature */
  hmpc_real bend[HMPC_N][HMPC_NC][HMPC_NC], actual[HMPC_N][HMPC_SOFT_E]; /* actual: values along the plan */
  hmpc_real gradient[HMPC_LD];                 /* of the QP, without that curvature */
#endif
  hmpc_real largest_defect;
} hmpc_linear;

typedef struct {
  hmpc_real u[HMPC_N][HMPC_NU], z[HMPC_N + 1][HMPC_LZ], d[HMPC_DIM(HMPC_ND)], w[HMPC_N][HMPC_DIM(HMPC_NW)];
  hmpc_real cost, excess;                   /* excess: largest violation of a soft bound */
  hmpc_real given_way[HMPC_DIM(HMPC_KINDS)]; /* largest violation of each hard bound, 0 if it is kept; hmpc_config.h
                                                lists their names */
  hmpc_real multiplier[HMPC_DIM(HMPC_BENT * HMPC_N)][HMPC_DIM(HMPC_SOFT_E)]; /* of curved bounds, if there are any */
} hmpc_plan;

#if HMPC_OUTPUT_COST
/* References over the horizon. */
typedef struct {
  hmpc_real x[HMPC_N + 1][HMPC_NX], u[HMPC_N][HMPC_NU], y[HMPC_N + 1][HMPC_NY];
} hmpc_target;

/* A point of the search for a steady state: v = (z, u), residual F(z, u) - z, Jacobian of the model, outputs; lacks:
   size of the residual; off: weighted deviation of the outputs from the set-point. */
typedef struct {
  hmpc_real v[HMPC_NT], rest[HMPC_NZ], slope[HMPC_NZ][HMPC_LJ], y[HMPC_NY], lacks, off;
#if HMPC_CURVED
  hmpc_real by_x[HMPC_NY][HMPC_NX], by_u[HMPC_NY][HMPC_NU]; /* derivatives of nonlinear outputs */
#endif
} hmpc_point;

/* End of a descent. off: distance of the outputs from the set-point in tolerated deviations; distance: distance of
   states and inputs from the operating point; sure: the result does not depend on rounding; lost: the descent ended
   where outputs do not respond to inputs. */
typedef struct {
  hmpc_steady at;
  hmpc_real v[HMPC_NT], off, distance;
  int sure, lost;
} hmpc_descent;

/* Memory of the search, see hmpc_targets.c; d, w: disturbances during the search. */
typedef struct {
  hmpc_point at, after, settled, kept, good;
  hmpc_descent tried[HMPC_TARGET_STARTS + 3];
  hmpc_real d[HMPC_DIM(HMPC_ND)], w[HMPC_DIM(HMPC_NW)];
  hmpc_real a[HMPC_NZ + HMPC_NY][HMPC_NT], half[HMPC_NZ + HMPC_NY], diagonal[HMPC_NZ + HMPC_NY], along[HMPC_NT][HMPC_NT], turned[HMPC_NY][HMPC_NT];
  hmpc_real h[HMPC_NT][HMPC_NT], gram[HMPC_NT][HMPC_NT], bend[HMPC_NT][HMPC_NT];
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
  HMPC_VALID,         /* the reading is finite */
  HMPC_WARM_UP,       /* the window is not full yet */
  HMPC_MISSING,       /* a sample or an input in the window is missing */
  HMPC_NOT_A_READING  /* the reading is not finite although no sample is missing: error of model or estimator */
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
/* The monitor: its last reading (Reading in hybrid_mpc), then its memory. Channels of HMPC_ENERGY: violation, forces,
   power of the free run; of HMPC_RESIDUALS: outputs, balances, measured disturbances, free runs of the outputs. */
typedef struct {
  int alarm; /* a limit is exceeded, a sensor is frozen, or the monitor is blind */
  int frozen, blind;
  hmpc_validity validity;
  hmpc_real value[HMPC_CHANNELS], share; /* share: largest ratio of a level to its threshold */
  hmpc_real travel[HMPC_NY];             /* predicted travel of each output since its sensor last moved */
  int stuck[HMPC_NY];                    /* frozen sensors */
#if HMPC_LIMITS > 0
  hmpc_real level[HMPC_LIMITS];
  int on[HMPC_LIMITS]; /* exceeded limits */
  /* internal: upper and lower CUSUM, latest values */
  hmpc_real up[HMPC_LIMITS], down[HMPC_LIMITS], recent[HMPC_LONGEST][HMPC_CHANNELS];
  int newest, counted;
#endif
  /* internal */
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
  HMPC_QUIET_AGAIN,  /* no alarm for the quiet time */
  HMPC_SENSOR,       /* a sensor is frozen while motion is predicted */
  HMPC_MODEL,        /* a residual between model and machine alarms */
  HMPC_BLIND         /* the monitor has no valid reading */
} hmpc_reason;
typedef enum { HMPC_CONTROLLER, HMPC_BACKUP_PLANS, HMPC_NOBODY } hmpc_planner;

/* The guard: present mode, mode of the next period and reason. */
typedef struct {
  hmpc_mode mode, wanted;
  hmpc_reason why;
  int since, since_alarm, since_frozen; /* periods in the mode, since the last alarm, since the last frozen sensor */
  int row;                              /* periods from the first to the last alarm of a series */
  hmpc_planner planner;                 /* controller of the last plan */
} hmpc_guard;
#endif

typedef struct {
  /* results */
  hmpc_real u[HMPC_NU]; /* the input to apply */
  hmpc_status status;   /* result of the last solve */
  hmpc_source source;   /* source of u */
  int age;              /* periods since the last successful solve */
  hmpc_real x[HMPC_NX], h[HMPC_DIM(HMPC_NH)], d[HMPC_DIM(HMPC_ND)], w[HMPC_DIM(HMPC_NW)]; /* the estimate;
      the last HMPC_TRACKED entries of w are the tracked parameters [their units] */
  hmpc_plan plan;
  hmpc_steady steady; /* if outputs have weights: steady state for the first row of their reference */
#if HMPC_MONITOR
  hmpc_monitor monitor; /* result of the last hmpc_finish */
#endif
#if HMPC_GUARD
  hmpc_guard guard;
#endif
#if HMPC_BACKUP
  hmpb_state backup; /* estimate and plan of the backup; u, status, source and age above are valid in every mode */
#endif
  /* internal */
  int prepared, pending;
#if HMPC_MONITOR
  int watched; /* 1: the monitor has processed this period */
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
#if HMPC_TURNS
  hmpc_real y[HMPC_NY]; /* the last sample, its periodic outputs moved by whole periods to the estimate */
#endif
  hmpc_real transition[HMPC_NE][HMPC_LE], product[HMPC_NE][HMPC_LE], stage[HMPC_NZ][HMPC_LJ];
#endif
} hmpc_state;

#if HMPC_MODES > 0
/* hmpc_start: first estimate, first plan (slower than a step), first input. hmpc_step: estimate and decision of one
   period. y: outputs; a non-finite value is a missing sample; periodic ones may be wrapped. w: measured disturbances,
   HMPC_MEASURED; NULL or not finite: the last values. applied: input that acted until now; NULL: the operating point's
   input, in hmpc_step the last decision. */
void hmpc_start(hmpc_state *s, const hmpc_real *y, const hmpc_real *w, const hmpc_real *applied, const hmpc_goal *goal);
void hmpc_step(hmpc_state *s, const hmpc_real *y, const hmpc_real *w, const hmpc_real *applied, const hmpc_goal *goal);
/* Runs the monitor, determines the guard's next mode, and prepares the part of the next step that needs no sample.
   Reads only the weights of the goal. hmpc_step calls hmpc_finish if the caller did not. */
void hmpc_finish(hmpc_state *s, const hmpc_goal *goal);

#if HMPC_MONITOR
/* The monitor alone, on the sample y, the input that acted before it, and the estimate in s->x, h, d, w. */
void hmpc_watch_begin(hmpc_state *s);
void hmpc_watch(hmpc_state *s, const hmpc_real *y, const hmpc_real *u_prev);
#endif

/* The estimator alone: s->x, h, d, w, with tracked parameters as the last of w. */
void hmpc_estimate_start(hmpc_state *s, const hmpc_real *y, const hmpc_real *w);
void hmpc_estimate_update(hmpc_state *s, const hmpc_real *y, const hmpc_real *u_prev, const hmpc_real *w);
#endif

/* The controller alone, with an estimate in s->x, h, d, w. */
void hmpc_clear(hmpc_state *s);
void hmpc_run_free(hmpc_state *s, const hmpc_real *u, int rows); /* plan: free run with inputs u, the last row holds */
void hmpc_prepare(hmpc_state *s, const hmpc_goal *goal);         /* shift the plan, linearize, condense */
void hmpc_linearize(hmpc_state *s, const hmpc_goal *goal);       /* at s->linear as it is */
void hmpc_load_plan(hmpc_state *s, const hmpc_real *u, const hmpc_real *z, const hmpc_real *d, const hmpc_real *w);
hmpc_status hmpc_feedback(hmpc_state *s, const hmpc_goal *goal, const hmpc_real *w, int w_rows); /* w NULL: s->w held */
void hmpc_complete(hmpc_state *s); /* hidden states of the plan; hmpc_prepare calls it */
void hmpc_begin(hmpc_state *s, const hmpc_real *applied, const hmpc_goal *goal); /* the first plan and input */
void hmpc_decide(hmpc_state *s, const hmpc_goal *goal, const hmpc_real *applied); /* s->u */

/* Functions for a guard. hmpc_take_over: start from another controller's plan (HMPC_N rows), one period later.
   hmpc_fall_back: stabilising feedback instead of a solve. hmpc_rest: the safe input. */
void hmpc_take_over(hmpc_state *s, const hmpc_real *plan, const hmpc_real *held);
void hmpc_fall_back(hmpc_state *s, const hmpc_goal *goal, const hmpc_real *held);
void hmpc_rest(hmpc_state *s, const hmpc_goal *goal, const hmpc_real *held);

#if HMPC_OUTPUT_COST
/* Steady state for a set-point of outputs with measured disturbances w and estimated disturbances s->d. start: start
   point or NULL; wide: 1: also try other start points. */
void hmpc_steady_state(hmpc_state *s, const hmpc_real *y, const hmpc_real *w, const hmpc_steady *start, int wide,
                       hmpc_steady *found);
void hmpc_aim(hmpc_state *s, const hmpc_goal *goal); /* sets s->target, for the measured disturbances of s->linear */
#endif

/* The model: step of one period, and its Jacobian (HMPC_NZ rows of HMPC_LJ; structural zeros are not written). */
void hmpc_model(const hmpc_real *z, const hmpc_real *u, const hmpc_real *w, hmpc_real *z_next);
void hmpc_model_slope(const hmpc_real *z, const hmpc_real *u, const hmpc_real *w, hmpc_real *z_next, hmpc_real *slope);

#if HMPC_RATES
void hmpc_rates(const hmpc_real *z, const hmpc_real *u, const hmpc_real *w, hmpc_real *xdot); /* rates of x */
#endif

hmpc_status hmpc_qp_solve(hmpc_qp *qp, hmpc_working *w, const hmpc_linear *linear);
void hmpc_qp_factor(hmpc_qp *qp);
void hmpc_qp_multipliers(const hmpc_qp *qp, const hmpc_working *w, hmpc_real *to); /* of the bounded expressions */
void hmpc_qp_shift(hmpc_working *w);
#ifndef HMPC_N
#error "hmpc_config.h lacks the sizes"
#endif
#endif
