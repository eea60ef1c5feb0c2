/* A law as data: u = u_0 + C x + D_r r + D_y y and x' = A x + B_r r + B_y y, with the limits, the
 * anti-windup W, the loop over omega_u in closed form, and the maps of a bumpless change. */
typedef struct {
    int n; /* states in use */
    int error_map;
    gfm_real error_parameters[2]; /* R and X of the line, p.u. */
    gfm_real A[GFM_NX][GFM_NX];
    gfm_real B_r[GFM_NX][GFM_NREF], B_y[GFM_NX][GFM_NY];
    gfm_real C[GFM_NU][GFM_NX];
    gfm_real D_r[GFM_NU][GFM_NREF], D_y[GFM_NU][GFM_NY];
    gfm_real D_u0[GFM_NU][GFM_NREF]; /* set-points of u that follow a reference */
    gfm_real u_0[GFM_NU];
    gfm_real loop; /* 1/(1 - D_y[1][2]) */
    gfm_real low[GFM_NU], high[GFM_NU]; /* limits of u, p.u. */
    gfm_real W[GFM_NX][GFM_NU];
    gfm_real decay;  /* of the offset, per tick */
    gfm_real follow; /* of the trend filter, per tick */
    gfm_real E_r[GFM_NX][GFM_NREF], E_y[GFM_NX][GFM_NY], F[GFM_NX][GFM_NU], G[GFM_NX][GFM_NU];
} gfm_law_t;
