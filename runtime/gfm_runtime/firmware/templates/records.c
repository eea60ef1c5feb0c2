static void set_inputs(const gfm_law_t *law, tick_t *t, const real ref[], const real y[])
{
    int j;
    for (j = 0; j < GFM_NREF; j++) {
        t->ref[j] = ref[j];
        t->r[j] = ref[j];
    }
    for (j = 0; j < @N_COLUMNS@; j++) {
        t->y[j] = y[j];
    }
    switch (law->error_map) {
    case @DC_ENERGY@:
        dc_energy(t->r, t->y);
        break;
    case @DVOC@:
        dvoc(t->r, t->y);
        break;
    case @HYBRID_ANGLE@:
        hybrid_angle(law->error_parameters[0], law->error_parameters[1], t->r, t->y);
        break;
    default:
        break;
    }
}

/* u_i without the column of omega_u. */
static real row(const gfm_law_t *law, const gfm_t *s, const tick_t *t, int i)
{
    real a = law->u_0[i] + s->offset[i];
    int j;
    for (j = 0; j < law->n; j++) {
        a += law->C[i][j] * s->x[j];
    }
    for (j = 0; j < GFM_NREF; j++) {
        a += law->D_u0[i][j] * t->ref[j] + law->D_r[i][j] * t->r[j];
    }
    for (j = 0; j < @N_COLUMNS@; j++) {
        if (j != 2) {
            a += law->D_y[i][j] * t->y[j];
        }
    }
    return a;
}

static void output(const gfm_law_t *law, const gfm_t *s, tick_t *t)
{
    int i;
    t->raw[1] = row(law, s, t, 1) * law->loop;
    t->u[1] = limited(t->raw[1], law->low[1], law->high[1]);
    t->y[2] = t->u[1];
    for (i = 0; i < @N_ROWS@; i += 2) {
        t->raw[i] = row(law, s, t, i) + law->D_y[i][2] * t->y[2];
        t->u[i] = limited(t->raw[i], law->low[i], law->high[i]);
    }
}

static void advance(const gfm_law_t *law, gfm_t *s, const tick_t *t)
{
    real next[GFM_NX];
    int i, j;
/* @if stages@ */
    real move = @0@;
    int frozen;
/* @end@ */
    for (i = 0; i < @N_ROWS@; i++) {
        real excess = t->u[i] - t->raw[i];
/* @if stages@ */
        if (i == 1 && law->inner != 0) { /* the power limiter moves omega_u too */
            excess = t->omega - t->raw[i];
        }
/* @end@ */
        if (excess != @0@) {
            for (j = 0; j < law->n; j++) {
                s->x[j] += law->W[j][i] * excess;
            }
        }
        s->offset[i] = faded(s->offset[i] * law->decay);
        s->trend[i] = faded(s->trend[i] + law->follow * (t->u[i] - s->u[i] - s->trend[i]));
        s->u[i] = t->u[i];
    }
    for (i = 0; i < law->n; i++) {
        real a = law->B_r[i][0] * t->r[0];
        for (j = 1; j < GFM_NREF; j++) {
            a += law->B_r[i][j] * t->r[j];
        }
        for (j = 0; j < @N_COLUMNS@; j++) {
            a += law->B_y[i][j] * t->y[j];
        }
        for (j = 0; j < law->n; j++) {
            a += law->A[i][j] * s->x[j];
        }
        next[i] = a;
    }
/* @if stages@ */
    for (i = 0; i < law->n; i++) {
        if (law->row[i] == 2) {
            move += law->C[2][i] * (next[i] - s->x[i]);
        }
    }
    /* a move of E_u towards v lets the current leave its limit */
    frozen = (law->freeze && s->limited && move * (s->u[2] - s->stage.v_f[0]) > @0@) ? 1 : 0;
/* @end@ */
    for (i = 0; i < law->n; i++) {
/* @if stages@ */
        if (!(frozen && law->row[i] == 2)) {
            s->x[i] = faded(next[i]);
        }
/* @else@ */
        s->x[i] = faded(next[i]);
/* @end@ */
    }
}

static void set_states(const gfm_law_t *law, gfm_t *s, tick_t *t, const real u[])
{
    int i, j, m;
    t->y[2] = u[1];
    for (i = 0; i < law->n; i++) {
        real a = law->E_r[i][0] * t->r[0];
        for (j = 1; j < GFM_NREF; j++) {
            a += law->E_r[i][j] * t->r[j];
        }
        for (j = 0; j < @N_COLUMNS@; j++) {
            a += law->E_y[i][j] * t->y[j];
        }
        for (j = 0; j < @N_ROWS@; j++) {
            real wanted = u[j] - law->u_0[j];
            for (m = 0; m < GFM_NREF; m++) {
                wanted -= law->D_u0[j][m] * t->ref[m];
            }
            a += law->F[i][j] * wanted + law->G[i][j] * s->trend[j];
        }
        s->x[i] = a + @0@; /* never -0 */
    }
}

