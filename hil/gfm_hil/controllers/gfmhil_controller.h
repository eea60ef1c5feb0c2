/* What a controller on gfmhil's bench is, if it is a shared library: version 1.
 *
 * All values are in SI units and instantaneous. A phase voltage is against the star point, without a
 * common mode. The bench calls from one thread; several controllers may live in one process.
 * gfmhil_fault may be left out, and one of gfmhil_step and gfmhil_isr: a run whose laws read counts of
 * an A/D calls gfmhil_isr, any other gfmhil_step.
 */
#ifndef GFMHIL_CONTROLLER_H
#define GFMHIL_CONTROLLER_H

#define GFMHIL_CONTROLLER_VERSION 1

#ifdef __cplusplus
extern "C" {
#endif

/* The converter and the bench, given once. */
typedef struct {
    double period;  /* s, between two calls of gfmhil_step */
    double delay;   /* s, from the sampling of the inputs to the middle of the time for which e acts */
    double S_n;     /* VA, nominal power */
    double V_n;     /* V, nominal line-to-line RMS voltage */
    double omega_n; /* rad/s, nominal angular frequency */
    double V_dcref; /* V, nominal DC voltage */
} gfmhil_setup;

/* What the controller measures, and what its operator asks for. */
typedef struct {
    double t;         /* s, since tick 0 */
    double v[3];      /* V, at the filter's capacitor, phases a, b, c */
    double i[3];      /* A, out of the bridge */
    double i_o[3];    /* A, out of the filter towards the grid */
    double v_dc;      /* V */
    double P_ref;     /* W, out of the filter */
    double Q_ref;     /* var, out of the filter */
    double V_ref;     /* V, line-to-line RMS at the capacitor */
    double omega_ref; /* rad/s */
    double V_dc_ref;  /* V */
} gfmhil_input;

/* What the controller commands. */
typedef struct {
    double e[3]; /* V, of the bridge, phases a, b, c, until the next call */
    double i_dc; /* A, of the DC source */
} gfmhil_output;

/* GFMHIL_CONTROLLER_VERSION, as it was compiled. */
int gfmhil_version(void);

/* What a run calls the controller: printable ASCII. */
const char *gfmhil_name(void);

/* A controller, or NULL if it cannot work with this bench. */
void *gfmhil_new(const gfmhil_setup *setup);

/* Begin, at the start and after each reset: the plant rests with these inputs under `now`. Returns 0,
 * or a number of its own other than 0, which blocks the bridge. */
int gfmhil_start(void *controller, const gfmhil_input *in, const gfmhil_output *now);

/* One period. Returns as gfmhil_start; out holds what the last call left there. */
int gfmhil_step(void *controller, const gfmhil_input *in, gfmhil_output *out);

/* One period from pin to pin: counts of the A/D in, of v_dc and of the phases a, b, c of i, v and i_o,
 * sampled where the carrier is at its lower end; compare counts of the legs a, b, c out, in counts of the
 * timer of the run's bridge, which act one period later. in has t and what the operator asks for; its
 * measurements are 0. Of out only i_dc is read. Returns as gfmhil_start. */
int gfmhil_isr(void *controller, const gfmhil_input *in, const unsigned short adc[10],
               gfmhil_output *out, unsigned short cmp[3]);

/* What such a number means, or NULL. May be left out. */
const char *gfmhil_fault(void *controller, int number);

/* The end of a controller. */
void gfmhil_free(void *controller);

#ifdef __cplusplus
}
#endif

#endif
