#ifndef @GUARD@_H
#define @GUARD@_H

/* @if fixed@ */
#include <stdint.h>

/* @elif counts@ */
#include <stdint.h>

/* @elif tuned@ */
#include <stdint.h>

/* @end@ */
#ifdef __cplusplus
extern "C" {
#endif

typedef @C_REAL@ @P@_real;

@SIGNALS@

/* What step, look, settle and switch return. All but OK is the safe state: the plant must block its
 * bridge. It is latched: only init and reset leave it. */
enum {
@REASONS@
};

@TYPES@

/* @if stages@ */
/* The inner stage's variables in the converter's dq frame, p.u. */
typedef struct {
@STAGE@
} @P@_stage_t;

/* @end@ */
/* @if counts@ */
/* What the interrupt of the A/D keeps. On a change of law copy it to the new law's instance. */
typedef struct {
@COUNTS@
} @P@_counts_t;

/* @end@ */
/* @if tuned@ */
/* The law's gains, in the units of its file; a parameter that the file ties to others follows them. */
typedef struct {
@GAIN_MEMBERS@
} @P@_gains_t;

enum { @GUARD@_NGAINS = @N_GAINS@, @GUARD@_NCOEFFICIENTS = @N_COEFFICIENTS@ };

/* What follows from them. */
typedef struct {
    @P@_real c[@GUARD@_NCOEFFICIENTS];
    uint32_t crc;
} @P@_set_t;

/* @end@ */
/* One instance. All that changes is in here, so there may be several. Treat it as read-only. */
typedef struct {
    @P@_real x[@GUARD@_NX];      /* states of the law, scaled */
    @P@_real offset[@N_ROWS@]; /* p.u., what a change of law left in u; decays */
    @P@_real u[@N_ROWS@];      /* the law's last u, p.u. */
    @P@_real trend[@N_ROWS@];  /* p.u. per tick, filtered u[k] - u[k-1] */
/* @if stages@ */
    @P@_stage_t stage;
/* @if counts@ */
    @P@_counts_t counts;
/* @end@ */
    int limited;                /* whether the stage limited the current in this tick */
/* @end@ */
/* @if fixed@ */
    int64_t rest[@GUARD@_NREST]; /* of the offset, the trend and x: their lower bits */
/* @end@ */
    int reason;                 /* 0, or why it is in the safe state */
    int channel;                /* which signal was the reason, or -1 */
/* @if tuned@ */
    @P@_set_t set[2];
    volatile int active, ready; /* which set is in use, and whether the other one shall be */
/* @end@ */
} @P@_t;

/* @if tuned@ */
/* The gains of the law file. */
extern const @P@_gains_t @P@_gains;

/* Gives the law other gains, without a bump: the next step or settle takes them, all in one tick. Not
 * for an interrupt; a step may interrupt it. Returns 0; or k + 1 if gain k is out of range; or
 * @GUARD@_NGAINS + 1 if the gains together give no stable law: then the old ones stay. init goes back
 * to the gains of the law file, reset keeps them. */
int @P@_tune(@P@_t *s, const @P@_gains_t *gains);

/* Whether the coefficients in use are as init or tune has left them, by their CRC-32. */
int @P@_intact(const @P@_t *s);
/* @end@ */

/* Makes an instance ready: states 0, the last u as by default in the signal table. */
void @P@_init(@P@_t *s);

/* @if stages@ */
/* Leaves the safe state: states 0; u and stage.e stay. Call settle before the next step. */
/* @else@ */
/* Leaves the safe state: states 0, and the last good u stays. Call settle before the next step. */
/* @end@ */
void @P@_reset(@P@_t *s);

/* One tick: from the references and measurements sampled at tick k to u[k], and the state to k + 1.
 * Let u[k] act from tick k + 1 on, as the bench does. u stays as it is when the result is not OK. */
int @P@_step(@LAW@@P@_t *s, const @P@_real ref[], const @P@_real y[],
    @P@_real u[]);

/* @if stages@ */
/* The law's own u[k] (i_u, omega_u, E_u) without a step. */
/* @else@ */
/* u[k] without a step. */
/* @end@ */
int @P@_look(@LAW@const @P@_t *s, const @P@_real ref[], const @P@_real y[],
    @P@_real u[]);

/* @if stages@ */
/* Sets the state so that the law's own u[k] is u, and goes on with the slope trend (p.u. per tick); and
 * the stage so that the bridge's voltage goes on at e (e_d, e_q), p.u. On return u is what comes out
 * of the law: the same but for rounding, or this law's limit. u, trend and e are not parts of s. What
 * is not finite gives BAD_U, and s stays. */
/* @else@ */
/* Sets the state so that u[k] is u, and goes on with the slope trend (p.u. per tick). On return u is
 * what comes out: the same but for rounding, or this law's limit. u and trend are not parts of s.
/* @if fixed@ */
 * Call it with u and trend in range. */
/* @else@ */
 * What is not finite gives BAD_U, and s stays. */
/* @end@ */
/* @end@ */
int @P@_settle(@LAW@@P@_t *s, const @P@_real ref[], const @P@_real y[],
    @P@_real u[], const @P@_real trend[]@E_OF@);

/* Changes to this law without a bump, in one tick: look at the old law for u, switch with that u and
/* @if stages@ */
 * the old law's trend and stage.e, and go on with step of this one. bump is max |change of u|, p.u. */
/* @else@ */
 * the old law's trend, and go on with step of this one. bump is max |change of u|, p.u. */
/* @end@ */
int @P@_switch(@LAW@@P@_t *s, const @P@_real ref[], const @P@_real y[],
    @P@_real u[], const @P@_real trend[]@E_OF@, @P@_real *bump);

/* @if counts@ */
/* The whole of a tick between the pins: counts of the A/D, in the order of the enum, to u[k] as step
 * gives it and to compare counts of the legs for half a carrier; cmp[@GUARD@_NCMP] is 1 while the gates
 * may switch. They act from the next tick on. In the safe state it is 0, and u and cmp stay. */
int @P@_isr(@LAW@@P@_t *s, const @P@_real ref[], const uint16_t adc[],
    @P@_real u[], uint16_t cmp[]);

/* The measurement of isr alone, to counts.sensed: for settle before the first tick and switch before the
 * next one. Give it a copy of the instance if isr gets the same counts afterwards. */
int @P@_sense(@LAW@@P@_t *s, const uint16_t adc[]);

/* Before the first tick, and before the one after reset: sets the frame's angle from the measured
 * voltage, which then has the components counts.sensed of it: along d, if nothing was written there. */
void @P@_align(@LAW@@P@_t *s, const uint16_t adc[]);

/* Before align, as often as the law calibrates (calibrate of [measure]; with 0, or more often, it does
 * nothing): takes the counts of a bridge without current for the mean that its sensors read then. The
 * last one gives BAD_SENSOR if an offset is too large. */
int @P@_calibrate(@LAW@@P@_t *s, const uint16_t adc[]);

/* @end@ */
#ifdef __cplusplus
}
#endif
#endif
