/* @if pll@ */
/* One tick of the PLL on v: stage.omega_pll is then the measured frequency, p.u. */
static void measure_frequency(@LAW@@P@_t *s, const real y[])
{
    const real *v = &y[@GUARD@_Y_V_D];
    real cosine = s->stage.pll[0], sine = s->stage.pll[1];
    real size = @sqrt@(v[0] * v[0] + v[1] * v[1]);
    real error = v[1] * cosine - v[0] * sine, h, a, b, turned, length;
    if (size > @least_v@) { /* else there is no voltage to follow */
        error = error / size;
    }
    s->stage.omega_pll += @T_k_pll@ * error;
    h = (s->stage.omega_pll + @k_pll@ * error - y[@GUARD@_Y_OMEGA_U]) * @half_turn@;
    /* times (1 + jh)/(1 - jh), whose modulus is 1; the root takes the rounding out */
    a = @1@ - h * h;
    b = h + h;
    turned = a * cosine - b * sine;
    sine = a * sine + b * cosine;
    length = @sqrt@(turned * turned + sine * sine);
    s->stage.pll[0] = turned / length;
    s->stage.pll[1] = sine / length;
}

/* @end@ */
/* @if power@ */
/* omega_u, p.u., lowered while p is above P_max and raised while it is below P_min. */
static real limit_power(@LAW@@P@_t *s, real p, real omega)
{
    real over = p - @P_max@, under = @P_min@ - p, lower, raise;
    s->stage.x_high += @T_k_Pi@ * over;
    if (s->stage.x_high < @0@) {
        s->stage.x_high = @0@;
    }
    s->stage.x_low += @T_k_Pi@ * under;
    if (s->stage.x_low < @0@) {
        s->stage.x_low = @0@;
    }
    lower = @k_P@ * over + s->stage.x_high;
    raise = @k_P@ * under + s->stage.x_low;
    if (lower > @0@) {
        omega = omega - lower;
    }
    if (raise > @0@) {
        omega = omega + raise;
    }
    return limited(omega, @low_omega@, @high_omega@);
}

/* @end@ */
/* @if stage@ */
/* Cuts i* to I_max, and remembers whether that was needed. */
static void limit_current(@LAW@@P@_t *s)
{
    real d = s->stage.i_ref[0], q = s->stage.i_ref[1];
    real size = d * d + q * q, most = @I_max@ * @I_max@;
    s->limited = size > most;
    if (!s->limited) {
        return;
    }
    /* @if angle@ */
        d = @I_cos@;
        q = @I_sin@;
    /* @elif keep_d@ */
        real rest;
        d = limited(d, -@I_max@, @I_max@);
        rest = @sqrt@(most - d * d);
        q = limited(q, -rest, rest);
    /* @elif keep_q@ */
        real rest;
        q = limited(q, -@I_max@, @I_max@);
        rest = @sqrt@(most - q * q);
        d = limited(d, -rest, rest);
    /* @else@ */
        real scale = @I_max@ / @sqrt@(size);
        d = d * scale;
        q = q * scale;
    /* @end@ */
    s->stage.i_ref[0] = d;
    s->stage.i_ref[1] = q;
}

/* @end@ */
/* @if stator@ */
/* One tick of the virtual stator by the trapezoidal rule on its own pole: i* from E - v. */
static void stator(@LAW@@P@_t *s, const tick_t *t, const real y[], real E_d, real E_q)
{
    const real *v = &y[@GUARD@_Y_V_D];
    real b = t->omega * @half_turn@, keep = @1@ - @stator_a@, lose = @1@ + @stator_a@;
    real d = s->stage.x_v[0], q = s->stage.x_v[1];
    real r_d = keep * d + b * q + @stator_b@ * (E_d - v[0]);
    real r_q = keep * q - b * d + @stator_b@ * (E_q - v[1]);
    real size = lose * lose + b * b;
    s->stage.x_v[0] = (r_d * lose + r_q * b) / size;
    s->stage.x_v[1] = (r_q * lose - r_d * b) / size;
    s->stage.i_ref[0] = s->stage.x_v[0];
    s->stage.i_ref[1] = s->stage.x_v[1];
    limit_current(@law@s);
}

/* @end@ */
/* @if voltage@ */
/* The voltage over the threshold impedance, 0 below the threshold. */
static void drop(@LAW@const @P@_t *s, real omega, real over[])
{
    real d = s->stage.i_f[0], q = s->stage.i_f[1], R = @0@, X = @0@;
    /* @if threshold@ */
        real beyond = @sqrt@(d * d + q * q) - @I_thr@;
        if (beyond < @0@) {
            beyond = @0@;
        }
        R = @k_thr@ * beyond;
        X = R * omega * @sigma@;
    /* @else@ */
        (void)omega; /* no threshold: over is 0, with the signs of the kernel's zeros */
    /* @end@ */
    over[0] = R * d - X * q;
    over[1] = R * q + X * d;
}

/* One tick of the voltage loop: i* from v* - v; it integrates only within the limit. */
static void voltage_loop(@LAW@@P@_t *s, const tick_t *t, const real y[], real E_d, real E_q)
{
    const real *v = &y[@GUARD@_Y_V_D], *i_o = &y[@GUARD@_Y_I_OD];
    real X = t->omega * @X_v@, B = t->omega * @C_f@, over[2], error_d, error_q;
    drop(@law@s, t->omega, over);
    E_d = E_d - over[0];
    E_q = E_q - over[1];
    error_d = E_d - @R_v@ * i_o[0] + X * i_o[1] - v[0];
    error_q = E_q - @R_v@ * i_o[1] - X * i_o[0] - v[1];
    s->stage.i_ref[0] = @k_v@ * error_d + s->stage.x_v[0] + @k_ff@ * i_o[0] - B * v[1];
    s->stage.i_ref[1] = @k_v@ * error_q + s->stage.x_v[1] + @k_ff@ * i_o[1] + B * v[0];
    limit_current(@law@s);
    if (!s->limited) {
        s->stage.x_v[0] += @T_k_vi@ * error_d;
        s->stage.x_v[1] += @T_k_vi@ * error_q;
    }
    /* @if threshold@ */
        s->limited = s->limited || over[0] != @0@ || over[1] != @0@;
    /* @end@ */
}

/* @end@ */
/* One tick of the inner stage, between output and advance of the law: stage.e from E_u. */
static void shape(@LAW@@P@_t *s, tick_t *t, const real y[])
{
    real E_d = t->u[2] + s->stage.away[0], E_q = s->stage.away[1];
    t->omega = t->u[1];
    /* @if stage@ */
        const real *i = &y[@GUARD@_Y_I_D], *v = &y[@GUARD@_Y_V_D];
        real X, most, size;
        /* @if power@ */
            t->omega = limit_power(@law@s, y[@GUARD@_Y_P], t->omega);
        /* @end@ */
        /* the low-passes on v and i */
        s->stage.v_f[0] += @follow_v@ * (v[0] - s->stage.v_f[0]);
        s->stage.v_f[1] += @follow_v@ * (v[1] - s->stage.v_f[1]);
        s->stage.i_f[0] += @follow_i@ * (i[0] - s->stage.i_f[0]);
        s->stage.i_f[1] += @follow_i@ * (i[1] - s->stage.i_f[1]);
        /* @if stator@ */
            stator(@law@s, t, y, E_d, E_q);
        /* @else@ */
            voltage_loop(@law@s, t, y, E_d, E_q);
        /* @end@ */
        /* the current loop: e from i* - i */
        X = t->omega * @L_f@;
        E_d = s->stage.i_ref[0] - i[0];
        E_q = s->stage.i_ref[1] - i[1];
        s->stage.e[0] = s->stage.v_f[0] + @k_c@ * E_d + s->stage.x_c[0] - X * i[1];
        s->stage.e[1] = s->stage.v_f[1] + @k_c@ * E_q + s->stage.x_c[1] + X * i[0];
        /* @if integral@ */
            s->stage.x_c[0] += @T_k_ci@ * E_d;
            s->stage.x_c[1] += @T_k_ci@ * E_q;
        /* @end@ */
        most = @m@ * y[@GUARD@_Y_V_DC];
        size = s->stage.e[0] * s->stage.e[0] + s->stage.e[1] * s->stage.e[1];
        if (size > most * most) { /* the limit of the modulation */
            real scale = most / @sqrt@(size);
            s->stage.e[0] *= scale;
            s->stage.e[1] *= scale;
        }
    /* @else@ */
        (void)y;
        s->limited = 0;
        s->stage.e[0] = E_d;
        s->stage.e[1] = E_q;
    /* @end@ */
    s->stage.away[0] = faded(s->stage.away[0] * @decay@);
    s->stage.away[1] = faded(s->stage.away[1] * @decay@);
}

