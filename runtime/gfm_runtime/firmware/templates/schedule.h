/* @LAW_NAME@: @COUNT@ stages of gains by the @QUANTITY@. @MADE@
 *
 * Source: @SOURCE@
 * The stage is chosen in double, whatever the law's precision: by the bench's bits. */
#ifndef @GUARD@_H
#define @GUARD@_H

@INCLUDES@

#ifdef __cplusplus
extern "C" {
#endif

typedef @FIRST@_real @P@_real;

enum { @GUARD@_NREF = @FIRST_GUARD@_NREF, @GUARD@_NY = @FIRST_GUARD@_NY, @GUARD@_NU = @FIRST_GUARD@_NU };
/* @if stages@ */
enum { @GUARD@_NROWS = @FIRST_GUARD@_NROWS };
/* @end@ */
enum {
    @GUARD@_OK = @FIRST_GUARD@_OK,
    @GUARD@_BAD_Y = @FIRST_GUARD@_BAD_Y,
    @GUARD@_BAD_U = @FIRST_GUARD@_BAD_U,
    @GUARD@_BAD_REF = @FIRST_GUARD@_BAD_REF
};

/* @if by_X@ */
/* The estimate of the grid's reactance from the swings of p and omega_u. */
typedef struct {
    double p_smooth, omega_smooth, theta, p_slow, p_slower, s_pt, s_tt, s_pp, omega_slow;
    double X; /* p.u. */
    long age; /* ticks, until it has settled */
} @P@_estimate_t;
/* @end@ */

/* One instance. All that changes is in here, so there may be several. Treat it as read-only. */
typedef struct {
@MEMBERS@
    /* @if by_X@ */
    @P@_estimate_t grid;
    /* @end@ */
    long since;  /* ticks since the last change, until the next one is allowed */
    long changes; /* of stage, so far */
    int active;  /* the stage that is in force, from 0 */
    int reason;  /* 0, or why it is in the safe state */
} @P@_t;

/* Makes an instance ready: the stage of @AT_START@, its states 0. */
void @P@_init(@P@_t *s);

/* Leaves the safe state: the states of the stage in force are 0. Call settle before the next step. */
void @P@_reset(@P@_t *s);

/* One tick, as a law's step: chooses the stage first, and changes it without a bump. */
int @P@_step(@P@_t *s, const @P@_real ref[], const @P@_real y[], @P@_real u[]);

/* As a law's settle, for the stage in force. */
int @P@_settle(@P@_t *s, const @P@_real ref[], const @P@_real y[],
    @P@_real u[], const @P@_real trend[]@E_OF@);

#ifdef __cplusplus
}
#endif
#endif
