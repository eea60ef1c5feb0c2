/* Sets the stage so that it goes on with the bridge's voltage e. What its structure cannot absorb goes
 * into stage.away. u is the law's output. */
static void settle_stage(@LAW@@P@_t *s, const real u[], const real y[], const real e[])
{
    const real *v = &y[@GUARD@_Y_V_D], *i = &y[@GUARD@_Y_I_D];
    real size = @sqrt@(v[0] * v[0] + v[1] * v[1]), need_d = e[0], need_q = e[1];
    int k;
    s->limited = 0;
    s->stage.omega_pll = u[1];
    s->stage.pll[0] = @1@;
    s->stage.pll[1] = @0@;
    if (size > @least_v@) {
        s->stage.pll[0] = v[0] / size;
        s->stage.pll[1] = v[1] / size;
    }
    s->stage.x_high = @0@;
    s->stage.x_low = @0@;
    for (k = 0; k < 2; k++) {
        s->stage.v_f[k] = v[k];
        s->stage.i_f[k] = i[k];
        s->stage.i_ref[k] = i[k];
        s->stage.x_c[k] = @0@;
        s->stage.x_v[k] = @0@;
        s->stage.e[k] = e[k];
    }
    /* @if stage@ */
        real X = u[1] * @L_f@, through_d, through_q, over[2] = {@0@, @0@};
        real lack_d = e[0] - v[0] + X * i[1], lack_q = e[1] - v[1] - X * i[0];
        /* @if integral@ */
            s->stage.x_c[0] = lack_d;
            s->stage.x_c[1] = lack_q;
        /* @else@ */
            s->stage.i_ref[0] += lack_d / @k_c@;
            s->stage.i_ref[1] += lack_q / @k_c@;
        /* @end@ */
        through_d = s->stage.i_ref[0];
        through_q = s->stage.i_ref[1];
        s->stage.x_v[0] = through_d;
        s->stage.x_v[1] = through_q;
        /* @if voltage@ */
            const real *i_o = &y[@GUARD@_Y_I_OD];
            real B = u[1] * @C_f@;
            drop(@law@s, u[1], over);
            s->stage.x_v[0] = through_d - @k_ff@ * i_o[0] + B * v[1];
            s->stage.x_v[1] = through_q - @k_ff@ * i_o[1] - B * v[0];
            through_d = i_o[0];
            through_q = i_o[1];
        /* @end@ */
        X = u[1] * @X_v@;
        need_d = v[0] + @R_v@ * through_d - X * through_q + over[0];
        need_q = v[1] + @R_v@ * through_q + X * through_d + over[1];
    /* @end@ */
    s->stage.away[0] = need_d - u[2];
    s->stage.away[1] = need_q;
}

