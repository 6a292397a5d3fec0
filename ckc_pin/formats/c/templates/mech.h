/* @TITLE@: dynamics and control of a closed kinematic chain in C99.
   Written by ckc_pin @VERSION@ (ckc export --to c).

   The coordinates q_tree (q') describe the tree, in which every loop is cut open; v_tree (v') are their rates. The loops
   are closed where phi(q') = 0. Then the independent coordinates q determine the dependent ones z, and v' = rho q_dot.
   Equations have the numbers of the paper that ckc_pin implements:
     eq. 1:   D' dv'/dt + C' v' + h' = u_tree + J^T multipliers, with phi(q') = 0 and J = d phi / d q'
     eq. 4:   sigma(q): the configuration q' with closed loops that belongs to q
     eq. 6:   D q_ddot + C q_dot + h = u, with D = rho^T D' rho
     eq. 14:  u = h(q_d) - K_P (q - q_d) - K_V q_dot
     eq. 16:  u = D dv/dt + C v + h - K_D (q_dot - v), with v = q_d_dot - Lambda (q - q_d)
   Gravity, springs and constant forces belong to h. Forces of dampers act in addition to u_tree and u.

   Use: call mech_set_parameters, mech_configure with mech_assembled, and mech_move to the measured q.
   Then call mech_tracking_step or mech_set_point_step once a sample, as main.c does.

   No heap, no writable globals, no recursion, no library but libm. Every loop has a fixed bound.
   Stack: at most MECH_STACK_BYTES, with all variables in memory as without optimization.

   Units are SI: m, rad, s, kg, N, N m. Matrices are dense, by columns: entry (i, k) of a matrix with r rows is m[i + r * k].

@COORDINATES@
*/
#ifndef MECH_H
#define MECH_H

#ifdef __cplusplus
extern "C" {
#endif

/* Sizes. Arrays have at least one entry. */
#define MECH_NQ @NQ@ /* numbers of a configuration q_tree */
#define MECH_N @N@ /* coordinates of the tree: entries of v_tree */
#define MECH_D @D@ /* independent coordinates q: degrees of freedom */
#define MECH_Z @Z@ /* dependent coordinates z */
#define MECH_ROWS @ROWS@ /* constraint rows, phi */
#define MECH_MOTORS @MOTORS@
#define MECH_POINTS @POINTS@ /* points that the mechanism names */
#define MECH_PARAMETERS @PARAMETERS@
#define MECH_NUMBERS @NUMBERS@ /* what a model stores */
#define MECH_SIZE(n) ((n) > 0 ? (n) : 1)

/* Bounds of Newton's method in mech_sigma. */
#define MECH_MAX_ITERATIONS @MAX_ITERATIONS@
#define MECH_MAX_STEP @MAX_STEP@ /* rad, or sizes of the mechanism */
#define MECH_TOLERANCE @TOLERANCE@ /* largest |phi| of closed loops */
#define MECH_PIECES 64 /* of the straight line in mech_move */

#define MECH_STACK_BYTES @STACK@

/* Places in v_tree, q, phi and tau. */
enum { @V_PLACES@ };
enum { @Q_PLACES@ };
@TAU_PLACES@
typedef enum {
  MECH_OK = 0,
  MECH_NOT_CLOSED, /* the loops cannot be closed near the guess: q is out of reach or too far from the guess */
  MECH_SINGULAR, /* phi_z is singular: q does not determine the configuration */
  MECH_NOT_FINITE, /* an argument or a result is not a finite number */
  MECH_INACCURATE, /* mech_acceleration lost more than four digits; use mech_forward_dynamics */
  MECH_UNDRIVEN /* the motors cannot produce every u */
} mech_status;

/* Parameters of the mechanism, with the names that ckc_pin uses.
   Mass, com and inertia are those of the whole body that a joint moves, in the joint's frame. Numbers that are zero in the
   files are no parameters. */
typedef struct {
@FIELDS@
} mech_parameters;

extern const mech_parameters mech_default_parameters; /* the values of the mechanism's files */

/* A model: parameters, prepared for the functions below. Constant while it is used. */
typedef struct {
  double numbers[MECH_SIZE(MECH_NUMBERS)];
} mech_model;

/* A configuration with the terms of its loops, eqs. 1 to 5. */
typedef struct {
  double q_tree[MECH_NQ]; /* q' */
  double trig[2 * MECH_NQ]; /* cosines and sines of q' */
  double phi[MECH_SIZE(MECH_ROWS)]; /* residual of the loops */
  double J[MECH_SIZE(MECH_ROWS * MECH_N)]; /* d phi / d q', (MECH_ROWS, MECH_N) */
  double phi_z[MECH_SIZE(MECH_Z * MECH_Z)]; /* factorized */
  int pivot[MECH_SIZE(MECH_Z)];
  double rho[MECH_N * MECH_D]; /* v' = rho q_dot, (MECH_N, MECH_D) */
#ifdef MECH_CHARTS
  int independent[MECH_D], dependent[MECH_SIZE(MECH_Z)]; /* places of q and z in v_tree, which an FMU changes */
#endif
} mech_configuration;

/* --- model and configurations --- */

void mech_set_parameters(mech_model *model, const mech_parameters *parameters);

/* The assembled configuration of the mechanism's files, (MECH_NQ). */
extern const double mech_assembled[MECH_NQ];

/* Places of q in q_tree. */
extern const int mech_q_places[MECH_D];

/* Evaluate a configuration q_tree that need not close the loops. MECH_SINGULAR, MECH_NOT_FINITE: without rho. */
mech_status mech_configure(const mech_model *model, const double *q_tree, mech_configuration *at);

/* sigma, eq. 4: move a complete configuration to the independent coordinates q and close its loops on the same branch, by
   at most MECH_MAX_ITERATIONS Newton steps. q must be near `at`. After another status than MECH_OK, `at` must not be used. */
mech_status mech_sigma(const mech_model *model, const double *q, mech_configuration *at);

/* The same for a q that is further away, along a straight line of MECH_PIECES pieces. */
mech_status mech_move(const mech_model *model, const double *q, mech_configuration *at);

/* --- terms --- */

/* v' = rho q_dot */
void mech_velocity(const mech_configuration *at, const double *q_dot, double *v_tree);

/* dv'/dt = rho q_ddot + rho_dot q_dot */
void mech_tree_acceleration(const mech_model *model, const mech_configuration *at, const double *v_tree,
                            const double *q_ddot, double *acceleration);

/* Positions and velocities of the mechanism's points in the world, (3, MECH_POINTS) each. */
void mech_points(const mech_model *model, const mech_configuration *at, const double *v_tree, double *positions,
                 double *velocities);

/* D', (MECH_N, MECH_N) */
void mech_D_tree(const mech_model *model, const mech_configuration *at, double *D_tree);

/* C' v' + h' less the forces of springs; J_dot v', (MECH_ROWS); forces of dampers */
void mech_bias_tree(const mech_model *model, const mech_configuration *at, const double *v_tree, double *bias_tree,
                    double *J_dot_v, double *damping);

/* h': gravity, springs and constant forces */
void mech_h_tree(const mech_model *model, const mech_configuration *at, double *h_tree);

double mech_potential_energy(const mech_model *model, const mech_configuration *at);

/* D, C and h of eq. 6: (MECH_D, MECH_D), (MECH_D, MECH_D), (MECH_D) */
void mech_D(const mech_model *model, const mech_configuration *at, double *D);
void mech_C(const mech_model *model, const mech_configuration *at, const double *q_dot, double *C);
void mech_h(const mech_model *model, const mech_configuration *at, double *h);

/* --- dynamics --- */

/* Eq. 1: the acceleration dv'/dt, (MECH_N), and the multipliers, (MECH_ROWS), under the force u_tree, (MECH_N), on the
   constraint manifold and off it, by elimination. */
mech_status mech_acceleration(const mech_model *model, const mech_configuration *at, const double *v_tree,
                              const double *u_tree, double *acceleration, double *multipliers);

/* The multipliers of an acceleration under the force u_tree. Those of redundant rows are zero. */
void mech_multipliers(const mech_model *model, const mech_configuration *at, const double *v_tree,
                      const double *u_tree, const double *acceleration, double *multipliers);

/* The force on the tree, (MECH_N), of motor torques tau. */
void mech_motor_force(const double *tau, double *u_tree);

/* Eq. 6: q_ddot under the force u_tree, by elimination with pivoting. */
mech_status mech_forward_dynamics(const mech_model *model, const mech_configuration *at, const double *q_dot,
                                  const double *u_tree, double *q_ddot);

/* The force u that q_ddot needs, eq. 6. */
void mech_inverse_dynamics(const mech_model *model, const mech_configuration *at, const double *q_dot,
                           const double *q_ddot, double *u);

/* Clip motor torques at the motors' limits. */
void mech_limit_torques(double *tau);

/* Motor torques of a force u, within the motors' limits; with redundant motors those of minimum norm. */
mech_status mech_motor_torques(const mech_configuration *at, const double *u, double *tau);

/* --- simulation of the reduced model --- */

typedef struct {
  mech_configuration at; /* loops closed */
  double q_dot[MECH_D];
} mech_motion;

/* Advance a motion by a time step (s) under constant torques: four stages of the classical Runge-Kutta method, the loops
   closed by sigma in each. After another status than MECH_OK, the motion is as before. */
mech_status mech_advance(const mech_model *model, mech_motion *motion, const double *tau, double step);

/* --- controllers: eqs. 14 and 16 --- */

typedef struct {
  double q[MECH_D];
  double q_dot[MECH_D];
  double q_d[MECH_D]; /* the desired motion at this instant; only mech_tracking_step reads it */
  double q_d_dot[MECH_D];
  double q_d_ddot[MECH_D];
} mech_measurement;

typedef struct {
  double u[MECH_D];
  double tau[MECH_SIZE(MECH_MOTORS)]; /* within the motors' limits */
} mech_command;

/* A controller's state: the last configuration, from which Newton's method starts. Initialize it by mech_configure with
   mech_assembled, then by mech_move to the measured q. */
typedef mech_configuration mech_state;

typedef struct {
  const mech_model *model;
  double K_P[MECH_D * MECH_D];
  double K_V[MECH_D * MECH_D];
  double q_d[MECH_D];
  double h_d[MECH_D]; /* h(q_d), written by mech_set_point_start */
} mech_set_point;

typedef struct {
  const mech_model *model;
  double Lambda[MECH_D * MECH_D];
  double K_D[MECH_D * MECH_D];
} mech_tracking;

/* Compute h(q_d) on the branch of a configuration. */
mech_status mech_set_point_start(mech_set_point *controller, const mech_configuration *start);

/* One sample of a controller. After another status than MECH_OK, the command is zero and the state as before. */
mech_status mech_set_point_step(const mech_set_point *controller, mech_state *state,
                                const mech_measurement *measurement, mech_command *command);
mech_status mech_tracking_step(const mech_tracking *controller, mech_state *state, const mech_measurement *measurement,
                               mech_command *command);

#ifdef __cplusplus
}
#endif

#endif
