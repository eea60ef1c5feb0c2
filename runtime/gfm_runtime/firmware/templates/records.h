/* A law as data: u = u_0 + C x + D_r r + D_y y and x' = A x + B_r r + B_y y, with the limits, the
 * anti-windup W, the loop over omega_u in closed form, and the maps of a bumpless change. */
typedef struct {
    int n; /* states in use */
    int error_map;
    gfm_real error_parameters[2]; /* R and X of the line, p.u. */
    gfm_real A[GFM_NX][GFM_NX];
    gfm_real B_r[GFM_NX][GFM_NREF], B_y[GFM_NX][@N_COLUMNS@];
    gfm_real C[@N_ROWS@][GFM_NX];
    gfm_real D_r[@N_ROWS@][GFM_NREF], D_y[@N_ROWS@][@N_COLUMNS@];
    gfm_real D_u0[@N_ROWS@][GFM_NREF]; /* set-points of u that follow a reference */
    gfm_real u_0[@N_ROWS@];
    gfm_real loop; /* 1/(1 - D_y[1][2]) */
    gfm_real low[@N_ROWS@], high[@N_ROWS@]; /* limits of u, p.u. */
    gfm_real W[GFM_NX][@N_ROWS@];
    gfm_real decay;  /* of the offset, per tick */
    gfm_real follow; /* of the trend filter, per tick */
    gfm_real E_r[GFM_NX][GFM_NREF], E_y[GFM_NX][@N_COLUMNS@], F[GFM_NX][@N_ROWS@], G[GFM_NX][@N_ROWS@];
/* @if stages@ */
    int inner, priority; /* @KINDS@ */
    int freeze;          /* whether the states of E_u may not lead further into the limit of the current */
    int row[GFM_NX]; /* of u that each state belongs to */
/* @if counts@ */
    int @COUNTS_INTEGERS@; /* two currents; kind of modulator, and so on */
/* @end@ */
    gfm_real @CONSTANTS@;
/* @end@ */
} gfm_law_t;
