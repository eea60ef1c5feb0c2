/* 0, or the reason to refuse these inputs: the state, or the ranges of the signal table. */
static int refused(const @P@_t *s, const real ref[], const real y[], int *channel)
{
    if (s->reason != @GUARD@_OK) {
        *channel = s->channel;
        return s->reason;
    }
    *channel = @Y_CHECKS@
             : -1;
    if (*channel >= 0) {
        return @GUARD@_BAD_Y;
    }
    *channel = @REF_CHECKS@
             : -1;
    return *channel >= 0 ? @GUARD@_BAD_REF : @GUARD@_OK;
}

void @P@_init(@P@_t *s)
{
    static const real u[] = {@U_DEFAULT@};
    int i;
/* @if stages@ */
    s->stage.e[0] = u[2];
    s->stage.e[1] = @0@;
/* @end@ */
    @P@_reset(s);
    for (i = 0; i < @N_ROWS@; i++) {
        s->u[i] = u[i];
    }
}

void @P@_reset(@P@_t *s)
{
    int i;
    for (i = 0; i < @GUARD@_NX; i++) {
        s->x[i] = @0@;
    }
    for (i = 0; i < @N_ROWS@; i++) {
        s->offset[i] = @0@;
        s->trend[i] = @0@;
    }
/* @if stages@ */
    {
        const @P@_stage_t rest = {
            .e = {s->stage.e[0], s->stage.e[1]}, .pll = {@1@, @0@}, .omega_pll = @OMEGA_DEFAULT@};
        s->stage = rest;
    }
    s->limited = 0;
/* @end@ */
    s->reason = @GUARD@_OK;
    s->channel = -1;
}

int @P@_step(@LAW@@P@_t *s, const real ref[], const real y[], real u[])
{
    tick_t t;
/* @if pll@ */
    real seen[@GUARD@_NREF];
    int k;
/* @end@ */
    int reason = refused(s, ref, y, &s->channel);
    if (reason != @GUARD@_OK) {
        s->reason = reason;
        return reason;
    }
    /* @if pll@ */
        measure_frequency(@law@s, y);
        for (k = 0; k < @GUARD@_NREF; k++) {
            seen[k] = ref[k];
        }
        seen[@GUARD@_REF_OMEGA_G] = s->stage.omega_pll;
        ref = seen;
    /* @end@ */
    set_inputs(@law@&t, ref, y);
    output(@law@s, &t);
/* @if stages@ */
    shape(@law@s, &t, y);
    advance(@law@s, &t);
    if (!((t.omega - t.omega) + (t.u[0] - t.u[0]) + (s->stage.e[0] - s->stage.e[0])
            + (s->stage.e[1] - s->stage.e[1])
            == @0@)) {
        /* omega_u first: column 3 takes it to the others */
        s->channel = !(t.omega - t.omega == @0@)         ? 1
            : !(t.u[0] - t.u[0] == @0@)                  ? 0
            : !(s->stage.e[0] - s->stage.e[0] == @0@)    ? 2
                                                       : 3;
        s->reason = @GUARD@_BAD_U;
        return s->reason;
    }
    u[0] = t.u[0];
    u[1] = t.omega;
    u[2] = s->stage.e[0];
    u[3] = s->stage.e[1];
/* @else@ */
    advance(@law@s, &t);
    if (!((t.u[1] - t.u[1]) + (t.u[0] - t.u[0]) + (t.u[2] - t.u[2]) == @0@)) {
        /* omega_u first: column 3 takes it to the others */
        s->channel = !(t.u[1] - t.u[1] == @0@) ? 1 : !(t.u[0] - t.u[0] == @0@) ? 0 : 2;
        s->reason = @GUARD@_BAD_U;
        return s->reason;
    }
    u[0] = t.u[0];
    u[1] = t.u[1];
    u[2] = t.u[2];
/* @end@ */
    return @GUARD@_OK;
}

/* The output for all but step. */
static void evaluate(@LAW@const @P@_t *s, tick_t *t)
{
    output(@law@s, t);
}

int @P@_look(@LAW@const @P@_t *s, const real ref[], const real y[], real u[])
{
    tick_t t;
    int i, channel, reason = refused(s, ref, y, &channel);
    if (reason != @GUARD@_OK) {
        return reason;
    }
    set_inputs(@law@&t, ref, y);
    evaluate(@law@s, &t);
    for (i = 0; i < @N_ROWS@; i++) {
        u[i] = t.u[i];
    }
    return @GUARD@_OK;
}

int @P@_settle(@LAW@@P@_t *s, const real ref[], const real y[], real u[], const real trend[]@E@)
{
    tick_t t;
    int i, channel, reason = refused(s, ref, y, &channel);
    if (reason != @GUARD@_OK) {
        return reason;
    }
    set_inputs(@law@&t, ref, y);
    for (i = 0; i < @N_ROWS@; i++) {
        s->offset[i] = @0@;
        s->trend[i] = trend[i];
        s->u[i] = u[i] - trend[i];
    }
    set_states(@law@s, &t, u);
    /* the offset takes the rest: all of it in a row without states, rounding in the others */
    evaluate(@law@s, &t);
    s->offset[1] = (u[1] - t.raw[1]) / @LOOP@;
    evaluate(@law@s, &t);
    s->offset[0] = u[0] - t.raw[0];
    s->offset[2] = u[2] - t.raw[2];
    evaluate(@law@s, &t);
/* @if stages@ */
    settle_stage(@law@s, t.u, y, e);
/* @end@ */
    for (i = 0; i < @N_ROWS@; i++) {
        u[i] = t.u[i];
    }
    return @GUARD@_OK;
}

int @P@_switch(@LAW@@P@_t *s, const real ref[], const real y[], real u[], const real trend[]@E@,
    real *bump)
{
    real old[@N_ROWS@], change;
    int i, reason;
    for (i = 0; i < @N_ROWS@; i++) {
        old[i] = u[i];
    }
    reason = @P@_settle(@law@s, ref, y, u, trend@e@);
    *bump = @0@;
    for (i = 0; i < @N_ROWS@; i++) {
        change = u[i] < old[i] ? old[i] - u[i] : u[i] - old[i];
        *bump = change > *bump ? change : *bump;
    }
    return reason;
}
